"""Folders whose poses were written by another convention."""

import cv2
import numpy as np
import pytest
from plane_scene import write_poses
from thorough import mostly_thorough

from endo_sim_ros.core.cameras import invert_pose, matrix_to_quat, rigid_pose
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences import misread_poses
from endo_sim_ros.sequences.folder import read_folder
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

XYZW, WXYZ = [1, 2, 3, 0], [0, 1, 2, 3]
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
FORWARD_LEFT_UP = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # columns: these in optical axes
FLIP_X, FLIP_Z = np.diag([-1.0, 1.0, 1.0, 1.0]), np.diag([1.0, 1.0, -1.0, 1.0])
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
same = lambda pose: pose


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A folder of images without poses, and the poses."""
    root = tmp_path_factory.mktemp("recording")
    (root / "left").mkdir()
    frames = list(phantom_sequence(PhantomConfig(width=320, height=256, frames=6, travel=0.02, stereo=False)))
    for number, frame in enumerate(frames):
        cv2.imwrite(str(root / f"left/{number}.png"), frame.image[..., ::-1])
    K = frames[0].camera.K
    (root / "calibration.yaml").write_text(f"fx: {K[0, 0]}\nfy: {K[1, 1]}\ncx: {K[0, 2]}\ncy: {K[1, 2]}\n")
    return root, [frame.camera.pose for frame in frames]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("written", "order", "sentence"),
    mostly_thorough(
        [
            (same, XYZW, ""),
            (invert_pose, XYZW, "were world-to-camera: .* px if poses are read so; invert each, or pass poses=sfm"),
            (
                lambda pose: MIRROR @ pose @ MIRROR,
                XYZW,
                "were left-handed with y up, as in Unity: .*; negate the ty, qx and qz of each, or",
            ),
            (same, WXYZ, "had quaternions in the order qw qx qy qz: .*; write them as qx qy qz qw, or"),
            (invert_pose, WXYZ, "were world-to-camera, with quaternions in the order qw qx qy qz: .*, and invert each pose, or"),
            (
                lambda pose: rigid_pose(pose[:3, :3].T, pose[:3, 3]),
                XYZW,
                "had rotations from the world to the camera beside .*; transpose their",
            ),
            (
                lambda pose: invert_pose(pose @ OPENGL),
                XYZW,
                "were world-to-camera, of a camera with y up that looks along -z: .*; invert each",
            ),
            (lambda pose: pose @ OPENGL, XYZW, "were of a camera with y up that looks along -z, as in OpenGL: .*; turn each"),
            (lambda pose: pose @ FORWARD_LEFT_UP, XYZW, "were of a camera that looks along x with z up, as bodies in ROS: .*; take those"),
            (lambda pose: FLIP_X @ pose @ FLIP_X, XYZW, "were mirrored along x: .*; negate the tx, qy and qz of each, or"),
            (lambda pose: FLIP_Z @ pose @ FLIP_Z, XYZW, "were mirrored along z: .*; negate the tz, qx and qy of each, or"),
            (
                lambda pose: MIRROR @ pose @ FORWARD_LEFT_UP @ MIRROR,
                XYZW,
                "were left-handed, of a camera that looks along x with z up, as in Unreal: .*; negate the ty, qx and qz of each, and take",
            ),
            (lambda pose: pose[[1, 2, 0, 3]][:, [2, 0, 1, 3]], XYZW, ""),  # what is wrong with these none of them explains
        ],
        4,
    ),
)
def test_poses_by_another_convention_are_refused_by_its_name(recording, caplog, written, order, sentence):
    root, poses = recording
    lines = []
    for number, pose in enumerate(map(written, poses)):
        lines.append(" ".join(map(str, [number, *pose[:3, 3], *matrix_to_quat(pose[:3, :3])[order]])))
    (root / "poses_left.txt").write_text("\n".join(lines))
    if not sentence:
        assert len(read_folder(root)) == len(poses)
        assert ("its poses do not fit the images: features of" in caplog.text) == (written is not same)
        return
    with pytest.raises(SequenceError, match=f"poses_left.txt: its poses do not fit the images, but would if they {sentence}"):
        read_folder(root)


@pytest.mark.slow
def test_matches_that_agree_with_no_geometry_do_not_judge_poses(recording, caplog, monkeypatch):
    root, poses = recording
    rng = np.random.default_rng(0)
    monkeypatch.setattr(misread_poses, "match_pair", lambda *_: (rng.uniform(0, 256, (40, 2)), rng.uniform(0, 256, (40, 2))))
    write_poses(root / "poses_left.txt", dict(enumerate(poses)))
    assert len(read_folder(root)) == len(poses)
    assert "do not fit the images" not in caplog.text
