"""Cuts on the grid: crossings against brute force, sides, copies of grid nodes."""

import numpy as np
import pytest
from cut_block import MIDDLE, SPACING, block, wall
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from endo_sim_ros.physics.cutting.geometry import separated, sweep
from endo_sim_ros.physics.cutting.stencils import CutStencils
from endo_sim_ros.physics.stencils import CutTable


def cut_stencils(rest_cells: np.ndarray, shape: tuple[int, int, int], triangles: np.ndarray, rest: np.ndarray) -> CutTable | None:
    """Stencils after cuts by all triangles [T, 3, 3] (m, world, at rest) at once; see :class:`CutStencils`."""
    stencils = CutStencils(rest, rest_cells, shape)
    stencils.cut(triangles)
    return stencils.table()


def grid_of(rest: np.ndarray, cell: float) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Nodes in cells and the shape of the grid, as the solver has them."""
    cells = ((rest - rest.min(0) + 2 * cell) / cell).astype(np.float32)
    return cells, tuple(int(n) for n in np.ceil(cells.max(0) + 2) + 1)


def stencils_of(rest: np.ndarray, ratio: float) -> CutStencils:
    return CutStencils(rest, *grid_of(rest, ratio * SPACING))


def tables(stencils: CutStencils) -> tuple[np.ndarray, np.ndarray, int]:
    """Regular stencils and those after the cuts [M, 27], and the number of regular grid nodes."""
    nx, ny, nz = stencils.shape
    base = np.floor(stencils.cells - 0.5).astype(int)
    steps = np.array([(i, j, k) for i in range(3) for j in range(3) for k in range(3)])
    i, j, k = np.moveaxis(base[:, None] + steps, 2, 0)
    regular = (i * ny + j) * nz + k
    after = regular.copy()
    cut = stencils.table()
    if cut is not None:
        after[cut.affected] = cut.table
    return regular, after, nx * ny * nz


def momentum_pieces(table: np.ndarray) -> np.ndarray:
    """Piece [M] that each node belongs to, when nodes that share a grid node exchange momentum."""
    count, grid = len(table), table.max() + 1
    ends = np.repeat(np.arange(count, dtype=np.int32), 27), (count + table.ravel()).astype(np.int32)
    graph = coo_array((np.ones(table.size), ends), shape=(count + grid,) * 2)
    return np.unique(connected_components(graph, directed=False)[1][:count], return_inverse=True)[1]


def spline_weights(stencils: CutStencils) -> np.ndarray:
    """Weights of the stencils [M, 27]."""
    x = stencils.cells - np.floor(stencils.cells - 0.5)
    w = np.stack([0.5 * (1.5 - x) ** 2, 0.75 - (x - 1) ** 2, 0.5 * (x - 0.5) ** 2], 2)
    return np.einsum("ni,nj,nk->nijk", w[:, 0], w[:, 1], w[:, 2]).reshape(-1, 27)


def coupling(stencils: CutStencils, a: np.ndarray, b: np.ndarray) -> float:
    """How much of the exchange between two groups of nodes (bool [M]) is left, 0 to 1."""
    regular, after, _ = tables(stencils)
    weights = spline_weights(stencils)

    def shared(table):
        on_grid = [np.bincount(table[group].ravel(), weights[group].ravel(), table.max() + 1) for group in (a, b)]
        return on_grid[0] @ on_grid[1]

    return shared(after) / shared(regular)


def beside_the_wall(rest: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The two nodes deep layers of nodes to the left and to the right of the middle, of these rows (bool [M])."""
    left = rest[:, 0] < MIDDLE
    near = rows & (np.abs(rest[:, 0] - MIDDLE) < 2 * SPACING)
    return near & left, near & ~left


def brute_force(a, b, triangle) -> bool:
    """Möller–Trumbore for one segment and one triangle."""
    e1, e2, ray = triangle[1] - triangle[0], triangle[2] - triangle[0], b - a
    h = np.cross(ray, e2)
    f, s = 1 / (e1 @ h), a - triangle[0]
    u, q = f * (s @ h), np.cross(s, e1)
    v, t = f * (ray @ q), f * (e2 @ q)
    return u >= 0 and v >= 0 and u + v <= 1 and 0 <= t <= 1


@pytest.mark.slow
def test_crossings_are_those_of_brute_force():
    rng = np.random.default_rng(0)
    a, b, triangles = rng.uniform(size=(400, 3)), rng.uniform(size=(400, 3)), rng.uniform(size=(12, 3, 3))
    expected = np.array([any(brute_force(p, q, triangle) for triangle in triangles) for p, q in zip(a, b)])
    assert 100 < expected.sum() < 390
    np.testing.assert_array_equal(separated(a, b, triangles), expected)


def test_no_segment_slips_through_a_shared_edge():
    rng = np.random.default_rng(0)
    corners = rng.uniform(size=(4, 3)) * 0.03 + 1.0
    triangles = np.stack([corners[[0, 1, 2]], corners[[0, 2, 3]]])
    on_edge = corners[0] + rng.uniform(0.01, 0.99, (2000, 1)) * (corners[2] - corners[0])
    normal = sum(np.cross(t[1] - t[0], t[2] - t[0]) for t in triangles)
    offset = 0.01 * normal / np.linalg.norm(normal) + rng.uniform(-0.003, 0.003, (2000, 3))
    assert separated(on_edge - offset, on_edge + offset, triangles).all()


def test_no_segment_slips_between_successive_sweeps():
    y, z = np.random.default_rng(0).uniform([0.0, 0.0], [0.03, 0.02], (2000, 2)).T
    y[:1000] = np.linspace(0, 0.03, 11)[np.arange(1000) % 11]  # through the edges between sweeps
    ends = [np.stack([np.full(2000, x), y, z], 1) for x in (-0.002, 0.003)]
    assert separated(*ends, wall(0.0, (0.0, 0.03), (0.0, 0.02))).all()


def test_nodes_in_the_plane_of_a_cut_are_on_one_side_of_it():
    triangles = wall(0.0, (-0.02, 0.02), (-0.02, 0.02))
    triangles[::2] = triangles[::2, ::-1]  # however they are wound
    on, left, right = np.zeros((1, 3)), np.array([[-0.01, 0.001, 0.002]]), np.array([[0.01, 0.002, 0.001]])
    assert separated(on, left, triangles) != separated(on, right, triangles)


def test_nothing_is_separated_by_no_triangles():
    assert not separated(np.zeros((3, 3)), np.ones((3, 3)), np.zeros((0, 3, 3))).any()
    assert separated(np.zeros((0, 3)), np.ones((0, 3)), np.ones((1, 3, 3))).shape == (0,)


@pytest.mark.parametrize("ratio", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_a_full_cut_leaves_two_pieces_that_share_no_grid_node(ratio, jitter):
    rest = block(jitter=jitter)
    stencils = stencils_of(rest, ratio)
    assert stencils.cut(wall())
    _, after, _ = tables(stencils)
    left = rest[:, 0] < MIDDLE
    assert not np.intersect1d(after[left], after[~left]).size
    assert momentum_pieces(after).max() == 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_an_oblique_cut_through_scattered_nodes_leaves_two_pieces(seed):
    rest, centre = block(jitter=0.4, seed=seed), np.array([0.03, 0.02, 0.01])
    normal = np.array([0.8, 0.5 * (seed - 1), 0.3])
    normal /= np.linalg.norm(normal)
    along = np.cross(normal, [0, 0, 1.0])
    blade = np.array([-0.1, 0.1])[:, None] * np.cross(along, normal)
    at = [centre + blade + shift * along for shift in np.linspace(-0.1, 0.1, 15)]
    stencils = stencils_of(rest, 1.5)
    stencils.cut(np.concatenate([sweep(start, end) for start, end in zip(at[:-1], at[1:])]))
    _, after, _ = tables(stencils)
    side = (rest - centre) @ normal < 0
    assert not np.intersect1d(after[side], after[~side]).size
    assert momentum_pieces(after).max() == 1


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_a_cut_right_through_nodes_still_leaves_two_pieces(jitter):
    rest = block(jitter=jitter)
    rest[np.abs(rest[:, 0] - 0.03) < 0.4 * SPACING, 0] = 0.03
    stencils = stencils_of(rest, 1.5)
    stencils.cut(wall(0.03))
    _, after, _ = tables(stencils)
    assert momentum_pieces(after).max() == 1


@pytest.mark.parametrize("ratio", [1.5, 2.0])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_half_a_cut_opens_behind_its_tip_and_holds_ahead_of_it(ratio, jitter):
    rest, tip = block(jitter=jitter), 0.0199
    stencils = stencils_of(rest, ratio)
    stencils.cut(wall(y=(-0.02, tip)))
    cell = ratio * SPACING
    assert coupling(stencils, *beside_the_wall(rest, rest[:, 1] < tip - cell)) < 0.05
    assert coupling(stencils, *beside_the_wall(rest, rest[:, 1] > tip + cell)) > 0.95
    regular, after, _ = tables(stencils)
    assert momentum_pieces(after).max() == 0
    far = rest[:, 1] > tip + 2 * cell
    np.testing.assert_array_equal(after[far], regular[far])


@pytest.mark.parametrize("ratio", [1.5, 2.0])
@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_under_a_shallow_cut_the_tissue_holds_and_a_deep_one_opens(ratio, jitter):
    rest, cell = block((13, 9, 7), jitter), ratio * SPACING
    stencils = stencils_of(rest, ratio)
    stencils.cut(wall(z=(-0.02, 0.4 * cell)))
    assert coupling(stencils, *beside_the_wall(rest, rest[:, 2] > 0.75 * SPACING)) > 0.95
    regular, after, _ = tables(stencils)
    assert momentum_pieces(after).max() == 0
    stencils.cut(wall(z=(-0.02, 2 * cell)))
    assert coupling(stencils, *beside_the_wall(rest, rest[:, 2] < 0.75 * SPACING)) < 0.05
    assert coupling(stencils, *beside_the_wall(rest, rest[:, 2] > 2 * cell + SPACING)) > 0.9
    assert momentum_pieces(tables(stencils)[1]).max() == 0


def test_a_scratch_that_parts_no_nodes_changes_nothing():
    stencils = stencils_of(block(), 1.5)
    assert not stencils.cut(wall(z=(-0.02, -0.001)))
    assert stencils.table() is None


@pytest.mark.parametrize("jitter", [0.0, 0.3])
@pytest.mark.parametrize("y", [(-0.02, 0.06), (-0.02, 0.02)])
def test_every_node_keeps_its_mass_on_copies_of_its_own_grid_nodes(jitter, y):
    rest = block(jitter=jitter)
    stencils = stencils_of(rest, 1.5)
    stencils.cut(wall(y=y))
    cut = stencils.table()
    regular, after, grid = tables(stencils)
    assert cut.affected.dtype == cut.table.dtype == cut.base.dtype == np.int32
    assert cut.table.shape == (len(cut.affected), 27) and (np.diff(cut.affected) > 0).all()
    assert after.min() >= 0 and after.max() == grid + cut.extra - 1
    assert (cut.table >= grid).any(1).all()
    np.testing.assert_array_equal(cut.base, np.floor(stencils.cells[cut.affected] - 0.5))
    np.testing.assert_array_equal(after[after < grid], regular[after < grid])
    np.testing.assert_array_equal(np.unique(after[after >= grid]), np.arange(grid, grid + cut.extra))
    original = np.full(grid + cut.extra, -1)  # a copy stands for one grid node
    original[after] = regular
    np.testing.assert_array_equal(original[after], regular)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
@pytest.mark.parametrize("y", [(-0.02, 0.06), (-0.02, 0.02)])
def test_a_copy_has_three_nodes_unless_the_cut_leaves_them_no_neighbour_there(jitter, y):
    rest = block(jitter=jitter)
    stencils = stencils_of(rest, 1.5)
    stencils.cut(wall(y=y))
    regular, after, grid = tables(stencils)
    users = np.bincount(after.ravel(), minlength=after.max() + 1)
    few = np.flatnonzero(users[grid:] < 3) + grid
    assert len(few) < 0.5 * stencils.table().extra
    links = stencils.links[~stencils.broken]
    for copy in few:
        alone = (after == copy).any(1)
        others = (regular == regular[after == copy][0]).any(1) & ~alone
        joined = (alone[links] & others[links][:, ::-1]).any(1)
        assert not joined.any()
    weights = spline_weights(stencils)
    assert (weights * (users[after] < 3)).sum(1).max() < 0.1


@pytest.mark.parametrize("where", ["none", "beside"])
def test_no_cut_gives_no_table(where):
    rest = block()
    triangles = np.zeros((0, 3, 3)) if where == "none" else wall() + [0.2, 0, 0]
    stencils = stencils_of(rest, 1.5)
    assert not stencils.cut(triangles) and stencils.table() is None and not len(stencils.triangles)
    assert cut_stencils(*grid_of(rest, 0.0075), triangles, rest) is None


def test_a_cut_that_only_touches_the_air_beside_the_tissue_changes_nothing():
    stencils = stencils_of(block(), 1.5)
    assert not stencils.cut(wall(x=-0.003)) and stencils.table() is None


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_two_crossing_cuts_leave_four_pieces(jitter):
    rest = block(jitter=jitter)
    across = wall(x=0.0211)[..., [1, 0, 2]] * [2, 1, 1]
    stencils = stencils_of(rest, 1.5)
    stencils.cut(wall())
    stencils.cut(across)
    pieces = momentum_pieces(tables(stencils)[1])
    assert pieces.max() == 3
    quadrant = 2 * (rest[:, 0] < MIDDLE) + (rest[:, 1] < 0.0211)
    assert len(np.unique(4 * pieces + quadrant)) == 4


@pytest.mark.slow
def test_cuts_in_any_pieces_and_order_give_the_same_table():
    rest = block(jitter=0.3)
    triangles = np.concatenate([wall(y=(-0.02, 0.03)), wall(x=0.0211)[..., [1, 0, 2]]])
    cells, shape = grid_of(rest, 0.0075)
    once = cut_stencils(cells, shape, triangles, rest)
    stencils = CutStencils(rest, cells, shape)
    for triangle in triangles[::-1]:
        stencils.cut(triangle[None])
    for other in (stencils.table(), cut_stencils(cells, shape, triangles, rest)):
        assert other.extra == once.extra
        for name in ("affected", "base", "table"):
            np.testing.assert_array_equal(getattr(other, name), getattr(once, name))


def test_reset_heals():
    stencils = stencils_of(block(), 1.5)
    stencils.cut(wall())
    stencils.reset()
    assert stencils.table() is None and not len(stencils.triangles)
    assert stencils.cut(wall())


def test_a_single_node_cut_off_all_around_stays_with_a_neighbour():
    rest = block()
    low, high = np.array([0.028] * 3) - [0, 0.01, 0.02], np.array([0.032] * 3) - [0, 0.01, 0.02]
    box = []
    for axis in range(3):
        for at in (low[axis], high[axis]):
            corners = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]], float)
            corners = np.roll(corners, axis, 1) * (high - low) + low
            corners[:, axis] = at
            box += [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    stencils = stencils_of(rest, 1.5)
    stencils.cut(np.array(box))
    inside = ((rest > low) & (rest < high)).all(1)
    assert inside.sum() == 1
    links = stencils.links[stencils.broken]
    assert inside[links].any(1).all() and len(links) > 5
    assert momentum_pieces(tables(stencils)[1]).max() == 0


@pytest.mark.parametrize("case", ["plane", "line", "coincident", "two", "one"])
def test_nodes_in_unusual_arrangements_are_cut_too(case):
    rest = {
        "plane": block((13, 9, 1)),
        "line": block((13, 1, 1)),
        "coincident": np.repeat(block((13, 9, 2)), 2, axis=0),
        "two": block((2, 1, 1)) + [0.028, 0, 0],
        "one": np.array([[0.03, 0.0, 0.0]]),
    }[case]
    stencils = stencils_of(rest, 1.5)
    several = case not in ("one", "two")  # no piece is smaller than three nodes
    assert stencils.cut(wall()) == several
    assert momentum_pieces(tables(stencils)[1]).max() == several


def test_stencils_name_what_they_cannot_use():
    with pytest.raises(ValueError, match="rest has shape"):
        CutStencils(np.zeros((3, 3)), np.zeros((4, 3)), (5, 5, 5))
    with pytest.raises(ValueError, match="too small"):
        CutStencils(np.zeros((3, 3)), np.zeros((3, 3)), (5, 5, 2))
    with pytest.raises(ValueError, match="finite"):
        stencils_of(block(), 1.5).cut(np.full((1, 3, 3), np.nan))
