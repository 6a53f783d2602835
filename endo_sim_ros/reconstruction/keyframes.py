"""Choice of the views to train on."""

import logging
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.words import counted
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import ScenePoints
from endo_sim_ros.reconstruction.stage_configs import CoverageConfig
from endo_sim_ros.reconstruction.triangulation import scene_points

log = logging.getLogger(__name__)

USUAL_DEPTH = 0.1
"""Distance of a laparoscope from the tissue, metres, where no point tells it."""

TOO_NEAR = 0.002
"""Metres; if only depths below it would let pictures move, the camera has hardly moved."""

_FEWEST_POINTS = 30  # in a view, to tell its distance; fewer may be wrong matches
_MOST_POINTS = 1000  # of the scene, to find medians of: more tell the same


class Posed(Protocol):
    """What has a camera: a frame, or a glance at one."""

    @property
    def camera(self) -> Camera:
        """Camera with its pose."""
        ...


def choose_views(
    views: Sequence[Posed],
    sample: Sequence[Frame],
    config: ReconstructionConfig,
    progress: StageProgress = StageProgress(),
    given: ScenePoints | None = None,
) -> tuple[list[int], ScenePoints | None]:
    """Indices of the views of a recording to train on, and scene points of all of it; None where every view is trained on.

    Args:
        views: All views, in the order of time; their images are not needed.
        sample: Some of them, spread over the recording, with their images.
        config: ``keyframes``, ``coverage`` and ``matching`` count.
        progress: Reported to while points are triangulated.
        given: Scene points that the recording brings; None triangulates.
    """
    points = given
    if given is None and (config.keyframes or config.coverage.min_keyframes) < len(views):
        points = scene_points(sample, options=config.matching, progress=progress)
    chosen = select_keyframes(views, config.keyframes, points, config.coverage)
    return chosen, points if given or len(chosen) < len(views) else None


def select_keyframes(
    frames: Sequence[Posed], count: int = 0, points: ScenePoints | None = None, options: CoverageConfig = CoverageConfig()
) -> list[int]:
    """Indices, in order, of views that spread over the camera path: at most ``count``, or by coverage where that is 0.

    Greedy farthest-point choice, beginning with the first and the last view, so that more views are always added between
    fewer. The distance between two views is how far the optical centre and the point that it looks at move, root mean square, in
    widths of what the second view shows of the tissue: of a camera that moves sideways, the share of its picture that is new.

    Args:
        frames: All views, in the order of time.
        count: Number of views; 0 adds views until none of the others is farther than `coverage.new_share` from a chosen one.
        points: Scene points, which tell how far away the tissue is; without them it is `USUAL_DEPTH`.
        options: Of the choice by coverage.
    """
    fewest, most = (count, count) if count else (options.min_keyframes, options.max_keyframes)
    if fewest >= len(frames):
        return list(range(len(frames)))
    depths = _depths(frames, points)
    poses = np.array([frame.camera.pose for frame in frames])
    ahead = poses[:, :3, 3] + np.median(depths) * poses[:, :3, 2]
    features = np.concatenate([poses[:, :3, 3], ahead], 1) / np.sqrt(2)
    widths = depths * [frame.camera.width / frame.camera.K[0, 0] for frame in frames]
    chosen = [0, len(frames) - 1][:most]
    distance = np.min([np.linalg.norm(features - features[i], axis=1) for i in chosen], 0) / widths
    while len(chosen) < min(most, len(frames)) and (len(chosen) < fewest or distance.max() > options.new_share):
        distance[chosen] = -1.0  # identical poses must not be picked twice
        farthest = int(distance.argmax())
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(features - features[farthest], axis=1) / widths)
    option = "keyframes" if count else "coverage.max_keyframes"
    why = f"as many as {option} allows" if len(chosen) == most else "enough"
    text = "%s of %s, %s: up to %.1f %% of a view's picture is new to them (tissue %.3g m away)"
    log.info(text, counted(len(chosen), "keyframe"), counted(len(frames), "view"), why, 100 * distance.max(), np.median(depths))
    return sorted(chosen)


def _depths(frames: Sequence[Posed], points: ScenePoints | None) -> np.ndarray:
    """Median depth [V] of the scene points in each view, metres; that of all where a view sees few."""
    known = np.empty((0, 3)) if points is None else points.positions[:: len(points.positions) // _MOST_POINTS + 1]
    depths = np.full(len(frames), np.nan)
    for index, frame in enumerate(frames):
        seen = known[frame.camera.sees(known)]
        if len(seen) >= _FEWEST_POINTS:
            depths[index] = np.median(frame.camera.project(seen)[1])
    typical = float(np.nanmedian(depths)) if np.isfinite(depths).any() else USUAL_DEPTH
    return np.where(np.isfinite(depths), depths, typical)
