"""The options of tissues against what their sources measured (docs/physics.md)."""

import numpy as np
import pytest
import torch

from endo_sim_ros.physics import TISSUES, lame_parameters, tissue
from endo_sim_ros.physics.materials import Stiffening, energy_density


def fast_shear_modulus(name: str) -> float:
    config = tissue(name)
    return (1 + config.relaxation) * lame_parameters(config.young_modulus, config.poisson_ratio)[0]


@pytest.mark.parametrize(("name", "modulus"), [("liver", 1.8e3), ("gall_bladder", 85e3), ("fat", 752.0)])
def test_fast_shear_has_the_modulus_that_was_measured(name, modulus):
    assert fast_shear_modulus(name) == pytest.approx(modulus, rel=0.03)


@pytest.mark.parametrize(("name", "strain", "strength"), [("liver", 0.38, 0.27e6), ("gall_bladder", 0.43, 2.5e6)])
def test_tissue_that_keeps_its_volume_bears_its_strength_where_it_tears(name, strain, strength):
    assert tissue(name).tear_strain == strain
    stretch = np.exp(strain)
    factor = np.exp(tissue(name).stiffening * (stretch**2 + 2 / stretch - 3))
    assert fast_shear_modulus(name) * factor * (stretch**2 - 1 / stretch) == pytest.approx(strength, rel=0.05)


def test_fat_that_is_pressed_stiffens_as_elastography_saw():
    stretch = np.array([0.7, 0.8])
    factor = np.exp(tissue("fat").stiffening * (stretch**2 + 2 / stretch - 3))
    np.testing.assert_allclose(factor, (stretch**2) ** -1.18, rtol=0.15)


def test_lung_has_the_stress_of_the_published_law():
    """Birzle et al. 2019, with sides that bear nothing: the lateral stretch has the least energy."""
    config, young, nu = tissue("lung"), 1913.7, 0.3413
    c, beta = young / (4 * (1 + nu)), nu / (1 - 2 * nu)

    def published(F: torch.Tensor) -> torch.Tensor:
        first, third = (F * F).sum((1, 2)), torch.linalg.det(F) ** 2
        shape = 278.2 * (third ** (-1 / 3) * first - 3) ** 3
        return c * (first - 3) + c / beta * (third**-beta - 1) + shape + 5.766 * (third ** (1 / 3) - 1) ** 6

    mu, lam = lame_parameters(config.young_modulus, config.poisson_ratio)
    laws = [published, lambda F: energy_density("fung", F, mu, lam, Stiffening(config.stiffening, 1000.0))]
    laws.append(lambda F: energy_density("neo_hookean", F, mu, lam))
    side = torch.linspace(0.7, 1.3, 6001, dtype=torch.float64)
    along = np.linspace(0.7, 1.5, 33)
    energies = np.zeros((3, len(along)))
    for i, stretch in enumerate(along):
        F = torch.stack([torch.full_like(side, stretch), side, side], 1).diag_embed()
        energies[:, i] = [float(law(F).min()) for law in laws]
    stress = np.gradient(energies, along, axis=1)[:, 1:-1]
    error = np.sqrt(((stress - stress[0]) ** 2).mean(1)) / np.abs(stress[0]).max()
    assert error[1] < 0.025 and error[2] > 3 * error[1]


def test_relaxation_is_that_of_the_sources():
    assert 1 + tissue("liver").relaxation == pytest.approx(2.04 / 0.91, rel=0.01)
    lung = tissue("lung")
    breathing = 2 * np.pi * 0.25 * lung.relaxation_time  # ω τ
    modulus = 1 + lung.relaxation * 1j * breathing / (1 + 1j * breathing)
    assert modulus.imag / modulus.real == pytest.approx(0.1, rel=0.02)
    assert {name for name in TISSUES if tissue(name).relaxation} == {"liver", "lung"}
