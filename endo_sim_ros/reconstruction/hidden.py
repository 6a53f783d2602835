"""Colours that Gaussians have once they are bared.

Next to nothing of the loss depends on a Gaussian that others hide, but Adam moves it as far as any other. It takes on a colour that mends
a little of what is in front of it, grey or green, on which pictures of tissue at rest rest. Such colours show as patches once tissue is
pulled and its slopes are seen from elsewhere; the colour that views see in front of it does not.
"""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.splatting import rasterize

_BLUR = 0.3  # pixel², as the rasteriser adds to the variances of a splat
_LEAST = 0.05  # opacity of a picture where its colour tells anything

View = tuple[GaussianModel, Tensor, Tensor, Tensor, tuple[int, int]]
"""The model as a view has it, which of its Gaussians [N] the view shows, hidden or not, its viewmat [4, 4], its intrinsics [3, 3], pixels,
and width and height."""


def bared_shifts(sh: Tensor, views: Iterable[View], least: float) -> Tensor:
    """Return what is added to the base coefficients of Gaussians as they are bared [N, 3], `GaussianModel.bared`.

    A Gaussian is seen by the part of its footprints' opacity that arrives in pictures: Σ w over Σ α. The colour in front of it is the mean
    of those in the pictures, weighted by w.

    Args:
        sh: Spherical harmonics [N, K, 3] of the colours.
        views: Where from it is looked at.
        least: Gaussians that are seen by less take on as much of the colour as is missing; those that no picture shows stay.
    """
    count = len(sh)
    arriving, whole, seen = sh.new_zeros(count), sh.new_zeros(count), sh.new_zeros(count, 3)
    for model, there, viewmat, K, size in views:
        tensors = model.means, model.quats, model.scales, model.opacities
        matrices = viewmat[None], K[None], *size
        picture = rasterize(*tensors, sh, *matrices)
        colors = picture.colors[0] / picture.alphas[0].clamp_min(_LEAST)[..., None]
        with torch.enable_grad():
            flat = sh.new_zeros(count, 1, 3).requires_grad_()  # the gradient of a picture by colours is w whatever these are
            gray = rasterize(*tensors, flat, *matrices).colors[0]
            (weights,) = torch.autograd.grad(gray[..., 0].sum(), flat, retain_graph=True)
            (sums,) = torch.autograd.grad((gray * colors).sum(), flat)
        arriving += there * weights[:, 0, 0] / SH_C0
        seen += there[:, None] * sums[:, 0] / SH_C0
        # Those beside and behind the lens have footprints without end.
        whole += torch.where(there, model.opacities * _footprints(model, viewmat, K), 0)
    missing = torch.where(arriving > 0, 1 - (arriving / (least * whole).clamp_min(1e-9)).clamp_max(1), 0)[:, None]
    return missing * ((seen / arriving.clamp_min(1e-9)[:, None] - 0.5) / SH_C0 - sh[:, 0])


def _footprints(model: GaussianModel, viewmat: Tensor, K: Tensor) -> Tensor:
    """∫ of what each splat is of its height [N], pixel² (Kerbl et al. 2023, eq. 5)."""
    R = viewmat[:3, :3]
    x, y, z = (model.means @ R.T + viewmat[:3, 3]).unbind(1)
    zero, z = torch.zeros_like(z), z.clamp_min(1e-6)
    rows = torch.stack([K[0, 0] / z, zero, -K[0, 0] * x / z**2, zero, K[1, 1] / z, -K[1, 1] * y / z**2], 1).view(-1, 2, 3)
    axes = rows @ R @ model.rotations * model.scales[:, None]
    plane = axes @ axes.transpose(1, 2) + _BLUR * torch.eye(2, device=z.device)
    return 2 * math.pi * torch.linalg.det(plane).clamp_min(0).sqrt()
