"""Poses that are off by a little, corrected by what the views share: bundle adjustment that begins, and stays, near them."""

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from endo_sim_ros.core.frames import Frame, interpolated
from endo_sim_ros.core.words import counted
from endo_sim_ros.reconstruction.bundle import Bundle, shared_tracks
from endo_sim_ros.reconstruction.camera_errors import CameraErrors
from endo_sim_ros.reconstruction.pose_check import of_one_motion
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import Matches
from endo_sim_ros.reconstruction.stage_configs import MatchingConfig, PosesConfig
from endo_sim_ros.sequences.misread_poses import Pair, misreading

log = logging.getLogger(__name__)
_STILL = 1e-6  # m and rad
_MOST_LIKELY = 3.0  # likely errors; what is off by more is no robot
_ENOUGH = 0.8  # part of the distance left by one change of all poses that poses which are each off leave, at least: else it is by chance


class CorrectedPoses(NamedTuple):
    """What corrects poses, and what they are better by."""

    errors: CameraErrors
    before: float  # median distance of features from one point each, pixels
    after: float
    distance: float  # of the tissue, m


def corrected_poses(
    frames: Sequence[Frame],
    matches: Sequence[Matches],
    options: PosesConfig = PosesConfig(),
    matching: MatchingConfig = MatchingConfig(),
    progress: StageProgress = StageProgress(),
) -> CorrectedPoses | None:
    """What brings cameras to where their features say; None where these tell too little, or that poses are as right as they can be.

    All poses and points are moved at once so that features are where points appear (Triggs et al. 2000), by robust least squares with
    the weights of a Cauchy distribution. Each pose is likely to err by `options.turn_error` and `options.place_error`; that holds what
    features do not tell, as the place, turn and scale of the whole.

    Tissue that moves could be taken for poses that are off. So features must come much nearer, and views must foresee each other better:
    each is left out once, and its features must be nearer to where the others have them by their corrected poses than by those recorded.
    Views that err each by itself foresee little of each other; where features are then as exact as of right poses, any gain is enough.
    Poses of two views tell nothing of a third, and stay.

    Of `options.mount_views` views or more, one change of all poses is taken in place of these where it leaves as little, as where the lens
    sits elsewhere on its arm than a hand-eye calibration says: the one by which features of left-out views are nearest to where the others
    have them.

    Args:
        frames: Posed views.
        matches: Features that they share.
        options: When poses are off, by how much they likely are, and what a correction must achieve.
        matching: How far a match may lie beside where a motion of the camera has it, and how many matches tell anything.
        progress: Asked whether to go on.

    Raises:
        Cancelled: If progress does.
    """
    cameras = [frame.camera for frame in frames]
    if all(np.allclose(camera.pose, cameras[0].pose, rtol=0, atol=_STILL) for camera in cameras):
        return None  # what moves before a lens that stands still is tissue
    moving = of_one_motion(matches, cameras, matching, progress)
    tracks = shared_tracks(moving, len(cameras), options.most_tracks, progress)
    bundle = Bundle(cameras, tracks, options, matching.reprojection_error)
    if bundle.told < matching.min_points:
        if len(cameras) > 2:
            log.info("whether poses are off cannot be told: three views or more share %s in front of them", counted(bundle.told, "feature"))
        return None
    agreed = lambda changes: bundle.adjusted(changes, bundle.points, False, progress)[1]
    still = np.zeros((len(cameras), 6))
    points = agreed(still)
    before = bundle.error(still, points)
    exact = options.exact * min(camera.width for camera in cameras)
    if before <= exact:
        return None
    if misreading([Pair(cameras[i], cameras[j], first, second) for (i, j), first, second in moving]):
        return None  # the check of poses says so
    each, why_not = _each(bundle, points, before, [frame.stamp_ns for frame in frames], exact, options, progress)
    if len(cameras) >= options.mount_views:
        alike = bundle.alike(progress)
        after = bundle.error(alike, agreed(alike))
        as_good = after <= (exact if each is None else each.after / _ENOUGH)
        if as_good and after <= options.left * before:
            return CorrectedPoses(CameraErrors(mount=alike[0] * bundle.likely), before, after, bundle.depth)
    if each is None:
        log.info("poses stay, though features lie %.2g pixels beside one point each%s", before, why_not)
    return each


def _each(
    bundle: Bundle, points: np.ndarray, before: float, stamps: list[int], exact: float, options: PosesConfig, progress: StageProgress
) -> tuple[CorrectedPoses | None, str]:
    """Poses that are each corrected by something else, of views that were taken at stamps, ns; None where they rather stay, and why."""
    still = np.zeros((len(stamps), 6))
    changes, points = bundle.adjusted(still, points, True, progress)
    after = bundle.error(changes, points)
    if (usual := np.median(np.abs(changes).max(1))) > _MOST_LIKELY:
        return None, f": the usual one would have to be off by {usual:.2g} times what is likely"
    others = [[k for k in range(len(stamps)) if k != i] for i in range(len(stamps))]
    between = np.array([interpolated([stamps[k] for k in rest], changes[rest], stamps[i]) for i, rest in enumerate(others)])
    recorded, alone, gradual = (float(np.median(bundle.left_out(*each))) for each in ((still, still), (changes, still), (changes, between)))
    foreseen = 1.0 if after <= exact else options.foreseen
    if after > options.left * before or min(alone, gradual) > foreseen * recorded:
        beside = f"those of a left-out view lie {recorded:.2g} pixels beside where the others have them, and then {min(alone, gradual):.2g}"
        return None, f", and {after:.2g} with other poses: {beside}"
    errors = CameraErrors(stamps, changes * bundle.likely, gradual < options.foreseen * alone)
    return CorrectedPoses(errors, before, after, bundle.depth), ""
