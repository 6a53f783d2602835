"""Who saw what, and how it is measured."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation.held_out import FIGURES, drawer, measure, seen_pixels
from endo_sim_ros.evaluation.preparation import divide_points
from endo_sim_ros.reconstruction import ScenePoints
from endo_sim_ros.reconstruction.camera_errors import CameraErrors, LensError
from endo_sim_ros.reconstruction.photometry import Drift

CAMERA = Camera(np.array([[50, 0, 32], [0, 50, 24], [0, 0, 1.0]]), 64, 48)


def box_depth(camera):
    """Depth of a wall at z = 0.2 m with a post in front of it, |x| < 1 cm at z = 0.1 m, seen along +z."""
    rays = camera.rays()
    at_post = camera.position[0] + rays[..., 0] * (0.1 - camera.position[2])
    return np.where(np.abs(at_post) < 0.01, 0.1, 0.2).astype(np.float32) - np.float32(camera.position[2])


def test_a_pixel_is_seen_where_another_view_sees_its_surface():
    left = CAMERA.at(look_at([-0.03, 0, 0], [-0.03, 0, 1]))
    here, there = box_depth(CAMERA), box_depth(left)
    seen = seen_pixels(CAMERA, here, [(left, there, None)])
    # By hand: each surface point of this view is in the other's image, and not behind the post.
    x = CAMERA.backproject(here)[..., 0]
    u = (x + 0.03) / here * 50 + 32
    crossing = -0.03 + (x + 0.03) / 2  # of the other view's ray to the wall with the plane of the post
    expected = (u < 64) & ((here < 0.15) | (np.abs(crossing) > 0.01))
    assert expected.any() and not expected.all()
    assert (seen != expected).mean() < 0.03  # pixels on an edge
    assert not seen_pixels(CAMERA, here, [(left, there, np.zeros_like(there))]).any()
    assert not seen_pixels(CAMERA, 0 * here, [(left, there, None)]).any()
    assert seen_pixels(CAMERA, here, [(left, there, None), (CAMERA, here, None)]).all()


def test_measures_of_what_was_seen_count_only_that(small_frames):
    frame, seen = small_frames[0], np.zeros((80, 96), np.uint8)
    seen[:, :48] = 255
    image = frame.image.copy()
    image[:, 60:] = 0
    row = measure(image, frame.depth, frame, seen)
    assert row["seen_psnr"] > 100 > row["psnr"]
    assert row["depth_rmse"] == row["depth_rmse_scaled"] == 0 and row["depth_share"] == 100
    half = np.where(seen > 0, frame.depth, 0)
    told = measure(image, half, frame)
    assert told["depth_rmse"] == 0 and told["depth_share"] == pytest.approx(row["seen_share"])  # holes are not judged, but told
    assert row["seen_share"] == pytest.approx(100 * (frame.mask[:, :48] > 0).sum() / (frame.mask > 0).sum())
    assert set(row) <= set(FIGURES) and "psnr_unmasked" in row  # the recording has a border


def test_depth_is_judged_by_scene_points_that_no_method_gets(small_frames):
    frame = small_frames[0]
    surface = frame.camera.backproject(frame.depth)[frame.depth > 0][::7]
    repeated = np.concatenate([surface, surface[::2], surface[1::2] + 1e-6])  # as other pairs of views triangulate them again
    points = ScenePoints(repeated, np.zeros_like(repeated), np.linspace(0.001, 0.002, len(repeated)))
    given, judging = divide_points(points)
    assert len(judging) == pytest.approx(len(np.unique(repeated, axis=0)) / 10, abs=1) and len(given.positions) == len(given.error)
    assert len(repeated) - 4 * len(judging) < len(given.positions) < len(repeated) - len(judging)
    assert KDTree(judging).query(given.positions)[0].min() > 2e-6
    few = ScenePoints(surface[:300], np.zeros_like(surface[:300]), 0.001)
    assert divide_points(few) == (few, None)
    assert measure(frame.image, frame.depth, frame, points=judging)["points_depth"] < 1e-6
    off = measure(frame.image, frame.depth + np.float32(0.002), frame, points=judging)
    assert off["points_depth"] == pytest.approx(0.002, rel=1e-3)
    assert "points_depth" not in measure(frame.image, frame.depth, frame)


@pytest.mark.parametrize("gradual", [True, False])
def test_a_view_is_drawn_where_its_camera_was(small_frames, gradual):
    generator = torch.Generator().manual_seed(0)
    frame = small_frames[3]
    rays = torch.from_numpy(frame.camera.rays().reshape(-1, 3)).float()
    places = rays[torch.randint(len(rays), (400,), generator=generator)] * torch.empty(400, 1).uniform_(0.08, 0.12, generator=generator)
    pose = torch.from_numpy(frame.camera.pose).float()
    world = places @ pose[:3, :3].T + pose[:3, 3]
    model = GaussianModel.from_points(world, torch.rand(400, 3, generator=generator), torch.full((400,), 0.002))
    changes = np.array([[0.0, 0.02, 0.0, 0.002, 0.0, 0.0]] * 3)
    errors = CameraErrors([f.stamp_ns for f in (small_frames[1], small_frames[5], small_frames[9])], changes, gradual)
    draw = lambda frame, errors: drawer(model, None, Drift([0], np.zeros((1, 3))), errors, "cpu")(frame, None)
    image, depth = draw(frame, errors)
    there = replace(frame, camera=CameraErrors([frame.stamp_ns], changes[:1]).corrected(frame.camera, frame.stamp_ns))
    recorded, corrected = draw(frame, CameraErrors()), draw(there, CameraErrors())
    assert np.abs(recorded[0].astype(int) - corrected[0]).mean() > 1
    for ours, expected in zip((image, depth), corrected if gradual else recorded):
        np.testing.assert_array_equal(ours, expected)


@pytest.mark.parametrize("lens", [LensError(1.3), LensError(1.0, -0.8), LensError(1.1, 0.5)])
def test_a_view_is_drawn_through_the_lens_that_recorded_it(small_frames, lens):
    frame = small_frames[0]
    for slope in np.array([[0.0, 0.0], [0.4, 0.1], [-0.3, 0.3]]):
        place = np.append(lens.rays(slope), 1.0) * 0.1  # of tissue that the recorded picture shows at this slope
        world = frame.camera.pose[:3, :3] @ place + frame.camera.pose[:3, 3]
        model = GaussianModel.from_points(torch.tensor(world[None]).float(), torch.ones(1, 3), torch.tensor([0.002]))
        image, _ = drawer(model, None, Drift([0], np.zeros((1, 3))), CameraErrors(lens=lens), "cpu")(frame, None)
        rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
        weight = image.astype(float).sum(-1)
        seen = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
        np.testing.assert_allclose(seen, slope * frame.camera.K.diagonal()[:2] + frame.camera.K[:2, 2], atol=0.6)
