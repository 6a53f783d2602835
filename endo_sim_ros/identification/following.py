"""Points of tissue that are followed through the images of an experiment."""

from collections.abc import Iterable

import cv2
import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros.core.cameras import Camera, interpolate_pose
from endo_sim_ros.core.features import follow, followable
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.identification.experiment import Tracks
from endo_sim_ros.identification.recording_config import RecordingConfig
from endo_sim_ros.identification.touches import Timeline
from endo_sim_ros.physics import sample_farthest
from endo_sim_ros.rendering import render_depth

_DISTANCE = 9  # pixels between followed points
_QUALITY = 0.01  # of the best corner, that others must have
_EXACT = 1_000_000  # ns between an image and the end of a step, that are one moment
_EDGE = 0.05  # share by which depth differs beside a point that lies on an edge: where it is at rest is not known then


class PointFollower:
    """Follows points of the skin, which are where the model says in the first image, through the images of one experiment.

    Args:
        model: The tissue at rest.
        line: The tool, which hides tissue.
        span: Steps of the experiment on it.
        config: How many points, and how well they are seen.
    """

    def __init__(self, model: GaussianModel, line: Timeline, span: tuple[int, int], config: RecordingConfig):
        self._model, self._line, self._span, self._config = model, line, span, config
        self._before: np.ndarray | None = None
        self._first: np.ndarray | None = None
        self._last = np.zeros((0, 2))  # where each was seen last
        self._rest = np.zeros((0, 3))
        self._stamps: list[int] = []
        self._cameras: list[Camera] = []
        self._pixels: list[np.ndarray] = []  # [K, 2] each, NaN where a point is lost
        self.in_picture = True
        """Whether the first image shows the model."""

    def look(self, frame: Frame) -> None:
        """Follow the points into the next image."""
        image = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        free = self._free(frame)
        if self._before is None or self._first is None or self._before.shape != image.shape:
            if self._before is not None:
                return  # of another camera
            self._begin(image, frame.camera, free)
        else:
            self._pixels.append(self._find(image, free))
        self._before = image
        self._stamps.append(frame.stamp_ns)
        self._cameras.append(frame.camera)

    def _find(self, image: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Pixels [K, 2] in the next image, NaN where a point is not seen: where they went since the image before, and from there on where
        what they looked like in the first image is. So errors do not add up, and what was hidden is found again."""
        assert self._before is not None and self._first is not None
        now, last, first = np.full_like(self._last, np.nan), *((each - 0.5).astype(np.float32) for each in (self._last, self._pixels[0]))
        if len(now):
            moved, good = follow(self._before, image, last, last)
            there, good = follow(self._first, image, first, np.where(good[:, None], moved, last))
            columns, rows = there.round().astype(int).clip(0, np.array(image.shape[::-1]) - 1).T
            good &= free[rows, columns] > 0  # else the instrument may take them along
            now[good] = there[good] + 0.5
            self._last = np.where(good[:, None], now, self._last)
        return now

    def _begin(self, image: np.ndarray, camera: Camera, free: np.ndarray) -> None:
        depth = render_depth(self._model, camera)
        self.in_picture = bool((depth > 0).mean() > 0.02)
        smooth = cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) < _EDGE * depth
        near = KDTree(_way(self._line, self._span)).query(camera.backproject(depth).reshape(-1, 3))[0].reshape(depth.shape)
        mask = np.where((depth > 0) & smooth & (near <= self._config.motion_reach), free, 0).astype(np.uint8)
        found = cv2.goodFeaturesToTrack(image, self._config.points, _QUALITY, _DISTANCE, mask=mask)
        places = np.zeros((0, 2)) if found is None else found[:, 0].astype(np.float64)
        columns, rows = places.astype(int).T if len(places) else np.zeros((2, 0), int)
        self._rest = camera.unproject(places + 0.5, depth[rows, columns].astype(np.float64))
        self._pixels.append(places + 0.5)
        self._first, self._last = image, places + 0.5

    def _free(self, frame: Frame) -> np.ndarray:
        """Pixels [H, W] that show tissue, and nothing else near them: 1."""
        if frame.mask is not None:
            return followable(frame.mask > 0)
        free = np.ones(frame.image.shape[:2], np.uint8)
        step = int(np.abs(self._line.times - frame.stamp_ns).argmin())
        tip, axis, radius = self._line.tips[step], self._line.rotations[step][:, 2], self._config.instrument_radius
        if not radius or not np.isfinite(tip).all():
            return free
        along = np.linspace(-radius, 0.2, 60)[:, None]
        uv, z = frame.camera.project(tip - along * axis)
        for place, depth in zip(uv, z):
            if depth > 0.2 * radius and np.abs(place).max() < 1e5:
                cv2.circle(free, (round(place[0]), round(place[1])), round(radius * frame.camera.K[0, 0] / depth), 0, -1)
        return free

    def tracks(self) -> Tracks | None:
        """What was followed, at the ends of the steps nearest to the images; None if that was nothing."""
        followed = np.isfinite(np.array(self._pixels)[:, :, 0]).sum(0) > 1 if len(self._pixels) > 1 else np.zeros(0, bool)
        if not followed.any():
            return None
        stamps, pixels = np.array(self._stamps), np.array(self._pixels)[:, followed]
        times = self._line.times[slice(*self._span)]
        steps, shown, cameras = [], [], []
        for number in np.flatnonzero(looked_at(stamps, self._config)).tolist():
            step = int(np.abs(times - stamps[number]).argmin())
            at = self._at(number, times[step], stamps, pixels) if step not in steps else None
            if at is not None:
                steps.append(step)
                shown.append(at[0])
                cameras.append(at[1])
        if len(steps) < 2:
            return None
        rest = self._rest[followed]
        return Tracks(rest, np.array(steps), np.array(shown), cameras, self._config.pixel_noise, self._hidden(rest))

    def _hidden(self, rest: np.ndarray) -> float:
        """By how much features of a picture of Gaussians near points [K, 3] slide as tissue bends, pixels: neighbours that are nearer hide
        one half of each, and what is seen of it lies aside by the mean of the other half; to another side where the slope turns."""
        camera, means = self._cameras[0], self._model.means.detach().cpu().double().numpy()
        sizes = np.sort(np.exp(self._model.log_scales.detach().cpu().double().numpy()), 1)[:, 1:]
        widths = np.sqrt(sizes.prod(1))[KDTree(means).query(rest)[1]] * camera.K[0, 0] / camera.project(rest)[1]
        return float(np.sqrt(2) * np.sqrt(2 / np.pi) * np.median(widths))

    def _at(self, number: int, time: int, stamps: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, Camera] | None:
        """Pixels [K, 2] and camera at a time near an image, on the way to the image on that side; None where there is none."""
        stamp = stamps[number]
        if abs(time - stamp) < _EXACT:
            return pixels[number], self._cameras[number]
        other = number + (1 if time > stamp else -1)
        if not 0 <= other < len(stamps) or abs(stamps[other] - stamp) > self._config.longest_gap * 1e9:
            return None
        share = (time - stamp) / (stamps[other] - stamp)
        if not 0 <= share <= 1:
            return None
        pose = interpolate_pose(self._cameras[number].pose, self._cameras[other].pose, share)
        return (1 - share) * pixels[number] + share * pixels[other], self._cameras[number].at(pose)


def _way(line: Timeline, span: tuple[int, int]) -> np.ndarray:
    """Where the tip touches in a span of steps [N, 3], m, world."""
    part = slice(*span)
    return line.tips[part][line.touching[part]]


def near_way(points: np.ndarray, line: Timeline, span: tuple[int, int], config: RecordingConfig) -> np.ndarray:
    """Numbers of points [N, 3], m, world, as many as are wanted, spread over what is in reach of the touches in a span of steps."""
    near = np.flatnonzero(KDTree(_way(line, span)).query(points)[0] <= config.motion_reach)
    return np.sort(near[sample_farthest(points[near], config.points)]) if len(near) > config.points else near


def looked_at(stamps: np.ndarray, config: RecordingConfig) -> np.ndarray:
    """Which of the states or images of an experiment are compared with the model [T], bool, by their stamps, ns: as many a second as is
    wanted, from the first on."""
    number = np.floor((stamps - stamps[0]) * 1e-9 * config.motion_rate + 1e-6).astype(int)
    return np.diff(number, prepend=-1) > 0


def follow_points(
    model: GaussianModel, frames: Iterable[Frame], line: Timeline, spans: list[tuple[int, int]], config: RecordingConfig
) -> tuple[dict[int, Tracks], int, bool]:
    """Tracks of experiments by their number, the number of images looked at, and whether they show the model.

    Args:
        model: The tissue at rest.
        frames: Of the recording, in order.
        line: The tool.
        spans: Steps of each experiment on it, in order.
        config: How many points, and how well they are seen.
    """
    followers: dict[int, PointFollower] = {}
    count = 0
    for frame in frames:
        for number, (start, stop) in enumerate(spans):
            if line.times[start] - _EXACT <= frame.stamp_ns <= line.times[stop - 1] + _EXACT:
                follower = followers.setdefault(number, PointFollower(model, line, (start, stop), config))
                follower.look(frame)
                count += 1
    found = {number: tracks for number, follower in followers.items() if (tracks := follower.tracks()) is not None}
    return found, count, any(follower.in_picture for follower in followers.values()) or not followers
