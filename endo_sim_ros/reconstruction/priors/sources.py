"""Depth priors: one depth image per training view, in metres, from whatever the recording offers."""

import dataclasses
import functools
import logging
import threading
from collections.abc import Sequence

import cv2
import numpy as np

from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.priors.interpolation import clip_to_range, fit_plane, krige
from endo_sim_ros.reconstruction.priors.network import cached_checkpoint, load_network, network_depth
from endo_sim_ros.reconstruction.priors.stereo import align_rows, disparity_to_depth, stereo_depth, stereo_disparity
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import ScenePoints, TrainingView
from endo_sim_ros.reconstruction.stage_configs import InterpolationConfig, MatchingConfig
from endo_sim_ros.reconstruction.triangulation import points_in_view

log = logging.getLogger(__name__)


def estimate_depth(
    views: Sequence[TrainingView],
    points: ScenePoints,
    config: ReconstructionConfig,
    progress: StageProgress = StageProgress(),
    motion: TissueMotion | None = None,
) -> list[TrainingView]:
    """The views with ``depth_prior`` set to the configured prior, or None where there is none.

    The prior is 0 where it has no finite positive measurement and where the mask says that there is no tissue. A right eye's
    principal point that turns out to be wrong is corrected in the views.

    Args:
        views: Training views, best at full size: disparities are as precise as the pixels are fine.
        points: Triangulated scene points, to interpolate between, or to find a constant disparity offset of stereo matching.
        config: ``depth`` names the source; ``auto`` takes the depth topic, else stereo, else a network if there is one,
            else the points; ``network_first`` likewise after a network. Each source has its own options.
        progress: Reported to by views.
        motion: How the tissue moves in the views, for stereo matching; points are in their mean positions.

    Raises:
        SequenceError: If the source asked for is not in the recording.
    """
    source = depth_source(views, config)
    if source == "topic":
        if not any(map(_has_depth, views)):
            raise SequenceError("depth=topic, but no view has a depth image; publish endoscope/left/depth or use auto")
        return [_with_prior(view, view.depth) for view in views]
    if source == "stereo":
        if all(view.right is None for view in views):
            raise SequenceError("depth=stereo, but no view has a right image; publish endoscope/right/* or use depth=auto")
        return [_with_prior(*found) for found in stereo_depth(views, points, config.stereo, config.matching, progress, motion)]
    if source == "network":
        network, one_at_a_time = functools.cache(lambda: load_network(config.depth_model, pick_device(config.device))), threading.Lock()

        def by_network(view: TrainingView) -> TrainingView:
            known = _known_depths(view, points.positions, config)
            with one_at_a_time:
                return _with_prior(view, network_depth(view, network(), known, config.network))

        found = progress.map(by_network, views)
        if all(view.depth_prior is None for view in found) and (config.depth == "network" or len(points.positions)):
            raise SequenceError(
                "depth=network, but no view's depth fits the scene points; check the poses, give views that overlap, or use depth=points"
            )
        return found
    if source == "points":
        options = config.interpolation, config.matching, pick_device(config.device)
        found = progress.map(lambda view: between_points(view, points.positions, *options), views)
        without = sum(view.depth_prior is None for view in found)
        if without and len(views) > 1:  # a lone one is told what helps it when training starts from a plane
            log.warning("fewer than %d scene points agree in %d of %d views", config.matching.min_points, without, len(views))
        return found
    return [_with_prior(view, None) for view in views]


def borrow_depth(views: Sequence[TrainingView], config: ReconstructionConfig) -> list[TrainingView]:
    """The views; those without a depth prior get one interpolated between what the others know, as between scene points."""
    parts = []
    for view in views:
        stride = max(int(config.interpolation.cell * view.camera.width), 1)
        taken = np.zeros(view.surface.shape, bool)
        taken[::stride, ::stride] = view.surface[::stride, ::stride] > 0
        parts.append(view.camera.backproject(view.surface)[taken])
    points = np.concatenate(parts)
    depth = lambda view: interpolate_points(view, points, config.interpolation, config.matching, pick_device(config.device))
    return [view if view.depth_prior is not None else _with_prior(view, depth(view)) for view in views]


def depth_source(frames: Sequence[Frame], config: ReconstructionConfig) -> str:
    """Where the depth of these views is from: the source that is configured, or what ``auto`` or ``network_first`` finds.

    A topic that has depth of fewer views than there are pairs gives way to stereo matching.
    """
    if config.depth not in ("auto", "network_first"):
        return config.depth
    has_network = lambda: bool(config.depth_model or cached_checkpoint())
    if config.depth == "network_first" and has_network():
        return "network"
    pairs = sum(frame.right is not None for frame in frames)
    if sum(map(_has_depth, frames)) >= max(pairs, 1):
        return "topic"
    if pairs:
        return "stereo"
    return "network" if has_network() else "points"


def interpolate_points(
    frame: Frame,
    points: np.ndarray,
    options: InterpolationConfig = InterpolationConfig(),
    matching: MatchingConfig = MatchingConfig(),
    device: str = "cpu",
) -> np.ndarray | None:
    """Depth [H, W] (m, 0 outside their hull) between the scene points [N, 3] (m, world) seen in a view; None if few.

    Kriging of how far inverse depth is from a plane's; all points err alike.
    """
    uv, z = points_in_view(frame.camera, points, matching)
    if len(uv) < matching.min_points or np.linalg.matrix_rank(uv - uv.mean(0), tol=1.0) < 2:
        return None
    height, width = shape = frame.camera.height, frame.camera.width
    a, b, c = fit_plane(uv[:, 0], uv[:, 1], 1 / z)
    apart = 1 / z - (a * uv[:, 0] + b * uv[:, 1] + c)
    residual = krige(np.zeros(shape), np.zeros(shape, bool), uv, apart, width, options, device)
    plane = a * (np.arange(width) + 0.5) + b * (np.arange(height)[:, None] + 0.5) + c
    inverse = clip_to_range(plane + residual, 1 / z, options)
    hull = cv2.fillConvexPoly(np.zeros(shape, np.uint8), cv2.convexHull(np.floor(uv).astype(np.int32)), 1)
    return np.where(hull > 0, 1 / inverse, 0).astype(np.float32)


def between_points(
    view: TrainingView, points: np.ndarray, options: InterpolationConfig, matching: MatchingConfig, device: str
) -> TrainingView:
    """The view with depth from `interpolate_points`, whose arguments these are, where it shows tissue."""
    return _with_prior(view, interpolate_points(view, points, options, matching, device))


def _has_depth(frame: Frame) -> bool:
    return frame.depth is not None and bool((frame.depth > 0).any())


def _with_prior(view: TrainingView, depth: np.ndarray | None) -> TrainingView:
    if depth is not None:
        valid = np.isfinite(depth) & (depth > 0) & (True if view.mask is None else view.mask > 0)
        depth = np.where(valid, depth, 0).astype(np.float32)
    return dataclasses.replace(view, depth_prior=depth)


def _known_depths(view: TrainingView, points: np.ndarray, config: ReconstructionConfig) -> np.ndarray:
    """Pixels u, v and depths z (m) [N, 3] of what is known in a view: scene points, or stereo matches where there is a right image."""
    if view.right is None:
        uv, z = view.camera.project(points[view.camera.sees(points)])
        return np.column_stack([uv, z])
    view = align_rows(view, config.stereo, config.matching)
    depth = disparity_to_depth(view, stereo_disparity(view, config.stereo), options=config.stereo)
    stride = 16  # pixels: neighbours say the same
    v, u = (stride * index + stride // 2 for index in np.nonzero(depth[stride // 2 :: stride, stride // 2 :: stride]))
    return np.stack([u + 0.5, v + 0.5, depth[v, u]], 1)
