"""The strategy of FSGS (Zhu et al. 2024): that of 3DGS, and proximity-guided unpooling."""

import dataclasses

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (it is public)
from torch import Tensor

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.strategies.base import Refined
from endo_sim_ros.reconstruction.strategies.gradient import Gradient


class Proximity(Gradient):
    """New Gaussians also fill the gaps around those that lie alone; options: `ProximityConfig`."""

    def refine(self, model: GaussianModel, state: dict[str, Tensor], generator: torch.Generator, iteration: int = 0) -> Refined:
        """Refine as `Gradient` does, then `unpool`."""
        refined = super().refine(model, state, generator, iteration)
        if self.options.unpool_until and iteration >= self.options.unpool_until:
            return refined
        model, others, added = self.unpool(refined.model)
        return Refined(model, refined.source[others], refined.fresh[others] | added)

    def unpool(self, model: GaussianModel) -> Refined:
        """Add Gaussians halfway to the neighbours of those that lie alone."""
        count, device, near = len(model), model.means.device, self.options.neighbours
        source = torch.arange(count, device=device)
        room = self.limit - count
        if count <= near or room <= 0:
            return Refined(model, source, torch.zeros(count, dtype=torch.bool, device=device))
        positions = model.means.detach().cpu().numpy()
        distance, neighbours = cKDTree(positions).query(positions, k=near + 1)
        proximity = distance[:, 1:].mean(1)
        lonely = np.nonzero(proximity > self.options.far * np.median(proximity))[0]
        lonely = lonely[np.argsort(-proximity[lonely], kind="stable")][: max(room // near, 1)]
        ends = torch.from_numpy(np.repeat(lonely, near)).to(device)[:room]
        others = torch.from_numpy(neighbours[lonely, 1:].reshape(-1)).to(device)[:room]
        source = torch.cat([source, others])
        new = model.select(source)
        means = new.means.clone()
        means[count:] = (model.means[ends] + model.means[others]) / 2
        return Refined(dataclasses.replace(new, means=means), source, torch.arange(len(source), device=device) >= count)
