"""What the trainer asks of a densification strategy."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from endo_sim_ros.core.gaussians import GaussianModel


class Refined(NamedTuple):
    """Gaussians after a refinement."""

    model: GaussianModel  # N' of them
    source: Tensor  # [N'] int64, the Gaussian that each one was copied from; itself when untouched
    fresh: Tensor  # [N'] bool, those whose optimiser state must restart


class Strategy:
    """How Gaussians are added, moved and removed while they are trained. This one does none of it.

    Args:
        options: Options of the strategy, as `ReconstructionConfig` nests them under its name.
        limit: Largest number of Gaussians.
        scene_depth: Unit of sizes, metres: the median depth of the scene, or what `ReconstructionConfig.unit` says.
    """

    wants_absgrad = False
    """Whether `step_post_backward` is to get the gradients of image positions, which costs time."""
    signed = False
    """Whether those of pixels are added up with their signs."""

    def __init__(self, options: Any, limit: int, scene_depth: float) -> None:
        self.options, self.limit, self.scene_depth = options, limit, scene_depth

    def initialize_state(self, count: int, device: torch.device | str) -> dict[str, Tensor]:
        """Statistics of so many Gaussians [..., count], finite float32, begun anew after each refinement; checkpoints hold them."""
        return {}

    def step_post_backward(self, state: dict[str, Tensor], steepness: Tensor) -> None:
        """Take note of an iteration, in place and without waiting for a GPU.

        Args:
            state: Statistics.
            steepness: Σ_pixels |∂L/∂mean2d| [N] of the training view, or |Σ_pixels ∂L/∂mean2d| where `signed`; image coordinates in
                units of half the image.
        """

    def refine(self, model: GaussianModel, state: dict[str, Tensor], generator: torch.Generator, iteration: int = 0) -> Refined:
        """Add, move and remove Gaussians, every `refine_every` iterations; ``iteration`` is the number of steps so far."""
        everything = torch.arange(len(model), device=model.means.device)
        return Refined(model, everything, torch.zeros_like(everything, dtype=torch.bool))

    def reset(self, parameters: dict[str, Tensor], states: dict[str, dict[str, Tensor]], iteration: int) -> None:
        """Change the Gaussians and the optimiser's state of them in place, after a step in the time of refinements."""

    def perturb(self, parameters: dict[str, Tensor], iteration: int, step_size: float, generator: torch.Generator) -> None:
        """Change the Gaussians in place, after every step of the optimiser.

        Args:
            parameters: The tensors that are trained, see `model_of`; no gradients are recorded.
            iteration: Number of steps so far.
            step_size: Learning rate of the means, metres.
            generator: Random numbers, on the device of the model.
        """
