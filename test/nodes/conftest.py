"""Fixtures of the tests of nodes."""

import pytest
import rclpy
from ros_bench import SMALL, Bench

from endo_sim_ros import messages
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.rendering_node import RenderingNode


@pytest.fixture(scope="module")
def ros(tmp_path_factory):
    """ROS with small parameters for the nodes that are made in this process."""
    outputs = {"reconstruction_node": {"output_dir": tmp_path_factory.mktemp("models")}}
    recording = tmp_path_factory.mktemp("recordings") / "bag"
    outputs |= {"recorder": {"bag": recording}}
    arguments = ["--ros-args"]
    for node, values in [*SMALL.items(), *outputs.items()]:
        for name, value in values.items():
            arguments += ["-p", f"{node}:{name}:={value}"]
    rclpy.init(args=arguments)
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
