"""The rasteriser against its float64 reference: images, gradients and depth."""

import numpy as np
import pytest
import torch
from raster_scene import (
    BACKGROUND,
    DEVICES,
    GAUSSIAN_NAMES,
    HEIGHT,
    IMAGE_TOLERANCE,
    WIDTH,
    assert_close,
    assert_matches_reference,
    covariances,
    make_cameras,
    make_gaussians,
    random_like,
    run,
)

from endo_sim_ros.splatting import RenderOutput, rasterize, rasterize_in_torch, reference


@pytest.mark.slow
@pytest.mark.parametrize("sh_count", [1, 4, 9, 16])
@pytest.mark.parametrize("device", DEVICES)
def test_images_and_all_gradients_match_the_reference(device, sh_count, compositor):
    assert_matches_reference(make_gaussians(sh_count=sh_count, seed=sh_count), make_cameras(), device)


@pytest.mark.parametrize("seed", range(20, 26))
def test_random_scenes_match_the_reference(seed):
    generator = np.random.default_rng(seed)
    size = tuple(int(x) for x in generator.integers(1, 60, 2))
    gaussians = make_gaussians(int(generator.integers(5, 120)), 4, seed)
    gaussians[2] = gaussians[2] * float(generator.uniform(0.3, 3.0))
    assert_matches_reference(gaussians, make_cameras(1, *size), size=size)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_opaque_stacks_that_end_pixels_early_match_the_reference(device, compositor):
    gaussians = make_gaussians(150, seed=3)
    gaussians[2] = gaussians[2] * 3
    gaussians[3] = 0.9 + 0.1 * gaussians[3]
    expected, _ = run(rasterize_in_torch, gaussians, make_cameras())
    assert expected.alphas.max() > 1 - 1e-3
    assert_matches_reference(gaussians, make_cameras(), device)


@pytest.mark.parametrize("device", DEVICES)
def test_covariances_match_the_reference_and_give_the_picture_of_quats_and_scales(device):
    means, quats, scales, opacities, sh = make_gaussians(seed=5)
    by_covariance = [means, covariances(quats, scales), opacities, sh]
    names = ["means", "covars", "opacities", "sh", "viewmats", "background"]
    assert_matches_reference(by_covariance, make_cameras(), device, names)
    output, _ = run(rasterize, by_covariance, make_cameras(), dtype=torch.float32, device=device)
    same, _ = run(rasterize, [means, quats, scales, opacities, sh], make_cameras(), dtype=torch.float32, device=device)
    for name, actual, image in zip(RenderOutput._fields[:4], output, same):
        assert_close(name, actual, image.detach().cpu(), IMAGE_TOLERANCE)


@pytest.mark.parametrize("device", DEVICES)
def test_extras_and_the_gradients_of_all_match_the_reference(device, compositor):
    gaussians, (viewmats, Ks) = make_gaussians(seed=9), make_cameras()
    extras = torch.randn(2, len(gaussians[0]), 4, generator=torch.Generator().manual_seed(9), dtype=torch.float64)

    def drawn(function, dtype, device):
        leaves = [x.detach().to(device, dtype).requires_grad_() for x in (*gaussians, viewmats, extras)]
        output = function(*leaves[:6], Ks.to(device, dtype), WIDTH, HEIGHT, extras=leaves[6])
        images = [*output[:4], output.extras]
        torch.autograd.backward(images, [x.to(device, dtype) for x in random_like(images)])
        return images, [leaf.grad for leaf in leaves]

    expected, expected_gradients = drawn(rasterize_in_torch, torch.float64, "cpu")
    images, gradients = drawn(rasterize, torch.float32, device)
    for name, actual, image in zip(("colors", "depths", "alphas", "distortions", "extras"), images, expected):
        assert_close(name, actual, image, IMAGE_TOLERANCE)
    for name, actual, gradient in zip((*GAUSSIAN_NAMES[:6], "extras"), gradients, expected_gradients):
        assert_close(f"gradient of {name}", actual, gradient, 1e-4)
    plain = run(rasterize, gaussians, (viewmats, Ks), dtype=torch.float32, device=device)[0]
    assert torch.equal(plain.depths, images[1]) and plain.extras is None


def test_extras_of_all_cameras_and_of_each_are_drawn_alike():
    gaussians, (viewmats, Ks) = make_gaussians(seed=9), make_cameras()
    extras = torch.randn(len(gaussians[0]), 4, generator=torch.Generator().manual_seed(9))
    draw = lambda extras: rasterize(*gaussians, viewmats, Ks, WIDTH, HEIGHT, extras=extras).extras
    assert torch.equal(draw(extras), draw(extras.expand(2, -1, -1)))
    with pytest.raises(ValueError, match=r"extras shape \(2, 60, 3\) != expected shape \(2, \d+, 4\)"):
        draw(torch.zeros(60, 3))


@pytest.mark.slow
def test_each_output_alone_has_the_gradient_of_the_reference():
    gaussians, cameras = make_gaussians(seed=6), make_cameras()
    images = run(rasterize_in_torch, gaussians, cameras)[0][:4]
    for alone in range(4):
        cotangents = [x if i == alone else torch.zeros_like(x) for i, x in enumerate(random_like(images))]
        _, expected = run(rasterize_in_torch, gaussians, cameras, cotangents=cotangents)
        _, gradients = run(rasterize, gaussians, cameras, cotangents=cotangents, dtype=torch.float32)
        for name, actual, gradient in zip(GAUSSIAN_NAMES[:4], gradients, expected):
            assert gradient.abs().max() > 0
            assert_close(f"{name} for {RenderOutput._fields[alone]}", actual, gradient, 2e-4)


@pytest.mark.slow
def test_camera_gradient_matches_finite_differences_of_the_reference():
    gaussians, (viewmats, Ks) = make_gaussians(40, 4, seed=7), make_cameras(1)
    cotangents = random_like(rasterize_in_torch(*gaussians, viewmats, Ks, WIDTH, HEIGHT)[:4])
    _, gradients = run(rasterize, gaussians, (viewmats, Ks), dtype=torch.float32, cotangents=cotangents)

    def loss(pose):
        output = rasterize_in_torch(*gaussians, pose, Ks, WIDTH, HEIGHT, background=BACKGROUND)
        return float(sum((image * cotangent).sum() for image, cotangent in zip(output, cotangents)))

    step = 1e-7
    differences = torch.zeros(1, 4, 4, dtype=torch.float64)
    for row in range(3):
        for column in range(4):
            change = torch.zeros(1, 4, 4, dtype=torch.float64)
            change[0, row, column] = step
            differences[0, row, column] = (loss(viewmats + change) - loss(viewmats - change)) / (2 * step)
    assert_close("gradient of viewmats", gradients[5], differences, 1e-3)


def test_gradients_match_finite_differences_where_nothing_is_cut_off(monkeypatch):
    gaussians, cameras = make_gaussians(8, 4, seed=16), make_cameras(1, 20, 14)
    gaussians[0] *= torch.tensor([0.2, 0.2, 1.0])
    gaussians[0][:, 2] += 0.1
    gaussians[2] = 0.1 + 2 * gaussians[2]
    gaussians[3] = 0.2 + 0.3 * gaussians[3]
    gaussians[4] = 0.3 * gaussians[4]  # no colour is clamped at zero
    images, gradients = run(rasterize, gaussians, cameras, size=(20, 14), dtype=torch.float32)
    cotangents = random_like(images[:4])

    def loss(leaves):
        *gaussians, viewmats, background = leaves
        output = rasterize_in_torch(*gaussians, viewmats, cameras[1], 20, 14, background=background)
        return float(sum((image * cotangent).sum() for image, cotangent in zip(output, cotangents)))

    leaves = [*gaussians, cameras[0], BACKGROUND]
    expected = loss(leaves)
    monkeypatch.setattr(reference, "ALPHA_MIN", 1e-9)
    monkeypatch.setattr(reference, "TRANSMITTANCE_MIN", 0.0)
    assert loss(leaves) == expected, "a cut-off has an effect"
    generator = torch.Generator().manual_seed(0)
    for index, name in enumerate(GAUSSIAN_NAMES):
        for _ in range(4):
            direction = torch.randn(leaves[index].shape, generator=generator, dtype=torch.float64)
            if name == "viewmats":
                direction[:, 3] = 0
            step = 1e-6 * leaves[index].abs().max() * direction
            ahead, behind = ([x + sign * step if i == index else x for i, x in enumerate(leaves)] for sign in (1, -1))
            difference = (loss(ahead) - loss(behind)) / 2
            change = float((gradients[index].double() * step).sum())
            scale = float(gradients[index].double().norm() * step.norm())
            assert abs(change - difference) < 1e-4 * scale, f"{name}: {change / difference - 1:.1e}"


def with_absolute_gradients(function, gaussians, cameras, device="cpu", dtype=torch.float64, **options):
    """Absolute gradients of the means in the image, and all other gradients."""
    absgrad = torch.full((len(cameras[0]), len(gaussians[0]), 2), 7.0, dtype=dtype, device=device, requires_grad=True)
    _, gradients = run(function, gaussians, cameras, device=device, dtype=dtype, absgrad=absgrad, **options)
    return absgrad.grad, gradients


@pytest.mark.parametrize("device", DEVICES)
def test_absolute_gradients_match_the_reference_and_change_nothing_else(device, compositor):
    gaussians, cameras = make_gaussians(seed=17), make_cameras()
    gaussians[0][:5, 2] = -1
    expected, _ = with_absolute_gradients(rasterize_in_torch, gaussians, cameras)
    actual, gradients = with_absolute_gradients(rasterize, gaussians, cameras, device, torch.float32)
    assert_close("absolute gradients", actual, expected, 5e-5)
    assert (actual >= 0).all() and not actual[:, :5].any()
    _, plain = run(rasterize, gaussians, cameras, device=device, dtype=torch.float32)
    if device == "cpu":
        assert all(torch.equal(first, other) for first, other in zip(gradients, plain))


@pytest.mark.parametrize("device", DEVICES)
def test_signed_gradients_match_the_reference_and_change_nothing_else(device, compositor):
    gaussians, cameras = make_gaussians(seed=17), make_cameras()
    gaussians[0][:5, 2] = -1
    expected, others = with_absolute_gradients(rasterize_in_torch, gaussians, cameras, signed=True)
    actual, gradients = with_absolute_gradients(rasterize, gaussians, cameras, device, torch.float32, signed=True)
    assert_close("signed gradients", actual, expected, 5e-5)
    assert actual.min() < 0 and not actual[:, :5].any()
    _, plain = run(rasterize_in_torch, gaussians, cameras)
    assert all(torch.equal(first, other) for first, other in zip(others, plain))
    _, plain = run(rasterize, gaussians, cameras, device=device, dtype=torch.float32)
    if device == "cpu":
        assert all(torch.equal(first, other) for first, other in zip(gradients, plain))


def test_absolute_gradients_do_not_cancel():
    means, K = torch.tensor([[0.0, 0.0, 0.1]]), torch.tensor([[[100.0, 0, 8.5], [0, 100, 8.5], [0, 0, 1]]])
    gaussian = [means.requires_grad_(), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.003), torch.tensor([0.5])]
    absgrad = torch.zeros(1, 1, 2, requires_grad=True)
    rasterize(*gaussian, torch.zeros(1, 1, 3), torch.eye(4)[None], K, 17, 17, absgrad=absgrad).alphas.sum().backward()
    # By symmetry the left and right halves of the splat pull the same way apart.
    assert absgrad.grad.min() > 0.1 and torch.allclose(absgrad.grad[..., 0], absgrad.grad[..., 1], rtol=1e-4)
    assert (means.grad[0, :2] * 0.1 / 100).abs().max() < 1e-4 * absgrad.grad.min()


@pytest.mark.parametrize("device", DEVICES)
def test_median_depth_and_its_gradient_match_the_reference(device, compositor):
    gaussians, (viewmats, Ks) = make_gaussians(150, seed=18), make_cameras()
    gaussians = [x.float().double() for x in gaussians]
    results = []
    for function, where, dtype in ((rasterize_in_torch, "cpu", torch.float64), (rasterize, device, torch.float32)):
        leaves = [x.detach().to(where, dtype, copy=True).requires_grad_() for x in (*gaussians, viewmats)]
        medians = function(*leaves, Ks.to(where, dtype), WIDTH, HEIGHT, median=True).medians
        (medians * random_like([medians])[0].to(where, dtype)).sum().backward()
        results.append((medians.detach().cpu(), leaves[0].grad.cpu(), leaves[5].grad.cpu()))
    expected, actual = results
    assert (expected[0] > 0).any() and not expected[0].all()
    for name, x, y in zip(("medians", "gradient of means", "gradient of viewmats"), actual, expected):
        assert_close(name, x, y, 1e-5)


def test_median_depth_is_where_half_of_the_light_is_blocked(compositor):
    z, opacity = torch.tensor([0.13, 0.10, 0.11]), torch.tensor([0.5, 0.3, 0.6])
    means = torch.stack([torch.zeros(3), torch.zeros(3), z], 1).requires_grad_()
    K = torch.tensor([[[50.0, 0, 0.5], [0, 50.0, 0.5], [0, 0, 1]]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1), torch.full((3, 3), 0.01)
    arguments = [means, quats, scales, opacity, torch.zeros(3, 1, 3), torch.eye(4)[None], K, 1, 1]
    output = rasterize(*arguments, median=True)
    output.medians.sum().backward()
    assert torch.allclose(output.medians, torch.tensor(0.11))
    assert torch.equal(means.grad, torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 1]]))
    faint = rasterize(*arguments[:3], 0.2 * opacity, *arguments[4:], median=True)
    assert not faint.medians.any() and rasterize(*arguments).medians is None


def test_mean_depth_lies_on_the_surface_also_where_it_is_thin():
    gaussians = [x.float() for x in make_gaussians(seed=19)]
    gaussians[0][:, 2] = 0.12
    viewmats, Ks = (x.float() for x in make_cameras(1))
    output = rasterize(*gaussians, torch.eye(4)[None], Ks, WIDTH, HEIGHT)
    drawn = output.alphas > 0
    assert drawn.any() and not drawn.all()
    assert torch.allclose(output.depths, 0.12 * output.alphas, rtol=1e-5, atol=0)


def test_float64_inputs_get_float64_gradients():
    _, gradients = run(rasterize, make_gaussians(), make_cameras())
    assert all(gradient.dtype == torch.float64 for gradient in gradients)


def test_distortion_is_the_double_sum_of_its_definition():
    z, opacity = torch.tensor([0.10, 0.11, 0.13]), torch.tensor([0.3, 0.6, 0.5])
    means = torch.stack([torch.zeros(3), torch.zeros(3), z], 1)
    K = torch.tensor([[[50.0, 0, 0.5], [0, 50.0, 0.5], [0, 0, 1]]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1), torch.full((3, 3), 0.01)
    output = rasterize(means, quats, scales, opacity, torch.zeros(3, 1, 3), torch.eye(4)[None], K, 1, 1)
    weights = opacity * torch.tensor([1.0, 0.7, 0.7 * 0.4])
    expected = (weights[:, None] * weights * (z[:, None] - z).abs()).sum()
    assert torch.allclose(output.distortions.squeeze(), expected, rtol=1e-5)
    assert torch.allclose(output.depths.squeeze(), (weights * z).sum(), rtol=1e-5)
    assert torch.allclose(output.alphas.squeeze(), weights.sum(), rtol=1e-5)
    assert torch.allclose(output.colors.squeeze(), 0.5 * weights.sum().expand(3), rtol=1e-5)
