"""By how many frames the poses of a recording are behind its images: measured from the images."""

from collections.abc import Callable, Container, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.core.features import agreeing, detect, epipolar_distance, match_pair
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.words import counted

_NEAR, _FAR = 0.02, 0.5  # metres, between which a laparoscope sees tissue
_NOISE = 0.25  # pixels, of a feature; which of two lags is better by less says nothing
_SEED = 0  # of random sampling
_MAX_LAG = 10  # frames, to either side, that are tried: more than twice what has been found in StereoMIS
_LAGS = np.arange(-_MAX_LAG, _MAX_LAG + 1)
_GAPS = 3, 6, 12, 24  # distances of the frames of a pair; a camera that moves steadily differs between lags over long ones only
_BRIDGE = 5  # missing rows that are interpolated
_LEAST_MOTION = 1.0  # pixels (standard deviation over the lags) by which a pair must tell lags apart
_OVERLAP = 0.25  # share of the image's width by which features of a pair may move
_LEAST_PAIRS = 6  # of frames; fewer do not outvote tissue that moves
_FEATURES, _RATIO = 1500, 0.8  # as `detect` and `match_pair` take them
_LEAST_MATCHES = 30  # of a pair of frames that agree with each other; fewer may agree by accident
_APART = 3  # frames from which on another lag must be worse
_LEAST_CONTRAST = 0.1  # by how much of its residual it must be worse
_LEAST_AGREEMENT = 0.9  # share of random selections of the pairs that must give the lag, or one beside it
_MOST_BESIDE = 0.02  # share of the image's width by which features may lie beside their lines; tissue that breathes moves by less
_BADLY = 0.004  # share of it from which on a user should know: good poses leave a quarter of that where tissue rests
_FARTHEST = 1.0  # metres: positions of a lens within a body span less
_CLEARLY = 4.0  # times as far features must lie beside their lines as with inverse poses, so that those are right


class LagFinder:
    """Finds the lag with which features of pairs of frames lie closest to their epipolar lines.

    A frame n belongs to the pose in row n − lag. The pairs are those, spread over the recording, at which the camera's path makes
    most of a difference between lags. Their features are matched once, and each lag is tried on them.

    Args:
        poses: Camera-to-world poses [4, 4] by row, metres. A few missing ones in a row are interpolated.
        camera: Of the images that `find` gets.
        frames: Increasing frame numbers that there are images of.
        pairs: Pairs of frames; half as many left a lag untold where tissue breathes by 4 mm.

    Attributes:
        fits_badly: Whether features lie far beside their lines with each lag that `find` tried, so that tissue moves or poses are wrong.
    """

    def __init__(self, poses: Mapping[int, np.ndarray], camera: Camera, frames: Sequence[int], *, pairs: int = 48):
        self._camera = camera
        around = frames[0] - _MAX_LAG - _BRIDGE, frames[-1] + _MAX_LAG + _BRIDGE
        self._path = _Path(poses, *around)
        self._inverse = _Path({row: invert_pose(pose) for row, pose in poses.items()}, *around)
        self._pairs, posed = self._telling_pairs(np.array(frames), pairs)
        self._lacking = ""  # which poses there are, where they are too few for any lag
        self.fits_badly = False
        near = np.array([pose[:3, 3] for row, pose in poses.items() if frames[0] - _MAX_LAG <= row <= frames[-1] + _MAX_LAG])
        self._span = float(np.linalg.norm(np.ptp(np.quantile(near, [0.05, 0.95], axis=0), axis=0))) if len(near) else 0.0  # m
        if self._span > _FARTHEST:
            self._pairs = []  # no image is needed to tell that
        if posed < _LEAST_PAIRS:
            given = f"there are poses in rows {min(poses)} to {max(poses)}, {len(near)} of them" if poses else "there is no pose"
            self._pairs, self._lacking = [], f"{given} within {_MAX_LAG} of the frames {frames[0]} to {frames[-1]}: too few"

    @property
    def frames(self) -> list[int]:
        """Numbers of the frames whose images `find` wants, in increasing order."""
        return sorted({number for pair in self._pairs for number in pair})

    def needs(self, row: int, frames: Container[int]) -> bool:
        """Whether the pose in a row is that of one of these frames with every lag."""
        return all(row + lag in frames for lag in _LAGS)

    def _telling_pairs(self, frames: np.ndarray, count: int) -> tuple[list[tuple[int, int]], int]:
        """The pairs, and how many first frames of pairs have poses with every lag."""
        width, height = self._camera.width, self._camera.height
        rays = self._camera.rays()[height // 4 :: height // 2, width // 4 :: width // 2].reshape(-1, 3)
        points, focal = 0.1 * rays, self._camera.K[0, 0]  # metres: the usual working distance
        starts = frames[:: max(1, len(frames) // 2000)]
        best = np.zeros((len(starts), 2))  # how much a pair tells, and its gap
        posed = np.zeros(len(starts), bool)
        for gap in _GAPS:
            inside = np.flatnonzero(np.isin(starts + gap, frames))
            rows = starts[inside, None] - _LAGS
            (here, known), (there, also_known) = self._path.at(rows), self._path.at(rows + gap)
            use = (known & also_known).all(1)
            inside, here, there = inside[use], here[use], there[use]
            posed[inside] = True
            world = np.einsum("abij,pj->abpi", here[..., :3, :3], points) + here[..., None, :3, 3]
            moved = np.einsum("abji,abpj->abpi", there[..., :3, :3], world - there[..., None, :3, 3])
            shift = focal * (moved[..., :2] / np.maximum(moved[..., 2:], 1e-3) - rays[:, :2])  # [pairs, lags, points, 2]
            telling = np.sqrt(shift.var(1).sum(-1).mean(1))
            telling[np.linalg.norm(shift, axis=-1).mean((1, 2)) > _OVERLAP * width] = 0
            better = telling > best[inside, 0]
            best[inside[better]] = np.column_stack([telling, np.full(len(telling), gap)])[better]
        pairs = []
        for part in np.array_split(np.arange(len(starts)), count):
            at = part[np.argmax(best[part, 0])] if len(part) else 0
            if len(part) and best[at, 0] > _LEAST_MOTION:
                pairs.append((int(starts[at]), int(starts[at] + best[at, 1])))
        return pairs, int(posed.sum())

    def find(self, images: Mapping[int, np.ndarray], mask_of: Callable[[int], np.ndarray | None]) -> tuple[int | None, str]:
        """The lag in frames, or None where it cannot be told, and what it was found from, for people.

        Args:
            images: RGB images [H, W, 3] of the `frames`, uint8; those that could not be read may be missing.
            mask_of: Gives the mask [H, W] of a frame, 0 = take no features here; or None.

        Raises:
            SequenceError: If the poses cannot be in metres, or if images tell that they are world-to-camera, that each lag is wrong, or
                that a larger one than those tried may be right.
        """
        if self._lacking:
            return None, self._lacking
        if self._span > _FARTHEST:
            raise SequenceError(
                f"its poses are wrong, or not in metres: they span {self._span:.3g} m, more than a lens goes; give them in metres, pass "
                "pose_lag to use them all the same, or poses=sfm to estimate them anew"
            )
        residuals, inverse = [], []
        for first, second in self._pairs:
            if first not in images or second not in images:
                continue
            one, other = (detect(images[number], mask_of(number), _FEATURES) for number in (first, second))
            uv_1, uv_2 = agreeing(*match_pair(one, other, _RATIO), _LEAST_MATCHES)
            if len(uv_1):
                for path, found in ((self._path, residuals), (self._inverse, inverse)):
                    poses = zip(path.at(first - _LAGS)[0], path.at(second - _LAGS)[0])
                    found.append([self._residual(*pair, uv_1, uv_2) for pair in poses])
        if len(residuals) < _LEAST_PAIRS:
            moves = "the camera moves too little, or too far, as with poses that are not in metres, or too little is seen of it"
            return None, f"{moves}: lags are told apart by {counted(len(residuals), 'pair')} of frames"
        logs = np.log(np.array(residuals) + _NOISE)  # their mean: no pair outweighs the others
        curve = logs.mean(0)
        best = int(np.argmin(curve))
        turned = float(np.log(np.array(inverse) + _NOISE).mean(0).min())
        if curve[best] - turned > np.log(_CLEARLY) and np.exp(turned) - _NOISE <= _MOST_BESIDE * self._camera.width:
            given, right = (np.exp(value) - _NOISE for value in (curve[best], turned))
            raise SequenceError(
                f"its poses are world-to-camera: features of {len(logs)} pairs of frames are {given:.2f} px beside their epipolar lines, "
                f"and {right:.2f} px with inverse poses; invert each, or pass poses=sfm to estimate them anew"
            )
        others = curve[np.abs(_LAGS - _LAGS[best]) >= _APART]
        contrast = float(np.exp(others.min() - curve[best]) - 1)
        draws = np.random.default_rng(_SEED).integers(len(logs), size=(200, len(logs)))
        agreement = float(np.mean(np.abs(logs[draws].mean(1).argmin(1) - best) <= 1))
        residual, next_best = (np.exp(value) - _NOISE for value in (curve[best], others.min()))
        basis = (
            f"features of {len(logs)} pairs of frames are {residual:.2f} px beside their epipolar lines with a lag of "
            f"{_LAGS[best]}, and at least {next_best:.2f} px with lags {_APART} or more frames from it"
        )
        fits, told = residual <= _MOST_BESIDE * self._camera.width, contrast >= _LEAST_CONTRAST and agreement >= _LEAST_AGREEMENT
        if not fits or told and best in (0, len(curve) - 1):
            how = "best with the largest lag that is tried" if fits else f"with no lag from {_LAGS[0]} to {_LAGS[-1]} frames"
            what_to_do = "pass pose_lag to use them all the same, or poses=sfm to estimate them anew"
            raise SequenceError(f"its poses fit the images {how} ({basis}); {what_to_do}")
        self.fits_badly = residual > _BADLY * self._camera.width
        if not told:
            return None, basis
        return int(_LAGS[best]), basis

    def _residual(self, first: np.ndarray, second: np.ndarray, uv_1: np.ndarray, uv_2: np.ndarray) -> float:
        """How far matched features [M, 2] lie beside their epipolar lines, pixels, were these the poses [4, 4] of their frames."""
        beside = epipolar_distance(self._camera.at(first), self._camera.at(second), uv_1, uv_2, _NEAR, _FAR)
        return float(np.median(np.minimum(beside, self._camera.width)))


class _Path:
    """Poses by row, between two rows given near each other interpolated.

    Args:
        poses: Camera-to-world poses [4, 4] by row.
        first, last: Rows between which to look.
    """

    def __init__(self, poses: Mapping[int, np.ndarray], first: int, last: int):
        self._rows = np.array(sorted(row for row in poses if first <= row <= last), np.int64)
        if len(self._rows) > 1:
            given = np.array([poses[row] for row in self._rows.tolist()])
            self._turn, self._positions = Slerp(self._rows, Rotation.from_matrix(given[:, :3, :3])), given[:, :3, 3]

    def at(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses [..., 4, 4] of rows [...], and which of them are known [...]."""
        poses = np.tile(np.eye(4), (*rows.shape, 1, 1))
        if len(self._rows) < 2 or not rows.size:
            return poses, np.zeros(rows.shape, bool)
        known = (rows >= self._rows[0]) & (rows <= self._rows[-1])
        rows = rows.clip(self._rows[0], self._rows[-1])
        after = np.searchsorted(self._rows, rows)  # the next given row, or the row itself
        known &= (self._rows[after] == rows) | (self._rows[after] - self._rows[after - 1] <= _BRIDGE + 1)
        poses[..., :3, :3] = self._turn(rows.ravel()).as_matrix().reshape(*rows.shape, 3, 3)
        for axis in range(3):
            poses[..., axis, 3] = np.interp(rows, self._rows, self._positions[:, axis])
        return poses, known
