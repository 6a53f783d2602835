"""The rasteriser at the edges: nothing to draw, odd sizes, degenerate Gaussians, wrong shapes."""

import pytest
import torch
from raster_scene import (
    BACKGROUND,
    DEVICES,
    GAUSSIAN_NAMES,
    GRADIENT_TOLERANCES,
    HEIGHT,
    IMAGE_TOLERANCE,
    WIDTH,
    assert_close,
    assert_matches_reference,
    make_cameras,
    make_gaussians,
    random_like,
    run,
)

from endo_sim_ros.splatting import RenderOutput, rasterize, rasterize_in_torch


def assert_only_background(gaussians, size=(WIDTH, HEIGHT)):
    output, gradients = run(rasterize, gaussians, make_cameras(2, *size), size=size, dtype=torch.float32)
    assert torch.equal(output.colors, BACKGROUND.float().expand_as(output.colors))
    assert not any(image.any() for image in output[1:5])
    assert all(not gradient.any() for gradient in gradients[:-1])
    cotangent = random_like(output[:1])[0].sum((0, 1, 2))
    assert_close("gradient of the background", gradients[-1], cotangent, 1e-5)


@pytest.mark.slow
def test_no_gaussians_render_the_background(compositor):
    assert_only_background(make_gaussians(0))


def test_the_gradient_of_the_background_is_exact_in_large_images():
    gaussians, (viewmats, Ks) = [x.float() for x in make_gaussians(0)], [x.float() for x in make_cameras(1, 1024, 512)]
    background = torch.zeros(3, requires_grad=True)
    rasterize(*gaussians, viewmats, Ks, 1024, 512, background=background).colors.mean().backward()
    assert torch.allclose(background.grad, torch.full((3,), 1 / 3), rtol=1e-6)


@pytest.mark.parametrize("opacity", [0.3, 1.0])
def test_one_gaussian_matches_the_reference(opacity, compositor):
    gaussians = make_gaussians(1, 4, seed=15)
    gaussians[0][:] = torch.tensor([0.01, 0.02, 0.12])
    gaussians[3][:] = opacity
    # It meets nothing, so its distortion is zero.
    expected, expected_gradients = run(rasterize_in_torch, gaussians, make_cameras())
    output, gradients = run(rasterize, gaussians, make_cameras(), dtype=torch.float32)
    for name, actual, image in zip(RenderOutput._fields[:3], output, expected):
        assert_close(name, actual, image, IMAGE_TOLERANCE)
    assert output.distortions.abs().max() < 1e-9
    for name, actual, gradient in zip(GAUSSIAN_NAMES, gradients, expected_gradients):
        assert_close(f"gradient of {name}", actual, gradient, GRADIENT_TOLERANCES[name])


@pytest.mark.parametrize("device", DEVICES)
def test_opacities_of_exactly_zero_and_one_match_the_reference(device, compositor):
    gaussians = make_gaussians(80, seed=21)
    gaussians[3] = (gaussians[3] > 0.5).double()
    output, gradients = run(rasterize, gaussians, make_cameras(), device=device, dtype=torch.float32)
    invisible = (gaussians[3] == 0).to(device)
    assert not output.radii[:, invisible].any()
    assert not any(gradient[invisible].any() for gradient in gradients[:5])
    assert_matches_reference(gaussians, make_cameras(), device)


def test_gaussians_behind_the_camera_render_the_background(compositor):
    gaussians = make_gaussians()
    gaussians[0][:, 2] = -0.1 - gaussians[0][:, 2].abs()
    assert_only_background(gaussians)


def test_gaussians_beside_the_image_render_the_background():
    gaussians = make_gaussians()
    gaussians[0][:, 0] += 5
    assert_only_background(gaussians)


def test_transparent_gaussians_render_the_background():
    gaussians = make_gaussians()
    gaussians[3][:] = 0.5 / 255
    assert_only_background(gaussians)


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 1), (1, 33), (48, 31)])
def test_any_image_size_matches_the_reference(size, compositor):
    gaussians = make_gaussians(30, seed=8)
    gaussians[2] = gaussians[2] * 4
    assert_matches_reference(gaussians, make_cameras(2, *size), size=size)


def test_a_gaussian_that_covers_all_tiles_matches_the_reference():
    gaussians = make_gaussians(4, seed=9)
    gaussians[0] = gaussians[0] * 0.1 + torch.tensor([0, 0, 0.1])
    gaussians[2] = gaussians[2] * 40
    assert_matches_reference(gaussians, make_cameras())


@pytest.mark.slow
@pytest.mark.parametrize("scale", [[0.0, 1.0, 1.0], [0.0, 0.0, 1.0], [1e-12, 1.0, 1.0], [-1.0, 1.0, 1.0]])
def test_degenerate_scales_match_the_reference(scale, compositor):
    gaussians = make_gaussians(seed=22)
    gaussians[2] = gaussians[2] * torch.tensor(scale)
    assert_matches_reference(gaussians, make_cameras(), names=["means", "quats"])


@pytest.mark.thorough
@pytest.mark.slow
def test_a_million_gaussians_are_all_seen():
    count, size = 1_000_000, (160, 128)
    gaussians = [x.float() for x in make_gaussians(count, seed=23)]
    gaussians[2] *= 0.02
    gaussians[3] *= 0.02
    cameras = make_cameras(1, *size)
    whole, gradients = run(rasterize, gaussians, cameras, size=size, dtype=torch.float32)
    assert all(x.isfinite().all() for x in (*whole[:4], *gradients))
    assert (whole.radii > 0).sum() > 0.5 * count
    # Compositing is associative: front half, then back half.
    viewmat = cameras[0][0].float()
    front = (gaussians[0] @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2] < 0.12
    halves = [run(rasterize, [x[side] for x in gaussians], cameras, size=size, dtype=torch.float32)[0] for side in (front, ~front)]
    seen_through = 1 - halves[0].alphas
    alphas = halves[0].alphas + seen_through * halves[1].alphas
    unfinished = alphas < 0.99
    assert 0.5 < alphas[unfinished].max() and unfinished.float().mean() > 0.2
    assert (whole.alphas - alphas)[unfinished].abs().max() < 1e-4
    depths = halves[0].depths + seen_through * halves[1].depths
    assert (whole.depths - depths)[unfinished].abs().max() < 1e-5


@pytest.mark.slow
def test_needle_gaussians_lose_no_tile(compositor):
    gaussians = make_gaussians(80, seed=10)
    gaussians[2] = gaussians[2] * torch.tensor([12.0, 0.02, 0.02])
    expected, _ = run(rasterize_in_torch, gaussians, make_cameras())
    output, _ = run(rasterize, gaussians, make_cameras(), dtype=torch.float32)
    for image, other in zip(output[:4], expected):
        errors = (image.double() - other).abs() / other.abs().max()
        # In float32 a needle's conic is good to 1e-4, so that some pixels fall on the other side of alpha = 1/255.
        assert errors.max() < 2 / 255
        assert (errors > 5e-4).double().mean() < 2e-3


def test_zero_quaternion_means_no_rotation_and_has_no_gradient():
    gaussians = make_gaussians()
    gaussians[1][3] = 0
    identity = [x.clone() for x in gaussians]
    identity[1][3] = torch.tensor([1.0, 0, 0, 0])
    output, gradients = run(rasterize, gaussians, make_cameras(), dtype=torch.float32)
    expected, _ = run(rasterize, identity, make_cameras(), dtype=torch.float32)
    assert torch.equal(output.colors, expected.colors)
    assert not gradients[1][3].any() and gradients[1].any()
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_a_flat_gaussian_is_drawn_as_wide_as_the_blur():
    gaussians = make_gaussians()
    gaussians[2][:] = 0
    assert_matches_reference(gaussians, make_cameras(), names=["means"])


@pytest.mark.parametrize("argument,value", [(1, torch.nan), (2, torch.inf), (3, torch.nan), (4, torch.nan), (2, 1e30)])
def test_a_gaussian_that_is_not_finite_is_not_drawn_and_does_no_harm(argument, value):
    good = make_gaussians()
    broken = [torch.cat([x[:1], x]) for x in good]
    broken[argument][0] = value
    output, gradients = run(rasterize, broken, make_cameras(), dtype=torch.float32)
    expected, expected_gradients = run(rasterize, good, make_cameras(), dtype=torch.float32)
    assert torch.equal(output.colors, expected.colors)
    assert not output.radii[:, 0].any()
    for gradient, expected_gradient in zip(gradients[:5], expected_gradients):
        assert not gradient[0].any()
        assert torch.equal(gradient[1:], expected_gradient)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_mean_that_is_not_finite_is_named(value):
    gaussians = [x.float() for x in make_gaussians()]
    gaussians[0][7, 1] = value
    viewmats, Ks = make_cameras()
    with pytest.raises(ValueError, match=r"rasterize: means\[7\] is not finite"):
        rasterize(*gaussians, viewmats, Ks, WIDTH, HEIGHT)


@pytest.mark.parametrize("function", [rasterize, rasterize_in_torch])
def test_wrong_shapes_are_named_with_both_shapes(function):
    gaussians = make_gaussians(6)
    viewmats, Ks = make_cameras()
    names = ["means", "quats", "scales", "opacities", "sh", "viewmats", "Ks"]
    for index, name in enumerate(names):
        arguments = [*gaussians, viewmats, Ks]
        arguments[index] = arguments[index][..., :-1]
        if name in ("means", "opacities"):
            arguments[index] = arguments[index][None]
        with pytest.raises(ValueError, match=rf"{function.__name__}: {name} shape \(.*\) != expected shape \(.*\)"):
            function(*arguments, WIDTH, HEIGHT)
    for option, shape in {"background": (4,), "masks": (2, HEIGHT, WIDTH + 1), "absgrad": (2, 5, 2)}.items():
        with pytest.raises(ValueError, match=f"{option} shape"):
            function(*gaussians, viewmats, Ks, WIDTH, HEIGHT, **{option: torch.zeros(shape)})
    with pytest.raises(ValueError, match="either covars or both"):
        function(gaussians[0], None, *gaussians[2:], viewmats, Ks, WIDTH, HEIGHT)
    with pytest.raises(ValueError, match="covars replaces"):
        function(*gaussians, viewmats, Ks, WIDTH, HEIGHT, covars=torch.eye(3).repeat(6, 1, 1))
    with pytest.raises(ValueError, match="image size"):
        function(*gaussians, viewmats, Ks, 0, HEIGHT)
    with pytest.raises(ValueError, match="no camera"):
        function(*gaussians, viewmats[:0], Ks[:0], WIDTH, HEIGHT)
    for option in ({"near": -1.0}, {"eps2d": float("nan")}):
        with pytest.raises(ValueError, match="must not be negative"):
            function(*gaussians, viewmats, Ks, WIDTH, HEIGHT, **option)
