"""The dynamic mask: what moved between the views, such as an instrument in one of them, is left out of the view."""

import dataclasses
import logging
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.depth import fill_depth
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView
from endo_sim_ros.reconstruction.stage_configs import DynamicMaskConfig
from endo_sim_ros.reconstruction.triangulation import nearest_views

log = logging.getLogger(__name__)


class _Small(NamedTuple):
    """A view at the size at which views are compared."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] RGB, uint8
    chroma: np.ndarray  # [2, H, W], see `_chroma`
    depth: np.ndarray  # [H, W] m, 0 = none
    points: np.ndarray  # [H * W, 3] m, world, as deep in holes as beside them
    tissue: np.ndarray  # [H, W] float32, 1 or 0


def mask_motion(
    views: Sequence[TrainingView],
    tolerance: float,
    options: DynamicMaskConfig = DynamicMaskConfig(),
    progress: StageProgress = StageProgress(),
) -> list[TrainingView]:
    """The views with what contradicts two or more others, and most of those that see it, masked and without depth prior.

    Args:
        views: Training views with their depth prior.
        tolerance: Relative difference of depth within which two views see the same surface.
        options: What contradicts, and how large a piece must be.
        progress: Reported to by views.
    """
    near = nearest_views(views, 3)  # two of which must contradict
    small = progress.map(lambda view: None if view.depth_prior is None else _small(view, options), views)

    def moved(i: int) -> np.ndarray | None:
        own, others = small[i], [other for j in near[i] if (other := small[j]) is not None]
        if own is None or not (own.depth > 0).any() or len(others) < 2:
            return None
        verdicts = np.array([_verdict(own, other, tolerance, options) for other in others])
        against, agreeing = (verdicts > 0).sum(0), (verdicts < 0).sum(0)
        return _wide_pieces((against >= 2) & (against > agreeing), options)

    return [_masked(view, pixels, options) for view, pixels in zip(views, progress.map(moved, range(len(views))))]


def _masked(view: TrainingView, moved: np.ndarray | None, options: DynamicMaskConfig) -> TrainingView:
    """The view without the pixels [H', W'] of its small version that moved."""
    at = view.stamp_ns * 1e-9
    if moved is None or not moved.any():
        return view
    if moved.mean() > options.max_area:
        log.warning("view at %.3f s: most of it contradicts the other views; check its depth and pose", at)
        return view
    moved = cv2.resize(moved.astype(np.uint8), (view.camera.width, view.camera.height), interpolation=cv2.INTER_NEAREST) > 0
    mask = np.where(moved, 0, 255 if view.mask is None else view.mask).astype(np.uint8)
    percent = round(100 * moved.mean())
    if percent:
        text = "view at %.3f s: %d %% of its pixels contradict the other views, and are left out; something moved, or their depth is wrong"
        log.warning(text, at, percent)
    return dataclasses.replace(view, mask=mask, depth_prior=np.where(moved, np.float32(0), view.surface))


def _small(view: TrainingView, options: DynamicMaskConfig) -> _Small:
    width = options.width
    camera = view.camera.resized(width, max(round(width * view.camera.height / view.camera.width), 1))
    size = (camera.width, camera.height)
    nearest = lambda array: cv2.resize(array, size, interpolation=cv2.INTER_NEAREST_EXACT)
    # Smoothed over a pixel and a half, what poses and depth leave off.
    image = cv2.GaussianBlur(cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), (0, 0), 1.5)
    depth = nearest(view.surface)
    # In a hole something may hide that has no depth: let it be as deep as what is beside it.
    points = camera.backproject(fill_depth(depth)[0] if depth.any() else depth).reshape(-1, 3)
    return _Small(camera, image, _chroma(image), depth, points, nearest(view.tissue))


def _verdict(view: _Small, other: _Small, tolerance: float, options: DynamicMaskConfig) -> np.ndarray:
    """1 where another view contradicts a view [H, W], -1 where it agrees, 0 where it sees nothing of it."""
    known = view.depth > 0
    uv, z = other.camera.project(view.points)
    u, v = ((uv - 0.5).T.reshape(2, *known.shape)).astype(np.float32)  # OpenCV counts from the centre of the first pixel
    z = z.reshape(known.shape)
    look = lambda array, how: cv2.remap(array, u, v, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    surface = look(other.depth, cv2.INTER_NEAREST)
    seen = (z > 0) & (surface > 0) & (view.tissue > 0) & (look(other.tissue, cv2.INTER_NEAREST) > 0)
    floats = seen & known & (z < surface * (1 - tolerance))
    same = seen & (np.abs(z - surface) < tolerance * surface)
    differs = np.abs(view.chroma - _chroma(look(other.image, cv2.INTER_LINEAR))).max(0) > options.chroma
    return np.where(floats | same & differs, 1, np.where(same, -1, 0))


def _chroma(image: np.ndarray) -> np.ndarray:
    """Logarithms of red and blue over green [2, H, W], those of dark pixels, which are noise, next to 0."""
    red, green, blue = cv2.split(np.log(image.astype(np.float32) + 8))
    return np.stack([red - green, blue - green])


def _wide_pieces(pixels: np.ndarray, options: DynamicMaskConfig) -> np.ndarray:
    """The pixels [H, W] in wide pieces, with a margin."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (max(round(options.min_width * options.width), 1),) * 2)
    return cv2.dilate(cv2.morphologyEx(pixels.astype(np.uint8), cv2.MORPH_OPEN, kernel), kernel) > 0
