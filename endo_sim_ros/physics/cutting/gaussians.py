"""Gaussians beside a cut: which control nodes they follow, and how far they reach."""

import numpy as np

from endo_sim_ros.core.growing import Growing
from endo_sim_ros.physics.cutting.geometry import OVERLAP, separated
from endo_sim_ros.physics.weights import compact_weights, nearest_nodes

ENDS = 2.0  # standard deviations at which a Gaussian ends: with more, a closed cut has grey sides, with fewer, skin spans an open one


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
        self.node_rest, self._count = np.asarray(node_rest, np.float64), len(means)
        self._means = Growing(np.asarray(means, np.float64))
        self._uncut = [Growing(index), Growing(weights)]
        self._now = [Growing(index.copy()), Growing(weights.copy())]
        self._reach: Growing[np.ndarray] | None = None  # what `_farthest` returns, from the first cut on
        self._forget()

    def _forget(self) -> None:
        self.triangles = np.zeros((0, 3, 3))  # of all cuts [T, 3, 3], m, world, at rest
        # Of those that a triangle has come near: their numbers [R], and distances, nodes and whether a cut parts them [R, 4 K + 1],
        # nearest first.
        count = min(4 * self.index.shape[1] + 1, len(self.node_rest))
        kinds = np.zeros(0, int), np.zeros((0, count)), np.zeros((0, count), int), np.zeros((0, count), bool)
        self._candidates = [Growing(kind) for kind in kinds]
        self._known = Growing(np.zeros(len(self.means), bool))  # which these are [N]

    @property
    def means(self) -> np.ndarray:
        """Gaussians at rest [N, 3], m, world."""
        return self._means.rows

    @property
    def index(self) -> np.ndarray:
        """Nodes that move each Gaussian now [N, K]."""
        return self._now[0].rows

    @property
    def weights(self) -> np.ndarray:
        """Their weights now [N, K]."""
        return self._now[1].rows

    def extends(self, triangles: np.ndarray) -> bool:
        """Whether cuts [T, 3, 3] begin with those that are heeded."""
        known = len(self.triangles)
        return known <= len(triangles) and np.array_equal(triangles[:known], self.triangles)

    def heal(self) -> None:
        """Forget all cuts, and the Gaussians that were appended."""
        for each in (self._means, *self._uncut, *self._now, *([] if self._reach is None else [self._reach])):
            each.shorten(self._count)
        for now, uncut in zip(self._now, self._uncut):
            now.rows[:] = uncut.rows
        self._forget()

    def append(self, means: np.ndarray, index: np.ndarray, weights: np.ndarray) -> None:
        """Add Gaussians [n, 3] with what they follow while whole [n, K]; they heed the cuts so far, and are gone when these heal."""
        added = CutNeighbours(means, self.node_rest, index, weights)
        added.cut(self.triangles)
        added._candidates[0].rows += len(self.means)
        every = lambda some: (some._means, *some._uncut, *some._now, *some._candidates, some._known)
        for own, new in zip(every(self), every(added)):
            own.append(new.rows)
        if self._reach is not None:
            self._reach.append(added._farthest())

    def cut(self, triangles: np.ndarray) -> np.ndarray:
        """Heed all cuts [T, 3, 3], m, world, at rest, and return the numbers of the Gaussians that follow other nodes now.

        They begin with those of the last call: only what is new is looked at.
        """
        triangles = np.asarray(triangles, np.float64).reshape(-1, 3, 3)
        before, new, self.triangles = self.triangles, triangles[len(self.triangles) :], triangles.copy()
        if not len(new) or not len(self.means):
            return np.zeros(0, int)
        count = self.index.shape[1]
        self._look_at(new, before)
        numbers, d, node, parted = (each.rows for each in self._candidates)
        near = _within_reach(self.means[numbers], d[:, -1], new)
        crossed = self._crossed(numbers[near], node[near], new)
        parted[near] |= crossed
        near = near[crossed.any(1)]
        # The nodes that it follows while whole are the first of the candidates.
        near = near[(parted[near, :count] & (self._uncut[1].rows[numbers[near]] > 0)).any(1)]
        numbers = numbers[near]
        if not len(near):
            return numbers

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
        self.index[numbers[able]] = np.where(kept[:, :count], node[:, :count], node[:, :1])[able]
        self.weights[numbers[able]] = compact[able]
        return numbers

    def _look_at(self, new: np.ndarray, before: np.ndarray) -> None:
        """Find the candidates of Gaussians whose nodes new triangles [T, 3, 3] may part from them, and which triangles before do."""
        if self._reach is None:
            self._reach = Growing(self._farthest())
        near = _within_reach(self.means, self._reach.rows, new)
        fresh = near[~self._known.rows[near]]
        if not len(fresh):
            return
        self._known.rows[fresh] = True
        d, node = nearest_nodes(self.node_rest, self.means[fresh], self._candidates[1].rows.shape[1])
        for each, found in zip(self._candidates, (fresh, d, node, self._crossed(fresh, node, before))):
            each.append(found)

    def _farthest(self) -> np.ndarray:
        """How far the farthest of the nodes is that Gaussians follow while whole [N], m."""
        return np.linalg.norm(self.means[:, None] - self.node_rest[self._uncut[0].rows], axis=2).max(1)

    def _crossed(self, numbers: np.ndarray, node: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Whether triangles [T, 3, 3] part the Gaussians of these numbers [R] from nodes [R, C], bool."""
        means = np.repeat(self.means[numbers], node.shape[1], 0)
        return separated(means, self.node_rest[node.ravel()], triangles).reshape(node.shape)


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
    some = _within_reach(means, reach, triangles)
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


def _within_reach(means: np.ndarray, reach: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Numbers of the means [N, 3] that are within their reach [N] of a box around triangles [T, 3, 3]."""
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    some = np.arange(len(means))
    for axis in range(3):
        x, far = means[some, axis], reach[some]
        some = some[(x >= low[axis] - far) & (x <= high[axis] + far)]
    return some
