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
from endo_sim_ros.physics.materials import MATERIALS, energy_density


def test_every_option_has_a_description_and_every_material_is_a_choice():
    assert all(option.description for option in options(PhysicsConfig))
    material = next(option for option in options(PhysicsConfig) if option.name == "material")
    assert set(material.choices) == set(MATERIALS)
    assert PhysicsConfig().step_duration == pytest.approx(0.04)
    with pytest.raises(ConfigError, match="poisson_ratio"):
        PhysicsConfig(poisson_ratio=0.5)


LANES = {"float": 1, "endo_sim::vfloat": 16}  # control nodes at a time: on a GPU and in the plain kernels; in a CPU's vectors


def stresses(material: str, number: str, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """P and τ [N, 3, 3] of F [N, 3, 3] for μ = 2 and λ = 3, as a kernel computes them for so many control nodes at a time."""

    @wp.func_native(f"""
        typedef {number} T;
        constexpr int lanes = endo_sim::Lanes<T>::count;
        T f[9] = {{}}, p[9], t[9];
        for (int lane = 0; lane < lanes; ++lane)
            for (int i = 0; i < 9; ++i)
                endo_sim::set_lane(f[i], lane, F.data[lanes * n + lane].data[i / 3][i % 3]);
        endo_sim::{material}::stress(f, endo_sim::everywhere<T>(2.0f), endo_sim::everywhere<T>(3.0f), p);
        for (int i = 0; i < 9; ++i)
            t[i] = p[i];
        endo_sim::kirchhoff(f, t);
        for (int lane = 0; lane < lanes; ++lane)
            for (int i = 0; i < 9; ++i) {{
                P.data[lanes * n + lane].data[i / 3][i % 3] = endo_sim::lane_of(p[i], lane);
                tau.data[lanes * n + lane].data[i / 3][i % 3] = endo_sim::lane_of(t[i], lane);
            }}
    """)
    def stress(n: int, F: wp.array[wp.mat33], P: wp.array[wp.mat33], tau: wp.array[wp.mat33]): ...

    @wp.kernel(enable_backward=False, module="unique", module_options={"extra_build_options": native("physics/native/node.h")})
    def evaluate(F: wp.array[wp.mat33], P: wp.array[wp.mat33], tau: wp.array[wp.mat33]):
        stress(wp.tid(), F, P, tau)

    init_warp()
    padded = np.tile(np.eye(3, dtype=np.float32), (-(-len(F) // 16) * 16, 1, 1))
    padded[: len(F)] = F
    gradients = wp.array(padded, dtype=wp.mat33, device="cpu")
    P, tau = wp.empty_like(gradients), wp.empty_like(gradients)
    wp.launch(evaluate, len(padded) // LANES[number], [gradients, P, tau], device="cpu")
    return P.numpy()[: len(F)], tau.numpy()[: len(F)]


@pytest.mark.parametrize("number", LANES)
@pytest.mark.parametrize("material", MATERIALS)
def test_stress_is_the_gradient_of_the_energy(material, number):
    rng = np.random.default_rng(2)
    F = random_rotations(64) @ (np.eye(3) + 0.25 * rng.uniform(-1, 1, (64, 3, 3)))
    F = F[np.linalg.det(F) > 0.2]
    leaf = torch.from_numpy(F).requires_grad_()
    energy_density(material, leaf, 2.0, 3.0).sum().backward()
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
