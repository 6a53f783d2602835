"""A lens that is not as recorded, found by features of views whose poses are known."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.bundle import Bundle, shared_tracks
from endo_sim_ros.reconstruction.camera_errors import LensError
from endo_sim_ros.reconstruction.pose_check import of_one_motion
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import Matches
from endo_sim_ros.reconstruction.stage_configs import LensConfig, MatchingConfig, PosesConfig

_LIKELY = np.array([0.2, 0.5])  # errors of the logarithm of the focal length, and of the division, where features tell little
_ROUNDS = 3  # in which what is an outlier is told anew
_WORTH = 0.9  # part of the distance that is left by the focal length alone, beyond which no distortion is taken: it blurs pictures


class CalibratedLens(NamedTuple):
    """What a lens does that was not recorded, and what features agree better by."""

    error: LensError
    before: float  # median distance of features from where other views have them, pixels
    after: float


def calibrated_lens(
    frames: Sequence[Frame],
    matches: Sequence[Matches],
    options: LensConfig = LensConfig(),
    matching: MatchingConfig = MatchingConfig(),
    progress: StageProgress = StageProgress(),
) -> CalibratedLens | None:
    """What the lens does that its pinhole camera does not; None where features tell too little, or that the lens is as recorded.

    Each view is left out once, and its features are to be where the others have them by the poses as they are: of that, focal length and
    distortion are those of least squares, with the weights of a Cauchy distribution. Poses that are off from view to view, and tissue that
    moves, are no lens: some of it looks like one, but features are not exact then.

    Args:
        frames: Posed views.
        matches: Features that they share.
        options: When a lens is not as recorded.
        matching: How far a match may lie beside where a motion of the camera has it, and how many matches tell anything.
        progress: Asked whether to go on.

    Raises:
        Cancelled: If progress does.
    """
    cameras = [frame.camera for frame in frames]
    tracks = shared_tracks(of_one_motion(matches, cameras, matching, progress), len(cameras), options.most_tracks, progress)
    bundle = Bundle(cameras, tracks, PosesConfig(), matching.reprojection_error)
    if bundle.told < matching.min_points:
        return None
    still = np.zeros((len(cameras), 6))
    far = float(cameras[0].width)

    def beside(values: np.ndarray, as_recorded: bool = True) -> np.ndarray:
        """How far features are from where other views have them, pixels, with a lens of two values, in likely errors."""
        progress.check()
        distances = bundle.through(_lens(values), as_recorded).left_out(still, still)
        return np.nan_to_num(distances, nan=far).clip(0, far)

    recorded = float(np.median(beside(np.zeros(2))))
    exact = options.exact * min(camera.width for camera in cameras)
    focal = _fitted(beside, 1, matching.reprojection_error)
    both = _fitted(beside, 2, matching.reprojection_error)
    values, after = min((focal, both), key=lambda found: found[1] * (1.0 if found is both else _WORTH))
    # A shorter lens shrinks what poses are off by in pictures, and a longer one what tissue moves by between the rays.
    if max(after, float(np.median(beside(values, as_recorded=False)))) > min(options.left * recorded, exact):
        return None
    return CalibratedLens(_lens(values), recorded, after)


def _lens(values: np.ndarray) -> LensError:
    """That of the logarithm of its focal length and its division, in likely errors."""
    focal, division = values * _LIKELY
    return LensError(float(np.exp(focal)), float(division))


def _fitted(beside: Callable[[np.ndarray], np.ndarray], count: int, outlying: float) -> tuple[np.ndarray, float]:
    """The first so many of two values, with 0 for the others, of which distances are least; and their median."""
    values = np.zeros(2)
    whole = lambda some: np.append(some, np.zeros(2 - count))
    for _ in range(_ROUNDS):
        # With a lens far off most features are no outliers.
        scale = max(outlying, float(np.median(beside(values))))
        cost = lambda some, scale=scale: np.append(np.sqrt(np.log1p((beside(whole(some)) / scale) ** 2)), some)
        values = whole(least_squares(cost, values[:count]).x)
    return values, float(np.median(beside(values)))
