"""Views whose pose contradicts what they share with the others."""

import logging
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.features import epipolar_distance, slopes
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import Matches
from endo_sim_ros.reconstruction.stage_configs import MatchingConfig, PosesConfig
from endo_sim_ros.sequences.misread_poses import Pair, misreading

log = logging.getLogger(__name__)

_Views = tuple[int, ...]


def misposed(
    frames: Sequence[Frame],
    matches: Sequence[Matches],
    depths: Sequence[np.ndarray | None] | None = None,
    options: PosesConfig = PosesConfig(),
    matching: MatchingConfig = MatchingConfig(),
    progress: StageProgress = StageProgress(),
) -> list[int]:
    """Indices of the views whose poses contradict most of the views that they share features with.

    Matches of two views that fit some motion of the camera must fit the given one. A feature that three views share must be one
    point, which fails where a pose is wrong along the line of sight. Where views contradict each other and nothing tells which one
    is wrong, that is logged, and none is named.

    Args:
        frames: Posed views.
        matches: Features that they share.
        depths: Depth [H, W] (m, 0 = none) of each view that does not depend on its pose, such as a sensor's; None for none.
        options: When a pose is wrong.
        matching: How far a match may lie beside where a motion of the camera has it, and how many matches tell anything.
        progress: Reported to by pairs of views.

    Raises:
        Cancelled: If progress does.
        SequenceError: If the poses were written by another convention, as from world to camera.
    """
    check = _PoseCheck(frames, depths or [None] * len(frames), options, matching, progress)
    cameras = [frame.camera for frame in frames]
    moving = of_one_motion(matches, cameras, matching, progress)
    if told := misreading([Pair(frames[i].camera, frames[j].camera, first, second) for (i, j), first, second in moving]):
        raise SequenceError(f"the poses {told[0]}; {told[1]}")
    wrong, unsettled = check.outvoted([(match.views, error) for match, error in zip(moving, progress.map(check.error_in_two, moving))])
    moving = [match for match in moving if not set(match.views) & set(wrong)]
    tracks = _tracks(moving, matching.min_points, progress)
    errors = progress.map(lambda track: check.error_in_three(*track), tracks)
    more, untold = check.outvoted([(views, error) for (views, _), error in zip(tracks, errors)])
    wrong += more
    if not wrong and (unsettled := unsettled or untold):
        check.tell(unsettled)
    return sorted(wrong)


def of_one_motion(matches: Sequence[Matches], cameras: Sequence[Camera], options: MatchingConfig, progress: StageProgress) -> list[Matches]:
    """The matches of each pair of views that fit one motion of the camera, of those pairs that have any."""
    return [found for found in progress.map(lambda match: _of_one_motion(match, cameras, options), matches) if len(found.first)]


def _of_one_motion(matches: Matches, cameras: Sequence[Camera], options: MatchingConfig) -> Matches:
    """The matches that fit the motion of the camera that most fit, whatever the poses are; none where it may be an accident."""
    first, second = (cameras[view] for view in matches.views)
    none, count = matches._replace(first=matches.first[:0], second=matches.second[:0]), len(matches.first)
    if count < options.min_points:
        return none
    here, there = slopes(first, matches.first), slopes(second, matches.second)
    found: Any = cv2.findEssentialMat(here, there, np.eye(3), cv2.RANSAC, 0.999, options.reprojection_error / second.K[0, 0])
    if found[1] is None:
        return none
    inliers = found[1][:, 0] > 0
    # Fewer than half of the matches fit many a motion.
    if inliers.sum() < max(options.min_points, 0.5 * count):
        return none
    return matches._replace(first=matches.first[inliers], second=matches.second[inliers])


class _PoseCheck:
    """How far off features of several views are, and which views are to blame; errors are in widths of the image."""

    def __init__(
        self,
        frames: Sequence[Frame],
        depths: Sequence[np.ndarray | None],
        options: PosesConfig,
        matching: MatchingConfig,
        progress: StageProgress,
    ) -> None:
        self._cameras = [frame.camera for frame in frames]
        self._stamps = [f"{frame.stamp_ns * 1e-9:.3f} s" for frame in frames]
        self._depths, self._options, self._matching, self._progress = depths, options, matching, progress

    def error_in_two(self, matches: Matches) -> float:
        """How far matches are from where the poses, and depth if there is any, expect them: the median."""
        (i, j), here, there = matches
        errors = [np.median(epipolar_distance(self._cameras[i], self._cameras[j], here, there))]
        for one, other, here, there in ((i, j, here, there), (j, i, there, here)):
            depth = self._depths[one]
            if depth is None:
                continue
            u, v = np.floor(here).astype(int).T
            known = depth[v, u] > 0
            if known.sum() >= self._matching.min_points:
                points = self._cameras[one].unproject((np.floor(here) + 0.5)[known], depth[v, u][known])
                errors.append(np.median(np.linalg.norm(self._cameras[other].project(points)[0] - there[known], axis=1)))
        return float(max(errors)) / self._cameras[j].width

    def error_in_three(self, views: _Views, pixels: Sequence[np.ndarray]) -> float:
        """How far features [M, 2] of several views are from one point each: the median, of the worst view each."""
        cameras = [self._cameras[view] for view in views]
        if np.ptp([camera.position for camera in cameras], 0).max() < 1e-6:
            return 0.0  # from one place any point on a ray would do
        rows = []
        for camera, uv in zip(cameras, pixels):
            x, y = slopes(camera, uv).T[..., None]
            rows += [x * camera.viewmat[2] - camera.viewmat[0], y * camera.viewmat[2] - camera.viewmat[1]]
        equations = np.stack(rows, 1)
        homogeneous = np.linalg.eigh(equations.swapaxes(1, 2) @ equations)[1][..., 0]  # a singular value decomposition takes twice as long
        points = homogeneous[:, :3] / np.where(np.abs(homogeneous[:, 3:]) < 1e-9, 1e-9, homogeneous[:, 3:])
        errors = np.zeros(len(points))
        for camera, uv in zip(cameras, pixels):
            expected, z = camera.project(points)
            errors = np.maximum(errors, np.where(z > 0, np.linalg.norm(expected - uv, axis=1) / camera.width, np.inf))
        return float(np.median(errors))

    def outvoted(self, errors: Sequence[tuple[_Views, float]]) -> tuple[list[int], list[_Views]]:
        """The views that most of their groups contradict, of groups of views and the error of each; and the other groups that err.

        No view is named unless more other views agree with each other than are found wrong.
        """
        if not errors:
            return [], []
        options = self._options
        # A fifth of the groups is right, even where most views are wrong.
        usual = np.quantile([error for _, error in errors], 0.2, method="lower")
        limit = min(max(options.min_error, options.outlier_factor * usual), options.max_error)
        wrong: list[int] = []
        while True:  # the worst first: what contradicts it may be right without it
            self._progress.check()
            left = [(views, error) for views, error in errors if not set(views) & set(wrong)]
            bad, all_of, total = np.zeros((3, len(self._cameras)))
            for views, error in left:
                bad[list(views)] += error > limit
                all_of[list(views)] += 1
                total[list(views)] += min(error, 1.0)
            share = bad / np.maximum(all_of, 1)
            worst = max(range(len(share)), key=lambda view: (share[view], bad[view], total[view]))
            if not bad[worst] or all_of[worst] < 2 or share[worst] <= 0.5:
                break
            wrong.append(worst)
        agreeing = {view for views, error in left if error <= limit for view in views}
        wrong = wrong if len(agreeing) > len(wrong) else []
        return wrong, sorted({tuple(sorted(views)) for views, error in errors if error > limit and not set(views) & set(wrong)})

    def tell(self, unsettled: Sequence[_Views]) -> None:
        """Log the groups of views that contradict each other: the first three, and how many others."""
        examples = ", ".join(" and ".join(self._stamps[view] for view in views) for views in unsettled[:3])
        more = f", and of {counted(len(unsettled) - 3, 'other group')} of views," if len(unsettled) > 3 else ""
        log.warning(
            "the poses of the views at %s%s contradict what these see; check these poses and their stamps, "
            "unless the tissue moved in between",
            examples, more,
        )  # fmt: skip


def _tracks(matches: Sequence[Matches], least: int, progress: StageProgress) -> list[tuple[_Views, list[np.ndarray]]]:
    """Three views each, with their pixels [M, 2] of the features that the first shares with both others, if they are enough."""
    ends: dict[int, list[tuple[int, np.ndarray, np.ndarray]]] = {}
    for (i, j), first, second in matches:
        ends.setdefault(i, []).append((j, first, second))
        ends.setdefault(j, []).append((i, second, first))
    found = []
    for view, others in ends.items():
        progress.check()
        for (j, here_j, there_j), (k, here_k, there_k) in combinations(others, 2):
            _, of_j, of_k = np.intersect1d(here_j @ [1, 1j], here_k @ [1, 1j], return_indices=True)
            if len(of_j) >= least:
                found.append(((view, j, k), [here_j[of_j], there_j[of_j], there_k[of_k]]))
    return found
