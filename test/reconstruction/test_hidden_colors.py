"""Colours that Gaussians which others hide have once they are bared."""

import dataclasses

import numpy as np
import pytest
import torch
from short_training import options
from trained import trainer_of

from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.reconstruction.hidden import bared_shifts

K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 100.0, 32.0], [0.0, 0.0, 1.0]])
RED, GREEN = (0.8, 0.2, 0.2), (0.1, 0.9, 0.3)


def wall(opacity: float) -> tuple[GaussianModel, int]:
    """A red wall 0.1 m ahead, and behind it, last, a green blob; returns the number of the one in front of that, too."""
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 25), np.linspace(-0.03, 0.03, 25))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.1)], 1)
    points = torch.from_numpy(np.vstack([points, [[0.0, 0.0, 0.104]]])).float()
    colors = torch.tensor([RED] * x.size + [GREEN])
    scales = torch.full((len(points),), 0.0015)
    return GaussianModel.from_points(points, colors, scales, opacity), x.size // 2


def looked_at(model: GaussianModel, there: bool = True):
    return model, torch.full((len(model),), there), torch.eye(4), K, (64, 64)


def bared(model: GaussianModel, least: float, *views) -> torch.Tensor:
    """Colours [N, 3] that Gaussians have once they are bared."""
    return (model.sh[:, 0] + bared_shifts(model.sh, views or [looked_at(model)], least)) * SH_C0 + 0.5


def test_what_is_hidden_takes_on_the_colour_in_front_of_it_and_what_is_seen_keeps_its_own():
    model, front = wall(0.9)
    found = bared(model, 0.5)
    np.testing.assert_allclose(found[-1], RED, atol=0.1)  # a little of it is seen itself
    np.testing.assert_allclose(found[:-1], model.base_colors[:-1], atol=0.01)
    aside = model.select(torch.tensor([front, len(model) - 1]))
    aside.means[1, 0] = 0.02  # nothing is in front of it
    np.testing.assert_array_equal(bared_shifts(aside.sh, [looked_at(aside)], 0.5), torch.zeros(2, 3))


def test_a_gaussian_that_one_of_two_views_shows_keeps_its_colour_and_one_that_none_shows_as_well():
    model, _ = wall(0.9)
    one = looked_at(model)
    clear = dataclasses.replace(model, logit_opacities=torch.cat([torch.full((len(model) - 1,), -9.0), model.logit_opacities[-1:]]))
    other = looked_at(clear)  # which the second view looks through
    np.testing.assert_allclose(bared(model, 0.3, one, other)[-1], GREEN, atol=0.02)
    np.testing.assert_array_equal(bared_shifts(model.sh, [looked_at(model, False)], 0.3), torch.zeros(len(model), 3))


def test_a_view_behind_whose_lens_a_gaussian_lies_does_not_count_for_it():
    model, _ = wall(0.9)
    model.means[0] = torch.tensor([0.5, 0.3, -1.0])
    model.log_scales[0] = -3.0
    back = torch.eye(4)
    back[2, 3] = 3.0  # a view from farther back shows it, too
    others = torch.arange(len(model)) > 0
    found = bared(model, 0.5, (model, others | True, back, K, (64, 64)), (model, others, torch.eye(4), K, (64, 64)))
    np.testing.assert_allclose(found[0], RED, atol=1e-4)
    np.testing.assert_allclose(found[-1], RED, atol=0.1)


@pytest.mark.parametrize("opacity", [0.05, 0.5])
def test_a_lonely_gaussian_is_seen_as_a_whole(opacity):
    model = wall(opacity)[0]
    model = model.select(torch.tensor([len(model) - 1]))
    np.testing.assert_allclose(bared(model, 0.8), [GREEN], atol=1e-6)


@pytest.mark.thorough
@pytest.mark.slow
def test_a_training_ends_with_them_and_is_no_other_for_it(small):
    trained = {}
    for below in (0.0, 0.5):
        config = options(iterations=10, refine_every=100, hidden_below=below)
        trainer = trainer_of(small[::4], config)
        trainer.step()
        assert trainer.model.bared is None
        trained[below] = trainer.run()
    assert trained[0.0].bared is None
    moved = trained[0.5].bared.abs().amax(1) > 0.05
    assert 0.01 < moved.float().mean() < 0.9
    for name, value in trained[0.0].tensors().items():
        assert torch.equal(value, getattr(trained[0.5], name)), name


@pytest.mark.thorough
@pytest.mark.slow
def test_masks_do_not_keep_hidden_colours(small):
    masked = []
    for frame in small[::4]:
        mask = np.full(frame.image.shape[:2], 255, np.uint8)
        mask[:, 100:] = 0  # as by an instrument that stays where it is
        masked.append(dataclasses.replace(frame, mask=mask))
    model = trainer_of(masked, options(iterations=10, refine_every=100)).run()
    pixels = [frame.camera.project(model.means.numpy())[0][:, 0] for frame in masked]
    under = np.all([(u > 105) & (u < 155) for u in pixels], axis=0)
    assert under.sum() > 20 and model.bared.any(1).numpy()[under].mean() > 0.3
