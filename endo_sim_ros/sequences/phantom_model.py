"""The synthetic patient as Gaussians, without any reconstruction."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_camera, render_phantom

_STEEPEST = 4.0  # pixels that a Gaussian may span; beyond it lies another surface


def phantom_model(count: int, width: int, seed: int = 0) -> tuple[GaussianModel, Camera]:
    """About `count` Gaussians on what an endoscope sees of the synthetic patient, and its camera.

    Args:
        count: Number of Gaussians, one for each pixel of a picture of about as many.
        width: Image width of the camera, pixels; its height is 0.8 of it.
        seed: Which patient.
    """
    camera = phantom_camera(PhantomConfig(width=width, height=round(0.8 * width)))
    columns = max(round(math.sqrt(1.25 * count)), 2)
    grid = camera.resized(columns, max(round(count / columns), 2))
    image, depth = render_phantom(PhantomConfig(seed=seed), grid)
    seen = depth > 0
    points, pixel = grid.backproject(depth), depth[..., None] / grid.K[0, 0]  # [H, W, 3] m, [H, W, 1] m
    # Ellipses that reach their neighbours, also where the surface is steep.
    right, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    x = right / np.linalg.norm(right, axis=2, keepdims=True).clip(1e-12)
    z = np.cross(x, down)
    z /= np.linalg.norm(z, axis=2, keepdims=True).clip(1e-12)
    axes = np.stack([x, np.cross(z, x), z], 3)  # [H, W, 3, 3]
    sides = [np.abs((axes[..., i] * side).sum(2, keepdims=True)) for i, side in enumerate((right, down))]
    sizes = np.concatenate([*(side.clip(pixel, _STEEPEST * pixel) for side in sides), 0.3 * pixel], 2)
    quats = np.roll(Rotation.from_matrix(axes[seen]).as_quat(), 1, axis=1)  # wxyz
    colors = (image[seen] / 255 - 0.5) / SH_C0
    tensor = lambda array: torch.from_numpy(array).float()
    opacity = tensor(np.full(seen.sum(), 2.2))  # of 0.9
    return GaussianModel(tensor(points[seen]), tensor(quats), tensor(np.log(0.7 * sizes[seen])), opacity, tensor(colors[:, None])), camera
