"""Values that are smooth between scattered places, fitted to what is known near each."""

import numpy as np
from scipy.spatial import KDTree

_NEAR = 60  # places between which another is interpolated: the noise of a share of a motion is a quarter, what motion bends is seen
_LEVEL = 0.02  # weight, of that of a place, of no slope and no bend between them, which counts where they lie in a row
_PART = 10_000  # places interpolated at a time: a hundred megabytes


def smoothed(places: np.ndarray, values: np.ndarray, certain: np.ndarray) -> np.ndarray:
    """Values [N] as those near their places [N, D] tell them, each the more, the more certain it is [N]: 1 / variance."""
    return interpolated_between(places, values[:, None], places, certain)[:, 0, 0]


def interpolated_between(places: np.ndarray, values: np.ndarray, at: np.ndarray, certain: np.ndarray | None = None) -> np.ndarray:
    """Values at others than the places [N, D] where they are known [N, C], and their slopes [M, C, 1 + D].

    Quadratic in what is near, and never beyond it.
    """
    tree, certain = KDTree(places), np.ones(len(places)) if certain is None else certain
    parts = [_fitted(tree, values, certain, at[i : i + _PART]) for i in range(0, len(at), _PART)]
    return np.concatenate([np.zeros((0, values.shape[1], 1 + at.shape[1])), *parts])


def _fitted(tree: KDTree, values: np.ndarray, certain: np.ndarray, at: np.ndarray) -> np.ndarray:
    """As `interpolated_between`, of all places at once; the tree has those that are known."""
    near, axes = min(_NEAR, tree.n), tree.m
    distances, indices = (x.reshape(len(at), near) for x in tree.query(at, k=near))
    reach = distances[:, -1:].clip(1e-12)
    weights = (1 - (distances / reach) ** 2) ** 2 + 1e-3  # none leaves with a jump
    weights *= certain[indices] / certain[indices].mean(1, keepdims=True)
    apart = (tree.data[indices] - at[:, None]) / reach[..., None]
    first, second = np.triu_indices(axes)
    apart = np.concatenate([np.ones((len(at), near, 1)), apart, apart[..., first] * apart[..., second]], -1)
    weighted = weights[..., None] * apart
    normal = weighted.swapaxes(1, 2) @ apart + np.diag(np.r_[0.0, np.full(apart.shape[2] - 1, _LEVEL)])
    known = values[indices]
    found = np.linalg.solve(normal, weighted.swapaxes(1, 2) @ known)[:, : 1 + axes].swapaxes(1, 2)
    level = found[..., 0].clip(known.min(1), known.max(1))
    slopes = np.where((level == found[..., 0])[..., None], found[..., 1:] / reach[..., None], 0)  # at a bound they are level
    return np.concatenate([level[..., None], slopes], -1)
