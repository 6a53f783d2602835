"""Camera poses in files: text with one pose a line, and matrices that are rigid up to rounding."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.cameras import quat_to_matrix, rigid_pose
from endo_sim_ros.core.frames import SequenceError


def read_poses(path: Path, scale: float = 1.0) -> dict[int, np.ndarray]:
    """Camera-to-world poses [4, 4] by frame number, from lines `frame tx ty tz qx qy qz qw`; # begins a comment.

    Args:
        path: The file.
        scale: Metres per unit of its positions.

    One that is not finite, or whose quaternion is no unit, is NaN: `keep_posed` refuses it where its frame is asked for.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows begin a file with a mark
    except FileNotFoundError:
        raise SequenceError(f"{path}: file is missing") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path}: not a readable text file ({error})") from None
    lines = text.replace(",", " ").splitlines()
    if lines and not any(map(_are_numbers, _content(lines[0]).split())):
        lines[0] = ""  # a heading
    line_of = lambda row: [count for count, line in enumerate(lines, 1) if _content(line)][row]
    if not any(map(_content, lines)):
        raise SequenceError(f"{path}: holds no poses; expected lines `frame tx ty tz qx qy qz qw`")
    try:
        table = np.loadtxt(lines, ndmin=2)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape[1] != 8:
        raise _malformed(path, lines)
    positions, quats = scale * table[:, 1:4], table[:, [7, 4, 5, 6]]
    with np.errstate(invalid="ignore"):
        whole = (table[:, 0] >= 0) & (table[:, 0] < 2**53) & (table[:, 0] % 1 == 0)
        good = np.isfinite(table).all(1) & (np.abs(np.linalg.norm(quats, axis=1) - 1) <= 0.05)
    if not whole.all():
        row = int(np.argmin(whole))
        number = line_of(row)
        said = _content(lines[number - 1]).split()[0]
        raise SequenceError(f"{path}: line {number} is not a pose; expected a whole frame number first, got {said}, which may be a time")
    numbers, first = np.unique(table[:, 0], return_index=True)
    if len(numbers) < len(table):
        row = int(np.setdiff1d(np.arange(len(table)), first)[0])
        raise SequenceError(f"{path}: line {line_of(row)} repeats frame {int(table[row, 0])}; keep one pose per frame")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = quat_to_matrix(np.where(good[:, None], quats, np.nan)), positions
    return dict(zip(table[:, 0].astype(int).tolist(), poses))


def _content(line: str) -> str:
    """A line without its comment."""
    return line.split("#")[0].strip()


def _are_numbers(line: str) -> bool:
    try:
        list(map(float, _content(line).split()))
    except ValueError:
        return False
    return True


def _malformed(path: Path, lines: list[str]) -> SequenceError:
    """What is wrong with the first line that is not eight numbers."""
    for count, line in enumerate(lines, 1):
        if not _are_numbers(line):
            return SequenceError(f"{path}: line {count} is not made of numbers: {line.strip()!r}")
        if len(_content(line).split()) not in (0, 8):
            found = len(_content(line).split())
            return SequenceError(f"{path}: line {count} has {found} numbers, expected 8: frame tx ty tz qx qy qz qw")
    return SequenceError(f"{path}: not made of numbers as 1.5 or -2e-3")


def rigid(matrix: ArrayLike, source: str) -> np.ndarray:
    """A rigid transform [4, 4] from one that is rigid up to rounding; its rotation is made exact."""
    try:
        values = np.asarray(matrix, np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (4, 4) or not np.isfinite(values).all():
        got = "one that is not finite" if values.shape == (4, 4) else f"shape {values.shape}"
        raise SequenceError(f"{source}: expected a finite 4×4 matrix, got {got}")
    u, singular, vt = np.linalg.svd(values[:3, :3])
    if np.abs(singular - 1).max() > 0.02 or np.linalg.det(u @ vt) < 0:
        raise SequenceError(f"{source}: its 3×3 block is not a rotation (singular values {singular.round(3).tolist()})")
    return rigid_pose(u @ vt, values[:3, 3])
