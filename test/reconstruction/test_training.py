"""Short trainings on the phantom: quality, repeatability, checkpoints."""

import dataclasses
import logging
import resource
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from short_training import bare, equal, options
from thorough import mostly_thorough
from trained import trainer_of

from endo_sim_ros.core import drawing
from endo_sim_ros.core.cameras import load_cameras
from endo_sim_ros.core.folders import written_whole
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import load_ply, save_ply
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.held_out import measure_held_out
from endo_sim_ros.reconstruction import Trainer, checkpoint, from_bag, prepare
from endo_sim_ros.reconstruction.from_bag import reconstruct_bag
from endo_sim_ros.reconstruction.optimizer import Adam
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.bag import write_bag
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence


def held_out(model, frames):
    """Mean PSNR (dB) and depth error (m) over frames."""
    renderer = DeformableRenderer(model, None, RenderingConfig(device="cpu"))
    rows = []
    for frame in frames:
        image, depth = renderer.render(frame.camera)
        rows.append([metrics.psnr(image, frame.image), metrics.depth_rmse(depth, frame.depth)])
    return np.mean(rows, 0)


@pytest.mark.slow
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


@pytest.mark.slow
def test_virtual_camera_lies_between_two_views(small, monkeypatch):
    trainer = trainer_of([small[0], small[4]], options(virtual_every=1))
    first, second = (small[i].camera.position for i in (0, 4))
    seen = []
    draw = trainer.render

    def spy(viewmats, *arguments):
        seen.extend(viewmats.double().inverse()[:, :3, 3].numpy())
        return draw(viewmats, *arguments)

    monkeypatch.setattr(trainer, "render", spy)
    for _ in range(3):
        trainer.step()
    virtual = seen[1::2]
    assert len(virtual) == 3
    for position in virtual:
        alpha = np.dot(position - first, second - first) / np.dot(second - first, second - first)
        assert 0 < alpha < 1
        np.testing.assert_allclose(position, (1 - alpha) * first + alpha * second, atol=1e-7)


@pytest.mark.slow
def test_dropout_rises_with_the_iterations_and_ends_before_the_last_ones(small, monkeypatch):
    trainer = trainer_of([small[0], small[4]], options(iterations=10, refine_until=0.8, dropout=0.5))
    factors, render = [], trainer.render
    monkeypatch.setattr(trainer, "render", lambda *given: factors.append(given[5].clone()) or render(*given))
    while trainer.iteration < trainer.iterations:
        trainer.step()
    shares = np.array([0.05 * iteration if iteration < 8 else 0 for iteration in range(10)])
    np.testing.assert_allclose([float((kept == 0).float().mean()) for kept in factors], shares, atol=0.04)
    np.testing.assert_allclose([float(kept.max()) for kept in factors], 1 / (1 - shares), rtol=1e-6)


@pytest.mark.slow
def test_training_improves_views_it_has_not_seen(small):
    training, rest = [small[i] for i in (0, 2, 4, 6)], [small[i] for i in (1, 3, 5)]
    noisy = [dataclasses.replace(f, depth=f.depth * np.float32(1.03 if i % 2 else 0.97)) for i, f in enumerate(training)]
    trainer = trainer_of(noisy, options(iterations=45, max_gaussians=4000, refine_every=15))
    psnr, _ = held_out(trainer.model, rest)
    given_error = 0.03 * np.mean([np.sqrt(np.mean(f.depth[f.depth > 0] ** 2)) for f in training])
    reports = []
    model = trainer.run(lambda progress: reports.append(progress), every=15)
    trained_psnr, trained_error = held_out(model, rest)
    assert trained_psnr > psnr + 2.5
    assert trained_error < 0.85 * given_error
    assert [report.iteration for report in reports] == [15, 30, 45]
    assert reports[-1].gaussians == len(model) <= 4000


@pytest.mark.slow
@pytest.mark.parametrize("source, weight", [("topic", 1.0), ("stereo", 0.1), ("network", 0.1), ("points", 0.1)])
def test_depth_that_was_not_recorded_weighs_a_tenth(small, source, weight):
    scene = prepare([bare(small[0], depth=small[0].depth)], options(depth="topic", iterations=1))
    wrong = tuple(dataclasses.replace(view, depth_prior=np.float32(1.1) * view.depth_prior) for view in scene.views)

    def loss(source, **changes):
        reports = []
        wrong_scene = dataclasses.replace(scene, views=wrong, depth_source=source)
        Trainer(wrong_scene, options(depth="topic", iterations=1, **changes)).run(reports.append, every=1)
        return reports[0].loss

    without, whole = loss(source, lambda_depth=0.0), loss(source, unmeasured_depth=1.0)
    assert whole - without > 0.05
    assert loss(source) - without == pytest.approx(weight * (whole - without), rel=1e-3)


@pytest.mark.thorough
@pytest.mark.slow
def test_what_no_view_shows_keeps_its_colour(small):
    """Its rims reach into the pictures, which tell next to nothing of it."""
    mask = np.full(small[0].image.shape[:2], 255, np.uint8)
    mask[:, :40] = 0
    frames = [bare(frame, depth=frame.depth, mask=mask) for frame in small[:3:2]]
    config = options(depth="topic", iterations=30, refine_every=100, max_gaussians=8000)
    scene = prepare(frames, config)
    model = Trainer(scene, config).run()
    unseen = ~np.any([_in_mask(frame, scene.model.means.numpy()) for frame in frames], 0)
    changed = (model.sh != scene.model.sh).flatten(1).any(1).numpy()
    assert unseen.sum() > 100 and not changed[unseen].any() and changed[~unseen].mean() > 0.5


def _in_mask(frame, points):
    uv, z = frame.camera.project(points.astype(np.float64))
    inside = frame.camera.contains(uv, z)
    columns, rows = np.floor(np.where(inside[:, None], uv, 0)).astype(int).T
    return inside & (frame.mask[rows, columns] > 0)


@pytest.mark.slow
def test_progress_can_stop_the_training(small):
    trainer = trainer_of([small[0]], options())
    trainer.run(lambda progress: False, every=2)
    assert trainer.iteration == 2


@pytest.mark.thorough
@pytest.mark.slow
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


@pytest.mark.slow
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
    with pytest.raises(SequenceError, match="there is no such checkpoint to go on from"):
        trainer.load_checkpoint(tmp_path / "absent.pt")


@pytest.mark.slow
def test_higher_harmonics_are_trained(small):
    model = trainer_of([small[0], small[8]], options(sh_degree=3)).run()
    assert model.sh_degree == 3
    assert model.sh[:, 1:].abs().max() > 0


@pytest.mark.slow
def test_reconstruction_of_a_bag_is_measured(tmp_path, small):
    write_bag(tmp_path / "bag", small)
    found = measure_held_out(*reconstruct_bag(tmp_path / "bag", tmp_path / "out", options(keyframes=4, image_width=80)), tmp_path / "out")
    assert found["held_out_views"] == 5
    assert found["psnr"] > 15
    assert found["depth_rmse"] < 0.010
    for name in ("model.ply", "checkpoint.pt", "held_out.png"):
        assert (tmp_path / "out" / name).stat().st_size > 0


def test_motion_of_an_earlier_model_goes_with_it(tmp_path, small):
    model = trainer_of([small[0]], options()).model
    (tmp_path / "motion.yaml").write_text("physics_node: {}")
    (tmp_path / "motion.npz").write_bytes(b"")
    from_bag._save(model, [small[0].camera], None, tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["cameras.json", "model.ply"]


@pytest.mark.slow
@pytest.mark.parametrize("room", mostly_thorough(["elsewhere", "nowhere"]))
def test_a_full_disk_loses_no_trained_model(tmp_path, small, room, monkeypatch, caplog):
    out, other = tmp_path / "out", tmp_path / "other"
    other.mkdir()
    save = from_bag.save_ply

    def full(model, path):
        if out in path.parents or room == "nowhere":
            raise OSError(28, "No space left on device")
        save(model, path)

    def no_checkpoint(self, path):
        raise OSError(f"{path}: the checkpoint cannot be written")

    monkeypatch.setattr(from_bag, "save_ply", full)
    monkeypatch.setattr(Trainer, "save_checkpoint", no_checkpoint)
    monkeypatch.setattr(tempfile, "tempdir", str(other))
    write_bag(tmp_path / "bag", small)
    with pytest.raises(RuntimeError, match=r"out: the model cannot be saved there \(No space left on device\)") as caught:
        reconstruct_bag(tmp_path / "bag", out, options(iterations=20, keyframes=4, image_width=80))
    assert "out/checkpoint.pt: the checkpoint cannot be written" in caplog.text  # the training went on
    if room == "elsewhere":
        folder = Path(str(caught.value).split("it is in ")[1])
        assert folder.parent == other and len(load_ply(folder / "model.ply")) and load_cameras(folder / "cameras.json")
    else:
        assert "start again with --resume" in str(caught.value) and not list(other.iterdir())


@pytest.mark.thorough
@pytest.mark.slow
def test_a_disk_with_room_for_the_model_alone_tells_its_figures(tmp_path, small, caplog):
    out = tmp_path / "out"
    out.mkdir()

    def fill(path):  # what is written until a file is whole
        (out / f"{path.name}.part").symlink_to("/dev/full")
        return written_whole(path)

    write_bag(tmp_path / "bag", small)
    with (
        caplog.at_level(logging.INFO),
        mock.patch.object(checkpoint, "written_whole", fill),
        mock.patch.object(drawing, "written_whole", fill),
    ):
        trainer, frames = reconstruct_bag(tmp_path / "bag", out, options(iterations=60, keyframes=4, image_width=80))
        (out / "held_out.png").write_text("of an earlier model")
        found = measure_held_out(trainer, frames, out)
    assert found["psnr"] > 10 and any(line.startswith("PSNR [dB]") for line in caplog.messages)
    assert f"{out / 'model.ply'}: {len(trainer.model)} Gaussians" in caplog.messages
    assert [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING] == [
        f"{out / 'checkpoint.pt'}: the checkpoint cannot be written (is the disk full?); --resume needs it, the model does not",
        f"{out / 'held_out.png'}: the picture cannot be written: the disk is full; the model is kept",
    ]
    assert sorted(file.name for file in out.iterdir()) == ["cameras.json", "model.ply"]


def test_what_found_no_room_leaves_nothing_behind(tmp_path, small):
    trainer, limits = trainer_of([small[0], small[8]], options()), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))
    try:
        with pytest.raises(OSError, match="checkpoint.pt: the checkpoint cannot be written"):
            trainer.save_checkpoint(tmp_path / "checkpoint.pt")
        with pytest.raises(OSError, match="File too large"):
            save_ply(trainer.model, tmp_path / "model.ply")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


@pytest.mark.thorough
@pytest.mark.slow
def test_no_gaussian_outgrows_the_scene():
    frames = list(phantom_sequence(PhantomConfig(frames=4, width=96, height=80, border=0.1)))
    trainer = trainer_of(frames, options(iterations=60, max_gaussians=1000, refine_every=100, learning_rate=5.0))
    trainer.run()
    assert trainer.model.scales.max() <= 0.06 * trainer.scene_depth * 1.001
