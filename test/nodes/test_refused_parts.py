"""Lockstep: a command of which a part is refused takes its step without that part."""

import numpy as np
import pytest
from ros_bench import S, tissue_bench
from std_srvs.srv import Trigger

from endo_sim_ros import messages

pytestmark = pytest.mark.dds

STEP = 20_000_000  # ns
NAN = float("nan")
POSE, JOINTS, CHANGE = messages.tool_pose_command("PSM1"), messages.tool_joint_command("PSM1"), messages.tool_joint_change("PSM1")
JAW, STATES, ERRORS = messages.tool_jaw("PSM1"), messages.tool_joints("PSM1"), messages.tool_error("PSM1")


@pytest.fixture(scope="module")
def graph():
    options = {"mode": "lockstep", "lockstep_inputs": "[pose, jaw]", "arms": "[PSM1]", "arm_source": "commanded"}
    with tissue_bench(STATES, ERRORS, **options) as bench:
        yield bench


def joints(positions, stamp):
    return messages.encode_joints([], np.array(positions, np.float64), np.zeros(0), np.zeros(0), stamp)


def pose(change):
    message = messages.encode_pose(np.eye(4), 1, "world")
    change(message)
    return message


REFUSED = {
    "change_beyond_a_limit": (CHANGE, joints([9.0, 0, 0, 0, 0, 0], 1)),
    "too_few_changes": (CHANGE, joints([0.1] * 5, 1)),
    "joints_beyond_a_limit": (JOINTS, joints([9.0, 0, 0.14, 0, 0, 0], 1)),
    "too_few_joints": (JOINTS, joints([0.1] * 5, 1)),
    "no_number": (JOINTS, joints([NAN] * 6, 1)),
    "unknown_frame": (POSE, pose(lambda m: setattr(m.header, "frame_id", "nowhere"))),
    "far_pose": (POSE, pose(lambda m: setattr(m.pose.position, "x", 100.0))),
    "jaw_beyond_its_limits": (JAW, messages.encode_jaw(9.0, 1)),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_refused_part_is_told_and_the_step_is_taken_without_it(graph, name):
    assert graph.call(Trigger, "/physics_node/reset").success
    graph.spin(0.1)
    arm = graph.nodes[1].arms["PSM1"]
    start, jaw = arm.joints, 0.5
    for heard in graph.heard.values():
        heard.clear()
    topic, message = REFUSED[name]
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(STEP, S)
    other = (CHANGE, joints([0.1, 0, 0, 0, 0, 0], STEP)) if topic is JAW else (JAW, messages.encode_jaw(jaw, STEP))
    for part in ((topic, message), other):
        graph.publish(*part)
    graph.until(lambda: graph.heard[STATES.name], "a step", 5)
    assert messages.stamp_to_ns(graph.heard[STATES.name][-1].header.stamp) == STEP
    graph.until(lambda: graph.heard[ERRORS.name], "an error", 5)
    assert len(graph.heard[ERRORS.name]) == 1
    np.testing.assert_array_equal(arm.joints, start + [0.1, 0, 0, 0, 0, 0] if topic is JAW else start)
    assert arm.angle == (1.0 if topic is JAW else jaw)
