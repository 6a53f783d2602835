"""A lens that is not as recorded, found by features of views whose poses are known."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.bundle import Bundle, least_beside, shared_tracks
from endo_sim_ros.reconstruction.camera_errors import LensError
from endo_sim_ros.reconstruction.pose_check import of_one_motion
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import Matches
from endo_sim_ros.reconstruction.stage_configs import LensConfig, MatchingConfig, PosesConfig

_LIKELY = np.array([0.2, 0.5, 0.1, 0.1, 0.1])  # errors of what `_lens` takes, where features tell little
_WORTH = 0.9  # part of the distance left without distortion that it must leave, as it blurs pictures, or a mount in place of a lens
_FOCAL, _DIVISION, _ASPECT, _MIDDLE = [0], [1], [2], [3, 4]  # of the values that `_lens` takes
_MOST_LIKELY = 3.0  # likely errors of aspect and principal point: beyond these it is not the lens


class CalibratedLens(NamedTuple):
    """What a lens does that was not recorded, and what features agree better by."""

    error: LensError
    before: float  # median distance of features from where other views have them, pixels
    after: float


def calibrated_lens(
    frames: Sequence[Frame],
    matches: Sequence[Matches],
    options: LensConfig = LensConfig(),
    poses: PosesConfig = PosesConfig(),
    matching: MatchingConfig = MatchingConfig(),
    progress: StageProgress = StageProgress(),
) -> CalibratedLens | None:
    """What the lens does that its pinhole camera does not; None where features tell too little, or that the lens is as recorded.

    Each view is left out once, and its features are to be where the others have them by the poses as they are: of that, focal length and
    distortion are those of least squares, with the weights of a Cauchy distribution. Pixels that are not square, and another principal
    point, are taken only of five views or more, where much is left without. Poses that are off from view to view, and tissue that moves,
    are no lens: some of it looks like one, but features are not exact then. Nor are poses that are all off alike, which leave less.

    Args:
        frames: Posed views.
        matches: Features that they share.
        options: When a lens is not as recorded.
        poses: By how much poses may be off alike, which is no lens, and how many views tell that.
        matching: How far a match may lie beside where a motion of the camera has it, and how many matches tell anything.
        progress: Asked whether to go on.

    Raises:
        Cancelled: If progress does.
    """
    cameras = [frame.camera for frame in frames]
    tracks = shared_tracks(of_one_motion(matches, cameras, matching, progress), len(cameras), options.most_tracks, progress)
    bundle = Bundle(cameras, tracks, poses, matching.reprojection_error)
    if bundle.told < matching.min_points:
        return None
    still = np.zeros((len(cameras), 6))

    def beside(values: np.ndarray, as_recorded: bool = True) -> np.ndarray:
        """How far features are from where other views have them, pixels, with a lens of five values, in likely errors."""
        progress.check()
        return bundle.through(_lens(values), as_recorded).left_out(still, still)

    def fitted(free: list[int]) -> tuple[np.ndarray, float]:
        """The five values that fit best, those of these numbers, while the others are 0; and the median distance that is left."""
        whole = np.eye(len(_LIKELY))[free]
        values = least_beside(lambda some: beside(some @ whole), len(free), matching.reprojection_error) @ whole
        # A shorter lens shrinks what poses are off by in pictures, and a longer one what tissue moves by between the rays.
        return values, max(float(np.median(beside(values, as_recorded))) for as_recorded in (True, False))

    recorded = float(np.median(beside(np.zeros(5))))
    most = min(options.left * recorded, options.exact * min(camera.width for camera in cameras))
    droppable, many = [(_DIVISION, _WORTH)], len(cameras) >= poses.mount_views
    if many:
        droppable = [(_MIDDLE, options.left), (_ASPECT, options.left), *droppable]
    free = sum((part for part, _ in droppable), _FOCAL)
    values, left = fitted(free)
    for part, worth in droppable:
        if left > most:  # fewer values leave no less
            return None
        fewer = [number for number in free if number not in part]
        simpler, its_left = fitted(fewer)
        if left >= worth * its_left:
            free, values, left = fewer, simpler, its_left
    if left > most or np.abs(values[2:]).max() > _MOST_LIKELY:
        return None
    # Poses that are all off alike look like another principal point or focal length, too, but less exactly.
    after, alike = float(np.median(beside(values))), bundle.alike(progress) if many else still
    if np.median(bundle.left_out(alike, alike)) < _WORTH * after:
        return None
    return CalibratedLens(_lens(values), recorded, after)


def _lens(values: np.ndarray) -> LensError:
    """That of five values, in likely errors: logarithm of its focal length, division, logarithm of its aspect, and principal point."""
    focal, division, aspect, right, down = values * _LIKELY
    return LensError(float(np.exp(focal)), float(division), float(np.exp(aspect)), float(right), float(down))
