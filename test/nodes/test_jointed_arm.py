"""Arms with joints, through their topics: what they publish, where they get to, and what they refuse."""

import numpy as np
import pytest
import rclpy
from ros_bench import SMALL, Bench, S, await_nodes, moved, send_model

from endo_sim_ros import messages
from endo_sim_ros.instruments import link_poses, load_arm, solve_inverse
from endo_sim_ros.nodes.physics_node import PhysicsNode

pytestmark = pytest.mark.dds

LINKS = ("roll", "wrist_pitch", "wrist_yaw", "jaw_left", "jaw_right")


def start(**parameters):
    values = {**SMALL["physics_node"], "arm_source": "commanded", **parameters}
    rclpy.init(args=["--ros-args", *(word for name, value in values.items() for word in ("-p", f"physics_node:{name}:={value}"))])
    bench = Bench()
    for topic in (messages.CONTROL_NODES, messages.CAMERA_POSE):
        bench.hear(topic)
    for arm in ("PSM1", "PSM2"):
        for topic in (messages.tool_pose(arm), messages.tool_links(arm), messages.tool_type(arm), messages.tool_jaw_state(arm)):
            bench.hear(topic)
    bench.add(PhysicsNode)
    return bench


@pytest.fixture(scope="module")
def graph():
    """Two commanded arms beside a piece of tissue."""
    bench = start(instruments="[LARGE_NEEDLE_DRIVER, PROGRASP_FORCEPS]")
    send_model(bench)
    await_nodes(bench, 5 * S)
    yield bench
    bench.close()
    rclpy.try_shutdown()


def newest(bench, topic):
    bench.until(lambda: bench.heard[topic.name], f"a message on {topic.name}")
    return bench.heard[topic.name][-1]


def pose_of(bench, topic):
    return messages.decode_pose(newest(bench, topic), "world", topic.name)


def tip_at(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def servo(bench, pose, arm="PSM1"):
    bench.publish(messages.tool_pose_command(arm), messages.encode_pose(pose, S, "world"))


def test_arms_stand_beside_each_other_with_their_instruments_and_touch_nothing(graph):
    names = [newest(graph, messages.tool_type(arm)).data for arm in ("PSM1", "PSM2")]
    assert names == ["LARGE_NEEDLE_DRIVER:400006", "PROGRASP_FORCEPS:400093"]
    graph.until(lambda: len(graph.heard["PSM2/link_poses"]) > 2, "poses of links")
    tips = [pose_of(graph, messages.tool_pose(arm)) for arm in ("PSM1", "PSM2")]
    assert tips[0][0, 3] > 0.005 > -0.005 > tips[1][0, 3], "PSM1 on the right of the picture, PSM2 on the left"
    assert all(0.08 < tip[2, 3] < 0.095 for tip in tips) and moved(graph) == 0
    for arm, tip in zip(("PSM1", "PSM2"), tips):
        message = newest(graph, messages.tool_links(arm))
        links = dict(zip(LINKS, messages.decode_poses(message, "")))
        assert message.header.frame_id == "world" and len(message.poses) == len(LINKS)
        np.testing.assert_allclose(links["wrist_yaw"][:3, 3], tip[:3, 3], atol=1e-6)  # the tip is the hinge of the jaws
        left, right = links["jaw_left"][:3, 1], links["jaw_right"][:3, 1]  # distal is y
        np.testing.assert_allclose(np.arccos(left @ right), 1.0, atol=1e-6)  # the angle of a jaw at the start


def test_links_follow_a_servoed_tip_with_its_stamp(graph):
    pose = tip_at(0.01, -0.01, 0.08)
    servo(graph, pose)
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1")), pose, atol=1e-12), "the pose exactly")
    stamp = graph.heard["PSM1/measured_cp"][-1].header.stamp
    (links,) = graph.until(lambda: [m for m in graph.heard["PSM1/link_poses"] if m.header.stamp == stamp], "links with its stamp")
    base = graph.nodes[1].arms["PSM1"].base
    psm = load_arm("PSM", "LARGE_NEEDLE_DRIVER")
    reach = solve_inverse(psm, np.linalg.inv(base) @ pose, graph.nodes[1].arms["PSM1"].joints)
    expected = np.stack(list(link_poses(psm, reach.joints, 1.0).values()))
    np.testing.assert_allclose(messages.decode_poses(links, ""), base @ expected, atol=1e-6)
