"""Inverse kinematics: poses in reach come back, also where the arm is singular; others get the nearest and are told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from endo_sim_ros.instruments import ReachConfig, inverse, load_arm, solve_inverse


def within_limits(arm, *shape, seed=0):
    return np.random.default_rng(seed).uniform(arm.lower, arm.upper, (*shape, len(arm.joints)))


def inserted(arm, joints):
    """How far the wrist pitch axis of an instrument is beyond the remote centre, m."""
    return joints[..., 2] + arm.joints[2].shift + arm.joints[3].shift


def test_joint_positions_within_limits_come_back(arms):
    for arm in arms:
        joints = within_limits(arm, 1000)
        reach = solve_inverse(arm, arm.tip_pose(joints), joints)
        assert reach.reached.all()
        np.testing.assert_allclose(reach.joints, joints, atol=1e-9)
        assert reach.position_error.max() < 1e-12 and reach.rotation_error.max() < 1e-12


def test_poses_within_reach_come_back_from_any_present_position(arms):
    for arm in arms:
        poses = arm.tip_pose(within_limits(arm, 500))
        reach = solve_inverse(arm, poses, within_limits(arm, 500, seed=1))
        assert reach.reached.all()
        assert ((reach.joints >= arm.lower) & (reach.joints <= arm.upper)).all()
        np.testing.assert_allclose(arm.tip_pose(reach.joints), poses, atol=1e-9)


def test_at_the_limits_joint_positions_come_back(arms):
    for arm in arms:
        joints = np.where(np.random.default_rng(0).random((200, len(arm.joints))) < 0.5, arm.lower, arm.upper)
        reach = solve_inverse(arm, arm.tip_pose(joints), joints)
        assert reach.reached.all()
        np.testing.assert_allclose(reach.joints, joints, atol=1e-9)


@pytest.mark.parametrize("distance", [0.0, 1e-12, 1e-10, 1e-9, 1e-8, 1e-6, 1e-4])
def test_near_the_remote_centre_the_pose_is_reached_and_the_shaft_stays(distance):
    """With the wrist in the remote centre the direction of the shaft is free, and keeps to that of the present."""
    arm = load_arm("PSM")
    joints = within_limits(arm, 200)
    joints[:, 2] = distance - arm.joints[2].shift - arm.joints[3].shift
    reach = solve_inverse(arm, arm.tip_pose(joints), joints)
    assert reach.position_error.max() < 1e-12 and reach.rotation_error.max() < 1e-12
    np.testing.assert_allclose(reach.joints, joints, atol=1e-6 if 0 < distance < 1e-6 else 1e-9)


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, -1e-7])
def test_near_a_wrist_axis_through_the_remote_centre_the_pose_is_reached_and_the_roll_stays(away):
    """The wrist yaw axis passes through the remote centre where s cos(pitch) = -a: by 80 degrees of pitch only inside the trocar."""
    arm = load_arm("PSM")
    joints = within_limits(arm, 200)
    joints[:, 4] = np.linspace(-0.9, 0.9, 200)
    s = -arm.joints[5].a / np.cos(joints[:, 4])
    joints[:, 2] = s - arm.joints[2].shift - arm.joints[3].shift + away
    joints = joints[joints[:, 2] > 0]
    assert len(joints) > 100
    reach = solve_inverse(arm, arm.tip_pose(joints), joints)
    assert reach.position_error.max() < 1e-12 and reach.rotation_error.max() < 1e-12
    np.testing.assert_allclose(reach.joints, joints, atol=1e-4 if 0 < abs(away) < 1e-7 else 1e-7)


def test_a_wrist_that_bends_beyond_a_right_angle_flips_only_when_the_present_is_nearer():
    """With wider limits a pose has several joint positions; each is its own answer when it is the present one."""
    joints = tuple(replace(joint, lower=-3.1, upper=3.1) if "wrist" in joint.name else joint for joint in load_arm("PSM").joints)
    arm = replace(load_arm("PSM"), joints=joints)
    present = within_limits(arm, 300)
    present[:, 2] = np.linspace(0.05, 0.2, 300)
    pose = arm.tip_pose(present)
    first = solve_inverse(arm, pose, present)
    np.testing.assert_allclose(first.joints, present, atol=1e-8)
    other = present + [0, 0, 0, np.pi, 0, 0] * np.sign(-present)
    other[:, 4] = np.sign(present[:, 4]) * np.pi - present[:, 4]
    other[:, 5] *= -1
    second = solve_inverse(arm, pose, other)
    assert second.reached.all() and (np.abs(second.joints - present)[:, 4] > 0.1).mean() > 0.5
    assert (np.linalg.norm(second.joints - other, axis=1) <= np.linalg.norm(first.joints - other, axis=1) + 1e-9).all()


def test_roll_takes_the_turn_that_is_nearer_to_the_present():
    arm = load_arm("PSM")
    joints = np.array([0.1, 0.2, 0.1, np.radians(200), 0.3, 0.4])
    for present, expected in ((250, 200), (100, 200), (-100, -160), (0, -160)):
        near = joints.copy()
        near[3] = np.radians(present)
        assert np.degrees(solve_inverse(arm, arm.tip_pose(joints), near).joints[3]) == pytest.approx(expected)


@pytest.mark.parametrize("arm, tool", [("PSM", ""), ("PSM_Si", "MARYLAND_BIPOLAR_FORCEPS"), ("ECM", "")])
def test_out_of_reach_nothing_within_the_limits_is_nearer(arm, tool):
    """Neither a small change of the joints is, nor any of many joint positions anywhere."""
    arm, length, rng = load_arm(arm, tool), ReachConfig().radian_length, np.random.default_rng(0)
    middle, half = (arm.lower + arm.upper) / 2, (arm.upper - arm.lower) / 2
    poses = arm.tip_pose(middle + 1.3 * half * rng.uniform(-1, 1, (30, len(middle))))
    reach = solve_inverse(arm, poses)
    missed = np.flatnonzero(~reach.reached)
    assert len(missed) > 10 and ((reach.joints >= arm.lower) & (reach.joints <= arm.upper)).all()

    def badness(tips, pose):
        turn = Rotation.from_matrix(pose[:3, :3] @ np.swapaxes(tips[..., :3, :3], -1, -2)).magnitude()
        return np.hypot(np.linalg.norm(tips[..., :3, 3] - pose[:3, 3], axis=-1), length * turn)

    anywhere = arm.tip_pose(within_limits(arm, 10_000))
    for i in missed:
        found = badness(arm.tip_pose(reach.joints[i]), poses[i])
        assert found == pytest.approx(np.hypot(reach.position_error[i], length * reach.rotation_error[i]), abs=1e-9)
        around = np.clip(reach.joints[i] + 1e-3 * rng.normal(size=(300, len(middle))), arm.lower, arm.upper)
        assert badness(arm.tip_pose(around), poses[i]).min() > found - 1e-5
        assert badness(anywhere, poses[i]).min() > found


def test_what_was_given_up_is_a_sentence():
    arm = load_arm("PSM")
    pose = arm.tip_pose([0, 0, 0.24, 0, 0, 0])
    assert solve_inverse(arm, pose).shortfall() == ""
    pose[2, 3] -= 0.0123
    reach = solve_inverse(arm, pose)
    assert reach.position_error == pytest.approx(0.0123) and reach.rotation_error < 1e-6
    assert reach.shortfall() == "PSM stops 12.3 mm and 0.0 degrees from the pose, with insertion at its limit of 240 mm"
    assert solve_inverse(arm, np.stack([pose, pose])).shortfall(1) == reach.shortfall()


def test_an_endoscope_cannot_look_away_from_its_shaft():
    arm = load_arm("ECM")
    pose = arm.tip_pose([0.1, 0.2, 0.1, 0.3])
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0.2, 0, 0]).as_matrix()
    reach = solve_inverse(arm, pose)
    assert not reach.reached and reach.rotation_error < 0.2 and reach.position_error < 0.002
    assert reach.shortfall().endswith("with no joint at its limit")


def test_the_nearest_pose_gives_up_more_of_the_direction_where_a_radian_is_short():
    arm = load_arm("PSM")
    pose = arm.tip_pose([0, 0, 0.1, 0, 0, 0])
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([1.5, 0, 0]).as_matrix()
    short, long = (solve_inverse(arm, pose, config=ReachConfig(radian_length=length)) for length in (1e-3, 0.1))
    assert short.position_error < long.position_error and short.rotation_error > long.rotation_error


def test_hardly_a_pose_out_of_reach_has_a_nearer_one():
    """Beside the best of searches from 40 random starts."""
    arm, rng = load_arm("PSM"), np.random.default_rng(0)
    joints = within_limits(arm, 150)
    joints[:, 2] = rng.uniform(0.05, 0.22, len(joints))
    poses = arm.tip_pose(joints)
    poses[:, :3, 3] += rng.normal(0, 0.05, (len(joints), 3))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.5, (len(joints), 3))).as_matrix() @ poses[:, :3, :3]
    reach, config = solve_inverse(arm, poses, joints), ReachConfig()
    missed = ~reach.reached
    found = np.hypot(reach.position_error, config.radian_length * reach.rotation_error)[missed]
    starts = rng.uniform(arm.lower, arm.upper, (40, missed.sum(), 6))
    many = np.broadcast_to(poses[missed], (len(starts), *poses[missed].shape))
    _, costs = inverse._search(arm, starts.reshape(-1, 6), many.reshape(-1, 4, 4), config)
    worse = found > np.sqrt(costs.reshape(len(starts), -1).min(0)) + 1e-4
    assert missed.sum() > 50 and worse.mean() < 0.03


def test_rounded_rotations_are_made_exact():
    arm = load_arm("PSM")
    joints = within_limits(arm, 20)
    poses = arm.tip_pose(joints).round(4)
    left, _, right = np.linalg.svd(poses[:, :3, :3])
    reach = solve_inverse(arm, poses, joints, ReachConfig(iterations=1))
    found = arm.tip_pose(reach.joints)[reach.reached]
    assert len(found) > 10
    np.testing.assert_allclose(found[:, :3, :3], (left @ right)[reach.reached], atol=1e-9)
    np.testing.assert_allclose(found[:, :3, 3], poses[reach.reached, :3, 3], atol=1e-9)


def test_any_batch_shape_is_solved():
    arm = load_arm("PSM")
    joints = within_limits(arm, 2, 3)
    reach = solve_inverse(arm, arm.tip_pose(joints), joints[0, 0])
    assert (reach.joints.shape, reach.position_error.shape, reach.reached.shape) == ((2, 3, 6), (2, 3), (2, 3))
    assert solve_inverse(arm, np.zeros((0, 4, 4))).joints.shape == (0, 6)


def test_ten_thousand_poses_are_solved_in_one_call():
    arm = load_arm("PSM")
    joints = within_limits(arm, 10_000)
    np.testing.assert_allclose(solve_inverse(arm, arm.tip_pose(joints), joints).joints, joints, atol=1e-9)


@pytest.mark.parametrize(
    "pose, sentence",
    [
        (np.full((4, 4), np.nan), "PSM: a pose of the tip must be a finite 4×4 matrix, got one that is not finite"),
        (np.eye(3), r"PSM: a pose of the tip must be a finite 4×4 matrix, got shape \(3, 3\)"),
        (1.0, "must be a finite 4×4 matrix, got shape"),
        ("here", "PSM: a pose of the tip must be a 4×4 matrix, got 'here'"),
        (2 * np.eye(4), "must be a rotation and a position, with the last row 0 0 0 1"),
        (np.diag([1.0, 1, -1, 1]), "must be a rotation and a position"),
    ],
)
def test_wrong_poses_are_one_sentence(pose, sentence):
    with pytest.raises(ValueError, match=sentence):
        solve_inverse(load_arm("PSM"), pose)


def test_wrong_present_positions_are_one_sentence():
    arm = load_arm("PSM")
    with pytest.raises(ValueError, match="4 numbers, not 6; the joints are yaw"):
        solve_inverse(arm, np.eye(4), np.zeros(4))
    with pytest.raises(ValueError, match=r"PSM: present joint positions \(3, 6\) do not fit poses \(2, 4, 4\)"):
        solve_inverse(arm, np.tile(np.eye(4), (2, 1, 1)), np.zeros((3, 6)))
