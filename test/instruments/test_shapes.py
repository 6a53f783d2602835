"""The shapes of instruments: closed, hinged where the kinematics says, and alike as triangles and as capsules."""

from dataclasses import replace

import numpy as np
import pytest

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import build_instrument, link_poses, load_arm
from endo_sim_ros.instruments.shapes import SHAPES

JOINTS = np.array([0.1, -0.2, 0.12, 0.7, 0.4, -0.3])


@pytest.fixture(params=SHAPES)
def arm(request):
    return load_arm("PSM", request.param)


def of_link(pieces, link):
    return [piece for piece in pieces if piece.link == link]


def test_every_part_is_closed_and_faces_outwards(arm):
    parts, _ = build_instrument(arm)
    assert 2000 < sum(len(part.faces) for part in parts) < 8000
    for part in parts:
        edges = {(int(a), int(b)) for face in part.faces for a, b in zip(face, np.roll(face, -1))}
        assert len(edges) == 3 * len(part.faces)
        assert {(b, a) for a, b in edges} == edges
        corners = part.vertices[part.faces].astype(float)
        assert np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0


@pytest.mark.parametrize("link, following", [("roll", "wrist_pitch"), ("wrist_pitch", "wrist_yaw")])
def test_links_turn_about_the_pins_of_those_before_them(arm, link, following):
    parts, _ = build_instrument(arm)
    poses = link_poses(arm, JOINTS)
    in_following = np.linalg.inv(poses[following]) @ poses[link]
    moved = [part.vertices @ in_following[:3, :3].T + in_following[:3, 3] for part in of_link(parts, link)]
    pins = [vertices for vertices in moved if np.abs(vertices[:, :2]).max() < 1.5e-3 and np.ptp(vertices[:, 2]) > 4e-3]
    assert len(pins) == 1
    np.testing.assert_allclose(pins[0].mean(0), 0, atol=1e-6)


def test_the_link_of_the_yaw_is_seen_of_hooks_alone(arm):
    """As pages and datasets tell of its label."""
    parts, _ = build_instrument(arm)
    assert bool(of_link(parts, "wrist_yaw")) == (SHAPES[arm.tool.rsplit("_", 1)[0]].hook is not None)


@pytest.mark.parametrize("arm", [name for name, shape in SHAPES.items() if shape.jaws and not shape.jaws.blade], indirect=True)
def test_closed_jaws_meet_and_open_by_the_angle_between_them(arm):
    parts, _ = build_instrument(arm)

    def jaw(side, angle):
        poses = link_poses(arm, JOINTS, angle)
        in_wrist = np.linalg.inv(poses["wrist_yaw"]) @ poses[f"jaw_{side}"]
        beams = [part.vertices for part in of_link(parts, f"jaw_{side}") if part.vertices[:, 1].max() > 5e-3]
        return np.concatenate(beams) @ in_wrist[:3, :3].T + in_wrist[:3, 3]

    assert jaw("left", 0.0)[:, 0].min() == pytest.approx(0, abs=1e-7) == -jaw("right", 0.0)[:, 0].max()
    faces = [jaw(side, 0.8)[np.argsort(jaw(side, 0.0)[:, 1])[-3:]].mean(0) for side in ("left", "right")]
    length = SHAPES[arm.tool.rsplit("_", 1)[0]].jaws.length
    assert faces[0][0] - faces[1][0] == pytest.approx(2 * length * np.sin(0.4), abs=2.5e-3)


def test_capsules_are_where_the_triangles_are(arm):
    parts, capsules = build_instrument(arm)
    for link in {capsule.link for capsule in capsules}:
        vertices = np.concatenate([part.vertices for part in of_link(parts, link)])
        outside = []
        for capsule in of_link(capsules, link):
            way = capsule.end - capsule.start
            share = ((vertices - capsule.start) @ way / (way @ way)).clip(0, 1)
            outside.append(np.linalg.norm(vertices - capsule.start - share[:, None] * way, axis=1) - capsule.radius)
            assert np.abs(outside[-1]).min() < 0.5e-3
        # The clevis at the end of the shaft is not in a capsule: the wrist's is there.
        near = np.min(outside, 0) if link != "roll" else np.min(outside, 0)[vertices[:, 2] < -9e-3]
        assert near.max() < 2.2e-3


def test_an_arm_of_many_positions_has_as_many_poses():
    arm = load_arm("PSM", "LARGE_NEEDLE_DRIVER")
    many = link_poses(arm, np.stack([JOINTS, 0.5 * JOINTS]), [0.2, 0.9])
    for i, one in enumerate((link_poses(arm, JOINTS, 0.2), link_poses(arm, 0.5 * JOINTS, 0.9))):
        for link, pose in one.items():
            np.testing.assert_allclose(many[link][i], pose, atol=1e-15)


def test_own_files_may_name_joints_as_they_like():
    arm = load_arm("PSM", "LARGE_NEEDLE_DRIVER")
    other = replace(arm, joints=tuple(replace(joint, name=f"outer_{joint.name}") for joint in arm.joints))
    parts, _ = build_instrument(other)
    assert {part.link for part in parts} <= link_poses(other, JOINTS).keys() == link_poses(arm, JOINTS).keys()


def test_what_has_no_shape_is_refused():
    with pytest.raises(ConfigError, match="ECM with ENDOSCOPE_UP has no wrist"):
        build_instrument(load_arm("ECM", "ENDOSCOPE_UP"))
