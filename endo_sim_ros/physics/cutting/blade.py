"""A cutting edge that moves through deformed tissue, carried back to the tissue at rest."""

import numpy as np

from endo_sim_ros.physics.cutting.geometry import separated, sweep
from endo_sim_ros.physics.weights import compact_weights

MIN_DETERMINANT = 0.05  # of F; below it a node has collapsed and says nothing of where rest is
BLADE_NEIGHBOURS = 4  # nodes that carry a point of the blade
BLADE_POINTS, BLADE_PIECES = 16, 16  # most along an edge, and on its way in one step
SHORTEST_MOVE = 0.1  # spacings that a blade moves before it cuts again
_CLOSING = 1e-3  # spacings by which tips come nearer in a step when scissors close: rounding is far below


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
        return self._draw(pose[:3, 3] - self._along * pose[:3, 2], rest, positions, F, cuts)

    def draw(self, corners: np.ndarray, rest: np.ndarray, positions: np.ndarray, F: np.ndarray, cuts: np.ndarray) -> np.ndarray:
        """The same for an edge through corners [C, 3], m, world, about as long as it was at first."""
        lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(lengths)])
        along = np.linspace(0, at[-1], len(self._along))
        edge = np.stack([np.interp(along, at, corners[:, axis]) for axis in range(3)], 1)
        return self._draw(edge, rest, positions, F, cuts)

    def _draw(self, edge: np.ndarray, rest: np.ndarray, positions: np.ndarray, F: np.ndarray, cuts: np.ndarray) -> np.ndarray:
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


class Scissors:
    """Two blades that cut what lies between them while they close.

    Each sweeps from where it was; closed, the two meet half way. While they open or stand still they cut nothing.

    Args:
        spacing: Typical distance between nodes, m.
    """

    def __init__(self, spacing: float):
        self._spacing = spacing
        self._jaws: np.ndarray | None = None  # at the last call [3, 3]
        self._closed = False
        self._blades: list[Blade] | None = None  # while they close

    def move(
        self, jaws: np.ndarray, closed: bool, rest: np.ndarray, positions: np.ndarray, F: np.ndarray, cuts: np.ndarray
    ) -> np.ndarray:  # fmt: skip
        """Triangles [T, 3, 3], m, at rest, that the blades cut on their way.

        Args:
            jaws: Hinge and tips of the two [3, 3], m, world.
            closed: Whether they are to meet.
            rest, positions, F, cuts: As for `Blade.move`.
        """
        before, was_closed, self._jaws, self._closed = self._jaws, self._closed, jaws, closed
        if before is None or was_closed or not (closed or _opening(jaws) < _opening(before) - _CLOSING * self._spacing):
            self._blades = None
            return np.zeros((0, 3, 3))
        state = rest, positions, F, cuts
        if self._blades is None:
            self._blades = [Blade(float(np.linalg.norm(tip - before[0])), self._spacing) for tip in before[1:]]
            for blade, tip in zip(self._blades, before[1:]):
                blade.draw(np.stack([before[0], tip]), *state)
        tips = [jaws[1:].mean(0)] * 2 if closed else jaws[1:]
        return np.concatenate([blade.draw(np.stack([jaws[0], tip]), *state) for blade, tip in zip(self._blades, tips)])


def _opening(jaws: np.ndarray) -> float:
    return float(np.linalg.norm(jaws[1] - jaws[2]))


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
    weights = compact_weights(d[:, :count], d[:, count:], kept)
    return (weights[..., None] * said).sum(1), inside
