"""Where arms stand by default: instruments come in from the lower corners and reach the tissue, and the camera is the ECM's tip."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix, invert_pose, make_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import PlacementConfig, load_arm, place_arm, solve_inverse

DEPTHS = 0.03, 0.05, 0.1, 0.2, 0.3
PAGE = Path(__file__).parents[2] / "docs" / "instruments.md"


def camera(fov=60.0, pose=None):
    """Somewhere, looking anywhere."""
    position, quat = np.split(np.random.default_rng(int(fov)).normal(size=7), [3])
    focal = 320 / np.tan(np.radians(fov / 2))
    return Camera(intrinsic_matrix(focal, focal, 320, 256), 640, 512, make_pose(position, quat) if pose is None else pose)


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("fov", [30, 60, 90])
@pytest.mark.parametrize("arm", ["PSM", "PSM_Si"])
@pytest.mark.parametrize("name", ["PSM1", "PSM2"])
def test_the_tip_reaches_the_middle_and_half_way_to_the_corners(name, arm, fov, depth):
    arm, view = load_arm(arm), camera(fov)
    place = place_arm(name, arm, view, depth)
    middle = place.base @ arm.tip_pose(place.joints)
    points = view.backproject(np.full((512, 640), depth))
    np.testing.assert_allclose(middle[:3, 3], view.pose[:3, :3] @ [0, 0, depth] + view.position, atol=1e-12)
    poses = np.tile(middle, (5, 1, 1))  # the jaw keeps its direction
    poses[1:, :3, 3] = points[[128, 128, 384, 384], [160, 480, 160, 480]]
    assert solve_inverse(arm, invert_pose(place.base) @ poses, place.joints).reached.all()


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("name, side", [("PSM1", 1), ("PSM2", -1)])
def test_shafts_come_in_from_below_psm1_from_the_right(name, side, depth):
    arm, view = load_arm("PSM"), camera()
    place = place_arm(name, arm, view, depth)
    frames = place.base @ arm.link_frames(place.joints)
    tip, shaft = place.base @ arm.tip_pose(place.joints), frames[3, :3, 2]
    np.testing.assert_allclose(tip[:3, 2], shaft, atol=1e-12, err_msg="the wrist is straight")
    seen, z = view.project(tip[:3, 3] - np.array([[0.005], [0.01], [0.015], [0.02]]) * shaft)
    assert (z > 0).all() and (side * (seen[:, 0] - 320) > 2).all() and (seen[:, 1] - 256 > 2).all()
    assert (np.diff(side * seen[:, 0]) > 0).all() and (np.diff(seen[:, 1]) > 0).all(), "the further back, the further out"


def test_arms_start_at_mid_insertion_with_all_else_straight():
    view = camera()
    for name, arm in {"PSM1": load_arm("PSM"), "PSM2": load_arm("PSM_Si"), "ECM": load_arm("ECM")}.items():
        joints = place_arm(name, arm, view, 0.1).joints
        assert joints[2] == pytest.approx((arm.lower[2] + arm.upper[2]) / 2)
        np.testing.assert_array_equal(np.delete(joints, 2), 0)
        assert place_arm(name, arm, view, 0.1, PlacementConfig(insertion=0.25)).joints[2] < joints[2]


@pytest.mark.parametrize("tool", ["ENDOSCOPE_STRAIGHT", "ENDOSCOPE_UP", "ENDOSCOPE_DOWN"])
@pytest.mark.parametrize("arm", ["ECM", "ECM_Si"])
def test_the_tip_of_the_ecm_is_the_camera(arm, tool):
    arm, view = load_arm(arm, tool), camera()
    place = place_arm("ECM", arm, view, 0.1)
    np.testing.assert_allclose(place.base @ arm.tip_pose(place.joints), view.pose, atol=1e-12)


def test_arms_move_left_and_up_in_the_picture_as_an_ecm_does():
    """Positive yaw leads to the left and positive pitch up; the tip of an ECM moves so, too."""
    view = camera(pose=np.eye(4))
    for name, arm in {"PSM1": load_arm("PSM"), "PSM2": load_arm("PSM"), "ECM": load_arm("ECM")}.items():
        place = place_arm(name, arm, view, 0.1)
        for joint, axis, sign in ((0, 0, -1), (1, 1, -1)):
            moved = place.joints + 0.1 * np.eye(len(place.joints))[joint]
            way = (place.base @ (arm.tip_pose(moved) - arm.tip_pose(place.joints)))[:3, 3]
            assert sign * way[axis] > 0.004


def test_options_turn_the_shaft():
    arm, view = load_arm("PSM"), camera(pose=np.eye(4))
    base = place_arm("PSM1", arm, view, 0.1, PlacementConfig(angle=30, below=0)).base
    np.testing.assert_allclose(base[:3, 2], [np.sin(np.radians(30)), 0, -np.cos(np.radians(30))], atol=1e-12)


def test_a_tip_beside_the_shaft_is_in_the_middle_too():
    arm, view = load_arm("PSM"), camera(pose=np.eye(4))
    offset = arm.tooltip_offset.copy()
    offset[:3, 3] = 0.002, 0.01, 0.001
    arm = replace(arm, tooltip_offset=offset)
    place = place_arm("PSM1", arm, view, 0.1)
    np.testing.assert_allclose((place.base @ arm.tip_pose(place.joints))[:3, 3], [0, 0, 0.1], atol=1e-12)


@pytest.mark.parametrize(
    "name, depth, fov, sentence",
    [
        ("PSM3", 0.1, 60, "there is no default place for PSM3, only for PSM1, PSM2 and ECM; give its base in frames"),
        ("PSM1", 0.0, 60, "PSM1: the depth of the tissue must be positive and finite, got 0 m"),
        ("PSM2", np.nan, 60, "PSM2: the depth of the tissue must be positive and finite, got nan m"),
        (
            *("PSM1", 0.5, 80),
            r"PSM1 \(PSM\) does not reach half way to the corners of a picture that shows 84 cm of tissue at 50 cm; "
            "if tissue is nearer, correct the scale of the poses, else give its base in frames",
        ),
    ],
)
def test_what_cannot_be_placed_is_one_sentence(name, depth, fov, sentence):
    with pytest.raises(ConfigError, match=sentence):
        place_arm(name, load_arm("PSM"), camera(fov), depth)


def test_the_code_of_the_page_runs(capsys):
    code = "\n".join(re.findall(r"```python\n(.+?)```", PAGE.read_text(), re.S))
    exec(compile(code, str(PAGE), "exec"), {})
    assert capsys.readouterr().out == "\n".join(re.findall(r"# prints (.+)", code)) + "\n"
