"""Control nodes: sampled from the model, given volume, a rim and depth, carved where cameras see through."""

import dataclasses

import numpy as np
import pytest
import torch
from tissue_scene import EYE, curved_sheet, pose_at

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.physics import PhysicsConfig, build_control_nodes, sample_farthest
from endo_sim_ros.rendering import render_depth


def test_farthest_points_agree_with_brute_force():
    points = np.random.default_rng(1).normal(size=(1500, 3))
    chosen = [7]
    nearest = np.full(len(points), np.inf)
    for _ in range(59):
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(nearest.argmax()))
    assert sample_farthest(points, 60, start=7).tolist() == chosen


def test_farthest_points_of_duplicates_take_the_lowest_index():
    points = np.repeat(np.eye(3), 4, axis=0)
    assert sample_farthest(points, 3).tolist() == [0, 4, 8]


def test_more_samples_than_points_is_refused():
    with pytest.raises(ValueError, match="cannot pick 5 of 4 points"):
        sample_farthest(np.zeros((4, 3)), 5)


def test_tissue_has_the_volume_and_depth_asked_for():
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=2000, layers=4, thickness=0.02))
    assert len(nodes) == 2000 and nodes.is_skin.sum() == 400
    skin, back = nodes.rest[:400], nodes.rest[-400:]
    depth = np.linalg.norm(back, axis=1) - np.linalg.norm(skin, axis=1)
    np.testing.assert_allclose(depth, 0.02, atol=1e-6)
    np.testing.assert_allclose(np.cross(skin, back), 0, atol=1e-8)  # along the viewing rays
    assert nodes.pinned[-400:].all()
    # 10 × 8 cm seen from 12 cm, 2 cm deep: a little more than 160 cm³, as the frustum widens.
    assert 1.0 * 160e-6 < nodes.volumes.sum() < 1.4 * 160e-6


def test_rim_is_the_border_and_only_the_border():
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=2000, pin_back=False))
    x, y = np.abs(nodes.rest[nodes.is_skin][:, :2]).T
    rim = nodes.pinned[nodes.is_skin]
    assert rim[(x > 0.0495) | (y > 0.0395)].all()
    assert not rim[(x < 0.044) & (y < 0.034)].any()


def test_faint_and_floating_gaussians_do_not_become_nodes():
    model = curved_sheet()
    logits = model.logit_opacities.clone()
    logits[:500] = -4.0
    means = model.means.clone()
    means[500] = torch.tensor([0.0, 0.0, 0.05])
    nodes = build_control_nodes(dataclasses.replace(model, means=means, logit_opacities=logits), EYE, PhysicsConfig())
    skin = {tuple(point) for point in nodes.rest[nodes.is_skin].tolist()}
    assert not skin & {tuple(point) for point in means[:501].tolist()}


def test_coinciding_gaussians_become_one_node():
    model = curved_sheet(300)
    twice = model.select(torch.arange(300).repeat(10))
    nodes = build_control_nodes(twice, EYE, PhysicsConfig(node_count=5000))
    assert nodes.is_skin.sum() == 300
    assert nodes.volumes.sum() < 1.4 * 160e-6


def test_several_viewpoints_mean_their_centre():
    config = PhysicsConfig(node_count=500)
    one = build_control_nodes(curved_sheet(), EYE, config)
    two = build_control_nodes(curved_sheet(), np.array([[0.01, 0, 0], [-0.01, 0, 0]]), config)
    np.testing.assert_array_equal(one.rest, two.rest)


@pytest.mark.parametrize("viewpoint", [[0.0, np.nan, 0.0], [[np.inf, 0.0, 0.0]]])
def test_a_viewpoint_that_is_not_finite_is_refused(viewpoint):
    with pytest.raises(ValueError, match="viewpoint must be a finite"):
        build_control_nodes(curved_sheet(), np.array(viewpoint), PhysicsConfig())


@pytest.mark.slow
def test_tissue_is_carved_where_a_camera_sees_through_it_and_only_there():
    """A small plate in front of a wide one: what hangs behind its edge is seen from the side."""
    rng = np.random.default_rng(7)
    plates = [np.c_[rng.uniform(-half, half, (count, 2)), np.full(count, z)] for half, z, count in ((0.02, 0.1, 4000), (0.1, 0.16, 16000))]
    points = torch.from_numpy(np.concatenate(plates)).float()
    model = GaussianModel.from_points(points, torch.rand(len(points), 3), torch.full((len(points),), 0.0014))
    model = dataclasses.replace(model, logit_opacities=torch.full((len(points),), 4.0))
    K = np.array([[300.0, 0, 160], [0, 300, 128], [0, 0, 1]])
    cameras = [Camera(K, 320, 256, pose_at([x, 0.0, 0.0])) for x in (-0.06, 0.0, 0.06)]
    config = PhysicsConfig(node_count=6000)
    whole = build_control_nodes(model, EYE, dataclasses.replace(config, carve=False), cameras)
    carved = build_control_nodes(model, EYE, config, cameras, render_depth)
    with pytest.raises(ValueError, match="pass render_depth"):
        build_control_nodes(model, EYE, config, cameras)
    left = {tuple(position) for position in carved.rest.tolist()}
    gone = np.array([position for position in whole.rest.tolist() if tuple(position) not in left])
    assert len(gone) > 20 and len(whole) - len(carved) == len(gone)
    depth = gone[:, 2]
    assert depth.min() > 0.1 and depth.max() < 0.125  # behind the plate, in front of the other
    # The camera at 6 cm sees, past the edge at 2 cm, what lies right of the line through both.
    behind = whole.rest[(whole.rest[:, 2] > 0.101) & (whole.rest[:, 2] < 0.125) & ~whole.is_skin]
    past_edge = np.abs(behind[:, 0]) - (0.02 - (behind[:, 2] - 0.1) * 0.04 / 0.1)
    kept = np.array([tuple(position) in left for position in behind.tolist()])
    assert kept[past_edge < 0].all() and kept[past_edge > 0.003].mean() < 0.15
    assert carved.is_skin.sum() == whole.is_skin.sum()


def test_what_no_camera_has_seen_gives_no_nodes():
    """A reconstruction continues tissue beyond the pictures."""
    cameras = [Camera(np.array([[600.0, 0, 160], [0, 600, 128], [0, 0, 1]]), 320, 256, pose_at([x, 0.0, 0.0])) for x in (-0.01, 0.01)]
    model = curved_sheet()
    in_pictures = lambda points: np.any([((c.project(points)[0] >= 0) & (c.project(points)[0] <= [320, 256])).all(1) for c in cameras], 0)
    skin = lambda nodes: nodes.rest[nodes.is_skin].astype(np.float64)
    config = PhysicsConfig(node_count=600, carve=False)
    assert in_pictures(skin(build_control_nodes(model, EYE, config))).mean() < 0.95
    assert in_pictures(skin(build_control_nodes(model, EYE, config, cameras))).all()
    away = [camera.at(camera.pose @ np.diag([-1.0, 1, -1, 1])) for camera in cameras]  # not those that saw it
    np.testing.assert_array_equal(build_control_nodes(model, EYE, config, away).rest, build_control_nodes(model, EYE, config).rest)


def test_a_model_without_opaque_gaussians_is_refused():
    model = dataclasses.replace(curved_sheet(), logit_opacities=torch.full((3000,), -9.0))
    with pytest.raises(ValueError, match="only 0 of 3000 Gaussians are as opaque"):
        build_control_nodes(model, EYE, PhysicsConfig())
