"""Materials: their options, stress against energy, rotations and Hooke's law."""

import numpy as np
import pytest
import torch
import warp as wp
from tissue_scene import random_rotations

from endo_sim_ros.core.config import ConfigError, options
from endo_sim_ros.core.device import init_warp
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.native import native
from endo_sim_ros.physics import PhysicsConfig, Skinning, lame_parameters, sound_speed
from endo_sim_ros.physics.backends.structs import Substep
from endo_sim_ros.physics.materials import MATERIALS, Stiffening, energy_density

STIFFENING = Stiffening(1.5, 2.0)


def test_every_option_has_a_description_and_every_material_is_a_choice():
    assert all(option.description for option in options(PhysicsConfig))
    material = next(option for option in options(PhysicsConfig) if option.name == "material")
    assert set(material.choices) == set(MATERIALS)
    assert PhysicsConfig().step_duration == pytest.approx(0.04)
    with pytest.raises(ConfigError, match="poisson_ratio"):
        PhysicsConfig(poisson_ratio=0.5)


LANES = {"float": 1, "endo_sim::vfloat": 16}  # control nodes at a time: on a GPU and in the plain kernels; in a CPU's vectors


def stresses(material: str, number: str, F: np.ndarray, stiffening: Stiffening = STIFFENING) -> tuple[np.ndarray, np.ndarray]:
    """P and τ [N, 3, 3] of F [N, 3, 3] for μ = 2 and λ = 3, as a kernel computes them for so many control nodes at a time."""

    @wp.func_native(f"""
        typedef {number} T;
        constexpr int lanes = endo_sim::Lanes<T>::count;
        T f[9] = {{}}, p[9], t[9];
        for (int lane = 0; lane < lanes; ++lane)
            for (int i = 0; i < 9; ++i)
                endo_sim::set_lane(f[i], lane, F.data[lanes * n + lane].data[i / 3][i % 3]);
        endo_sim::{material}::stress(f, endo_sim::everywhere<T>(2.0f), endo_sim::everywhere<T>(3.0f), substep, p);
        for (int i = 0; i < 9; ++i)
            t[i] = p[i];
        endo_sim::kirchhoff(f, t);
        for (int lane = 0; lane < lanes; ++lane)
            for (int i = 0; i < 9; ++i) {{
                P.data[lanes * n + lane].data[i / 3][i % 3] = endo_sim::lane_of(p[i], lane);
                tau.data[lanes * n + lane].data[i / 3][i % 3] = endo_sim::lane_of(t[i], lane);
            }}
    """)
    def stress(n: int, substep: Substep, F: wp.array[wp.mat33], P: wp.array[wp.mat33], tau: wp.array[wp.mat33]): ...

    @wp.kernel(enable_backward=False, module="unique", module_options={"extra_build_options": native("physics/native/node.h")})
    def evaluate(substep: Substep, F: wp.array[wp.mat33], P: wp.array[wp.mat33], tau: wp.array[wp.mat33]):
        stress(wp.tid(), substep, F, P, tau)

    init_warp()
    padded = np.tile(np.eye(3, dtype=np.float32), (-(-len(F) // 16) * 16, 1, 1))
    padded[: len(F)] = F
    gradients = wp.array(padded, dtype=wp.mat33, device="cpu")
    P, tau = wp.empty_like(gradients), wp.empty_like(gradients)
    substep = Substep()
    substep.stiffening, substep.largest_exponent = stiffening.rate, np.log(stiffening.limit)
    wp.launch(evaluate, len(padded) // LANES[number], [substep, gradients, P, tau], device="cpu")
    return P.numpy()[: len(F)], tau.numpy()[: len(F)]


@pytest.mark.parametrize("number", LANES)
@pytest.mark.parametrize("material", MATERIALS)
def test_stress_is_the_gradient_of_the_energy(material, number):
    rng = np.random.default_rng(2)
    F = random_rotations(64) @ (np.eye(3) + 0.25 * rng.uniform(-1, 1, (64, 3, 3)))
    F = F[np.linalg.det(F) > 0.2]
    leaf = torch.from_numpy(F).requires_grad_()
    energy_density(material, leaf, 2.0, 3.0, STIFFENING).sum().backward()
    P, tau = stresses(material, number, F)
    np.testing.assert_allclose(P, leaf.grad.numpy(), atol=3e-5)
    np.testing.assert_allclose(tau, leaf.grad.numpy() @ F.transpose(0, 2, 1), atol=3e-5)
    assert np.abs(P).max() > 0.5


@pytest.mark.parametrize("number", LANES)
@pytest.mark.parametrize("material", MATERIALS)
def test_rigid_rotation_gives_no_stress_and_rest_gives_exactly_none(material, number):
    P, _ = stresses(material, number, random_rotations(64))
    np.testing.assert_allclose(P, 0, atol=5e-6)
    assert not np.any(stresses(material, number, np.eye(3)[None])[0])


@pytest.mark.parametrize("number", LANES)
@pytest.mark.parametrize("material", MATERIALS)
def test_inverted_and_collapsed_matter_has_finite_stress(material, number):
    F = np.stack([np.diag([1.0, 1.0, -0.5]), np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), -np.eye(3)])
    assert np.isfinite(stresses(material, number, F)[0]).all()


@pytest.mark.parametrize("number", LANES)
@pytest.mark.parametrize("material", MATERIALS)
def test_stress_turns_with_the_tissue(material, number):
    R, F = random_rotations(16), np.eye(3) + 0.2 * np.random.default_rng(4).uniform(-1, 1, (16, 3, 3))
    np.testing.assert_allclose(stresses(material, number, R @ F)[0], R @ stresses(material, number, F)[0], atol=3e-5)


@pytest.mark.parametrize("number", LANES)
def test_fung_is_what_the_equation_says_in_shear_and_in_uniaxial_strain(number):
    """μ = 2, λ = 3; on both sides of the limit, exp(1.5 W) = 2 at W = 0.46."""
    shear, stretch = np.linspace(-1.0, 1.0, 32), np.linspace(0.4, 1.9, 32)
    F = np.tile(np.eye(3), (64, 1, 1))
    F[:32, 0, 1], F[32:, 0, 0] = shear, stretch
    P, _ = stresses("fung", number, F)
    factor = np.minimum(np.exp(1.5 * shear**2), 2.0)
    assert (factor == 2).any() and (factor < 1.5).any()
    np.testing.assert_allclose(P[:32, 0, 1], 2 * factor * shear, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(P[:32, 0, 0], 0, atol=1e-5)
    factor = np.minimum(np.exp(1.5 * (stretch**2 - 1 - 2 * np.log(stretch))), 2.0)
    np.testing.assert_allclose(P[32:, 0, 0], 2 * factor * (stretch - 1 / stretch) + 3 * np.log(stretch) / stretch, rtol=2e-5, atol=1e-5)


@pytest.mark.parametrize("number", LANES)
def test_fung_is_neo_hookean_without_stiffening_and_as_many_times_stiffer_beyond_the_limit(number):
    F = random_rotations(32) @ (np.eye(3) + 0.3 * np.random.default_rng(5).uniform(-1, 1, (32, 3, 3)))
    np.testing.assert_array_equal(stresses("fung", number, F, Stiffening(5.0, 1.0))[0], stresses("neo_hookean", number, F)[0])
    huge = np.diag([1e15, 1.0, 1.0])[None]  # whose square float32 still holds
    P = stresses("fung", number, huge, Stiffening(5.0, 7.0))[0]
    assert np.isfinite(P).all() and P[0, 0, 0] == pytest.approx(7 * 2 * 1e15, rel=1e-5)


def test_the_tangent_that_substeps_are_planned_for_is_met_in_small_strain_and_nowhere_passed_in_tension():
    stretch = torch.linspace(1.0, 2.5, 4000, dtype=torch.float64)
    for rate, limit in ((200.0, 3.0), (5.0, 5.0), (1.0, 2.0)):
        F = torch.eye(3, dtype=torch.float64).repeat(len(stretch), 1, 1)
        F[:, 0, 0] = stretch
        P = torch.gradient(energy_density("fung", F, 1.0, 0.0, Stiffening(rate, limit)), spacing=(stretch,))[0]
        tangent = float(torch.gradient(P, spacing=(stretch,))[0][2:-2].max()) / 2
        planned = MATERIALS["fung"].tangent(Stiffening(rate, limit))
        assert tangent < 1.001 * planned
        assert rate < 200 or tangent > 0.9 * planned


def test_polar_rotation_is_proper_and_nearest():
    rng = np.random.default_rng(3)
    F = rng.normal(size=(200, 3, 3))
    U, _, Vt = np.linalg.svd(F)
    U[np.linalg.det(U @ Vt) < 0, :, 2] *= -1
    points = torch.from_numpy(rng.normal(size=(200, 3))).float()
    model = GaussianModel.from_points(points, torch.zeros(200, 3), torch.ones(200))  # each Gaussian is a control node
    R = Skinning(model, points, neighbours=1, device="cpu").rotations(F).numpy()
    near_tie = np.abs(np.linalg.svd(F)[1][:, 2]) < 0.05  # the rotation is ill-conditioned there
    np.testing.assert_allclose(R[~near_tie], (U @ Vt)[~near_tie], atol=2e-3)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-4)


@pytest.mark.parametrize("number", LANES)
@pytest.mark.parametrize("material", MATERIALS)
def test_small_strains_obey_hooke(material, number):
    strain = np.diag([1e-3, -2e-4, -2e-4])
    P, _ = stresses(material, number, (np.eye(3) + strain)[None])
    np.testing.assert_allclose(P[0], 4.0 * strain + 3.0 * np.trace(strain) * np.eye(3), atol=2e-5)


def test_sound_speed_of_the_default_tissue():
    mu, lam = lame_parameters(10e3, 0.3)
    assert (mu, lam) == pytest.approx((3846.15, 5769.23), rel=1e-5)
    assert sound_speed(10e3, 0.3, 1000) == pytest.approx(3.669, rel=1e-3)
