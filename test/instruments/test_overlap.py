"""How deep instruments are in each other."""

import numpy as np
import pytest

from endo_sim_ros.instruments import Capsule
from endo_sim_ros.instruments.overlap import overlap


def placed(*places):
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return {"shaft": poses}


def test_capsules_that_cross_lie_beside_each_other_or_end_before_are_told_apart():
    along = [Capsule("shaft", np.array([-0.1, 0, 0]), np.array([0.1, 0, 0]), 0.004)]
    across = [Capsule("shaft", np.array([0, -0.1, 0]), np.array([0, 0.1, 0]), 0.003)]
    here = placed(*[(0, 0, 0)] * 4)
    there = placed((0, 0, 0.005), (0, 0, 0.008), (0.1015, 0, 0), (0, 0.102, 0.004))
    deep = overlap((along, here), (across, there))
    np.testing.assert_allclose(deep, [0.002, 0, 0.0055, 0.007 - np.hypot(0.002, 0.004)], atol=1e-9)
    beside = overlap((along, here), (along, placed((0, 0.006, 0), (0, 0.009, 0), (0.205, 0, 0), (0.3, 0, 0))))
    np.testing.assert_allclose(beside, [0.002, 0, 0.003, 0], atol=1e-9)


def test_it_is_what_many_points_of_the_segments_give():
    rng = np.random.default_rng(0)
    share = np.linspace(0, 1, 400)[:, None]
    for _ in range(20):
        ends = rng.uniform(-0.02, 0.02, (2, 2, 3))
        first, second = ([Capsule("shaft", *pair, 0.01)] for pair in ends)
        points = [a + share * (b - a) for a, b in ends]
        nearest = np.linalg.norm(points[0][:, None] - points[1], axis=2).min()
        found = overlap((first, placed((0, 0, 0))), (second, placed((0, 0, 0))))
        assert found == pytest.approx([max(0.02 - nearest, 0)], abs=1e-4)
