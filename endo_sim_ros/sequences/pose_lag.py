"""By how many frames the poses of a recording are behind its images: measured from the images."""

from collections.abc import Callable, Container, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.core.features import detect, epipolar_distance, match_pair
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.words import counted

_NEAR, _FAR = 0.02, 0.5  # metres, between which a laparoscope sees tissue
_NOISE = 0.25  # pixels, of a feature; which of two lags is better by less says nothing
_SEED = 0  # of random sampling


class LagFinder:
    """Finds the lag with which features of pairs of frames lie closest to their epipolar lines.

    A frame n belongs to the pose in row n − lag. The pairs are those, spread over the recording, at which the camera's path makes
    most of a difference between lags. Their features are matched once, and each lag is tried on them.

    Args:
        poses: Camera-to-world poses [4, 4] by row, metres. A few missing ones in a row are interpolated.
        camera: Of the images that `find` gets.
        frames: Increasing frame numbers that there are images of.
        max_lag: Largest lag that is tried, frames, to either side: more than twice what has been found in StereoMIS.
        pairs: Pairs of frames; half as many left a lag untold where tissue breathes by 4 mm.
        gaps: Distances of the frames of a pair; a camera that moves steadily differs between lags over long ones only.
        bridge: Missing rows that are interpolated.
        least_motion: Pixels (standard deviation over the lags) by which a pair must tell lags apart.
        overlap: Share of the image's width by which features of a pair may move.
        least_pairs: Of frames; fewer do not outvote tissue that moves.
    """

    def __init__(
        self,
        poses: Mapping[int, np.ndarray],
        camera: Camera,
        frames: Sequence[int],
        *,
        max_lag: int = 10,
        pairs: int = 48,
        gaps: tuple[int, ...] = (3, 6, 12, 24),
        bridge: int = 5,
        least_motion: float = 1.0,
        overlap: float = 0.25,
        least_pairs: int = 6,
    ):
        self._camera, self._least_pairs = camera, least_pairs
        self._lags = np.arange(-max_lag, max_lag + 1)
        around = frames[0] - max_lag - bridge, frames[-1] + max_lag + bridge, bridge
        self._path = _Path(poses, *around)
        self._inverse = _Path({row: invert_pose(pose) for row, pose in poses.items()}, *around)
        self._pairs, posed = self._telling_pairs(np.array(frames), pairs, gaps, least_motion, overlap)
        self._lacking = ""  # which poses there are, where they are too few for any lag
        if posed < least_pairs:
            near = sum(frames[0] - max_lag <= row <= frames[-1] + max_lag for row in poses)
            given = f"there are poses in rows {min(poses)} to {max(poses)}, {near} of them" if poses else "there is no pose"
            self._pairs, self._lacking = [], f"{given} within {max_lag} of the frames {frames[0]} to {frames[-1]}: too few"

    @property
    def frames(self) -> list[int]:
        """Numbers of the frames whose images `find` wants, in increasing order."""
        return sorted({number for pair in self._pairs for number in pair})

    def needs(self, row: int, frames: Container[int]) -> bool:
        """Whether the pose in a row is that of one of these frames with every lag."""
        return all(row + lag in frames for lag in self._lags)

    def _telling_pairs(
        self, frames: np.ndarray, count: int, gaps: tuple[int, ...], least: float, overlap: float
    ) -> tuple[list[tuple[int, int]], int]:
        """The pairs, and how many first frames of pairs have poses with every lag."""
        width, height = self._camera.width, self._camera.height
        rays = self._camera.rays()[height // 4 :: height // 2, width // 4 :: width // 2].reshape(-1, 3)
        points, focal = 0.1 * rays, self._camera.K[0, 0]  # metres: the usual working distance
        starts = frames[:: max(1, len(frames) // 2000)]
        best = np.zeros((len(starts), 2))  # how much a pair tells, and its gap
        posed = np.zeros(len(starts), bool)
        for gap in gaps:
            inside = np.flatnonzero(np.isin(starts + gap, frames))
            rows = starts[inside, None] - self._lags
            (here, known), (there, also_known) = self._path.at(rows), self._path.at(rows + gap)
            use = (known & also_known).all(1)
            inside, here, there = inside[use], here[use], there[use]
            posed[inside] = True
            world = np.einsum("abij,pj->abpi", here[..., :3, :3], points) + here[..., None, :3, 3]
            moved = np.einsum("abji,abpj->abpi", there[..., :3, :3], world - there[..., None, :3, 3])
            shift = focal * (moved[..., :2] / np.maximum(moved[..., 2:], 1e-3) - rays[:, :2])  # [pairs, lags, points, 2]
            telling = np.sqrt(shift.var(1).sum(-1).mean(1))
            telling[np.linalg.norm(shift, axis=-1).mean((1, 2)) > overlap * width] = 0
            better = telling > best[inside, 0]
            best[inside[better]] = np.column_stack([telling, np.full(len(telling), gap)])[better]
        pairs = []
        for part in np.array_split(np.arange(len(starts)), count):
            at = part[np.argmax(best[part, 0])] if len(part) else 0
            if len(part) and best[at, 0] > least:
                pairs.append((int(starts[at]), int(starts[at] + best[at, 1])))
        return pairs, int(posed.sum())

    def find(
        self,
        images: Mapping[int, np.ndarray],
        mask_of: Callable[[int], np.ndarray | None],
        *,
        features: int = 1500,
        ratio: float = 0.8,
        least_matches: int = 30,
        apart: int = 3,
        least_contrast: float = 0.1,
        least_agreement: float = 0.9,
        max_residual: float = 0.02,
        clearly: float = 2.0,
    ) -> tuple[int | None, str]:
        """The lag in frames, or None where it cannot be told, and what it was found from, for people.

        Args:
            images: RGB images [H, W, 3] of the `frames`, uint8; those that could not be read may be missing.
            mask_of: Gives the mask [H, W] of a frame, 0 = take no features here; or None.
            features: SIFT features of an image, at most.
            ratio: As `match_pair`.
            least_matches: Of a pair of frames; fewer may agree by accident.
            apart: Distance in frames from which on another lag must be worse.
            least_contrast: By how much of its residual it must be worse.
            least_agreement: Share of random selections of the pairs that must give the lag, or one beside it.
            max_residual: Share of the image's width by which features may lie beside their lines; tissue that breathes moves by less.
            clearly: How many times as far features must lie beside their lines as with inverse poses, so that those are right.

        Raises:
            SequenceError: If images tell that the poses are world-to-camera, that each lag is wrong, or that a larger one than those
                tried may be right.
        """
        if self._lacking:
            return None, self._lacking
        residuals, inverse = [], []
        for first, second in self._pairs:
            if first not in images or second not in images:
                continue
            one, other = (detect(images[number], mask_of(number), features) for number in (first, second))
            uv_1, uv_2 = match_pair(one, other, ratio)
            if len(uv_1) >= least_matches:
                for path, found in ((self._path, residuals), (self._inverse, inverse)):
                    found.append([self._residual(path, first - lag, second - lag, uv_1, uv_2) for lag in self._lags])
        if len(residuals) < self._least_pairs:
            moves = "the camera moves too little, or too far, as with poses that are not in metres, or too little is seen of it"
            return None, f"{moves}: lags are told apart by {counted(len(residuals), 'pair')} of frames"
        logs = np.log(np.array(residuals) + _NOISE)  # their mean: no pair outweighs the others
        curve = logs.mean(0)
        best = int(np.argmin(curve))
        turned = float(np.log(np.array(inverse) + _NOISE).mean(0).min())
        if curve[best] - turned > np.log(clearly) and np.exp(turned) - _NOISE <= max_residual * self._camera.width:
            given, right = (np.exp(value) - _NOISE for value in (curve[best], turned))
            raise SequenceError(
                f"its poses are world-to-camera: features of {len(logs)} pairs of frames are {given:.2f} px beside their epipolar lines, "
                f"and {right:.2f} px with inverse poses; invert each, or pass poses=sfm to estimate them anew"
            )
        others = curve[np.abs(self._lags - self._lags[best]) >= apart]
        contrast = float(np.exp(others.min() - curve[best]) - 1)
        draws = np.random.default_rng(_SEED).integers(len(logs), size=(200, len(logs)))
        agreement = float(np.mean(np.abs(logs[draws].mean(1).argmin(1) - best) <= 1))
        residual, next_best = (np.exp(value) - _NOISE for value in (curve[best], others.min()))
        basis = (
            f"features of {len(logs)} pairs of frames are {residual:.2f} px beside their epipolar lines with a lag of "
            f"{self._lags[best]}, and at least {next_best:.2f} px with lags {apart} or more frames from it"
        )
        fits, told = residual <= max_residual * self._camera.width, contrast >= least_contrast and agreement >= least_agreement
        if not fits or told and best in (0, len(curve) - 1):
            how = "best with the largest lag that is tried" if fits else f"with no lag from {self._lags[0]} to {self._lags[-1]} frames"
            what_to_do = "pass pose_lag to use them all the same, or poses=sfm to estimate them anew"
            raise SequenceError(f"its poses fit the images {how} ({basis}); {what_to_do}")
        if not told:
            return None, basis
        return int(self._lags[best]), basis

    def _residual(self, path: "_Path", first: int, second: int, uv_1: np.ndarray, uv_2: np.ndarray) -> float:
        one, other = (self._camera.at(path.at(np.array(row))[0]) for row in (first, second))
        return float(np.median(np.minimum(epipolar_distance(one, other, uv_1, uv_2, _NEAR, _FAR), self._camera.width)))


class _Path:
    """Poses by row, between two rows given near each other interpolated.

    Args:
        poses: Camera-to-world poses [4, 4] by row.
        first, last: Rows between which to look.
        bridge: Rows that may be missing between two others.
    """

    def __init__(self, poses: Mapping[int, np.ndarray], first: int, last: int, bridge: int):
        self._rows = np.array(sorted(row for row in poses if first <= row <= last), np.int64)
        self._bridge = bridge
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
        known &= (self._rows[after] == rows) | (self._rows[after] - self._rows[after - 1] <= self._bridge + 1)
        poses[..., :3, :3] = self._turn(rows.ravel()).as_matrix().reshape(*rows.shape, 3, 3)
        for axis in range(3):
            poses[..., axis, 3] = np.interp(rows, self._rows, self._positions[:, axis])
        return poses, known
