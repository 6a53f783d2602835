"""Where Gaussians are needed: a capped Markov chain Monte Carlo strategy (Kheradmand et al. 2024, 3DGS-MCMC).

Dead Gaussians move to live ones, and new ones are born there, such that the rendered image stays the same; noise
explores.
"""

import math

import torch
from torch import Tensor

from endo_sim_ros.gaussians import GaussianModel

DEAD_OPACITY = 0.005
_MAX_COPIES = 50


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


def refine(
    model: GaussianModel, growth: float, limit: int, generator: torch.Generator
) -> tuple[GaussianModel, Tensor, Tensor]:
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
    noise = torch.randn(len(model), 3, generator=generator).to(model.means)
    return scale * faint[:, None] * torch.einsum("nij,nj->ni", model.covariances, noise)
