"""The strategy of 3DGS (Kerbl et al. 2023), with its gradients or with those of AbsGS (Ye et al. 2024)."""

import dataclasses
import math

import torch
from torch import Tensor

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.strategies.base import Refined, Strategy


class Gradient(Strategy):
    """Where image gradients are large, large Gaussians are split and small ones doubled; options: `GradientConfig`."""

    wants_absgrad = True

    @property
    def signed(self) -> bool:
        """As the options say."""
        return not self.options.absolute

    @property
    def _first_reset(self) -> int:
        return self.options.reset_first or self.options.reset_every

    def initialize_state(self, count: int, device: torch.device | str) -> dict[str, Tensor]:
        """Of each Gaussian, Σ of its image gradients, and the number of iterations in which it had any."""
        return {"gradients": torch.zeros(2, count, device=device)}

    def step_post_backward(self, state: dict[str, Tensor], steepness: Tensor) -> None:
        """Add up the image gradients."""
        state["gradients"] += torch.stack([steepness, (steepness > 0).to(steepness.dtype)])

    def reset(self, parameters: dict[str, Tensor], states: dict[str, dict[str, Tensor]], iteration: int) -> None:
        """Let opacities fall, every `reset_every` iterations: what a view needs becomes opaque again, the rest can be removed."""
        options, since = self.options, iteration - self._first_reset
        if options.reset_every and since >= 0 and since % options.reset_every == 0:
            parameters["logit_opacities"].clamp_(max=math.log(options.reset_to / (1 - options.reset_to)))
            for moment in ("exp_avg", "exp_avg_sq"):
                states["logit_opacities"][moment].zero_()

    def refine(self, model: GaussianModel, state: dict[str, Tensor], generator: torch.Generator, iteration: int = 0) -> Refined:
        """Remove dead Gaussians; where images ask for more, split the large ones in two and double the small ones.

        Above the limit, the steepest come first.
        """
        options, scales, device = self.options, model.scales, model.means.device
        total, count = state["gradients"]
        gradients = total / count.clamp_min(1)
        alive = model.opacities > options.dead_opacity
        if not alive.any():
            alive[:] = True  # nothing would be left
        hot = (gradients > options.threshold) & alive
        room = max(0, self.limit - int(alive.sum()))
        if int(hot.sum()) > room:
            hot &= gradients > gradients[hot].sort(descending=True).values[room] if room else hot.new_zeros(())
        split = hot & (scales.amax(1) > options.large * self.scene_depth)
        indices = [mask.nonzero()[:, 0] for mask in (alive & ~split, hot & ~split, split, split)]
        source = torch.cat(indices)
        new = model.select(source)
        halves = len(source) - 2 * len(indices[2])
        moved = model.select(source[halves:])
        noise = torch.randn(len(moved), 3, generator=generator).to(device)
        steps = (moved.rotations @ (moved.scales * noise)[..., None])[..., 0]
        means, log_scales = new.means.clone(), new.log_scales.clone()
        means[halves:] += steps
        log_scales[halves:] -= math.log(options.shrink)
        fresh = torch.arange(len(source), device=device) >= len(indices[0])
        new = dataclasses.replace(new, means=means, log_scales=log_scales)
        if options.oversize and options.reset_every and iteration > self._first_reset:
            small = (new.scales.amax(1) <= options.oversize * self.scene_depth).nonzero()[:, 0]
            if len(small):
                return Refined(new.select(small), source[small], fresh[small])
        return Refined(new, source, fresh)
