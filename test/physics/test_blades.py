"""Blades: what they sweep, and mapped back to rest."""

import numpy as np
import pytest
from cut_block import MIDDLE, block, wall

from endo_sim_ros.physics.cutting.blade import Blade, to_rest
from endo_sim_ros.physics.cutting.geometry import separated, sweep


def test_a_sweep_is_the_quad_between_two_blades():
    triangles = sweep([[0, 0, 0], [0, 0, 2]], [[3, 0, 0], [3, 0, 2]])
    assert triangles.shape == (2, 3, 3)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(6)
    assert (normals @ normals.T > 0).all()  # wound alike


@pytest.mark.parametrize("motion", [(0, 0, 0), (0, 0, 0.01), (1e-8, 0, 0)])
def test_a_blade_at_rest_or_drawn_along_itself_cuts_nothing(motion):
    blade = np.array([[0.1, 0.2, 0.3], [0.1, 0.2, 0.33]])
    assert sweep(blade, blade + motion).shape == (0, 3, 3)


def test_a_blade_turned_about_its_end_sweeps_one_triangle():
    assert len(sweep([[0, 0, 0], [0, 0, 1]], [[0, 0, 0], [0, 1, 1]])) == 1


def test_sweep_names_the_shapes_it_cannot_use():
    with pytest.raises(ValueError, match=r"\(2, 3\).*\(3, 3\)"):
        sweep(np.zeros((2, 3)), np.zeros((3, 3)))


def test_to_rest_inverts_an_affine_deformation_exactly():
    rng = np.random.default_rng(0)
    rest, points = block(jitter=0.3), rng.uniform([-0.01] * 3, [0.07, 0.05, 0.03], (50, 3))
    A, shift = np.eye(3) + rng.uniform(-0.4, 0.4, (3, 3)), np.array([1.0, -2.0, 3.0])
    found, inside = to_rest(points @ A.T + shift, rest, rest @ A.T + shift, np.tile(A, (len(rest), 1, 1)))
    assert inside.all()
    np.testing.assert_allclose(found, points, atol=1e-12)


def test_to_rest_of_collapsed_or_broken_nodes_stays_near():
    rest = block()
    F = np.tile(np.eye(3), (len(rest), 1, 1))
    F[::3, 2, 2], F[1::3, 0, 0] = 1e-9, np.nan
    points = np.array([[0.03, 0.02, 0.01], [0.011, 0.012, 0.013]])
    np.testing.assert_allclose(to_rest(points, rest, rest, F)[0], points, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_to_rest_works_with_few_nodes(count):
    rest = block()[:count]
    np.testing.assert_allclose(to_rest(rest, rest, rest + 0.5, np.tile(np.eye(3), (count, 1, 1)))[0], rest - 0.5, atol=1e-12)


def knife(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    """Pose of a tool whose edge stands along z, below the tip."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def still(rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return rest, rest, np.tile(np.eye(3), (len(rest), 1, 1))


def test_a_trembling_blade_cuts_nothing_and_a_slow_one_as_much_as_a_fast_one():
    rest, none = block(), np.zeros((0, 3, 3))
    blade, rng = Blade(0.03, 0.005), np.random.default_rng(0)
    assert not len(blade.move(knife(0.021, 0.02, 0.025), *still(rest), none))
    for _ in range(100):
        tremor = rng.uniform(-1e-4, 1e-4, 3)
        assert not len(blade.move(knife(*(tremor + [0.021, 0.02, 0.025])), *still(rest), none))
    areas = []
    for steps in (200, 4):
        blade, triangles = Blade(0.03, 0.005), [none]
        for y in np.linspace(-0.02, 0.06, steps + 1):
            triangles.append(blade.move(knife(0.021, y, 0.025), *still(rest), none))
        corners = np.concatenate(triangles)
        areas.append(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2)
        np.testing.assert_allclose(corners[..., 0], 0.021, atol=1e-12)
        a, b = rest[rest[:, 0] < 0.021][:40], rest[rest[:, 0] > 0.021][:40]
        assert separated(a, b * [1, 0, 0] + a * [0, 1, 1], corners).all()
    np.testing.assert_allclose(areas[0], areas[1], rtol=0.15)  # both end a spacing beside the tissue


def test_a_blade_in_the_air_or_in_an_open_wound_cuts_nothing():
    rest, cut = block(), wall()
    wide = rest + [0.02, 0, 0] * (rest[:, :1] > MIDDLE)  # the wound is open by 2 cm
    F = np.tile(np.eye(3), (len(rest), 1, 1))
    for x in (MIDDLE + 0.003, MIDDLE + 0.01, MIDDLE + 0.017):  # beside one lip, between, beside the other
        blade = Blade(0.03, 0.005)
        for step in range(5):
            assert not len(blade.move(knife(x + 0.0006 * step, 0.005 * step, 0.025), rest, wide, F, cut))
    blade, triangles = Blade(0.03, 0.005), []
    for y in np.linspace(0.0, 0.04, 9):  # in the lip itself it does cut
        triangles.append(blade.move(knife(MIDDLE + 0.028, y, 0.025), rest, wide, F, cut))
    np.testing.assert_allclose(np.concatenate(triangles)[..., 0], MIDDLE + 0.008, atol=1e-9)
    blade = Blade(0.01, 0.005)
    for x in (-0.02, -0.01):
        assert not len(blade.move(knife(x, 0.02, 0.01), *still(rest), np.zeros((0, 3, 3))))
