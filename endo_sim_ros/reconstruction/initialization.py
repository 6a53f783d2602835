"""The Gaussians that training starts from: depth back-projected from every view, checked between views."""

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from endo_sim_ros.core.device import map_in_threads
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.config import ReconstructionConfig

_OPACITY = 0.5
_STEEPEST = 2.0  # slope of a surface across the line of sight, beyond which a point near it floats in front of it
_MIN_POINTS = 10


class _Points(NamedTuple):
    """Surface points with what a Gaussian needs."""

    positions: np.ndarray  # [N, 3] m, world
    colors: np.ndarray  # [N, 3] RGB in [0, 1]
    spacing: np.ndarray  # [N] m, distance to the neighbours


def initial_model(frames: list[Frame], points: np.ndarray, colors: np.ndarray, config: ReconstructionConfig) -> GaussianModel:
    """Isotropic Gaussians at the back-projected depth of the views, and at triangulated points where no depth reaches.

    Args:
        frames: Training views, with their depth prior.
        points, colors: Triangulated points [N, 3] (m, world) and their RGB in [0, 1].

    Raises:
        SequenceError: If neither depth nor points give the scene a shape.
    """
    if config.initialization == "points":
        frames = [dataclasses.replace(frame, depth=None) for frame in frames]
    chosen = _surface_pixels(frames, config.depth_tolerance)
    stride = _stride(chosen, config.max_gaussians)
    taken = [pixels & _lattice(pixels.shape, stride) for pixels in chosen]
    parts = [_back_project(frames, i, pixels, stride, config.depth_tolerance) for i, pixels in enumerate(taken)]
    useful = ~_afloat(frames, points, config.depth_tolerance)
    if any(pixels.any() for pixels in chosen):  # lone points beyond the views would reach into them; see `with_surroundings`
        useful &= np.any([frame.camera.sees(points) for frame in frames], 0)
    parts.append(_in_holes(parts, points[useful], colors[useful]))
    positions, colors, spacing = (np.concatenate(arrays) for arrays in zip(*parts))
    if len(positions) < _MIN_POINTS:
        raise SequenceError(
            f"only {len(positions)} scene points could be found in {len(frames)} views; give depth or a right image, "
            "views that overlap from different positions, or check the poses"
        )
    arrays = (array[: config.max_gaussians] for array in (positions, colors, spacing))
    tensors = [torch.from_numpy(array.astype(np.float32)) for array in arrays]
    return GaussianModel.from_points(*tensors, _OPACITY, config.sh_degree)


def _surface_pixels(frames: list[Frame], tolerance: float) -> list[np.ndarray]:
    """Which pixels [H, W] of each view to back-project, so that every piece of surface is there once.

    The view that sees a piece from nearest provides it. A pixel whose point floats in front of the surface that another
    view sees, by more than the relative tolerance, is contradicted and left out.
    """
    chosen = [np.zeros((frame.camera.height, frame.camera.width), bool) for frame in frames]
    with_depth = [i for i, frame in enumerate(frames) if frame.depth is not None and (frame.depth > 0).any()]
    fineness = {i: np.median(frames[i].depth[frames[i].depth > 0]) / frames[i].camera.K[0, 0] for i in with_depth}
    done = []
    for i in sorted(with_depth, key=fineness.get):
        frame = frames[i]
        pixels = (frame.depth > 0) & (True if frame.mask is None else frame.mask > 0)
        points = frame.camera.backproject(frame.depth)[pixels]

        def keeps(j: int) -> np.ndarray:
            z, surface, _ = _seen(frames[j], points)  # noqa: B023
            return (surface <= 0) | (z >= surface * (1 + tolerance if j in done else 1 - tolerance))

        chosen[i][pixels] = np.all([np.ones(len(points), bool), *map_in_threads(keeps, [j for j in with_depth if j != i])], 0)
        done.append(i)
    return chosen


def _seen(frame: Frame, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [N] (m) of points [N, 3] in a view; depth (0 = none) of the surface that it sees there, and which of its pixels that is [N]."""
    uv, z = frame.camera.project(points)
    u, v = uv.T
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < frame.camera.width) & (v < frame.camera.height)
    pixels = np.where(inside, v, 0).astype(int) * frame.camera.width + np.where(inside, u, 0).astype(int)
    return z, np.where(inside, frame.depth.reshape(-1)[pixels], 0.0), pixels


def _stride(chosen: list[np.ndarray], limit: int) -> float:
    """Smallest distance (pixels, at least 1) of a lattice that takes no more than ``limit`` of the chosen pixels."""
    total = sum(int(pixels.sum()) for pixels in chosen)
    stride = max((total / limit) ** 0.5, 1.0)
    while sum(int((pixels & _lattice(pixels.shape, stride)).sum()) for pixels in chosen) > limit:
        stride *= 1.01
    return stride


def _lattice(shape: tuple[int, int], stride: float) -> np.ndarray:
    """A regular choice of pixels [H, W], one in every ``stride``² (not necessarily a whole number)."""
    rows, columns = (np.diff(np.floor(np.arange(-1, n) / stride)) > 0 for n in shape)
    return rows[:, None] & columns


def _back_project(frames: list[Frame], index: int, pixels: np.ndarray, stride: float, tolerance: float) -> _Points:
    """Points of the given pixels [H, W] of one view, with the mean colour of the views that see them.

    The light moves with the endoscope: colours of one view alone would show where the next view's piece begins.
    """
    if not pixels.any():
        return _Points(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    frame = frames[index]
    points, colors = frame.camera.backproject(frame.depth)[pixels], frame.image[pixels] / 255.0
    count = np.ones((len(points), 1))
    for j, other in enumerate(frames):
        if j == index or other.depth is None:
            continue
        z, surface, seen = _seen(other, points)
        agrees = ((surface > 0) & (np.abs(z - surface) < tolerance * surface))[:, None]
        colors, count = colors + agrees * (other.image.reshape(-1, 3)[seen] / 255.0), count + agrees
    return _Points(points, colors / count, stride * frame.depth[pixels].astype(np.float64) / frame.camera.K[0, 0])


def _afloat(frames: list[Frame], points: np.ndarray, tolerance: float) -> np.ndarray:
    """Which triangulated points [N] float in front of the surface that some view sees there or, in a hole of it, beside it.

    Highlights are where depth has holes, and where points are matched that are no tissue: they move with the light.
    """
    floats = np.zeros(len(points), bool)
    for frame in frames:
        if frame.depth is None or not (frame.depth > 0).any():
            continue
        distance, nearest = distance_transform_edt(frame.depth <= 0, return_indices=True)
        beside = (frame.depth[tuple(nearest)] * (1 - tolerance - _STEEPEST * distance / frame.camera.K[0, 0])).astype(np.float32)
        z, surface, _ = _seen(dataclasses.replace(frame, depth=np.maximum(beside, 0)), points)
        floats |= (surface > 0) & (z < surface)
    return floats


def _in_holes(parts: list[_Points], points: np.ndarray, colors: np.ndarray) -> _Points:
    """The triangulated points that lie where the back-projected surface has a hole, or all if there is none."""
    surface = np.concatenate([part.positions for part in parts])
    if len(surface) and len(points):
        distance, nearest = cKDTree(surface).query(points)
        far = distance > 5 * np.concatenate([part.spacing for part in parts])[nearest]
        points, colors = points[far], colors[far]
    if len(points) < 2:
        return _Points(points, colors, np.full(len(points), 1e-3))
    spacing = cKDTree(points).query(points, k=min(4, len(points)))[0][:, 1:].mean(1)
    return _Points(points, colors, np.minimum(spacing, 4 * np.median(spacing)))  # a lone point must not cover the scene
