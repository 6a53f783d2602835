"""From sparse views to a model: every part by itself, then short trainings on the phantom."""

import dataclasses

import numpy as np
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure
from trained import trainer_of

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.held_out import reconstruct_and_measure
from endo_sim_ros.reconstruction import ReconstructionConfig, losses
from endo_sim_ros.reconstruction.config import McmcConfig
from endo_sim_ros.reconstruction.optimizer import Adam
from endo_sim_ros.reconstruction.strategies import STRATEGIES
from endo_sim_ros.reconstruction.strategies.mcmc import exploration_noise, relocated
from endo_sim_ros.reconstruction.triangulation import ScenePoints
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.bag import write_bag
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.splatting import render

NO_POINTS = ScenePoints.none()


def film(width, height, count):
    return tuple(phantom_sequence(PhantomConfig(width=width, height=height, frames=count)))


@pytest.fixture(scope="module")
def small():
    """Nine frames of the phantom, 160×128, with exact depth and stereo."""
    return film(160, 128, 9)


@pytest.fixture(scope="module")
def large():
    """Four frames of the phantom, 640×512, for matching."""
    return film(640, 512, 4)


def options(**changes):
    short = {"iterations": 12, "max_gaussians": 2000, "refine_every": 5, "device": "cpu"}
    return ReconstructionConfig(**(short | changes))


def bare(frame, **changes):
    """The frame without any depth."""
    nothing = {"depth": None, "right": None, "baseline": None, "right_K": None}
    return dataclasses.replace(frame, **(nothing | changes))


def equal(first: GaussianModel, second: GaussianModel) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first.tensors().values(), second.tensors().values()))


def held_out(model, frames):
    """Mean PSNR (dB) and depth error (m) over frames."""
    renderer = DeformableRenderer(model, None, RenderingConfig(device="cpu"))
    rows = []
    for frame in frames:
        image, depth = renderer.render(frame.camera)
        rows.append([metrics.psnr(image, frame.image), metrics.depth_rmse(depth, frame.depth)])
    return np.mean(rows, 0)


# ----------------------------------------------------------------------------------------------- losses


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
    values = [function.apply(image, y) for function, image in ((losses._SsimOnGpu, ours), (losses._Ssim, expected))]
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


# -------------------------------------------------------------------------------------------- keyframes


# --------------------------------------------------------------------------------- shrinking of frames


# ---------------------------------------------------------------------------------------- triangulation


# ------------------------------------------------------------------------------------------- depth prior


# ---------------------------------------------------------------------------------------- agreement of views


@pytest.mark.parametrize("known", [np.s_[20:21], np.s_[:, 20:21]])
def test_depth_in_one_line_is_continued_level_to_its_sides(known):
    """Of how depth changes across the line nothing is known."""
    (frame,) = film(40, 40, 1)
    line = np.zeros_like(frame.depth)
    line[known] = frame.depth[known]
    model = trainer_of([dataclasses.replace(bare(frame), depth=line)], options(depth="topic")).run()
    _, depth = frame.camera.project(model.means.numpy())
    assert len(model) > 100 and 0.7 * line[known].min() < depth.min() and depth.max() < 1.4 * line.max()


@pytest.mark.parametrize(
    "positions, error, said",
    [
        (np.full((9, 3), np.nan), 0.01, "not finite"),
        (np.ones((9, 3)), np.zeros(9), "above zero"),
        (np.ones((9, 3)), np.full(9, np.nan), "above zero"),
        (np.ones((9, 2)), 0.01, r"arrays \[N, 3\]"),
    ],
)
def test_scene_points_that_are_none_are_refused(large, positions, error, said):
    with pytest.raises(SequenceError, match=said):
        trainer_of(list(large[:1]), options(iterations=1), (positions, np.ones((len(positions), positions.shape[1])), error))


# ----------------------------------------------------------------------------------------- initial model


# ----------------------------------------------------------------------------------------- densification


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


def test_optimiser_state_follows_its_gaussians(small):
    trainer = trainer_of([small[0], small[8]], options(refine_every=1000, max_gaussians=1500))
    for _ in range(3):
        trainer.step()
    with torch.no_grad():
        trainer._parameters["logit_opacities"][:7] = -8
    state = lambda: trainer._optimizer.state["means"]
    moments, means = state()["exp_avg"].clone(), trainer.model.means
    trainer._refine()
    kept = (trainer.model.means[: len(means)] == means).all(1) & (state()["exp_avg"][: len(means)] != 0).any(1)
    assert kept.sum() > 0.5 * len(means)
    assert not kept[:7].any()
    torch.testing.assert_close(state()["exp_avg"][: len(means)][kept], moments[kept])
    assert float(state()["step"]) == 3
    trainer.step()


# ---------------------------------------------------------------------------------------------- training


def test_adam_is_that_of_torch():
    g = torch.Generator().manual_seed(0)
    start = {name: torch.randn(shape, generator=g) for name, shape in (("means", (20, 3)), ("logit_opacities", (20,)))}
    rates = {"means": 1e-3, "logit_opacities": 0.05}
    ours, theirs = ({name: x.clone().requires_grad_() for name, x in start.items()} for _ in range(2))
    optimizer = Adam(ours, rates)
    reference = torch.optim.Adam([{"params": [x], "lr": rates[name]} for name, x in theirs.items()], eps=1e-15)
    for step in range(5):
        optimizer.set_rate("means", 1e-3 / (step + 1))
        reference.param_groups[0]["lr"] = 1e-3 / (step + 1)
        for name, x in theirs.items():
            x.grad = torch.randn(x.shape, generator=g)
        optimizer.step({name: x.grad for name, x in theirs.items()})
        reference.step()
    for name, x in ours.items():
        torch.testing.assert_close(x, theirs[name])
        assert not torch.equal(x, start[name])


def test_virtual_camera_lies_between_two_views(small, monkeypatch):
    trainer = trainer_of([small[0], small[4]], options(virtual_every=1))
    first, second = (small[i].camera.position for i in (0, 4))
    seen = []
    draw = trainer._render

    def spy(viewmats, *arguments):
        seen.extend(viewmats.double().inverse()[:, :3, 3].numpy())
        return draw(viewmats, *arguments)

    monkeypatch.setattr(trainer, "_render", spy)
    for _ in range(3):
        trainer.step()
    virtual = seen[1::2]
    assert len(virtual) == 3
    for position in virtual:
        alpha = np.dot(position - first, second - first) / np.dot(second - first, second - first)
        assert 0 < alpha < 1
        np.testing.assert_allclose(position, (1 - alpha) * first + alpha * second, atol=1e-7)


def test_training_improves_views_it_has_not_seen(small):
    training, rest = [small[i] for i in (0, 2, 4, 6)], [small[i] for i in (1, 3, 5)]
    noisy = [dataclasses.replace(f, depth=f.depth * np.float32(1.03 if i % 2 else 0.97)) for i, f in enumerate(training)]
    trainer = trainer_of(noisy, options(iterations=150, max_gaussians=8000, refine_every=50))
    psnr, _ = held_out(trainer.model, rest)
    given_error = 0.03 * np.mean([np.sqrt(np.mean(f.depth[f.depth > 0] ** 2)) for f in training])
    reports = []
    model = trainer.run(lambda progress: reports.append(progress), every=50)
    trained_psnr, trained_error = held_out(model, rest)
    assert trained_psnr > psnr + 2.5
    assert trained_error < 0.85 * given_error
    assert [report.iteration for report in reports] == [50, 100, 150]
    assert reports[-1].gaussians == len(model) <= 8000


def test_progress_can_stop_the_training(small):
    trainer = trainer_of([small[0]], options())
    trainer.run(lambda progress: False, every=2)
    assert trainer.iteration == 2


def test_same_seed_gives_the_same_bits_whatever_the_threads(small, monkeypatch):
    models = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("ENDO_SIM_THREADS", threads)
        torch.set_num_threads(int(threads))
        try:
            models.append(trainer_of(list(small[::4]), options(max_gaussians=15_000)).run())
        finally:
            torch.set_num_threads(1)
    assert equal(models[0], models[1])
    assert equal(models[0], models[2])
    other = trainer_of(list(small[::4]), options(max_gaussians=15_000, seed=1)).run()
    assert not equal(models[0], other)


def test_a_checkpoint_goes_on_as_if_never_interrupted(small, tmp_path):
    views = list(small[::4])
    whole = trainer_of(views, options()).run()
    first = trainer_of(views, options())
    for _ in range(7):
        first.step()
    first.save_checkpoint(tmp_path / "a" / "checkpoint.pt")
    second = trainer_of(views, options())
    second.load_checkpoint(tmp_path / "a" / "checkpoint.pt")
    assert second.iteration == 7
    assert equal(second.run(), whole)


def test_checkpoints_that_do_not_fit_are_refused(small, tmp_path):
    path = tmp_path / "checkpoint.pt"
    trainer = trainer_of([small[0]], options())
    trainer.save_checkpoint(path)
    with pytest.raises(SequenceError, match=r"other options \(seed\)"):
        trainer_of([small[0]], options(seed=3)).load_checkpoint(path)
    with pytest.raises(SequenceError, match="other views"):
        trainer_of([small[1]], options()).load_checkpoint(path)
    state = torch.load(path, weights_only=True)
    torch.save(state | {"config": state["config"] | {"lambda_gone": 0.3}}, path)  # of another version, which asked for more
    with pytest.raises(SequenceError, match=r"other options \(lambda_gone\)"):
        trainer.load_checkpoint(path)
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(SequenceError, match="not a readable checkpoint"):
        trainer.load_checkpoint(path)
    with pytest.raises(SequenceError, match="not a readable checkpoint"):
        trainer.load_checkpoint(tmp_path / "absent.pt")


def test_higher_harmonics_are_trained(small):
    model = trainer_of([small[0], small[8]], options(sh_degree=3)).run()
    assert model.sh_degree == 3
    assert model.sh[:, 1:].abs().max() > 0


def test_reconstruction_of_a_bag_is_measured(tmp_path, small):
    write_bag(tmp_path / "bag", small)
    found = reconstruct_and_measure(tmp_path / "bag", tmp_path / "out", options(keyframes=4, image_width=80))
    assert found["held_out_views"] == 5
    assert found["psnr"] > 15
    assert found["depth_rmse"] < 0.010
    for name in ("model.ply", "checkpoint.pt", "held_out.png"):
        assert (tmp_path / "out" / name).stat().st_size > 0


# -------------------------------------------------------------------------------------------- bad inputs


def finite(model):
    return all(bool(tensor.isfinite().all()) for tensor in model.tensors().values())


def test_no_views_is_one_clear_error():
    with pytest.raises(SequenceError, match="no views"):
        trainer_of([], options())


def test_one_view_is_enough_with_depth(small):
    assert finite(trainer_of([small[0]], options()).run())


def test_identical_views_train(small, caplog):
    assert finite(trainer_of([small[0]] * 3, options()).run())
    assert "contradict what they see" not in caplog.text


def test_masking_everything_is_an_error(small):
    hidden = dataclasses.replace(small[0], mask=np.zeros_like(small[0].mask))
    with pytest.raises(SequenceError, match="masked"):
        trainer_of([hidden], options())
    assert finite(trainer_of([small[4], hidden], options()).run())  # one of them is no obstacle


def test_depth_with_holes_trains(small):
    depth = small[0].depth.copy()
    depth[:, :60], depth[:40] = np.nan, 0
    empty = dataclasses.replace(small[4], depth=np.zeros_like(depth))
    assert finite(trainer_of([dataclasses.replace(small[0], depth=depth), empty], options()).run())


def test_nothing_to_see_is_an_error(small):
    flat = np.full_like(small[0].image, 128)
    with pytest.raises(SequenceError, match="only 0 scene points"):
        trainer_of([bare(small[0], image=flat), bare(small[4], image=flat)], options())
    with pytest.raises(SequenceError, match="only 0 scene points"):
        trainer_of([dataclasses.replace(bare(small[0]), depth=np.zeros_like(small[0].depth))], options())


def test_views_that_face_away_from_each_other_train(small):
    away = small[4].camera.pose @ np.diag([-1.0, 1, -1, 1])
    other = dataclasses.replace(small[4], camera=small[4].camera.at(away))
    assert finite(trainer_of([small[0], other], options()).run())


def test_points_alone_are_enough(large):
    model = trainer_of([bare(frame) for frame in large[:3]], options(image_width=160)).run()
    assert finite(model)
    assert len(model) > 100


def test_odd_sizes_train():
    frames = film(161, 97, 3)
    model = trainer_of(list(frames[::2]), options(image_width=75)).run()
    assert finite(model)


def test_depth_extent_sees_needles_along_the_line_of_sight_only():
    eye, angle = torch.tensor([0.0, 0.0, -0.1]), np.pi / 4
    turned = [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]  # the z axis turns towards x
    quats = torch.tensor([[1.0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0], turned], dtype=torch.float32)
    scales = torch.tensor([[1.0, 1, 1], [4, 4, 1], [1, 1, 6], [1, 1, 6]]) * 1e-3
    model = GaussianModel(torch.zeros(4, 3), quats, scales.log(), torch.zeros(4), torch.zeros(4, 1, 3))
    model.log_scales.requires_grad_()
    extent = losses.depth_extent(model, eye, 1.5)
    # A sphere and a disc across the view are fine; a needle along it is 6 times as deep as wide, a turned one less.
    deep, wide = (1 + 36) / 2, (1 + (1 + 36) / 2) / 2
    expected = [0, 0, np.log(6 / 1.5), 0.5 * np.log(deep / wide) - np.log(1.5)]
    np.testing.assert_allclose(extent.detach(), np.maximum(expected, 0), atol=1e-5)
    extent[2].backward()
    assert model.log_scales.grad[2, 2] > 0 > model.log_scales.grad[2, 0] and not model.log_scales.grad[:2].any()


def test_no_gaussian_outgrows_the_scene():
    frames = list(phantom_sequence(PhantomConfig(frames=4, width=96, height=80, border=0.1)))
    trainer = trainer_of(frames, ReconstructionConfig(iterations=60, max_gaussians=1000, device="cpu", learning_rate=5.0))
    trainer.run()
    assert trainer.model.scales.max() <= 0.06 * trainer.scene_depth * 1.001
