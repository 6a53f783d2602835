"""Holes of pictures that take the colour around them."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import SURFACE, Light
from endo_sim_ros.core.surroundings import fill_holes
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig

LEFT, RIGHT = torch.tensor([0.8, 0.4, 0.2]), torch.tensor([0.2, 0.5, 0.9])


def pictures(device="cpu"):
    """Two pictures 90 × 60 of two colours, left and right, with a hole in the middle; a corner of the second lets black through."""
    alphas = torch.ones(2, 60, 90)
    alphas[:, 20:40, 30:60] = 0
    alphas[1, 50:, :30] = 0.3
    colors = torch.where((torch.arange(90) < 45)[:, None], LEFT, RIGHT) * alphas[..., None]
    return colors.to(device).contiguous(), alphas.to(device)


def test_holes_take_the_colour_around_and_tissue_keeps_its_own():
    colors, alphas = pictures()
    before = colors.clone()
    fill_holes(colors, alphas)
    seen = alphas >= SURFACE
    assert torch.equal(colors[seen], before[seen])
    hole = colors[0, 20:40, 30:60]
    assert (hole[:, 0] - LEFT).abs().max() < 0.05 and (hole[:, -1] - RIGHT).abs().max() < 0.05
    assert (hole[:, :, 0].diff(dim=1) < 1e-6).all()  # from the left colour to the right one
    assert torch.allclose(hole[:, 15], (LEFT + RIGHT) / 2, atol=0.12)
    share = 1 - 0.3 / SURFACE
    assert torch.allclose(colors[1, 55, :10], 0.3 * LEFT + share * LEFT, atol=0.03)


def test_what_fills_is_the_mean_of_all_cells_by_distance():
    alphas = torch.rand(1, 20, 20, generator=torch.Generator().manual_seed(0)) * SURFACE  # a pixel is a cell
    colors = torch.rand(1, 20, 20, 3, generator=torch.Generator().manual_seed(1)) * alphas[..., None]
    expected = torch.empty_like(colors)
    rows, columns = torch.meshgrid(torch.arange(20), torch.arange(20), indexing="ij")
    for row in range(20):
        for column in range(20):
            weights = ((rows - row) ** 2 + (columns - column) ** 2 + 0.1).float() ** -2
            around = (weights[..., None] * colors[0]).sum((0, 1)) / (weights * alphas[0]).sum()
            expected[0, row, column] = colors[0, row, column] + (1 - alphas[0, row, column] / SURFACE) * around
    fill_holes(colors, alphas)
    assert torch.allclose(colors, expected, atol=1e-5)


def test_a_picture_of_nothing_stays_black():
    colors, alphas = torch.zeros(1, 30, 40, 3), torch.zeros(1, 30, 40)
    fill_holes(colors, alphas)
    assert not colors.any()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_fills_as_a_cpu_does():
    (colors, alphas), (ours, there) = pictures(), pictures("cuda")
    fill_holes(colors, alphas)
    fill_holes(ours, there)
    assert torch.allclose(ours.cpu(), colors, atol=1e-5)


def test_the_model_says_whether_its_holes_are_filled_and_depth_tells_them():
    places = torch.tensor([[x / 100, y / 100, 0.1] for x in range(-8, 9) for y in range(-8, 9) if max(abs(x), abs(y)) > 3])
    model = GaussianModel.from_points(places, torch.tensor([0.7, 0.4, 0.3]).expand(len(places), 3), torch.full((len(places),), 0.006), 0.99)
    camera = Camera(np.array([[60.0, 0, 48], [0, 60, 40], [0, 0, 1]]), 96, 80)

    def middle(filled, **options):
        lit = dataclasses.replace(model, light=Light(filled=filled))
        image, depth = DeformableRenderer(lit, None, RenderingConfig(device="cpu", **options)).render(camera)
        assert not depth[36:44, 44:52].any() and abs(image[5, 5].astype(int) - [178, 102, 76]).max() < 3
        return image[40, 48].astype(int)

    assert abs(middle(1.0) - [178, 102, 76]).max() < 12
    assert not middle(0.0).any() and not middle(1.0, background=0.0).any()
    assert middle(1.0, background=0.5).tolist() == [128] * 3


def test_lights_of_files_from_before_there_were_filled_holes_or_a_shoulder_are_read():
    values = json.loads(Light(distance=0.9).to_json())
    del values["shoulder"]
    assert Light.from_json(json.dumps(values)) == Light(distance=0.9)
    del values["filled"]
    assert Light.from_json(json.dumps(values)) == Light(distance=0.9)


def test_holes_are_filled_or_not():
    with pytest.raises(ValueError, match="light: filled is 0.5; it must be 0 or 1"):
        Light(filled=0.5)


def test_pictures_are_filled_to_the_same_bits_together_and_alone():
    colors, alphas = pictures()
    alone = colors.clone()
    fill_holes(colors, alphas)
    for color, alpha in zip(alone, alphas):
        fill_holes(color[None], alpha[None])
    assert torch.equal(alone, colors)
