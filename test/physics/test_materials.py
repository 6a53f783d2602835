"""Materials: their options, stress against energy, rotations and Hooke's law."""

import numpy as np
import pytest
import torch
import warp as wp
from tissue_scene import random_rotations

from endo_sim_ros.core.config import ConfigError, options
from endo_sim_ros.physics import PhysicsConfig, lame_parameters, sound_speed
from endo_sim_ros.physics.materials import MATERIALS, energy_density, kirchhoff_stress, rotation_of


def test_every_option_has_a_description_and_every_material_is_a_choice():
    assert all(option.description for option in options(PhysicsConfig))
    material = next(option for option in options(PhysicsConfig) if option.name == "material")
    assert set(material.choices) == set(MATERIALS)
    assert PhysicsConfig().step_duration == pytest.approx(0.04)
    with pytest.raises(ConfigError, match="poisson_ratio"):
        PhysicsConfig(poisson_ratio=0.5)


@wp.kernel(enable_backward=False)
def _rotations(F: wp.array[wp.mat33], R: wp.array[wp.mat33]):
    i = wp.tid()
    R[i] = rotation_of(F[i])


def _stress_kernel(material):
    stress = MATERIALS[material][0]

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(F: wp.array[wp.mat33], mu: float, lam: float, P: wp.array[wp.mat33], tau: wp.array[wp.mat33]):
        i = wp.tid()
        P[i] = stress(F[i], mu, lam)
        tau[i] = kirchhoff_stress(P[i], F[i])

    return evaluate


def stresses(material: str, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """P and τ [N, 3, 3] of F [N, 3, 3] for μ = 2 and λ = 3."""
    F = wp.array(F.astype(np.float32), dtype=wp.mat33, device="cpu")
    P, tau = wp.empty_like(F), wp.empty_like(F)
    wp.launch(_stress_kernel(material), len(F), [F, 2.0, 3.0, P, tau], device="cpu")
    return P.numpy(), tau.numpy()


@pytest.mark.parametrize("material", MATERIALS)
def test_stress_is_the_gradient_of_the_energy(material):
    rng = np.random.default_rng(2)
    F = random_rotations(64) @ (np.eye(3) + 0.25 * rng.uniform(-1, 1, (64, 3, 3)))
    F = F[np.linalg.det(F) > 0.2]
    leaf = torch.from_numpy(F).requires_grad_()
    energy_density(material, leaf, 2.0, 3.0).sum().backward()
    P, tau = stresses(material, F)
    np.testing.assert_allclose(P, leaf.grad.numpy(), atol=3e-5)
    np.testing.assert_allclose(tau, leaf.grad.numpy() @ F.transpose(0, 2, 1), atol=3e-5)
    assert np.abs(P).max() > 0.5


@pytest.mark.parametrize("material", MATERIALS)
def test_rigid_rotation_gives_no_stress_and_rest_gives_exactly_none(material):
    P, _ = stresses(material, random_rotations(64))
    np.testing.assert_allclose(P, 0, atol=5e-6)
    assert not np.any(stresses(material, np.eye(3)[None])[0])


@pytest.mark.parametrize("material", MATERIALS)
def test_inverted_and_collapsed_matter_has_finite_stress(material):
    F = np.stack([np.diag([1.0, 1.0, -0.5]), np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), -np.eye(3)])
    assert np.isfinite(stresses(material, F)[0]).all()


def test_polar_rotation_is_proper_and_nearest():
    rng = np.random.default_rng(3)
    F = rng.normal(size=(200, 3, 3))
    U, _, Vt = np.linalg.svd(F)
    U[np.linalg.det(U @ Vt) < 0, :, 2] *= -1
    R = wp.empty(200, dtype=wp.mat33, device="cpu")
    wp.launch(_rotations, 200, [wp.array(F.astype(np.float32), dtype=wp.mat33, device="cpu"), R], device="cpu")
    near_tie = np.abs(np.linalg.svd(F)[1][:, 2]) < 0.05  # the rotation is ill-conditioned there
    np.testing.assert_allclose(R.numpy()[~near_tie], (U @ Vt)[~near_tie], atol=2e-3)
    np.testing.assert_allclose(np.linalg.det(R.numpy()), 1, atol=1e-4)


def test_small_strains_obey_hooke():
    strain = np.diag([1e-3, -2e-4, -2e-4])
    for material in MATERIALS:
        P, _ = stresses(material, (np.eye(3) + strain)[None])
        np.testing.assert_allclose(P[0], 4.0 * strain + 3.0 * np.trace(strain) * np.eye(3), atol=2e-5)


def test_sound_speed_of_the_default_tissue():
    mu, lam = lame_parameters(10e3, 0.3)
    assert (mu, lam) == pytest.approx((3846.15, 5769.23), rel=1e-5)
    assert sound_speed(10e3, 0.3, 1000) == pytest.approx(3.669, rel=1e-3)
