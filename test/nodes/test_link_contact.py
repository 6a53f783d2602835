"""Arms whose instruments touch the tissue with their links, through their topics."""

from pathlib import Path

import numpy as np
import pytest
from ros_bench import S, moved, nodes_of, tissue_bench
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.instruments import arm_files, build_instrument, load_arm
from endo_sim_ros.messages import OK, WARN
from endo_sim_ros.nodes.arm_setup import make_arms
from endo_sim_ros.nodes.configs import PhysicsNodeConfig

pytestmark = pytest.mark.dds

STEP = 40_000_000  # ns
REACTION, JOINTS = messages.tool_reaction("PSM1"), messages.tool_joints("PSM1")
JAWS = 0.0102  # m, of the large needle driver


@pytest.fixture(scope="module")
def running():
    heard = messages.CUT_SURFACE, REACTION, JOINTS, messages.tool_warning("PSM1"), messages.tool_warning("PSM2")
    tools = {"instruments": "[LARGE_NEEDLE_DRIVER, CURVED_SCISSORS]", "link_contact": "true", "grip_force": 4.0}
    lockstep = {"mode": "lockstep", "lockstep_inputs": "[pose, jaw]"}
    with tissue_bench(*heard, node_count=3000, arm_source="commanded", **tools, **lockstep) as bench:
        yield bench


def play(bench, ways, scissors=()):
    """Depths of the hinge, m, and angles of the jaw, rad, one each step; returns reactions [n, 6], efforts [n, 6] and the last state.

    The scissors of the other arm do the same 2 cm aside, or wait in the air.
    """
    assert bench.call(Trigger, "/physics_node/reset").success
    for heard in bench.heard.values():
        heard.clear()
    for step, way in enumerate(ways):
        other = scissors[min(step, len(scissors) - 1)] if len(scissors) else (0.06, 1.0)
        for arm, x, (depth, angle) in (("PSM1", 0.0, way), ("PSM2", -0.02, other)):
            pose, stamp = np.eye(4), (100 * S + step * STEP)
            pose[0, 3], pose[2, 3] = x, depth
            bench.publish(messages.tool_pose_command(arm), messages.encode_pose(pose, stamp, "world"))
            bench.publish(messages.tool_jaw(arm), messages.encode_jaw(angle, stamp))
    bench.until(lambda: len(bench.heard[JOINTS.name]) >= len(ways), "all steps")
    felt = [np.concatenate(messages.decode_wrench(message, "")) for message in bench.heard[REACTION.name][-len(ways) :]]
    efforts = [list(message.effort) for message in bench.heard[JOINTS.name][-len(ways) :]]
    return np.array(felt), np.array(efforts), nodes_of(bench).positions.copy()


PRESS = [(0.1 - JAWS - 0.008 + 0.001 * step, 0.5) for step in range(12)]
GRASP = [*PRESS, *[(PRESS[-1][0], 0.0)] * 3, *[(PRESS[-1][0] - 0.001 * step, 0.0) for step in range(1, 8)]]


def test_instruments_that_run_into_each_other_are_told(running):
    assert running.call(Trigger, "/physics_node/reset").success
    for step, apart in enumerate((0.04, 0.002)):
        said = len(running.statuses["physics_node"])
        for arm, x in (("PSM1", 0.0), ("PSM2", -apart)):
            pose, stamp = np.eye(4), (100 * S + step * STEP)
            pose[0, 3], pose[2, 3] = x, 0.06
            running.publish(messages.tool_pose_command(arm), messages.encode_pose(pose, stamp, "world"))
            running.publish(messages.tool_jaw(arm), messages.encode_jaw(0.5, stamp))
        text = "the instruments of PSM1 and PSM2 run into each other, and nothing stops them; they overlap by" if step else "in lockstep"
        level, sentence, _ = running.status("physics_node", text, WARN if step else OK, since=said)
        assert step or "run into" not in sentence, level


def test_jaws_press_before_the_tip_does_and_joints_feel_it(running):
    felt, efforts, _ = play(running, PRESS)
    assert felt[-1, 2] < -0.05 and moved(running) > 1e-3  # although the tip is still 7 mm in front of the tissue
    arm = running.nodes[1].arms["PSM1"]
    R = arm.base[:3, :3]
    wrench = np.concatenate([R.T @ felt[-1, :3], R.T @ felt[-1, 3:]])  # the axes of the tip are those of the world
    np.testing.assert_allclose(efforts[-1], arm.kinematics.jacobian(arm.joints).T @ wrench, atol=1e-6)
    assert efforts[-1, 2] < -0.5 * np.linalg.norm(felt[-1, :3])  # it pushes the instrument out


def test_closed_jaws_pull_until_the_tissue_slips_and_the_same_episode_gives_the_same_bytes(running):
    felt, _, first = play(running, GRASP)
    bound = 2 * 0.2 * 4.0
    assert 0.05 < felt[-1, 2] < bound  # the tissue pulls the tool back
    again, _, second = play(running, GRASP)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(felt, again)
    far = [(GRASP[-1][0] - 0.002 * step, 0.0) for step in range(1, 12)]
    felt, _, _ = play(running, [*GRASP, *far])
    assert felt[:, 2].max() < 1.02 * bound and not felt[-1].any()
    where = "PSM1: tissue slipped out of the jaw, which pulled it almost 0.05 m, or with 1.6 N between two jaws"
    said = running.status("physics_node", f"{where}; open it, come nearer, or raise travel or grip_force", WARN)[1]
    assert said in [messages.decode_state_command(message) for message in running.heard["PSM1/warning"]]
    assert not running.heard["PSM2/warning"]


def test_jaws_that_close_on_nothing_say_so_and_hold_nothing_until_they_open(running):
    play(running, [(0.06, 0.5), (0.06, 0.0)])
    assert "the jaws touch no movable tissue" in running.status("physics_node", "PSM1: the jaw closed on nothing", WARN)[1]
    simulation = lambda: running.nodes[1].simulation
    felt, _, _ = play(running, [(0.06, 0.5), (0.06, 0.0), *[(depth, 0.0) for depth, _ in PRESS]])
    assert felt[-1, 2] < -0.05 and not simulation().in_reach("PSM1")
    play(running, [(0.06, 0.5), (0.06, 0.0), *PRESS, (PRESS[-1][0], 0.0)])
    assert simulation().in_reach("PSM1")


def test_a_bare_tip_that_tissue_slipped_out_of_waits_until_it_is_told_to_close_again(running, monkeypatch):
    arm, slips = running.nodes[1].arms["PSM1"], lambda: running.nodes[1].simulation.slips
    monkeypatch.setattr(arm, "links", dict)  # nobody knows them
    play(running, [(0.1, 0.5), (0.1, 0.0)])
    assert running.nodes[1].simulation.in_reach("PSM1")
    arm.servo(arm.pose + 0.055 * np.eye(4, k=3))  # aside, where there is tissue, too
    for _ in range(3):
        assert running.call(Trigger, "/physics_node/step").success
        assert slips() == 1 and not running.nodes[1].simulation.in_reach("PSM1")


def test_scissors_cut_when_their_jaw_closes_and_not_tissue_that_cannot_be_cut(running):
    waiting = [(0.06, 0.5)] * 6
    play(running, waiting, [*[(0.09, 0.9)] * 3, (0.09, 0.5), (0.09, 0.0)])
    running.until(lambda: running.heard["cut_surface"] and running.heard["cut_surface"][-1].width > 0, "a cut")
    triangles = messages.decode_cut_surface(running.heard["cut_surface"][-1])
    assert np.abs(triangles[..., 0] + 0.02).max() < 0.01
    assert running.call(Trigger, "/physics_node/reset").success
    assert running.set("physics_node", kinematics="current")[0]
    running.refused("physics_node", "link_contact of PSM2: tissue with kinematics current cannot be cut")
    play(running, waiting, [(0.09, 0.9), (0.09, 0.0)])  # the scissors are a bare tip
    assert running.set("physics_node", kinematics="rest")[0]
    running.until(lambda: running.nodes[1].simulation.has_instrument("PSM2"), "scissors again")


def test_an_instrument_whose_shape_nobody_knows_touches_as_a_usual_one(tmp_path, caplog):
    tool = tmp_path / "MY_SPOON_1.json"
    tool.write_text((Path(arm_files.__file__).parent / "parameters" / "LARGE_NEEDLE_DRIVER_400006.json").read_text())
    arm = make_arms(PhysicsNodeConfig(instruments=(str(tool),), link_contact=True))["PSM1"]
    assert "nobody knows the shape of MY_SPOON_1; it looks like a LARGE_NEEDLE_DRIVER" in caplog.text
    assert len(arm.capsules) == len(build_instrument(load_arm("PSM", "LARGE_NEEDLE_DRIVER"))[1])


def test_a_tool_without_a_jaw_refuses_one_and_holds_nothing():
    arm = make_arms(PhysicsNodeConfig(instruments=("PERMANENT_CAUTERY_HOOK",), arm_source="commanded"))["PSM1"]
    with pytest.raises(ValueError, match="PSM1: PERMANENT_CAUTERY_HOOK_400183 has no jaw, so it neither opens nor closes"):
        arm.check_jaw(0.0)
    arm.angle = 0.0
    arm.hold(0.1, 0.2)
    assert not arm.closed, "whatever a robot measures"


def test_a_wrench_acts_between_the_jaws_and_at_a_bare_tip_where_the_links_do_not_touch():
    for touch in (True, False):
        arm = make_arms(PhysicsNodeConfig(link_contact=touch, arm_source="commanded"))["PSM1"]
        arm.stand(np.eye(4), np.clip(np.zeros(6), arm.kinematics.lower, arm.kinematics.upper))
        offset = np.linalg.norm(arm.works_at - arm.pose[:3, 3])
        assert (0.005 < offset < 0.02) if touch else offset == 0


@pytest.mark.parametrize(
    "tool, said", [("FOO_DRIVER", "instruments or arm_models of PSM1: "), (" ", "instruments: that of PSM1 has no name")]
)
def test_an_instrument_that_is_none_is_refused_by_the_name_of_its_arm(tool, said):
    with pytest.raises(ValueError, match=said):
        make_arms(PhysicsNodeConfig(instruments=(tool,)))
