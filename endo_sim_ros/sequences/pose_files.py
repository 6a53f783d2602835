"""Camera poses in files: text with one pose a line, and matrices that are rigid up to rounding."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.cameras import make_pose
from endo_sim_ros.core.frames import SequenceError


def read_poses(path: Path) -> dict[int, np.ndarray]:
    """Camera-to-world poses [4, 4] by frame number, from lines `frame tx ty tz qx qy qz qw`; # begins a comment."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SequenceError(f"{path}: file is missing") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path}: not a readable text file ({error})") from None
    poses: dict[int, np.ndarray] = {}
    for count, raw_line in enumerate(text.splitlines(), 1):
        line = raw_line.split("#")[0].replace(",", " ")
        if not line.strip():
            continue
        try:
            values = np.array([float(word) for word in line.split()])
        except ValueError:
            if not poses and count == 1:
                continue  # a heading
            raise SequenceError(f"{path}: line {count} is not made of numbers: {raw_line.strip()!r}") from None
        if len(values) != 8:
            raise SequenceError(f"{path}: line {count} has {len(values)} numbers, expected 8: frame tx ty tz qx qy qz qw")
        number, position, quat = int(values[0]) if np.isfinite(values[0]) else -1, values[1:4], values[[7, 4, 5, 6]]
        if not np.isfinite(values).all() or abs(np.linalg.norm(quat) - 1) > 0.05 or number != values[0] or number < 0:
            raise SequenceError(
                f"{path}: line {count} is not a pose; expected a whole frame number, a finite position and a unit "
                f"quaternion, got {raw_line.strip()!r}"
            )
        if number in poses:
            raise SequenceError(f"{path}: line {count} repeats frame {number}; keep one pose per frame")
        poses[number] = make_pose(position, quat)
    if not poses:
        raise SequenceError(f"{path}: holds no poses; expected lines `frame tx ty tz qx qy qz qw`")
    return poses


def rigid(matrix: ArrayLike, source: str) -> np.ndarray:
    """A rigid transform [4, 4] from one that is rigid up to rounding; its rotation is made exact."""
    try:
        values = np.asarray(matrix, np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (4, 4) or not np.isfinite(values).all():
        raise SequenceError(f"{source}: expected a finite 4×4 matrix, got shape {values.shape}")
    u, singular, vt = np.linalg.svd(values[:3, :3])
    if np.abs(singular - 1).max() > 0.02 or np.linalg.det(u @ vt) < 0:
        raise SequenceError(f"{source}: its 3×3 block is not a rotation (singular values {singular.round(3).tolist()})")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ vt, values[:3, 3]
    return pose
