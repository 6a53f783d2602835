"""Fixtures of the tests of nodes."""

import pytest
import rclpy
from ros_bench import SMALL, Bench, start_ros

from endo_sim_ros import messages
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.rendering_node import RenderingNode


@pytest.fixture(scope="module")
def ros(tmp_path_factory):
    """ROS with small parameters for the nodes that are made in this process."""
    models, recording = tmp_path_factory.mktemp("models"), tmp_path_factory.mktemp("recordings") / "bag"
    reconstruction = SMALL["reconstruction_node"] | {"output_dir": models}
    start_ros(**SMALL | {"reconstruction_node": reconstruction, "recorder": {"bag": recording}})
    yield recording
    rclpy.try_shutdown()


@pytest.fixture
def bench(ros):
    bench = Bench()
    yield bench
    bench.close()


@pytest.fixture
def physics(bench):
    bench.hear(messages.CONTROL_NODES)
    return bench.add(PhysicsNode)


@pytest.fixture
def rendering(bench):
    bench.hear(messages.RENDERED_IMAGE)
    return bench.add(RenderingNode)
