"""How the joints of an arm get to where the tip is told to be."""

import types
import warnings

import numpy as np
import pytest

from endo_sim_ros.core.cameras import make_pose
from endo_sim_ros.instruments import load_arm
from endo_sim_ros.nodes.arm import seconds_between
from endo_sim_ros.nodes.arm_topics import ArmTopics
from endo_sim_ros.nodes.camera_arm import CameraArm
from endo_sim_ros.nodes.configs import PhysicsNodeConfig
from endo_sim_ros.nodes.jointed_arm import JointedArm

PSM = load_arm("PSM", "LARGE_NEEDLE_DRIVER")
BASE = make_pose([0.1, -0.2, 0.3], [0.5, 0.1, -0.7, 0.3])
SPEEDS = np.where(PSM.prismatic, 0.2, 2.0)
STEP = 0.04  # s


def arm_at(joints):
    arm = JointedArm("PSM1", kinematics=PSM, joint_speed=2.0, slide_speed=0.2)
    arm.stand(BASE, np.asarray(joints))
    return arm


def travel(arm):
    """Joints and poses of all steps of a move."""
    joints, poses = [arm.joints], [arm.pose]
    while arm.busy:
        assert len(joints) < 1000, "it never arrives"
        assert arm.move(STEP, 0.05, 1.5) == ""
        joints.append(arm.joints)
        poses.append(arm.pose)
    return np.array(joints), np.array(poses)


@pytest.mark.parametrize("seed", range(24))
def test_moves_between_any_two_poses_arrive_within_all_limits(seed):
    random = np.random.default_rng(seed)
    first, last = (random.uniform(0.95 * PSM.lower, 0.95 * PSM.upper) for _ in range(2))
    first[2], last[2] = random.uniform(0.06, 0.22, 2)
    arm, goal = arm_at(first), BASE @ PSM.tip_pose(last)
    assert arm.move_to(goal) == ""
    joints, poses = travel(arm)
    assert (np.abs(np.diff(joints, axis=0)) <= SPEEDS * STEP * (1 + 1e-6)).all()
    assert max(seconds_between(*pair, 0.05, 1.5) for pair in zip(poses, poses[1:])) <= STEP * (1 + 1e-6)
    assert (joints >= PSM.lower - 1e-9).all() and (joints <= PSM.upper + 1e-9).all()
    np.testing.assert_allclose(arm.pose, goal, atol=1e-7)


def test_a_move_in_reach_is_straight():
    arm = arm_at([0.0, 0, 0.12, 0, 0.2, 0.1])
    goal = arm.pose.copy()
    goal[:3, 3] += BASE[:3, :3] @ [0.02, 0.01, 0.01]
    arm.move_to(goal)
    _, poses = travel(arm)
    way = poses[:, :3, 3] - poses[0, :3, 3]
    length = np.linalg.norm(way, axis=1)
    np.testing.assert_allclose(way, length[:, None] * way[-1] / length[-1], atol=1e-7)
    np.testing.assert_allclose(np.diff(length)[:-1], 0.05 * STEP, atol=1e-7)


def test_through_a_singularity_the_joints_move_instead_of_leaping():
    """From one side of the remote centre to the other the shaft would have to turn round on the spot."""
    arm = arm_at([0.3, 0.2, 0.02, 0, 0.0, 0.0])
    goal = BASE @ PSM.tip_pose([-0.9, -0.6, 0.02, 2.5, 0.5, -0.5])
    assert arm.move_to(goal) == ""
    joints, _ = travel(arm)
    assert (np.abs(np.diff(joints, axis=0)) <= SPEEDS * STEP * (1 + 1e-6)).all()
    np.testing.assert_allclose(arm.pose, goal, atol=1e-7)


def test_a_servoed_pose_is_taken_exactly_and_out_of_reach_the_nearest_one_if_that_is_near():
    arm = arm_at([0.0, 0, 0.12, 0, 0, 0])
    pose = arm.pose.copy()
    pose[:3, 3] += BASE[:3, :3] @ [0.01, 0, 0]
    arm.servo(pose)
    assert arm.move(STEP, 0.05, 1.5) == "" and arm.pose is pose
    assert np.abs(arm.velocities).max() > 0.1
    far = pose.copy()
    far[:3, 3] += BASE[:3, :3] @ [0, 0, -0.5]
    joints = arm.joints
    arm.servo(far)
    said = arm.move(STEP, 0.05, 1.5)
    assert said.startswith("PSM1 stays where it is, as it would leap") and "insertion at its limit of 240 mm" in said
    assert arm.pose is pose and arm.joints is joints and arm.move(STEP, 0.05, 1.5) == ""
    arm.servo_joints([*joints[:2], 0.236, *joints[3:]])
    arm.move(STEP, 0.05, 1.5)
    arm.servo(far)
    assert "PSM stops" in arm.move(STEP, 0.05, 1.5) and arm.joints[2] == PSM.upper[2]
    assert (np.abs(arm.velocities) <= SPEEDS).all()
    np.testing.assert_allclose(arm.pose, BASE @ PSM.tip_pose(arm.joints), atol=1e-12)
    arm.move(STEP, 0.05, 1.5)
    assert not arm.velocities.any()


@pytest.mark.parametrize("far", [80.0, -90.0, 3.0, 1e5, 1e200, -1e308])
def test_a_pose_beyond_any_reach_is_refused_in_a_sentence_and_the_arm_stays(far):
    for arm in (arm_at([0.0, 0, 0.12, 0, 0, 0]), camera_arm()):
        before = arm.pose, arm.joints
        pose = arm.pose.copy()
        pose[0, 3] = far
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for command in (arm.servo, arm.move_to):
                with pytest.raises(ValueError, match=r"stays where it is: the pose is \S+ m from the base, .* is it in metres\?$"):
                    command(pose)
        assert arm.move(STEP, 0.05, 1.5) == "" and not arm.busy
        assert arm.pose is before[0] and arm.joints is before[1]


def camera_arm():
    arm = CameraArm("ECM", kinematics=load_arm("ECM", "ENDOSCOPE_STRAIGHT"), joint_speed=2.0, slide_speed=0.2)
    arm.stand(BASE, np.array([0.0, 0, 0.1, 0]))
    return arm


def test_no_joint_positions_put_the_tip_farther_away_than_the_arm_is_long():
    random = np.random.default_rng(0)
    for arm in (PSM, load_arm("PSM_Si", "LARGE_NEEDLE_DRIVER"), load_arm("ECM", "ENDOSCOPE_UP")):
        reached = np.linalg.norm(arm.tip_pose(random.uniform(arm.lower, arm.upper, (1000, len(arm.joints))))[:, :3, 3], axis=-1)
        assert reached.max() < arm.length < 2


@pytest.mark.parametrize("tool", ["LARGE_NEEDLE_DRIVER", "LARGE_CLIP_APPLIER", "PERMANENT_CAUTERY_HOOK"])
def test_a_jaw_starts_within_its_limits(tool):
    arm = JointedArm("PSM1", kinematics=load_arm("PSM", tool))
    at_start = arm.angle
    arm.angle = 0.1
    arm.reset()
    assert arm.angle == at_start
    if arm.kinematics.jaw is not None:
        assert arm.check_jaw(at_start) == arm.gape == at_start == min(1.0, arm.kinematics.jaw[1])


def test_efforts_are_the_torques_of_a_force_at_the_tip():
    arm = arm_at([0.1, 0.2, 0.12, 0.3, 0.4, 0.5])
    force, torque, small = np.array([0.3, -0.2, 0.5]), np.array([0.01, 0.02, -0.03]), 1e-6
    efforts, _, _ = arm.dynamics(force, torque)
    for i in range(6):
        moved = arm.joints.copy()
        moved[i] += small
        change = (BASE @ PSM.tip_pose(moved)) - arm.pose
        turn = change[:3, :3] @ arm.pose[:3, :3].T
        twist = np.concatenate([change[:3, 3], [turn[2, 1], turn[0, 2], turn[1, 0]]]) / small
        assert efforts[i] == pytest.approx(twist @ np.concatenate([force, torque]), abs=1e-5)


@pytest.mark.parametrize("link, index", [("roll", 3), ("wrist_pitch", 4), ("jaw_left", 5)])
def test_efforts_of_a_push_on_a_link_are_its_virtual_work_and_joints_beyond_bear_none_of_it(link, index):
    arm = arm_at([0.1, 0.2, 0.12, 0.3, 0.4, 0.5])
    push, at_tip, small = np.array([0.3, -0.2, 0.5]), np.array([-0.1, 0.4, 0.2]), 1e-6
    frame = BASE @ PSM.link_frames(arm.joints)[index]
    local = np.array([0.004, -0.003, -0.05])  # of the point that is pushed, in the frame of the link
    point = frame[:3, :3] @ local + frame[:3, 3]
    turning = np.cross(point - arm.pose[:3, 3], push)
    arm.link_reactions = {link: (push, turning)}
    efforts, _, _ = arm.dynamics(push + at_tip, turning)
    for i in range(6):
        moved = arm.joints.copy()
        moved[i] += small
        then = BASE @ PSM.link_frames(moved)[index]
        work = push @ (then[:3, :3] @ local + then[:3, 3] - point) + at_tip @ (BASE @ PSM.tip_pose(moved) - arm.pose)[:3, 3]
        assert efforts[i] == pytest.approx(work / small, abs=1e-5)


@pytest.mark.parametrize("before_the_step", [lambda arm: arm.servo_joints(arm.joints_after(np.zeros(6))), JointedArm.links])
def test_what_an_arm_misses_is_told_in_the_next_step_whoever_asks_where_it_is_before(before_the_step):
    arm = arm_at([0.0, 0, 0.12, 0, 0, 0])
    arm.servo(BASE @ PSM.tip_pose([0.0, 0, 0.12, 0, 0, 0]) @ make_pose([0, 0, 0.3], [1, 0, 0, 0]))
    before_the_step(arm)
    assert "PSM stops" in arm.move(STEP, 0.05, 1.5)
    assert arm.move(STEP, 0.05, 1.5) == ""


def test_an_arm_without_a_base_is_a_tip():
    arm = JointedArm("PSM3", kinematics=PSM)
    arm.move_to(np.eye(4))
    arm.move(STEP, 0.05, 1.5)
    np.testing.assert_array_equal(arm.pose, np.eye(4))
    assert arm.links() == {}
    with pytest.raises(ValueError, match="PSM3 has no place yet; publish a model, or give PSM3_base in frames"):
        arm.servo_joints(np.zeros(6))


@pytest.mark.parametrize("forces, told", [((0, 3.6, 61.9, 60), [62]), ((3, 9, 12, 21), []), ((9, 20), [20]), ((15, 15.5), [15])])
def test_a_force_that_grows_by_more_than_the_limit_in_a_step_is_told(forces, told):
    """Also where tissue was touched before."""
    warned = []
    topics = types.SimpleNamespace(
        options=PhysicsNodeConfig(), _node=types.SimpleNamespace(report_warning=warned.append), _tell=lambda arm, topic, text: None
    )
    arm = arm_at([0.0, 0, 0.12, 0, 0, 0])
    for force in forces:
        ArmTopics.limit_force(topics, arm, lambda force=force: np.array([0.0, 0, force]))
    assert [text.partition(" at once")[0] for text in warned] == [f"PSM1 presses with {force} N" for force in told]


@pytest.mark.parametrize("forces, ended", [((15, 15, 14, 9, 3), False), ((15, 15.5), True), ((4, 9, 11), True), ((4, 9, 9.9), False)])
def test_a_move_ends_where_a_reaction_above_the_limit_grows_and_a_retreat_does_not(forces, ended):
    """The first force is felt while the arm waits."""
    told, warned = [], []
    node = types.SimpleNamespace(report_error=told.append, report_warning=warned.append)
    topics = types.SimpleNamespace(options=PhysicsNodeConfig(), _node=node, _tell=lambda arm, topic, text: None)
    arm = arm_at([0.0, 0, 0.12, 0, 0, 0])
    arm.slide_speed = 0.1
    for number, force in enumerate(forces):
        if number == 1:
            arm.move_joints([0.0, 0, 0.06, 0, 0, 0])
        began = arm.joints
        arm.move(STEP, 0.05, 1.5)
        ArmTopics.limit_force(topics, arm, lambda force=force: np.array([0.0, 0, force]))
    assert bool(told) == ended
    assert [text.partition(":")[0] for text in warned] == ["PSM1 presses with 15 N at once"][: forces[0] > 10]
    arm.move(STEP, 0.05, 1.5)
    assert arm.moving != ended and np.array_equal(arm.joints, began) == ended
