"""Cameras beside the training views, which must see the tissue as those do."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from short_training import bare, options
from trained import trainer_of

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix, look_at
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.reconstruction import ReconstructionConfig, Trainer, capacity_trial
from endo_sim_ros.reconstruction.device_views import carried
from endo_sim_ros.reconstruction.presets import PRESETS, preset
from endo_sim_ros.reconstruction.stage_configs import GlossConfig, TiltedConfig
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence, render_phantom


def test_a_picture_is_carried_to_where_another_camera_sees_the_same_tissue():
    K = intrinsic_matrix(120.0, 110.0, 41.0, 30.0)
    first = Camera(K, 80, 64, look_at((0.01, 0.0, 0.0), (0.0, 0.0, 0.1)))
    second = first.at(look_at((-0.03, 0.02, 0.01), (0.0, 0.0, 0.1)))
    slope = np.array([0.3, -0.2])  # of a plane z = 0.1 + slope · (x, y)
    painted = lambda x: np.stack([np.sin(90 * x[..., 0]), np.cos(70 * x[..., 1])])

    def filmed(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Depth [H, W] and points [H, W, 3] of the plane."""
        rays = camera.rays() @ camera.pose[:3, :3].T
        height = 0.1 + slope @ camera.position[:2] - camera.position[2]
        depth = height / (rays[..., 2] - rays[..., :2] @ slope)
        return depth, camera.position + depth[..., None] * rays

    picture, (depth, points) = painted(filmed(first)[1]), filmed(second)
    tensor = lambda array: torch.from_numpy(np.asarray(array, np.float32))
    found, z = carried(tensor(picture), tensor(K), tensor(first.viewmat @ second.pose), tensor(depth))
    uv, true_z = first.project(points.reshape(-1, 3))
    inside = ((uv > 1) & (uv < [79, 63])).all(1).reshape(64, 80)
    assert 0.3 < inside.mean() < 0.95
    np.testing.assert_allclose(z, true_z.reshape(64, 80), rtol=1e-5)
    np.testing.assert_allclose(found.numpy()[:, inside], painted(points)[:, inside], atol=2e-3)
    far = ((uv < -1) | (uv > [81, 65])).any(1).reshape(64, 80)
    assert not found.numpy()[:, far].any()


def test_they_look_at_the_middle_of_the_picture_from_all_sides(small):
    trainer = trainer_of([small[0], small[4]], options(tilted=TiltedConfig(angle=30.0)))
    camera = trainer.cameras[0]
    middle = camera.pose @ [0.0, 0.0, trainer.scene_depth, 1.0]
    ways = []
    for _ in range(300):
        tilted = trainer._tilted_camera(camera)
        np.testing.assert_allclose(tilted.viewmat @ middle, [0.0, 0.0, trainer.scene_depth, 1.0], atol=1e-9)
        ways.append(camera.pose[:3, :3].T @ tilted.pose[:3, 2])
    ways = np.array(ways)
    angles = np.degrees(np.arccos(ways[:, 2].clip(-1, 1)))
    assert angles.max() < 30.0 + 1e-6
    np.testing.assert_allclose(angles.mean(), 20.0, atol=1.5)  # of a disc's points two thirds of the radius
    assert np.abs(ways[:, :2].mean(0)).max() < 0.05


def second_cameras(trainer, monkeypatch, iterations: int = 8) -> list[int]:
    """Which iterations draw a second camera."""
    drawn, render = [], trainer.render
    monkeypatch.setattr(trainer, "render", lambda viewmats, *given: drawn.append(len(viewmats)) or render(viewmats, *given))
    for _ in range(iterations):
        trainer.step()
    return [iteration for iteration, cameras in enumerate(drawn) if cameras == 2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "due"),
    [
        ({}, [0, 4]),
        pytest.param({"tilted": TiltedConfig(every=3)}, [0, 3, 6], marks=pytest.mark.thorough),
        ({"tilted": TiltedConfig(every=1), "refine_until": 0.25}, [0, 1, 2]),  # of twelve iterations, so that the others settle
        ({"tilted": TiltedConfig(every=0)}, []),
        ({"sh_degree": 1, "reflections": False}, []),
        ({"depth": "none", "initialization": "points"}, []),
    ],
)
def test_they_come_as_often_as_told_where_there_is_depth(small, monkeypatch, changes, due):
    frames = [small[0], small[4]]
    if changes.get("depth") == "none":
        frames = [bare(frame) for frame in frames]
    assert second_cameras(trainer_of(frames, options(**changes)), monkeypatch) == due


@pytest.mark.slow
def test_one_view_has_them_too(small, monkeypatch):
    assert second_cameras(trainer_of([small[0]], options()), monkeypatch) == [0, 4]


@pytest.mark.slow
def test_trials_of_how_many_gaussians_have_none(small, monkeypatch):
    trials = []
    monkeypatch.setattr(capacity_trial, "Trainer", lambda scene, config: trials.append(config) or Trainer(scene, config))
    trainer = trainer_of([small[0], small[4]], options(max_gaussians=0, tilted=TiltedConfig(every=1)))
    assert [config.tilted.every for config in trials] == [0, 0]
    assert trainer.config.tilted.every == 1


def test_published_methods_have_none():
    assert not [name for name in PRESETS if name not in ("default", "laptop") and preset(name).tilted.every]
    assert ReconstructionConfig().tilted.every


@pytest.mark.thorough
@pytest.mark.slow
def test_tissue_looks_as_it_is_from_where_no_view_was():
    patient = PhantomConfig(seed=3, frames=7, width=96, height=80, rounds=0.5)
    film = list(phantom_sequence(patient))

    def from_aside(every: int) -> float:
        """Mean PSNR, dB, of pictures up to 20° beside a view."""
        tilted = TiltedConfig(every=every, weight=1.0)
        changes = {"iterations": 100, "max_gaussians": 4000, "refine_every": 20, "reflections": False}
        trainer = trainer_of([film[0], film[3], film[6]], options(tilted=tilted, **changes))
        renderer = DeformableRenderer(trainer.run(), None, RenderingConfig(device="cpu"))
        trainer._generator.manual_seed(1)
        cameras = [trainer._tilted_camera(film[3].camera) for _ in range(8)]
        return float(np.mean([metrics.psnr(renderer.render(camera)[0], render_phantom(patient, camera)[0]) for camera in cameras]))

    assert from_aside(1) > from_aside(0) + 0.4


def tilted_loss(trainer) -> torch.Tensor:
    """The loss of a tilted camera of the first view, the same one each time."""
    trainer._generator.manual_seed(0)
    view = trainer._device_views[0]
    inputs = trainer._inputs(view, None, trainer._tilted_camera(view.camera))
    output, plain = trainer.render(inputs.viewmats, inputs.Ks, (view.camera.width, view.camera.height))[1:]
    _, gain = trainer._exposed(output, inputs.rays, inputs.exposure)
    return trainer._tilted_loss(inputs, output, plain, gain)


@pytest.mark.slow
def test_what_masks_hide_and_what_is_white_tells_nothing(small):
    rows, columns = slice(40, 60), slice(60, 90)
    mask = np.full((128, 160), 255, np.uint8)
    mask[rows, columns] = 0
    trainer = trainer_of([dataclasses.replace(small[0], mask=mask)], options(reflections=False, dynamic_mask=False))
    view, loss = trainer._device_views[0], lambda: float(tilted_loss(trainer).detach())
    before = loss()
    view.image[rows, columns] = 0.5
    assert math.isclose(loss(), before, rel_tol=1e-6)
    view.image[70:80, 60:90] = 0.5
    assert not math.isclose(loss(), before, rel_tol=1e-3)
    view.image[70:80, 60:90] = 1.0
    white = loss()
    view.image[70:80, 60:90] = 0.99
    assert math.isclose(loss(), white, rel_tol=1e-6)


@pytest.mark.slow
def test_what_is_nowhere_near_the_depth_prior_tells_nothing_and_little_counts_little(small):
    trainer = trainer_of([small[0]], options(reflections=False))
    prior = trainer._device_views[0].prior
    whole = tilted_loss(trainer)
    prior[:, 8:] = 0
    assert 0 < float(tilted_loss(trainer).detach()) < 0.15 * float(whole.detach())
    prior[:] = 0.3  # 0.14 m is right
    assert not tilted_loss(trainer).detach()


@pytest.mark.slow
def test_what_glints_tells_nothing_and_neither_light_nor_films_are_moved(small):
    trainer = trainer_of([small[0], small[4]], options(gloss=GlossConfig(most_turning=1e6)))
    gloss, eye = trainer.parameters["gloss"], torch.from_numpy(trainer.cameras[0].position).float()
    with torch.no_grad():
        gloss[:, 3:6] = eye - trainer.parameters["means"]
        gloss[:, 7] = -20.0
    loss = tilted_loss(trainer)
    learnt = [gloss, trainer.parameters["sh_base"], trainer.appearance.tensors["light"]]
    of_gloss, of_colors, of_light = torch.autograd.grad(loss, learnt, allow_unused=True)
    assert float(loss.detach()) > 0 and of_colors.any() and of_light is None
    assert not of_gloss[:, 3:6].any() and not of_gloss[:, 7].any()
    with torch.no_grad():
        gloss[:, 7] = 1.0
    assert not tilted_loss(trainer).detach()
