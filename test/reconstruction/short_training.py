"""Short trainings on the phantom."""

import dataclasses

import torch

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction import ReconstructionConfig
from endo_sim_ros.reconstruction.stage_configs import InterpolationConfig
from endo_sim_ros.reconstruction.triangulation import ScenePoints
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

NO_POINTS = ScenePoints.none()


def film(width, height, count):
    return tuple(phantom_sequence(PhantomConfig(width=width, height=height, frames=count)))


def bare(frame, **changes):
    """The frame without any depth."""
    nothing = {"depth": None, "right": None, "baseline": None, "right_K": None}
    return dataclasses.replace(frame, **(nothing | changes))


def equal(first: GaussianModel, second: GaussianModel) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first.tensors().values(), second.tensors().values()))


# From so few neighbours depth is continued beyond the pictures in a fifth of the time, which else takes longer than these trainings.
SHORT = {"iterations": 12, "max_gaussians": 2000, "refine_every": 5, "device": "cpu", "interpolation": InterpolationConfig(neighbours=4)}


def options(**changes):
    return ReconstructionConfig(**(SHORT | changes))


def options_of_depth(**changes):
    """Options with which depth is continued as it is by default."""
    return options(interpolation=InterpolationConfig(), **changes)


def finite(model: GaussianModel) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in model.tensors().values())
