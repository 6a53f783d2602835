"""Densification by splitting, cloning and unpooling; what no view shows."""

import numpy as np
import pytest
import torch
from trained import trainer_of

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction import ReconstructionConfig
from endo_sim_ros.reconstruction.config import GradientConfig, ProximityConfig
from endo_sim_ros.reconstruction.strategies import STRATEGIES


def cloud(count: int = 60) -> GaussianModel:
    g = torch.Generator().manual_seed(0)
    return GaussianModel.from_points(torch.rand(count, 3, generator=g), torch.rand(count, 3, generator=g), torch.full((count,), 0.004))


def split_and_clone(model, gradients, limit):
    """What the strategy of 3DGS makes of Gaussians with such mean gradients."""
    state = {"gradients": torch.stack([gradients, torch.ones_like(gradients)])}
    return STRATEGIES["gradient"](GradientConfig(), limit, 1.0).refine(model, state, torch.Generator().manual_seed(0))


def test_opacities_fall_with_their_moments_and_what_is_too_large_goes_after_that():
    model, options = cloud(), GradientConfig(reset_every=100, oversize=0.04)
    strategy = STRATEGIES["gradient"](options, 1000, 1.0)
    parameters = {"logit_opacities": torch.tensor([3.0, -6.0])}
    states = {"logit_opacities": {"exp_avg": torch.ones(2), "exp_avg_sq": torch.ones(2), "step": torch.tensor(7.0)}}
    strategy.reset(parameters, states, 150)
    assert parameters["logit_opacities"].tolist() == [3.0, -6.0]
    strategy.reset(parameters, states, 200)
    torch.testing.assert_close(parameters["logit_opacities"].sigmoid(), torch.tensor([0.01, 0.00247]), rtol=1e-2, atol=0)
    assert not states["logit_opacities"]["exp_avg"].any() and float(states["logit_opacities"]["step"]) == 7
    model.log_scales[10:15] = np.log(0.05)
    gradients = torch.zeros(60)
    gradients[10] = 1.0  # its halves are small enough
    state = {"gradients": torch.stack([gradients, torch.ones(60)])}
    sizes = [len(strategy.refine(model, state, torch.Generator().manual_seed(0), iteration).model) for iteration in (100, 101)]
    assert sizes == [61, 57]


def test_unpooling_ends():
    strategy = STRATEGIES["proximity"](ProximityConfig(unpool_until=2000), 1000, 1.0)
    model = cloud()
    model.means[0] = torch.tensor([3.0, 3.0, 3.0])
    state = {"gradients": torch.zeros(2, 60)}
    sizes = [len(strategy.refine(model, state, torch.Generator().manual_seed(0), iteration).model) for iteration in (1900, 2000)]
    assert sizes[0] > 60 and sizes[1] == 60


def unpool(model, limit):
    return STRATEGIES["proximity"](ProximityConfig(), limit, 1.0).unpool(model)


def test_steep_gaussians_are_split_or_doubled_and_dead_ones_go():
    model = cloud()
    model.logit_opacities[:5] = -9
    model.log_scales[10:15] = np.log(0.05)  # large
    gradients = torch.zeros(60)
    gradients[10:20] = 1.0
    new, source, fresh = split_and_clone(model, gradients, 1000)
    assert len(new) == 60 - 5 + 5 + 5 == len(source) == len(fresh)
    assert not set(range(5)) & set(source.tolist())
    assert sorted(source[fresh].tolist()) == sorted([*range(15, 20), *range(10, 15), *range(10, 15)])
    halves = fresh & (source < 15)
    torch.testing.assert_close(new.log_scales[halves], torch.full((10, 3), np.log(0.05 / 1.6), dtype=torch.float32))
    assert (new.means[halves] != model.means[source[halves]]).any(1).all()
    limited, _, _ = split_and_clone(model, gradients * torch.linspace(1, 2, 60), 58)
    assert len(limited) == 58


@pytest.mark.thorough
@pytest.mark.slow
def test_exposures_and_colours_do_not_drift_against_each_other(views):
    trainer = trainer_of(views, ReconstructionConfig(iterations=40, max_gaussians=2000, depth="topic", extrapolation=0.0, device="cpu"))
    before = trainer.appearance.tensors["exposures"].detach().clone()
    trainer.run()
    after = trainer.appearance.tensors["exposures"].detach()
    assert (after - before).abs().max() > 1e-5
    np.testing.assert_allclose(after.mean(0), before.mean(0), atol=1e-6)


def test_unpooling_fills_gaps_halfway_to_the_neighbours():
    model = cloud()
    model.means[0] = torch.tensor([3.0, 3.0, 3.0])
    new, source, fresh = unpool(model, 1000)
    assert len(new) > 60 and (~fresh).sum() == 60
    added = new.means[fresh]
    assert (added > 1.2).all(1).sum() == 3  # on the way to the lone one
    assert len(unpool(model, 61)[0]) == 61
    assert len(unpool(model, 60)[0]) == 60
