"""Loss terms of the reconstruction. Each returns an unreduced map or a scalar; the trainer weighs them.

Images are [H, W, 3] in [0, 1], depths [H, W] in metres, masks [H, W] in {0, 1}.
"""

import math

import torch
from torch import Tensor

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.ssim import ssim

_FAINT = 1e-3  # alpha, below which a pixel has no depth of its own


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of a map [H, W] or [H, W, C] over the pixels of a mask [H, W] (all without one); 0 for an empty mask."""
    if mask is None:
        return values.mean()
    if values.shape[:2] != mask.shape:
        raise ValueError(f"masked_mean: values {tuple(values.shape)} do not fit the mask {tuple(mask.shape)}")
    channels = values[0, 0].numel()
    weights = mask if values.ndim == 2 else mask[..., None]
    return (values * weights).sum() / (mask.sum() * channels).clamp_min(1)


def photometric(image: Tensor, target: Tensor, mask: Tensor | None, lambda_ssim: float) -> Tensor:
    """(1 − λ)·L1 + λ·(1 − SSIM), the loss of vanilla 3DGS. Masked pixels, equal in both, add nothing."""
    if image.shape != target.shape:
        raise ValueError(f"photometric: image shape {tuple(image.shape)} != target shape {tuple(target.shape)}")
    if mask is not None:
        image, target = image * mask[..., None], target * mask[..., None]
    l1 = masked_mean((image - target).abs(), mask)
    if lambda_ssim == 0:
        return l1
    return (1 - lambda_ssim) * l1 + lambda_ssim * masked_mean(1 - ssim(image, target), mask)


def depth_l1(depth: Tensor, prior: Tensor, mask: Tensor | None, alpha: Tensor, opaque: float) -> Tensor:
    """|D − D̂| where the prior has a measurement (> 0), metres.

    Paper eq. 4 has the composited depth Σ w z for D̂, in which transparent tissue counts as near and trained tissue lies the deeper.
    With ``opaque`` above zero D̂ is the mean depth of what is seen, Σ w z / alpha, and transparency, (1 − alpha)·D, has that weight.
    """
    valid = (prior > 0).to(depth.dtype)
    valid = valid if mask is None else valid * mask
    if not opaque:
        return masked_mean((depth - prior).abs(), valid)
    return masked_mean((depth / alpha.clamp_min(_FAINT) - prior).abs() + opaque * (1 - alpha) * prior, valid)


def total_variation(depth: Tensor, mask: Tensor | None) -> Tensor:
    """Mean absolute difference of neighbour depths, metres (paper eq. 6); pairs across a mask's edge do not count."""
    dx, dy = (depth[:, 1:] - depth[:, :-1]).abs(), (depth[1:] - depth[:-1]).abs()
    if mask is None:
        return dx.mean() + dy.mean()
    return masked_mean(dx, mask[:, 1:] * mask[:, :-1]) + masked_mean(dy, mask[1:] * mask[:-1])


def pearson(depth: Tensor, prior: Tensor, mask: Tensor | None) -> Tensor:
    """1 − correlation of depth and prior where the prior has a measurement (> 0) (FSGS, eq. 6)."""
    valid = (prior > 0).to(depth.dtype)
    valid = valid if mask is None else valid * mask
    centre = lambda x: (x - masked_mean(x, valid)) * valid
    a, b = centre(depth), centre(prior)
    return 1 - (a * b).sum() / ((a * a).sum() * (b * b).sum()).clamp_min(1e-20).sqrt()


def depth_extent(model: GaussianModel, eye: Tensor) -> Tensor:
    """How far each Gaussian is deeper than 1.5 times its width seen from a point ``eye`` [3] (m, world), log ratio [N].

    Depth along the line of sight cannot be seen in the training views, but it becomes a streak across the picture as soon
    as the tissue is sheared. (PhysGaussian's anisotropy regulariser, Xie et al. 2024, serves the same end but also
    forbids the discs that a surface is best made of.)
    """
    line = torch.nn.functional.normalize(model.means.detach() - eye, dim=1)
    w, v = model.quats[:, :1], -model.quats[:, 1:]  # the inverse rotation takes the line of sight to the Gaussian's axes
    cross = torch.linalg.cross(v, line)
    local = line + 2 / (w * w + (v * v).sum(1, keepdim=True)).clamp_min(1e-12) * (w * cross + torch.linalg.cross(v, cross))
    variances = (2 * model.log_scales).exp()
    deep = (local * local * variances).sum(1)
    wide = (variances.sum(1) - deep) / 2
    return torch.relu(0.5 * (deep / wide.clamp_min(1e-20)).log() - math.log(1.5))


def seen_at(points: Tensor, viewmat: Tensor, K: Tensor, mask: Tensor | None, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Where a view sees points [N, 3] (m, world): index of the pixel [N], whether it lies in the picture's mask [N], and depth [N].

    Args:
        points: Positions.
        viewmat, K: World-to-camera [4, 4] and intrinsics [3, 3].
        mask: [H, W] 1 = tissue; None = all of it.
        size: H and W.
    """
    height, width = size
    # Without a matrix product: libraries give other last bits with other numbers of threads.
    x, y, z = (sum(row[i] * points[:, i] for i in range(3)) + row[3] for row in viewmat[:3])
    ahead = z.clamp_min(1e-6)
    u, v = (x / ahead * K[0, 0] + K[0, 2]).floor(), (y / ahead * K[1, 1] + K[1, 2]).floor()
    inside = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = (v.clamp(0, height - 1) * width + u.clamp(0, width - 1)).long()
    return index, inside if mask is None else inside & (mask.flatten()[index] > 0), z
