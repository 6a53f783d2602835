"""The page: what the mouse does to tissue, what the page asks of the graph, and what a real browser shows."""

import itertools
import os
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import rclpy
from conftest import wait_until
from test_nodes import Bench, S, send_camera, send_model, sheet

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, save_cameras
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.drawing import draw_points
from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.physics.materials import MATERIALS
from endo_sim_ros.physics.stress import von_mises
from endo_sim_ros.viewer.browser import SPLATS, VIEWS, Pointer, _fitted, _padded
from endo_sim_ros.viewer.config import ViewerConfig
from endo_sim_ros.viewer.grasp import Grasp
from endo_sim_ros.viewer.viewer import PARAMETERS, SLIDERS, Tool

PORT = 20000 + os.getpid() % 20000
CAMERA = Camera(np.array([[200.0, 0, 100], [0, 200.0, 80], [0, 0, 1]]), 200, 160)
MOST = 3.0  # N
SOFT = PhysicsConfig(node_count=400, force_radius=0.02, device="cpu")


# ------------------------------------------------------------------------------------------------------ the pull


def pulled(target, stiffness, seconds=4.0, late=3, max_force=2.0, **options):
    """Where a grasp ends up whose tissue is a spring [N/m] that is felt some turns late, and all forces on the way."""
    options = {"max_force": max_force, "max_speed": 0.5, "reach": 0.04} | options
    grasp, forces = Grasp(np.eye(4), **options), [0.0] * late
    grasp.aim(np.asarray(target, float))
    for _ in range(int(seconds / 0.02)):
        forces.append(stiffness * float(np.linalg.norm(grasp.advance(0.02, forces[-late])[:3, 3])))
    return grasp.pose[:3, 3], np.array(forces)


def test_soft_tissue_follows_the_mouse_all_the_way():
    end, forces = pulled([0.01, 0.0, -0.005], stiffness=50)
    np.testing.assert_allclose(end, [0.01, 0.0, -0.005], atol=1e-6)
    assert forces[-1] < 2


@pytest.mark.parametrize("stiffness", [150, 1000, 20000])
def test_stiff_tissue_stops_at_the_largest_force_and_does_not_swing(stiffness):
    end, forces = pulled([0.03, 0, 0], stiffness)
    assert forces[-1] == pytest.approx(2.0, rel=0.02) and forces[-50:].std() < 0.01
    assert end[0] > 0 and not end[1:].any()


def test_pull_is_no_longer_than_the_reach_and_no_faster_than_allowed():
    end, _ = pulled([1.0, 0, 0], stiffness=0)
    assert np.linalg.norm(end) == pytest.approx(0.04)
    end, _ = pulled([1.0, 0, 0], stiffness=0, seconds=0.5, max_speed=0.01)
    assert np.linalg.norm(end) < 0.005


def test_jaw_closes_before_it_moves():
    grasp = Grasp(np.eye(4), 1.0, 1.0, 0.1)
    grasp.aim(np.array([0.1, 0, 0]))
    while not grasp.closed:
        assert np.array_equal(grasp.advance(0.01, 0.0), np.eye(4))
    assert grasp.advance(0.01, 0.0)[0, 3] > 0


# -------------------------------------------------------------------------------------------------------- stress


@pytest.mark.parametrize("material", MATERIALS)
def test_stress_of_small_strain_is_that_of_the_textbook(material):
    E, nu, strain = 10e3, 0.3, 1e-4
    stretch = np.diag([1 + strain, 1 - nu * strain, 1 - nu * strain])  # uniaxial: E times the strain
    shear = np.eye(3)
    shear[0, 1] = strain  # √3 G times the shear
    found = von_mises(np.stack([stretch, shear, 1.001 * np.eye(3)]), E, nu, material)
    np.testing.assert_allclose(found[:2], [E * strain, 3**0.5 * E / (2 * (1 + nu)) * strain], rtol=0.02)
    assert found[2] < 0.01, "pressure is not counted"


@pytest.mark.parametrize("material", MATERIALS)
def test_turned_tissue_has_no_stress_and_collapsed_tissue_a_finite_one(material):
    turn = cv2.Rodrigues(np.array([0.3, -1.0, 0.5]))[0]
    F = np.stack([turn, np.zeros((3, 3)), -np.eye(3), turn @ np.diag([1.2, 1, 1])])
    found = von_mises(F, 10e3, 0.3, material)
    assert np.isfinite(found).all() and found[0] < 1 and not found[1:3].any() and found[3] > 1000


# ----------------------------------------------------------------------------------------------- page without browser


class FakeBrowser:
    """Stands for a browser that looks from the origin and keeps what it is shown."""

    view, wants_splats, wants_nodes, wants_stress = SPLATS, True, True, True

    def __init__(self):
        self.splats, self.colors, self.models = [], [], 0

    def ray(self, x, y):
        local = np.linalg.solve(CAMERA.K, [x * CAMERA.width, y * CAMERA.height, 1.0])
        return np.zeros(3), local, CAMERA

    def show_model(self, viewer):
        self.models += 1

    def show_splats(self, *splats):
        self.splats.append(splats)

    def show_nodes(self, positions, colors, size):
        self.colors.append(colors)

    def show_picture(self, viewer, dirty):
        pass

    def close(self):
        pass


def point(viewer, phase, at, client=1, lifts=False):
    viewer.point(Pointer(client, phase, (0.5, 0.5), at, lifts))


@pytest.fixture
def page():
    pytest.importorskip("viser")
    from endo_sim_ros.viewer.standalone import Standalone

    page = Standalone(sheet(tilt=0.3), [CAMERA], SOFT, ViewerConfig(port=PORT, rate=60.0, max_force=MOST))
    page.viewer.browsers |= {1: FakeBrowser(), 2: FakeBrowser()}
    yield page
    page.viewer.stop()


def moved(page):
    state = page.simulation.state()
    return float(np.linalg.norm(state.positions - state.rest, axis=1).max())


def turn_until(page, condition, what):
    return wait_until(condition, 20, what, page.turn)


def test_mouse_pulls_tissue_and_lets_go(page):
    viewer, browser = page.viewer, page.viewer.browsers[1]
    point(viewer, "start", (0.5, 0.5))
    assert viewer.holding
    point(viewer, "update", (0.6, 0.5))
    turn_until(page, lambda: moved(page) > 2e-3, "tissue to follow")
    turn_until(page, lambda: browser.splats and np.abs(browser.splats[-1][0] - browser.splats[0][0]).max() > 0.2, "splats to move, cm")
    assert viewer.tools["mouse"].force[0] > 0, "the mouse pulls the tissue to the right"
    places = itertools.cycle(np.linspace(0.5, 0.6, 50))

    def measured():
        point(viewer, "update", (next(places), 0.5))
        return viewer.latency > 0

    turn_until(page, measured, "a measured latency")
    assert np.unique(browser.colors[-1], axis=0).shape[0] > 5, "stress has colours"
    point(viewer, "end", (0.6, 0.5))
    assert not viewer.holding
    turn_until(page, lambda: not viewer.tools, "no tool any more")
    far = moved(page)
    turn_until(page, lambda: moved(page) < 0.5 * far, "tissue to come back")


def test_lifting_pulls_towards_the_user_with_no_more_than_the_largest_force(page):
    point(page.viewer, "start", (0.5, 0.5), lifts=True)
    point(page.viewer, "update", (0.5, 0.0), lifts=True)
    turn_until(page, lambda: page.viewer.tools and page.viewer.tools["mouse"].force[2] < -0.9 * MOST, "the largest force")
    forces = []

    def settled():
        forces.append(float(np.linalg.norm(page.viewer.tools["mouse"].force)))
        return len(forces) > 200 and np.abs(np.array(forces[-100:]) - MOST).max() < 0.1 * MOST

    turn_until(page, settled, "the largest force, held")


def test_tissue_is_held_by_one_user_at_a_time(page):
    point(page.viewer, "start", (0.5, 0.5))
    grasp = page.viewer._grasp
    point(page.viewer, "start", (0.4, 0.5), client=2)
    point(page.viewer, "update", (0.1, 0.5), client=2)
    point(page.viewer, "end", (0.1, 0.5), client=2)
    assert page.viewer._grasp is grasp and np.abs(grasp._target).max() < 1e-5
    page.viewer._leave(1)
    assert not page.viewer.holding, "who leaves lets go"


def test_mouse_beside_the_tissue_holds_nothing(page):
    page.viewer.point(Pointer(1, "start", (-0.3, 0.5), (-0.3, 0.5), False))
    assert not page.viewer.holding
    point(page.viewer, "update", (0.6, 0.5))
    point(page.viewer, "end", (0.6, 0.5))


def test_picked_point_lies_on_the_tissue(page):
    expected = 0.1 / (1 - 0.3 * (0.1 + 0.6 * -0.1))  # of the tilted plane, along the ray of the pixel
    picked = page.viewer.pick(page.viewer.browsers[1], 0.6, 0.375)
    np.testing.assert_allclose(picked, expected * np.array([0.1, -0.1, 1.0]), atol=1e-3)


def test_reset_brings_tissue_back_and_lets_go(page):
    point(page.viewer, "start", (0.5, 0.5))
    point(page.viewer, "update", (0.6, 0.5))
    turn_until(page, lambda: moved(page) > 2e-3, "tissue to follow")
    page.viewer.post(page.viewer._reset)
    page.turn()
    assert moved(page) == 0 and not page.viewer.holding
    np.testing.assert_allclose(page.viewer.splats()[0], 100 * page._model.means.numpy(), atol=1e-4)


def test_time_stands_still_while_paused_and_goes_step_by_step(page):
    page.viewer._actions.pause(True)
    before = page.simulation.time
    for _ in range(20):
        page.turn()
    assert page.simulation.time == before
    page.step()
    assert page.simulation.time == pytest.approx(before + page.simulation.step_duration)
    page.pause(False)
    turn_until(page, lambda: page.simulation.time > before + 0.1, "time to go on")


def test_slider_changes_the_material_under_the_hand_when_it_stands_still(page):
    slider = next(slider for slider in SLIDERS if slider.parameter == "young_modulus")
    point(page.viewer, "start", (0.5, 0.5))
    point(page.viewer, "update", (0.52, 0.5))
    turn_until(page, lambda: moved(page) > 5e-4, "tissue to follow")
    for value in (20.0, 25.0, 30.0):
        page.viewer._slide(slider, value)
        page.turn()
        assert page.simulation.config.young_modulus == SOFT.young_modulus, "not at each move of the slider"
    turn_until(page, lambda: page.simulation.config.young_modulus == 30e3, "the new stiffness")
    assert page.viewer.holding and moved(page) > 5e-4
    page.viewer._slide(next(slider for slider in SLIDERS if slider.parameter == "thickness"), 30)
    turn_until(page, lambda: page.simulation.config.thickness == pytest.approx(0.03), "the new thickness")
    assert page.simulation.config.young_modulus == 30e3 and not page.viewer.holding and moved(page) == 0
    assert page.viewer.browsers[1].models == 0, "the model is the same, so that views stay as they are"


def test_sliders_show_the_parameters_within_their_ends(page):
    page.viewer.show_parameters({"young_modulus": 5e6, "damping": 20.0})
    assert page.viewer._sliders["young_modulus"].value == 100 and page.viewer._sliders["damping"].value == 20
    assert set(PARAMETERS) <= set(vars(SOFT))


def test_tools_of_others_are_shown_and_vanish(page):
    page.viewer.show_tools({"PSM2": Tool(np.array([0, 0, 0.1]), np.array([0, 0, -2.0]))}, 0.0)
    page.viewer._draw_tools()
    np.testing.assert_allclose(page.viewer._arrows.points, [[[0, 0, 10], [0, 0, 8]]], atol=1e-5)
    assert page.viewer._labels["PSM2"].text == "2.0 N"
    page.viewer.show_tools({}, 0.0)
    page.viewer._draw_tools()
    assert not page.viewer._arrows.visible and not page.viewer._tips.visible and not page.viewer._labels


def test_endoscope_picture_is_centred_at_its_optical_axis():
    K = np.array([[100.0, 0, 30], [0, 100.0, 20], [0, 0, 1]])
    image = np.zeros((40, 80, 3), np.uint8)
    image[18:22, 28:32] = 255  # around the principal point
    for aspect in (0.5, 1.0, 3.0):
        padded = _padded(image, Camera(K, 80, 40), aspect)
        bright = np.argwhere(padded[..., 0] > 127).mean(0) + 0.5
        np.testing.assert_allclose(bright, np.array(padded.shape[:2]) / 2, atol=0.6)
        assert padded.shape[1] / padded.shape[0] == pytest.approx(aspect, rel=0.02)


def test_pictures_of_another_shape_fit_into_a_video_and_near_nodes_hide_far_ones():
    wide = _fitted(np.full((20, 40, 3), 200, np.uint8), 30, 60)
    assert wide.shape == (60, 30, 3)
    lit = np.argwhere(wide[..., 0] > 0)
    np.testing.assert_array_equal([lit.min(0), lit.max(0)], [[22, 0], [36, 29]])
    camera = Camera(np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]]), 80, 60)
    points = np.array([[0, 0, 0.1], [0.003, 0, 0.2], [0.02, 0, 0.1], [0, 0, -0.1], [9, 0, 0.1]])
    colors = np.uint8([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255, 255, 255]])
    image = draw_points(np.zeros((60, 80, 3), np.uint8), camera, points, colors, 0.008)
    assert image[30, 40].tolist() == [255, 0, 0] and image[30, 60].tolist() == [0, 0, 255], "near ones hide far ones"
    assert 40 < (image[..., 0] > 127).sum() < 80  # a disc of 8 pixels


def test_missing_viser_is_one_sentence_that_says_how_to_install_it(monkeypatch):
    from endo_sim_ros.viewer.viewer import _serve

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ConfigError, match=r"pip install 'endo_sim_ros\[viewer\]'"):
        _serve(ViewerConfig())


# ------------------------------------------------------------------------------------------------------- the node


@pytest.fixture(scope="module")
def ros():
    arguments = ["--ros-args", "-p", f"viewer_node:port:={PORT}", "-p", "viewer_node:rate:=30.0", "-p", f"viewer_node:max_force:={MOST}"]
    for name, value in {"node_count": 300, "substeps": 40, "force_radius": 0.02, "device": "cpu"}.items():
        arguments += ["-p", f"physics_node:{name}:={value}"]
    rclpy.init(args=arguments)
    yield
    rclpy.try_shutdown()


@pytest.fixture
def bench(ros):
    pytest.importorskip("viser")
    bench = Bench()
    bench.hear(messages.CONTROL_NODES)
    yield bench
    bench.close()


@pytest.fixture
def graph(bench):
    """Physics, the page and somebody who looks at it."""
    from endo_sim_ros.nodes.viewer_node import ViewerNode

    bench.physics = bench.add(PhysicsNode)
    send_model(bench, sheet(tilt=0.3))
    bench.page = bench.add(ViewerNode)
    bench.viewer = bench.page.viewer
    bench.viewer.browsers[1] = FakeBrowser()
    bench.until(lambda: bench.viewer.state is not None and bench.viewer.tools is not None, "the state of the tissue")
    hand = bench.page._pose_pub, bench.page._jaw_pub
    bench.until(lambda: all(publisher.get_subscription_count() for publisher in hand), "physics to be found")
    bench.spin(0.5)  # each side finds the other in its own time
    return bench


def distance(bench):
    state = messages.decode_control_nodes(bench.heard["control_nodes"][-1])
    return float(np.linalg.norm(state.positions - state.rest, axis=1).max())


def pull(bench):
    point(bench.viewer, "start", (0.5, 0.5))
    assert bench.viewer.holding
    point(bench.viewer, "update", (0.6, 0.5))
    bench.until(lambda: distance(bench) > 2e-3, "tissue to follow")


def test_mouse_is_a_tool_of_the_graph(graph):
    pull(graph)
    graph.until(lambda: "PSM1" in graph.viewer.tools and graph.viewer.tools["PSM1"].force[0] > 0.1, "the force of the pull")
    places = itertools.cycle(np.linspace(0.5, 0.6, 50))
    graph.until(lambda: point(graph.viewer, "update", (next(places), 0.5)) or graph.viewer.latency > 0, "a measured latency")
    graph.viewer.post(graph.viewer._reset)
    graph.until(lambda: distance(graph) == 0 and not graph.viewer.holding, "tissue at rest")
    assert graph.status("viewer_node", "showing the tissue at http://127.0.0.1")[2]["browsers"] == "1"


def test_page_sets_and_follows_the_parameters_of_physics(graph):
    graph.until(lambda: graph.viewer._sliders["young_modulus"].value == 10, "the slider to know")
    slider = next(slider for slider in SLIDERS if slider.parameter == "young_modulus")
    graph.viewer._slide(slider, 20.0)
    graph.until(lambda: graph.physics.get_parameter("young_modulus").value == 20e3, "the parameter")
    assert graph.set("physics_node", damping=100.0)[0]
    graph.until(lambda: graph.viewer._sliders["damping"].value == 100, "what somebody else has set")
    assert graph.viewer._sliders["young_modulus"].value == 20


def test_page_stops_time_and_steps(graph):
    graph.viewer.post(lambda: graph.viewer._actions.pause(True))
    graph.until(lambda: graph.viewer.paused, "a pause")
    graph.status("physics_node", "paused")
    before = graph.physics._simulation.time
    graph.viewer.post(graph.viewer._actions.step)
    graph.until(lambda: graph.physics._simulation.time == pytest.approx(before + 0.02), "one step")
    graph.viewer.post(lambda: graph.viewer._actions.pause(False))
    graph.until(lambda: not graph.viewer.paused and graph.physics._simulation.time > before + 0.1, "time to go on")


def test_in_lockstep_the_mouse_moves_no_arm(graph):
    poses, jaws = graph.hear(messages.tool_pose("PSM1")), graph.hear(messages.tool_jaw("PSM1"))
    graph.page._lockstep, graph.page._paused_until = True, np.inf  # as physics says on /diagnostics
    point(graph.viewer, "start", (0.5, 0.5))
    graph.until(lambda: not graph.viewer.holding and "lockstep" in graph.viewer._notice, "a refusal")
    graph.spin(0.3)
    assert not poses and not jaws


def test_page_survives_physics_and_new_models(graph):
    pull(graph)
    graph.nodes.remove(graph.physics)
    graph.executor.remove_node(graph.physics)
    graph.physics.destroy_node()
    point(graph.viewer, "end", (0.6, 0.5))
    graph.viewer.post(graph.viewer._reset)
    graph.until(lambda: not graph.viewer.tools and "not there" in graph.viewer._notice, "the page to notice")
    graph.heard["control_nodes"].clear()
    graph.physics = graph.add(PhysicsNode)
    graph.until(lambda: graph.heard["control_nodes"], "the new physics")
    pull(graph)
    models = graph.viewer.browsers[1].models
    send_model(graph, sheet(20, tilt=0.3), 9 * S)
    graph.until(lambda: graph.viewer.browsers[1].models > models and len(graph.viewer.renderer.model) == 400, "the new model")
    graph.until(lambda: graph.viewer.browsers[1].splats[-1][0].shape == (400, 3), "its splats")
    assert not graph.viewer.holding


def test_bad_input_is_one_sentence_and_the_page_goes_on(graph):
    message = messages.encode_gaussians(sheet(), 6 * S, "world")
    message.width += 1000
    graph.publish(messages.GAUSSIANS, message)
    graph.refused("viewer_node", "truncated", "gaussians")
    message = messages.encode_wrench(np.array([np.nan, 0, 0]), np.zeros(3), S, "PSM1")
    graph.publish(messages.tool_reaction("PSM1"), message)
    graph.refused("viewer_node", "not finite")
    pull(graph)


def test_endoscope_view_shows_what_rendering_published(graph):
    graph.add(RenderingNode)
    send_camera(graph)
    graph.viewer.browsers[1].view = VIEWS[-1]
    graph.until(lambda: graph.viewer.endoscope is not None, "a picture")
    image, camera = graph.viewer.endoscope
    assert image.shape == (80, 96, 3) and image.std() > 10 and camera.width == 96
    np.testing.assert_allclose(camera.pose, np.eye(4), atol=1e-6)


# ---------------------------------------------------------------------------------------------------- a real browser


def seen(tab):
    """Pixels of the tissue, beside panel and notifications; coarse, as the page draws fewer pixels on slow machines."""
    picture = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)[200:380, 150:320]
    return cv2.resize(picture, (17, 18), interpolation=cv2.INTER_AREA).astype(float)


def difference(a, b):
    return float(np.abs(a - b).mean())


def rows(tab):
    """Mean brightness [400] of the rows of the picture."""
    return cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)[:, :300].mean(1)


def frames_of(video):
    """Pictures of a video, in floating point."""
    capture, frames = cv2.VideoCapture(str(video)), []
    while (read := capture.read())[0]:
        frames.append(read[1].astype(float))
    return frames


def test_in_a_browser_tissue_is_seen_dragged_and_reset(chromium, tmp_path):
    pytest.importorskip("viser")
    from endo_sim_ros.viewer.standalone import Standalone

    camera = Camera(np.array([[330.0, 0, 330], [0, 330, 200], [0, 0, 1]]), 660, 400)
    config = ViewerConfig(port=PORT, max_force=20.0, videos=str(tmp_path))
    page = Standalone(sheet(tilt=0.3), [camera], SOFT, config)
    going = threading.Event()
    going.set()

    def drive():
        while going.is_set():
            page.turn()

    thread = threading.Thread(target=drive)
    thread.start()
    try:
        first, second = (chromium.new_page(viewport={"width": 934, "height": 400}) for _ in range(2))
        first.goto(page.viewer.url)
        second.goto(page.viewer.url)
        wait_until(lambda: seen(first).std() > 10, 30, "tissue on the page")
        first.wait_for_timeout(1000)  # the splats fade in
        rest = seen(first)
        wait_until(lambda: difference(seen(second), rest) < 2, 30, "the second browser to show the same")

        recorded = lambda: next((b._recording._count for b in page.viewer.browsers.values() if b._recording is not None), 0)
        first.get_by_role("button", name="record").click()
        wait_until(recorded, 20, "a recording")
        first.keyboard.down("Shift")
        first.mouse.move(200, 250)
        first.mouse.down()
        first.mouse.move(215, 250, steps=2)
        first.mouse.move(270, 220, steps=2)
        wait_until(lambda: moved(page) > 0.008, 20, "tissue to follow the mouse", lambda: first.wait_for_timeout(50))
        wait_until(lambda: difference(seen(first), rest) > 5, 20, "the picture to change")
        assert page.viewer.tools["mouse"].force[0] > 0
        first.mouse.up()
        first.keyboard.up("Shift")
        first.get_by_role("button", name="stop recording").click()
        with first.expect_download() as download:
            first.get_by_role("link", name=".mp4").click()
        first.get_by_role("alert").filter(has_text=".mp4").get_by_role("button").last.click()  # it covers tissue
        (video,) = tmp_path.glob("*.mp4")
        assert Path(download.value.path()).read_bytes() == video.read_bytes()
        frames = frames_of(video)
        assert frames[0].std() > 5 and max(difference(frames[0], frame) for frame in frames) > 2, "tissue moves in the video"

        first.get_by_role("button", name="reset").click()
        wait_until(lambda: moved(page) == 0, 20, "tissue at rest", lambda: first.wait_for_timeout(50))
        wait_until(lambda: difference(seen(first), rest) < 1.5, 20, "the picture from before")

        first.mouse.move(200, 300)
        first.mouse.down()
        first.mouse.move(250, 300, steps=2)  # without Shift it turns the view of this browser only
        first.mouse.up()
        wait_until(lambda: difference(seen(first), rest) > 3, 20, "the view to turn")
        assert moved(page) == 0 and difference(seen(second), rest) < 2

        first.get_by_role("combobox", name="view").click()
        first.get_by_role("option", name="endoscope").click()
        wait_until(lambda: difference(seen(first), rest) < 10 and seen(first).std() > 10, 20, "the endoscope's picture")
        first.set_viewport_size({"width": 604, "height": 400})  # half the room beside the panel: the picture fits its width
        wait_until(lambda: rows(first)[310:].max() < 5 < rows(first)[150:250].min(), 20, "the endoscope's whole picture, smaller")
    finally:
        going.clear()
        thread.join()
        page.viewer.stop()


def test_view_command_serves_a_model(tmp_path):
    pytest.importorskip("viser")
    import subprocess
    import urllib.request

    save_ply(sheet(), tmp_path / "model.ply")
    save_cameras([CAMERA], tmp_path / "cameras.json")
    command = [sys.executable, "-u", "-m", "endo_sim_ros.cli", "view", tmp_path / "model.ply", "--node-count", 300, "--port", PORT + 7]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1])
    try:
        line = next(line for line in process.stdout if line.startswith("open http"))
        with urllib.request.urlopen(line.split()[1], timeout=20) as answer:
            assert answer.status == 200 and b"<html" in answer.read().lower()
    finally:
        process.terminate()
        process.wait(20)
