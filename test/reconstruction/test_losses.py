"""Losses against references and by hand."""

import math

import numpy as np
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.reconstruction import ReconstructionConfig, losses
from endo_sim_ros.reconstruction.device_views import DeviceView, shown
from endo_sim_ros.reconstruction.scene import TrainingView, pixels_of


def reference_ssim(x, y):
    """The SSIM map [H, W, 3] in plain torch, zero padding."""
    t = torch.arange(11, dtype=x.dtype) - 5
    g = torch.exp(-(t**2) / 4.5)
    window = torch.outer(g, g)[None, None] / g.sum() ** 2
    blur = lambda a: torch.nn.functional.conv2d(a.permute(2, 0, 1)[:, None], window, padding=5)[:, 0].permute(1, 2, 0)
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 1e-4, 9e-4
    return (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))


@pytest.fixture
def images():
    generator = torch.Generator().manual_seed(0)
    return tuple(torch.rand(37, 29, 3, generator=generator, dtype=torch.float64) for _ in range(3))


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 2e-4)])
def test_ssim_and_its_gradient_are_those_of_the_reference(images, dtype, tolerance):
    x, y, v = images
    y = 0.7 * x + 0.3 * y
    ours, exact = x.clone().to(dtype).requires_grad_(), x.clone().requires_grad_()
    value, expected = losses.ssim(ours, y.to(dtype)), reference_ssim(exact, y)
    torch.testing.assert_close(value.double(), expected, atol=tolerance, rtol=0)
    value.backward(v.to(dtype))
    expected.backward(v)
    assert exact.grad.abs().max() > 0.1
    torch.testing.assert_close(ours.grad.double(), exact.grad, atol=10 * tolerance, rtol=0)


def test_ssim_by_kernels_is_the_same(images):
    x, y, v = (image.float() for image in (*images[:2], torch.randn(images[0].shape, generator=torch.Generator().manual_seed(3))))
    ours, expected = x.clone().requires_grad_(), x.clone().requires_grad_()
    values = [losses.ssim(expected, y)]
    with compare_plain():
        values.append(losses.ssim(ours, y))
    for value in values:
        value.backward(v)
    torch.testing.assert_close(*values, atol=1e-5, rtol=0)
    torch.testing.assert_close(ours.grad, expected.grad, atol=1e-5 * float(expected.grad.abs().max()), rtol=0)


def test_ssim_is_that_of_torchmetrics_away_from_the_border(images):
    x, y = (image.permute(2, 0, 1)[None] for image in images[:2])
    _, full = structural_similarity_index_measure(x, y, data_range=1.0, return_full_image=True)
    ours = losses.ssim(*images[:2])
    torch.testing.assert_close(ours[5:-5, 5:-5], full[0].permute(1, 2, 0)[5:-5, 5:-5], atol=1e-6, rtol=0)


def test_photometric_loss_of_constant_images_by_hand():
    image, target = torch.full((20, 20, 3), 0.5), torch.full((20, 20, 3), 0.3)
    assert float(losses.photometric(image, target, None, 0.0)) == pytest.approx(0.2)
    expected = 0.8 * 0.2 + 0.2 * float(1 - losses.ssim(image, target).mean())
    assert float(losses.photometric(image, target, None, 0.2)) == pytest.approx(expected, rel=1e-5)


def test_masked_pixels_have_no_part_in_the_photometric_loss(images):
    image, target = images[0].float().requires_grad_(), images[1].float()
    mask = torch.zeros(37, 29)
    mask[:, :15] = 1
    loss = losses.photometric(image, target, mask, 0.2)
    loss.backward()
    assert image.grad[:, 15:].abs().max() == 0
    assert image.grad[:, :15].abs().max() > 0
    other = torch.where(mask[..., None] > 0, images[0].float(), 9.0)
    assert float(losses.photometric(other, target, mask, 0.2)) == float(loss.detach())


def test_an_overexposed_pixel_asks_nothing_of_a_brighter_picture(images):
    target = images[1].float()
    target[10:20, 10:20, 0] = 0.99
    image = torch.lerp(target, images[0].float(), 0.1)
    loss = lambda red, white: losses.photometric(torch.where(target == 0.99, red, image), target, None, 0.2, white)
    red = torch.full_like(image, 2.0).requires_grad_()
    brighter = loss(red, 0.98)
    brighter.backward()
    assert float(brighter.detach()) == float(loss(target, 0.98)) and red.grad.abs().max() == 0
    assert float(loss(torch.tensor(0.9), 0.98)) > float(brighter.detach()) + 1e-3  # a darker one is wrong
    assert float(loss(torch.tensor(2.0), math.inf)) > float(brighter.detach()) + 1e-3


def test_masked_mean_counts_channels_and_survives_an_empty_mask():
    values = torch.tensor([[[1.0, 3.0], [9.0, 9.0]]])  # [1, 2, 2]
    assert float(losses.masked_mean(values, torch.tensor([[1.0, 0.0]]))) == 2
    assert float(losses.masked_mean(values, torch.zeros(1, 2))) == 0
    with pytest.raises(ValueError, match="do not fit the mask"):
        losses.masked_mean(values, torch.ones(2, 2))


def test_depth_loss_by_hand():
    depth, prior = torch.tensor([[0.10, 0.20, 0.30]]), torch.tensor([[0.13, 0.0, 0.29]])
    alpha = torch.tensor([[0.8, 1.0, 1.0]])
    assert float(losses.depth_l1(depth, prior, None, alpha, 0.0)) == pytest.approx(0.02)
    assert float(losses.depth_l1(depth, prior, torch.tensor([[1.0, 1.0, 0.0]]), alpha, 0.0)) == pytest.approx(0.03)
    # Seen at 0.125 m, and a fifth of it is transparent.
    assert float(losses.depth_l1(depth, prior, None, alpha, 0.5)) == pytest.approx((0.005 + 0.5 * 0.2 * 0.13 + 0.01) / 2)


def test_total_variation_by_hand():
    depth = torch.tensor([[1.0, 2.0, 4.0], [1.0, 1.0, 1.0]])
    # Differences along rows: 1, 2, 0, 0; along columns: 0, 1, 3.
    assert float(losses.total_variation(depth, None)) == pytest.approx(3 / 4 + 4 / 3)
    mask = torch.tensor([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    assert float(losses.total_variation(depth, mask)) == pytest.approx(1 / 3 + 1 / 2)


def test_pearson_does_not_see_scale_and_shift():
    depth = torch.rand(20, 30, generator=torch.Generator().manual_seed(0)) + 1
    assert float(losses.pearson(3 * depth + 2, depth, None)) == pytest.approx(0, abs=1e-5)
    assert float(losses.pearson(-depth, depth, None)) == pytest.approx(2, abs=1e-5)
    spoilt = depth.clone()
    spoilt[:10] = 9
    prior = depth.clone()
    prior[:10] = 0  # no measurement
    assert float(losses.pearson(spoilt, prior, None)) == pytest.approx(0, abs=1e-5)


def test_opacity_and_size_count_only_where_a_view_shows_tissue():
    model = GaussianModel.from_points(torch.zeros(4, 3), torch.zeros(4, 3), torch.full((4,), 0.002), opacity=0.5)
    images = torch.ones(8, 8)
    seen = torch.tensor([1.0, 1.0, 1.0, 0.0])
    rendering = losses.Rendering(model, images, images, images, None, None, scene_depth=0.1, seen=seen)
    config = ReconstructionConfig(lambda_opacity=2.0, lambda_scale=3.0)
    weighted = {term.weight: term.weighted for term in losses.TERMS}
    assert float(weighted["lambda_opacity"](rendering, config)) == pytest.approx(2 * 0.5 * 3 / 4)
    assert float(weighted["lambda_scale"](rendering, config)) == pytest.approx(3 * 0.02 * 3 / 4)


def test_a_view_shows_what_projects_onto_its_tissue():
    mask = np.zeros((24, 32), np.uint8)
    mask[5:20, 4:30] = 255
    camera = Camera(intrinsic_matrix(30, 30, 16, 12), 32, 24, np.array([[0, 0, 1, -0.4], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]))
    view = TrainingView(0, np.zeros((24, 32, 3), np.uint8), camera, mask=mask)
    points = np.random.default_rng(0).normal(0, 0.3, (500, 3))
    found = pixels_of(camera, points)
    expected = np.zeros(500, bool)
    expected[found.index] = mask[found.rows, found.columns] > 0
    given = shown(DeviceView.of(view, 0, "cpu"), torch.tensor(points, dtype=torch.float32))
    assert 20 < expected.sum() < 400 and np.array_equal(given.numpy(), expected)
