"""The control nodes nearest to points, and compact weights with which points follow them (in place of those of paper eq. 9)."""

from typing import Any

import numpy as np
from scipy.spatial import KDTree


def nearest_nodes(rest: np.ndarray, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [N, count] of points [N, 3] to their nearest control nodes [M, 3], m, nearest first, and the numbers of these.

    Where there are fewer, distances are infinite and numbers are M.
    """
    ranks: Any = list(range(1, count + 1))  # a list gives a column for a count of one, too
    distances, index = KDTree(rest).query(points, k=ranks, workers=-1)
    return np.asarray(distances), np.asarray(index)


def compact_weights(d: np.ndarray, beyond: np.ndarray, kept: np.ndarray | bool = True) -> np.ndarray:
    """Return (1 − (d/d_{K+1})²)², normalised: the weight of a control node falls smoothly to zero where it is no longer among the nearest.

    Args:
        d: Distances to the nearest control nodes [N, K], m.
        beyond: Distance to the next one, d_{K+1} [N, 1]; [N, 0] or infinite where there is none. Equidistant control nodes share evenly.
        kept: Which count [N, K]; the others get zero.
    """
    if not beyond.shape[1]:
        beyond = np.full((len(d), 1), np.inf)
    weights = np.where(kept, np.maximum(1 - (d / np.maximum(beyond, 1e-30)) ** 2, 1e-6) ** 2, 0)
    return weights / np.maximum(weights.sum(1, keepdims=True), 1e-30)
