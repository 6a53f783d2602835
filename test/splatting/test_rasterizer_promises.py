"""What the rasteriser promises of any scene: the same bits, masks, room in memory, threads."""

import contextlib
import gc
import threading

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from raster_scene import (
    BACKGROUND,
    DEVICES,
    GAUSSIAN_NAMES,
    HEIGHT,
    IMAGE_TOLERANCE,
    WIDTH,
    assert_close,
    covariances,
    make_cameras,
    make_gaussians,
    random_like,
    run,
)
from underflow import kernels_with_subnormals, tells_underflow

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.kernels import compare_plain, vectorised
from endo_sim_ros.splatting import RenderOutput, api, cuda, rasterize, rasterize_in_torch, render

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


@pytest.mark.slow
@settings(max_examples=80, deadline=None, derandomize=True, database=None)
@given(scenes)
def test_any_scene_matches_the_reference(scene):
    """Images everywhere but at pixels on a threshold; gradients where there is no such pixel. Of long needles close by plain torch
    loses digits in float32 as well."""
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
    expected, expected_gradients = run(rasterize_in_torch, gaussians, cameras, **options)
    rounded, rounded_gradients = run(rasterize_in_torch, gaussians, cameras, dtype=torch.float32, **options)
    output, gradients = run(rasterize, gaussians, cameras, dtype=torch.float32, **options)
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert (output.alphas >= 0).all() and (output.alphas <= 1).all() and (output.distortions > -1e-5).all()
    assert_close("gradient of background", gradients[-1], expected_gradients[-1] + 1e-9, 2e-2)
    apart = torch.zeros_like(expected.alphas, dtype=torch.bool)
    for name, image, other, plain in zip(RenderOutput._fields[:4], output, expected, rounded):
        errors = [(each.double() - other).abs() / other.abs().max().clamp_min(1e-3) for each in (image, plain)]
        error, usual = (each.amax(-1) if each.ndim == 4 else each for each in errors)
        # The light of a splat that is or is not cut off: one 255th of itself, or the last 1e-4 of the transmittance.
        assert error.max() < 3e-2, name
        apart |= error > 3e-5 + 2 * usual
    assert apart.sum() <= max(2, 0.01 * apart.numel())
    if not apart.any():
        for actual, gradient, plain in zip(gradients[:-1], expected_gradients, rounded_gradients):
            if gradient.numel():
                usual = (plain.double() - gradient).abs().max()
                assert (actual.double() - gradient).abs().max() <= 5e-4 * gradient.abs().max() + 2 * usual + 1e-6


def test_results_repeat_bit_for_bit_with_any_number_of_threads(monkeypatch):
    gaussians, cameras = make_gaussians(3000, 4, seed=11), make_cameras(2, 150, 90)
    results = []
    for threads in (1, 2, 2, 5):
        monkeypatch.setenv("ENDO_SIM_THREADS", str(threads))
        absgrad = torch.zeros(2, 3000, 2, requires_grad=True)
        extras = torch.randn(2, 3000, 4, generator=torch.Generator().manual_seed(1)).requires_grad_()
        options = {"size": (150, 90), "absgrad": absgrad, "median": True, "extras": extras}
        output, gradients = run(rasterize, gaussians, cameras, dtype=torch.float32, **options)
        again = rasterize(*(x.float() for x in (*gaussians, *cameras)), 150, 90, extras=extras).extras
        (v_extras,) = torch.autograd.grad(again.square().sum(), extras)
        results.append([*output, *gradients, absgrad.grad, v_extras])
    for result in results[1:]:
        assert all(torch.equal(first, other) for first, other in zip(results[0], result, strict=True))


def test_a_mask_that_skips_tiles_does_not_change_the_other_pixels(compositor):
    gaussians, cameras = make_gaussians(seed=12), make_cameras()
    mask = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    mask[0, 20:30, 30:50] = True
    mask[1, 44, 69] = True
    cotangents = random_like(run(rasterize_in_torch, gaussians, cameras)[0][:4])
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


@pytest.mark.slow
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


def test_pictures_in_inference_mode_do_not_disturb_later_gradients(compositor):
    for cache in (api.black, cuda.scratch_for):
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
    api.black.cache_clear()
    expected, _ = run(rasterize, gaussians, cameras, dtype=torch.float32)
    torch.set_default_dtype(torch.float64)
    try:
        output, _ = run(rasterize, gaussians, cameras, dtype=torch.float32)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(output.colors, expected.colors)


@pytest.mark.slow
def test_pictures_drawn_in_several_threads_are_those_drawn_in_one(compositor):
    """Of different sizes, each with two forward passes before their backward passes."""
    plain, scenes = not vectorised("cpu"), [(make_gaussians(400, seed=31), (70, 45)), (make_gaussians(150, seed=32), (33, 60))]

    def draw(turn):
        with compare_plain() if plain else contextlib.nullcontext():
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


@pytest.mark.slow
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
    extras = torch.randn(3, 60, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    draw = lambda function, x: function(x[0], None, None, *x[2:6], WIDTH, HEIGHT, covars=x[1], extras=x[6], median=True)
    everything = [means, covars, opacities, sh, viewmats, Ks, extras]
    expected = draw(rasterize_in_torch, everything)
    output = draw(rasterize, [x.to(device, torch.float32) for x in everything])
    for name, actual, image in zip(RenderOutput._fields, output, expected):
        if name == "radii":
            assert (actual.cpu() - image).abs().max() <= 1
        else:
            assert_close(name, actual, image, IMAGE_TOLERANCE if name != "medians" else 1e-4)
    for c in range(3):
        alone = [means[c], covars[c], opacities, sh[c], viewmats[c : c + 1], Ks[c : c + 1], extras[c : c + 1]]
        one = draw(rasterize, [x.to(device, torch.float32) for x in alone])
        assert torch.equal(one.colors[0], output.colors[c]) and torch.equal(one.extras[0], output.extras[c])
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


def test_capacity_follows_what_pictures_needed():
    expectation = cuda._Expectation(torch.device("cpu"))
    assert 4000 <= expectation.capacity(1000) < 8000
    expectation.seen.copy_(torch.tensor([30_000, 1000]))
    assert 30_000 < expectation.capacity(1000) < 60_000
    assert 60_000 < expectation.capacity(2000) < 120_000
    expectation.seen.copy_(torch.tensor([100_000_000, 1000]))
    assert expectation.capacity(1000) == cuda._ALWAYS
    assert 64_000_000 <= expectation.capacity(1_000_000) < 100_000_000


def test_the_first_picture_on_a_cpu_has_lists():
    cuda.scratch_for.cache_clear()
    gaussians, cameras = make_gaussians(20, seed=33), make_cameras(1, 300, 200)
    gaussians[2] *= 10
    with compare_plain():
        run(rasterize, gaussians, cameras, size=(300, 200), dtype=torch.float32)
    scratch = cuda.scratch_for(torch.device("cpu"), 0)
    assert cuda._FIRST_GUESS * 20 * 1.5 < scratch.seen[0] <= scratch.capacity


@pytest.mark.parametrize("count,opacity,masked", [(60, 0.0, False), (1500, 0.9, False), (1500, 0.9, True)])
def test_vectors_and_plain_numbers_draw_the_same_bits(count, opacity, masked):
    """The maths is written once; tile rows that are left out hold no pixel of a splat."""
    gaussians, cameras = make_gaussians(count, 4, seed=34), make_cameras(2, 150, 90)
    gaussians[2] *= torch.tensor([3.0, 1.0, 0.1])
    gaussians[3] = opacity + (1 - opacity) * gaussians[3]
    options = {"size": (150, 90), "median": True, "extras": torch.randn(2, count, 4, generator=torch.Generator().manual_seed(1))}
    options["masks"] = torch.rand(2, 90, 150, generator=torch.Generator().manual_seed(2)) > 0.998 if masked else None
    expected, _ = run(rasterize, gaussians, cameras, dtype=torch.float32, **options)
    with compare_plain():
        output, _ = run(rasterize, gaussians, cameras, dtype=torch.float32, **options)
    assert bool((expected.alphas > 0.999).any()) == (count > 60) and expected.alphas.max() > 0.5
    for name, actual, image in zip(RenderOutput._fields, output, expected):
        assert torch.equal(actual, image), name


@tells_underflow
def test_small_splats_are_drawn_without_subnormal_numbers(monkeypatch):
    """Of a tile they leave most pixels far outside."""
    gaussians, cameras = make_gaussians(200, seed=35), make_cameras(1)
    gaussians[2] *= 0.01
    assert not kernels_with_subnormals(lambda: run(rasterize, gaussians, cameras, dtype=torch.float32), monkeypatch)


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


@pytest.mark.parametrize("device", DEVICES)
def test_pictures_without_lists_of_tiles_are_the_same(device, monkeypatch):
    """Two cameras, one of which sees nothing, and Gaussians behind the camera and beside the image."""
    gaussians, cameras = make_gaussians(300, 4, seed=13), make_cameras()
    gaussians[0][:20, 2] = -1.0
    gaussians[0][20:40, 0] = 50.0
    cameras[0][1, 2, 3] = -100.0
    with compare_plain():
        listed = run(rasterize, gaussians, cameras, device=device, dtype=torch.float32)
        monkeypatch.setattr(cuda, "_MOST", 0.01)
        monkeypatch.setattr(cuda, "_ALWAYS", 0)
        unlisted = run(rasterize, gaussians, cameras, device=device, dtype=torch.float32)
        device = torch.device(f"{device}:0" if device == "cuda" else device)
        scratch = cuda.scratch_for(device, cuda.stream_of(device))
    assert scratch.seen[0] > scratch.capacity
    for expected, actual in zip([*listed[0][:4], *listed[1]], [*unlisted[0][:4], *unlisted[1]]):
        assert_close("it", actual, expected.cpu(), 1e-5)
