"""The synthetic patient: repeatable, exactly posed, exactly deep, and plausible to look at."""

import dataclasses

import numpy as np
import pytest

from endo_sim_ros.sequences.phantom import (
    PhantomConfig,
    build_phantom,
    phantom_camera,
    phantom_poses,
    phantom_sequence,
    render_phantom,
    rendering,
)
from endo_sim_ros.sequences.phantom.height_field import CELL

SMALL = PhantomConfig(frames=3, width=160, height=128)


@pytest.fixture(scope="module")
def frames():
    return list(phantom_sequence(SMALL))


@pytest.mark.slow
def test_same_seed_gives_the_same_bytes(frames):
    rendering._kept.cache_clear()
    for first, second in zip(frames, phantom_sequence(SMALL), strict=True):
        assert first.stamp_ns == second.stamp_ns
        for name in ("image", "right", "depth", "mask"):
            assert getattr(first, name).tobytes() == getattr(second, name).tobytes(), name
        assert first.camera.pose.tobytes() == second.camera.pose.tobytes()


@pytest.mark.thorough
@pytest.mark.slow
def test_other_seeds_are_other_patients(frames):
    image, depth = render_phantom(dataclasses.replace(SMALL, seed=1), frames[0].camera)
    assert np.abs(image.astype(int) - frames[0].image).mean() > 10
    assert np.abs(depth - frames[0].depth).mean() > 1e-3


@pytest.mark.slow
def test_sequence_is_lazy_and_stamped_by_the_frame_rate():
    endless = phantom_sequence(PhantomConfig(frames=100_000, width=32, height=24, fps=10.0, stereo=False))
    first, second = next(endless), next(endless)
    assert first.stamp_ns == 1_000_000_000
    assert second.stamp_ns - first.stamp_ns == 100_000_000
    assert first.right is None and first.baseline is None


@pytest.mark.slow
def test_depth_lies_on_the_surface():
    """Ray marching is in single precision; the surface it should have found is evaluated in double."""
    for pose in phantom_poses(SMALL):
        camera = phantom_camera(SMALL, pose)
        _, depth = render_phantom(SMALL, camera)
        points = camera.backproject(depth.astype(np.float64))
        gap = points[..., 2] - build_phantom(SMALL.seed).height(points[..., 0], points[..., 1])
        assert np.percentile(np.abs(gap), 99) < 2e-6
        assert np.abs(gap).max() < 2e-5


@pytest.mark.slow
def test_nothing_of_the_surface_is_in_front_of_the_depth(frames):
    """Of all crossings along a ray the depth is the first."""
    camera, depth = frames[1].camera, frames[1].depth
    for fraction in np.linspace(0.6, 0.999, 60):
        points = camera.backproject(depth.astype(np.float64) * fraction)
        assert (points[..., 2] < build_phantom(0).height(points[..., 0], points[..., 1]) + 2e-6).all()


@pytest.mark.slow
def test_two_views_agree_on_the_depth():
    config = dataclasses.replace(SMALL, width=320, height=256)
    poses = phantom_poses(dataclasses.replace(config, frames=9))
    first, second = phantom_camera(config, poses[0]), phantom_camera(config, poses[4])
    assert np.linalg.norm(first.position - second.position) > 0.01
    _, depth1 = render_phantom(config, first)
    _, depth2 = render_phantom(config, second)
    pixels, z = second.project(first.backproject(depth1).reshape(-1, 3))
    u, v = (pixels - 0.5).T
    inside = (u >= 0) & (v >= 0) & (u < config.width - 1) & (v < config.height - 1)
    u, v, z = u[inside], v[inside], z[inside]
    i, j = u.astype(int), v.astype(int)
    a, b = u - i, v - j
    corners = np.stack([depth2[j, i], depth2[j, i + 1], depth2[j + 1, i], depth2[j + 1, i + 1]])
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    seen = (weights * corners).sum(0)
    visible = (z - seen < 5e-4) & (np.ptp(corners, axis=0) < 1e-3)  # not hidden, and not beside an outline
    assert visible.mean() > 0.5
    assert np.median(np.abs(z - seen)[visible]) < 5e-5


@pytest.mark.slow
def test_stereo_disparity_is_focal_times_baseline_over_depth():
    """Along a row, the right image moved by fx·B/Z shows the left image; a wrong disparity shows it much worse."""
    frame = next(phantom_sequence(PhantomConfig(width=320, height=256, frames=1, noise=0.0)))
    assert frame.baseline == PhantomConfig().baseline and frame.right_K is None
    disparity = frame.camera.K[0, 0] * frame.baseline / frame.depth
    columns = np.arange(frame.camera.width) + np.zeros_like(frame.depth)

    def difference(shift):
        x = columns - shift
        i = np.clip(x.astype(int), 0, frame.camera.width - 2)
        blend = (x - i)[..., None]
        rows = np.arange(frame.camera.height)[:, None]
        warped = (1 - blend) * frame.right[rows, i] + blend * frame.right[rows, i + 1]
        error = np.abs(warped - frame.image).mean(-1)
        return np.median(error[:, 20:])

    assert difference(disparity) < 3.0  # the vignettes differ
    for wrong in (-1.0, -0.5, 0.5, 1.0):
        assert difference(disparity) < difference(disparity + wrong)
    assert difference(disparity) < 0.5 * min(difference(disparity - 3), difference(disparity + 3))


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, pytest.param(2, marks=pytest.mark.thorough)])
def test_images_look_like_tissue(seed):
    config = PhantomConfig(seed=seed, width=320, height=256, frames=2)
    image, depth = render_phantom(config, phantom_camera(config, phantom_poses(config)[0]))
    red, green, blue = image.reshape(-1, 3).mean(0)
    assert red > 1.25 * green and red > 1.25 * blue
    assert 70 < image.mean() < 150
    assert image.std() > 25
    assert 1e-5 < (image.min(-1) > 240).mean() < 0.03, "glints are there, and are small"
    assert (image.max(-1) < 20).mean() < 0.05
    assert 0.07 < depth.min() < depth.max() < 0.22
    assert np.ptp(depth) > 0.02


@pytest.mark.thorough
@pytest.mark.slow
def test_the_surface_fills_every_view():
    for seed in range(3):
        config = PhantomConfig(seed=seed, frames=12, width=48, height=40, fov_deg=75.0, travel=0.05, stereo=False)
        for frame in phantom_sequence(config):
            assert (frame.depth > 0).all()
            assert (frame.mask == 255).all()


@pytest.mark.parametrize("size", [(97, 53), (8, 8), (131, 240)])
def test_any_image_size_works(size):
    width, height = size
    frame = next(phantom_sequence(PhantomConfig(width=width, height=height, frames=1)))
    assert frame.image.shape == frame.right.shape == (height, width, 3)
    assert frame.depth.shape == frame.mask.shape == (height, width)
    assert frame.depth.dtype == np.float32 and frame.image.dtype == np.uint8


def test_poses_are_rigid_smooth_and_rest_at_both_ends():
    config = PhantomConfig()
    poses = phantom_poses(config)
    rotations, tips = poses[:, :3, :3], poses[:, :3, 3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    speed = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    assert speed[0] < 0.05 * speed.max() and speed[-1] < 0.05 * speed.max()
    assert np.abs(np.diff(speed)).max() < 0.1 * speed.max()
    assert 0.5 * config.travel < np.ptp(tips, axis=0).max() < 1.5 * config.travel
    # the shaft always passes through the trocar
    trocar = tips - rotations[:, :, 2] * np.linalg.norm(tips + [0, 0, config.lever], axis=1)[:, None]
    np.testing.assert_allclose(trocar, np.tile([0, 0, -config.lever], (len(poses), 1)), atol=1e-9)


def test_half_a_round_ends_elsewhere_and_a_whole_one_at_the_beginning():
    half, whole = (phantom_poses(PhantomConfig(frames=9, rounds=rounds))[:, :3, 3] for rounds in (0.5, 1.0))
    assert np.linalg.norm(half[-1] - half[0]) > 0.005
    np.testing.assert_allclose(whole[-1], whole[0], atol=1e-9)


@pytest.mark.thorough
@pytest.mark.slow
def test_a_flight_sees_tissue_all_the_way_with_exact_depth():
    config = PhantomConfig(flight=0.3, frames=7, width=64, height=52, noise=0.0)
    assert config.sections == 2 and SMALL.sections == 1
    surface, seen = build_phantom(config.seed, config.sections), []
    for frame in phantom_sequence(config):
        points = frame.camera.backproject(frame.depth.astype(np.float64))
        gap = points[..., 2] - surface.height(points[..., 0], points[..., 1])
        assert np.percentile(np.abs(gap), 99) < 2e-6 and (frame.depth > 0.05).all()
        assert frame.image.std() > 25
        seen.append(points[..., 0])
    assert 0.28 < np.ptp(phantom_poses(config)[:, 0, 3]) < 0.34
    reach = (surface.heights.shape[1] - 1) / 2 * CELL  # where the surface is mirrored
    assert 0.2 < np.max(np.abs(seen)) < reach


def test_border_is_black_masked_and_without_depth():
    frame = next(phantom_sequence(PhantomConfig(width=160, height=128, frames=1, border=0.05, noise=0.0)))
    assert set(np.unique(frame.mask)) == {0, 255}
    assert frame.mask[0, 0] == 0 and frame.mask[64, 80] == 255
    assert (frame.image[0] == 0).all()
    assert (frame.depth[frame.mask == 0] == 0).all() and (frame.depth[frame.mask == 255] > 0).all()


def test_auto_exposure_holds_the_brightness():
    means = []
    for z in (-0.03, 0.03):
        pose = np.eye(4)
        pose[2, 3] = z
        fixed, held = (
            render_phantom(config, phantom_camera(config, pose))[0].mean()
            for config in (SMALL, dataclasses.replace(SMALL, auto_exposure=True))
        )
        means.append((fixed, held))
    (far, far_held), (near, near_held) = means
    assert near > 1.2 * far
    assert abs(near_held - far_held) < 0.25 * (near - far)


def test_a_camera_that_looks_away_sees_nothing():
    away = np.diag([1.0, -1.0, -1.0, 1.0])
    image, depth = render_phantom(SMALL, phantom_camera(SMALL, away))
    assert (image == 0).all() and (depth == 0).all()
