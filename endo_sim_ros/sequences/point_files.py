"""Scene points in files: text with one point a line, beside the images of a folder or in a bag."""

import warnings
from pathlib import Path

import numpy as np

from endo_sim_ros.core.frames import SequenceError

_POINTS_FILE = "points.txt"


def read_points(path: Path | str, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray] | None:
    """Scene points [N, 3] (m, world) and their RGB [N, 3] in [0, 1] of a folder of images or a bag; None if it has none.

    Args:
        path: The folder or bag.
        scale: Metres per unit of the file.

    Raises:
        SequenceError: If they cannot be read.
    """
    root = Path(path)
    file = root / _POINTS_FILE
    if not file.is_file():
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy's, of a file without lines
            values = np.loadtxt(file, usecols=range(6), ndmin=2, encoding="utf-8-sig")
    except (ValueError, IndexError, OSError) as error:
        reason = next(iter(str(error).splitlines()), "")
        raise SequenceError(f"{file}: not lines of x y z r g b ({reason}); correct or remove it") from None
    if not len(values) or not np.isfinite(values).all() or values[:, 3:].min() < 0 or values[:, 3:].max() > 255:
        raise SequenceError(f"{file}: expected finite x y z and colours r g b from 0 to 255; correct or remove it")
    return scale * values[:, :3], values[:, 3:] / 255


def write_points(path: Path | str, points: np.ndarray, colors: np.ndarray) -> None:
    """Write scene points [N, 3] (m, world) and their RGB [N, 3] in [0, 1] into a folder of images or a bag."""
    np.savetxt(Path(path) / _POINTS_FILE, np.column_stack([points, np.round(255 * colors)]), "%.7g", header="x y z r g b")
