"""Whether tissue moves periodically by itself, as by breath and heart: told from tracks of points through a posed recording."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.stage_configs import MotionSearchConfig

_RIDGE = 0.02  # metres: how far tissue moves; only what rays do not see of a motion is bound by it
_ROUNDS = 20  # of telling the way and the shares of it in turns
_PHASES = 64  # places along a period at which a motion is looked at
_LOOK: dict[str, Any] = dict(winSize=(15, 15), maxLevel=4)  # of optical flow
_DISTANCE = 7  # pixels between tracked points


@dataclass(frozen=True)
class TissueMotion:
    """A periodic motion of tissue.

    Args:
        period: s.
        amplitude: How far tissue goes, there or back, where it goes farthest, m; nineteen of twenty points go less far.
        explained: Share, 0 to 1, of what still points leave over that it explains, where it explains most.
        cycles: Number of periods that were watched.
    """

    period: float
    amplitude: float
    explained: float
    cycles: float


@dataclass
class _Track:
    """A point through the images in a row that it is seen in, from the image of a number on: pixels, and those in the right image."""

    first: int
    left: list[np.ndarray]
    right: list[np.ndarray]  # NaN where it is not found there


class MotionWatch:
    """Looks for periodic motion of tissue while the frames of a recording go by.

    For a period, every track is triangulated as a point that moves with it: linear least squares with its rays, of both eyes where
    there are two, so that poses tell the motion of the camera from that of the tissue. The period that explains most of what a still
    point leaves over is the motion's: the periodogram of Lomb (1976) and Scargle (1982), of all tracks at once.

    Args:
        options: Of the search.
    """

    def __init__(self, options: MotionSearchConfig = MotionSearchConfig()):
        self.options = options
        self._times: list[float] = []
        self._eyes: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # pose, K of the left and of the right camera
        self._baseline = 0.0
        self._ended: list[_Track] = []
        self._tracks: list[_Track] = []
        self._before: np.ndarray | None = None

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames, each looked at as it goes by, until there are enough."""
        for frame in frames:
            if len(self._times) < self.options.images:
                self.look(frame)
            yield frame

    def look(self, frame: Frame) -> None:
        """Follow points into a frame; one that comes too soon after the last is left out."""
        seconds = frame.stamp_ns * 1e-9
        if self._times and seconds - self._times[-1] < 0.999 / self.options.rate:
            return
        scale = min(self.options.width / frame.camera.width, 1.0)
        size = round(frame.camera.width * scale), round(frame.camera.height * scale)
        gray = [None if image is None else cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
                for image in (frame.image, frame.right)]  # fmt: skip
        image, right = gray
        assert image is not None
        fit = np.diag([size[0] / frame.camera.width, size[1] / frame.camera.height, 1.0])
        right_K = frame.camera.K if frame.right_K is None else frame.right_K
        number = len(self._times)
        self._times.append(seconds)
        self._eyes.append((frame.camera.pose, fit @ frame.camera.K, fit @ right_K))
        self._baseline = frame.baseline or self._baseline
        if self._before is not None and self._before.shape != image.shape:
            self._ended, self._tracks = self._ended + self._tracks, []
        if self._before is not None and self._tracks:
            was = np.array([track.left[-1] for track in self._tracks], np.float32)
            now, good = _followed(self._before, image, was, was)
            self._ended += [track for track, kept in zip(self._tracks, good) if not kept]
            self._tracks = [track for track, kept in zip(self._tracks, good) if kept]
            for track, place in zip(self._tracks, now[good]):
                track.left.append(place)
        free = np.full(image.shape, 255, np.uint8) if frame.mask is None else cv2.resize(frame.mask, size, interpolation=cv2.INTER_NEAREST)
        for track in self._tracks:
            cv2.circle(free, (round(float(track.left[-1][0])), round(float(track.left[-1][1]))), _DISTANCE, 0, -1)
        wanted = self.options.points - len(self._tracks)
        if wanted > self.options.points // 10:
            found = cv2.goodFeaturesToTrack(image, wanted, 0.01, _DISTANCE, mask=free)
            self._tracks += [_Track(number, [place], []) for place in (() if found is None else found[:, 0])]
        if right is not None and self._tracks:
            places = np.array([track.left[-1] for track in self._tracks], np.float32)
            guesses = [track.left[-1] - (track.left[-2] - track.right[-1] if track.right else 0) for track in self._tracks]
            guesses = np.where(np.isfinite(guesses), guesses, places).astype(np.float32)
            found, good = _followed(image, right, places, guesses)
            good &= np.abs(found[:, 1] - places[:, 1]) < 1.5
            for track, place, kept in zip(self._tracks, found, good):
                track.right += [np.full(2, np.nan)] * (len(track.left) - 1 - len(track.right)) + [place if kept else np.full(2, np.nan)]
        self._before = image

    def found(self) -> tuple[list[TissueMotion], str]:
        """The motions, breath before heart, and a sentence that says so or why nothing can be told."""
        options, times = self.options, np.array(self._times)
        length = float(np.ptp(times)) if len(times) else 0.0
        if length < options.least_cycles * options.shortest_beat or len(times) < 10:
            return [], f"whether the tissue moves by itself cannot be told from {length:.1f} s"
        rays = _Rays.of(self._ended + self._tracks, times, self._eyes, self._baseline, options)
        if rays is None:
            return [], "whether the tissue moves by itself cannot be told: too few points could be followed for long"
        between, drift = options.shortest_breath, 1 + int(2 * length / options.shortest_breath)
        slowest = min(options.longest_breath, length / options.least_cycles)
        # What is slower than a heart is drift to it. A knock has many harmonics.
        breath = self._motion(rays, between, slowest, options.least_pixels, options.least_explained)
        fast = replace(rays, drift=drift, harmonics=4)
        heart = self._motion(fast, options.shortest_beat, 0.8 * between, options.least_pixels / 20, options.least_explained / 2)
        motions = [each for each in (breath, heart) if isinstance(each, TissueMotion)]
        if motions:
            parts = [f"{1e3 * each.amplitude:.1f} mm every {each.period:.2f} s (explains {each.explained:.0%})" for each in motions]
            return motions, f"the tissue moves by itself: {' and '.join(parts)}, seen for {length:.0f} s; the model blurs what moves"
        if breath:
            text = f"in {length:.0f} s points move by {breath:.1f} pixels, by the tissue or faults of poses, without a period that is seen"
            return [], f"{text} {options.least_cycles:g} times"
        return [], f"no breath and no heartbeat seen in {length:.0f} s"

    def _motion(self, rays: "_Rays", shortest: float, longest: float, least: float, share: float) -> TissueMotion | float:
        """The motion with a period (s) in between; where there is none, by how many pixels points move anyhow, if that is enough, or 0.

        Args:
            rays: What is seen.
            shortest, longest: Periods, s.
            least: Pixels that it must explain.
            share: Share that it must explain.
        """
        if longest <= shortest:
            return 0.0
        before = rays.left_over(None)
        rates = np.linspace(1 / longest, 1 / shortest, max(int(3 * rays.times[-1] * (1 / shortest - 1 / longest)), 3))
        power = np.array([_explained(before, rays.left_over(1 / rate)) for rate in rates])
        peak = int(power.argmax())
        if power[peak] < least:
            return 0.0
        if peak in (0, len(rates) - 1):  # what grows towards longer periods is drift
            return float(power[peak])
        gain = before - rays.left_over(1 / rates[peak])
        most = gain >= np.quantile(gain, 0.8)  # a motion has its place
        rate = _refined(lambda rate: -float(rays.left_over(1 / rate)[most].sum()), rates[peak], rates[1] - rates[0])
        explained = 1 - float(rays.left_over(1 / rate)[most].sum() / before[most].sum())
        if explained < share:
            return float(power[peak])
        return TissueMotion(float(1 / rate), rays.amplitude(1 / rate), explained, float(rays.times[-1] * rate))


@dataclass(frozen=True)
class _Rays:
    """What is seen of N tracks: normal equations of each observation, in pixels."""

    times: np.ndarray  # [T] s
    planes: np.ndarray  # [N, T, 3, 3], weighted sum of I − d dᵀ over the eyes; 0 where it is not seen
    sides: np.ndarray  # [N, T, 3], these times the lenses' positions
    squares: np.ndarray  # [N, T]
    counts: np.ndarray  # [N] observed coordinates
    spans: np.ndarray  # [N] s that it was followed for
    drift: int = 1  # terms of a cosine series that every point may follow
    harmonics: int = 1  # of a motion

    @classmethod
    def of(cls, tracks: list[_Track], times: np.ndarray, eyes: list, baseline: float, options: MotionSearchConfig) -> "_Rays | None":
        least = 2 * options.shortest_breath * options.rate
        tracks = sorted((track for track in tracks if len(track.left) >= least), key=lambda track: -len(track.left))[: options.points]
        if len(tracks) < 10:
            return None
        shape = len(tracks), len(times)
        planes, sides, squares = np.zeros((*shape, 3, 3)), np.zeros((*shape, 3)), np.zeros(shape)
        counts, spans = np.zeros(len(tracks)), np.zeros(len(tracks))
        for n, track in enumerate(tracks):
            numbers = range(track.first, track.first + len(track.left))
            seen = []
            for k, number in enumerate(numbers):
                pose, K, right_K = eyes[number]
                seen.append((number, pose[:3, 3], _ray(track.left[k], pose, K), K[0, 0]))
                if k < len(track.right) and np.isfinite(track.right[k]).all():
                    seen.append((number, pose[:3, 3] + baseline * pose[:3, 0], _ray(track.right[k], pose, right_K), right_K[0, 0]))
            each = np.array([number for number, *_ in seen])
            origins, directions, focal = (np.array(x) for x in list(zip(*seen))[1:])
            across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
            normal = across.sum(0) + 1e-6 * np.eye(3)
            middle = np.linalg.solve(normal, np.einsum("kij,kj->i", across, origins))
            weights = (focal / np.linalg.norm(middle - origins, axis=1).clip(1e-3)) ** 2
            origins = origins - middle
            np.add.at(planes[n], each, weights[:, None, None] * across)
            against = np.einsum("kij,kj->ki", across, origins)
            np.add.at(sides[n], each, weights[:, None] * against)
            np.add.at(squares[n], each, weights * np.einsum("ki,ki->k", against, origins))
            counts[n], spans[n] = 2 * len(seen), np.ptp(times[each])
        return cls(times - times[0], planes, sides, squares, counts, spans)

    def solved(self, period: float | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients of drift and motion of each point [N, 3 B], m, what the rays tell of them [N, 3 B, 3 B], 1/m², and the mean square
        left over [N], pixels²."""
        basis = np.cos(np.pi * np.outer(self.times / self.times[-1], np.arange(self.drift)))
        if period is not None:
            basis = np.concatenate([basis, _waves(self.times / period, self.harmonics)], 1)
        size = 3 * basis.shape[1]
        normal = np.einsum("ta,tb,ntij->naibj", basis, basis, self.planes, optimize=True).reshape(-1, size, size)
        side = np.einsum("ta,nti->nai", basis, self.sides).reshape(-1, size)
        # A motion along the only ray to a point is not seen; it is taken to be none.
        loose = np.diag(np.r_[np.full(3, 1e-6), np.full(size - 3, 1.0)] / _RIDGE**2)
        found = np.linalg.solve(normal + loose, side[..., None])[..., 0]
        left = self.squares.sum(1) - 2 * (side * found).sum(1) + np.einsum("na,nab,nb->n", found, normal, found)
        return found, normal + loose, left.clip(0) / (self.counts - size).clip(1)

    def left_over(self, period: float | None) -> np.ndarray:
        """Mean square [N] that drift and a motion of this period leave over, pixels²."""
        return self.solved(period)[2]

    def amplitude(self, period: float) -> float:
        """How far the motion goes, m, where it goes farthest.

        All points are taken to move alike, each by a share of its own: so each tells what its rays see of the way, and together they tell
        all of it.
        """
        found, told, _ = self.solved(period)
        n = 3 * self.drift
        ways = found[:, n:]
        told = told[:, n:, n:] - told[:, n:, :n] @ np.linalg.solve(told[:, :n, :n], told[:, :n, n:])
        way, shares = np.median(ways, 0), np.ones(len(ways))
        for _ in range(_ROUNDS):
            seen = told @ way
            shares = (seen * ways).sum(1) / (seen * way).sum(1).clip(1e-12)
            weighted = shares[:, None, None] * told
            way = np.linalg.solve((shares[:, None, None] * weighted).sum(0), np.einsum("nab,nb->a", weighted, ways))
        certain = told @ way @ way
        shares = np.abs(shares[certain >= np.median(certain)])
        path = _waves(np.arange(_PHASES) / _PHASES, self.harmonics) @ way.reshape(-1, 3)
        return float(np.quantile(shares, 0.95) * np.linalg.norm(path[:, None] - path, axis=-1).max())


def _waves(phases: np.ndarray, harmonics: int) -> np.ndarray:
    """Cosines and sines of so many harmonics at phases [T], in periods, [T, 2 H]."""
    return np.stack([wave(2 * np.pi * k * phases) for k in range(1, harmonics + 1) for wave in (np.cos, np.sin)], 1)


def _ray(pixel: np.ndarray, pose: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Unit direction [3], world, of a pixel whose index counts from the centre of the first."""
    direction = pose[:3, :3] @ np.array([(pixel[0] + 0.5 - K[0, 2]) / K[0, 0], (pixel[1] + 0.5 - K[1, 2]) / K[1, 1], 1.0])
    return direction / np.linalg.norm(direction)


def _followed(image: np.ndarray, other: np.ndarray, places: np.ndarray, guesses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where places [N, 2] of an image are in another, and whether the way back leads there [N]."""
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(image, other, places[:, None], guesses[:, None].copy(), flags=flags, **_LOOK)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, image, there, places[:, None].copy(), flags=flags, **_LOOK)
    good = (found[:, 0] > 0) & (returned[:, 0] > 0) & (np.abs(back[:, 0] - places).max(1) < 0.3)
    height, width = image.shape
    return there[:, 0], good & (there[:, 0] >= 0).all(1) & (there[:, 0] < [width, height]).all(1)


def _explained(before: np.ndarray, after: np.ndarray) -> float:
    """Root mean square, pixels, that a motion explains of what was left over [N], where it explains most: a motion has its place."""
    return max(float(np.quantile(before - after, 0.9)), 0.0) ** 0.5


def _refined(power: Callable[[float], float], rate: float, step: float) -> float:
    """The rate of the greatest power near one, to a thousandth of a step."""
    while step > 1e-3 * rate:
        rate = max((rate + step * part for part in (0, -1, -0.5, 0.5, 1)), key=power)
        step /= 2
    return rate
