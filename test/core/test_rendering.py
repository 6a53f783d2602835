"""A model that follows its nodes."""

import numpy as np
import pytest
import torch

from endo_sim_ros.core.cameras import Camera, make_pose
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig

CAMERA = Camera(np.array([[120.0, 0, 48], [0, 120, 40], [0, 0, 1]]), 96, 80)
CPU = RenderingConfig(device="cpu")


def sheet(degree=0):
    g = torch.Generator().manual_seed(0)
    xy = torch.rand(4000, 2, generator=g) * 0.1 - 0.05
    points = torch.cat([xy, 0.1 + 0.01 * torch.rand(4000, 1, generator=g)], 1)  # distinct depths: one order
    model = GaussianModel.from_points(points, torch.rand(4000, 3, generator=g), torch.full((4000,), 1.5e-3), 0.9, degree)
    if degree:
        model.sh[:, 1:] = 0.3 * torch.randn(model.sh[:, 1:].shape, generator=g)
    return model


NODES = sheet().means[::10].numpy()
IDENTITY = np.tile(np.eye(3, dtype=np.float32), (len(NODES), 1, 1))


def test_nodes_at_rest_change_nothing():
    renderer = DeformableRenderer(sheet(), NODES, CPU)
    image, depth = renderer.render(CAMERA)
    same, same_depth = renderer.render(CAMERA, NODES, IDENTITY)
    assert np.abs(image.astype(int) - same).max() <= 1
    np.testing.assert_allclose(depth, same_depth, atol=1e-5)
    assert depth[40, 48] == pytest.approx(0.1, abs=1e-2) and image.std() > 10


@pytest.mark.parametrize("degree", [0, 2])
def test_moving_all_nodes_rigidly_is_moving_the_camera_back(degree):
    motion = make_pose([0.004, -0.003, 0.01], [1, 0.03, -0.02, 0.05])
    renderer = DeformableRenderer(sheet(degree), NODES, CPU)
    positions = (NODES @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32)
    F = np.tile(motion[:3, :3].astype(np.float32), (len(NODES), 1, 1))
    moved, _ = renderer.render(CAMERA.at(motion), positions, F)
    rest, _ = renderer.render(CAMERA)
    assert np.abs(moved.astype(int) - rest).mean() < 0.2
    unmoved, _ = renderer.render(CAMERA, positions, F)
    assert np.abs(unmoved.astype(int) - rest).mean() > 3


def test_the_clamp_of_stretches_matters_to_wild_tissue_alone():
    model = sheet()
    rest = model.means[::5].numpy()
    pictures = {}
    for clamp in (True, False):
        renderer = DeformableRenderer(model, rest, RenderingConfig(device="cpu", clamp_stretch=clamp))
        for stretch in (1.5, 9.0):
            F = np.tile(np.diag([stretch, 1.0, 1.0]), (len(rest), 1, 1))
            pictures[stretch, clamp] = renderer.deform(rest, F)[1]
    assert torch.equal(pictures[1.5, True], pictures[1.5, False])
    assert pictures[9.0, False].amax() > 4 * pictures[9.0, True].amax()


def test_background_and_empty_pixels():
    renderer = DeformableRenderer(sheet(), None, RenderingConfig(device="cpu", background=0.5))
    image, depth = renderer.render(CAMERA.at(make_pose([0, 0, 0], [0, 0, 1, 0])))  # looking away
    assert (image == 128).all() and not depth.any()


def test_width_sets_the_size_and_keeps_the_shape():
    renderer = DeformableRenderer(sheet(), None, RenderingConfig(device="cpu", image_width=48))
    image, _ = renderer.render(renderer.camera(CAMERA))
    assert image.shape == (40, 48, 3)
