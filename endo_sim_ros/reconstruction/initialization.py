"""The Gaussians that training starts from: depth back-projected from every view, checked between views."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.sequences.frames import Frame, SequenceError

_OPACITY = 0.5
_MIN_POINTS = 10


def initial_model(
    frames: list[Frame], points: np.ndarray, colors: np.ndarray, config: ReconstructionConfig
) -> GaussianModel:
    """Isotropic Gaussians at the back-projected depth of the views, and at triangulated points where no depth reaches.

    Args:
        frames: Training views, with their depth prior.
        points, colors: Triangulated points [N, 3] (m, world) and their RGB in [0, 1].

    Raises:
        SequenceError: If neither depth nor points give the scene a shape.
    """
    dense = [_consistent_points(frames, index, config.depth_tolerance) for index in range(len(frames))]
    dense_points = np.concatenate([p for p, _ in dense])
    dense_colors = np.concatenate([c for _, c in dense])
    if len(dense_points):
        # Keep triangulated points only where the dense cloud leaves a hole.
        spacing = _median_spacing(dense_points)
        far = cKDTree(dense_points).query(points)[0] > 5 * spacing if len(points) else np.zeros(0, bool)
        points, colors = points[far], colors[far]
    points, colors = np.concatenate([dense_points, points]), np.concatenate([dense_colors, colors])
    if len(points) < _MIN_POINTS:
        raise SequenceError(
            f"only {len(points)} scene points could be found in {len(frames)} views; give depth or a right image, "
            "views that overlap from different positions, or check the poses"
        )
    points, colors = _thin(points, colors, config.max_gaussians)
    spacing = cKDTree(points).query(points, k=min(4, len(points)))[0][:, 1:].mean(1)
    spacing = np.minimum(spacing, 4 * np.median(spacing))  # a lone point must not cover the scene
    tensor = lambda array: torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))  # noqa: E731
    return GaussianModel.from_points(tensor(points), tensor(colors), tensor(spacing), _OPACITY, config.sh_degree)


def _consistent_points(frames: list[Frame], index: int, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Back-projected pixels of one view that no other view contradicts.

    A view contradicts a point that floats in front of the surface it sees by more than the relative tolerance.
    """
    frame = frames[index]
    if frame.depth is None:
        return np.empty((0, 3)), np.empty((0, 3))
    valid = (frame.depth > 0) & (True if frame.mask is None else frame.mask > 0)
    points, colors = frame.camera.backproject(frame.depth)[valid], frame.image[valid] / 255.0
    keep = np.ones(len(points), bool)
    for other in frames[:index] + frames[index + 1 :]:
        if other.depth is None:
            continue
        uv, z = other.camera.project(points)
        u, v = np.floor(uv).astype(int).T
        seen = (z > 0) & (u >= 0) & (v >= 0) & (u < other.camera.width) & (v < other.camera.height)
        surface = np.zeros(len(points))
        surface[seen] = other.depth[v[seen], u[seen]]
        keep &= ~((surface > 0) & (z < surface * (1 - tolerance)))
    return points[keep], colors[keep]


def _median_spacing(points: np.ndarray) -> float:
    sample = points[:: max(len(points) // 2000, 1)]
    return float(np.median(cKDTree(points).query(sample, k=2)[0][:, 1]))


def _thin(points: np.ndarray, colors: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Average points and colours in cubes, as small as the limit on their number allows."""
    low, size = 0.0, float(np.ptp(points, axis=0).max()) or 1.0
    origin = points.min(0)
    for _ in range(20):  # bisection on the cube's size
        middle = 0.5 * (low + size)
        cells = np.unique(_cell_keys(points, origin, middle))
        low, size = (low, middle) if len(cells) <= limit else (middle, size)
    _, inverse, counts = np.unique(_cell_keys(points, origin, size), return_inverse=True, return_counts=True)
    average = lambda values: np.stack(  # noqa: E731
        [np.bincount(inverse, values[:, axis]) / counts for axis in range(3)], 1
    )
    return average(points), average(colors)


def _cell_keys(points: np.ndarray, origin: np.ndarray, size: float) -> np.ndarray:
    cells = np.minimum((points - origin) / size, 2**20).astype(np.int64)
    return cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2]
