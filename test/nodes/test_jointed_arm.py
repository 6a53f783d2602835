"""Arms with joints, through their topics: what they publish, where they get to, and what they refuse."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from rclpy.experimental.events_executor import EventsExecutor
from ros_bench import HEIGHT, WIDTH, K, S, await_nodes, moved, report, send_model, sheet, tissue_bench
from scipy.spatial.transform import Rotation
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger
from urdf_links import poses_of_links

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, make_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import arm_files, build_instrument, link_poses, load_arm, solve_inverse
from endo_sim_ros.instruments.overlap import overlap
from endo_sim_ros.nodes.arm_setup import make_arms, place_arms
from endo_sim_ros.nodes.configs import PhysicsNodeConfig
from endo_sim_ros.nodes.rendering_node import RenderingNode

pytestmark = pytest.mark.dds

LINKS = ("roll", "wrist_pitch", "wrist_yaw", "jaw_left", "jaw_right")
HEARD = (
    messages.tool_pose, messages.tool_links, messages.tool_type, messages.tool_joints, messages.tool_velocity, messages.tool_local_pose,
    messages.tool_state, messages.tool_warning, messages.tool_error, messages.tool_jaw_state, messages.tool_reaction, messages.tool_ratio,
    messages.tool_body_jacobian, messages.tool_spatial_jacobian, messages.tool_spatial_reaction,
)  # fmt: skip
ARMS = ("PSM1", "PSM2", "ECM")
PSM = load_arm("PSM", "LARGE_NEEDLE_DRIVER")


@pytest.fixture(scope="module")
def running():
    """Two commanded arms and that of the camera beside a piece of tissue."""
    heard = messages.JOINT_STATES, messages.ROBOT_DESCRIPTION, *(topic(arm) for arm in ARMS for topic in HEARD)
    # Each step of three arms is half a hundred messages, and a loaded machine keeps up with them, too.
    arms = {"step_duration": 0.05, "arms": f"[{', '.join(ARMS)}]", "arm_models": "[PSM, PSM, ECM]", "arm_source": "commanded"}
    instruments = "[LARGE_NEEDLE_DRIVER, PROGRASP_FORCEPS, ENDOSCOPE_STRAIGHT]"
    with tissue_bench(*heard, **arms, executor=EventsExecutor, instruments=instruments) as bench:
        yield bench


@pytest.fixture
def graph(running):
    """The same at its start."""
    assert running.call(Trigger, "/physics_node/reset").success
    kept = messages.tool_state, messages.tool_type, messages.tool_ratio
    latched = {messages.ROBOT_DESCRIPTION.name} | {topic(arm).name for arm in ARMS for topic in kept}
    arms = running.nodes[1].arms.items()
    told = lambda arm: running.heard[f"{arm}/measured_js"][-1:]  # noqa: E731
    running.until(
        lambda: all(told(name) and list(told(name)[0].position) == list(arm.start) for name, arm in arms), "the start of all arms"
    )
    running.statuses.clear()
    for name, heard in running.heard.items():
        if name not in latched:
            heard.clear()
    return running


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
    assert all(0.07 < tip[2, 3] < 0.095 for tip in tips) and moved(graph) == 0
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


def joints_of(bench, arm="PSM1"):
    return np.array(newest(bench, messages.tool_joints(arm)).position)


def send_joints(bench, topic, positions, arm="PSM1"):
    none = np.zeros(0)
    bench.publish(topic(arm), messages.encode_joints([], np.array(positions), none, none, S))


def texts(bench, topic, arm="PSM1"):
    """What came on a topic of the types of CRTK."""
    return [report(message) for message in bench.heard[topic(arm).name]]


def test_joints_move_together_within_their_speeds_and_their_poses_agree(graph):
    first = joints_of(graph)
    goal = first + [0.2, -0.1, 0.01, 0.3, 0.0, -0.2]
    send_joints(graph, messages.tool_joint_move, goal)
    graph.until(lambda: texts(graph, messages.tool_state)[-1] == "ENABLED BUSY", "a busy arm")
    graph.until(lambda: texts(graph, messages.tool_state)[-1] == "ENABLED", "the end of the move")
    graph.until(lambda: np.allclose(joints_of(graph), goal, atol=1e-12))
    way = np.array([m.position for m in graph.heard["PSM1/measured_js"]])
    speeds = np.abs([m.velocity for m in graph.heard["PSM1/measured_js"]]).max(0)
    assert (speeds <= np.array([2, 2, 0.2, 2, 2, 2]) * 1.001).all() and speeds[3] > 1.99
    part = (way - first)[:, 3] / 0.3
    np.testing.assert_allclose(way, first + part[:, None] * (goal - first), atol=1e-9)
    assert list(newest(graph, messages.tool_joints("PSM1")).name) == [joint.name for joint in PSM.joints]
    local = lambda: messages.decode_pose(newest(graph, messages.tool_local_pose("PSM1")), "PSM1_base", "")  # noqa: E731
    graph.until(lambda: np.allclose(local(), PSM.tip_pose(goal), atol=1e-9), "the pose in the base")
    world = graph.nodes[1].arms["PSM1"].base @ PSM.tip_pose(goal)
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1")), world, atol=1e-9), "the pose in the world")
    assert moved(graph) == 0


def test_changes_of_joints_add_up_and_may_not_lead_beyond_limits(graph):
    first = joints_of(graph)
    change = np.array([0.01, 0, 0.002, 0.1, 0, 0])
    for _ in range(3):
        send_joints(graph, messages.tool_joint_change, change)
    graph.until(lambda: np.allclose(joints_of(graph), first + 3 * change, atol=1e-12), "three changes at once")
    for _ in range(2):
        send_joints(graph, messages.tool_joint_move_change, 10 * change)
    graph.until(lambda: np.allclose(joints_of(graph), first + 23 * change, atol=1e-12), "a goal that moved on")
    there = joints_of(graph)
    for topic in (messages.tool_joint_change, messages.tool_joint_move_change):
        lengths = [([0.0] * length, f"PSM1: {length} numbers, not 6; the joints are yaw, pitch,") for length in (0, 5)]
        no_number = [float("nan")] * 6, "expected finite changes of joint positions, rad and m, got [nan,"
        for positions, sentence in (*lengths, no_number, ([0, 0, 0.3, 0, 0, 0], "insertion cannot be at")):
            graph.heard["PSM1/error"].clear()
            send_joints(graph, topic, positions)
            (said,) = graph.until(lambda: texts(graph, messages.tool_error), "an error of the arm")
            assert said.startswith(topic("PSM1").name) and sentence in said
    graph.spin(0.1)
    np.testing.assert_array_equal(joints_of(graph), there)


def test_each_of_many_changes_at_once_counts(graph):
    first = joints_of(graph)
    for _ in range(150):
        send_joints(graph, messages.tool_joint_change, [0.0005, 0, 0, 0, 0, 0])
    graph.until(lambda: np.isclose(joints_of(graph)[0], first[0] + 0.075, atol=1e-9), "all changes")


def test_the_newest_change_during_a_pause_acts_after_it(graph):
    first = joints_of(graph)
    assert graph.call(SetBool, "/physics_node/pause", data=True).success
    for yaw in (0.1, 0.02):
        send_joints(graph, messages.tool_joint_change, [yaw, 0, 0, 0, 0, 0])
    graph.spin(0.3)
    assert graph.call(SetBool, "/physics_node/pause", data=False).success
    graph.until(lambda: np.isclose(joints_of(graph)[0], first[0] + 0.02), "the newest change")


def pause(bench, paused):
    assert bench.call(SetBool, "/physics_node/pause", data=paused).success


@pytest.mark.parametrize("newest_is", ["move_jp", "move_jr", "move_cp", "hold", "free", "pause", "disable"])
def test_the_newest_command_of_a_pause_ends_those_that_wait(graph, newest_is):
    physics, arm, first = graph.nodes[1], graph.nodes[1].arms["PSM1"], joints_of(graph)
    change, goal = np.array([0.1, 0, 0, 0, 0, 0]), first + [0.1, 0, 0, 0, 0, 0]
    pause(graph, True)
    send_joints(graph, messages.tool_joint_command, first + [0.02, 0, 0, 0, 0, 0])
    jaw(graph, 0.5)
    graph.until(lambda: len(physics._held) == 2, "two commands that wait")
    if newest_is in ("hold", "free"):
        topic = getattr(messages, f"tool_{newest_is}")("PSM1")
        graph.publish(topic, messages.ros_class(topic.type)())
    elif newest_is in ("disable", "pause"):
        switch(graph, newest_is, f"{newest_is.upper()}D")
        switch(graph, "enable" if newest_is == "disable" else "resume", "ENABLED")
    elif newest_is == "move_cp":
        graph.publish(messages.tool_move("PSM1"), messages.encode_pose(arm.base @ PSM.tip_pose(goal), S, "world"))
    else:
        relative = newest_is == "move_jr"
        send_joints(graph, messages.tool_joint_move_change if relative else messages.tool_joint_move, change if relative else goal)
    moves = newest_is.startswith("move")
    graph.until(lambda: ("PSM1", "pose") not in physics._held, "the older command to be forgotten")
    pause(graph, False)
    graph.until(lambda: not physics._held and not arm.busy, "the end of the newest command")
    graph.spin(0.1)
    jaw_angle = lambda: newest(graph, messages.tool_jaw_state("PSM1")).position[0]
    there = lambda: np.allclose(joints_of(graph), goal if moves else first, rtol=1e-7, atol=1e-6)
    graph.until(there, lambda: f"the arm where it belongs; it is at {joints_of(graph)}")
    graph.until(lambda: jaw_angle() == (0.5 if moves else 1.0), lambda: f"the jaw; at {jaw_angle()}")


def test_the_newest_command_of_a_jaw_during_a_pause_acts_after_it(graph):
    physics, arm = graph.nodes[1], graph.nodes[1].arms["PSM1"]
    pause(graph, True)
    jaw(graph, 0.5)
    graph.until(lambda: physics._held, "a command that waits")
    graph.publish(messages.tool_jaw_move("PSM1"), messages.encode_jaw(0.8, S))
    graph.until(lambda: arm.angle_goal == 0.8, "a goal")
    pause(graph, False)
    graph.until(lambda: not arm.busy, "the end of the move")
    assert arm.angle == 0.8


@pytest.mark.parametrize("topic", [messages.tool_hold, messages.tool_free])
def test_hold_and_free_end_all_moves_where_they_are(graph, topic):
    empty = messages.ros_class(topic("PSM1").type)
    first, goal = joints_of(graph), joints_of(graph) + [0.5, 0, 0, 0, 0, 0]
    send_joints(graph, messages.tool_joint_move, goal)
    graph.publish(messages.tool_jaw_move("PSM1"), messages.encode_jaw(-0.3, S))
    graph.until(lambda: joints_of(graph)[0] > first[0] + 0.05, "a move")
    graph.publish(topic("PSM1"), empty())
    arm = graph.nodes[1].arms["PSM1"]
    graph.until(lambda: not arm.busy, "the end of the move")
    joints, angle = arm.joints, arm.angle
    graph.spin(0.2)
    np.testing.assert_array_equal(joints_of(graph), joints)
    assert joints[0] < goal[0] - 0.05 and newest(graph, messages.tool_jaw_state("PSM1")).position[0] == angle > -0.2
    assert texts(graph, messages.tool_state)[-1] == "ENABLED"
    switch(graph, "disable", "DISABLED")
    graph.publish(topic("PSM1"), empty())
    said = f"{topic('PSM1').name}: PSM1 is DISABLED; send enable on PSM1/state_command"
    graph.until(lambda: said in texts(graph, messages.tool_error), "an error of the arm")
    switch(graph, "enable", "ENABLED")


def test_a_ratio_makes_moves_slower(graph):
    ratio = lambda: newest(graph, messages.tool_ratio("PSM1")).data  # noqa: E731
    send = lambda value: graph.publish(messages.tool_ratio_command("PSM1"), messages.encode_number(value))  # noqa: E731
    assert ratio() == 1.0
    send(0.25)
    graph.until(lambda: ratio() == 0.25, "the ratio")
    goal = joints_of(graph) + [0.1, 0, 0, 0, 0, 0]
    send_joints(graph, messages.tool_joint_move, goal)
    graph.until(lambda: np.allclose(joints_of(graph), goal, atol=1e-12), "the goal")
    fastest = lambda: np.abs([m.velocity for m in graph.heard["PSM1/measured_js"]]).max()  # noqa: E731
    assert 0.499 < fastest() < 0.501  # of 2 rad/s
    pose = pose_of(graph, messages.tool_pose("PSM1"))
    pose[2, 3] -= 0.002
    graph.spin(0.1)  # it stands
    graph.heard["PSM1/measured_cv"].clear()
    graph.publish(messages.tool_move("PSM1"), messages.encode_pose(pose, S, "world"))
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1")), pose, atol=1e-9), "the pose")
    speed = max(np.hypot(np.hypot(v.x, v.y), v.z) for v in (m.twist.linear for m in graph.heard["PSM1/measured_cv"]))
    assert 0.01 < speed < 0.0126  # of 5 cm/s
    for value in (0.0, 1.5, -0.1, 1.0000001, 0.0009, 5e-324, float("inf"), float("nan")):
        send(value)
        said = f"PSM1/trajectory_j/set_ratio: PSM1: the ratio of speeds is {value}; send one from 0.001 to 1"
        graph.until(lambda said=said: said in texts(graph, messages.tool_error), "an error of the arm")
    assert graph.nodes[1].arms["PSM1"].speed_ratio == 0.25
    send(1.0)
    graph.until(lambda: ratio() == 1.0, "the ratio of before")


def test_jacobians_are_those_of_the_joints(graph):
    for arm in ("PSM1", "ECM"):
        kinematics, joints = graph.nodes[1].arms[arm].kinematics, joints_of(graph, arm)
        for topic, expected in (
            (messages.tool_body_jacobian, kinematics.body_jacobian(joints)),
            (messages.tool_spatial_jacobian, kinematics.spatial_jacobian(joints)),
        ):
            message = newest(graph, topic(arm))
            shape = [each.size for each in message.layout.dim]
            np.testing.assert_allclose(np.array(message.data).reshape(shape), expected, atol=1e-12)


def test_what_is_published_can_be_sent_back(graph):
    joints, pose = joints_of(graph), pose_of(graph, messages.tool_pose("PSM1"))
    send_joints(graph, messages.tool_joint_command, joints + [0, 0, 0.005, 0, 0, 0])
    graph.until(lambda: joints_of(graph)[2] > joints[2] + 0.004)
    servo(graph, pose)
    graph.until(lambda: np.allclose(joints_of(graph), joints, atol=1e-9), "the joints of before")
    fastest = lambda: max((abs(m.twist.linear.z) for m in graph.heard["PSM1/measured_cv"]), default=0.0)  # noqa: E731
    graph.until(lambda: fastest() > 0.05, "5 mm in a step")


BAD_JOINTS = {
    "too_few": ([0.0] * 5, "PSM1: 5 numbers, not 6; the joints are yaw, pitch,"),
    "too_many": ([0.0] * 7, "PSM1: 7 numbers, not 6; the joints are yaw, pitch,"),
    "none": ([], "PSM1: 0 numbers, not 6; the joints are yaw, pitch,"),
    "nan": ([0, 0, float("nan"), 0, 0, 0], "expected finite joint positions"),
    "infinite": ([0, 0, float("inf"), 0, 0, 0], "expected finite joint positions"),
    "beyond_limits": ([0, 0, 0.3, 0, 0, 0], "insertion cannot be at 300 mm; its limits are 0 and 240 mm"),
    "degrees": ([0, 0, 0.1, 0, 45, 0], "wrist_pitch cannot be at 2578 degrees; its limits are -80 and 80 degrees; is it in radians?"),
    "millimetres": ([0, 0, 100, 0, 0, 0], "insertion cannot be at 1e+05 mm; its limits are 0 and 240 mm; is it in metres?"),
}


@pytest.mark.parametrize("name", BAD_JOINTS)
def test_bad_joints_are_one_sentence_and_the_arm_stays(graph, name):
    positions, sentence = BAD_JOINTS[name]
    before, pose = joints_of(graph), pose_of(graph, messages.tool_pose("PSM1"))
    for topic in (messages.tool_joint_command, messages.tool_joint_move):
        graph.heard["PSM1/error"].clear()
        graph.statuses.clear()
        send_joints(graph, topic, positions)
        graph.until(lambda: texts(graph, messages.tool_error), "an error of the arm")
        (said,) = texts(graph, messages.tool_error)
        assert sentence in said and said.startswith(topic("PSM1").name)
        graph.refused("physics_node", said)
    graph.spin(0.1)
    np.testing.assert_array_equal(joints_of(graph), before)
    np.testing.assert_array_equal(pose_of(graph, messages.tool_pose("PSM1")), pose)


def test_a_refused_command_lets_a_move_go_on(graph):
    goal = joints_of(graph) + [0.3, 0, 0, 0, 0, 0]
    send_joints(graph, messages.tool_joint_move, goal)
    send_joints(graph, messages.tool_joint_move_change, [9, 0, 0, 0, 0, 0])
    send_joints(graph, messages.tool_joint_command, [9, 0, 0, 0, 0, 0])
    graph.until(lambda: len(texts(graph, messages.tool_error)) == 2, "two errors")
    graph.until(lambda: np.allclose(joints_of(graph), goal), "the goal")


@pytest.mark.parametrize("topic", [messages.tool_joint_command, messages.tool_joint_move])
def test_joints_may_have_their_names_and_no_others(graph, topic):
    joints, none = joints_of(graph), np.zeros(0)
    names = list(newest(graph, messages.tool_joints("PSM1")).name)
    for wrong in (names[::-1], names[:5], [", ".join(names)], ["yaw\n[ERROR] forged"]):
        graph.publish(topic("PSM1"), messages.encode_joints(wrong, joints + 0.01, none, none, S))
        said = f"PSM1: the joints are {', '.join(names)}, in this order, not {', '.join(map(repr, wrong))}; send these names or none"
        graph.refused("physics_node", f"{topic('PSM1').name}: {said}")
    np.testing.assert_array_equal(joints_of(graph), joints)
    graph.publish(topic("PSM1"), messages.encode_joints(names, joints + 0.01, none, none, S))
    graph.until(lambda: np.allclose(joints_of(graph), joints + 0.01), "the joints")


def test_an_arm_stays_where_a_servoed_pose_out_of_reach_is_told(graph):
    before = joints_of(graph)
    servo(graph, tip_at(0.0, 0.0, 0.4))
    said = graph.until(lambda: texts(graph, messages.tool_warning), "a warning")
    assert said[-1].startswith("PSM1 stays where it is, as it would leap") and "insertion at its limit of 240 mm" in said[-1]
    graph.refused("physics_node", "PSM1 stays where it is")
    graph.spin(0.2)
    assert np.array_equal(joints_of(graph), before) and len(texts(graph, messages.tool_warning)) == 1, "told once"


def test_a_move_out_of_reach_takes_the_arm_as_near_as_it_gets(graph):
    assert graph.set("physics_node", move_speed=1.0)[0]
    goal = tip_at(0.0, 0.0, 0.4)
    graph.publish(messages.tool_move("PSM1"), messages.encode_pose(goal, S, "world"))
    said = graph.until(lambda: texts(graph, messages.tool_warning), "a warning")
    assert said[-1].startswith("PSM1: PSM stops") and "insertion at its limit of 240 mm" in said[-1]
    graph.refused("physics_node", "from the pose, with insertion at its limit")
    graph.until(lambda: joints_of(graph)[2] > 0.2399, "the arm to be there")
    reach = solve_inverse(PSM, np.linalg.inv(graph.nodes[1].arms["PSM1"].base) @ goal, joints_of(graph))
    assert np.abs(joints_of(graph) - reach.joints).max() < 0.02 and not reach.reached
    graph.spin(0.2)
    assert len(texts(graph, messages.tool_warning)) == 1, "told once"
    servo(graph, tip_at(0, 0, 0.08))
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1"))[:3, 3], [0, 0, 0.08]), "a pose in reach")


def test_a_straight_move_is_as_slow_as_its_fastest_joint(graph):
    servo(graph, tip_at(0, 0, 0.08))
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1"))[:3, 3], [0, 0, 0.08]))
    assert graph.set("physics_node", move_speed=10.0, turn_speed=100.0)[0]
    goal = tip_at(0.02, 0.0, 0.07)
    goal[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    graph.heard["PSM1/measured_js"].clear()
    graph.publish(messages.tool_move("PSM1"), messages.encode_pose(goal, S, "world"))
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1")), goal, atol=1e-9), "the goal")
    speeds = np.abs([m.velocity for m in graph.heard["PSM1/measured_js"]])
    assert (speeds.max(0) <= np.array([2, 2, 0.2, 2, 2, 2]) * 1.001).all() and speeds.max() > 1.5
    assert graph.set("physics_node", move_speed=0.05, turn_speed=1.5)[0]


def test_reset_takes_arms_to_their_start_and_the_same_episode_gives_the_same_bits(graph):
    def episode():
        assert graph.call(Trigger, "/physics_node/reset").success
        graph.until(lambda: (joints_of(graph) == at).all(), "the start")
        del graph.heard["PSM1/measured_js"][:-1]
        send_joints(graph, messages.tool_joint_move, at + [0.1, 0, 0.03, 0.2, 0, 0])
        graph.until(lambda: len(graph.heard["PSM1/measured_js"]) > 15, "some steps")
        way = [tuple(m.position) for m in graph.heard["PSM1/measured_js"]]
        return list(dict.fromkeys(way))[:8]  # the start may be told twice

    at = joints_of(graph)
    assert episode() == episode()
    assert graph.call(Trigger, "/physics_node/reset").success
    graph.until(lambda: (joints_of(graph) == at).all(), "the start")
    assert moved(graph) == 0


def test_a_move_through_tissue_ends_at_its_force_limit_and_the_way_back_does_not(graph):
    assert graph.set("physics_node", contact_radius=0.015, force_limit=0.5)[0]
    graph.until(lambda: graph.nodes[1].simulation.contact_radius >= 0.015, "contact")
    servo(graph, tip_at(0, 0, 0.07))
    graph.spin(0.1)
    goal = messages.encode_pose(tip_at(0, 0, 0.11), S, "world")
    graph.publish(messages.tool_move("PSM1"), goal)
    (said,) = graph.until(lambda: texts(graph, messages.tool_error), lambda: f"the force limit; felt {graph.nodes[1].arms['PSM1'].felt} N")
    assert said.startswith("PSM1: the move ended at ") and "above force_limit = 0.5 N" in said
    graph.refused("physics_node", "the move ended at")
    graph.until(lambda: texts(graph, messages.tool_state)[-1] == "ENABLED", "an arm that is not busy")
    assert moved(graph) > 1e-4
    depth = pose_of(graph, messages.tool_pose("PSM1"))[2, 3]
    assert 0.07 < depth < 0.109
    pressed = graph.heard["PSM1/measured_cp"]
    pressed.clear()
    graph.until(lambda: len(pressed) > 5, "some steps of waiting")
    assert graph.nodes[1].arms["PSM1"].felt > 0, "it feels the tissue while it waits"
    graph.publish(messages.tool_move("PSM1"), messages.encode_pose(tip_at(0, 0, 0.07), S, "world"))
    graph.until(lambda: abs(pose_of(graph, messages.tool_pose("PSM1"))[2, 3] - 0.07) < 1e-9, "the way back")
    assert len(texts(graph, messages.tool_error)) == 1, "the way back is not ended"
    assert graph.set("physics_node", contact_radius=0.0, force_limit=10.0)[0]
    graph.until(lambda: graph.nodes[1].simulation.contact_radius == 0, "no contact")


def test_who_puts_an_arm_into_the_tissue_is_told(graph):
    assert graph.set("physics_node", contact_radius=0.015, force_limit=0.5)[0]
    graph.until(lambda: graph.nodes[1].simulation.contact_radius >= 0.015, "contact")
    servo(graph, tip_at(0, 0, 0.07))
    graph.spin(0.1)
    assert graph.nodes[1].arms["PSM1"].felt == 0
    before = len(texts(graph, messages.tool_warning))
    servo(graph, tip_at(0, 0, 0.1))
    graph.until(lambda: len(texts(graph, messages.tool_warning)) > before, "a warning")
    assert re.fullmatch(r"PSM1 presses with \d+ N at once: it was put into the tissue; .*", texts(graph, messages.tool_warning)[-1])
    servo(graph, tip_at(0, 0, 0.07))
    assert graph.set("physics_node", contact_radius=0.0, force_limit=10.0)[0]
    graph.until(lambda: graph.nodes[1].simulation.contact_radius == 0, "no contact")


@pytest.mark.thorough
def test_many_small_moves_press_no_harder_than_one(graph):
    assert graph.set("physics_node", contact_radius=0.015, force_limit=0.5)[0]
    graph.until(lambda: graph.nodes[1].simulation.contact_radius >= 0.015, "contact")
    servo(graph, tip_at(0, 0, 0.07))
    graph.spin(0.1)
    arm, felt = graph.nodes[1].arms["PSM1"], []
    for _ in range(20):
        depth = arm.pose[2, 3]
        graph.publish(messages.tool_move("PSM1"), messages.encode_pose(tip_at(0, 0, depth + 1e-3), S, "world"))
        steps = graph.nodes[1].steps
        graph.until(lambda: graph.nodes[1].steps > steps + 3 and not arm.moving, "the end of a small move")
        felt.append(arm.felt)
    assert max(felt) < 0.6 and len(texts(graph, messages.tool_error)) > 2, felt
    assert 0.08 < arm.pose[2, 3] < 0.088, arm.pose
    at, last = arm.pose[2, 3], graph.nodes[1].steps
    for _ in range(10):  # a goal a step, which does not wait for the way back
        graph.publish(messages.tool_move("PSM1"), messages.encode_pose(tip_at(0, 0, arm.pose[2, 3] + 1e-3), S, "world"))
        graph.until(lambda: graph.nodes[1].steps > last, "a step")
        last = graph.nodes[1].steps
    graph.until(lambda: not arm.moving, "the end of moves")
    assert arm.felt < 1.0 and arm.pose[2, 3] < at + 2e-3  # ten millimetres would press with many newtons
    servo(graph, tip_at(0, 0, 0.07))
    assert graph.set("physics_node", contact_radius=0.0, force_limit=10.0)[0]
    graph.until(lambda: graph.nodes[1].simulation.contact_radius == 0, "no contact")


def jaw(bench, angle, arm="PSM1"):
    bench.publish(messages.tool_jaw(arm), messages.encode_jaw(angle, S))


def felt(bench, arm="PSM1"):
    return np.linalg.norm(messages.decode_wrench(newest(bench, messages.tool_reaction(arm)), "")[0])


def hold_tissue(bench, arm="PSM1"):
    """Close a jaw on the tissue and pull at it."""
    servo(bench, tip_at(0, 0, 0.1), arm)
    bench.spin(0.1)
    jaw(bench, 0.0, arm)
    bench.until(lambda: bench.nodes[1].arms[arm].closed and bench.nodes[1].simulation.in_reach(arm), "a grasp")
    servo(bench, tip_at(0, 0, 0.085), arm)
    bench.until(lambda: felt(bench, arm) > 0.1 and moved(bench) > 0.01, "a pull")


@pytest.mark.parametrize("topic", [messages.tool_jaw, messages.tool_jaw_move])
def test_an_angle_beyond_the_jaw_is_refused_and_a_tight_closing_is_not(graph, topic):
    assert graph.set("physics_node", turn_speed=100.0)[0]
    angle = lambda: newest(graph, messages.tool_jaw_state("PSM1")).position[0]  # noqa: E731
    for goal, shown in ((99.0, "5672"), (1.45, "83.08"), (-0.5, "-28.65"), (20.0, "1146")):
        graph.publish(topic("PSM1"), messages.encode_jaw(goal, S))
        said = f"{topic('PSM1').name}: PSM1: the jaw cannot be at {shown} degrees; its limits are -20 and 80 degrees"
        graph.refused("physics_node", said)
        graph.until(lambda said=said: said in texts(graph, messages.tool_error), "the same on the topic of the arm")
    assert angle() == 1.0
    for goal in (np.radians(-20), np.radians(80), -0.355, 0.0):
        graph.publish(topic("PSM1"), messages.encode_jaw(goal, S))
        graph.until(lambda goal=goal: angle() == goal, "the angle")
    assert graph.set("physics_node", turn_speed=1.5)[0]


def test_an_arm_whose_base_is_moved_lets_go_and_the_others_stay(graph):
    hold_tissue(graph)
    other = joints_of(graph, "PSM2") + [0.1, 0, 0, 0, 0, 0]
    send_joints(graph, messages.tool_joint_command, other, "PSM2")
    graph.until(lambda: (joints_of(graph, "PSM2") == other).all(), "another arm that has moved")
    assert graph.set("physics_node", frames=["PSM1_base 0.12 0.1 0.0 0 1 0 0"])[0]
    graph.until(lambda: felt(graph) == 0 and moved(graph) < 1e-3, "tissue that is let go")
    arms = graph.nodes[1].arms
    np.testing.assert_allclose(arms["PSM1"].base[:3, 3], [0.12, 0.1, 0.0])
    graph.until(lambda: newest(graph, messages.tool_jaw_state("PSM1")).position[0] == 1.0, "an open jaw")
    np.testing.assert_array_equal(joints_of(graph, "PSM2"), other)
    pose = pose_of(graph, messages.tool_pose("PSM1"))  # in the world, and so is a pose without a frame
    pose[:3, 3] += [0.001, 0, 0]
    graph.publish(messages.tool_pose_command("PSM1"), messages.encode_pose(pose, S, ""))
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1")), pose, atol=1e-9), "a pose 1 mm further")
    assert graph.set("physics_node", frames=[""])[0]
    graph.until(lambda: arms["PSM1"].base[0, 3] != 0.12, "the place of before")
    np.testing.assert_array_equal(joints_of(graph, "PSM2"), other)


def test_the_arm_of_the_camera_moves_it_and_does_not_turn_it_over(graph):
    np.testing.assert_allclose(pose_of(graph, messages.tool_pose("ECM")), np.eye(4), atol=1e-9)  # the training camera
    graph.publish(messages.tool_move("ECM"), messages.encode_pose(tip_at(0.01, 0.005, 0.02), S, "world"))
    there = lambda: np.allclose(pose_of(graph, messages.tool_pose("ECM"))[:3, 3], [0.01, 0.005, 0.02], atol=2e-4)  # noqa: E731
    graph.until(there, "the camera to be there")
    pose = pose_of(graph, messages.tool_pose("ECM"))
    over = tip_at(0.01, 0.005, 0.02) @ np.diag([-1.0, -1, 1, 1])
    graph.publish(messages.tool_pose_command("ECM"), messages.encode_pose(over, S, "world"))
    graph.refused("physics_node", "ECM/servo_cp: ECM stays where it is: the camera would be upside down")
    graph.publish(messages.tool_pose_command("ECM"), messages.encode_pose(tip_at(0, 0, 0.5), S, "world"))
    graph.refused("physics_node", "ECM/servo_cp: ECM stays where it is: ECM stops", "insertion at its limit")
    send_joints(graph, messages.tool_joint_command, [0, 0, 0.1, 1.6], "ECM")
    graph.refused("physics_node", "ECM: roll cannot be at 91.67 degrees")
    aside = pose.copy()  # a direction that the place does not give
    aside[:3, :3] = pose[:3, :3] @ Rotation.from_euler("y", 20, degrees=True).as_matrix()
    for command in (messages.tool_pose_command, messages.tool_move):
        told = len(texts(graph, messages.tool_warning, "ECM"))
        graph.publish(command("ECM"), messages.encode_pose(aside, S, "world"))
        graph.until(lambda told=told: len(texts(graph, messages.tool_warning, "ECM")) > told, "what is missed")
        assert texts(graph, messages.tool_warning, "ECM")[-1].startswith("ECM: its direction is 20 degrees from that of the pose")
        graph.publish(messages.tool_pose_command("ECM"), messages.encode_pose(pose, S, "world"))
        graph.until(lambda: "ECM" not in graph.nodes[1]._arm_topics._short, "a pose that it reaches")
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("ECM")), pose, rtol=0, atol=1e-12), "that pose")
    send_joints(graph, messages.tool_joint_command, [0, 0, 0.1, 0.5], "ECM")
    graph.until(lambda: np.allclose(joints_of(graph, "ECM"), [0, 0, 0.1, 0.5]), "the joints")


def test_no_arm_moves_during_a_pause_and_the_newest_commands_act_after_it(graph):
    before = {arm: joints_of(graph, arm) for arm in ("PSM1", "ECM")}
    assert graph.call(SetBool, "/physics_node/pause", data=True).success
    try:
        for yaw in (0.1, 0.02):
            for arm, joints in before.items():
                send_joints(graph, messages.tool_joint_command, joints + [yaw, 0, 0, *[0] * (len(joints) - 3)], arm)
        graph.spin(0.5)
        for arm, joints in before.items():
            np.testing.assert_array_equal(joints_of(graph, arm), joints)
    finally:
        assert graph.call(SetBool, "/physics_node/pause", data=False).success
    for arm, joints in before.items():
        graph.until(lambda arm=arm, joints=joints: np.isclose(joints_of(graph, arm)[0], joints[0] + 0.02), f"the newest command of {arm}")


def test_a_camera_in_the_tissue_is_a_warning(graph):
    graph.publish(messages.tool_pose_command("ECM"), messages.encode_pose(tip_at(0, 0, 0.1), S, "world"))
    said = graph.until(lambda: texts(graph, messages.tool_warning, "ECM"), "a warning of the camera's arm")
    assert said == ["ECM is in the tissue or within 12 mm of it; nothing stops it there, so draw the endoscope back"]
    graph.refused("physics_node", "ECM is in the tissue or within", "draw the endoscope back")


def test_poses_may_be_in_the_frame_of_the_moving_camera_and_of_a_base(graph):
    in_view = tip_at(0.01, 0.02, 0.08)
    graph.publish(messages.tool_pose_command("PSM1"), messages.encode_pose(in_view, S, "ECM_view"))
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1"))[:3, 3], [-0.01, -0.02, 0.08]), "x left, y up")
    send_joints(graph, messages.tool_joint_command, joints_of(graph, "ECM") + [0.05, 0, 0.01, 0], "ECM")
    graph.spin(0.1)
    assert graph.set("physics_node", cartesian_frame="ECM_view")[0]
    graph.publish(messages.tool_pose_command("PSM1"), messages.encode_pose(in_view, S, ""))
    told = lambda: graph.heard["PSM1/measured_cp"][-1]  # noqa: E731
    graph.until(lambda: told().header.frame_id == "ECM_view" and np.allclose(messages.decode_pose(told(), "ECM_view", ""), in_view))
    assert graph.set("physics_node", cartesian_frame="world")[0]
    graph.until(lambda: told().header.frame_id == "world")
    at = pose_of(graph, messages.tool_pose("PSM1"))
    assert not graph.set("physics_node", cartesian_frame="cart")[0]
    assert graph.set("physics_node", frames=["cart 0 0 0.02 0 0 0 1"], cartesian_frame="cart")[0]
    graph.until(lambda: told().header.frame_id == "cart")
    in_cart = messages.decode_pose(told(), "cart", "")
    np.testing.assert_allclose(in_cart, make_pose((0, 0, -0.02), (1, 0, 0, 0)) @ at, atol=1e-9)
    graph.publish(messages.tool_pose_command("PSM1"), messages.encode_pose(in_cart, S, ""))
    assert graph.set("physics_node", cartesian_frame="world")[0]
    graph.until(lambda: told().header.frame_id == "world")
    np.testing.assert_allclose(pose_of(graph, messages.tool_pose("PSM1")), at, atol=1e-9)
    assert graph.set("physics_node", frames=[""])[0]
    world = pose_of(graph, messages.tool_pose("ECM")) @ np.diag([-1.0, -1, 1, 1]) @ in_view
    np.testing.assert_allclose(pose_of(graph, messages.tool_pose("PSM1")), world, atol=1e-9)
    local = messages.decode_pose(newest(graph, messages.tool_local_pose("PSM1")), "PSM1_base", "")
    local[2, 3] += 0.01
    graph.publish(messages.tool_pose_command("PSM1"), messages.encode_pose(local, S, "PSM1_base"))
    shown = lambda: messages.decode_pose(newest(graph, messages.tool_local_pose("PSM1")), "PSM1_base", "")  # noqa: E731
    graph.until(lambda: np.allclose(shown(), local), "the pose in the base")


def test_all_joints_are_told_together_with_a_description_that_has_them(graph):
    states = newest(graph, messages.JOINT_STATES)
    robot = ElementTree.fromstring(newest(graph, messages.ROBOT_DESCRIPTION).data)
    joints = {joint.get("name") for joint in robot.findall("joint") if joint.get("type") != "fixed" and joint.find("mimic") is None}
    assert joints == set(states.name) and len(states.name) == len(states.position) == 7 + 7 + 4
    assert {"PSM1_yaw", "PSM2_jaw", "ECM_roll"} <= joints


@pytest.mark.parametrize("angle", [0.5, -0.3])
def test_description_and_joints_put_links_where_they_are(graph, angle):
    jaw(graph, angle)
    send_joints(graph, messages.tool_joint_command, joints_of(graph) + [0.1, -0.1, 0.01, 0.3, 0.2, -0.2])
    graph.until(lambda: newest(graph, messages.tool_jaw_state("PSM1")).position[0] == angle, "the angle")
    same = lambda: newest(graph, messages.JOINT_STATES).header.stamp == newest(graph, messages.tool_links("PSM1")).header.stamp  # noqa: E731
    graph.spin(0.1)
    graph.until(same, "joints and links of one step")
    states = newest(graph, messages.JOINT_STATES)
    description = newest(graph, messages.ROBOT_DESCRIPTION).data
    _, found = poses_of_links(description, dict(zip(states.name, states.position)), "world")
    for link, pose in zip(LINKS, messages.decode_poses(newest(graph, messages.tool_links("PSM1")), "")):
        np.testing.assert_allclose(found[f"PSM1_{link}"], pose, atol=1e-6, err_msg=link)
    camera = pose_of(graph, messages.tool_pose("ECM"))
    np.testing.assert_allclose(found["ECM_tip"], camera, atol=1e-6)


def test_markers_show_the_capsules_of_the_instrument_where_the_links_are(graph):
    shown = graph.hear(messages.TOOL_MARKERS)
    servo(graph, tip_at(0.01, -0.01, 0.08))
    arm = graph.nodes[1].arms["PSM1"]
    graph.until(lambda: np.allclose(pose_of(graph, messages.tool_pose("PSM1"))[:3, 3], [0.01, -0.01, 0.08]), "the pose")
    shown.clear()
    graph.until(lambda: shown, "markers")
    rods = [marker for marker in shown[-1].markers if marker.ns == "PSM1" and marker.id >= 4]
    _, capsules = build_instrument(arm.kinematics)
    assert len(rods) == len(capsules) and {rod.type for rod in rods} == {rods[0].CYLINDER}
    for rod, capsule in zip(rods, capsules):
        half = 0.5 * rod.scale.z * make_pose([0, 0, 0], [getattr(rod.pose.orientation, axis) for axis in "wxyz"])[:3, 2]
        middle, link = [getattr(rod.pose.position, axis) for axis in "xyz"], arm.links()[capsule.link]
        for found, end in ((middle - half, capsule.start), (middle + half, capsule.end)):
            np.testing.assert_allclose(found, link[:3, :3] @ end + link[:3, 3], atol=1e-9)
        assert rod.scale.x == rod.scale.y == pytest.approx(2 * capsule.radius)


def test_a_disabled_arm_takes_no_command(graph):
    for command, state in (("disable", "DISABLED"), ("enable", "ENABLED")):
        graph.publish(messages.tool_state_command("PSM2"), messages.encode_report(command, S))
        graph.until(lambda: texts(graph, messages.tool_state, "PSM2")[-1] == state)
        if state == "DISABLED":
            send_joints(graph, messages.tool_joint_move, joints_of(graph, "PSM2"), "PSM2")
            graph.refused("physics_node", "PSM2/move_jp: PSM2 is DISABLED; send enable")


def switch(bench, command, state, arm="PSM1"):
    bench.publish(messages.tool_state_command(arm), messages.encode_report(command, S))
    bench.until(lambda: texts(bench, messages.tool_state, arm)[-1] == state, state)


def test_a_disabled_arm_lets_go_and_holds_nothing_when_it_is_enabled_before_it_is_told_to(graph):
    hold_tissue(graph)
    switch(graph, "disable", "DISABLED")
    graph.until(lambda: felt(graph) == 0 and moved(graph) < 1e-3, "tissue that is let go")
    switch(graph, "enable", "ENABLED")
    graph.spin(0.2)
    assert moved(graph) < 1e-3
    servo(graph, tip_at(0, 0, 0.1))
    jaw(graph, 0.0)
    graph.until(lambda: graph.nodes[1].simulation.in_reach("PSM1"), "a grasp")


def test_a_wrench_ends_when_its_arm_is_disabled_however_soon_it_is_enabled(graph):
    arm, physics = graph.nodes[1].arms["PSM1"], graph.nodes[1]
    assert graph.set("physics_node", command_timeout=0.0)[0]
    servo(graph, tip_at(0, 0, 0.1))
    graph.publish(messages.tool_wrench("PSM1"), messages.encode_wrench(np.array([0, 0, -0.5]), np.zeros(3), S, "world"))
    graph.until(lambda: physics.simulation.in_reach("PSM1"), "a pull")
    for command in ("disable", "enable"):  # between two steps
        arm.command_state(command)
    graph.until(lambda: not physics.simulation.in_reach("PSM1") and felt(graph) == 0, "the end of the pull")
    assert graph.set("physics_node", command_timeout=0.5)[0]


@pytest.mark.parametrize("arm", ["PSM1", "ECM"])
def test_what_an_ideal_arm_has_no_use_for_is_refused(graph, arm):
    joints = joints_of(graph, arm)
    for make, message, said in (
        (
            messages.tool_joint_effort,
            messages.encode_joints((), np.zeros(0), np.zeros(0), np.zeros(6), S),
            f"{arm}/servo_jf: the joints are ideal",
        ),
        (messages.tool_wrench_axes, Bool(data=True), f"{arm}/body/set_cf_orientation_absolute: wrenches are in the axes of the tip"),
        (messages.tool_gravity, Bool(data=False), f"{arm}/use_gravity_compensation: the joints are ideal"),
        (messages.tool_present, Bool(data=False), f"{arm}/emulate_tool_present: the tool stays"),
    ):
        graph.publish(make(arm), message)
        graph.until(lambda said=said: any(each.startswith(said) for each in texts(graph, messages.tool_error, arm)), said)
    np.testing.assert_array_equal(joints_of(graph, arm), joints)
    if arm == "ECM":
        graph.publish(messages.tool_wrench(arm), messages.encode_wrench(np.ones(3), np.zeros(3), S, arm))
        graph.until(lambda: any("the endoscope touches nothing" in each for each in texts(graph, messages.tool_error, arm)), "an error")
        assert not np.any(messages.decode_wrench(newest(graph, messages.tool_reaction(arm)), ""))


def wrench(bench, topic, frame):
    message = newest(bench, topic("PSM1"))
    assert message.header.frame_id == frame
    return messages.decode_wrench(message, "")


def test_a_wrench_may_be_told_and_is_felt_in_and_about_the_base(graph):
    arm = graph.nodes[1].arms["PSM1"]
    assert graph.set("physics_node", command_timeout=0.0)[0]
    servo(graph, tip_at(0, 0, 0.1))
    force, torque = np.array([0.2, -0.1, -0.5]), np.array([0.001, 0.002, -0.001])  # world, about where the tool works
    R, origin = arm.base[:3, :3], arm.base[:3, 3]
    graph.until(lambda: arm.pose is not None and np.allclose(arm.pose[:3, 3], [0, 0, 0.1], atol=1e-6), "the tip")
    about_base = torque + np.cross(arm.works_at - origin, force)
    graph.publish(messages.tool_spatial_wrench("PSM1"), messages.encode_wrench(R.T @ force, R.T @ about_base, S, "PSM1_base"))
    graph.until(lambda: felt(graph) > 0.1, "a pull")
    np.testing.assert_allclose(arm.force, force, atol=1e-12)
    np.testing.assert_allclose(arm.torque, torque, atol=1e-12)
    graph.until(lambda: np.allclose(wrench(graph, messages.tool_reaction, "PSM1")[0], -arm.pose[:3, :3].T @ force, atol=1e-6), "the pull")
    graph.heard["PSM1/spatial/measured_cf"].clear()
    at_tip, there = (
        wrench(graph, make, frame) for make, frame in ((messages.tool_reaction, "PSM1"), (messages.tool_spatial_reaction, "PSM1_base"))
    )
    turn, tip = R.T @ arm.pose[:3, :3], R.T @ (arm.pose[:3, 3] - origin)
    np.testing.assert_allclose(there[0], turn @ at_tip[0], atol=1e-5)
    np.testing.assert_allclose(there[1], turn @ at_tip[1] + np.cross(tip, there[0]), atol=1e-5)
    graph.publish(messages.tool_spatial_wrench("PSM1"), messages.encode_wrench(force, torque, S, "world"))
    said = "PSM1/spatial/servo_cf"
    graph.until(lambda: any(said in each for each in texts(graph, messages.tool_error)), "an error of the arm")
    arm.command_state("disable")
    arm.command_state("enable")
    assert graph.set("physics_node", command_timeout=0.5)[0]


def test_a_disabled_arm_has_no_capsule(graph):
    assert graph.set("physics_node", contact_radius=0.015)[0]
    graph.until(lambda: graph.nodes[1].simulation.contact_radius >= 0.015, "contact")
    for step in range(6):
        servo(graph, tip_at(0, 0, 0.08 + 0.004 * step))
        graph.spin(0.05)
    graph.until(lambda: felt(graph) > 0.01 and moved(graph) > 1e-3, "contact")
    switch(graph, "disable", "DISABLED")
    graph.until(lambda: felt(graph) == 0 and moved(graph) < 1e-3, "tissue that is free")
    switch(graph, "enable", "ENABLED")
    graph.until(lambda: felt(graph) > 0.01 and moved(graph) > 1e-3, "contact again")
    assert graph.set("physics_node", contact_radius=0.0)[0]
    graph.until(lambda: graph.nodes[1].simulation.contact_radius == 0, "no contact")


BAD_OPTIONS = {
    "three_for_one": (dict(arms=("A",), instruments=("none",) * 3), "instruments: there are 3 for 1 arm; give one for all"),
    "two_for_three": (dict(arms=("A", "B", "C"), instruments=("none", "none")), "instruments: there are 2 for 3 arms"),
    "unknown": (dict(instruments=("SPOON",)), "tool must be the path of a .json file or one of"),
    "no_file": (dict(arm_models=("/nowhere/psm.json",)), "there is no such file"),
    "endoscope": (dict(instruments=("ENDOSCOPE_STRAIGHT",), arm_models=("ECM",)), "PSM1 cannot be ECM with ENDOSCOPE_STRAIGHT"),
    "two_of_a_name": (dict(arms=("PSM1", "PSM1")), "PSM1 is there 2 times"),
    "capitals": (dict(arms=("PSM1", "psm1")), "PSM1 and psm1 differ in capitals alone; give each arm a name of its own"),
    "nine": (dict(arms=tuple(f"PSM{k}" for k in range(1, 10))), "arms: there are 9 for tools; tissue takes up to 8, beside ECM"),
    "measured_camera": (dict(arms=("PSM1", "ECM")), "ECM needs arm_source commanded"),
}


@pytest.mark.parametrize("name", BAD_OPTIONS)
def test_bad_options_are_one_sentence(name):
    values, sentence = BAD_OPTIONS[name]
    with pytest.raises(ConfigError, match=sentence):
        make_arms(PhysicsNodeConfig(**values))


def test_a_model_of_the_same_recording_leaves_the_arms_and_another_takes_them_to_their_start(graph):
    send_joints(graph, messages.tool_joint_command, joints_of(graph, "PSM2") + [0.1, 0, 0, 0, 0, 0], "PSM2")
    graph.publish(messages.tool_state_command("PSM2"), messages.encode_report("disable", S))
    graph.until(lambda: texts(graph, messages.tool_state, "PSM2")[-1] == "DISABLED")
    arms, goal = graph.nodes[1].arms, joints_of(graph) + [0.0, 0, -0.04, 0, 0, 0]
    left, base = arms["PSM2"].joints, arms["PSM1"].base
    assert graph.set("physics_node", slide_speed=0.02)[0]
    send_joints(graph, messages.tool_joint_move, goal)
    send_model(graph, sheet(z=0.101), stamp=7 * S)
    await_nodes(graph, 7 * S)
    assert arms["PSM1"].base is base and arms["PSM1"].busy, "the move goes on"
    graph.until(lambda: np.allclose(joints_of(graph), goal), "its goal")
    assert graph.set("physics_node", slide_speed=0.2)[0]
    assert not texts(graph, messages.tool_warning)
    assert graph.call(Trigger, "/physics_node/reset").success
    graph.until(lambda: (joints_of(graph) == arms["PSM1"].start).all(), "the start")
    np.testing.assert_array_equal(arms["PSM2"].joints, left)  # disabled

    other = tip_at(0.001, 0, 0)
    send_joints(graph, messages.tool_joint_move, goal)
    send_model(graph, stamp=8 * S, cameras=(other,))
    await_nodes(graph, 8 * S)
    for arm in ARMS:
        (said,) = graph.until(lambda arm=arm: texts(graph, messages.tool_warning, arm), f"a warning of {arm}")
        assert said.startswith(f"{arm} is at its start, as a model of another recording came")
        np.testing.assert_array_equal(arms[arm].joints, arms[arm].start)
    graph.refused("physics_node", "is at its start, as a model of another recording came")
    graph.publish(messages.tool_state_command("PSM2"), messages.encode_report("enable", S))
    graph.until(lambda: texts(graph, messages.tool_state, "PSM2")[-1] == "ENABLED")
    send_model(graph, stamp=9 * S)
    await_nodes(graph, 9 * S)


def test_one_model_for_all_arms_makes_that_of_the_camera_an_ecm_if_it_is_a_name(tmp_path):
    for model in ("PSM", "PSM_Si"):
        arms = make_arms(PhysicsNodeConfig(arms=("PSM1", "ECM"), arm_source="commanded", arm_models=(model,)))
        assert arms["ECM"].kinematics.name == model.replace("PSM", "ECM")
    file = tmp_path / "PSM" / "PSM.json"
    file.parent.mkdir()
    file.write_text((Path(arm_files.__file__).parent / "parameters" / "PSM.json").read_text())
    assert make_arms(PhysicsNodeConfig(arm_models=(str(file),)))["PSM1"].kinematics.name == "PSM"
    with pytest.raises(ConfigError, match="ECM cannot be PSM with .*; ECM takes an endoscope, every other arm an instrument"):
        make_arms(PhysicsNodeConfig(arms=("PSM1", "ECM"), arm_source="commanded", arm_models=(str(file),)))


def test_two_arms_never_have_the_same_place():
    view = Camera(K, WIDTH, HEIGHT, np.eye(4)), 0.1
    arms = make_arms(PhysicsNodeConfig(arms=("right/PSM2", "left/PSM1", "PSM1", "left/ECM")))
    places = "left/PSM1: the place of PSM1 in front of a camera is that of PSM1; give left/PSM1_base in frames; "
    places += "left/ECM: the place of ECM in front of a camera is that of a camera; give left/ECM_base in frames"
    for kept in ((), ("PSM1", "right/PSM2")):
        assert place_arms(arms, {}, view, True, kept) == places
    assert arms["left/PSM1"].base is None and arms["PSM1"].base is not None is not arms["right/PSM2"].base
    assert place_arms(arms, {"PSM1_base": np.eye(4), "left/ECM_base": np.eye(4)}, view, True) == ""


@pytest.mark.parametrize("tools, same_start", [
    (("PERMANENT_CAUTERY_HOOK", "LARGE_NEEDLE_DRIVER"), True), (("LARGE_NEEDLE_DRIVER",), False), (("PROGRASP_FORCEPS",), False),
    (("MARYLAND_BIPOLAR_FORCEPS",), False), (("LARGE_CLIP_APPLIER",), False), (("LARGE_NEEDLE_DRIVER", "CURVED_SCISSORS"), False),
])  # fmt: skip
def test_two_instruments_are_clear_of_each_other_at_their_start(tools, same_start):
    options = PhysicsNodeConfig(arms=("PSM1", "PSM2"), arm_source="commanded", instruments=tools)
    view, together, alone = (Camera(K, WIDTH, HEIGHT, np.eye(4)), 0.1), make_arms(options), make_arms(options)
    assert place_arms(together, {}, view) == "" and all(place_arms({name: arm}, {}, view) == "" for name, arm in alone.items())
    first, second = ((arm.capsules, arm.links()) for arm in together.values())
    assert overlap(first, second, clear=0.0049) == 0
    drawn_back = {alone[name].joints[2] - arm.joints[2] for name, arm in together.items()}
    assert drawn_back == {0.0} if same_start else 0 < min(drawn_back) < 0.03


def test_a_base_far_from_the_camera_is_told():
    arms, view = make_arms(PhysicsNodeConfig(arm_source="commanded")), (Camera(K, WIDTH, HEIGHT, np.eye(4)), 0.1)
    assert place_arms(arms, {"PSM1_base": tip_at(0.1, -0.2, 0.3)}, view, True) == ""
    said = place_arms(arms, {"PSM1_base": tip_at(100, -200, 300)}, view, True)
    assert said == "PSM1_base in frames is 374 m from the camera, and the whole arm is 1.1 m long; is it in metres?"


def test_pictures_follow_the_arm_of_the_camera(graph):
    rendering = graph.add(RenderingNode)
    shown = graph.hear(messages.RENDERED_POSE)
    send_model(graph, stamp=10 * S)
    await_nodes(graph, 10 * S)
    graph.publish(messages.LEFT_INFO, messages.encode_camera_info(K, WIDTH, HEIGHT, S, "endoscope_left"))
    graph.until(lambda: shown, "a picture")
    arm = graph.nodes[1].arms["ECM"]
    goal = arm.start + [0.1, 0.05, 0.02, 0.3]
    send_joints(graph, messages.tool_joint_move, goal, "ECM")
    graph.until(lambda: np.allclose(arm.joints, goal), "the end of the move")
    assert np.linalg.norm(arm.pose[:3, 3]) > 0.02
    graph.until(lambda: np.allclose(messages.decode_pose(shown[-1], "world", ""), arm.pose, atol=1e-6), "its view")
    assert rendering.error_count == 0
