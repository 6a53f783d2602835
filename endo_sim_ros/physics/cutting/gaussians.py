"""Gaussians beside a cut: which control nodes they follow, and how far they reach."""

import numpy as np

from endo_sim_ros.physics.cutting.geometry import OVERLAP, separated
from endo_sim_ros.physics.weights import compact_weights, nearest_nodes

ENDS = (
    1.5  # standard deviations at which a Gaussian counts as ended: with more a closed cut is a dark gap, with fewer an open one is blurred
)


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
        self.means, self.node_rest = np.asarray(means, np.float64), np.asarray(node_rest, np.float64)
        self._uncut, self._count = (index, weights), len(means)
        self.triangles = np.zeros((0, 3, 3))  # of all cuts [T, 3, 3], m, world, at rest
        self.index, self.weights = index.copy(), weights.copy()  # now
        # Distances, nodes and whether a cut parts them [N, 4 K + 1], nearest first, from the first cut on.
        self._candidates: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def extends(self, triangles: np.ndarray) -> bool:
        """Whether cuts [T, 3, 3] begin with those that are heeded."""
        known = len(self.triangles)
        return known <= len(triangles) and np.array_equal(triangles[:known], self.triangles)

    def heal(self) -> None:
        """Forget all cuts, and the Gaussians that were appended."""
        count = self._count
        self.means, self._uncut = self.means[:count], (self._uncut[0][:count], self._uncut[1][:count])
        self.index, self.weights = self._uncut[0].copy(), self._uncut[1].copy()
        self.triangles = np.zeros((0, 3, 3))
        if self._candidates is not None:
            d, node, parted = (each[:count] for each in self._candidates)
            self._candidates = d, node, np.zeros_like(parted)

    def append(self, means: np.ndarray, index: np.ndarray, weights: np.ndarray) -> None:
        """Add Gaussians [n, 3] with what they follow while whole [n, K]; they heed the cuts so far, and are gone when these heal."""
        added = CutNeighbours(means, self.node_rest, index, weights)
        added.cut(self.triangles)
        for name in ("means", "index", "weights"):
            setattr(self, name, np.concatenate([getattr(self, name), getattr(added, name)]))
        index, weights = map(np.concatenate, zip(self._uncut, added._uncut))
        self._uncut = index, weights
        if self._candidates is not None and added._candidates is not None:
            d, node, parted = map(np.concatenate, zip(self._candidates, added._candidates))
            self._candidates = d, node, parted

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
            d, node = nearest_nodes(self.node_rest, self.means, min(4 * count + 1, len(self.node_rest)))
            self._candidates = d, node, np.zeros(d.shape, bool)
        d, node, parted = self._candidates
        reach = d[:, -1].max()
        near = (self.means >= new.min((0, 1)) - reach) & (self.means <= new.max((0, 1)) + reach)
        near = np.flatnonzero(near.all(1))
        ends = node[near]
        crossed = separated(np.repeat(self.means[near], ends.shape[1], 0), self.node_rest[ends.ravel()], new)
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
        compact = compact_weights(distances[:, :count], distances[:, count : count + 1], kept[:, :count])
        able = kept[:, 0]
        self.index[near[able]] = np.where(kept[:, :count], node[:, :count], node[:, :1])[able]
        self.weights[near[able]] = compact[able]
        return near


def crop_to_sides(means: np.ndarray, covars: np.ndarray, reach: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Make Gaussians no longer reach across a cut, so that its edges are sharp when it opens; returns the numbers of those that changed.

    A Gaussian less than `ENDS` standard deviations from a triangle below it shrinks to what of it is on its own side: that still reaches as
    far away from the cut, and as many standard deviations end at the cut. Its shape along the cut follows as if it had been cropped there.
    Triangles act one after the other, so it does not matter how cuts are divided into calls.

    Args:
        means: Gaussians at rest [N, 3], m; changed in place.
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
    if not len(some):
        return some
    x, reach = means[some], reach[some, None]
    near = (triangles.min(1) <= (x + reach).max(0)) & (triangles.max(1) >= (x - reach).min(0))
    for a, b, c in triangles[near.all(1)]:
        e1, e2 = b - a, c - a
        cross = np.cross(e1, e2)
        square = cross @ cross
        normal = cross / np.sqrt(square)
        corners = np.stack([a, b, c])
        near = np.flatnonzero(((x >= corners.min(0) - reach) & (x <= corners.max(0) + reach)).all(1))
        arm = x[near] - a
        u, v, height = arm @ np.cross(e2, cross) / square, arm @ np.cross(cross, e1) / square, arm @ normal
        along = covars[some[near]] @ normal  # [n, 3]
        spread = ENDS * np.sqrt(np.maximum(along @ normal, 0))
        over = (u >= -OVERLAP) & (v >= -OVERLAP) & (u + v <= 1 + OVERLAP) & (np.abs(height) < spread)
        near, along, height, spread = near[over], along[over], height[over], spread[over]
        kept = (1 + np.abs(height) / spread) / 2  # share of its reach
        along = along * (ENDS / spread)[:, None]  # Σ n over one standard deviation
        x[near] += (np.where(height < 0, -1, 1) * (kept * spread - np.abs(height)) / spread * ENDS)[:, None] * along
        near = some[near]
        covars[near] -= (1 - kept**2)[:, None, None] * along[:, :, None] * along[:, None]
        changed[near] = True
    means[some] = x
    return np.flatnonzero(changed)
