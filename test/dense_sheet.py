"""A curved sheet of many Gaussians, for a GPU."""

import torch

from endo_sim_ros.core.gaussians import GaussianModel


def sheet(count: int = 20_000) -> GaussianModel:
    """A curved sheet of random Gaussians 12 cm in front of the camera."""
    g = torch.Generator().manual_seed(0)
    xy = torch.rand(count, 2, generator=g) * torch.tensor([0.14, 0.11]) - torch.tensor([0.07, 0.055])
    points = torch.cat([xy, 0.12 + 0.5 * (xy**2).sum(1, keepdim=True)], 1)
    model = GaussianModel.from_points(points, torch.rand(count, 3, generator=g), torch.full((count,), 8e-4))
    quats = torch.randn(count, 4, generator=g)
    scales = model.log_scales + 0.5 * torch.randn(count, 3, generator=g)
    return GaussianModel(points, quats, scales, torch.randn(count, generator=g), model.sh)
