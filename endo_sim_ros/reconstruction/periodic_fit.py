"""Motions that go on periodically, fitted to points that were tracked through posed images: least squares with all rays at once."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.smooth_fields import smoothed
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion, cosines, waves
from endo_sim_ros.reconstruction.bundle import Tracks
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.stage_configs import MotionSearchConfig

_RIDGE = 0.02  # metres: how far tissue moves; only what rays do not see of a motion is bound by it
_ROUNDS = 20  # of telling the way and the shares of it in turns
_TURNS = 2  # of telling these and the rate in turns, and of breath and heart
HARMONICS = 3  # of a breath's way: people breathe out longer than in
BAND = 0.45  # of the rate of images: up to half of it rates are told apart
_MOST = 1.5  # share, of that which nineteen of twenty points do not reach: few rays tell a share badly
_TRACKS = 5  # times as many tracks as points are followed at a time tell the motion
FEWEST = 12  # images that tell a point's share of a way that is known
_UNSEEN = 0.01  # pixels²: a way that moves a point by less does not tell its share
_REWEIGHTED = 3  # times that shares are smoothed anew; eight tell the same
_NEXT = 6  # points next to one: where these agree with it, what moves is small, and no highlight
_SLIP = 0.02  # of a share: what its rays do not tell of its error, as they slip along edges
_NUMBERS = 1_200_000  # in an array of what the drift of some tracks takes with it; there are four such


Eyes = list[tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Of each image the pose [4, 4], and the intrinsics [3, 3] of the left and of the right camera."""


@dataclass
class Track:
    """A point through the images in a row that it is seen in, from the image of a number on: pixels, and those in the right image."""

    first: int
    left: list[np.ndarray]
    right: list[np.ndarray]  # NaN where it is not found there

    def at(self, image: int) -> tuple[np.ndarray, np.ndarray]:
        """Where it is in the left and in the right image of a number in which it is seen, pixels."""
        number = image - self.first
        return self.left[number], self.right[number] if number < len(self.right) else np.full(2, np.nan)


class Seen(NamedTuple):
    """What a search found."""

    name: str
    drift: int
    harmonics: int
    rate: float = 0.0  # Hz
    pixels: float = 0.0  # that it explains, 0 of less than the least
    explained: float = 0.0
    sure: bool = False


class _Drift(NamedTuple):
    """What each of N points follows as it likes: a cosine series, and the lens."""

    basis: np.ndarray  # [T, D]
    held: np.ndarray  # inverse of what the rays tell of it, and of what is known before [N, 3 D, 3 D], m²
    loose: np.ndarray  # what is known before [3 D], 1/m²
    side: np.ndarray  # [N, 3 D], 1/m


@dataclass(frozen=True)
class Rays:
    """What is seen of N tracks: normal equations of each observation, in pixels."""

    times: np.ndarray  # [T] s
    lens: np.ndarray  # [T, 6], axis and place of the left lens, less their means, of standard deviation 1
    middles: np.ndarray  # [N, 3] m, world: what positions count from
    planes: np.ndarray  # [N, T, 3, 3], weighted sum of I − d dᵀ over the eyes' rays d; 0 where it is not seen
    sides: np.ndarray  # [N, T, 3], these times where the rays pass the middle
    squares: np.ndarray  # [N, T]
    counts: np.ndarray  # [N] observed coordinates
    tracks: list[Track]  # N
    eyes: Eyes  # T
    baseline: float  # m; 0: one lens
    progress: StageProgress  # is asked whether to go on

    @classmethod
    def of(
        cls, tracks: list[Track], times: np.ndarray, eyes: Eyes, baseline: float, options: MotionSearchConfig, progress: StageProgress
    ) -> "Rays":
        """Of the longest tracks, longest first."""
        tracks = sorted((track for track in tracks if len(track.left) >= FEWEST), key=lambda track: -len(track.left))
        tracks = tracks[: _TRACKS * options.points]
        return cls._through(tracks, times - times[0], eyes, baseline, progress, np.zeros((len(tracks), len(times), 3)))

    def about(self, moved: np.ndarray) -> "Rays":
        """The same where points are known to move by [N, T, 3], m: a step of Gauss and Newton.

        Only rays of one lens count to first order about where a point is. That of still rays is too near, since a motion that does not
        go with the lens looks like parallax, and about there a motion is told too short.
        """
        return self._through(self.tracks, self.times, self.eyes, self.baseline, self.progress, moved)

    @classmethod
    def _through(
        cls, tracks: list[Track], times: np.ndarray, eyes: Eyes, baseline: float, progress: StageProgress, moved: np.ndarray
    ) -> "Rays":
        """Of all these tracks but those behind the lens, about points that move by [N, T, 3], m."""
        shape = len(tracks), len(times)
        planes, sides, squares = np.zeros((*shape, 3, 3)), np.zeros((*shape, 3)), np.zeros(shape)
        counts, middles, ahead = np.zeros(len(tracks)), np.zeros((len(tracks), 3)), np.zeros(len(tracks), bool)
        poses, lefts, rights = map(np.array, zip(*eyes))
        for n, track in enumerate(tracks):
            progress.check()
            numbers = track.first + np.arange(len(track.left))
            beside = np.array(track.right, np.float64).reshape(-1, 2)
            both = np.flatnonzero(np.isfinite(beside).all(1))
            each = np.concatenate([numbers, numbers[both]])
            pixels = np.concatenate([np.array(track.left, np.float64), beside[both]])
            K = np.concatenate([lefts[numbers], rights[numbers[both]]])
            directions, focal = _directions(pixels, poses[each], K), K[:, 0, 0]
            origins = poses[each, :3, 3] + baseline * poses[each, :3, 0] * (np.arange(len(each)) >= len(numbers))[:, None]
            across = _across(directions)
            normal = across.sum(0) + 1e-6 * np.eye(3)
            middles[n] = np.linalg.solve(normal, np.einsum("kij,kj->i", across, origins - moved[n, each]))
            still = middles[n] - origins
            towards = still + moved[n, each]
            far = np.linalg.norm(towards, axis=1, keepdims=True).clip(1e-3)
            weights = (focal / far[:, 0]) ** 2
            ahead[n] = np.median((towards * directions).sum(1)) > 0
            passes = far * directions / (directions * towards / far).sum(1, keepdims=True).clip(0.1) - still
            # With one lens across where it is still: across its own rays a point would err least that slides to the lens.
            across = across if baseline else _across(still / np.linalg.norm(still, axis=1, keepdims=True).clip(1e-3))
            aside = np.einsum("kij,kj->ki", across, passes)
            np.add.at(planes[n], each, weights[:, None, None] * across)
            np.add.at(sides[n], each, weights[:, None] * aside)
            np.add.at(squares[n], each, weights * (aside**2).sum(1))
            counts[n] = 2 * len(each)
        lens = poses[:, :3, 2:].reshape(len(times), -1)
        lens = (lens - lens.mean(0)) / lens.std(0).clip(1e-9)
        rays = cls(times, lens, middles, planes, sides, squares, counts, tracks, eyes, baseline, progress)
        return rays._of(np.flatnonzero(ahead))

    def features(self, images: dict[int, Camera], moved: np.ndarray, most: int) -> Tracks:
        """Where some images show points, as if they had not moved.

        Args:
            images: Their cameras by their numbers.
            moved: How far the points move in all images [N, T, 3], m.
            most: Of the points that three of the images show or more, the longest tracks first.
        """
        first = np.array([track.first for track in self.tracks])
        end = first + [len(track.left) for track in self.tracks]
        shown = np.array([(first <= image) & (image < end) for image in images])
        kept = np.flatnonzero(shown.sum(0) > 2)[:most]
        parts = [Tracks(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0, int), np.zeros(0))]
        for view, (image, camera) in enumerate(images.items()):
            points = np.flatnonzero(shown[view, kept])
            some, right = kept[points], self.eyes[image][2]
            seen = np.array([self.tracks[n].at(image) for n in some]).reshape(-1, 2, 2) + 0.5
            # As if the right eye had the intrinsics of the left one.
            seen[:, 1] = (seen[:, 1] - right[:2, 2]) / right.diagonal()[:2] * camera.K.diagonal()[:2] + camera.K[:2, 2]
            for eye, pixels, beside in zip((camera, camera.beside(self.baseline)), seen.swapaxes(0, 1), (0.0, self.baseline)):
                at_rest = self.middles[some]
                way = eye.project(at_rest + moved[some, image])[0] - eye.project(at_rest)[0]
                found = np.isfinite(pixels).all(1)
                count = int(found.sum())
                parts.append(Tracks(np.full(count, view), (pixels - way)[found], points[found], np.full(count, beside)))
        return Tracks(*(np.concatenate(arrays) for arrays in zip(*parts)))

    def longest(self, seconds: float) -> "Rays":
        """Of the tracks that are long enough, s, to tell a way."""
        unknown = 3 * (1 + 6 + 2 * HARMONICS)  # coordinates: of its mean, by the lens, of its way
        images = (np.einsum("ntii->nt", self.planes) > 0).sum(1)
        return self.first(int((images >= max(seconds / self.interval, unknown / 2)).sum()))

    def first(self, count: int) -> "Rays":
        """Of the first tracks alone."""
        return self._of(np.arange(min(count, len(self.counts))))

    def _of(self, numbers: np.ndarray) -> "Rays":
        """Of the tracks of these numbers alone."""
        arrays = {name: getattr(self, name)[numbers] for name in ("middles", "planes", "sides", "squares", "counts")}
        return replace(self, tracks=[self.tracks[number] for number in numbers], **arrays)

    def less(self, moved: np.ndarray) -> "Rays":
        """As if points had not moved by [N, T, 3], m."""
        along = np.einsum("ntij,ntj->nti", self.planes, moved)
        squares = self.squares + (moved * (along - 2 * self.sides)).sum(-1)
        return replace(self, sides=self.sides - along, squares=squares)

    def _told(self, rate: float, harmonics: int) -> int:
        """How many harmonics of a rate (Hz), at most so many, images can tell that follow each other so slowly; at least one."""
        return max(min(harmonics, int(BAND / (rate * self.interval))), 1)

    @property
    def interval(self) -> float:
        """Between images, s."""
        return float(np.median(np.diff(self.times)))

    def _slow(self, drift: int) -> np.ndarray:
        """What every point follows as it likes [T, D]: a cosine series of so many terms, the first of which is one, and the lens."""
        # Highlights slide with the lens, and what is followed slips as the light turns: without it both look like a motion of tissue.
        return np.concatenate([cosines(self.times / self.times[-1], drift), self.lens], 1)

    def _drifting(self, drift: int) -> _Drift:
        """What a search of rates needs of drift by so many terms, which are many more than those of a motion."""
        slow, count = self._slow(drift), len(self.counts)
        size = 3 * slow.shape[1]
        free = np.einsum("ta,tb,ntij->naibj", slow, slow, self.planes, optimize=True).reshape(count, size, size)
        loose = self._loose(slow.shape[1])
        side = np.einsum("ta,nti->nai", slow, self.sides).reshape(count, -1)
        return _Drift(slow, np.linalg.inv(free + np.diag(loose)), loose, side)

    def _beside(self, basis: np.ndarray, slow: _Drift) -> np.ndarray:
        """Terms of the normal equations between a motion of this basis [T, B] and drift [N, 3 B, 3 D]."""
        terms = np.einsum("tk,ta->tka", basis, slow.basis).reshape(len(basis), basis.shape[1] * slow.basis.shape[1])
        planes = self.planes.transpose(0, 2, 3, 1).reshape(-1, len(basis))
        cross = (planes @ terms).reshape(len(self.counts), 3, 3, basis.shape[1], slow.basis.shape[1])
        return cross.transpose(0, 3, 1, 4, 2).reshape(len(cross), 3 * basis.shape[1], 3 * slow.basis.shape[1])

    def _waves(self, rate: float, harmonics: int) -> np.ndarray:
        """The basis [T, 2 H] of motions of a rate (Hz), of at most so many harmonics."""
        return waves(self.times * rate, self._told(rate, harmonics))

    def _solved(self, basis: np.ndarray, slow: _Drift) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients of a motion of this basis [T, B] for each point [N, 3 B], m, what the rays tell of them beside its drift, which is
        eliminated (Schur's complement) [N, 3 B, 3 B], 1/m², and the mean square left over [N], pixels²."""
        self.progress.check()
        count, size = len(self.counts), 3 * basis.shape[1]
        loose = self._loose(1 + basis.shape[1])[3:]
        normal = np.einsum("ta,tb,ntij->naibj", basis, basis, self.planes, optimize=True).reshape(count, size, size) + np.diag(loose)
        side = np.einsum("ta,nti->nai", basis, self.sides).reshape(count, size, 1)
        cross, theirs = self._beside(basis, slow), slow.side[..., None]
        through = cross @ slow.held
        free = normal - through @ cross.swapaxes(1, 2)
        found = np.linalg.solve(free, side - through @ theirs)
        drift = slow.held @ (theirs - cross.swapaxes(1, 2) @ found)
        pairs = ((found, side, loose), (drift, theirs, slow.loose))
        explained = sum((x * (by + bound[:, None] * x)).sum((1, 2)) for x, by, bound in pairs)
        left = (self.squares.sum(1) - explained).clip(0) / (self.counts - size - len(slow.loose)).clip(1)
        return found[..., 0], free, left

    def _loose(self, terms: int) -> np.ndarray:
        """What is known of the coefficients of so many terms before anything is seen [3 · terms], 1/m²."""
        # A motion along the only ray to a point is not seen; it is taken to be none.
        return np.r_[np.full(3, 1e-6), np.full(3 * (terms - 1), 1.0)] / _RIDGE**2

    def search(
        self, name: str, drift: int, harmonics: int, shortest: float, longest: float, least: float, share: float, cycles: float
    ) -> Seen:
        """The motion with a period (s) in between that explains most, and whether it is one.

        Args:
            name: Of the motion.
            drift: Terms of a cosine series that every point may follow besides.
            harmonics: Of the motion.
            shortest, longest: Periods, s.
            least: Pixels that it must explain.
            share: Share that it must explain.
            cycles: Periods that must be seen.
        """
        if longest <= shortest or self.interval > BAND * shortest:  # what is faster than images tell looks like something slower
            return Seen(name, drift, harmonics)
        slow = self._drifting(drift)
        left_over = lambda rate: self._solved(self._waves(rate, harmonics), slow)[2]
        before = self._solved(np.zeros((len(self.times), 0)), slow)[2]
        rates = np.linspace(1 / longest, 1 / shortest, max(int(3 * self.times[-1] * (1 / shortest - 1 / longest)), 3))
        power = np.array([_explained(before, left_over(rate)) for rate in rates])
        peak = int(power.argmax())
        if power[peak] < least:
            return Seen(name, drift, harmonics)
        gain = before - left_over(rates[peak])
        most = gain >= np.quantile(gain, 0.8)  # a motion has its place
        rate = float(_refined(lambda rate: -float(left_over(rate)[most].sum()), rates[peak], rates[1] - rates[0]))
        explained = 1 - float(left_over(rate)[most].sum() / before[most].sum())
        inside = 0 < peak < len(rates) - 1  # what grows towards longer periods is drift
        sure = inside and rate * float(self.times[-1]) >= cycles and explained >= share
        return Seen(name, drift, harmonics, rate, float(power[peak]), explained, sure)

    def fitted(self, rate: float, harmonics: int, drift: int) -> tuple[float, np.ndarray, np.ndarray]:
        """A motion in which all points move alike, each by a share of its own.

        So each tells what its rays see of the way, and together they tell all of it.

        Args:
            rate: About its rate, Hz.
            harmonics: Of its way.
            drift: Terms of a cosine series that every point may follow besides.

        Returns:
            Its rate, its way [2 H, 3] (m) and the shares [N].
        """
        way, shares, slow = np.zeros(0), np.ones(len(self.counts)), self._drifting(drift)
        harmonics = self._told(1.1 * rate, harmonics)  # whatever it is refined to
        for _ in range(_TURNS):
            found, free, left = self._solved(self._waves(rate, harmonics), slow)
            free = free / (left + np.median(left))[:, None, None]  # what slips tells less
            if not len(way):
                way = np.median(found, 0)
            for _ in range(_ROUNDS):
                seen = free @ way
                shares = (seen * found).sum(1) / (seen @ way).clip(1e-12)
                weighted = shares[:, None, None] * free
                way = np.linalg.solve(np.einsum("n,nab->ab", shares, weighted), np.einsum("nab,nb->a", weighted, found))
            together = self._together(slow, shares, left)
            rate = _refined(lambda rate: -self._left_together(rate, harmonics, together), rate, 0.05 / self.times[-1])
        scale = np.quantile(np.abs(shares), 0.95) * (1 if np.median(shares) >= 0 else -1)
        return rate, (scale * way).reshape(-1, 3), (shares / scale).clip(-_MOST, _MOST)

    def irregular(self, path: np.ndarray, shares: np.ndarray) -> float:
        """Root mean square by which the way that all points go together, image by image, differs from a path [T, 3], m, of which they go
        shares [N], of that of the path."""
        alike, side = self._otherwise(path, shares)
        other = np.linalg.solve(alike, side[..., None])[..., 0]
        square = lambda way: np.einsum("ti,tij,tj->", way, alike, way)
        return float(np.sqrt(square(other) / square(path)))

    def _otherwise(self, path: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of each image, [T, 3, 3] and [T, 3], of what points go together beside a path by the same shares."""
        # About where each point is on average. What slides with the lens is not taken out: half of an irregular breath would go with it.
        alike = self.planes.sum(1) + self._loose(1)[0] * np.eye(3)
        left = self.sides - np.einsum("ntij,n,tj->nti", self.planes, shares, path)
        left -= np.einsum("ntij,nj->nti", self.planes, np.linalg.solve(alike, left.sum(1)[..., None])[..., 0])
        alike = np.einsum("n,ntij->tij", shares**2, self.planes) + np.eye(3) / _RIDGE**2
        return alike, np.einsum("n,nti->ti", shares, left)

    def _together(self, slow: _Drift, shares: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations [3 T, 3 T] and [3 T] of a path [T, 3] of which points go shares [N], with their drift eliminated; each weighs
        less the more is `left` [N] of it. A motion of any rate is such a path."""
        weights, (count, images) = shares / (left + np.median(left)), self.squares.shape
        alike = np.einsum("n,ntij->tij", weights * shares, self.planes)
        side = (weights @ self.sides.reshape(count, -1)).reshape(-1)
        normal = np.zeros((images, 3, images, 3))
        normal[np.arange(images), :, np.arange(images)] = alike
        normal = normal.reshape(3 * images, -1)
        at_a_time = max(_NUMBERS // (9 * slow.basis.size), 1)
        for first in range(0, count, at_a_time):
            self.progress.check()
            some = slice(first, first + at_a_time)
            cross = np.einsum("ntij,ta->ntiaj", self.planes[some], slow.basis).reshape(len(weights[some]), 3 * images, -1)
            through = cross @ slow.held[some]
            side -= np.einsum("n,nab,nb->a", weights[some], through, slow.side[some], optimize=True)
            through = ((weights * shares)[some, None, None] * through).transpose(1, 0, 2).reshape(len(side), -1)
            normal -= through @ cross.transpose(1, 0, 2).reshape(len(side), -1).T
        return normal, side

    def _left_together(self, rate: float, harmonics: int, together: tuple[np.ndarray, np.ndarray]) -> float:
        """Squares, less a constant, left over where points go `together` the best way."""
        self.progress.check()
        basis = np.kron(waves(self.times * rate, harmonics), np.eye(3))
        normal, side = together
        right = basis.T @ side
        return -float(right @ np.linalg.solve(basis.T @ normal @ basis, right))

    def moved(self, seen: Seen, most_irregular: float) -> np.ndarray:
        """How far a motion moves the points [N, T, 3], m; one that is more irregular than this (see `irregular`) as it goes in each image.

        Else what no period tells of an irregular breath looks like a heart. A heart goes another way, or by other shares, and is left.
        """
        rate, way, shares = self.fitted(seen.rate, seen.harmonics, seen.drift)
        path = waves(self.times * rate, len(way) // 2) @ way
        if self.irregular(path, shares) > most_irregular:
            alike, side = self._otherwise(path, shares)
            axis = np.linalg.svd(path, full_matrices=False)[2][0]  # along it alone, so that less of a heart goes with it
            path = path + np.outer(side @ axis / (alike @ axis @ axis), axis)
        return shares[:, None, None] * path

    def followed(self, part: PeriodicMotion, terms: int) -> PeriodicMotion:
        """The part with what all points do together beside its period, along the axis of its way: a cosine series of so many terms."""
        periodic, series = waves(self.times / part.period, len(part.way) // 2), cosines(self.times / self.times[-1], terms)
        axis = np.linalg.svd(periodic @ part.way, full_matrices=False)[2][0]  # along it alone, so that less of a heart goes with it

        def along(basis: np.ndarray, way: np.ndarray) -> np.ndarray:
            """Coefficients of a basis [T, B] by which points go together beside a way."""
            alike, side = self._otherwise(periodic @ way, part.shares)
            normal = (basis.T * (alike @ axis @ axis)) @ basis + np.eye(basis.shape[1]) / _RIDGE**2
            return np.linalg.solve(normal, basis.T @ (side @ axis))

        way = part.way + np.outer(along(periodic, part.way), axis)  # else some of the period is told beside it, and physics lacks it
        return replace(part, way=np.concatenate([way, axis[None]]), beside=along(series, way))

    def motion_of(
        self, seen: Sequence[Seen], start: float, every: "Rays", most_irregular: float, drift: int
    ) -> tuple[TissueMotion, list[float]]:
        """What was seen, with the shares of every point there is, and how `irregular` each is; phases are 0 at a time, s.

        A breath that is more irregular than this is `followed` by as many terms as a heart's drift, which are slower than a heart.
        """
        moved, irregular, parts = [np.zeros(self.sides.shape) for _ in seen], [0.0] * len(seen), []
        for _ in range(_TURNS if len(seen) > 1 else 1):
            parts = []
            for index, each in enumerate(seen):
                others = sum((m for i, m in enumerate(moved) if i != index), np.zeros(self.sides.shape))
                rest = self.less(others)
                rate, way, shares = rest.fitted(each.rate, max(each.harmonics, HARMONICS), each.drift)
                part = PeriodicMotion(each.name, float(1 / rate), each.explained, float(self.times[-1] * rate), way, shares)
                irregular[index] = rest.irregular(part.path(self.times), shares)
                if each.name == "breathing" and irregular[index] > most_irregular:
                    part = rest.followed(part, drift)
                parts.append(part)
                moved[index] = shares[:, None, None] * part.where(self.times)
        return every.shared(start, parts), irregular

    def shared(self, start: float, parts: Sequence[PeriodicMotion]) -> TissueMotion:
        """Parts of a motion, of which longer tracks told the ways, with the shares of these points; phases are 0 at a time, s.

        What the lens leaves soon is not seen for two breaths. Its shares are less certain, and all are told by those near them, of
        which those count less that differ from the others and from the points next to them.
        """
        slow, paths = self._slow(1), np.stack([part.where(self.times) for part in parts], 2)  # [T, D], [T, 3, parts]
        terms = np.concatenate([np.kron(slow[:, None], np.eye(3)), paths], 2)
        count, size = len(self.counts), terms.shape[2]
        pairs = np.einsum("tia,tjb->tijab", terms, terms).reshape(-1, size**2)
        normal = (self.planes.reshape(count, -1) @ pairs).reshape(count, size, size)
        side = self.sides.reshape(count, -1) @ terms.reshape(-1, size)
        told = np.linalg.inv(normal + np.diag(np.r_[self._loose(slow.shape[1]), np.full(len(parts), _UNSEEN)]))
        found = np.einsum("nab,nb->na", told, side)
        left = self.squares.sum(1) - 2 * (side * found).sum(1) + np.einsum("na,nab,nb->n", found, normal, found)
        left = left.clip(0) / (self.counts - 3 - len(parts)).clip(1)
        variances = np.einsum("naa->na", told) * (left + np.median(left))[:, None]
        points, shared = self.middles + found[:, :3], []
        nearest = np.atleast_2d(KDTree(points).query(points, k=min(_NEXT, len(points) - 1) + 1)[1])[:, 1:]
        for part, shares, variance in zip(parts, found.T[-len(parts) :].clip(-_MOST, _MOST), variances.T[-len(parts) :] + _SLIP**2):
            smooth, apart = smoothed(points, shares, 1 / variance), np.abs(shares - np.median(shares[nearest], 1))
            for _ in range(_REWEIGHTED):  # Cauchy: a point that went with a highlight differs from all around, and from those next to it
                smooth = smoothed(points, shares, 1 / (variance + np.minimum(apart, np.abs(shares - smooth)) ** 2))
            shared.append(replace(part, shares=smooth))
        return TissueMotion(start, points, tuple(shared))


def _across(directions: np.ndarray) -> np.ndarray:
    """Projections [k, 3, 3] across unit directions [k, 3]."""
    return np.eye(3) - directions[:, :, None] * directions[:, None, :]


def _directions(pixels: np.ndarray, poses: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Unit directions [k, 3], world, of pixels [k, 2] whose indices count from the centre of the first, in cameras [k, 4, 4], [k, 3, 3]."""
    x, y = ((pixels[:, i] + 0.5 - K[:, i, 2]) / K[:, i, i] for i in (0, 1))
    directions = (poses[:, :3, :3] @ np.stack([x, y, np.ones(len(x))], 1)[..., None])[..., 0]
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _explained(before: np.ndarray, after: np.ndarray) -> float:
    """Root mean square, pixels, that a motion explains of what was left over [N], where it explains most: a motion has its place."""
    return max(float(np.quantile(before - after, 0.9)), 0.0) ** 0.5


def _refined(power: Callable[[float], float], rate: float, step: float) -> float:
    """The rate of the greatest power near one, to a hundred-thousandth of it."""
    power = functools.cache(power)  # half of those that are compared were looked at with the step before
    while step > 1e-5 * rate:
        rate = max((rate + step * part for part in (0, -1, -0.5, 0.5, 1)), key=power)
        step /= 2
    return rate
