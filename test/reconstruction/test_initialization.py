"""The initial model: on the surface, within limits, without what floats."""

import dataclasses

import numpy as np
import torch
from short_training import NO_POINTS, options
from trained import trainer_of

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction import ReconstructionConfig, losses
from endo_sim_ros.reconstruction.initialization import initial_model
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence


def test_initial_model_lies_on_the_surface_within_the_limit(small):
    model = initial_model(list(small[::4]), *NO_POINTS[:2], options(max_gaussians=3000))
    assert 2000 < len(model) <= 3000
    errors = []
    for frame in small[::4]:
        uv, z = frame.camera.project(model.means.numpy().astype(np.float64))
        u, v = np.floor(uv).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < 160) & (v < 128) & (z > 0)
        # Never in front of what a view sees by more than the tolerance.
        assert (z[inside] > frame.depth[v[inside], u[inside]] * 0.949).all()
        errors.append(np.abs(z[inside] / frame.depth[v[inside], u[inside]] - 1))
    assert np.median(np.concatenate(errors)) < 0.01


def test_depth_floating_in_front_of_another_view_is_left_out(small):
    first, second = small[0], small[4]
    depth = first.depth.copy()
    depth[50:70, 60:90] *= 0.6  # a floating patch
    model = initial_model([dataclasses.replace(first, depth=depth), second], *NO_POINTS[:2], options(max_gaussians=50_000))
    uv, z = second.camera.project(model.means.numpy().astype(np.float64))
    u, v = np.floor(uv).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < 160) & (v < 128)
    assert (z[inside] > 0.94 * second.depth[v[inside], u[inside]]).all()
    alone = initial_model([dataclasses.replace(first, depth=depth)], *NO_POINTS[:2], options(max_gaussians=50_000))
    assert float(alone.means[:, 2].min()) < 0.7 * first.depth.min() + first.camera.position[2]


def test_masked_pixels_give_no_gaussians(small):
    mask = np.zeros_like(small[0].mask)
    mask[:, :80] = 255
    model = initial_model([dataclasses.replace(small[0], mask=mask)], *NO_POINTS[:2], options())
    uv, _ = small[0].camera.project(model.means.numpy().astype(np.float64))
    assert uv[:, 0].max() < 80


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


def test_points_that_float_before_the_surface_or_before_a_hole_of_it_do_not_become_gaussians(small):
    frame, camera = small[0], small[0].camera
    depth = frame.depth.copy()
    row, column = camera.height // 2, camera.width // 2
    true = float(depth[row, column])
    depth[row - 10 : row + 11, column - 10 : column + 11] = 0  # a highlight: no depth there
    ray = camera.backproject(np.ones_like(depth))[row, column] - camera.position
    points = camera.position + ray * np.array([[0.5 * true], [true], [0.98 * true]])
    points = np.concatenate([points, points + 1e-4])
    views = [dataclasses.replace(frame, depth=depth)]
    model = initial_model(views, points, np.full((6, 3), 0.5), options(max_gaussians=50_000))
    z = camera.project(model.means.double().numpy())[1]
    assert z.min() > 0.9 * frame.depth[frame.depth > 0].min()
    near = np.linalg.norm(model.means.double().numpy()[:, None] - points, axis=2).min(0)
    assert (near[[1, 2, 4, 5]] < 1e-6).all() and (near[[0, 3]] > 0.01).all()
