"""Where tissue tears: across the direction in which it is stretched beyond what it bears."""

import numpy as np

SIDE = 2.5  # cells of the grid; smaller tears do not join, and leave crumbs


class Tearing:
    """Cuts tissue where its largest principal true strain, the logarithm of the stretch, is above a limit.

    A tear is a square through a node at rest, across the stretch there (O'Brien and Hodgins 1999). In each step the most strained node
    tears, so that a tear grows from its ends as the tissue beside it relaxes. Nodes within half a side of a tear tear no more.

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
        self.newest: tuple[np.ndarray, float, float] | None = None  # where at rest [3], m, world, the true strain there, and the limit
        self._spent = np.zeros(len(self._rest), bool)  # nodes that tear no more

    def copy(self, other: "Tearing") -> None:
        """Take over the tears of other tissue with the same nodes."""
        self.count, self.newest, self._spent = other.count, other.newest, other._spent.copy()

    def tear(self, F: np.ndarray) -> np.ndarray:
        """Triangles [T, 3, 3], m, world, at rest, along which tissue with deformation gradients F [M, 3, 3] tears now: two or none."""
        C = np.einsum("mji,mjk->mik", F, F, dtype=np.float64)
        mean = np.trace(C, axis1=1, axis2=2) / 3
        spread = np.sqrt(np.maximum((C**2).sum((1, 2)) - 3 * mean**2, 0) * 2 / 3)
        able = np.flatnonzero(~self._spent & (mean + spread > np.exp(2 * self._limit)))  # no eigenvalue of C is above that
        values, axes = np.linalg.eigh(C[able])
        strains = 0.5 * np.log(values[:, 2])
        if not len(able) or strains.max() <= self._limit:
            return np.zeros((0, 3, 3))
        k = int(strains.argmax())
        at, (a, b) = self._rest[able[k]], self._side / 2 * axes[k, :, :2].T
        self._spent |= np.linalg.norm(self._rest - at, axis=1) <= self._side / 2
        self.count += 1
        self.newest = at, float(strains[k]), self._limit
        return (at + np.stack([-a - b, a - b, a + b, b - a]))[[[0, 1, 2], [0, 2, 3]]]
