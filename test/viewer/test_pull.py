"""The pull of the mouse on tissue."""

import numpy as np
import pytest

from endo_sim_ros.viewer.grasp import Grasp


def pulled(target, stiffness, seconds=4.0, late=3, max_force=2.0, **options):
    """Where a grasp ends up whose tissue is a spring [N/m] that is felt some turns late, and all forces on the way."""
    options = {"max_force": max_force, "max_speed": 0.5, "longest_pull": 0.04} | options
    grasp, forces = Grasp(np.eye(4), **options), [0.0] * late
    grasp.aim(np.asarray(target, float))
    for _ in range(int(seconds / 0.02)):
        forces.append(stiffness * float(np.linalg.norm(grasp.advance(0.02, forces[-late])[:3, 3])))
    return grasp.pose[:3, 3], np.array(forces)


def test_soft_tissue_follows_the_mouse_all_the_way():
    end, forces = pulled([0.01, 0.0, -0.005], stiffness=50)
    np.testing.assert_allclose(end, [0.01, 0.0, -0.005], atol=1e-6)
    assert forces[-1] < 2


@pytest.mark.parametrize("stiffness", [150, 1000, 20000])
def test_stiff_tissue_stops_at_the_largest_force_and_does_not_swing(stiffness):
    end, forces = pulled([0.03, 0, 0], stiffness)
    assert forces[-1] == pytest.approx(2.0, rel=0.02) and forces[-50:].std() < 0.01
    assert end[0] > 0 and not end[1:].any()


def test_pull_is_no_longer_than_the_reach_and_no_faster_than_allowed():
    end, _ = pulled([1.0, 0, 0], stiffness=0)
    assert np.linalg.norm(end) == pytest.approx(0.04)
    end, _ = pulled([1.0, 0, 0], stiffness=0, seconds=0.5, max_speed=0.01)
    assert np.linalg.norm(end) < 0.005


def test_jaw_comes_along_its_axis_and_goes_back():
    grasp = Grasp(np.eye(4), 1.0, 0.1, 0.1, ahead=0.02)
    grasp.aim(np.array([0.1, 0, 0]))
    ways = [grasp.advance(0.05, 0.0)[:3, 3].tolist() for _ in range(4)]
    np.testing.assert_allclose(ways, [[0, 0, z] for z in (-0.015, -0.01, -0.005, 0)], atol=1e-12)
    assert not grasp.closed
    while not grasp.closed:
        grasp.advance(0.05, 0.0)
    pull = grasp.advance(0.05, 0.0)[0, 3]
    assert pull > 0 and grasp.resistance(np.array([2.0, 0, 5.0])) == pytest.approx(2)  # what presses from the side resists no pull
    assert grasp.withdraw(0.1)
    np.testing.assert_allclose(grasp.pose[:3, 3], [pull, 0, -0.01], atol=1e-12)
    assert grasp.withdraw(0.2) and not grasp.withdraw(0.1)
    np.testing.assert_allclose(grasp.pose[:3, 3], [pull, 0, -0.02], atol=1e-12)


def test_jaw_closes_before_it_moves():
    grasp = Grasp(np.eye(4), 1.0, 1.0, 0.1)
    grasp.aim(np.array([0.1, 0, 0]))
    while not grasp.closed:
        assert np.array_equal(grasp.advance(0.01, 0.0), np.eye(4))
    assert grasp.advance(0.01, 0.0)[0, 3] > 0
