"""Where tissue tears: across the direction in which it is stretched beyond what it bears."""

import math

import numpy as np
import torch
from torch import Tensor

SIDE = 2.5  # cells of the grid; smaller tears do not join, and leave crumbs
_ROUNDED = 1e-5  # share by which single precision may be off
_TOUGHER = 1.5  # times as much strain is borne beside each tear


def may_tear(F: Tensor, limit: float) -> Tensor:
    """Of which tissues [B], by their deformation gradients F [B, M, 3, 3], a node may be strained beyond a limit; of the others none is."""
    x, y, z = F.unbind(-1)  # as many products as C = Fᵀ F has entries; of tiny matrices they take a third of the time
    dot = lambda a, b: (a * b).sum(-1)
    across = torch.stack([dot(x, x), dot(y, y), dot(z, z)])
    mean, aside = across.mean(0), dot(x, y) ** 2 + dot(x, z) ** 2 + dot(y, z) ** 2
    spread = ((across - mean).square().sum(0) + 2 * aside).mul(2 / 3).sqrt()
    return (mean + spread > math.exp(2 * limit) * (1 - _ROUNDED)).any(1)  # no eigenvalue of C is above that


class Tearing:
    """Cuts tissue where its largest principal true strain, the logarithm of the stretch, is above a limit.

    A tear is a square at rest, across the stretch of a node (O'Brien and Hodgins 1999) and halfway to the nodes behind it. In each step
    the node that is farthest beyond what it bears tears, so that a tear grows from its ends as the tissue beside it relaxes. Nodes within
    half a side of a tear, which it may not have parted, bear more from then on: else what the grid still stretches there would tear to
    crumbs.

    Args:
        rest: Nodes at rest [M, 3], m, world.
        limit: True strain that the tissue bears.
        cell: Side of a cell of the grid, m.
    """

    def __init__(self, rest: np.ndarray, limit: float, cell: float):
        self._rest, self._limit, self._side = np.asarray(rest, np.float64), limit, SIDE * cell
        self.reset()

    def reset(self) -> None:
        """Forget all tears."""
        self.count = 0
        self.triangles: list[int] = []  # their numbers among those of all cuts, which who cuts along them adds
        self.newest: tuple[np.ndarray, float, float] | None = None  # where at rest [3], m, world, the true strain there, and the limit
        self._tougher = np.ones(len(self._rest))  # how many times the limit each node bears

    def copy(self, other: "Tearing") -> None:
        """Take over the tears of other tissue with the same nodes."""
        self.count, self.newest, self._tougher = other.count, other.newest, other._tougher.copy()
        self.triangles = other.triangles.copy()

    def tear(self, F: np.ndarray) -> np.ndarray:
        """Triangles [T, 3, 3], m, world, at rest, along which tissue with deformation gradients F [M, 3, 3] tears now: two or none."""
        limits = self._limit * self._tougher
        C = np.einsum("mji,mjk->mik", F, F, dtype=np.float64)
        mean = np.trace(C, axis1=1, axis2=2) / 3
        spread = np.sqrt(np.maximum((C**2).sum((1, 2)) - 3 * mean**2, 0) * 2 / 3)
        able = np.flatnonzero(mean + spread > np.exp(2 * limits))  # no eigenvalue of C is above that
        values, axes = np.linalg.eigh(C[able])
        strains = 0.5 * np.log(values[:, 2])
        beyond = strains - limits[able]
        if not len(able) or beyond.max() <= 0:
            return np.zeros((0, 3, 3))
        k = int(beyond.argmax())
        at, (a, b) = self._rest[able[k]], self._side / 2 * axes[k, :, :2].T
        near = np.linalg.norm(self._rest - at, axis=1) <= self._side / 2
        self.newest = at, float(strains[k]), self._limit
        self._tougher[near] *= _TOUGHER
        self.count += 1
        # Between the node and those behind it: through a node of the skin itself it would part nothing from nothing.
        heights = (self._rest[near] - at) @ axes[k, :, 2]
        heights = heights[np.abs(heights) > self._side / 10]
        behind = np.sign(np.sign(heights).sum()) or 1.0  # where most of them are
        at = at + behind * (behind * heights)[behind * heights > 0].min(initial=self._side / 2) / 2 * axes[k, :, 2]
        return (at + np.stack([-a - b, a - b, a + b, b - a]))[[[0, 1, 2], [0, 2, 3]]]
