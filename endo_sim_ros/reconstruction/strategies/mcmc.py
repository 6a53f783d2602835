"""Where Gaussians are needed.

`refine` and `exploration_noise` are a capped Markov chain Monte Carlo strategy (Kheradmand et al. 2024, 3DGS-MCMC): dead
Gaussians move to live ones, and new ones are born there, such that the rendered image stays the same; noise explores.
`split_and_clone` is that of 3DGS (Kerbl et al. 2023) with the gradients of AbsGS, `unpool` that of FSGS (Zhu et al. 2024).
"""

import dataclasses
import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from endo_sim_ros.core.gaussians import GaussianModel

DEAD_OPACITY = 0.005
_MAX_COPIES = 50
_HOT = 8e-4  # mean absolute gradient, per half image, of a Gaussian that is to become two (AbsGS)
_LARGE = 0.01  # standard deviation from which on it is split, in units of the scene's depth
_SHRINK = 1.6  # by which the halves are smaller
_NEIGHBOURS = 3
_FAR = 2.0  # mean distance from the neighbours, in units of the median, from which on FSGS fills the gaps


def relocated(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacities and scales that make ``copies`` coincident Gaussians look like the one they replace (their eq. 9).

    Args:
        opacities: [N] in (0, 1). scales: [N, 3] m. copies: [N] int, at least 1.
    """
    o, n = opacities.double(), copies.clamp(1, _MAX_COPIES).double()
    o = 1 - (1 - o) ** (1 / n)
    # Σ_j C(n, j) (-1)^(j-1) o^j / √j, their double sum over i and k with Σ_i C(i-1, k) = C(n, k+1).
    total, term = torch.zeros_like(o), -torch.ones_like(o)
    for j in range(1, int(n.max()) + 1 if len(n) else 1):
        term = -term * o * (n - j + 1) / j  # C(n, j) is 0 for j > n
        total += term / math.sqrt(j)
    return o.to(opacities), scales * (opacities / total)[:, None].to(scales)


def refine(model: GaussianModel, growth: float, limit: int, generator: torch.Generator) -> tuple[GaussianModel, Tensor, Tensor]:
    """Move dead Gaussians onto live ones and add up to ``growth`` × N new ones, at most ``limit`` in all.

    Returns:
        The new model; ``source`` [N'] int64, the Gaussian that each one was copied from (itself when untouched); and
        ``fresh`` [N'] bool, those whose optimiser state must restart.
    """
    n, device = len(model), model.means.device
    opacities = model.opacities
    dead = (opacities <= DEAD_OPACITY).nonzero()[:, 0]
    alive = (opacities > DEAD_OPACITY).nonzero()[:, 0]
    born = max(0, min(limit, math.ceil(n * (1 + growth))) - n)
    source = torch.arange(n + born, device=device)
    fresh = torch.zeros(n + born, dtype=torch.bool, device=device)
    count = len(dead) + born
    if count and len(alive):
        weights = opacities[alive].double().cpu()
        drawn = alive[torch.multinomial(weights, count, replacement=True, generator=generator).to(device)]
        source[torch.cat([dead, torch.arange(n, n + born, device=device)])] = drawn
        copies = torch.bincount(drawn, minlength=n) + 1
        touched = copies > 1
        opacity, scale = relocated(opacities[touched], model.scales[touched], copies[touched])
        logit, log_scale = model.logit_opacities.clone(), model.log_scales.clone()
        logit[touched] = opacity.clamp(DEAD_OPACITY, 1 - 1e-6).logit()
        log_scale[touched] = scale.log()
        model = GaussianModel(model.means, model.quats, log_scale, logit, model.sh)
        fresh = touched[source]
    elif count:
        source, fresh = source[:n], fresh[:n]  # everything is dead: nothing to copy
    return model.select(source), source, fresh


def exploration_noise(model: GaussianModel, scale: float, generator: torch.Generator) -> Tensor:
    """Random steps [N, 3] (m) along each Gaussian's own shape, only where it is faint (their eq. 8)."""
    faint = torch.sigmoid(-100 * (model.opacities - DEAD_OPACITY))
    noise = torch.randn(len(model), 3, generator=generator, device=generator.device).to(model.means)
    return scale * faint[:, None] * torch.einsum("nij,nj->ni", model.covariances, noise)


def split_and_clone(
    model: GaussianModel, gradients: Tensor, scene_depth: float, limit: int, generator: torch.Generator
) -> tuple[GaussianModel, Tensor, Tensor]:
    """Remove dead Gaussians; where images ask for more, split the large ones in two and double the small ones.

    Args:
        gradients: Mean over the views of Σ_pixels |∂L/∂mean2d| [N], image coordinates in units of half the image.
        scene_depth: Unit of the size that counts as large, metres.
        limit: Largest number of Gaussians; the steepest come first.

    Returns:
        As `refine`.
    """
    scales, device = model.scales, model.means.device
    alive = model.opacities > DEAD_OPACITY
    if not alive.any():
        alive[:] = True  # nothing would be left
    hot = (gradients > _HOT) & alive
    room = max(0, limit - int(alive.sum()))
    if int(hot.sum()) > room:
        hot &= gradients > gradients[hot].sort(descending=True).values[room] if room else hot.new_zeros(())
    split = hot & (scales.amax(1) > _LARGE * scene_depth)
    indices = [mask.nonzero()[:, 0] for mask in (alive & ~split, hot & ~split, split, split)]
    source = torch.cat(indices)
    new = model.select(source)
    halves = len(source) - 2 * len(indices[2])
    moved = new.select(slice(halves, None))
    noise = torch.randn(len(moved), 3, generator=generator).to(device)
    steps = (moved.rotations @ (moved.scales * noise)[..., None])[..., 0]
    means, log_scales = new.means.clone(), new.log_scales.clone()
    means[halves:] += steps
    log_scales[halves:] -= math.log(_SHRINK)
    fresh = torch.arange(len(source), device=device) >= len(indices[0])
    return dataclasses.replace(new, means=means, log_scales=log_scales), source, fresh


def unpool(model: GaussianModel, limit: int) -> tuple[GaussianModel, Tensor, Tensor]:
    """Add Gaussians halfway to the neighbours of those that lie alone (FSGS, proximity-guided unpooling).

    Returns:
        As `refine`.
    """
    count, device = len(model), model.means.device
    source = torch.arange(count, device=device)
    room = limit - count
    if count <= _NEIGHBOURS or room <= 0:
        return model, source, torch.zeros(count, dtype=torch.bool, device=device)
    positions = model.means.detach().cpu().numpy()
    distance, neighbours = cKDTree(positions).query(positions, k=_NEIGHBOURS + 1)
    proximity = distance[:, 1:].mean(1)
    lonely = np.nonzero(proximity > _FAR * np.median(proximity))[0]
    lonely = lonely[np.argsort(-proximity[lonely], kind="stable")][: max(room // _NEIGHBOURS, 1)]
    ends = torch.from_numpy(np.repeat(lonely, _NEIGHBOURS)).to(device)[:room]
    others = torch.from_numpy(neighbours[lonely, 1:].reshape(-1)).to(device)[:room]
    source = torch.cat([source, others])
    new = model.select(source)
    means = new.means.clone()
    means[count:] = (model.means[ends] + model.means[others]) / 2
    return dataclasses.replace(new, means=means), source, torch.arange(len(source), device=device) >= count
