"""Loss terms of the reconstruction: each is a function here, a line in TERMS, and a weight in `ReconstructionConfig`.

Images are [H, W, 3] in [0, 1], depths [H, W] in metres, masks [H, W] in {0, 1}. On a GPU an iteration is a graph capture, so a term
must not wait for the GPU, as `.item()` does.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.ssim import ssim


class Rendering(NamedTuple):
    """What terms are computed from: one image of the Gaussians, and its depth prior. Colours are for `photometric` alone."""

    model: GaussianModel
    depth: Tensor  # [H, W] Σ w z, metres
    alpha: Tensor  # [H, W]
    distortion: Tensor  # [H, W] metres
    mask: Tensor | None  # [H, W] 1 = tissue; None = all of it
    prior: Tensor | None  # [H, W] depth prior, metres, 0 = none
    scene_depth: float  # metres
    seen: Tensor | float = 1.0  # [N] 1 = some training view shows where the Gaussian is; what none shows, no photometric loss holds


class Term(NamedTuple):
    """A term of the loss."""

    weight: str  # option that weighs it; without a weight nothing is computed
    weighted: Callable[[Rendering, ReconstructionConfig], Tensor]  # a scalar
    of_virtual: bool = False  # whether virtual cameras have it, too
    needs_prior: bool = False


def active_terms(config: ReconstructionConfig) -> tuple[Term, ...]:
    """The terms that have a weight."""
    return tuple(term for term in TERMS if getattr(config, term.weight) > 0)


def regularized(loss: Tensor, terms: Sequence[Term], rendering: Rendering, config: ReconstructionConfig, virtual: bool = False) -> Tensor:
    """The loss so far, plus the terms of an image of a training or a virtual camera."""
    for term in terms:
        if (virtual and not term.of_virtual) or (term.needs_prior and rendering.prior is None):
            continue
        value = term.weighted(rendering, config)
        if virtual:
            value = config.virtual_weight * value
        loss = loss + value
    return loss


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of a map [H, W] or [H, W, C] over the pixels of a mask [H, W] (all without one); 0 for an empty mask."""
    if mask is None:
        return values.mean()
    if values.shape[:2] != mask.shape:
        raise ValueError(f"masked_mean: values {tuple(values.shape)} do not fit the mask {tuple(mask.shape)}")
    channels = values[0, 0].numel()
    weights = mask if values.ndim == 2 else mask[..., None]
    return (values * weights).sum() / (mask.sum() * channels).clamp_min(1)


def photometric(image: Tensor, target: Tensor, mask: Tensor | None, lambda_ssim: float, white: float = math.inf) -> Tensor:
    """(1 − λ)·L1 + λ·(1 − SSIM), the loss of vanilla 3DGS. Masked pixels, equal in both, add nothing.

    A channel of the target that is at least ``white`` is overexposed: a brighter image is equal to it.
    """
    if image.shape != target.shape:
        raise ValueError(f"photometric: image shape {tuple(image.shape)} != target shape {tuple(target.shape)}")
    if white <= 1:
        image = torch.where(target < white, image, image.minimum(target))
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
    # What is fainter than the thousandth part has no depth of its own.
    return masked_mean((depth / alpha.clamp_min(1e-3) - prior).abs() + opaque * (1 - alpha) * prior, valid)


def total_variation(depth: Tensor, mask: Tensor | None) -> Tensor:
    """Mean absolute difference of neighbour depths, metres (in paper eq. 6); pairs across a mask's edge do not count."""
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


TERMS = (
    Term(
        "lambda_depth",
        lambda of, c: c.lambda_depth / of.scene_depth * depth_l1(of.depth, of.prior, of.mask, of.alpha, c.lambda_opaque),
        needs_prior=True,
    ),
    Term("lambda_pearson", lambda of, c: c.lambda_pearson * pearson(of.depth, of.prior, of.mask), of_virtual=True, needs_prior=True),
    Term("lambda_dist", lambda of, c: c.lambda_dist * masked_mean(of.distortion, of.mask) / of.scene_depth, of_virtual=True),
    Term("lambda_tv", lambda of, c: c.lambda_tv * total_variation(of.depth, of.mask) / of.scene_depth, of_virtual=True),
    Term("lambda_opacity", lambda of, c: c.lambda_opacity * (of.seen * of.model.opacities).mean()),
    Term("lambda_scale", lambda of, c: c.lambda_scale / of.scene_depth * (of.seen * of.model.scales.mean(1)).mean()),
)
"""What the photometric loss of a training view is added to, in this order."""
