"""Streams of a tool on steps of the physics, and experiments of them, against exact expectations."""

from dataclasses import replace

import numpy as np
import pytest
from made_touches import PHYSICS, RADIUS, STEP, STIFFNESS, SURFACE, S, flat_tissue, pressed, tip

from endo_sim_ros.core.cameras import matrix_to_quat, quat_to_matrix
from endo_sim_ros.identification.recording_config import TouchConfig
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.identification.touches import (
    experiment_spans,
    forces_at,
    poses_at,
    step_times,
    tared,
    timeline,
    touches,
)
from endo_sim_ros.learning.streams import Stream

NODES = flat_tissue()
SKIN = Surface(NODES)
CONFIG = TouchConfig()
SETTLE = round(CONFIG.settle / STEP)


def stream(seconds, values):
    return Stream(np.round(np.asarray(seconds) * S).astype(np.int64), np.asarray(values, np.float64))


def poses(seconds, depths, x=0.0):
    rows = [[*tip(depth, x)[:3, 3], 0, 0, 0, 1] for depth in depths]
    return stream(seconds, rows)


def line_of(seconds, depths, jaw=None, forces=None, config=CONFIG, x=0.0):
    return timeline(poses(seconds, depths, x), jaw, forces, SKIN, PHYSICS, config, RADIUS)


def pressing(seconds=6.0, presses=(1.0, 4.0), rate=100):
    times = np.arange(int(seconds * rate)) / rate
    return times, pressed(times, presses)


def test_gaps_count_along_normals_and_are_negative_in_the_tissue():
    points = np.array(
        [[0.0, 0, SURFACE - 0.03], [0.001, 0.0005, SURFACE - 0.002], [0, 0, SURFACE + 0.007], [0.05, 0, SURFACE], [np.nan, 0, 0]]
    )
    gaps = SKIN.gaps(points)
    np.testing.assert_allclose(gaps, [0.03, 0.002, -0.007, 0.03, np.inf], atol=1e-6)
    np.testing.assert_allclose(SKIN.normals, np.tile([0, 0, -1.0], (len(SKIN.skin), 1)), atol=1e-6)
    assert SKIN.apart == pytest.approx(0.002, rel=1e-4)


def test_steps_are_where_a_simulation_took_them():
    path = poses(np.arange(50) * 0.01 + 0.003, np.zeros(50))
    alone = step_times(path, None, STEP)
    np.testing.assert_array_equal(alone, round(0.003 * S) + np.arange(13) * round(STEP * S))
    reactions = stream(0.017 + STEP * np.arange(12), np.zeros((12, 6)))
    shared = step_times(path, reactions, STEP)
    assert set(shared) <= set(reactions.stamps) and shared[0] == round(0.017 * S)
    np.testing.assert_array_equal(step_times(path, stream(np.arange(500) * 0.001, np.zeros((500, 6))), STEP), alone)


def test_poses_lie_on_straight_lines_and_are_unknown_in_gaps():
    turned = [matrix_to_quat(quat_to_matrix([np.cos(a / 2), 0, 0, np.sin(a / 2)])) for a in (0.0, 0.2, 0.4)]
    rows = [[x, 0, 0, *quat[1:], quat[0]] for x, quat in zip((0.0, 1.0, 3.0), turned)]
    rows[1][3:] = [-each for each in rows[1][3:]]  # the same rotation
    path = stream([0.0, 0.1, 1.0], rows)
    positions, quats = poses_at(path, np.array([-1, 0, 50_000_000, 100_000_000, 500_000_000, S, 2 * S]), 0.2)
    np.testing.assert_allclose(positions[:, 0], [np.nan, 0, 0.5, 1.0, np.nan, 3.0, np.nan])
    half = np.roll(quats[2], 1)
    np.testing.assert_allclose(np.abs(half), np.abs([np.cos(0.05), 0, 0, np.sin(0.05)]), atol=1e-6)


def test_many_forces_are_averaged_over_a_step_and_few_are_joined():
    few = stream([0.0, 0.1, 0.5], [[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    np.testing.assert_allclose(forces_at(few, np.array([0, S // 20, S // 10, 3 * S // 10]), STEP, 0.2)[:, 0], [0, 0.5, 1.0, np.nan])
    times = np.arange(1000) / 1000
    many = stream(times, np.stack([3 * times, np.tile([1.0, -1.0], 500), np.zeros(1000)], 1))
    at = forces_at(many, np.array([S // 2, S // 4]), STEP, 0.2)
    np.testing.assert_allclose(at[:, 0], [1.5, 0.75], atol=2e-3)
    np.testing.assert_allclose(at[:, 1], 0, atol=1e-9)


def test_experiments_begin_at_rest_and_hold_one_touch_each():
    times, depths = pressing()
    line = line_of(times, depths)
    expected = pressed(line.times * 1e-9, (1.0, 4.0))
    np.testing.assert_allclose(line.gaps, -expected, atol=2e-5)
    np.testing.assert_array_equal(line.touching, line.gaps <= CONFIG.clearance)
    found = touches(line)
    spans, left_out = experiment_spans(line, SETTLE)
    assert len(found) == len(spans) == 2 and left_out == 0
    for (start, stop), (first, last) in zip(found, spans):
        assert first == start - SETTLE // 2 and last == stop + SETTLE // 2
        assert not line.touching[first:start].any()
    np.testing.assert_allclose(np.nanmax(line.depths), np.max(expected), atol=1e-5)


def test_touches_in_quick_succession_are_one_experiment():
    times, depths = pressing(presses=(1.0, 1.9))
    spans, left_out = experiment_spans(line_of(times, depths), SETTLE)
    assert len(touches(line_of(times, depths))) == 2 and len(spans) == 1 and left_out == 0


def test_what_begins_in_tissue_is_left_out():
    times, depths = pressing(presses=(-0.5, 3.0))
    spans, left_out = experiment_spans(line_of(times, depths), SETTLE)
    assert len(spans) == 1 and left_out == 1


def test_a_gap_in_the_poses_ends_an_experiment_and_what_follows_is_left_out():
    times, depths = pressing(presses=(1.0, 4.0))
    kept = ~((times > 1.4) & (times < 1.65))
    line = line_of(times[kept], depths[kept])
    spans, left_out = experiment_spans(line, SETTLE)
    assert left_out == 1 and len(spans) == 2  # the second half of the first press
    assert line.present[slice(*spans[0])].all() and not line.present[spans[0][1]]
    assert not line.closed.any()


def test_a_jaw_holds_only_what_it_closed_on_and_keeps_it_while_it_pulls():
    times = np.arange(600) / 100
    depths = np.interp(times, [0, 1, 2, 3, 4, 6], [-0.03, 0.0, 0.0, -0.02, -0.02, -0.03])  # down, stay, up with tissue
    jaw = stream([0.0, 0.5, 1.0, 1.5, 4.5], [[0.0], [0.15], [0.5], [0.05], [0.3]])
    line = line_of(times, depths, jaw)
    seconds = line.times * 1e-9
    np.testing.assert_array_equal(line.closed, (seconds >= 1.5) & (seconds < 4.5))  # not at first, when it closed in the air
    at = np.searchsorted(seconds, 3.5)
    np.testing.assert_allclose(line.pulled[at], [0, 0, -0.02], atol=1e-6)
    spans, _ = experiment_spans(line, SETTLE)
    assert len(spans) == 1 and line.touching[at]


def test_forces_in_the_air_tell_offset_and_noise():
    times, depths = pressing(seconds=12.0, presses=(1.0, 4.0))
    rng = np.random.default_rng(1)
    at = np.arange(300) * STEP
    values = np.zeros((300, 6))
    values[:, 2] = -STIFFNESS * pressed(at, (1.0, 4.0)).clip(0)
    values[:, :3] += rng.normal(0, 0.08, (300, 3)) + [0.3, 0.0, -0.2]
    line = line_of(times, depths, forces=stream(at, values))
    clean, noise, offset, drift, _ = tared(line, SETTLE)
    assert not drift.any()
    np.testing.assert_allclose(offset, [0.3, 0, -0.2], atol=0.03)
    assert noise == pytest.approx(0.08, rel=0.2)
    np.testing.assert_allclose(clean.forces[:, 2], -STIFFNESS * (-clean.gaps).clip(0), atol=0.4)
    few = line_of(times[:60], depths[:60] + 1.0, forces=stream(at, values))
    assert tared(few, SETTLE)[1] == 0.0


def test_forces_in_the_air_tell_a_sensor_that_drifts():
    times, depths = pressing(seconds=12.0, presses=(1.0, 4.0))
    at = np.arange(300) * STEP
    values = np.zeros((300, 6))
    values[:, 2] = -STIFFNESS * pressed(at, (1.0, 4.0)).clip(0)
    values[:, :3] += np.random.default_rng(1).normal(0, 0.05, (300, 3)) + np.linspace(0, 1, 300)[:, None] * [0.4, 0.0, -0.3]
    clean, noise, _, drift, _ = tared(line_of(times, depths, forces=stream(at, values)), SETTLE)
    np.testing.assert_allclose(drift, [0.4, 0, -0.3], atol=0.05)
    assert noise == pytest.approx(0.05, rel=0.2)
    np.testing.assert_allclose(clean.forces[:, 2], -STIFFNESS * (-clean.gaps).clip(0), atol=0.3)


@pytest.mark.parametrize("white", [0.0, 0.05])
def test_noise_that_lasts_is_no_drift(white):
    """Also beside noise that is other at each step."""
    times, depths = pressing(seconds=12.0, presses=(1.0, 4.0))
    line, kept = line_of(times, depths, forces=stream(np.arange(300) * STEP, np.zeros((300, 6)))), np.exp(-1 / 10)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        noise = [rng.standard_normal(3)]
        for draw in rng.standard_normal((len(line.times) - 1, 3)):  # of ten steps
            noise.append(kept * noise[-1] + np.sqrt(1 - kept**2) * draw)
        forces = 0.05 * np.array(noise) + white * rng.standard_normal((len(noise), 3))
        *_, drift, lasts = tared(replace(line, forces=forces), SETTLE)
        assert not drift.any() and 2 < lasts < 30
