"""Densification by relocation and noise."""

import dataclasses

import numpy as np
import pytest
import torch
from short_training import equal, options
from trained import trainer_of

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.config import McmcConfig
from endo_sim_ros.reconstruction.strategies import STRATEGIES
from endo_sim_ros.reconstruction.strategies.mcmc import exploration_noise, relocated
from endo_sim_ros.splatting import render


def cloud(count=300, seed=0):
    """Small Gaussians in front of a camera at the origin."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) * 0.06 + torch.tensor([-0.03, -0.03, 0.1])
    scales = torch.rand(count, generator=generator) * 1e-3 + 5e-4
    model = GaussianModel.from_points(means, torch.rand(count, 3, generator=generator), scales, 0.3)
    opacities = torch.rand(count, generator=generator) * 0.4 + 0.1
    return dataclasses.replace(model, logit_opacities=opacities.logit())


def test_copies_share_opacity_and_size():
    opacities, scales = torch.tensor([0.3, 0.99, 0.5]), torch.ones(3, 3)
    shared, smaller = relocated(opacities, scales, torch.tensor([2, 50, 1]), 50)
    torch.testing.assert_close(1 - (1 - shared) ** torch.tensor([2, 50, 1]), opacities)
    # Two copies by hand: 0.3 / (2 o − o² / √2) with o = 1 − √0.7.
    o = 1 - 0.7**0.5
    assert float(smaller[0, 0]) == pytest.approx(0.3 / (2 * o - o**2 / 2**0.5), rel=1e-6)
    assert float(smaller[2, 0]) == pytest.approx(1)
    assert torch.isfinite(smaller).all()


def test_refinement_preserves_the_picture_moves_the_dead_and_respects_the_limit():
    model = cloud()
    logits = model.logit_opacities.clone()
    logits[::6] = -7  # dead
    model = dataclasses.replace(model, logit_opacities=logits)
    camera = Camera(np.array([[80.0, 0, 40], [0, 80, 40], [0, 0, 1]]), 80, 80)
    before = render(model, camera)
    new, source, fresh = STRATEGIES["mcmc"](McmcConfig(), 310, 0.1).refine(model, {}, torch.Generator().manual_seed(0))
    after = render(new, camera)
    assert len(new) == len(source) == len(fresh) == 310
    assert (new.opacities > McmcConfig().dead_opacity).all()
    assert not (source[:300:6] == torch.arange(0, 300, 6)).any()
    assert fresh[:300:6].all()
    assert fresh[300:].all()
    torch.testing.assert_close(new.means, model.means[source])
    untouched = ~fresh[:300]
    torch.testing.assert_close(new.log_scales[:300][untouched], model.log_scales[untouched])
    assert float((after.colors - before.colors).abs().mean()) < 0.02 * float(before.colors.mean())


def test_refinement_without_any_living_gaussian_changes_nothing():
    model = dataclasses.replace(cloud(20), logit_opacities=torch.full((20,), -9.0))
    new, source, fresh = STRATEGIES["mcmc"](McmcConfig(growth=0.5), 100, 0.1).refine(model, {}, torch.Generator())
    assert equal(new, model)
    assert len(source) == len(fresh) == 20
    assert not fresh.any()


def test_noise_moves_only_the_faint():
    model = cloud(50)
    model.logit_opacities[:25] = -7
    noise = exploration_noise(model, 1.0, 0.005, torch.Generator().manual_seed(0))
    assert noise[:25].abs().min() > 0
    assert noise[25:].abs().max() < 1e-3 * noise[:25].abs().median()


@pytest.mark.slow
def test_optimiser_state_follows_its_gaussians(small):
    trainer = trainer_of([small[0], small[8]], options(refine_every=1000, max_gaussians=1500))
    for _ in range(3):
        trainer.step()
    with torch.no_grad():
        trainer.parameters["logit_opacities"][:7] = -8
    state = lambda: trainer.optimizer.state["means"]
    moments, means = state()["exp_avg"].clone(), trainer.model.means
    trainer.refine()
    kept = (trainer.model.means[: len(means)] == means).all(1) & (state()["exp_avg"][: len(means)] != 0).any(1)
    assert kept.sum() > 0.5 * len(means)
    assert not kept[:7].any()
    torch.testing.assert_close(state()["exp_avg"][: len(means)][kept], moments[kept])
    assert float(state()["step"]) == 3
    trainer.step()


@pytest.mark.slow
def test_as_many_gaussians_as_before_stay_where_captured_steps_find_them(small):
    trainer = trainer_of([small[0], small[8]], options(refine_every=1000, max_gaussians=1500))
    held = lambda: [*trainer.parameters.values(), *(x for state in trainer.optimizer.state.values() for x in state.values())]
    places = lambda: [tensor.data_ptr() for tensor in held()]
    trainer.step()
    while len(trainer.model) < 1500:
        trainer.refine()
    full, means = places(), trainer.model.means.clone()
    with torch.no_grad():
        trainer.parameters["logit_opacities"][:7] = -8
    trainer.refine()
    assert len(trainer.model) == 1500 and places() == full
    assert (trainer.model.means[:7] != means[:7]).any(1).all(), "the dead have moved"
    assert trainer.parameters["logit_opacities"][:7].min() > -8
    assert not trainer.optimizer.state["means"]["exp_avg"][:7].any()
    trainer.step()
