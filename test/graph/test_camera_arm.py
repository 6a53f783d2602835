"""Lockstep with an arm of the camera: each picture is seen from where that was in its step."""

import numpy as np
import pytest
import rclpy
from ros_bench import HEIGHT, WIDTH, Bench, K, send_model, sheet, start_ros
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.rendering_node import RenderingNode

pytestmark = pytest.mark.dds

STEP = 20_000_000  # ns


@pytest.fixture
def graph():
    physics = {"node_count": 300, "step_duration": 0.02, "arm_source": "commanded", "arms": "[PSM1, ECM]", "lockstep_inputs": "[pose]"}
    both = {"mode": "lockstep", "device": "cpu"}
    start_ros(physics_node=physics | both, rendering_node=both | {"lockstep_camera": True})
    bench = Bench()
    for topic in (messages.RENDERED_POSE, messages.CAMERA_POSE, messages.tool_joints("PSM1"), messages.CONTROL_NODES):
        bench.hear(topic)
    bench.add(PhysicsNode)
    bench.add(RenderingNode)
    bench.publish(messages.LEFT_INFO, messages.encode_camera_info(K, WIDTH, HEIGHT, 1, "endoscope_left"))
    send_model(bench, sheet(tilt=0.3))
    bench.until(lambda: bench.heard["rendered/camera_pose"], "the first observation")
    yield bench
    bench.close()
    rclpy.try_shutdown()


def episode(bench):
    """Joint commands to both arms, one step each; the bytes of the states, and of the poses of pictures and camera by stamp."""
    assert bench.call(Trigger, "/physics_node/reset").success
    bench.spin(0.3)
    for heard in bench.heard.values():
        heard.clear()
    psm, ecm = (bench.nodes[1].arms[name].joints for name in ("PSM1", "ECM"))
    none = np.zeros(0)
    for k in range(1, 6):
        camera = messages.encode_joints([], ecm + [0.02 * k, 0, 0, 0], none, none, k * STEP)
        bench.publish(messages.tool_joint_command("ECM"), camera)
        arrived = lambda k=k: np.isclose(bench.nodes[1].arms["ECM"].joints[0], ecm[0] + 0.02 * k)  # noqa: E731
        bench.until(arrived, "the command of the camera, which acts at once")
        joints = messages.encode_joints([], psm + [0.01 * k, 0, 0.004 * k, 0, 0, 0], none, none, k * STEP)
        bench.publish(messages.tool_joint_command("PSM1"), joints)
        bench.until(lambda k=k: len(bench.heard["rendered/camera_pose"]) >= k, f"picture {k}")
    stamp = lambda message: messages.stamp_to_ns(message.header.stamp)  # noqa: E731
    poses = lambda topic: {stamp(m): messages.decode_pose(m, "world", "").tobytes() for m in bench.heard[topic]}  # noqa: E731
    joints = [tuple(m.position) for m in bench.heard["PSM1/measured_js"] if stamp(m) <= 5 * STEP]
    states = [bytes(m.data) for m in bench.heard["control_nodes"]][-5:]
    return poses("rendered/camera_pose"), poses("ECM/measured_cp"), joints, states


def test_pictures_are_seen_from_the_camera_of_their_step_and_episodes_repeat(graph):
    first, second = episode(graph), episode(graph)
    shown, told, joints, _ = first
    assert first == second
    steps = [k * STEP for k in range(1, 6)]
    for k in steps:
        np.testing.assert_allclose(np.frombuffer(shown[k]), np.frombuffer(told[k]), atol=1e-12)
    assert len({shown[k] for k in steps}) == 5
    assert len(joints) == 5


def test_a_change_of_joints_is_the_pose_of_a_command_and_hold_is_no_part_of_one(graph):
    assert graph.call(Trigger, "/physics_node/reset").success
    arm = graph.nodes[1].arms["PSM1"]
    start, none = arm.joints, np.zeros(0)
    graph.publish(messages.tool_hold("PSM1"), messages.ros_class(messages.tool_hold("PSM1").type)())
    for k in (1, 2):
        change = messages.encode_joints([], np.array([0.01, 0, 0.004, 0, 0, 0]), none, none, k * STEP)
        graph.publish(messages.tool_joint_change("PSM1"), change)
        expected = start + k * np.array([0.01, 0, 0.004, 0, 0, 0])
        graph.until(lambda expected=expected: np.allclose(arm.joints, expected, atol=1e-12), f"step {k}")
    assert graph.nodes[1].error_count == 0
