"""Bundle adjustment: cameras and points that features agree with best."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.sparse import bsr_array, coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import single_threaded_torch
from endo_sim_ros.reconstruction.camera_errors import LensError
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import Matches
from endo_sim_ros.reconstruction.stage_configs import PosesConfig

_ROUNDS = 3  # in which what is an outlier is told anew
_STEPS = 50  # of Levenberg and Marquardt at most; some ten do
_SETTLED = 1e-4  # part of the cost by which the last step lowers it
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e6
_LOOSE = 1e-9  # damping of points whose rays may be parallel
_NEAR, _FAR = 0.1, 10.0  # times the median depth, between which a point tells anything


class Tracks(NamedTuple):
    """Features that are one point each, of M observations."""

    views: np.ndarray  # [M]
    pixels: np.ndarray  # [M, 2]
    points: np.ndarray  # [M] numbers from 0
    beside: np.ndarray | float = 0.0  # [M] m; how far to the right of the view's left eye the one is that sees it


def least_beside(beside: Callable[[np.ndarray], np.ndarray], count: int, outlying: float) -> np.ndarray:
    """So many values, in likely errors, of which distances [M] are least: least squares with the weights of a Cauchy distribution.

    Args:
        beside: The distances, pixels, of values.
        count: Of the values.
        outlying: Distance from which on a feature counts little, pixels.
    """
    values = np.zeros(count)
    for _ in range(_ROUNDS):
        # With values far off most features are no outliers.
        scale = max(outlying, float(np.median(beside(values))))
        cost = lambda some, scale=scale: np.append(np.sqrt(np.log1p((beside(some) / scale) ** 2)), some)
        values = least_squares(cost, values, ftol=_SETTLED).x
    return values


class Bundle:
    """Poses and points of tracks. A change of a pose [6] turns the left eye about itself and then shifts what it sees, in likely errors;
    the right one goes with it."""

    def __init__(self, cameras: Sequence[Camera], tracks: Tracks, options: PosesConfig, outlying: float) -> None:
        of = lambda value: np.array([value(camera) for camera in cameras])
        self._R, self._t = of(lambda camera: camera.viewmat[:3, :3]), of(lambda camera: camera.viewmat[:3, 3])
        self._outlying, self._mount_error = outlying, options.mount_error
        focal, middle = of(lambda camera: camera.K.diagonal()[:2]), of(lambda camera: camera.K[:2, 2])
        self._views, pixels, self._points, beside = tracks
        self._beside = np.zeros((len(self._views), 3))
        self._beside[:, 0] = beside
        self._focal = focal[self._views]
        self._slopes = (pixels - middle[self._views]) / self._focal
        still = np.zeros((len(cameras), 6))
        self.likely = np.zeros(6)
        rays, moments = self._rays(still)
        points = np.linalg.solve(_damped(self._sum(rays), _LOOSE), self._sum(moments)[..., None])[..., 0]
        depths = self._seen(still, points)[1][:, 2]
        self.depth = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
        """Median distance of the points, m."""
        outside = (depths < _NEAR * self.depth) | (depths > _FAR * self.depth)
        told = np.bincount(self._points, outside, len(points)) == 0
        kept = told[self._points]
        self._views, self._points = self._views[kept], np.cumsum(told)[self._points[kept]] - 1
        self._slopes, self._focal, self._beside = self._slopes[kept], self._focal[kept], self._beside[kept]
        pairs, self._pair = np.unique(self._points * len(cameras) + self._views, return_inverse=True)
        self.points = points[told]
        """Where rays of the poses as they are meet [P, 3], m."""
        self.likely = np.repeat([np.radians(options.turn_error), options.place_error * self.depth], 3)
        """Likely errors of a pose [6], rad and m."""
        self._length = np.bincount(pairs // len(cameras), minlength=len(self.points))
        self.told = int((self._length > 2).sum())
        """Points that three views see or more."""

    def _sum(self, values: np.ndarray) -> np.ndarray:
        """Sums over the observations of each point [P, ...] of values [M, ...]."""
        return _sums(values, self._points)

    def _rays(self, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations [M, 3, 3] and [M, 3] of points on the rays of features; of their sums it is the point nearest to all."""
        R, t = (part[self._views] for part in self.poses(changes))
        t = t - self._beside
        slopes = self._slopes[..., None]
        rows, right = slopes * R[:, 2:] - R[:, :2], t[:, :2] - slopes[..., 0] * t[:, 2:]
        return rows.swapaxes(1, 2) @ rows, np.einsum("mki,mk->mi", rows, right)

    def through(self, lens: LensError, as_recorded: bool = True) -> Bundle:
        """The same with the rays that features have by this lens.

        Args:
            lens: What it does.
            as_recorded: Whether distances are pixels of the recorded pictures, as noise is. Else they are those between the rays, as
                errors of poses are, in pixels of the recorded focal length.
        """
        other = copy.copy(self)
        other._slopes, other._focal = lens.rays(self._slopes), self._focal * (lens.magnified(self._slopes) if as_recorded else 1)
        return other

    def left_out(self, changes: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Distances of features from where two other views or more have them, pixels; not more than the focal length.

        Args:
            changes: Of the other views' poses [V, 6].
            own: Of the pose of the view that is left out [V, 6].
        """
        rest, right = (self._sum(of)[self._points] - _sums(of, self._pair)[self._pair] for of in self._rays(changes))
        points = np.linalg.solve(_damped(rest, _LOOSE), right[..., None])[..., 0]
        R, t = (part[self._views] for part in self.poses(own))
        off = self._off(np.einsum("mij,mj->mi", R, points) + t - self._beside)
        distances = np.nan_to_num(np.linalg.norm(off, axis=1), nan=np.inf)
        return np.minimum(distances, self._focal[:, 0])[self._length[self._points] > 2]

    def alike(self, progress: StageProgress) -> np.ndarray:
        """The one change of all poses, [V, 6] equal rows, by which features of left-out views are nearest to where the others have them."""
        of_all = lambda change: np.tile(self._mount_error * change, (len(self._R), 1))

        def beside(change: np.ndarray) -> np.ndarray:
            progress.check()
            return self.left_out(of_all(change), of_all(change))

        return of_all(least_beside(beside, 6, self._outlying))

    def poses(self, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [V, 3, 3] and shifts [V, 3] from the world to the cameras, after changes [V, 6]."""
        changes = changes * self.likely
        turns = np.array([cv2.Rodrigues(change)[0] for change in changes[:, :3]])
        return turns @ self._R, np.einsum("vij,vj->vi", turns, self._t) + changes[:, 3:]

    def error(self, changes: np.ndarray, points: np.ndarray) -> float:
        """Median distance of features from where their points appear, pixels."""
        return float(np.median(np.linalg.norm(self._seen(changes, points)[0], axis=1)))

    def _seen(self, changes: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far features are off [M, 2], pixels, their points in the eye [M, 3], m, and its rotation [M, 3, 3]."""
        R, t = (part[self._views] for part in self.poses(changes))
        local = np.einsum("mij,mj->mi", R, points[self._points]) + t - self._beside
        return self._off(local), local, R

    def _off(self, local: np.ndarray) -> np.ndarray:
        """How far features are off [M, 2], pixels, from points in their cameras [M, 3], m."""
        with np.errstate(divide="ignore", invalid="ignore"):  # a lens that stays where it is tells no point, and that is in the lens
            return (local[:, :2] / local[:, 2:] - self._slopes) * self._focal

    def _derivatives(self, changes: np.ndarray, local: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of what `_seen` returns by the change of the pose [M, 2, 6] and by the point [M, 2, 3]."""
        by_local = np.zeros((len(local), 2, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = 1 / local[:, 2]
        by_local[:, :, 2] = -local[:, :2] / local[:, 2:] ** 2
        by_local *= self._focal[..., None]
        turning = np.cross(by_local, (local + self._beside - (changes * self.likely)[self._views, 3:])[:, None], axisb=2)
        return np.concatenate([-turning, by_local], 2) * self.likely, by_local @ R

    def adjusted(self, changes: np.ndarray, points: np.ndarray, free: bool, progress: StageProgress) -> tuple[np.ndarray, np.ndarray]:
        """Changes [V, 6] and points [P, 3] of least cost, from those given; the changes stay unless they are free."""
        damping, (off, local, R) = _FIRST_DAMPING, self._seen(changes, points)
        for _ in range(_STEPS):
            # Of poses far off most features are no outliers.
            scale = max(self._outlying, float(np.median(np.linalg.norm(off, axis=1))))
            now, step = _cost(off, changes, scale), self._step(changes, off, local, R, scale)
            while damping < _MOST_DAMPING:
                progress.check()
                of_poses, of_points = step(damping, free)
                tried = changes + of_poses, points + of_points
                off, local, R = self._seen(*tried)
                if (then := _cost(off, tried[0], scale)) < now:
                    break
                damping *= 10
            else:
                return changes, points
            changes, points = tried
            damping /= 10
            if now - then < _SETTLED * now:
                break
        return changes, points

    def _step(
        self, changes: np.ndarray, off: np.ndarray, local: np.ndarray, R: np.ndarray, scale: float
    ) -> Callable[[float, bool], tuple[np.ndarray, np.ndarray]]:
        """A function that returns a step of Levenberg and Marquardt, of a damping and whether poses are free."""
        cameras, count = len(changes), len(self.points)
        weights = 1 / (1 + (off**2).sum(1) / scale**2)
        by_pose, by_point = self._derivatives(changes, local, R)
        weighted = weights[:, None, None] * by_pose
        points = self._sum(np.einsum("m,mki,mkj->mij", weights, by_point, by_point))
        of_points, of_poses = self._sum(np.einsum("m,mki,mk->mi", weights, by_point, off)), changes.copy()
        np.add.at(of_poses, self._views, np.einsum("mki,mk->mi", weighted, off))
        poses = np.zeros((cameras, 6, 6)) + np.eye(6)
        np.add.at(poses, self._views, weighted.swapaxes(1, 2) @ by_pose)
        across = _blocks(weighted.swapaxes(1, 2) @ by_point, self._views, self._points, (cameras, count))

        def step(damping: float, free: bool) -> tuple[np.ndarray, np.ndarray]:
            inverse = _diagonal(np.linalg.inv(_damped(points, damping)))
            change = np.zeros(6 * cameras)
            if free:  # points are eliminated first (Schur complement)
                through = across @ inverse
                left = _diagonal(_damped(poses, damping)) - through @ across.T
                right = through @ of_points.ravel() - of_poses.ravel()
                with single_threaded_torch():  # with more, the last bits may be others
                    change = torch.linalg.solve(torch.from_numpy(left.toarray()), torch.from_numpy(right)).numpy()
            moved = inverse @ -(of_points.ravel() + across.T @ change)
            return change.reshape(-1, 6), moved.reshape(-1, 3)

        return step


def _sums(values: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Sums of values [M, ...] of equal numbers [M], which begin with 0."""
    sums = np.zeros((numbers.max(initial=-1) + 1, *values.shape[1:]))
    np.add.at(sums, numbers, values)
    return sums


def _cost(off: np.ndarray, changes: np.ndarray, scale: float) -> float:
    """What is least where features [M, 2], pixels, are off by little, few by more than a scale, and poses [V, 6] change by little."""
    return float(scale**2 * np.log1p((off**2).sum(1) / scale**2).sum() + (changes**2).sum())


def _damped(blocks: np.ndarray, damping: float) -> np.ndarray:
    """Square matrices [N, n, n] whose diagonals are greater by a share."""
    return blocks + damping * blocks * np.eye(blocks.shape[1]) + 1e-12 * np.eye(blocks.shape[1])


def _diagonal(blocks: np.ndarray) -> csr_array:
    """The matrix of square blocks [N, n, n] on its diagonal."""
    count, size = blocks.shape[:2]
    return csr_array(bsr_array((blocks, np.arange(count), np.arange(count + 1)), shape=(count * size, count * size)))


def _blocks(values: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> csr_array:
    """The matrix of blocks [M, n, m] at rows and columns of blocks [M]; those at one place add up."""
    height, width = values.shape[1:]
    at = np.broadcast_arrays(height * rows[:, None, None] + np.arange(height)[:, None], width * columns[:, None, None] + np.arange(width))
    return csr_array(coo_array((values.ravel(), tuple(each.ravel() for each in at)), shape=(height * shape[0], width * shape[1])))


def shared_tracks(matches: Sequence[Matches], cameras: int, most: int, progress: StageProgress) -> Tracks:
    """Features that matches say are one, the longest tracks first, until each view has so many; none that a view has twice."""
    views = np.concatenate([np.zeros(0, int), *(np.full(len(uv), view) for match in matches for view, uv in zip(match.views, match[1:]))])
    pixels = np.concatenate([np.zeros((0, 2)), *(uv for match in matches for uv in match[1:])])
    # As numbers, which are sorted faster than rows: of the places in each view, then of these and the views.
    places, place = np.unique(pixels @ [1, 1j], return_inverse=True)
    features, number = np.unique(views * len(places) + place.ravel(), return_inverse=True)
    ends, at = [np.zeros((2, 0), int)], 0
    for match in matches:
        count = len(match.first)
        ends.append(number.ravel()[at : at + 2 * count].reshape(2, count))
        at += 2 * count
    links = np.concatenate(ends, axis=1)
    size = len(features)
    count, track = connected_components(coo_array((np.ones(links.shape[1]), tuple(links)), shape=(size, size)), directed=False)
    of_view, place = np.divmod(features, max(len(places), 1))
    length = np.bincount(track, minlength=count)
    once = np.bincount(np.unique(track * np.int64(cameras) + of_view) // cameras, minlength=count) == length
    members = np.split(np.argsort(track, kind="stable"), np.cumsum(length)[:-1]) if count else []
    mixed = np.random.default_rng(0).permutation(count)  # tracks of one length come from all over the pictures
    have, kept = np.zeros(cameras, int), np.zeros(count, bool)
    for order, chosen in enumerate(mixed[np.argsort(-length[mixed], kind="stable")]):
        if order % 1000 == 0:
            progress.check()
        shown = of_view[members[chosen]]
        if once[chosen] and (have[shown] < most).any():
            kept[chosen] = True
            have[shown] += 1
    some = kept[track]
    uv = np.column_stack([places.real, places.imag])[place[some]]
    return Tracks(of_view[some], uv, np.cumsum(kept)[track[some]] - 1)
