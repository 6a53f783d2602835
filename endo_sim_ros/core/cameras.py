"""Pinhole cameras and rigid poses.

Conventions: optical frames (x right, y down, z forward), poses are camera-to-world 4×4 matrices in metres,
quaternions are wxyz. Pixel (0, 0) has its centre at (0.5, 0.5), so that scaling an image scales its intrinsics.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.folders import naming

_MOST_BYTES = 64_000_000  # of a file of cameras; one takes 600
_LONGEST_SIDE = 65_535  # pixels


@dataclass(frozen=True)
class Camera:
    """A posed pinhole camera.

    Args:
        K: Intrinsic matrix [3, 3], pixels.
        width: Image width, pixels.
        height: Image height, pixels.
        pose: Camera-to-world transform [4, 4], metres, optical frame.

    Raises:
        ValueError: If K or the pose has a wrong shape, is not finite, or K has a focal length of zero or less.
    """

    K: np.ndarray
    width: int
    height: int
    pose: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))

    def __post_init__(self):
        K, pose = np.asarray(self.K, np.float64), np.asarray(self.pose, np.float64)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise ValueError(f"camera matrix K must be a finite 3×3 matrix, got {K.tolist() if K.shape == (3, 3) else K.shape}")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise ValueError(f"focal lengths must be positive, got fx={K[0, 0]:g}, fy={K[1, 1]:g}; is the camera calibrated?")
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"image size must be positive, got {self.width}×{self.height}")
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"camera pose must be a finite 4×4 matrix, got {pose.tolist() if pose.shape == (4, 4) else pose.shape}")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "pose", pose)

    @functools.cached_property
    def viewmat(self) -> np.ndarray:
        """World-to-camera transform [4, 4], which is kept."""
        return invert_pose(self.pose)

    @property
    def position(self) -> np.ndarray:
        """Optical centre in the world [3], metres."""
        return self.pose[:3, 3]

    def at(self, pose: np.ndarray) -> Camera:
        """The same camera at another camera-to-world pose [4, 4], metres."""
        return dataclasses.replace(self, pose=pose)

    def beside(self, distance: float) -> Camera:
        """The same camera to the right of this one, metres: the right eye beside a left one."""
        pose = self.pose.copy()
        pose[:3, 3] += distance * pose[:3, 0]
        return self.at(pose)

    def resized(self, width: int, height: int) -> Camera:
        """The camera that sees the same field of view in an image of width × height pixels."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return dataclasses.replace(self, K=scale @ self.K, width=width, height=height)

    def rays(self) -> np.ndarray:
        """Directions through every pixel centre with unit z, camera frame [H, W, 3]."""
        rays = np.ones((self.height, self.width, 3))
        rays[..., 0] = (np.arange(self.width) + 0.5 - self.K[0, 2]) / self.K[0, 0]
        rays[..., 1] = ((np.arange(self.height) + 0.5 - self.K[1, 2]) / self.K[1, 1])[:, None]
        return rays

    def backproject(self, depth: np.ndarray) -> np.ndarray:
        """World points [H, W, 3] of a depth image (z along the optical axis, metres) [H, W]."""
        points = self.rays() * depth[..., None]
        return points @ self.pose[:3, :3].T + self.pose[:3, 3]

    def unproject(self, uv: np.ndarray, z: np.ndarray) -> np.ndarray:
        """World points [N, 3] at pixels [N, 2] and depths [N] (z along the optical axis, metres)."""
        slopes = (uv - self.K[:2, 2]) / np.diag(self.K)[:2]
        return np.append(slopes, np.ones((len(slopes), 1)), 1) * z[:, None] @ self.pose[:3, :3].T + self.pose[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates [N, 2] and depths [N] of world points [N, 3]; points behind have depth <= 0."""
        local = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        z = local[:, 2]
        safe = np.where(np.abs(z) < 1e-12, 1e-12, z)
        uv = local[:, :2] / safe[:, None] * [self.K[0, 0], self.K[1, 1]] + self.K[:2, 2]
        return uv, z

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Which points [N, 3] (m, world) lie in the picture [N], hidden or not."""
        return self.contains(*self.project(points))

    def contains(self, uv: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Which points at pixels [N, 2] and depths [N] (m), as `project` gives them, lie in the picture [N]."""
        u, v = uv.T
        return (z > 0) & (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Intrinsics [3, 3] of focal lengths and a principal point, pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def focal_length_possible(K: np.ndarray, width: float, height: float) -> bool:
    """Whether both focal lengths of intrinsics [3, 3] or [3, 4] are between a hundredth and a hundred times a picture's longer side:
    lenses of endoscopes have half of it to twice as much."""
    return all(0.01 <= length / max(width, height) <= 100 for length in (K[0, 0], K[1, 1]))


def principal_point_inside(K: np.ndarray, width: float, height: float) -> bool:
    """Whether the principal point of intrinsics [3, 3] lies in the picture; else they are those of another one, or in other units."""
    return 0 <= K[0, 2] <= width and 0 <= K[1, 2] <= height


def rigid_pose(rotation: ArrayLike, position: ArrayLike) -> np.ndarray:
    """Rigid transform [4, 4] of a rotation [3, 3] and a position [3], metres."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def invert_pose(pose: np.ndarray) -> np.ndarray:
    """Inverses of rigid transforms [..., 4, 4]."""
    inverse = np.zeros(pose.shape)
    inverse[..., :3, :3] = np.swapaxes(pose[..., :3, :3], -1, -2)
    inverse[..., :3, 3] = -(inverse[..., :3, :3] @ pose[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1
    return inverse


def rotation_numbers(w: Any, x: Any, y: Any, z: Any) -> list:
    """The nine numbers of a rotation matrix, row by row, of those of a unit quaternion; arrays, or tensors, of each."""
    return [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip


def quat_to_matrix(quat: ArrayLike) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions wxyz [..., 4], which need not be normalised."""
    quat = np.asarray(quat, np.float64)
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    return np.stack(rotation_numbers(w, x, y, z), -1).reshape(quat.shape[:-1] + (3, 3))


def matrix_to_quat(matrix: ArrayLike) -> np.ndarray:
    """Quaternions wxyz [..., 4] with w >= 0 of rotation matrices [..., 3, 3] (Bar-Itzhack: exact for rotations, nearest otherwise)."""
    m = np.moveaxis(np.asarray(matrix, np.float64), (-2, -1), (0, 1))
    o = np.zeros(m.shape[2:])
    K = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], o, o, o],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], o, o],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], o],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m.trace()],
        ]
    )
    found = np.linalg.eigh(np.moveaxis(K, (0, 1), (-2, -1)) / 3.0)[1][..., -1]  # xyzw; eigh reads the lower triangle
    quats = np.roll(found, 1, -1)
    return np.where(quats[..., :1] < 0, -quats, quats)


def make_pose(position: ArrayLike, quat: ArrayLike) -> np.ndarray:
    """Rigid transform [4, 4] of a position [3], metres, and a quaternion wxyz [4], which need not be normalised."""
    return rigid_pose(quat_to_matrix(quat), position)


def sent_poses(poses: np.ndarray) -> np.ndarray:
    """Rigid transforms [..., 4, 4] as whoever receives them in messages has them: rotations travel as quaternions, in double precision."""
    received = poses.copy()
    received[..., :3, :3] = quat_to_matrix(matrix_to_quat(poses[..., :3, :3]))
    return received


def look_at(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, -1.0, 0.0)) -> np.ndarray:
    """Camera-to-world pose [4, 4] at a position [3] whose optical axis passes through a target [3]."""
    z = np.asarray(target, np.float64) - np.asarray(position, np.float64)
    z /= np.linalg.norm(z)
    x = np.cross(-np.asarray(up, np.float64), z)
    x /= np.linalg.norm(x)
    return rigid_pose(np.stack([x, np.cross(z, x), z], 1), position)


def slerp(q1: np.ndarray, q2: np.ndarray, alpha: float) -> np.ndarray:
    """Unit quaternion wxyz [4] at a fraction alpha of the shorter arc from one to another [4]."""
    q1, q2 = np.asarray(q1, np.float64), np.asarray(q2, np.float64)
    dot = float(q1 @ q2)
    if dot < 0:
        q2, dot = -q2, -dot
    if dot > 1 - 1e-9:
        mixed = (1 - alpha) * q1 + alpha * q2
        return mixed / np.linalg.norm(mixed)
    angle = np.arccos(dot)
    return (np.sin((1 - alpha) * angle) * q1 + np.sin(alpha * angle) * q2) / np.sin(angle)


def interpolate_pose(pose1: np.ndarray, pose2: np.ndarray, alpha: float) -> np.ndarray:
    """Pose [4, 4] at a fraction alpha of the way between two: slerp of rotations, lerp of translations (paper eq. 7)."""
    quat = slerp(matrix_to_quat(pose1[:3, :3]), matrix_to_quat(pose2[:3, :3]), alpha)
    return make_pose((1 - alpha) * pose1[:3, 3] + alpha * pose2[:3, 3], quat)


def save_cameras(cameras: Sequence[Camera], path: str | Path) -> None:
    """Write cameras as JSON: a list of K, width, height and camera-to-world pose."""
    entries = [{"K": c.K.tolist(), "width": c.width, "height": c.height, "pose": c.pose.tolist()} for c in cameras]
    with naming(Path(path)):
        Path(path).write_text(json.dumps(entries, indent=1))


def load_cameras(path: str | Path) -> list[Camera]:
    """Read what `save_cameras` wrote.

    Raises:
        ValueError: If the file holds something else; the message names it.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes, far more than cameras need")
        entries = json.loads(path.read_text())
        if not isinstance(entries, list):
            raise ValueError(f"expected a list, got {type(entries).__name__}")
        cameras = [Camera(np.array(e["K"]), int(e["width"]), int(e["height"]), np.array(e["pose"])) for e in entries]
        for camera in cameras:
            R = camera.pose[:3, :3]
            if max(camera.width, camera.height) > _LONGEST_SIDE or not np.allclose(R @ R.T, np.eye(3), atol=1e-3):
                raise ValueError(f"no camera has {camera.width}×{camera.height} pixels and the rotation {R.round(3).tolist()}")
        return cameras
    except (OSError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path}: not a readable list of cameras ({error})") from error


def parse_frames(world_frame: str, frames: Iterable[str]) -> dict[str, np.ndarray]:
    """Poses [4, 4] in the world, metres, by name, of frames given as ``name x y z qx qy qz qw`` and of the world itself.

    Raises:
        ValueError: If a frame is not a name and a pose with a unit quaternion.
    """
    poses = {world_frame.lstrip("/"): np.eye(4)}
    for text in filter(None, frames):
        name, *numbers = text.split() or [""]
        try:
            x, y, z, qx, qy, qz, qw = map(float, numbers)
        except ValueError:
            raise ValueError(f"frames: {text!r} is not a name and seven numbers, as in 'PSM1_base 0.1 0 0 0 0 0 1'") from None
        position, quat = np.array([x, y, z]), np.array([qw, qx, qy, qz])
        if not np.isfinite(position).all() or not abs(np.linalg.norm(quat) - 1) < 0.01:
            raise ValueError(f"frames: {text!r} has no finite position and unit quaternion (x y z qx qy qz qw)")
        poses[name.lstrip("/")] = make_pose(position, quat)
    return poses
