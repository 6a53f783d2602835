"""The synthetic patient that is pulled, or breathes: what moves is known, and what reflects stays with the light."""

import dataclasses

import numpy as np
import pytest

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.sequences.phantom import (
    Displacement,
    PhantomConfig,
    build_phantom,
    displacement_at,
    phantom_camera,
    phantom_poses,
    phantom_sequence,
    render_phantom,
)
from endo_sim_ros.sequences.phantom.rendering import radiance_and_depth

SMALL = PhantomConfig(frames=3, width=160, height=128, stereo=False, noise=0.0)
PULLED = dataclasses.replace(SMALL, deformed=0.012)


@pytest.fixture(scope="module")
def camera():
    return phantom_camera(SMALL, phantom_poses(SMALL)[0])


def test_gradients_are_those_of_finite_differences():
    displacement = displacement_at(dataclasses.replace(PULLED, breathing=0.008, heartbeat=0.002), 1.3)
    assert displacement is not None and len(displacement.radii) == 3
    points, step = np.random.default_rng(0).normal([0, 0, 0.13], 0.03, (50, 3)), 1e-6
    ahead, behind = (np.stack([displacement.at(points + sign * step * axis) for axis in np.eye(3)], -1) for sign in (1, -1))
    assert np.allclose(displacement.gradients(points), np.eye(3) + (ahead - behind) / (2 * step), atol=1e-8)


@pytest.mark.slow
def test_tissue_that_is_hardly_pulled_looks_as_at_rest(camera):
    image, depth = render_phantom(SMALL, camera)
    other, pulled = render_phantom(dataclasses.replace(SMALL, deformed=1e-9), camera)
    assert np.abs(pulled - depth).max() < 2e-5
    assert np.abs(other.astype(int) - image).max() <= 2


@pytest.mark.slow
def test_moving_everything_is_moving_the_camera_the_other_way(camera):
    """So colours, normals, light and reflections are those of the displaced surface, wherever it went."""
    by = np.array([0.004, -0.003, -0.006])
    far = Displacement(np.array([[0, 0, 0.13]]), by[None], np.array([1e3]))  # the same everywhere
    phantom, pose = build_phantom(0), camera.pose.copy()
    pose[:3, 3] -= by
    radiance, depth = radiance_and_depth(phantom, camera, camera, far)
    expected, there = radiance_and_depth(phantom, camera.at(pose), camera.at(pose))
    off = np.abs(radiance - expected).max(-1)
    assert np.quantile(np.abs(depth - there), 0.999) < 2e-5
    assert np.quantile(off, 0.99) < 0.01 and np.median(expected) > 0.05


@pytest.mark.slow
def test_every_point_that_is_seen_was_on_the_surface(camera):
    displacement = displacement_at(PULLED, 0.0)
    assert displacement is not None
    seen = camera.backproject(render_phantom(PULLED, camera)[1]).reshape(-1, 3)
    rest = seen.astype(np.float64)
    for _ in range(50):
        rest = seen - displacement.at(rest)
    moved = np.linalg.norm(displacement.at(rest), axis=1)
    assert moved.max() > 0.01 and np.median(moved) < 0.003
    off = np.abs(rest[:, 2] - build_phantom(0).height(rest[:, 0], rest[:, 1]))
    assert np.quantile(off, 0.99) < 5e-5 and off.max() < 1e-3  # along a steep edge a hair aside is far in z


@pytest.mark.slow
def test_what_would_fold_tissue_is_refused():
    PhantomConfig(deformed=0.03)
    with pytest.raises(ConfigError, match="together fold the tissue"):
        PhantomConfig(deformed=0.03, breathing=0.03, heartbeat=0.01)
    grid = np.stack(np.meshgrid(*[np.linspace(low, high, 41) for low, high in ((-0.1, 0.1), (-0.1, 0.1), (0, 0.2))]), -1).reshape(-1, 3)
    for seed in range(20):
        config = PhantomConfig(seed=seed, deformed=0.015, breathing=0.03, heartbeat=0.007)
        displacement = displacement_at(config, 2.0 + 0.025)  # breath at its height, and the heart nearly so
        assert displacement is not None and np.linalg.det(displacement.gradients(grid)).min() > 0.05


def test_breath_and_heart_go_there_and_back_in_their_time():
    config = dataclasses.replace(SMALL, breathing=0.008, breathing_period=5.0)
    reach = lambda t: np.linalg.norm(displacement_at(config, t).amplitudes)
    assert reach(0.0) == pytest.approx(0) and reach(2.5) == pytest.approx(0.008) and reach(5.0) == pytest.approx(0, abs=1e-12)
    assert reach(6.25) == pytest.approx(reach(1.25)) == pytest.approx(0.004)
    config = dataclasses.replace(SMALL, heartbeat=0.002, heartbeat_period=0.9)
    assert max(reach(t) for t in np.linspace(0, 0.9, 91)) == pytest.approx(0.002, rel=0.01)
    assert reach(0.3) == pytest.approx(reach(1.2))
    assert displacement_at(SMALL, 1.0) is None


@pytest.mark.thorough
def test_breaths_may_differ_in_length():
    config = dataclasses.replace(SMALL, breathing=0.008, breathing_irregularity=0.4)
    times = np.arange(0, 60, 0.01)
    reach = lambda config: np.array([np.linalg.norm(displacement_at(config, t).amplitudes) for t in times])
    found = reach(config)
    assert np.abs(np.diff(found)).max() < 0.008 * np.pi * 0.01 / 2.4 * 1.01  # no jump, and none shorter than 2.4 s
    still = times[1:-1][(found[1:-1] < found[:-2]) & (found[1:-1] <= found[2:])]
    lengths = np.diff(still)
    assert 2.38 < lengths.min() < 3.2 and 4.8 < lengths.max() < 5.62
    assert (found == reach(config)).all() and (found != reach(dataclasses.replace(config, seed=config.seed + 1))).any()


@pytest.mark.slow
def test_a_film_of_breathing_tissue_shows_each_frame_at_its_time():
    config = dataclasses.replace(SMALL, frames=3, fps=0.5, travel=0.0, breathing=0.008, width=80, height=64)
    frames = list(phantom_sequence(config))
    for frame, seconds in zip(frames, (0.0, 2.0, 4.0), strict=True):
        image, depth = render_phantom(config, frame.camera, seconds)
        assert (frame.image == image).all() and (frame.depth == depth).all()
    assert np.abs(frames[1].depth - render_phantom(config, frames[1].camera)[1]).max() > 0.003
