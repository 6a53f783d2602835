"""A capped Markov chain Monte Carlo strategy (Kheradmand et al. 2024, 3DGS-MCMC): dead Gaussians move to live ones, and new ones are
born there, such that the rendered image stays the same; noise explores."""

import dataclasses
import math

import torch
from torch import Tensor

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.optimizer import model_of
from endo_sim_ros.reconstruction.strategies.base import Refined, Strategy


class Mcmc(Strategy):
    """Gaussians are samples of where the scene is; options: `McmcConfig`."""

    def refine(self, model: GaussianModel, state: dict[str, Tensor], generator: torch.Generator, iteration: int = 0) -> Refined:
        """Move dead Gaussians onto live ones and add a share of new ones, up to the limit."""
        n, device, least = len(model), model.means.device, self.options.dead_opacity
        opacities = model.opacities
        dead = (opacities <= least).nonzero()[:, 0]
        alive = (opacities > least).nonzero()[:, 0]
        born = max(0, min(self.limit, math.ceil(n * (1 + self.options.growth))) - n)
        source = torch.arange(n + born, device=device)
        fresh = torch.zeros(n + born, dtype=torch.bool, device=device)
        count = len(dead) + born
        if count and len(alive):
            weights = opacities[alive].double().cpu()
            drawn = alive[torch.multinomial(weights, count, replacement=True, generator=generator).to(device)]
            source[torch.cat([dead, torch.arange(n, n + born, device=device)])] = drawn
            copies = torch.bincount(drawn, minlength=n) + 1
            touched = copies > 1
            opacity, scale = relocated(opacities[touched], model.scales[touched], copies[touched], self.options.most_copies)
            logit, log_scale = model.logit_opacities.clone(), model.log_scales.clone()
            logit[touched] = opacity.clamp(least, 1 - 1e-6).logit()
            log_scale[touched] = scale.log()
            model = dataclasses.replace(model, log_scales=log_scale, logit_opacities=logit)
            fresh = touched[source]
        elif count:
            source, fresh = source[:n], fresh[:n]  # everything is dead: nothing to copy
        return Refined(model.select(source), source, fresh)

    def perturb(self, parameters: dict[str, Tensor], iteration: int, step_size: float, generator: torch.Generator) -> None:
        """Move faint Gaussians about at random, along their own shapes (their eq. 8)."""
        options, faint = self.options, slice(None)
        if iteration % options.noise_every:
            return
        model, means = model_of(parameters), parameters["means"]
        if means.device.type == "cpu":  # a GPU is sooner done with all than it has told how many they are
            faint = (model.opacities < 10 * options.dead_opacity).nonzero()[:, 0]
            if not len(faint):
                return
            model = model.select(faint)
        # Variances are in m²: divided by the squared depth of the scene, steps are those of a scene of depth 1.
        scale = options.noise_every**0.5 * options.noise * step_size / self.scene_depth**2
        means[faint] += exploration_noise(model, scale, options.dead_opacity, generator)


def relocated(opacities: Tensor, scales: Tensor, copies: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Opacities and scales that make ``copies`` coincident Gaussians look like the one they replace (their eq. 9).

    Args:
        opacities: [N] in (0, 1). scales: [N, 3] m. copies: [N] int, at least 1. most: Number of copies above which more count as so many.
    """
    o, n = opacities.double(), copies.clamp(1, most).double()
    o = 1 - (1 - o) ** (1 / n)
    # Σ_j C(n, j) (-1)^(j-1) o^j / √j, their double sum over i and k with Σ_i C(i-1, k) = C(n, k+1).
    total, term = torch.zeros_like(o), -torch.ones_like(o)
    for j in range(1, int(n.max()) + 1 if len(n) else 1):
        term = -term * o * (n - j + 1) / j  # C(n, j) is 0 for j > n
        total += term / math.sqrt(j)
    return o.to(opacities), scales * (opacities / total)[:, None].to(scales)


def exploration_noise(model: GaussianModel, scale: float, dead_opacity: float, generator: torch.Generator) -> Tensor:
    """Random steps [N, 3] (m) along each Gaussian's own shape, only where it is faint."""
    faint = torch.sigmoid(-100 * (model.opacities - dead_opacity))
    noise = torch.randn(len(model), 3, generator=generator, device=generator.device).to(model.means)
    return scale * faint[:, None] * torch.einsum("nij,nj->ni", model.covariances, noise)
