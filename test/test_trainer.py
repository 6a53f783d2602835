"""Presets of the trainer, what they are made of, and where reconstruction breaks: a result or one clear error."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from trained import trainer_of

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.reconstruction import ABLATIONS, PRESETS, ReconstructionConfig, losses, preset
from endo_sim_ros.reconstruction.config import GradientConfig, ProximityConfig
from endo_sim_ros.reconstruction.presets import resolved
from endo_sim_ros.reconstruction.priors.stereo import right_view
from endo_sim_ros.reconstruction.scene import shrink
from endo_sim_ros.reconstruction.strategies import STRATEGIES
from endo_sim_ros.reconstruction.triangulation import triangulate
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

SHORT = {"iterations": 12, "max_gaussians": 2000, "refine_every": 5, "device": "cpu"}


def options(**changes):
    return ReconstructionConfig(**(SHORT | changes))


@pytest.fixture(scope="module")
def views():
    """Nine frames 160×128 of half a round about the phantom, the exposure of the camera automatic."""
    return list(phantom_sequence(PhantomConfig(width=160, height=128, frames=9, rounds=0.5, auto_exposure=True, border=0.04)))


@pytest.fixture(scope="module")
def large():
    """Five frames 480×384."""
    return list(phantom_sequence(PhantomConfig(width=480, height=384, frames=5, travel=0.02, stereo=False)))


def bare(frame):
    return dataclasses.replace(frame, depth=None, right=None, baseline=None, right_K=None)


def finite(model: GaussianModel) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in model.tensors().values())


def quality(model, frames) -> tuple[float, float]:
    """Mean PSNR and gain-fitted PSNR, dB."""
    renderer = DeformableRenderer(model, None, RenderingConfig(device="cpu"))
    pairs = [(renderer.render(frame.camera)[0], frame.image, frame.mask) for frame in frames]
    fitted = [metrics.psnr(metrics.gain_fitted(*pair), *pair[1:]) for pair in pairs]
    return float(np.mean([metrics.psnr(*pair) for pair in pairs])), float(np.mean(fitted))


# --------------------------------------------------------------------------------------------- presets


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_trains(views, name):
    points = triangulate(views)[:2]
    model = trainer_of(views[::4], preset(name, **SHORT), points).run()
    assert finite(model) and len(model) <= 2000
    assert (model.light is None) == (name in ("paper", "fsgs", "3dgs"))


def test_options_beside_a_preset_count_and_resolving_twice_changes_nothing():
    config = preset("paper", lambda_tv=0.5, initialization="depth")
    assert (config.initialization, config.lambda_tv, config.light, config.preset) == ("depth", 0.5, False, "default")
    assert resolved(config) == config
    chosen = ReconstructionConfig(preset="3dgs", iterations=7)
    assert resolved(chosen) == preset("3dgs", iterations=7)
    with pytest.raises(ConfigError, match="must be one of"):
        preset("nerf")


def test_every_ablation_changes_its_preset():
    for name, parts in ABLATIONS.items():
        for part, changes in parts.items():
            assert preset(name, **changes) != preset(name), (name, part)


def test_the_default_beats_the_paper_on_two_views(views):
    ends, rest = [views[0], views[-1]], views[1:-1]
    short = {"iterations": 60, "max_gaussians": 6000, "refine_every": 20, "device": "cpu"}
    points = triangulate(views)[:2]
    paper = quality(trainer_of(ends, preset("paper", **short), points).run(), rest)
    ours = quality(trainer_of(ends, preset("default", **short)).run(), rest)
    assert ours[0] > paper[0] + 1.5 and ours[1] > paper[1] + 1.5


# ---------------------------------------------------------------------------------------------- losses


def test_pearson_does_not_see_scale_and_shift():
    depth = torch.rand(20, 30, generator=torch.Generator().manual_seed(0)) + 1
    assert float(losses.pearson(3 * depth + 2, depth, None)) == pytest.approx(0, abs=1e-5)
    assert float(losses.pearson(-depth, depth, None)) == pytest.approx(2, abs=1e-5)
    spoilt = depth.clone()
    spoilt[:10] = 9
    prior = depth.clone()
    prior[:10] = 0  # no measurement
    assert float(losses.pearson(spoilt, prior, None)) == pytest.approx(0, abs=1e-5)


# --------------------------------------------------------------------------------------- densification


def cloud(count: int = 60) -> GaussianModel:
    g = torch.Generator().manual_seed(0)
    return GaussianModel.from_points(torch.rand(count, 3, generator=g), torch.rand(count, 3, generator=g), torch.full((count,), 0.004))


def split_and_clone(model, gradients, limit):
    """What the strategy of 3DGS makes of Gaussians with such mean gradients."""
    state = {"gradients": torch.stack([gradients, torch.ones_like(gradients)])}
    return STRATEGIES["gradient"](GradientConfig(), limit, 1.0).refine(model, state, torch.Generator().manual_seed(0))


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


def test_exposures_and_colours_do_not_drift_against_each_other(views):
    trainer = trainer_of(views, ReconstructionConfig(iterations=40, max_gaussians=2000, depth="topic", device="cpu"))
    before = trainer._appearance.tensors["exposures"].detach().clone()
    trainer.run()
    after = trainer._appearance.tensors["exposures"].detach()
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


# --------------------------------------------------------------------------------------- views and poses


def test_the_right_image_is_a_view_of_the_same_scene(views):
    frame = views[4]
    right = right_view(frame)
    model = trainer_of(views, options(iterations=40, max_gaussians=8000, extrapolation=0.0, learning_rate=1.0)).run()
    image, _ = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(right.camera)
    wrong, _ = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(frame.camera)
    assert metrics.psnr(image, right.image, right.mask) > metrics.psnr(wrong, right.image, right.mask) + 3


def test_pure_rotation_trains_with_depth_and_is_an_error_without(views):
    turned = []
    for frame, angle in ((views[0], 0.0), (views[0], 0.04)):
        pose = frame.camera.pose.copy()
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        H = frame.camera.K @ pose[:3, :3].T @ frame.camera.pose[:3, :3] @ np.linalg.inv(frame.camera.K)
        warp = lambda image, H=H: cv2.warpPerspective(image, H, (160, 128))
        images = {name: warp(getattr(frame, name)) for name in ("image", "mask", "depth")}
        turned.append(dataclasses.replace(frame, right=None, camera=frame.camera.at(pose), **images))
    assert finite(trainer_of(turned, options()).run())
    with pytest.raises(SequenceError, match="scene points could be found in 2 views"):
        trainer_of([bare(frame) for frame in turned], options())


@pytest.mark.parametrize("reason, change", {
    "overexposed": lambda frame: {"image": np.full_like(frame.image, 255)},
    "black": lambda frame: {"image": np.zeros_like(frame.image)},
    "masked": lambda frame: {"mask": np.zeros_like(frame.mask)},
}.items())  # fmt: skip
def test_a_view_that_shows_nothing_is_left_out(views, caplog, reason, change):
    blind = dataclasses.replace(views[4], **change(views[4]))
    trainer = trainer_of([views[0], blind, views[8]], options())
    assert len(trainer.cameras) == 2 and f"left out: {reason}" in caplog.text
    with pytest.raises(SequenceError, match=f"every (view|pixel of every view) is {reason}"):
        trainer_of([blind], options())


@pytest.mark.parametrize("size", [(161, 97), (3840, 2160)])
def test_odd_and_large_pictures_train(size):
    frame = next(iter(phantom_sequence(PhantomConfig(width=160, height=96, frames=1))))
    camera = frame.camera.resized(*size)
    enlarged = lambda image: cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
    large = dataclasses.replace(bare(frame), camera=camera, image=enlarged(frame.image), depth=enlarged(frame.depth), mask=None)
    trainer = trainer_of([large], options(image_width=75, iterations=3))
    assert trainer.cameras[0].width == 75 and finite(trainer.run())


def test_out_of_memory_goes_on_at_half_the_size(views, monkeypatch, caplog):
    trainer = trainer_of(views[::4], options())
    draw, widths = trainer._render, []

    def short_of_memory(viewmats, Ks, size, *arguments):
        widths.append(size[0])
        if size[0] > 80:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return draw(viewmats, Ks, size, *arguments)

    monkeypatch.setattr(trainer, "_render", short_of_memory)
    assert finite(trainer.run()) and trainer.iteration == 12
    assert widths[:2] == [160, 80] and trainer.cameras[0].width == 80
    assert "80 pixels wide" in caplog.text
    tiny = trainer_of([shrink(view, 80) for view in views[::4]], options())
    monkeypatch.setattr(tiny, "_render", lambda *_: (_ for _ in ()).throw(torch.OutOfMemoryError("CUDA out of memory")))
    with pytest.raises(torch.OutOfMemoryError):
        tiny.run()


@pytest.mark.parametrize("name", ["default", "3dgs", "fsgs"])
def test_a_checkpoint_of_any_preset_goes_on_as_if_never_interrupted(views, tmp_path, name):
    make = lambda: trainer_of(views[::4], preset(name, **SHORT), triangulate(views)[:2])
    whole, first = make().run(), make()
    for _ in range(7):
        first.step()
    first.save_checkpoint(tmp_path / "checkpoint.pt")
    second = make()
    second.load_checkpoint(tmp_path / "checkpoint.pt")
    resumed = second.run()
    assert all(torch.equal(a, b) for a, b in zip(resumed.tensors().values(), whole.tensors().values()))
    assert resumed.light == whole.light


# ---------------------------------------------------------------------------------------- surroundings


@pytest.mark.parametrize(("name", "opaque"), [("default", 0.01), ("paper", 0.0)])
def test_transparency_is_weighed_apart_by_default_and_not_as_printed(views, monkeypatch, name, opaque):
    weights = []
    monkeypatch.setattr(losses, "depth_l1", lambda *arguments: weights.append(arguments[-1]) or torch.zeros(()))
    trainer_of(views[:3], preset(name, **SHORT)).step()
    assert weights == [opaque]
