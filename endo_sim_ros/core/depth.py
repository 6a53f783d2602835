"""Depth images with holes."""

from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt


def fill_depth(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Depth [H, W] (0 = none) with that of the nearest pixel that has any in its holes, the distance from it [H, W], pixels, and its rows
    and columns [H, W]."""
    found: Any = distance_transform_edt(depth <= 0, return_indices=True)
    distance, (rows, columns) = found
    return depth[rows, columns], distance, (rows, columns)
