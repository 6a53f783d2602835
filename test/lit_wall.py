"""A wall of Gaussians and a lamp at the camera."""

import numpy as np
import torch

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import Light

CAMERA = Camera(np.array([[200.0, 0, 80], [0, 200.0, 64], [0, 0, 1]]), 160, 128)
LAMP = Light(distance=1.2, angle=8.0, tilt_x=0.4, tilt_y=-0.3, reference=0.1, level_r=0.1, level_g=0.2, level_b=0.3, response=0.5)


def wall(count: int = 12_000) -> GaussianModel:
    """A flat wall of random colours at 0.1 m, dense enough to be opaque."""
    g = torch.Generator().manual_seed(0)
    xy = (torch.rand(count, 2, generator=g) - 0.5) * torch.tensor([0.16, 0.14])
    points = torch.cat([xy, torch.full((count, 1), 0.1)], 1)
    return GaussianModel.from_points(points, 0.2 + 0.3 * torch.rand(count, 3, generator=g), torch.full((count,), 2e-3), 0.95)
