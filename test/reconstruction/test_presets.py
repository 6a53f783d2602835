"""Presets of the trainer, what they are made of, and where they break."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from short_training import SHORT, bare, finite, options
from trained import trainer_of

from endo_sim_ros.core.config import ConfigError, option_values
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.reconstruction import ABLATIONS, PRESETS, ReconstructionConfig, Trainer, losses, prepare, preset
from endo_sim_ros.reconstruction.scene import shrink
from endo_sim_ros.reconstruction.triangulation import triangulate
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence


def quality(model, frames) -> tuple[float, float]:
    """Mean PSNR and gain-fitted PSNR, dB."""
    renderer = DeformableRenderer(model, None, RenderingConfig(device="cpu"))
    pairs = [(renderer.render(frame.camera)[0], frame.image, frame.mask) for frame in frames]
    fitted = [metrics.psnr(metrics.gain_fitted(*pair), *pair[1:]) for pair in pairs]
    return float(np.mean([metrics.psnr(*pair) for pair in pairs])), float(np.mean(fitted))


@pytest.fixture(scope="module")
def points(views):
    """Scene points of the views."""
    return triangulate(views)[:2]


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_trains(views, points, name):
    model = trainer_of(views[::4], preset(name, **SHORT), points).run()
    assert finite(model) and len(model) <= 2000
    assert (model.light is None) == (name not in ("default", "laptop"))


@pytest.mark.parametrize("name", ["3dgs", "fsgs"])
def test_the_originals_have_no_frequency_regularisation(name):
    original, ours = preset(name), preset(f"{name}-sh0")
    assert (original.sh_degree, ours.sh_degree) == (3, 0)
    options = getattr(original, original.densification)
    assert not options.absolute and options.reset_every == 3000


@pytest.mark.slow
def test_spherical_harmonics_rise_and_opacities_fall_as_planned(views, points):
    plan = {"sh_every": 4, "gradient.reset_every": 6, "refine_from": 5, "refine_every": 3, "schedule": 14, "gradient.threshold": 0.0}
    trainer = trainer_of(views[::4], preset("3dgs", **SHORT | {"max_gaussians": 4000} | plan), points)
    learnt, counts, opacities = [], [], []
    while trainer.iteration < 12:
        trainer.step()
        learnt.append([bool(trainer.model.sh[:, k:].any()) for k in (1, 4, 9)])
        counts.append(len(trainer.model))
        opacities.append(float(trainer.model.opacities.max()))
    assert learnt[2] == [False] * 3 and learnt[3] == [True, False, False]  # the fourth iteration has the first degree
    assert learnt[7] == [True, True, False] and learnt[11] == [True] * 3
    assert counts[4] == counts[0] < counts[5], "refinement begins after the fifth iteration"
    assert counts[5] == counts[-1], "and ends before the seventh, the middle of the schedule"
    assert opacities[4] > 0.05 > 0.0101 > opacities[5] and opacities[11] > opacities[5]
    late = trainer_of(
        views[::4], preset("3dgs", **SHORT | {"max_gaussians": 4000} | plan | {"gradient.reset_every": 12, "schedule": 28}), points
    )
    assert late.run().opacities.max() > 0.05, "nothing would rise again after the last iteration"


@pytest.mark.slow
def test_learning_rates_follow_the_schedule_and_the_unit(views, points):
    trainer = trainer_of(views[::4], preset("3dgs", unit="cameras", **SHORT), points)
    positions = np.array([camera.position for camera in trainer.cameras])
    extent = 1.1 * np.linalg.norm(positions - positions.mean(0), axis=1).max()
    trainer.run()
    trainer.step()
    assert trainer.optimizer.rates["means"] == pytest.approx(1.6e-4 * extent * 0.01 ** (12 / 30_000), rel=1e-6)
    for frames, unit in ((views[::4], "depth"), (views[:1], "cameras")):  # one camera has no extent
        other = trainer_of(frames, preset("3dgs", unit=unit, **SHORT), points)
        other.step()
        assert other.optimizer.rates["means"] == pytest.approx(1.6e-4 * other.scene_depth, rel=1e-6)


@pytest.mark.slow
def test_virtual_cameras_begin_and_weigh_as_told(views, points, monkeypatch):
    weights, trained = [], losses.regularized

    def note(loss, terms, rendering, config, virtual=False):
        after = trained(loss, terms, rendering, config, virtual)
        if virtual:
            (term,) = [term for term in terms if term.of_virtual]
            weights.append(((after - loss) / term.weighted(rendering, config)).item())
        return after

    monkeypatch.setattr(losses, "regularized", note)
    trainer = trainer_of(views[:3], preset("fsgs", **SHORT, virtual_from=10), points)
    trainer.run()
    np.testing.assert_allclose(weights, [10.0, 10.0], rtol=1e-3)


def test_every_ablation_changes_its_preset():
    for name, parts in ABLATIONS.items():
        for part, changes in parts.items():
            assert preset(name, **changes) != preset(name), (name, part)


@pytest.mark.slow
def test_the_default_beats_the_paper_on_two_views(views, points):
    ends, rest = [views[0], views[-1]], views[1:-1]
    short = {"iterations": 60, "max_gaussians": 6000, "refine_every": 20, "device": "cpu"}
    paper = quality(trainer_of(ends, preset("paper", **short), points).run(), rest)
    ours = quality(trainer_of(ends, preset("default", **short)).run(), rest)
    assert ours[0] > paper[0] + 1.5 and ours[1] > paper[1] + 1.5


@pytest.mark.slow
@pytest.mark.parametrize("size", [(161, 97), pytest.param((3840, 2160), marks=pytest.mark.thorough)])
def test_odd_and_large_pictures_train(size):
    frame = next(iter(phantom_sequence(PhantomConfig(width=160, height=96, frames=1))))
    camera = frame.camera.resized(*size)
    enlarged = lambda image: cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
    large = dataclasses.replace(bare(frame), camera=camera, image=enlarged(frame.image), depth=enlarged(frame.depth), mask=None)
    trainer = trainer_of([large], options(image_width=75, iterations=3))
    assert trainer.cameras[0].width == 75 and finite(trainer.run())


@pytest.mark.slow
def test_out_of_memory_goes_on_at_half_the_size(views, monkeypatch, caplog):
    trainer = trainer_of(views[::4], options())
    draw, widths = trainer.render, []

    def short_of_memory(viewmats, Ks, size, *arguments, **named):
        widths.append(size[0])
        if size[0] > 80:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return draw(viewmats, Ks, size, *arguments, **named)

    monkeypatch.setattr(trainer, "render", short_of_memory)
    assert finite(trainer.run()) and trainer.iteration == 12
    assert widths[:2] == [160, 80] and trainer.cameras[0].width == 80
    assert "80 pixels wide" in caplog.text
    tiny = trainer_of([shrink(view, 80) for view in views[::4]], options())
    monkeypatch.setattr(tiny, "render", lambda *_, **__: (_ for _ in ()).throw(torch.OutOfMemoryError("CUDA out of memory")))
    with pytest.raises(torch.OutOfMemoryError):
        tiny.run()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["default", "3dgs", "fsgs"])
def test_a_checkpoint_of_any_preset_goes_on_as_if_never_interrupted(views, points, tmp_path, name):
    config = preset(name, **SHORT)
    scene = prepare(views[::4], config, points)
    make = lambda: Trainer(scene, config)
    whole, first = make().run(), make()
    for _ in range(7):
        first.step()
    first.save_checkpoint(tmp_path / "new" / "checkpoint.pt")
    second = make()
    second.load_checkpoint(tmp_path / "new" / "checkpoint.pt")
    assert second.iteration == 7
    resumed = second.run()
    assert all(torch.equal(a, b) for a, b in zip(resumed.tensors().values(), whole.tensors().values()))
    assert resumed.light == whole.light


def test_options_beside_a_preset_count_even_if_they_are_the_defaults():
    config = preset("paper", lambda_tv=0.0, initialization="depth")
    assert (config.initialization, config.lambda_tv, config.light) == ("depth", 0.0, False)
    assert preset("default", lambda_tv=0.0) == ReconstructionConfig()
    with pytest.raises(ConfigError, match="preset must be one of default, .*, got 'nerf'"):
        preset("nerf")
    with pytest.raises(ConfigError, match="has no option preset"):
        preset("paper", preset="3dgs")


@pytest.mark.slow
def test_a_checkpoint_knows_the_options_and_not_the_preset_that_they_came_from(views, points, tmp_path):
    config = preset("paper", lambda_dist=0.0, **SHORT)
    trainer = trainer_of(views[::4], config, points)
    trainer.step()
    trainer.save_checkpoint(tmp_path / "checkpoint.pt")
    spelled_out = trainer_of(views[::4], ReconstructionConfig.from_mapping(option_values(config)), points)
    spelled_out.load_checkpoint(tmp_path / "checkpoint.pt")
    assert spelled_out.iteration == 1
    with pytest.raises(SequenceError, match=r"other options \(lambda_dist\)"):
        trainer_of(views[::4], preset("paper", **SHORT), points).load_checkpoint(tmp_path / "checkpoint.pt")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "opaque"), [("default", 0.01), ("paper", 0.0)])
def test_transparency_is_weighed_apart_by_default_and_not_as_printed(views, monkeypatch, name, opaque):
    weights = []
    monkeypatch.setattr(losses, "depth_l1", lambda *arguments: weights.append(arguments[-1]) or torch.zeros(()))
    trainer_of(views[:3], preset(name, **SHORT)).step()
    assert weights == [opaque]
