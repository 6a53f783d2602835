"""Forward kinematics and Jacobian against implementations of their own."""

import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from endo_sim_ros.instruments import load_arm

QUARTER = {"1.5708": np.pi / 2, "-1.5708": -np.pi / 2}


def within_limits(arm, *shape):
    return np.random.default_rng(0).uniform(arm.lower, arm.upper, (*shape, len(arm.joints)))


def elementary(axis, angle=0.0, shift=0.0):
    """Turn about, and slide along, one axis."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    pose["xyz".index(axis), 3] = shift
    return pose


def plain_product(paths, joints, rounded):
    """The tip by the DH tables of files as they are, a product of elementary transforms; `rounded` keeps 1.5708."""
    tables = []
    for path in paths:
        text = re.sub(r"/\*.*?\*/|//[^\n]*", "", path.read_text(), flags=re.S)
        text = text if rounded else re.sub(r"-?1\.5708(?=\s*,\s*\"|\s*,\s*\n)", lambda found: repr(QUARTER[found[0]]), text)
        tables.append(json.loads(text))
    pose = np.eye(4)
    rows = [row for table in tables for row in table["DH"].get("joints", table["DH"].get("links"))]
    for row, q in zip(rows, joints):
        turn = row["theta"] + (row["offset"] + q if row["type"] == "revolute" else 0)
        slide = row["D"] + (row["offset"] + q if row["type"] == "prismatic" else 0)
        pose = pose @ elementary("x", row["alpha"], row["A"]) @ elementary("z", turn, slide)
    return pose @ np.array(tables[-1].get("tooltip_offset", np.eye(4)))


@pytest.mark.parametrize("arm, tool", [("PSM", "LARGE_NEEDLE_DRIVER_420006"), ("PSM_Si", "MARYLAND_BIPOLAR_FORCEPS_420172"),
                                       ("PSM_Si", "PROGRASP_FORCEPS_420093"), ("PSM_Si", "CURVED_SCISSORS_420178")])  # fmt: skip
def test_tip_is_where_the_files_of_the_dvrk_put_it(given, arm, tool):
    paths = [given / "kinematics" / f"{name}.json" for name in (arm, tool)]
    ours = load_arm(arm, tool)
    for joints in within_limits(ours, 50):
        tip, exact, printed = ours.tip_pose(joints), plain_product(paths, joints, False), plain_product(paths, joints, True)
        np.testing.assert_allclose(tip, exact, atol=1e-12)
        assert np.linalg.norm(tip[:3, 3] - printed[:3, 3]) < 1e-5, "π with four decimals is a few micrometres off"
        assert np.degrees(Rotation.from_matrix(tip[:3, :3].T @ printed[:3, :3]).magnitude()) < 0.002


@pytest.mark.parametrize("name", ["ECM", "ECM_Si"])
def test_endoscope_is_where_the_files_of_the_dvrk_put_it(given, name):
    ours, paths, scope = load_arm(name), [given / "kinematics" / f"{name}.json"], elementary("z", np.pi / 2)
    for joints in within_limits(ours, 50):
        np.testing.assert_allclose(ours.tip_pose(joints), plain_product(paths, joints, False) @ scope, atol=1e-12)


def test_tip_is_where_the_urdf_of_the_arm_puts_it(given):
    """The URDF stands at the base, not at the remote centre, and its wrist links end a jaw's length further on."""
    joints = {joint.get("name"): joint for joint in ElementTree.parse(given / "psm" / "psm.urdf").iter("joint") if joint.get("name")}
    names = "yaw", "pitch_end", "main_insertion", "tool_roll", "tool_pitch", "tool_yaw"
    arm = load_arm("PSM", "LARGE_NEEDLE_DRIVER_400006")
    for positions in within_limits(arm, 50):
        pose = np.eye(4)
        for name, q in zip(names, positions):
            origin = joints[f"psm_{name}_joint"].find("origin")
            step = np.eye(4)
            step[:3, :3] = Rotation.from_euler("xyz", [float(x) for x in origin.get("rpy").split()]).as_matrix()
            step[:3, 3] = [float(x) for x in origin.get("xyz").split()]
            pose = pose @ step @ (elementary("z", shift=q) if "insertion" in name else elementary("z", q))
        base = np.eye(4)
        base[1, 3] = 0.4864  # psm_remote_center_joint
        np.testing.assert_allclose(base @ arm.link_frames(positions)[-1], pose, atol=1e-10)


def test_at_zero_the_shaft_points_against_z_and_the_wrist_is_straight(arms):
    for arm in arms:
        tip = arm.tip_pose(np.zeros(len(arm.joints)))
        np.testing.assert_allclose(tip[:2, 3], 0, atol=1e-12)
        if "UP" not in arm.tool and "DOWN" not in arm.tool:
            np.testing.assert_allclose(tip[:3, 2], [0, 0, -1], atol=1e-12)
        insertion = np.zeros(len(arm.joints))
        insertion[2] = 0.1
        np.testing.assert_allclose(arm.tip_pose(insertion)[:3, 3] - tip[:3, 3], [0, 0, -0.1], atol=1e-12)


def test_the_shaft_passes_through_the_remote_centre(arms):
    for arm in arms:
        frame = arm.link_frames(within_limits(arm, 20))[:, 3]
        np.testing.assert_allclose(np.cross(frame[:, :3, 3], frame[:, :3, 2]), 0, atol=1e-12)


@pytest.mark.parametrize("tool, degrees", [("ENDOSCOPE_UP", 30), ("ENDOSCOPE_DOWN", -30)])
def test_angled_endoscopes_look_up_and_down(tool, degrees):
    straight, angled = (load_arm("ECM", name).tip_pose(np.zeros(4)) for name in ("ENDOSCOPE_STRAIGHT", tool))
    view = np.linalg.inv(straight) @ angled
    np.testing.assert_allclose(view[:3, 2], [0, -np.sin(np.radians(degrees)), np.cos(np.radians(30))], atol=1e-12)
    np.testing.assert_allclose(view[:3, 0], [1, 0, 0], atol=1e-12)


def test_any_batch_shape_is_the_same_as_one_by_one(arms):
    for arm in arms[::4]:
        joints = within_limits(arm, 2, 3)
        frames, tips, jacobians = arm.link_frames(joints), arm.tip_pose(joints), arm.jacobian(joints)
        assert (frames.shape, jacobians.shape) == ((2, 3, len(arm.joints), 4, 4), (2, 3, 6, len(arm.joints)))
        for at in np.ndindex(2, 3):
            np.testing.assert_allclose(frames[at], arm.link_frames(joints[at]), atol=1e-15)
            np.testing.assert_allclose(tips[at], frames[at][-1] @ arm.tooltip_offset, atol=1e-15)
            np.testing.assert_allclose(jacobians[at], arm.jacobian(joints[at]), atol=1e-15)
        assert arm.tip_pose(np.zeros((0, len(arm.joints)))).shape == (0, 4, 4)


def test_jacobian_is_that_of_finite_differences(arms):
    step = 1e-6
    for arm in arms:
        for joints in within_limits(arm, 5):
            here, body, spatial = arm.tip_pose(joints), arm.body_jacobian(joints), arm.spatial_jacobian(joints)
            for i, column in enumerate(arm.jacobian(joints).T):
                change = step * np.eye(len(joints))[i]
                before, after = arm.tip_pose(joints - change), arm.tip_pose(joints + change)
                turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
                np.testing.assert_allclose(column, np.concatenate([after[:3, 3] - before[:3, 3], turn]) / (2 * step), atol=1e-8)
                slope, back = (after - before) / (2 * step), np.linalg.inv(here)
                for twist, found in ((back @ slope, body), (slope @ back, spatial)):  # of matrices, as textbooks define them
                    skew = [twist[2, 1], twist[0, 2], twist[1, 0]]
                    np.testing.assert_allclose(found[:, i], np.concatenate([twist[:3, 3], skew]), atol=1e-8)


@pytest.mark.parametrize(
    "joints, sentence",
    [
        (np.zeros(4), "PSM: 4 numbers, not 6; the joints are yaw, pitch, insertion"),
        (0.0, "one number, not 6"),
        ([0, 0, np.nan, 0, 0, 0], "PSM: insertion is not finite; send rad and m"),
        ([[0] * 6, [0, 0, 0, 0, 0, np.inf]], "PSM: wrist_yaw is not finite"),
        (["a"] * 6, "PSM: a joint position must be 6 numbers, got"),
        (None, "PSM: "),
    ],
)
@pytest.mark.parametrize("method", ["link_frames", "tip_pose", "jacobian", "body_jacobian", "spatial_jacobian"])
def test_wrong_joint_positions_are_one_sentence(method, joints, sentence):
    with pytest.raises(ValueError, match=sentence):
        getattr(load_arm("PSM"), method)(joints)
