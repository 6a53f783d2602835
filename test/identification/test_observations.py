"""Noise of what was measured: that of tips is in it."""

from dataclasses import replace

import numpy as np
import pytest
from slab import NODES, pressed

from endo_sim_ros.identification.observations import Observations, smoothing_matrix
from endo_sim_ros.identification.solving import Data


@pytest.mark.parametrize("moved, count", [(0, 27), (2, 87)])  # fewer numbers than errors of the tips, and more
def test_covariance_is_that_of_noise_and_tips(moved, count):
    rng = np.random.default_rng(0)
    experiment = pressed(steps=10)
    forces = rng.standard_normal((10, 3))
    forces[4] = np.nan
    if moved:
        experiment = replace(experiment, displacements=rng.standard_normal((10, moved, 3)), nodes=np.arange(moved))
    tips = experiment.tips + experiment.tip_noise * rng.standard_normal((10, 3))
    seen = Observations(replace(experiment, tips=tips, forces=forces), 0.08)
    assert not np.allclose(seen.smoother, np.eye(10))
    assert len(seen.values) == count
    G, shared = rng.standard_normal((count, 3)) * 100, rng.standard_normal((count, 2))
    # Written out: R = σ² 1 + S (σ² 1) Sᵀ + c cᵀ with S = ∂number_i/∂tip of each step.
    S = np.zeros((count, 10, 3))
    for row, step in enumerate(seen.steps):
        S[row] = seen.smoother[step][:, None] * G[row]
    S = S.reshape(count, 30)
    R = np.diag(seen.noise**2) + experiment.tip_noise**2 * S @ S.T + shared @ shared.T
    x, found = rng.standard_normal((count, 2)), seen.covariance(G, shared)
    expected = np.linalg.solve(R, x)
    assert np.allclose(found.solve(x), expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert found.log_determinant == pytest.approx(np.linalg.slogdet(R)[1])


def test_what_lasts_of_trembling_is_alike_from_step_to_step():
    experiment = replace(pressed(steps=12), forces=np.ones((12, 3)), tip_noise=0.001)
    seen = Observations(experiment, 0.12)
    seen.smoother, seen._smoothed = (W := smoothing_matrix(experiment.present, 3.0)), [(0, W)]
    seen.uneven, seen.lasting = np.random.default_rng(0).uniform(0.01, 0.02, 36), 0.7
    alike = W @ W.T
    sizes = np.sqrt(0.7 * seen.uneven / np.repeat(np.diag(alike), 3))
    R = np.diag(experiment.force_noise**2 + 0.3 * seen.uneven) + sizes[:, None] * np.kron(alike, np.eye(3)) * sizes
    x = np.random.default_rng(1).standard_normal((36, 2))
    found = seen.covariance(np.zeros((36, 3)), np.zeros((36, 1)))
    assert np.allclose(found.solve(x), np.linalg.solve(R, x)) and found.log_determinant == pytest.approx(np.linalg.slogdet(R)[1])


def test_what_a_long_experiment_shares_does_not_average_out():
    steps = 600  # more than are taken for one block
    experiment = replace(pressed(steps=steps), forces=np.ones((steps, 3)))
    seen = Observations(experiment, 0.0)
    level = np.ones((len(seen.values), 1))
    R = seen.covariance(np.zeros((len(level), 3)), 0.1 * level)
    mean_variance = 1 / (level.T @ R.solve(level)).item()
    assert mean_variance == pytest.approx(0.1**2 + experiment.force_noise**2 / len(level), rel=1e-6)


@pytest.mark.parametrize("steps, measured", [(10, slice(0, 0)), (600, slice(0, 200))])
def test_a_stretch_in_which_nothing_was_measured_tells_nothing(steps, measured):
    forces = np.full((steps, 3), np.nan)
    forces[measured] = 1.0
    seen = Observations(replace(pressed(steps=steps), forces=forces), 0.0)
    count = len(seen.values)
    R = seen.covariance(np.zeros((count, 3)), np.zeros((count, 1)))
    assert np.allclose(R.solve(np.ones((count, 1))), seen.noise[:, None] ** -2)


def test_smoothing_keeps_steady_motion_and_does_not_mix_what_was_apart():
    present = np.array([1, 1, 1, 1, 0, 0, 1, 1, 1, 1, 1], bool)
    W = smoothing_matrix(present, 1.5)
    line = np.arange(11.0)
    assert np.allclose(W @ line, line) and np.allclose(W.sum(1), 1)
    assert not W[:4, 6:].any() and not W[6:, :4].any()


@pytest.mark.parametrize("noise, quick, kept", [(0.0005, False, True), (0.0, False, False), (0.0005, True, False)])
def test_smoothing_does_not_round_off_how_the_tool_moves(noise, quick, kept):
    rng, experiment = np.random.default_rng(0), pressed(steps=60)
    way = experiment.tips + (20 * (experiment.tips - experiment.tips[0]) if quick else 0)  # twenty times as far in the same time
    noisy = replace(experiment, tips=way + noise * rng.standard_normal((60, 3)), forces=np.zeros((60, 3)))
    seen = Observations(noisy, 0.12)
    assert (np.allclose(seen.smoother, smoothing_matrix(noisy.present, 3.0))) == kept
    if not kept:
        assert np.abs(seen.experiment.tips - way).max() < 4 * max(noise, 1e-5)


def test_what_was_not_measured_is_left_out():
    moved = np.full((24, 2, 3), np.nan)
    moved[3:5] = 0.001
    seen = Observations(replace(pressed(), displacements=moved, nodes=np.array([0, len(NODES) - 1])), 0.0)
    assert len(seen.values) == 12 and set(seen.steps) == {3, 4}


@pytest.mark.parametrize("by_axis", [False, True])
def test_a_sensor_at_its_limit_tells_no_changes_of_what_it_bounds(by_axis):
    rng = np.random.default_rng(3)
    seen = Observations(replace(pressed(), forces=rng.normal(size=(24, 3))), 0.0)
    seen.uneven[:], part = 0.04, Data(seen, np.zeros((0, 1)), np.zeros((0, 1)), 0.7, by_axis)
    told, changes = 1.5 * rng.normal(size=72), rng.normal(size=(72, 4))
    differences = np.stack([part.clipped(told + 1e-6 * each) - part.clipped(told - 1e-6 * each) for each in changes.T], 1) / 2e-6
    np.testing.assert_allclose(part.passed(told, changes), differences, atol=1e-6)
    assert part.bounded(part.clipped(told)).max() == pytest.approx(0.7)
    bound = part.at_limit(part.clipped(told))  # along which only the noise of the sensor is left
    R = part.covariance(told, np.zeros((72, 3)), changes)
    for step in range(24):
        along = np.where(seen.steps == step, bound, 0.0)
        for way in np.diag(along)[along != 0] if by_axis else [along]:
            assert not way.any() or way @ R.solve(way[:, None])[:, 0] == pytest.approx(way @ way / 0.05**2)


@pytest.mark.parametrize("moved", [0, 2])
def test_noise_next_to_nothing_beside_errors_of_the_tips_is_no_error(moved):
    experiment = replace(pressed(steps=10), forces=np.ones((10, 3)), force_noise=1e-12, displacement_noise=1e-12)
    if moved:
        experiment = replace(experiment, displacements=np.zeros((10, moved, 3)), nodes=np.arange(moved))
    seen = Observations(experiment, 0.08)
    R = seen.covariance(np.full((len(seen.values), 3), 100.0), np.zeros((len(seen.values), 1)))
    assert np.isfinite(R.solve(np.ones((len(seen.values), 1)))).all() and np.isfinite(R.log_determinant)
