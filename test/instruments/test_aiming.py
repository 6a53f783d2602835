"""Where instruments work, and the poses with which they do."""

import numpy as np
import pytest

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import aimed_pose, build_instrument, link_poses, load_arm, place_arm, solve_inverse, working_point
from endo_sim_ros.instruments.shapes import SHAPES
from endo_sim_ros.instruments.urdf import find_base, robot_description

CAMERA = Camera(intrinsic_matrix(560, 560, 320, 256), 640, 512)
TARGET = np.array([0.012, -0.008, 0.095])


@pytest.mark.parametrize("tool", SHAPES)
def test_the_jaws_are_around_the_target_and_the_shaft_comes_from_the_remote_centre(tool):
    arm = load_arm("PSM", tool)
    _, capsules = build_instrument(arm)
    placed = place_arm("PSM1", arm, CAMERA, 0.1)
    pose = aimed_pose(arm, placed.base, TARGET, working_point(arm, capsules))
    reach = solve_inverse(arm, np.linalg.inv(placed.base) @ pose, placed.joints)
    assert reach.reached and np.abs(reach.joints[3:]).max() < np.radians(5)  # straight, but for the bend of a hook or blade
    assert pose[2, 2] > 0.5  # jaws come from the camera's side
    links = {link: placed.base @ each for link, each in link_poses(arm, reach.joints, 0.6).items()}
    ends = {each.link: links[each.link][:3, :3] @ each.end + links[each.link][:3, 3] for each in capsules}  # of the last of each link
    if arm.jaw is None:
        np.testing.assert_allclose(ends["wrist_yaw"], TARGET, atol=1e-9)
        return
    left, right = ends["jaw_left"] - TARGET, ends["jaw_right"] - TARGET
    across = (left - right) / np.linalg.norm(left - right)
    assert left @ across > 1e-3 and right @ across < -1e-3
    length = SHAPES[tool].jaws.length
    assert 0.8 * length < np.linalg.norm(TARGET - pose[:3, 3]) < 0.95 * length  # from the hinge, which is the tip


def test_the_base_of_an_arm_is_read_from_the_robot_description():
    arm = load_arm("PSM", "LARGE_NEEDLE_DRIVER")
    base = place_arm("PSM2", arm, CAMERA, 0.1).base
    text = robot_description({"left/PSM2": (arm, base, ())})
    np.testing.assert_allclose(find_base(text, "left/PSM2"), base, atol=1e-9)
    assert find_base(text, "PSM1") is None
    with pytest.raises(ConfigError, match="the robot description cannot be read"):
        find_base("no xml", "PSM1")
