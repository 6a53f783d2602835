"""The Gaussians that training starts from: depth back-projected from every view, checked between views."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (it is public)
from scipy.spatial.distance import pdist

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.depth import fill_depth
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.words import counted
from endo_sim_ros.reconstruction.keyframes import TOO_NEAR, USUAL_DEPTH
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView, pixels_of
from endo_sim_ros.reconstruction.stage_configs import InitialModelConfig
from endo_sim_ros.reconstruction.surfaces import Surfaces

_FEWEST = 10  # points that give a scene a shape


class _Points(NamedTuple):
    """Surface points with what a Gaussian needs."""

    positions: np.ndarray  # [N, 3] m, world
    colors: np.ndarray  # [N, 3] RGB in [0, 1]
    spacing: np.ndarray  # [N] m, distance to the neighbours


def initial_model(
    views: Sequence[TrainingView],
    points: np.ndarray,
    colors: np.ndarray,
    tolerance: float,
    max_gaussians: int,
    sh_degree: int = 0,
    options: InitialModelConfig = InitialModelConfig(),
    progress: StageProgress = StageProgress(),
    device: str = "cpu",
    share: float = 1.0,
) -> GaussianModel:
    """Isotropic Gaussians at the back-projected depth of the views, and at triangulated points where no depth reaches.

    Args:
        views: Training views; those without a depth prior have no part in the surface.
        points, colors: Triangulated points [N, 3] (m, world) and their RGB in [0, 1].
        tolerance: Relative difference of depth at which two views contradict each other.
        max_gaussians: Largest number of Gaussians of a scene.
        sh_degree: Degree of the spherical harmonics.
        options: Opacity, and which points float before the surface.
        progress: Reported to by views.
        device: Where views are compared.
        share: Part of ``max_gaussians`` that may be used here, above 0 and up to 1; at least one is used.

    Raises:
        SequenceError: If neither depth nor points give the scene a shape, or the number of Gaussians leaves next to none of it.
    """
    most = max(int(share * max_gaussians), 1)
    surfaces = [view for view in views if (view.surface > 0).any()]
    parts = [_Points(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))]
    chosen: list[np.ndarray] = []
    if surfaces:
        compared = Surfaces(surfaces, device)
        chosen = compared.chosen(tolerance, progress)
        stride = _stride(chosen, most)
        taken = [pixels & _lattice(pixels.shape, stride) for pixels in chosen]
        for view, pixels, seen in zip(surfaces, taken, compared.mean_colors(taken, tolerance, progress)):
            depth, centres = view.surface[pixels].astype(np.float64), np.argwhere(pixels)[:, ::-1] + 0.5
            parts.append(_Points(view.camera.unproject(centres, depth), seen, stride * depth / view.camera.K[0, 0]))
    useful = np.ones(len(points), bool)
    if any(pixels.any() for pixels in chosen):
        useful = _believable(views, points, tolerance, options, progress)
    parts.append(_in_holes(parts, points[useful], colors[useful]))
    positions, *others = (np.concatenate(arrays) for arrays in zip(*parts))
    shown = sum(int(pixels.sum()) for pixels in chosen)
    if len(positions) < _FEWEST <= shown:
        raise SequenceError(
            f"max_gaussians = {max_gaussians} is too small: of {shown} pixels with depth in {counted(len(views), 'view')} it leaves "
            f"{len(positions)} to start from; give some thousands, or 0 for as many as the views can tell of"
        )
    if len(positions) < _FEWEST:  # stray matches
        raise SequenceError(
            f"only {counted(len(positions), 'scene point')} could be found in {counted(len(views), 'view')}; give depth or a right image, "
            "views that overlap from different positions, or check the poses"
        )
    tensors = [torch.from_numpy(array[:most].astype(np.float32)) for array in (positions, *others)]
    return GaussianModel.from_points(*tensors, opacity=options.opacity, sh_degree=sh_degree)


def rough_depth(views: Sequence[TrainingView], points: np.ndarray) -> float:
    """Median depth (m) of the scene points [N, 3] in the views; NaN if fewer than three are in any, which may be stray."""
    depths = [pixels_of(view.camera, points).depth for view in views]
    return float(np.median(np.concatenate(depths))) if max(map(len, depths)) >= 3 else math.nan


def guessed_depth(cameras: Sequence[Camera], shift: float) -> float:
    """A depth (m) where nothing tells one: there the picture moves by so many of its widths between two cameras, in the median.

    It has the unit of the poses, whatever that is. Of cameras in one place it is `USUAL_DEPTH`, at which they see the same as at any.
    """
    distances = pdist([camera.position for camera in cameras])
    apart = distances[distances > 0]
    focal = np.median([camera.K[0, 0] / camera.width for camera in cameras])
    depth = float(np.median(apart) * focal / shift) if len(apart) else 0.0
    return depth if depth > TOO_NEAR else USUAL_DEPTH


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


def _believable(
    views: Sequence[TrainingView], points: np.ndarray, tolerance: float, options: InitialModelConfig, progress: StageProgress
) -> np.ndarray:
    """Which triangulated points [N] may be tissue of unknown depth: in a hole of some view's surface, and beyond what is beside it in no
    view, nor, in that one, behind it. Points outside of all views would reach into them; see `extrapolate`.

    Highlights are where depth has holes, and where points are matched that are no tissue: images of the light in it. Training would
    make the tissue before them transparent, since they explain how the highlights move.
    """

    def compare(view: TrainingView) -> tuple[np.ndarray, np.ndarray]:
        found = pixels_of(view.camera, points)
        if not (view.surface > 0).any():
            return found.index[:0], found.index
        depth, distance = (values[found.rows, found.columns] for values in fill_depth(view.surface)[:2])
        rise = tolerance + options.max_slope * distance / view.camera.K[0, 0]
        floats, sinks = found.depth < depth * (1 - rise), found.depth > depth * (1 + rise)
        return found.index[floats], found.index[(distance > 0) & ~sinks]

    floating, fitting = np.zeros((2, len(points)), bool)
    for floats, fits in progress.map(compare, views):
        floating[floats] = fitting[fits] = True
    return fitting & ~floating


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
