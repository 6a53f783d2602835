"""scripted_tool_node: waits, pulls and lets go."""

import numpy as np
import pytest
import rclpy
from ros_bench import SMALL, S, await_nodes, moved, send_camera, send_model, start_ros

from endo_sim_ros.messages import OK, WARN
from endo_sim_ros.nodes.scripted_tool_node import ScriptedToolNode

pytestmark = pytest.mark.dds


@pytest.fixture(scope="module")
def ros():
    """An instrument whose links touch."""
    start_ros(**SMALL | {"physics_node": SMALL["physics_node"] | {"node_count": 2000, "link_contact": "true"}})
    yield
    rclpy.try_shutdown()


def test_scripted_tool_waits_then_pulls_and_lets_go(bench, physics, rendering):
    tool = bench.add(ScriptedToolNode)
    bench.status("scripted_tool", "waiting for the rendered depth", WARN)
    assert bench.set("scripted_tool", pull=0.5, swing=60.0, release=0.2, force=1.0)[0]
    assert not bench.set("scripted_tool", arm="PSM2")[0]
    send_model(bench)
    send_camera(bench)
    await_nodes(bench, 5 * S)
    bench.until(lambda: moved(bench) > 1e-3, "the tool to touch tissue")
    simulation, arm = physics.simulation, physics.arms["PSM1"]
    bench.until(lambda: tool.status()[2]["state"] == "swinging", "the tool to pull")
    hold = simulation.held("PSM1").mean(0)
    jaws = np.mean([pose[:3, 3] for link, pose in arm.links().items() if link.startswith("jaw")], 0)
    ahead = arm.pose[:3, 2]  # from the hinge to the points of the jaws
    assert 0.004 < (hold - jaws) @ ahead < 0.016  # what it holds lies between the jaws, not at their hinge
    # A loaded machine lags behind the tool, which pulls harder until it has caught up; so it may swing until then.
    bench.until(lambda: 0.3 < np.linalg.norm(simulation.reaction("PSM1")[0]) < 2.0, "a reaction about as large as the force")
    assert bench.set("scripted_tool", swing=0.5)[0]
    bench.status("scripted_tool", "finished", OK)
    assert np.linalg.norm(tool.grasped - [0, 0, 0.1]) < 0.01
    bench.until(lambda: moved(bench) < 1e-4, "the tissue to be released")
