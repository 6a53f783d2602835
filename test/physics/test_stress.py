"""Stress shown in the page, against the textbook."""

import cv2
import numpy as np
import pytest

from endo_sim_ros.physics.materials import MATERIALS, Stiffening
from endo_sim_ros.physics.stress import von_mises


@pytest.mark.parametrize("material", MATERIALS)
def test_stress_of_small_strain_is_that_of_the_textbook(material):
    E, nu, strain = 10e3, 0.3, 1e-4
    stretch = np.diag([1 + strain, 1 - nu * strain, 1 - nu * strain])  # uniaxial: E times the strain
    shear = np.eye(3)
    shear[0, 1] = strain  # √3 G times the shear
    found = von_mises(np.stack([stretch, shear, 1.001 * np.eye(3)]), E, nu, material)
    np.testing.assert_allclose(found[:2], [E * strain, 3**0.5 * E / (2 * (1 + nu)) * strain], rtol=0.02)
    assert found[2] < 0.01, "pressure is not counted"


@pytest.mark.parametrize("material", MATERIALS)
def test_turned_tissue_has_no_stress_and_collapsed_tissue_a_finite_one(material):
    turn = cv2.Rodrigues(np.array([0.3, -1.0, 0.5]))[0]
    F = np.stack([turn, np.zeros((3, 3)), -np.eye(3), np.diag([np.inf, 1, 1]), turn @ np.diag([1.2, 1, 1])])
    found = von_mises(F, 10e3, 0.3, material)
    assert np.isfinite(found).all() and found[0] < 1 and not found[1:4].any() and found[4] > 1000


def test_stiffened_tissue_has_as_much_more_stress():
    F = np.diag([1.5, 1.0, 1.0])[None]
    soft, stiff = (von_mises(F, 10e3, 0.0, "fung", Stiffening(2.0, limit))[0] for limit in (1.0, 100.0))
    assert soft == pytest.approx(5000 * (1.5**2 - 1) / 1.5, rel=1e-4)  # σ = μ (s² − 1)/J along the stretch, none across it
    assert stiff == pytest.approx(soft * np.exp(2 * (1.5**2 - 1 - 2 * np.log(1.5))), rel=1e-4)
