"""The rasteriser against its float64 reference, and what must hold at the edges."""

import contextlib
import gc
import threading

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.kernels import plain_kernels, vectorised
from endo_sim_ros.splatting import RenderOutput, _rasterize, api, cuda, rasterize, reference, render

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
WIDTH, HEIGHT = 70, 45  # no multiple of the tile
BACKGROUND = torch.tensor([0.2, 0.4, 0.1], dtype=torch.float64)


def make_gaussians(count=60, sh_count=1, seed=0):
    """Random means, quats, scales, opacities and sh in float64; some lie behind the cameras, some outside the image."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(count, 3) * torch.tensor([0.04, 0.04, 0.05]) + torch.tensor([0.0, 0.0, 0.12])
    opacities = torch.rand(count, generator=generator, dtype=torch.float64)
    scales = (0.5 * normal(count, 3)).exp() * 0.006
    return [means, normal(count, 4), scales, opacities, 0.3 * normal(count, sh_count, 3)]


def make_cameras(count=2, width=WIDTH, height=HEIGHT):
    """View matrices and intrinsics in float64, around a point 12 cm in front of the origin."""
    target = np.array([0.0, 0.0, 0.12])
    poses = [look_at(np.array([0.03 * i, 0.01 * i, -0.02 * i]), target) for i in range(count)]
    viewmats = torch.stack([torch.from_numpy(np.linalg.inv(pose)) for pose in poses])
    K = torch.tensor([[0.8 * width, 0, 0.45 * width], [0, 0.75 * width, 0.55 * height], [0, 0, 1]], dtype=torch.float64)
    return viewmats, K.repeat(count, 1, 1)


def random_like(images, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(image.shape, generator=generator, dtype=torch.float64) for image in images]


def covariances(quats, scales):
    """World covariances [N, 3, 3]."""
    rotations = reference._quat_to_matrix(quats)
    return rotations @ torch.diag_embed(scales**2) @ rotations.mT


def run(function, gaussians, cameras, size=(WIDTH, HEIGHT), device="cpu", dtype=torch.float64, cotangents=None, **options):
    """The output of a rasteriser and the gradients of gaussians, view matrices and background for random cotangents."""
    viewmats, Ks = cameras
    leaves = [x.detach().to(device, dtype).requires_grad_() for x in (*gaussians, viewmats, BACKGROUND)]
    *gaussians, viewmats, background = leaves
    if len(gaussians) == 4:  # means, covars, opacities, sh
        options["covars"] = gaussians[1]
        gaussians = [gaussians[0], None, None, *gaussians[2:]]
    output = function(*gaussians, viewmats, Ks.to(device, dtype), *size, background=background, **options)
    cotangents = random_like(output[:4]) if cotangents is None else cotangents
    torch.autograd.backward(output[:4], [x.to(device, dtype) for x in cotangents])
    return output, [leaf.grad for leaf in leaves]


def assert_close(name, actual, expected, tolerance):
    """Both finite, and equal within a tolerance relative to the largest expected value."""
    actual, expected = actual.detach().cpu().double(), expected.detach().double()
    assert actual.isfinite().all() and expected.isfinite().all(), f"{name} is not finite"
    error = float((actual - expected).abs().max() / expected.abs().max())
    assert error < tolerance, f"{name}: relative error {error:.1e}"


GAUSSIAN_NAMES = ["means", "quats", "scales", "opacities", "sh", "viewmats", "background"]
IMAGE_TOLERANCE = 1e-5
GRADIENT_TOLERANCES = {"means": 5e-5, "quats": 5e-5, "scales": 5e-5, "covars": 5e-5, "opacities": 5e-5} | {
    name: 1e-4 for name in ("sh", "viewmats", "background")
}


def assert_matches_reference(gaussians, cameras, device="cpu", names=GAUSSIAN_NAMES, **options):
    expected, expected_gradients = run(_rasterize, gaussians, cameras, **options)
    output, gradients = run(rasterize, gaussians, cameras, device=device, dtype=torch.float32, **options)
    for name, actual, image in zip(RenderOutput._fields, output, expected):
        if name not in ("radii", "medians"):
            assert image.abs().max() > 0, f"{name} is empty, nothing is tested"
            assert_close(name, actual, image, IMAGE_TOLERANCE)
    assert torch.equal(output.radii.cpu() > 0, expected.radii > 0)
    assert (output.radii.cpu() - expected.radii).abs().max() <= 1
    for name, actual, gradient in zip(names, gradients, expected_gradients):
        assert gradient.abs().max() > 1e-6, f"the gradient of {name} vanishes, nothing is tested"
        assert_close(f"gradient of {name}", actual, gradient, GRADIENT_TOLERANCES[name])


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread():
    """The reference works on small tensors, for which threads that wait for each other on busy cores only cost time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=["vectors", "pixels"])
def compositor(request):
    """The backend of CPUs, and that of GPUs, which runs on the CPU too."""
    with plain_kernels() if request.param == "pixels" else contextlib.nullcontext():
        yield


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


@pytest.mark.parametrize("device", DEVICES)
def test_opaque_stacks_that_end_pixels_early_match_the_reference(device, compositor):
    gaussians = make_gaussians(150, seed=3)
    gaussians[2] = gaussians[2] * 3
    gaussians[3] = 0.9 + 0.1 * gaussians[3]
    expected, _ = run(_rasterize, gaussians, make_cameras())
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


def test_each_output_alone_has_the_gradient_of_the_reference():
    gaussians, cameras = make_gaussians(seed=6), make_cameras()
    images = run(_rasterize, gaussians, cameras)[0][:4]
    for alone in range(4):
        cotangents = [x if i == alone else torch.zeros_like(x) for i, x in enumerate(random_like(images))]
        _, expected = run(_rasterize, gaussians, cameras, cotangents=cotangents)
        _, gradients = run(rasterize, gaussians, cameras, cotangents=cotangents, dtype=torch.float32)
        for name, actual, gradient in zip(GAUSSIAN_NAMES[:4], gradients, expected):
            assert gradient.abs().max() > 0
            assert_close(f"{name} for {RenderOutput._fields[alone]}", actual, gradient, 2e-4)


def test_camera_gradient_matches_finite_differences_of_the_reference():
    gaussians, (viewmats, Ks) = make_gaussians(40, 4, seed=7), make_cameras(1)
    cotangents = random_like(_rasterize(*gaussians, viewmats, Ks, WIDTH, HEIGHT)[:4])
    _, gradients = run(rasterize, gaussians, (viewmats, Ks), dtype=torch.float32, cotangents=cotangents)

    def loss(pose):
        output = _rasterize(*gaussians, pose, Ks, WIDTH, HEIGHT, background=BACKGROUND)
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
        output = _rasterize(*gaussians, viewmats, cameras[1], 20, 14, background=background)
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
    expected, _ = with_absolute_gradients(_rasterize, gaussians, cameras)
    actual, gradients = with_absolute_gradients(rasterize, gaussians, cameras, device, torch.float32)
    assert_close("absolute gradients", actual, expected, 5e-5)
    assert (actual >= 0).all() and not actual[:, :5].any()
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
    for function, where, dtype in ((_rasterize, "cpu", torch.float64), (rasterize, device, torch.float32)):
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


def test_expected_depth_lies_on_the_surface_also_where_it_is_thin():
    gaussians = [x.float() for x in make_gaussians(seed=19)]
    gaussians[0][:, 2] = 0.12
    viewmats, Ks = (x.float() for x in make_cameras(1))
    output = rasterize(*gaussians, torch.eye(4)[None], Ks, WIDTH, HEIGHT)
    drawn = output.alphas > 0
    assert drawn.any() and not drawn.all()
    assert torch.allclose(output.expected_depths, torch.where(drawn, 0.12, 0.0), atol=1e-6)


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


# ---------------------------------------------------------------- edges


def assert_only_background(gaussians, size=(WIDTH, HEIGHT)):
    output, gradients = run(rasterize, gaussians, make_cameras(2, *size), size=size, dtype=torch.float32)
    assert torch.equal(output.colors, BACKGROUND.float().expand_as(output.colors))
    assert not any(image.any() for image in output[1:5])
    assert all(not gradient.any() for gradient in gradients[:-1])
    cotangent = random_like(output[:1])[0].sum((0, 1, 2))
    assert_close("gradient of the background", gradients[-1], cotangent, 1e-5)


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
    expected, expected_gradients = run(_rasterize, gaussians, make_cameras())
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


@pytest.mark.parametrize("scale", [[0.0, 1.0, 1.0], [0.0, 0.0, 1.0], [1e-12, 1.0, 1.0], [-1.0, 1.0, 1.0]])
def test_degenerate_scales_match_the_reference(scale, compositor):
    gaussians = make_gaussians(seed=22)
    gaussians[2] = gaussians[2] * torch.tensor(scale)
    assert_matches_reference(gaussians, make_cameras(), names=["means", "quats"])


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


def test_needle_gaussians_lose_no_tile(compositor):
    gaussians = make_gaussians(80, seed=10)
    gaussians[2] = gaussians[2] * torch.tensor([12.0, 0.02, 0.02])
    expected, _ = run(_rasterize, gaussians, make_cameras())
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


@pytest.mark.parametrize("function", [rasterize, _rasterize])
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


# ---------------------------------------------------------------- fuzzing

scenes = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**31),
        "count": st.integers(0, 40),
        "cameras": st.integers(1, 3),
        "sh_count": st.sampled_from([1, 4, 9, 16]),
        "size": st.tuples(st.integers(1, 50), st.integers(1, 50)),
        "log_scale": st.floats(-6, 3),
        "stretch": st.sampled_from([(1, 1, 1), (1, 1, 0), (1, 0, 0), (0, 0, 0), (5, 1, 0.2)]),
        "opacities": st.sampled_from(["random", "zero", "one", "faint", "both"]),
        "nearness": st.floats(0.0, 0.3),
        "zero_quats": st.booleans(),
        "covars": st.booleans(),
        "median": st.booleans(),
    }
)


@settings(max_examples=80, deadline=None, derandomize=True, database=None)
@given(scenes)
def test_any_scene_matches_the_reference(scene):
    """Images everywhere but at pixels on a threshold; gradients where there is no such pixel."""
    gaussians = make_gaussians(scene["count"], scene["sh_count"], scene["seed"])
    means, quats, scales, opacities, sh = gaussians
    means[:, 2] -= scene["nearness"]
    if scene["zero_quats"]:
        quats[::3] = 0
    scales = scales * np.exp(scene["log_scale"]) * torch.tensor(scene["stretch"], dtype=torch.float64)
    edge = {"zero": opacities * 0, "one": opacities * 0 + 1, "faint": opacities / 100, "both": opacities.round()}
    opacities = edge.get(scene["opacities"], opacities)
    shape = covariances(quats, scales) if scene["covars"] else None
    gaussians = [means, quats, scales, opacities, sh] if shape is None else [means, shape, opacities, sh]
    gaussians = [x.float().double() for x in gaussians]
    cameras, options = make_cameras(scene["cameras"], *scene["size"]), {"size": scene["size"], "median": scene["median"]}
    cameras = [x.float().double() for x in cameras]
    expected, expected_gradients = run(_rasterize, gaussians, cameras, **options)
    output, gradients = run(rasterize, gaussians, cameras, dtype=torch.float32, **options)
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert (output.alphas >= 0).all() and (output.alphas <= 1).all() and (output.distortions > -1e-5).all()
    assert_close("gradient of background", gradients[-1], expected_gradients[-1] + 1e-9, 2e-2)
    apart = torch.zeros_like(expected.alphas, dtype=torch.bool)
    for name, image, other in zip(RenderOutput._fields[:4], output, expected):
        error = (image.double() - other).abs() / other.abs().max().clamp_min(1e-3)
        error = error.amax(-1) if error.ndim == 4 else error
        # The light of a splat that is or is not cut off: one 255th of itself, or the last 1e-4 of the transmittance.
        assert error.max() < 3e-2, name
        apart |= error > 3e-5
    assert apart.sum() <= max(2, 0.01 * apart.numel())
    if not apart.any():
        for actual, gradient in zip(gradients[:-1], expected_gradients):
            assert (actual.double() - gradient).abs().max() <= 5e-4 * gradient.abs().max() + 1e-6 if gradient.numel() else True


# ---------------------------------------------------------------- promises


def test_results_repeat_bit_for_bit_with_any_number_of_threads(monkeypatch):
    gaussians, cameras = make_gaussians(3000, 4, seed=11), make_cameras(2, 150, 90)
    results = []
    for threads in (1, 2, 2, 5):
        monkeypatch.setenv("ENDO_SIM_THREADS", str(threads))
        absgrad = torch.zeros(2, 3000, 2, requires_grad=True)
        options = {"size": (150, 90), "absgrad": absgrad, "median": True}
        output, gradients = run(rasterize, gaussians, cameras, dtype=torch.float32, **options)
        results.append([*output, *gradients, absgrad.grad])
    for result in results[1:]:
        assert all(torch.equal(first, other) for first, other in zip(results[0], result, strict=True))


@pytest.mark.parametrize("count,opacity", [(60, 0.0), (1500, 0.9)])
def test_vectors_and_plain_numbers_draw_the_same_bits(count, opacity):
    """The maths of compositing is written once; tile rows that are left out hold no pixel of a splat."""
    gaussians, cameras = make_gaussians(count, 4, seed=34), make_cameras(2, 150, 90)
    gaussians[2] *= torch.tensor([3.0, 1.0, 0.1])
    gaussians[3] = opacity + (1 - opacity) * gaussians[3]
    expected, _ = run(rasterize, gaussians, cameras, size=(150, 90), dtype=torch.float32, median=True)
    with plain_kernels():
        output, _ = run(rasterize, gaussians, cameras, size=(150, 90), dtype=torch.float32, median=True)
    assert bool((expected.alphas > 0.999).any()) == (count > 60) and expected.alphas.max() > 0.5
    for name, actual, image in zip(RenderOutput._fields, output, expected):
        assert torch.equal(actual, image), name


def test_a_mask_that_skips_tiles_does_not_change_the_other_pixels(compositor):
    gaussians, cameras = make_gaussians(seed=12), make_cameras()
    mask = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    mask[0, 20:30, 30:50] = True
    mask[1, 44, 69] = True
    cotangents = random_like(run(_rasterize, gaussians, cameras)[0][:4])
    cotangents = [x * (mask[..., None] if x.ndim == 4 else mask) for x in cotangents]
    whole, whole_gradients = run(rasterize, gaussians, cameras, dtype=torch.float32, cotangents=cotangents)
    output, gradients = run(rasterize, gaussians, cameras, dtype=torch.float32, cotangents=cotangents, masks=mask)
    for image, expected in zip(output[:4], whole):
        assert torch.equal(image[mask], expected[mask])
    assert torch.equal(output.colors[0, 0, 0], BACKGROUND.float()) and not torch.equal(output.colors, whole.colors)
    for name, gradient, expected in zip(GAUSSIAN_NAMES, gradients, whole_gradients):
        assert_close(name, gradient, expected, 1e-5)


def test_whatever_is_not_zero_in_a_mask_is_true():
    gaussians, cameras = make_gaussians(seed=12), make_cameras()
    mask = torch.zeros(2, HEIGHT, WIDTH)
    mask[0, 20, 30] = 0.4
    expected, _ = run(rasterize, gaussians, cameras, dtype=torch.float32, masks=mask > 0)
    output, _ = run(rasterize, gaussians, cameras, dtype=torch.float32, masks=mask)
    assert torch.equal(output.alphas, expected.alphas) and output.alphas.any()


def test_hidden_gaussians_do_not_change_the_picture():
    gaussians, cameras = make_gaussians(seed=13), make_cameras()
    hidden = [torch.cat([x, y]) for x, y in zip(gaussians, make_gaussians(50, seed=14))]
    hidden[0][60:, 2] = -1
    expected, _ = run(rasterize, gaussians, cameras, dtype=torch.float32)
    output, _ = run(rasterize, hidden, cameras, dtype=torch.float32)
    assert all(torch.equal(image, other) for image, other in zip(output[:4], expected))
    assert not output.radii[:, 60:].any()


def test_render_shows_a_model_through_a_camera():
    model = GaussianModel.from_points(torch.tensor([[0.0, 0, 0.1]]), torch.tensor([[0.9, 0.2, 0.1]]), torch.tensor([0.02]), opacity=0.99)
    camera = Camera(np.array([[40.0, 0, 16.5], [0, 40, 12.5], [0, 0, 1]]), 33, 25)
    output = render(model, camera, background=torch.ones(3))
    assert output.colors.shape == (1, 25, 33, 3) and output.radii.shape == (1, 1)
    assert torch.allclose(output.colors[0, 12, 16], torch.tensor([0.9, 0.2, 0.1]) * 0.99 + 0.01, atol=1e-4)
    assert torch.allclose(output.depths[0, 12, 16], torch.tensor(0.099), atol=1e-6)
    covars = covariances(model.quats, model.scales)
    deformed = render(model, camera, covars=covars, background=torch.ones(3))
    assert torch.allclose(deformed.colors, output.colors, atol=1e-5)


def test_gradient_descent_recovers_a_moved_gaussian():
    viewmats, Ks = (x.float() for x in make_cameras(1))
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.015)
    opacities, sh = torch.tensor([0.9]), torch.ones(1, 1, 3)

    def draw(mean):
        return rasterize(mean[None], quats, scales, opacities, sh, viewmats, Ks, WIDTH, HEIGHT).colors

    target = draw(torch.tensor([0.01, -0.005, 0.12]))
    mean = torch.tensor([0.0, 0.0, 0.13], requires_grad=True)
    optimizer = torch.optim.Adam([mean], lr=1e-3)
    for _ in range(60):
        optimizer.zero_grad()
        (draw(mean) - target).square().mean().backward()
        optimizer.step()
    assert torch.allclose(mean, torch.tensor([0.01, -0.005, 0.12]), atol=2e-3)


@pytest.mark.parametrize("device", DEVICES)
def test_pictures_without_lists_of_tiles_are_the_same(device, monkeypatch):
    """Two cameras, one of which sees nothing, and Gaussians behind the camera and beside the image."""
    gaussians, cameras = make_gaussians(300, 4, seed=13), make_cameras()
    gaussians[0][:20, 2] = -1.0
    gaussians[0][20:40, 0] = 50.0
    cameras[0][1, 2, 3] = -100.0
    with plain_kernels():
        listed = run(rasterize, gaussians, cameras, device=device, dtype=torch.float32)
        monkeypatch.setattr(cuda, "_MOST", 0.01)
        monkeypatch.setattr(cuda, "_ALWAYS", 0)
        unlisted = run(rasterize, gaussians, cameras, device=device, dtype=torch.float32)
        device = torch.device(f"{device}:0" if device == "cuda" else device)
        scratch = cuda._scratch(device, cuda._stream(device))
    assert scratch.seen[0] > scratch.capacity
    for expected, actual in zip([*listed[0][:4], *listed[1]], [*unlisted[0][:4], *unlisted[1]]):
        assert_close("it", actual, expected.cpu(), 1e-5)


def test_memory_that_runs_out_is_asked_for_again(monkeypatch):
    scratch = cuda._Scratch(torch.device("cpu"))
    scratch.reserve_splats(10)

    def run_out(count, dtype=torch.int32):
        raise torch.OutOfMemoryError

    with monkeypatch.context() as patch:
        patch.setattr(scratch, "_integers", run_out)
        with pytest.raises(torch.OutOfMemoryError):
            scratch.reserve_splats(20)
    scratch.reserve_splats(20)
    assert len(scratch.depth_keys) == len(scratch.order) == 40
    scratch.ends.fill_(1000)
    with monkeypatch.context() as patch:
        patch.setattr(scratch, "_integers", run_out)
        with pytest.raises(torch.OutOfMemoryError):
            scratch.reserve_lists(1)
    capacity = scratch.reserve_lists(1)
    assert capacity >= 1000 and len(scratch.tiles) == len(scratch.values) == 2 * capacity


def test_the_first_picture_on_a_cpu_has_lists():
    cuda._scratch.cache_clear()
    gaussians, cameras = make_gaussians(20, seed=33), make_cameras(1, 300, 200)
    gaussians[2] *= 10
    with plain_kernels():
        run(rasterize, gaussians, cameras, size=(300, 200), dtype=torch.float32)
    scratch = cuda._scratch(torch.device("cpu"), 0)
    assert cuda._FIRST_GUESS * 20 * 1.5 < scratch.seen[0] <= scratch.capacity


def test_capacity_follows_what_pictures_needed():
    expectation = cuda._Expectation(torch.device("cpu"))
    assert 4000 <= expectation.capacity(1000) < 8000
    expectation.seen.copy_(torch.tensor([30_000, 1000]))
    assert 30_000 < expectation.capacity(1000) < 60_000
    assert 60_000 < expectation.capacity(2000) < 120_000
    expectation.seen.copy_(torch.tensor([100_000_000, 1000]))
    assert expectation.capacity(1000) == cuda._ALWAYS
    assert 64_000_000 <= expectation.capacity(1_000_000) < 100_000_000


def test_captured_pictures_know_whether_their_capacity_still_fits():
    expectation = cuda._Expectation(torch.device("cpu"))
    capacity = cuda.Capacity.for_picture(expectation, 1000, 40)
    assert capacity.fits()
    expectation.seen.copy_(torch.tensor([30_000, 1000]))
    assert not capacity.fits()  # too small
    capacity = cuda.Capacity.for_picture(expectation, 1000, 40)
    assert capacity.fits()
    expectation.seen.copy_(torch.tensor([3000, 1000]))
    for _ in range(20):
        assert capacity.fits()
    while capacity.fits():  # in the end too large
        pass
    assert cuda.Capacity.for_picture(expectation, 1000, 40).size < capacity.size / 2


def test_pictures_in_inference_mode_do_not_disturb_later_gradients(compositor):
    for cache in (api._black, api._all_tiles, cuda._scratch):
        cache.cache_clear()
    *gaussians, viewmats, Ks = (x.float() for x in (*make_gaussians(), *make_cameras()))
    with torch.inference_mode():
        expected = rasterize(*gaussians, viewmats, Ks, WIDTH, HEIGHT).colors
    gaussians[0].requires_grad_()
    colors = rasterize(*gaussians, viewmats, Ks, WIDTH, HEIGHT).colors
    colors.sum().backward()
    assert torch.equal(colors, expected) and gaussians[0].grad.any()


def test_the_default_dtype_changes_nothing(compositor):
    gaussians, cameras = make_gaussians(), make_cameras()
    api._black.cache_clear()
    expected, _ = run(rasterize, gaussians, cameras, dtype=torch.float32)
    torch.set_default_dtype(torch.float64)
    try:
        output, _ = run(rasterize, gaussians, cameras, dtype=torch.float32)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(output.colors, expected.colors)


def test_pictures_drawn_in_several_threads_are_those_drawn_in_one(compositor):
    """Of different sizes, each with two forward passes before their backward passes."""
    plain, scenes = not vectorised("cpu"), [(make_gaussians(400, seed=31), (70, 45)), (make_gaussians(150, seed=32), (33, 60))]

    def draw(turn):
        with plain_kernels() if plain else contextlib.nullcontext():
            leaves, losses = [], []
            for gaussians, size in scenes[::turn]:
                leaves.append([x.float().requires_grad_() for x in gaussians])
                viewmats, Ks = (x.float() for x in make_cameras(1, *size))
                losses.append(rasterize(*leaves[-1], viewmats, Ks, *size).colors.square().sum())
            return [torch.autograd.grad(loss, x, retain_graph=True) for loss, x in zip(losses, leaves)][::turn]

    expected, same = draw(1), []

    def work(turn):
        for _ in range(4):
            same.extend(torch.equal(x, y) for a, b in zip(draw(turn), expected) for x, y in zip(a, b))

    threads = [threading.Thread(target=work, args=(turn,)) for turn in (1, -1, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(same) == 3 * 4 * 10 and all(same)


def test_nothing_holds_the_memory_of_a_picture_that_is_gone(compositor):
    size = (59, 41)  # of no other test
    run(rasterize, make_gaussians(), make_cameras(), size=size, dtype=torch.float32)
    gc.collect()
    held = [x for x in gc.get_objects() if type(x) is torch.Tensor and x.numel() in (2 * 59 * 41, 3 * 2 * 59 * 41)]
    assert not held, f"{len(held)} images are still there"


@pytest.mark.parametrize("device", DEVICES)
def test_gaussians_of_each_camera_match_the_reference_and_the_cameras_one_by_one(device, compositor):
    viewmats, Ks = make_cameras(3)
    sets = [make_gaussians(60, 4, seed) for seed in (1, 2, 3)]
    means, covars, sh = (torch.stack(x) for x in zip(*[(s[0], covariances(s[1], s[2]), s[4]) for s in sets]))
    opacities = sets[0][3]
    draw = lambda function, x: function(x[0], None, None, x[2], x[3], x[4], x[5], WIDTH, HEIGHT, covars=x[1], median=True)
    everything = [means, covars, opacities, sh, viewmats, Ks]
    expected = draw(_rasterize, everything)
    output = draw(rasterize, [x.to(device, torch.float32) for x in everything])
    for name, actual, image in zip(RenderOutput._fields, output, expected):
        if name == "radii":
            assert (actual.cpu() - image).abs().max() <= 1
        else:
            assert_close(name, actual, image, IMAGE_TOLERANCE if name != "medians" else 1e-4)
    for c in range(3):
        alone = [means[c], covars[c], opacities, sh[c], viewmats[c : c + 1], Ks[c : c + 1]]
        one = draw(rasterize, [x.to(device, torch.float32) for x in alone])
        assert torch.equal(one.colors[0], output.colors[c]) and torch.equal(one.depths[0], output.depths[c])
    everything[3] = sh[0]  # the same colours for all
    shared = draw(rasterize, [x.to(device, torch.float32) for x in everything])
    everything[3] = sh[:1].expand_as(sh)
    assert torch.equal(shared.colors, draw(rasterize, [x.to(device, torch.float32) for x in everything]).colors)
    assert not torch.equal(shared.colors, output.colors)


def test_gaussians_of_each_camera_need_covariances_of_each_and_have_no_gradients():
    (means, quats, scales, opacities, sh), (viewmats, Ks) = make_gaussians(), make_cameras(2)
    own = lambda x: x.expand(2, *x.shape).float()
    covars = covariances(quats, scales)
    with pytest.raises(ValueError, match=r"covars of each camera, \(2, 60, 3, 3\)"):
        rasterize(own(means), quats, scales, opacities, own(sh), viewmats, Ks, 8, 8)
    with pytest.raises(ValueError, match=r"sh shape \(3, 60, 1, 3\) != expected shape \(2, 60, 1, 3\)"):
        rasterize(own(means), None, None, opacities, sh.expand(3, *sh.shape), viewmats, Ks, 8, 8, covars=own(covars))
    with pytest.raises(ValueError, match="have no gradients"):
        rasterize(own(means).requires_grad_(), None, None, opacities, own(sh), viewmats, Ks, 8, 8, covars=own(covars))
