"""Values continued from pixels and points: kriging, inverse distance weighting, planes."""

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from endo_sim_ros.reconstruction.priors.interpolation import clip_to_range, fit_plane, inverse_distance_weighted, krige
from endo_sim_ros.reconstruction.stage_configs import InterpolationConfig

OPTIONS = InterpolationConfig()


def test_depth_beyond_is_that_of_kriging():
    random, width = np.random.default_rng(0), 80  # one pixel a cell
    known = np.zeros((12, width), bool)
    known[2:6, 3:8] = True
    values, uv, there = random.normal(0, 1, known.shape), random.uniform(0, [width, 12], (15, 2)), random.normal(0, 1, 15)
    told = krige(values, known, uv, there, width, OPTIONS)
    assert (told[known] == values[known]).all()
    rows, columns = np.nonzero(known)
    sources = np.concatenate([np.column_stack([columns, rows]) + 0.5, uv])
    rows, columns = np.nonzero(~known)
    targets = np.column_stack([columns, rows]) + 0.5
    # Half the squared difference of what lies a distance apart is that distance, to which the variances of the sources come.
    between = lambda a, b: -np.linalg.norm(a[:, None] - b, axis=2)
    system = np.zeros((36, 36))
    system[:35, :35] = between(sources, sources) + np.diag(np.repeat([width / 128, width / 8], [20, 15]))
    system[35, :35] = system[:35, 35] = 1
    weights = np.linalg.solve(system, np.column_stack([between(targets, sources), np.ones(len(targets))]).T)[:35]
    expected = weights.T @ np.concatenate([values[known], there])
    np.testing.assert_allclose(told[~known], expected, atol=1e-4)


def test_kriging_from_the_nearest_of_many_points_is_that_of_scipy():
    random, width = np.random.default_rng(0), 80  # one pixel a cell
    uv, there = random.uniform(0, [width, 30], (500, 2)), random.normal(0, 1, 500)
    told = krige(np.zeros((30, width)), np.zeros((30, width), bool), uv, there, width, OPTIONS)
    targets = np.argwhere(np.ones((30, width)))[:, ::-1] + 0.5
    scipys = RBFInterpolator(uv, there, neighbors=OPTIONS.neighbours, smoothing=width * OPTIONS.point_error, kernel="linear", degree=0)
    np.testing.assert_allclose(told.ravel(), scipys(targets), atol=1e-5)


def test_colour_beyond_is_the_mean_of_what_is_seen_by_distance():
    random, width = np.random.default_rng(0), 80  # one pixel a cell
    known = random.random((12, width)) < 0.2
    values = random.random((*known.shape, 3))
    continued = inverse_distance_weighted(values, known, width, OPTIONS)
    assert (continued[known] == values[known]).all()
    distance = np.linalg.norm(np.argwhere(~known)[:, None] - np.argwhere(known), axis=2)
    weights = 1 / (distance**2 + 0.25) ** 2
    expected = weights @ values[known] / weights.sum(1, keepdims=True)
    np.testing.assert_allclose(continued[~known], expected, atol=1e-5)


def test_a_plane_is_found_and_what_nothing_tells_of_it_is_level():
    u, v = np.random.default_rng(0).uniform(0, 600, (2, 50_000))
    assert fit_plane(u, v, 0.01 * u - 0.02 * v + 9) == pytest.approx((0.01, -0.02, 9), abs=1e-6)
    a, b, c = fit_plane(u, np.full_like(u, 7.0), 0.01 * u + 9)
    assert (a, 7 * b + c) == pytest.approx((0.01, 9), abs=1e-4) and abs(b) < 1


def test_values_stay_near_the_range_that_they_come_from():
    sources = np.linspace(5, 10, 1001)
    clipped = clip_to_range(np.array([-3.0, 4.5, 7.0, 99.0]), sources, InterpolationConfig(margin=0.1))
    np.testing.assert_allclose(clipped, [0.9 * 5.05, 4.545, 7, 1.1 * 9.95])


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (37, 20)])
@pytest.mark.parametrize("channels", [1, 3])
def test_holes_of_any_size_are_filled_with_what_is_around(shape, channels):
    values = np.random.default_rng(0).random((*shape, channels)).astype(np.float32)
    known = np.zeros(shape, bool)
    known[::5, ::3] = True
    filled = inverse_distance_weighted(values, known, shape[1], OPTIONS)
    assert filled.shape == values.shape and (filled[known] == values[known]).all()
    assert values[known].min() - 1e-6 <= filled.min() and filled.max() <= values[known].max() + 1e-6
