"""The robot description says where the links are, as the kinematics does."""

from xml.etree import ElementTree

import numpy as np
import pytest
from urdf_links import matrix, poses_of_links

from endo_sim_ros.core.cameras import make_pose
from endo_sim_ros.instruments import build_instrument, link_poses, load_arm
from endo_sim_ros.instruments.urdf import arm_capsules, robot_description

BASE = make_pose([0.1, -0.2, 0.3], [0.5, 0.1, -0.7, 0.3])


@pytest.mark.parametrize("model, tool", [
    ("PSM", "LARGE_NEEDLE_DRIVER"), ("PSM_Si", "PERMANENT_CAUTERY_HOOK"), ("ECM", "ENDOSCOPE_UP"),
])  # fmt: skip
def test_links_are_where_the_kinematics_has_them(model, tool):
    arm, random = load_arm(model, tool), np.random.default_rng(3)
    text = robot_description({"left/A": (arm, BASE, arm_capsules(arm))}, "map")
    for _ in range(5):
        joints, jaw = random.uniform(arm.lower, arm.upper), 0.6
        positions = {f"left_A_{joint.name}": value for joint, value in zip(arm.joints, joints)} | {"left_A_jaw": jaw}
        robot, found = poses_of_links(text, positions, "map")
        np.testing.assert_allclose(found["left_A_tip"], BASE @ arm.tip_pose(joints), atol=1e-9)
        for joint, frame in zip(arm.joints, arm.link_frames(joints)):
            np.testing.assert_allclose(found[f"left_A_{joint.name}"], BASE @ frame, atol=1e-9)
        if arm.jaw:
            for name in ("jaw_left", "jaw_right"):
                np.testing.assert_allclose(found[f"left_A_{name}"], BASE @ link_poses(arm, joints, jaw)[name], atol=1e-9)
    limits = {
        j.get("name"): (float(j.find("limit").get("lower")), float(j.find("limit").get("upper"))) for j in robot.findall("joint[limit]")
    }
    for joint in arm.joints:
        assert limits[f"left_A_{joint.name}"] == pytest.approx((joint.lower, joint.upper))


def test_shapes_are_the_capsules_of_the_instrument():
    arm = load_arm("PSM", "PROGRASP_FORCEPS")
    robot = ElementTree.fromstring(robot_description({"PSM1": (arm, np.eye(4), arm_capsules(arm))}))
    _, capsules = build_instrument(arm)
    assert len(robot.findall("link/visual")) == len(capsules)
    for capsule in capsules:
        ends = []
        for visual in robot.findall(f"link[@name='PSM1_{capsule.link}']/visual"):
            pose, shape = matrix(visual.find("origin")), visual.find("geometry/cylinder")
            half = 0.5 * float(shape.get("length")) * pose[:3, 2]
            ends.append(np.concatenate([pose[:3, 3] - half, pose[:3, 3] + half, [float(shape.get("radius"))]]))
        wanted = np.concatenate([capsule.start, capsule.end, [capsule.radius]])
        assert min(np.abs(end - wanted).max() for end in ends) < 1e-6
