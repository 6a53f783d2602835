"""The page without a browser: what the mouse does to tissue, sliders, tools of others."""

import itertools
import sys

import numpy as np
import pytest
from fake_browser import CAMERA, MOST, PORT, SOFT, FakeBrowser, moved, point
from ros_bench import sheet
from waiting import wait_until

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.drawing import draw_points
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion
from endo_sim_ros.physics import MotionConfig
from endo_sim_ros.viewer.browser import Pointer, fitted, padded
from endo_sim_ros.viewer.config import ViewerConfig
from endo_sim_ros.viewer.sliders import SLIDERS
from endo_sim_ros.viewer.tool_marks import Tool
from endo_sim_ros.viewer.viewer import PARAMETERS


@pytest.fixture
def page():
    pytest.importorskip("viser")
    from endo_sim_ros.viewer.standalone import Standalone

    page = Standalone(sheet(tilt=0.3), [CAMERA], SOFT, ViewerConfig(port=PORT, rate=60.0, max_force=MOST))
    page.viewer.browsers |= {1: FakeBrowser(), 2: FakeBrowser()}
    yield page
    page.viewer.stop()


def turn_until(page, condition, what):
    return wait_until(condition, 20, what, page.turn)


@pytest.mark.slow
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


def test_stress_is_coloured_by_the_stiffness_of_each_node(page):
    viewer, rest = page.viewer, page.simulation.nodes.rest
    strained = np.tile(np.diag([1.05, 1, 1]).astype(np.float32), (len(rest), 1, 1))
    assert len(np.unique(viewer.stress_colors(strained), axis=0)) == 1, "the same strain in the same tissue"
    viewer.show_parameters({"regions": ["box 0 -1 -1 1 1 1 young_modulus=80000"]})
    colors, stiff = viewer.stress_colors(strained), rest[:, 0] >= 0
    assert 0 < stiff.sum() < len(rest)
    assert (colors[stiff] == colors[stiff][0]).all() and (colors[~stiff] == colors[~stiff][0]).all()
    assert colors[stiff][0, 0] > 100 > colors[~stiff][0, 0], "red where it is stiff, blue elsewhere"
    viewer.show_parameters({"regions": ["mask /missing.png /missing.json 0 young_modulus=80000"]})
    assert len(np.unique(viewer.stress_colors(strained), axis=0)) == 1
    assert "without regions" in viewer.notice and "/missing" in viewer.notice


def test_stiffness_is_that_of_the_options_until_it_is_identified(page):
    viewer, rest = page.viewer, page.simulation.nodes.rest
    count, stiff = len(rest), rest[:, 0] >= 0
    assert len(np.unique(viewer.stiffness_colors(count), axis=0)) == 1
    viewer.show_parameters({"regions": ["box 0 -1 -1 1 1 1 young_modulus=80000"]})
    colors = viewer.stiffness_colors(count)
    assert (colors[stiff] == colors[stiff][0]).all() and colors[stiff][0, 0] > 100 > colors[~stiff][0, 0]
    assert "red: 80 kPa, as the physics has it" in viewer.stiffness_colors.legend
    known, order = rest[:, 1] >= 0, np.random.default_rng(0).permutation(count)  # whatever the order of the points
    moduli = np.where(rest[:, 1] >= 0.02, 40e3, 2e3)
    viewer.show_stiffness(rest[order], moduli[order], known[order])
    colors = viewer.stiffness_colors(count)
    assert "red: 40 kPa, as identified" in viewer.stiffness_colors.legend
    assert (np.ptp(colors[~known], axis=1) == 0).all() and (np.ptp(colors[known], axis=1) > 20).all()
    assert len(np.unique(colors[known], axis=0)) == 2
    for browser in viewer.browsers.values():
        browser.wants_stress, browser.wants_stiffness = False, True
    turn_until(page, lambda: viewer.browsers[1].colors, "a picture")
    viewer.browsers[1].colors.clear()
    viewer.show_stiffness(rest, moduli, ~known)
    turn_until(page, lambda: viewer.browsers[1].colors, "a picture of the new map")
    assert (np.ptp(viewer.browsers[1].colors[-1][known], axis=1) == 0).all()


@pytest.mark.slow
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
    grasp = page.viewer.grasp
    point(page.viewer, "start", (0.4, 0.5), client=2)
    point(page.viewer, "update", (0.1, 0.5), client=2)
    point(page.viewer, "end", (0.1, 0.5), client=2)
    assert page.viewer.grasp is grasp and np.abs(grasp.target).max() < 1e-5
    page.viewer.leave(1)
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


@pytest.mark.slow
def test_reset_brings_tissue_back_and_lets_go(page):
    point(page.viewer, "start", (0.5, 0.5))
    point(page.viewer, "update", (0.6, 0.5))
    turn_until(page, lambda: moved(page) > 2e-3, "tissue to follow")
    page.viewer.post(page.viewer.reset)
    page.turn()
    assert moved(page) == 0 and not page.viewer.holding
    np.testing.assert_allclose(page.viewer.splats()[0], 100 * page.model.means.numpy(), atol=1e-4)


def test_time_stands_still_while_paused_and_goes_step_by_step(page):
    page.viewer.actions.pause(True)
    before = page.simulation.time
    for _ in range(20):
        page.turn()
    assert page.simulation.time == before
    page.step()
    assert page.simulation.time == pytest.approx(before + page.simulation.step_duration)
    page.pause(False)
    turn_until(page, lambda: page.simulation.time > before + 0.1, "time to go on")


@pytest.mark.slow
def test_slider_changes_the_material_under_the_hand_when_it_stands_still(page):
    slider = next(slider for slider in SLIDERS if slider.parameter == "young_modulus")
    point(page.viewer, "start", (0.5, 0.5))
    point(page.viewer, "update", (0.52, 0.5))
    turn_until(page, lambda: moved(page) > 5e-4, "tissue to follow")
    for value in (20.0, 25.0, 30.0):
        page.viewer.sliders.slide(slider, value)
        page.turn()
        assert page.simulation.config.young_modulus == SOFT.young_modulus, "not at each move of the slider"
    turn_until(page, lambda: page.simulation.config.young_modulus == 30e3, "the new stiffness")
    assert page.viewer.holding and moved(page) > 5e-4
    page.viewer.sliders.slide(next(slider for slider in SLIDERS if slider.parameter == "thickness"), 30)
    turn_until(page, lambda: page.simulation.config.thickness == pytest.approx(0.03), "the new thickness")
    assert page.simulation.config.young_modulus == 30e3 and not page.viewer.holding and moved(page) == 0
    assert page.viewer.browsers[1].models == 0, "the model is the same, so that views stay as they are"


def test_sliders_show_the_parameters_within_their_ends(page):
    page.viewer.show_parameters({"young_modulus": 5e6, "damping": 20.0})
    assert page.viewer.sliders.handles["young_modulus"].value == 100 and page.viewer.sliders.handles["damping"].value == 20
    assert set(PARAMETERS) <= set(vars(SOFT))


def test_tools_of_others_are_shown_and_vanish(page):
    page.viewer.show_tools({"PSM2": Tool(np.array([0, 0, 0.1]), np.array([0, 0, -2.0]))}, "mouse")
    page.viewer.marks.draw(page.viewer.tools)
    np.testing.assert_allclose(page.viewer.marks.arrows.points, [[[0, 0, 10], [0, 0, 8]]], atol=1e-5)
    assert page.viewer.marks.labels["PSM2"].text == "2.0 N"
    page.viewer.show_tools({}, "mouse")
    page.viewer.marks.draw(page.viewer.tools)
    assert not page.viewer.marks.arrows.visible and not page.viewer.marks.tips.visible and not page.viewer.marks.labels


def test_endoscope_picture_is_centred_at_its_optical_axis():
    K = np.array([[100.0, 0, 30], [0, 100.0, 20], [0, 0, 1]])
    image = np.zeros((40, 80, 3), np.uint8)
    image[18:22, 28:32] = 255  # around the principal point
    for aspect in (0.5, 1.0, 3.0):
        centred = padded(image, Camera(K, 80, 40), aspect)
        bright = np.argwhere(centred[..., 0] > 127).mean(0) + 0.5
        np.testing.assert_allclose(bright, np.array(centred.shape[:2]) / 2, atol=0.6)
        assert centred.shape[1] / centred.shape[0] == pytest.approx(aspect, rel=0.02)


def test_pictures_of_another_shape_fit_into_a_video_and_near_nodes_hide_far_ones():
    wide = fitted(np.full((20, 40, 3), 200, np.uint8), 30, 60)
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
    from endo_sim_ros.viewer.viewer import serve

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ConfigError, match=r"pip install 'endo_sim_ros\[viewer\]'"):
        serve(ViewerConfig())


def test_tissue_moves_as_the_file_beside_its_model_has_it(tmp_path, caplog):
    pytest.importorskip("viser")
    from endo_sim_ros.viewer.standalone import moving_as_found

    model = sheet()
    assert moving_as_found(tmp_path / "model.ply", model, SOFT) is SOFT
    points, way = model.means[::3].double().numpy(), np.array([[0.002, 0.0, 0.0], [0.0, 0.0, 0.0]])
    part = PeriodicMotion("breathing", 3.0, 1.0, 5.0, way, np.ones(len(points)))
    TissueMotion(3.0, points, (part,)).save(tmp_path, model)
    physics = moving_as_found(tmp_path / "model.ply", model, SOFT)
    assert physics.motion == MotionConfig(file=str(tmp_path / "motion.npz"), breathing=0.004, breathing_period=3.0)
    assert moving_as_found(tmp_path / "other.ply", sheet(20), SOFT) is SOFT
    assert "the tissue does not move by itself: " in caplog.text and "another model" in caplog.text
