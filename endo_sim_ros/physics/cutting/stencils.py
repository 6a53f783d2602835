"""Which copy of a grid node each control node uses beside a cut: the topology of the grid."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, KDTree, QhullError

from endo_sim_ros.physics.cutting.geometry import separated
from endo_sim_ros.physics.stencils import CutTable, Stencils

CORE = 0.75  # cells; a cut opens where it parts the nodes that are this near to a grid node
BOX = 1.5 + 1e-5  # cells; how far a quadratic spline reaches along each axis, and a little for rounding
LINK_REACH = 2.0  # cells; nodes farther apart than this have no tissue between them
MIN_FRAGMENT = 3  # nodes; fewer than this stay with a neighbour where there is one


class CutStencils:
    """Which copy of each grid node the material points use, as cuts accumulate.

    Material points are linked as in their Delaunay tetrahedralisation, in which every point of a ball is joined to the
    point nearest its centre without leaving the ball; a triangle of the cut that crosses a link breaks it. Then, for
    every grid node near a broken link:

    1. The points within `core` cells of it fall into sides, the components under unbroken links. A grid node beyond the
       surface takes the nearest place inside the box of the points it reaches, so that a shallow cut parts nothing there.
    2. Sides grow outwards: a point farther away joins the side to which most of its unbroken links towards the grid node
       lead, nearer ones counting more. Links may leave the support, not the box of its size around the core.
    3. Points that no side reaches that way, because the cut lies between, are sides of their own.
    4. A side of less than three points joins the one that most of its unbroken links lead to. If none does, it keeps its
       own copy, for joining would glue the cut. That is no danger: a partition cannot raise the highest frequency of the
       grid above that of a point alone (Irons' bound), which the Courant limit is for.

    The largest side keeps the grid node itself. One or two points cut off all around stay linked to the nearest other.
    The result does not depend on how cuts are divided into calls.

    Args:
        rest: Material points at rest [M, 3], m, world.
        rest_cells: The same in cells of the grid from its corner [M, 3], rounded as the solver rounds it.
        shape: Grid nodes (nx, ny, nz).
        core: Radius that decides, cells.

    Raises:
        ValueError: If rest and rest_cells are not both [M, 3], or the grid has fewer than three nodes along an axis.
    """

    def __init__(self, rest: np.ndarray, rest_cells: np.ndarray, shape: tuple[int, int, int], *, core: float = CORE):
        rest, cells = np.asarray(rest, np.float64), np.asarray(rest_cells, np.float64)
        if rest.shape != cells.shape or rest.ndim != 2 or rest.shape[1] != 3:
            raise ValueError(f"CutStencils: rest has shape {rest.shape} and rest_cells {cells.shape}, expected [M, 3]")
        if min(shape) < 3:
            raise ValueError(f"CutStencils: a grid of {shape} nodes is too small, expected at least 3 along each axis")
        self.core = core
        self.shape = int(shape[0]), int(shape[1]), int(shape[2])
        self._rest, self.cells = rest, cells
        self._tree = KDTree(cells)
        whole = Stencils(cells, self.shape)
        self._base, self._stencils = whole.first, whole.corners()  # [M, 3], [M, 27]
        # Centres of the cores: the grid nodes in use, moved into the box of the points that use them.
        grid = np.arange(np.prod(self.shape))
        low, high = np.full((len(grid), 3), np.inf), np.full((len(grid), 3), -np.inf)
        for axis in range(3):
            np.minimum.at(low[:, axis], self._stencils, cells[:, axis, None])
            np.maximum.at(high[:, axis], self._stencils, cells[:, axis, None])
        self._grid = np.flatnonzero(np.isfinite(low[:, 0]))
        self._ijk = np.stack(np.unravel_index(self._grid, self.shape), 1)
        self._centres = self._ijk.clip(low[self._grid], high[self._grid])
        self.links = _link(cells)  # [L, 2]
        a, b = rest[self.links[:, 0]], rest[self.links[:, 1]]
        self._low, self._high = np.minimum(a, b).T.copy(), np.maximum(a, b).T.copy()  # of the links [3, L]
        self._nearness = 1 / np.linalg.norm(cells[self.links[:, 0]] - cells[self.links[:, 1]], axis=1).clip(1e-6)
        self._reach = float(np.linalg.norm(b - a, axis=1).max(initial=0))
        self.reset()

    def reset(self) -> None:
        """Heal all cuts."""
        self.triangles = np.zeros((0, 3, 3))  # of all cuts [T, 3, 3], m, world, at rest
        self.broken = np.zeros(len(self.links), bool)
        self._passable = ~self.broken
        self._copies = np.zeros((len(self._rest), 27), np.int64)  # 0 is the grid node itself

    def cut(self, triangles: np.ndarray) -> bool:
        """Add triangles [T, 3, 3] (m, world, at rest) to the cuts; returns whether any stencil changed.

        Triangles out of reach of any link are not kept. Those kept may part skin from nodes where no stencil changes.

        Raises:
            ValueError: If a triangle is not finite; the cuts then stay as they were.
        """
        triangles = np.asarray(triangles, np.float64).reshape(-1, 3, 3)
        if not np.isfinite(triangles).all():
            raise ValueError("CutStencils: triangles must be finite")
        low, high = triangles.min(1) - self._reach, triangles.max(1) + self._reach
        inside = (low <= self._rest.max(0)) & (high >= self._rest.min(0))
        triangles = triangles[inside.all(1)]
        if not len(triangles):
            return False
        self.triangles = np.concatenate([self.triangles, triangles])
        near = ~self.broken
        for axis in range(3):
            corners = triangles[..., axis]
            near &= (self._low[axis] <= corners.max()) & (self._high[axis] >= corners.min())
        near = np.flatnonzero(near)
        ends = self._rest[self.links[near]]
        broken = near[separated(ends[:, 0], ends[:, 1], triangles)]
        if not len(broken):
            return False
        self.broken[broken] = True
        passable = self._keep_islands()
        changed = self.cells[self.links[passable != self._passable]]  # [B, 2, 3]
        self._passable = passable
        if not len(changed):  # all of it between islands
            return False
        # Grid nodes whose box holds a changed link.
        low, high = changed.max(1) - BOX, changed.min(1) + BOX
        near = np.flatnonzero(((self._centres >= low.min(0)) & (self._centres <= high.max(0))).all(1))
        within = np.ones((len(near), len(changed)), bool)
        for axis in range(3):
            centres = self._centres[near, axis, None]
            within &= (centres >= low[:, axis]) & (centres <= high[:, axis])
        before = self._copies.copy()
        self._partition(near[within.any(1)])
        return not np.array_equal(before, self._copies)

    def table(self) -> CutTable | None:
        """The stencils that differ from the regular ones, or None where none does."""
        copied = self._copies > 0
        affected = np.flatnonzero(copied.any(1))
        if not len(affected):
            return None
        copied, table = copied[affected], self._stencils[affected]
        stride = self._copies.max() + 1
        copies, number = np.unique((table * stride + self._copies[affected])[copied], return_inverse=True)
        table[copied] = np.prod(self.shape) + number
        base = self._base[affected]
        return CutTable(affected.astype(np.int32), base.astype(np.int32), table.astype(np.int32), len(copies))

    def pieces(self) -> np.ndarray:
        """Number of the piece of tissue that each point belongs to [M]."""
        return _components(len(self._rest), *self.links[self._passable].T)

    def _keep_islands(self) -> np.ndarray:
        """Links that hold [L]: the unbroken ones, and the shortest broken one of each piece that is too small to be one."""
        passable = ~self.broken
        degree = np.bincount(self.links[passable].ravel(), minlength=len(self._rest))
        if (degree[self.links[self.broken]] > MIN_FRAGMENT - 2).all():  # no piece is that small
            return passable
        while True:
            piece = _components(len(self._rest), *self.links[passable].T)
            small = (np.bincount(piece) < MIN_FRAGMENT)[piece]
            leaving = np.flatnonzero(~passable & small[self.links].any(1))
            leaving = leaving[np.argsort(-self._nearness[leaving], kind="stable")]
            if not len(leaving):
                return passable
            ends = self.links[leaving].ravel()
            islands = np.flatnonzero(small[ends])
            shortest = islands[np.unique(piece[ends[islands]], return_index=True)[1]]
            passable[leaving[shortest // 2]] = True

    def _partition(self, rows: np.ndarray) -> None:
        """Renew the copies at these grid nodes [R], as positions in self._grid."""
        centres = self._centres[rows]
        if not len(rows):
            return
        members = self._tree.query_ball_point(centres, BOX, p=np.inf, return_sorted=True)
        sizes = np.array([len(points) for points in members])
        row, point = np.repeat(np.arange(len(rows)), sizes), np.concatenate(members).astype(np.int64)
        count = len(point)  # of pairs of a grid node and a point; they are the vertices of one graph for all grid nodes
        radius = np.linalg.norm(self.cells[point] - centres[row], axis=1)
        nearest = np.minimum.reduceat(radius, np.r_[0, np.cumsum(sizes)[:-1]])
        core = radius <= np.maximum(self.core, nearest)[row]
        step = self._ijk[rows][row] - self._base[point]
        support = ((step >= 0) & (step <= 2)).all(1)

        # Links that hold, between vertices: p is the nearer to the grid node.
        vertex = np.full((len(self._rest), len(rows)), -1, np.int32)
        vertex[point, row] = np.arange(count)
        present = np.zeros(len(self._rest), bool)
        present[point] = True
        links = np.flatnonzero(self._passable & present[self.links].all(1))
        p, q = vertex[self.links[links]].transpose(1, 0, 2).reshape(2, -1)  # [L' R]
        held = np.flatnonzero((p | q) >= 0)
        p, q, nearness = p[held], q[held], self._nearness[links[held // len(rows)]]
        farther = radius[p] > radius[q]
        p, q = np.where(farther, q, p), np.where(farther, p, q)

        inner = core[p] & core[q]
        side = np.where(core, _components(count, p[inner], q[inner]), -1)
        outward = ~core[q]
        p_out, q_out, votes = p[outward], q[outward], nearness[outward]
        while True:
            reaching = side[p_out] >= 0
            if not reaching.any():
                break
            side = _elect(q_out[reaching], side[p_out[reaching]], votes[reaching], side)
            waiting = side[q_out] < 0
            p_out, q_out, votes = p_out[waiting], q_out[waiting], votes[waiting]
        left = side < 0
        stray = left[p] & left[q]
        side = np.where(left, count + _components(count, p[stray], q[stray]), side)

        side = np.unique(side, return_inverse=True)[1]
        total = side.max() + 1
        size = np.bincount(side[support], minlength=total)
        small = size < MIN_FRAGMENT
        leaving, entered = np.r_[side[p], side[q]], np.r_[side[q], side[p]]
        apart = np.flatnonzero((leaving != entered) & small[leaving] & (size[entered] > 0))
        joined = _elect(leaving[apart], entered[apart], np.r_[nearness, nearness][apart], np.arange(total))
        side = _components(total, np.arange(total), joined)[side]

        # Copies are numbered from the largest side of each grid node on.
        row, point, side, step = row[support], point[support], side[support], step[support]
        size = np.bincount(side)
        order = np.lexsort((side, -size[side], row))
        row, point, side, step = row[order], point[order], side[order], step[order]
        new_row = np.r_[True, row[1:] != row[:-1]]
        number = np.cumsum(new_row | np.r_[True, side[1:] != side[:-1]])
        number -= number[np.flatnonzero(new_row)][np.cumsum(new_row) - 1]
        self._copies[point, step @ [9, 3, 1]] = number


def _link(cells: np.ndarray) -> np.ndarray:
    """Delaunay links [L, 2] between points [M, 3], in cells; points may be on a lattice, in a plane, or coincide."""
    try:
        corners = Delaunay(cells, qhull_options="Qbb Qc QJ").simplices
    except (QhullError, ValueError):  # fewer than five points
        corners = np.arange(len(cells))[None]
    pairs = np.stack(np.triu_indices(corners.shape[1], 1), 1)
    links = np.sort(corners[:, pairs].reshape(-1, 2), 1).astype(np.int64)
    links = np.unique(links[:, 0] * len(cells) + links[:, 1])
    links = np.stack([links // len(cells), links % len(cells)], 1)
    return links[np.linalg.norm(cells[links[:, 0]] - cells[links[:, 1]], axis=1) <= LINK_REACH]


def _components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Label [count] of the component of every vertex, for links between vertices a [L] and b [L]."""
    ends = a.astype(np.int32), b.astype(np.int32)  # SciPy below 1.12 has no components of other integers
    graph = coo_array((np.ones(len(a), np.int8), ends), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _elect(voters: np.ndarray, choices: np.ndarray, votes: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Chosen [V] with the choice of most votes entered for every voter there is; of equals the lowest. All others are [L]."""
    chosen = chosen.copy()
    chosen[voters] = choices
    contested = np.zeros(len(chosen), bool)
    contested[voters[chosen[voters] != choices]] = True
    split = contested[voters]  # few are, and only they need counting
    voters, choices, votes = voters[split], choices[split], votes[split]
    order = np.lexsort((choices, voters))
    voters, choices, votes = voters[order], choices[order], votes[order]
    new = np.flatnonzero(np.r_[True, (voters[1:] != voters[:-1]) | (choices[1:] != choices[:-1])][: len(voters)])
    totals = np.round(np.add.reduceat(votes, new), 9) if len(new) else votes  # equal sums stay equal in any order
    voters, choices = voters[new], choices[new]
    order = np.lexsort((-choices, totals, voters))  # the winner comes last
    chosen[voters[order]] = choices[order]
    return chosen
