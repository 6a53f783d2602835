"""The trials that tell how many Gaussians few views can tell of, and whether depth that one lens tells helps them."""

import dataclasses

import numpy as np
import pytest
import torch
from short_training import bare, options
from training_views import with_prior

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion
from endo_sim_ros.reconstruction import Trainer, capacity_trial, pipeline, prepare
from endo_sim_ros.reconstruction.capacity_trial import choose_capacity
from endo_sim_ros.reconstruction.from_bag import reconstruct_bag
from endo_sim_ros.reconstruction.losses import photometric
from endo_sim_ros.reconstruction.priors.extrapolation import light_ratio
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import PreparedScene
from endo_sim_ros.reconstruction.triangulation import ScenePoints
from endo_sim_ros.sequences.bag import write_bag

QUICK = {"training.min_gaussians": 8000, "capacity.iterations": 250, "capacity.share": 1.0, "capacity.left_out": 0.1}


def undecided(**changes):
    """Options that leave the number of Gaussians to the views."""
    return options(max_gaussians=0, iterations=0, depth="topic", extrapolation=0.0).replaced(QUICK | changes)


@pytest.mark.thorough
@pytest.mark.slow
def test_noise_asks_for_fewer_gaussians_and_clean_pictures_do_not(small_frames):
    """Noise of independent pixels cannot be predicted: whatever memorises it predicts worse."""
    clean, generator = [bare(frame, depth=frame.depth) for frame in small_frames[2:7:4]], np.random.default_rng(0)
    config = undecided(**{"training.min_gaussians": 3000, "seed": 2})  # of five, the one that tells clean pictures by the most, a tenth
    noisy = [
        dataclasses.replace(frame, image=np.clip(frame.image + generator.normal(0, 12, frame.image.shape), 0, 255).astype(np.uint8))
        for frame in clean
    ]
    scene = prepare(clean, config)
    assert (scene.max_gaussians, scene.fading) == (3000, 1.0)
    scene = prepare(noisy, config)
    assert (scene.max_gaussians, scene.fading) == (1200, 3.0)
    (tried,) = [sentence for sentence in scene.decisions if "left-out pixels" in sentence]
    assert "1200 Gaussians at most, weight of fading × 3" in tried


@pytest.mark.thorough
@pytest.mark.slow
def test_a_trial_is_made_of_tissue_that_moves_in_its_mean_position_and_in_the_light_of_the_whole_views(small, monkeypatch):
    judged = []
    monkeypatch.setattr(pipeline, "light_ratio", lambda *given: judged.append(light_ratio(*given)) or judged[-1])
    frames = [bare(frame, depth=frame.depth) for frame in small[:2]]
    camera = frames[0].camera
    points = (frames[0].depth[..., None] * camera.rays())[::16, ::16].reshape(-1, 3) @ camera.pose[:3, :3].T + camera.position
    breath = PeriodicMotion("breathing", 4.0, 1.0, 3.0, np.full((2, 3), 1e-4), np.ones(len(points)))
    scene = prepare(frames, undecided(**{"capacity.iterations": 2}), motion=TissueMotion(0.0, points, (breath,)))
    assert any("loss of left-out pixels" in decision for decision in scene.decisions) and len(judged) == 1


@pytest.mark.thorough
@pytest.mark.slow
def test_what_is_given_or_told_by_many_pixels_is_not_tried(small):
    frames = [bare(frame, depth=frame.depth) for frame in small[:2]]
    for changes in ({"max_gaussians": 900}, {"capacity.iterations": 0}, {"training.min_gaussians": 100}):
        stages = {}
        scene = prepare(frames, undecided(**changes), on_progress=lambda stage, done, total: stages.update({stage: total}))
        assert scene.fading == 1.0 and not stages["capacity trial"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"capacity.block": 100, "capacity.share": 0.5, "capacity.left_out": 0.5}, "middle"),  # all of it is left out, or nothing
        ({"training.min_gaussians": 600, "capacity.fewer": 0.01}, "leaves"),
    ],
)
def test_a_trial_that_cannot_be_made_leaves_the_scene_as_it_is(small, changes, reason):
    frames = [bare(frame, depth=frame.depth) for frame in small[:1]]
    for seed in range(2):
        scene = prepare(frames, undecided(seed=seed, **{"capacity.iterations": 1} | changes))
        assert (scene.max_gaussians, scene.fading) == (changes.get("training.min_gaussians", 8000), 1.0)
        (sentence,) = [sentence for sentence in scene.decisions if "no trial" in sentence]
        assert reason in sentence


@pytest.mark.slow
def test_a_trial_that_runs_out_of_memory_is_left_out(small, monkeypatch):
    def step(_):
        raise torch.OutOfMemoryError("out of memory")

    monkeypatch.setattr(Trainer, "step", step)
    scene = prepare([bare(frame, depth=frame.depth) for frame in small[:2]], undecided())
    assert scene.max_gaussians == 8000 and "no trial of fewer Gaussians: out of memory" in scene.decisions


@pytest.mark.slow
def test_training_goes_on_with_what_was_decided_when_it_began(small, tmp_path):
    config = undecided(**{"capacity.iterations": 0})
    scene = prepare([bare(frame, depth=frame.depth) for frame in small[:2]], config)
    first = Trainer(dataclasses.replace(scene, max_gaussians=3000, fading=3.0), config)
    for _ in range(3):
        first.step()
    first.save_checkpoint(tmp_path / "begun.ckpt")
    second = Trainer(dataclasses.replace(scene, model=first.model), config)
    second.load_checkpoint(tmp_path / "begun.ckpt")
    for trainer in (first, second):
        for _ in range(3):
            trainer.step()
    assert all(torch.equal(a, b) for a, b in zip(first.model.tensors().values(), second.model.tensors().values()))


@pytest.fixture(scope="module")
def told(small):
    """Three views whose depth is said to be from points, although it is exact, and scene points that are exact."""
    frames = [bare(frame, depth=frame.depth) for frame in small[:9:4]]
    scene = prepare(frames, undecided(max_gaussians=3000, **{"capacity.iterations": 0}))
    depth = small[4].depth
    assert depth is not None
    positions = frames[1].camera.backproject(depth)[::4, ::4].reshape(-1, 3)
    points = ScenePoints(positions, frames[1].image[::4, ::4].reshape(-1, 3), *ScenePoints.none()[2:])
    return dataclasses.replace(scene, depth_source="points", points=points)


@pytest.mark.slow
@pytest.mark.parametrize("times, kept", [(1.0, True), pytest.param(4.0, False, marks=pytest.mark.thorough)])
def test_depth_of_one_lens_is_kept_if_left_out_pixels_speak_for_it(told, times, kept):
    views = tuple(dataclasses.replace(view, depth=None, depth_prior=times * view.surface) for view in told.views)
    short = undecided(max_gaussians=3000, **{"capacity.iterations": 40})
    scene = pipeline.try_points(dataclasses.replace(told, views=views), short, StageProgress())
    assert ("depth is kept" in scene.decisions[-1]) == kept
    assert ("training starts from scene points, without depth and light" in scene.decisions[-1]) != kept
    if kept:
        assert scene.views is views and scene.model is told.model and not scene.without_depth
    else:
        assert not any(view.surface.any() for view in scene.views) and scene.without_depth
        assert len(scene.model) == len(told.points.positions)
        trainer = Trainer(scene, undecided(max_gaussians=3000))
        trainer.step()
        assert told.light[0] != 0 and max(trainer.light.distance, trainer.light.angle) < 1e-9, "it falls with depth, which is not trained"
        assert not np.array_equal(scene.exposures, told.exposures), "exposures were told beside that light"
        given = dataclasses.replace(told, views=views[:2], without_depth=True)  # as a checkpoint says
        given = pipeline.try_points(given, undecided(max_gaussians=3000, exposure=False), StageProgress())
        assert not given.light.any() and not any(view.surface.any() for view in given.views)
        assert pipeline.extrapolate_tissue(scene, undecided(extrapolation=0.3), StageProgress()) is scene


def test_depth_is_not_tried_that_is_known_nor_with_two_views(told, monkeypatch):
    monkeypatch.setattr(pipeline, "choose_start", lambda *_: pytest.fail("it is tried"))
    two = dataclasses.replace(told, views=told.views[:2])
    known, pointless = dataclasses.replace(told, depth_source="stereo"), dataclasses.replace(told, points=ScenePoints.none())
    for scene in (two, known, pointless):
        assert pipeline.try_points(scene, undecided(), StageProgress()) is scene
    for name in ("capacity.iterations", "capacity.without_depth"):
        assert pipeline.try_points(told, undecided(**{name: 0}), StageProgress()) is told


@pytest.mark.slow
def test_a_checkpoint_of_a_training_without_depth_is_not_gone_on_with_in_one_with_depth(told, tmp_path):
    config = undecided(max_gaussians=3000)
    Trainer(dataclasses.replace(told, without_depth=True), config).save_checkpoint(tmp_path / "plain.ckpt")
    with pytest.raises(SequenceError, match="plain.ckpt: training began without depth; prepare views so, or start anew"):
        Trainer(told, config).load_checkpoint(tmp_path / "plain.ckpt")


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("first", ["plain", "with depth"])
def test_a_reconstruction_goes_on_without_depth_or_with_it_as_it_began(small, tmp_path, monkeypatch, first):
    write_bag(tmp_path / "bag", [bare(frame) for frame in small[:9:2]])
    config = undecided(max_gaussians=1000, depth="auto").replaced({"iterations": 40, "keyframes": 4, "capacity.iterations": 1})

    def decide(losses):
        monkeypatch.setattr(capacity_trial, "_left_out_losses", lambda *_: losses)

    decide((1.0, 0.1) if first == "plain" else (1.0, 1.0))
    begun = reconstruct_bag(tmp_path / "bag", tmp_path, config)[0]
    decide((1.0, 1.0) if first == "plain" else (1.0, 0.1))
    ended = reconstruct_bag(tmp_path / "bag", tmp_path, config, resume=True)[0]
    assert all(torch.equal(a, b) for a, b in zip(begun.model.tensors().values(), ended.model.tensors().values()))


def test_trials_see_the_middle_of_the_views_without_the_left_out_blocks(small):
    views, given = with_prior(small[:2]), []
    scene = PreparedScene((), tuple(views), max_gaussians=4000, iterations=900)

    class Seen(Exception):
        pass

    def start(trial):
        given.append(trial)
        raise Seen

    config = undecided(**{"capacity.share": 0.5, "capacity.left_out": 0.3, "capacity.block": 4})
    with pytest.raises(Seen):
        choose_capacity(scene, config, start, StageProgress())
    (trial,) = given
    assert (trial.max_gaussians, trial.iterations) == (1000, 250)
    for view, whole in zip(trial.views, views):
        assert (view.image == whole.image[32:96, 40:120]).all() and (view.depth_prior == whole.depth_prior[32:96, 40:120]).all()
        points = whole.camera.backproject(whole.depth_prior).reshape(-1, 3)
        assert np.allclose(view.camera.project(points)[0] + (40, 32), whole.camera.project(points)[0])
        blocks = (view.mask == 0).reshape(16, 4, 20, 4).swapaxes(1, 2)
        assert (blocks.all((2, 3)) == blocks.any((2, 3))).all()  # whole blocks, as all is tissue
        assert 0.2 < blocks.mean() < 0.4


def test_the_error_of_pixels_is_the_loss_of_training(small):
    config = options(iterations=3, extrapolation=0.0, depth="topic", lambda_depth=0.0, light=False, exposure=False)
    trainer = Trainer(prepare([bare(frame, depth=frame.depth) for frame in small[:3]], config), config)
    trainer.run()
    losses = []
    for camera, frame in zip(trainer.cameras, small):
        viewmats, Ks = (torch.tensor(matrix, dtype=torch.float32)[None] for matrix in (camera.viewmat, camera.K))
        image = trainer.render(viewmats, Ks, (camera.width, camera.height))[1].colors[0].detach()
        losses.append(float(photometric(image, torch.tensor(frame.image) / 255, None, config.lambda_ssim)))
    everything = np.ones((128, 160), bool)
    assert trainer.photometric_error([everything] * 3) == pytest.approx(np.mean(losses), rel=1e-5)
    one = np.zeros_like(everything)
    one[60:70, 60:70] = True
    assert trainer.photometric_error([one] * 3) != pytest.approx(np.mean(losses), rel=1e-3)
