"""Stencils: which grid nodes the control nodes transfer to, for rest kinematics."""

import functools
from dataclasses import dataclass

import numpy as np

STENCIL = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(27, 3)
"""Steps from the first grid node of a stencil to all of them, k fastest."""


@dataclass(frozen=True)
class CutTable:
    """Stencils of the nodes that use a copy of a grid node; all other nodes keep the regular ones.

    The grid then has G + extra nodes: G = nx·ny·nz regular ones, then the copies.
    """

    affected: np.ndarray  # nodes, ascending [A], int32
    base: np.ndarray  # first grid node (i, j, k) of their stencils [A, 3], int32; the weights go by it
    table: np.ndarray  # grid nodes of their stencils [A, 27], int32, those of (i, j, k) at 9 i + 3 j + k
    extra: int


class Stencils:
    """The 3 × 3 × 3 grid nodes around each of M control nodes at rest, and copies of them beside cuts.

    Args:
        rest_cells: Control nodes at rest [M, 3], in cells of the grid from its corner.
        shape: Grid nodes (nx, ny, nz).
        cut: Stencils that use a copy of a grid node; None = there is no cut.
    """

    def __init__(self, rest_cells: np.ndarray, shape: tuple[int, int, int], cut: CutTable | None = None):
        self.rest_cells, self.shape = rest_cells, shape
        # First grid node (i, j, k) of each stencil [M, 3].
        self.first = np.floor(rest_cells - 0.5).astype(np.int64).clip(0, np.array(shape) - 3)
        self.row = np.full(len(rest_cells), -1)  # in the table, of control nodes beside a cut; -1 for all others [M]
        self.table = np.zeros((0, 27), int)  # numbers of their grid nodes [A, 27]
        self.grid_count = int(np.prod(shape))  # of grid nodes with their copies
        if cut is not None:
            self.first[cut.affected], self.row[cut.affected] = cut.base, np.arange(len(cut.affected))
            self.table = cut.table
            self.grid_count += cut.extra

    def corners(self) -> np.ndarray:
        """Numbers of each control node's grid nodes [M, 27]."""
        corners = np.asarray(np.ravel_multi_index(tuple(np.moveaxis(self.first[:, None] + STENCIL, -1, 0)), self.shape))
        corners[self.row >= 0] = self.table[self.row[self.row >= 0]]
        return corners

    def sorted_nodes(self) -> np.ndarray:
        """Numbers of the control nodes [M], those of a cell together and neighbouring cells near each other."""
        return np.lexsort(self.first.T[::-1])

    @functools.cached_property
    def by_grid_node(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """For each of n grid nodes that has any, the control nodes that give to it: E entries, those of a grid node together.

        Returns:
            First entry of each grid node, and the end of the last, int32 [n + 1].
            Control node of each entry, int32 [E].
            Way from it to the grid node (x, y, z), cells, and weight, float32 [E, 4].
            Numbers of the grid nodes, int32 [n].
        """
        f = self.rest_cells - self.first  # [M, 3]
        splines = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], -1)  # [M, 3, 3]
        weights = splines[:, 0, STENCIL[:, 0]] * splines[:, 1, STENCIL[:, 1]] * splines[:, 2, STENCIL[:, 2]]  # [M, 27]
        offsets = np.concatenate([STENCIL - f[:, None], weights[..., None]], -1).reshape(-1, 4)
        numbers = self.corners().ravel()
        order = np.argsort(numbers, kind="stable")
        places, counts = np.unique(numbers, return_counts=True)
        starts = np.concatenate([[0], np.cumsum(counts)])
        integers = [values.astype(np.int32) for values in (starts, order // 27, places)]
        return integers[0], integers[1], offsets[order].astype(np.float32), integers[2]

    def transferred(self, fields: np.ndarray, volumes: np.ndarray, cell_size: float) -> np.ndarray:
        """Fields over control nodes, values and slopes (1/m) [M, P, 4], as a step would leave them that moves tissue by them: to the grid
        and back, see `plain_kernels`. A displacement by these and its gradient belong to each other.

        Args:
            fields: At the control nodes.
            volumes: Of the control nodes [M].
            cell_size: Of the grid, m.
        """
        starts, nodes, ways, _ = self.by_grid_node
        ways, weights = ways[:, None, :3].astype(np.float64), ways[:, 3:].astype(np.float64)
        given = fields[nodes, :, 0] + cell_size * (fields[nodes, :, 1:] * ways).sum(2)
        masses = weights * volumes[nodes, None]
        on_grid = np.add.reduceat(masses * given, starts[:-1]) / np.add.reduceat(masses, starts[:-1])
        taken = weights * np.repeat(on_grid, np.diff(starts), 0)
        found = np.zeros_like(fields)
        np.add.at(found, nodes, np.concatenate([taken[..., None], 4 / cell_size * taken[..., None] * ways], 2))
        return found
