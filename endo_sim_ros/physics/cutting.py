"""Cutting: a blade sweeps a surface through tissue, across which nodes no longer share grid nodes, nor skin its nodes.

All of it happens in the rest configuration, where the transfer weights of the solver are taken and never change: the
blade is mapped back to rest (`to_rest`), what it sweeps there is a set of triangles (`sweep`), and the topology follows
from which straight lines between rest positions the triangles cross (`separated`). The tissue is then cut as with
virtual nodes (Molino et al. 2004): a grid node that both sides of a cut use gets a copy for each side (`CutStencils`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError, cKDTree

CORE = 0.75  # cells; a cut opens where it parts the nodes that are this near to a grid node
BOX = 1.5 + 1e-5  # cells; how far a quadratic spline reaches along each axis, and a little for rounding
LINK_REACH = 2.0  # cells; nodes farther apart than this have no tissue between them
MIN_FRAGMENT = 3  # nodes; fewer than this stay with a neighbour where there is one
MIN_DETERMINANT = 0.05  # of F; below it a node has collapsed and says nothing of where rest is
BLADE_NEIGHBOURS = 4  # nodes that carry a point of the blade
BLADE_POINTS, BLADE_PIECES = 16, 16  # most along an edge, and on its way in one step
SHORTEST_MOVE = 0.1  # spacings that a blade moves before it cuts again
MIN_HEIGHT = 1e-6  # m; of a triangle worth keeping
ON_PLANE = 1e-9  # m; points this near to the plane of a triangle lie on its positive side
OVERLAP = 1e-6  # of a triangle, by which it reaches over its edges, so that two that share one leave no gap
FLATTEST = 0.05  # of its extent; a Gaussian in the cut itself keeps that much across it
UPWARD = np.array([0.531, 0.616, 0.582])  # tells the positive side of a plane, however its triangle is wound
BLOCK = 4_000_000  # bounding boxes compared at once


def sweep(start: np.ndarray, end: np.ndarray, whole: np.ndarray | None = None) -> np.ndarray:
    """Triangles [T, 3, 3] between a blade at the start and at the end of a step, as polylines [S, 3] each, in metres.

    A blade of two points gives T = 2. Triangles lower than a micrometre are left out, so a blade at rest or drawn along
    itself gives none.

    Args:
        start: Points of the blade [S, 3].
        end: The same later.
        whole: Which points cut all the way [S]; default: all. Between others there is no triangle.

    Raises:
        ValueError: If the shapes differ, or are not [S, 3] with S of at least 2.
    """
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    if start.shape != end.shape or start.ndim != 2 or start.shape[1] != 3 or len(start) < 2:
        raise ValueError(f"sweep: start has shape {start.shape} and end {end.shape}, expected both [S, 3] with S > 1")
    cutting = np.ones(len(start) - 1, bool) if whole is None else whole[:-1] & whole[1:]
    a, b, c, d = start[:-1][cutting], start[1:][cutting], end[1:][cutting], end[:-1][cutting]
    triangles = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1).reshape(-1, 3, 3)
    edges = triangles - np.roll(triangles, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(1)
    return triangles[np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > MIN_HEIGHT * longest]


class Blade:
    """A straight cutting edge that moves through tissue.

    Its points are carried to rest by the tissue around them. One that is farther from all nodes than these are from each
    other is in the air, and so is one that an older cut parts from its nearest node: it is in an open wound. Nothing is
    cut there.

    Args:
        length: Of the edge, from the tip backwards against the tool's z axis, m.
        spacing: Typical distance between nodes, m.
    """

    def __init__(self, length: float, spacing: float):
        self._spacing = spacing
        points = min(max(round(2 * length / spacing), 3), BLADE_POINTS) + 1
        self._along = np.linspace(0, length, points)[:, None]  # half a spacing apart, so that they follow bent tissue
        self._edge: np.ndarray | None = None  # points now where they cut last [S, 3], world
        self._rest, self._inside = np.zeros((0, 3)), np.zeros(0, bool)  # the same at rest, and which are in tissue

    def move(self, pose: np.ndarray, rest: np.ndarray, positions: np.ndarray, F: np.ndarray, cuts: np.ndarray) -> np.ndarray:
        """Triangles [T, 3, 3], m, at rest, that the edge cuts on its way to a pose [4, 4] of its tool.

        Moves of less than a tenth of the spacing are saved up, so that a trembling blade does not cut the same over and over.

        Args:
            pose: Tip-to-world transform.
            rest: Nodes at rest [M, 3], m, world.
            positions: Nodes now [M, 3], m, world.
            F: Their deformation gradients [M, 3, 3].
            cuts: Triangles of all cuts [T, 3, 3], m, at rest.
        """
        edge = pose[:3, 3] - self._along * pose[:3, 2]
        if self._edge is None:
            self._edge = edge
            self._rest, self._inside = to_rest(edge, rest, positions, F, self._spacing, cuts)
            return np.zeros((0, 3, 3))
        moved = float(np.linalg.norm(edge - self._edge, axis=1).max())
        if moved < SHORTEST_MOVE * self._spacing:
            return np.zeros((0, 3, 3))
        # In pieces, so that what enters or leaves tissue on the way is cut as far as it is in it.
        pieces = min(max(round(2 * moved / self._spacing), 1), BLADE_PIECES)
        shares = np.arange(1, pieces + 1)[:, None, None] / pieces
        way = (self._edge + shares * (edge - self._edge)).reshape(-1, 3)
        carried, inside = to_rest(way, rest, positions, F, self._spacing, cuts)
        carried = np.concatenate([self._rest[None], carried.reshape(pieces, -1, 3)])
        inside = np.concatenate([self._inside[None], inside.reshape(pieces, -1)])
        triangles = [sweep(carried[k], carried[k + 1], inside[k] & inside[k + 1]) for k in range(pieces)]
        self._edge, self._rest, self._inside = edge, carried[-1], inside[-1]
        return np.concatenate(triangles)


def to_rest(
    points: np.ndarray,
    rest: np.ndarray,
    positions: np.ndarray,
    F: np.ndarray,
    reach: float = np.inf,
    cuts: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Where points [P, 3] of the deformed tissue were at rest [P, 3], X = Σ w_k (X_k + F_k⁻¹ (x − x_k)), metres, world;
    and which of them are in tissue [P].

    The nodes k are the nearest by their current positions, with the compact weights of the skinning, which this inverts
    (exactly where the deformation is affine); those that a cut parts from the nearest one have no say. Collapsed nodes
    count as undeformed. All P × M distances are computed: meant for the few points of a blade.

    Args:
        points: Points [P, 3], m, world.
        rest: Nodes at rest [M, 3], m, world.
        positions: Nodes now [M, 3], m, world.
        F: Their deformation gradients [M, 3, 3].
        reach: Points farther than this from every node are not in tissue, m.
        cuts: Triangles of all cuts [T, 3, 3], m, at rest. A point that one of them parts from its nearest node is not in
            tissue.
    """
    points, positions = np.asarray(points, np.float64), np.asarray(positions, np.float64)
    rest = np.asarray(rest, np.float64)
    count = min(BLADE_NEIGHBOURS, max(len(positions) - 1, 1))
    squared = sum((points[:, axis, None] - positions[:, axis]) ** 2 for axis in range(3))  # [P, M]
    nearest = np.argpartition(squared, min(count, len(positions) - 1), axis=1)[:, : count + 1]
    d = np.sqrt(np.take_along_axis(squared, nearest, 1))
    order = np.argsort(d, axis=1)
    nearest, d = np.take_along_axis(nearest, order, 1)[:, :count], np.take_along_axis(d, order, 1)
    gradients = np.asarray(F, np.float64)[nearest]  # [P, K, 3, 3]
    with np.errstate(invalid="ignore"):
        collapsed = ~(np.linalg.det(gradients) >= MIN_DETERMINANT)
    gradients[collapsed] = np.eye(3)
    offsets = np.linalg.solve(gradients, (points[:, None] - positions[nearest])[..., None])[..., 0]
    said = rest[nearest] + offsets  # [P, K, 3] where each node says that the point was
    inside, kept = d[:, 0] <= reach, np.ones(nearest.shape, bool)
    if cuts is not None and len(cuts):
        own = rest[nearest[:, 0]]
        inside &= ~separated(own, said[:, 0], cuts)
        kept = ~separated(rest[nearest].reshape(-1, 3), np.repeat(own, count, 0), cuts).reshape(kept.shape)
    weights = _compact_weights(d[:, :count], d[:, count:], kept)
    return (weights[..., None] * said).sum(1), inside


def separated(a: np.ndarray, b: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Whether the segments from a [N, 3] to b [N, 3] cross any of the triangles [T, 3, 3]; bool [N].

    A point in the plane of a triangle counts as on one of its sides, the same for all triangles of that plane, so that a
    cut right through nodes parts them from one side only. Triangles reach a millionth over their edges.
    """
    a, b, triangles = np.asarray(a, np.float64), np.asarray(b, np.float64), np.asarray(triangles, np.float64)
    crossed = np.zeros(len(a), bool)
    if not len(triangles) or not len(a):
        return crossed
    pad = ON_PLANE + OVERLAP * np.ptp(triangles, axis=1)
    low, high = triangles.min(1) - pad, triangles.max(1) + pad  # [T, 3]
    first, last = np.minimum(a, b), np.maximum(a, b)
    near = np.flatnonzero(((first <= high.max(0)) & (last >= low.min(0))).all(1))
    if not len(near):
        return crossed
    first, last = first[near].T.copy(), last[near].T.copy()
    chunk = max(1, BLOCK // len(near))
    for begin in range(0, len(triangles), chunk):
        rows = slice(begin, begin + chunk)
        meets = np.ones((len(triangles[rows]), len(near)), bool)
        for axis in range(3):
            meets &= first[axis] <= high[rows, axis, None]
            meets &= last[axis] >= low[rows, axis, None]
        triangle, segment = np.nonzero(meets)
        segment = near[segment]
        hit = _crosses(a[segment], b[segment], triangles[begin + triangle])
        crossed[segment[hit]] = True
    return crossed


def _crosses(a: np.ndarray, b: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Whether each segment a–b [Q, 3] crosses its triangle [Q, 3, 3]."""
    origin, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    cross = np.cross(e1, e2)
    area = np.linalg.norm(cross, axis=1)
    normal = cross * (np.where(cross @ UPWARD < 0, -1, 1) / np.maximum(area, 1e-300))[:, None]
    height_a, height_b = ((a - origin) * normal).sum(1), ((b - origin) * normal).sum(1)
    apart = (height_a >= -ON_PLANE) != (height_b >= -ON_PLANE)
    t = np.clip(height_a / np.where(apart, height_a - height_b, 1), 0, 1)
    x = a + t[:, None] * (b - a) - origin
    # Barycentric coordinates of the crossing, from areas in the plane.
    square = np.where(area > 0, area**2, np.inf)
    u = (np.cross(x, e2) * cross).sum(1) / square
    v = (np.cross(e1, x) * cross).sum(1) / square
    return apart & (area > 0) & (u >= -OVERLAP) & (v >= -OVERLAP) & (u + v <= 1 + OVERLAP)


def first_nodes(cells: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """First grid node (i, j, k) of the stencils [M, 3] of points at these positions [M, 3], in cells of the grid."""
    return np.floor(cells - 0.5).astype(np.int64).clip(0, np.array(shape) - 3)


@dataclass(frozen=True)
class CutTable:
    """Stencils of the nodes that use a copy of a grid node; all other nodes keep the regular ones.

    The grid then has G + extra nodes: G = nx·ny·nz regular ones, then the copies.
    """

    affected: np.ndarray  # nodes, ascending [A], int32
    base: np.ndarray  # first grid node (i, j, k) of their stencils [A, 3], int32; the weights go by it
    table: np.ndarray  # grid nodes of their stencils [A, 27], int32, those of (i, j, k) at 9 i + 3 j + k
    extra: int


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
        self.shape = tuple(int(n) for n in shape)
        self._rest, self._cells = rest, cells
        self._tree = cKDTree(cells)
        steps = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(27, 3)
        self._base = first_nodes(cells, self.shape)
        self._stencils = np.ravel_multi_index(np.moveaxis(self._base[:, None] + steps, 2, 0), self.shape)  # [M, 27]
        # Centres of the cores: the grid nodes in use, moved into the box of the points that use them.
        grid = np.arange(np.prod(self.shape))
        low, high = np.full((len(grid), 3), np.inf), np.full((len(grid), 3), -np.inf)
        for axis in range(3):
            np.minimum.at(low[:, axis], self._stencils, cells[:, axis, None])
            np.maximum.at(high[:, axis], self._stencils, cells[:, axis, None])
        self._grid = np.flatnonzero(np.isfinite(low[:, 0]))
        self._ijk = np.stack(np.unravel_index(self._grid, self.shape), 1)
        self._centres = self._ijk.clip(low[self._grid], high[self._grid])
        self._links = _link(cells)  # [L, 2]
        a, b = rest[self._links[:, 0]], rest[self._links[:, 1]]
        self._low, self._high = np.minimum(a, b).T.copy(), np.maximum(a, b).T.copy()  # of the links [3, L]
        self._nearness = 1 / np.linalg.norm(cells[self._links[:, 0]] - cells[self._links[:, 1]], axis=1).clip(1e-6)
        self._reach = float(np.linalg.norm(b - a, axis=1).max(initial=0))
        self.reset()

    def reset(self) -> None:
        """Heal all cuts."""
        self.triangles = np.zeros((0, 3, 3))  # of all cuts [T, 3, 3], m, world, at rest
        self._broken = np.zeros(len(self._links), bool)
        self._passable = ~self._broken
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
        near = ~self._broken
        for axis in range(3):
            corners = triangles[..., axis]
            near &= (self._low[axis] <= corners.max()) & (self._high[axis] >= corners.min())
        near = np.flatnonzero(near)
        ends = self._rest[self._links[near]]
        broken = near[separated(ends[:, 0], ends[:, 1], triangles)]
        if not len(broken):
            return False
        self._broken[broken] = True
        passable = self._keep_islands()
        changed = self._cells[self._links[passable != self._passable]]  # [B, 2, 3]
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

    def _keep_islands(self) -> np.ndarray:
        """Links that hold [L]: the unbroken ones, and the shortest broken one of each piece that is too small to be one."""
        passable = ~self._broken
        degree = np.bincount(self._links[passable].ravel(), minlength=len(self._rest))
        if (degree[self._links[self._broken]] > MIN_FRAGMENT - 2).all():  # no piece is that small
            return passable
        while True:
            piece = _components(len(self._rest), *self._links[passable].T)
            small = (np.bincount(piece) < MIN_FRAGMENT)[piece]
            leaving = np.flatnonzero(~passable & small[self._links].any(1))
            leaving = leaving[np.argsort(-self._nearness[leaving], kind="stable")]
            if not len(leaving):
                return passable
            ends = self._links[leaving].ravel()
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
        radius = np.linalg.norm(self._cells[point] - centres[row], axis=1)
        nearest = np.minimum.reduceat(radius, np.r_[0, np.cumsum(sizes)[:-1]])
        core = radius <= np.maximum(self.core, nearest)[row]
        step = self._ijk[rows][row] - self._base[point]
        support = ((step >= 0) & (step <= 2)).all(1)

        # Links that hold, between vertices: p is the nearer to the grid node.
        vertex = np.full((len(self._rest), len(rows)), -1, np.int32)
        vertex[point, row] = np.arange(count)
        present = np.zeros(len(self._rest), bool)
        present[point] = True
        links = np.flatnonzero(self._passable & present[self._links].all(1))
        p, q = vertex[self._links[links]].transpose(1, 0, 2).reshape(2, -1)  # [L' R]
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


class CutNeighbours:
    """Nodes and weights by which Gaussians follow the tissue on their own side of a cut, as cuts accumulate.

    A Gaussian that a triangle parts from one of its nodes takes the nearest K of its 4 K nearest nodes that are on its
    side, with compact weights; where fewer remain, entries repeat with weight zero, and where none does, it keeps its
    own. All others are as they were, bit for bit. The result does not depend on how cuts are divided into calls.

    Args:
        means: Gaussians at rest [N, 3], m, world.
        node_rest: Nodes at rest [M, 3], m, world.
        index: Nodes that move each Gaussian [N, K].
        weights: Their weights [N, K], which add up to one.
    """

    def __init__(self, means: np.ndarray, node_rest: np.ndarray, index: np.ndarray, weights: np.ndarray):
        self.means, self._rest = np.asarray(means, np.float64), np.asarray(node_rest, np.float64)
        self._uncut = index, weights
        self.triangles = np.zeros((0, 3, 3))  # of all cuts [T, 3, 3], m, world, at rest
        self.index, self.weights = index.copy(), weights.copy()  # now
        # Distances, nodes and whether a cut parts them [N, 4 K + 1], nearest first, from the first cut on.
        self._candidates: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def extends(self, triangles: np.ndarray) -> bool:
        """Whether cuts [T, 3, 3] begin with those that are heeded."""
        known = len(self.triangles)
        return known <= len(triangles) and np.array_equal(triangles[:known], self.triangles)

    def heal(self) -> None:
        """Forget all cuts."""
        self.index, self.weights = self._uncut[0].copy(), self._uncut[1].copy()
        self.triangles = np.zeros((0, 3, 3))
        if self._candidates is not None:
            self._candidates[2][:] = False

    def cut(self, triangles: np.ndarray) -> np.ndarray:
        """Heed all cuts [T, 3, 3], m, world, at rest, and return the numbers of the Gaussians that follow other nodes now.

        They begin with those of the last call: only what is new is looked at.
        """
        triangles = np.asarray(triangles, np.float64).reshape(-1, 3, 3)
        new, self.triangles = triangles[len(self.triangles) :], triangles.copy()
        if not len(new) or not len(self.means):
            return np.zeros(0, int)
        count = self.index.shape[1]
        if self._candidates is None:
            ranks = list(range(1, min(4 * count + 1, len(self._rest)) + 1))
            d, node = cKDTree(self._rest).query(self.means, k=ranks, workers=-1)
            self._candidates = d, node, np.zeros(d.shape, bool)
        d, node, parted = self._candidates
        reach = d[:, -1].max()
        near = (self.means >= new.min((0, 1)) - reach) & (self.means <= new.max((0, 1)) + reach)
        near = np.flatnonzero(near.all(1))
        ends = node[near]
        crossed = separated(np.repeat(self.means[near], ends.shape[1], 0), self._rest[ends.ravel()], new)
        crossed = crossed.reshape(ends.shape)
        parted[near] |= crossed
        near = near[crossed.any(1)]
        # The nodes that it follows while whole are the first of the candidates.
        near = near[(parted[near, :count] & (self._uncut[1][near] > 0)).any(1)]
        if not len(near):
            return near

        d, node, parted = d[near], node[near], parted[near]
        order = np.argsort(parted, axis=1, kind="stable")  # those on this side first
        node, kept = np.take_along_axis(node, order, 1), ~np.take_along_axis(parted, order, 1)
        distances = np.where(kept, np.take_along_axis(d, order, 1), d[:, -1:])  # all others are at least this far
        missing = count + 1 - d.shape[1]
        if missing > 0:  # so few nodes
            pad = ((0, 0), (0, missing))
            node, kept = np.pad(node, pad, "edge"), np.pad(kept, pad)
            distances = np.pad(distances, pad, constant_values=np.inf)
        compact = _compact_weights(distances[:, :count], distances[:, count : count + 1], kept[:, :count])
        able = kept[:, 0]
        self.index[near[able]] = np.where(kept[:, :count], node[:, :count], node[:, :1])[able]
        self.weights[near[able]] = compact[able]
        return near


def clip_to_sides(means: np.ndarray, covars: np.ndarray, reach: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Make covariances [N, 3, 3] no longer reach across a cut, so that its edges are sharp when it opens; returns the
    numbers of those that changed.

    A Gaussian less than two standard deviations from a triangle below it is flattened along the triangle's normal until
    it is two away, or to a twentieth. Triangles act one after the other, so it does not matter how cuts are divided into calls.

    Args:
        means: Gaussians at rest [N, 3], m, world.
        covars: Their covariances [N, 3, 3], m²; changed in place.
        reach: Bounds on two standard deviations [N], m.
        triangles: Of the cut [T, 3, 3], m, world, at rest.
    """
    triangles, changed = np.asarray(triangles, np.float64), np.zeros(len(means), bool)
    if not len(triangles):
        return np.flatnonzero(changed)
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    some = np.ones(len(means), bool)
    for axis in range(3):
        some &= (means[:, axis] >= low[axis] - reach) & (means[:, axis] <= high[axis] + reach)
    some = np.flatnonzero(some)
    x, reach = means[some], reach[some, None]
    for a, b, c in triangles:
        e1, e2 = b - a, c - a
        cross = np.cross(e1, e2)
        square = cross @ cross
        normal = cross / np.sqrt(square)
        corners = np.stack([a, b, c])
        near = np.flatnonzero(((x >= corners.min(0) - reach) & (x <= corners.max(0) + reach)).all(1))
        arm = x[near] - a
        u, v, height = arm @ np.cross(e2, cross) / square, arm @ np.cross(cross, e1) / square, np.abs(arm @ normal)
        near = some[near]
        along = covars[near] @ normal  # [n, 3]
        spread = 2 * np.sqrt(np.maximum(along @ normal, 0))
        over = (u >= -OVERLAP) & (v >= -OVERLAP) & (u + v <= 1 + OVERLAP) & (height < spread)
        near, along = near[over], along[over]
        lost = 1 - np.maximum(height[over] / spread[over], FLATTEST)
        outer = lost[:, None, None] * along[:, :, None] * normal
        kept = lost**2 * (along @ normal)
        covars[near] += kept[:, None, None] * np.outer(normal, normal) - outer - outer.transpose(0, 2, 1)
        changed[near] = True
    return np.flatnonzero(changed)


def _compact_weights(d: np.ndarray, beyond: np.ndarray, kept: np.ndarray | bool = True) -> np.ndarray:
    """Weights (1 − (d/d_{K+1})²)² of the nearest nodes [N, K], of those kept, normalised; as the skinning has them."""
    if not beyond.shape[1]:
        beyond = np.full((len(d), 1), np.inf)
    weights = np.where(kept, np.maximum(1 - (d / np.maximum(beyond, 1e-30)) ** 2, 1e-6) ** 2, 0)
    return weights / np.maximum(weights.sum(1, keepdims=True), 1e-30)


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
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(count, count))
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
