"""viewer_node: what the page asks of the graph."""

import itertools

import numpy as np
import pytest
import rclpy
from fake_browser import MOST, PORT, FakeBrowser, point
from ros_bench import HEIGHT, WIDTH, Bench, K, S, send_camera, send_model, send_tip, sheet, start_ros

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.viewer.browser import VIEWS
from endo_sim_ros.viewer.sliders import SLIDERS

pytestmark = pytest.mark.dds


@pytest.fixture(scope="module")
def ros():
    viewer = {"port": PORT, "rate": 30.0, "max_force": MOST}
    start_ros(viewer_node=viewer, physics_node={"node_count": 300, "step_duration": 0.02, "force_radius": 0.02, "device": "cpu"})
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
    hand = bench.page.pose_publisher, bench.page.jaw_publisher
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
    graph.viewer.post(graph.viewer.reset)
    graph.until(lambda: distance(graph) == 0 and not graph.viewer.holding, "tissue at rest")
    assert graph.status("viewer_node", "showing the tissue at http://127.0.0.1")[2]["browsers"] == "1"


def test_page_sets_and_follows_the_parameters_of_physics(graph):
    graph.until(lambda: graph.viewer.sliders.handles["young_modulus"].value == 10, "the slider to know")
    slider = next(slider for slider in SLIDERS if slider.parameter == "young_modulus")
    graph.viewer.sliders.slide(slider, 20.0)
    graph.until(lambda: graph.physics.get_parameter("young_modulus").value == 20e3, "the parameter")
    assert graph.set("physics_node", damping=100.0)[0]
    graph.until(lambda: graph.viewer.sliders.handles["damping"].value == 100, "what somebody else has set")
    assert graph.viewer.sliders.handles["young_modulus"].value == 20


def test_page_stops_time_and_steps(graph):
    graph.viewer.post(lambda: graph.viewer.actions.pause(True))
    graph.until(lambda: graph.viewer.paused, "a pause")
    graph.status("physics_node", "paused")
    before = graph.physics.simulation.time
    graph.viewer.post(graph.viewer.actions.step)
    graph.until(lambda: graph.physics.simulation.time == pytest.approx(before + 0.02), "one step")
    graph.viewer.post(lambda: graph.viewer.actions.pause(False))
    graph.until(lambda: not graph.viewer.paused and graph.physics.simulation.time > before + 0.1, "time to go on")


def test_in_lockstep_the_mouse_moves_no_arm(graph):
    poses, jaws = graph.hear(messages.tool_pose("PSM1")), graph.hear(messages.tool_jaw("PSM1"))
    graph.page.lockstep, graph.page.paused_until = True, np.inf  # as physics says on /diagnostics
    point(graph.viewer, "start", (0.5, 0.5))
    graph.until(lambda: not graph.viewer.holding and "lockstep" in graph.viewer.notice, "a refusal")
    graph.spin(0.3)
    assert not poses and not jaws


def test_page_survives_physics_and_new_models(graph):
    pull(graph)
    graph.nodes.remove(graph.physics)
    graph.executor.remove_node(graph.physics)
    graph.physics.destroy_node()
    point(graph.viewer, "end", (0.6, 0.5))
    graph.viewer.post(graph.viewer.reset)
    graph.until(lambda: not graph.viewer.tools and "not there" in graph.viewer.notice, "the page to notice")
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


def test_pictures_that_are_rendered_here_show_the_instruments(graph):
    """physics_node knows where the links are as soon as it knows where the tip is."""
    look = lambda: graph.viewer._render(Camera(K, WIDTH, HEIGHT)).astype(int)
    alone = look()

    def shown():
        send_tip(graph, (0.0, 0.0, 0.07))
        return graph.viewer.instruments is not None and np.abs(look() - alone).max() > 60

    graph.until(shown, "the instrument", 60)
    assert not graph.page.logged
