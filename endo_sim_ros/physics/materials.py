"""Materials: hyperelastic laws, and the relaxation that may act beside each of them.

A material is one ``@wp.func`` that maps the deformation gradient F and Lamé's parameters to the first Piola-Kirchhoff
stress P = ∂ψ/∂F [Pa] (exactly zero at F = I, so that a rest state stays at rest bit for bit), one torch function with
the same name and a leading underscore that gives its energy density ψ [J/m³], and one line in ``MATERIALS``. On a CPU
it is fast if ``mpm_simd_kernels.STRESSES`` has a vectorised twin of it, and runs from this one function if not.
The Kirchhoff stress is τ = P Fᵀ (``kirchhoff_stress``).
"""

import math

import torch
import warp as wp
from torch import Tensor

wp.set_module_options({"enable_backward": False})


def lame_parameters(young_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """Lamé's parameters (mu, lambda) in Pa of Young's modulus in Pa and Poisson's ratio."""
    mu = young_modulus / (2 * (1 + poisson_ratio))
    lam = young_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))
    return mu, lam


def sound_speed(young_modulus: float, poisson_ratio: float, density: float) -> float:
    """Speed of pressure waves √((λ + 2μ)/ρ) in m/s, the fastest signal in the tissue."""
    mu, lam = lame_parameters(young_modulus, poisson_ratio)
    return math.sqrt((lam + 2 * mu) / density)


@wp.func
def cofactor(F: wp.mat33) -> wp.mat33:
    """Cofactor matrix det(F) F⁻ᵀ, defined for singular F as well."""
    a, b, c = wp.vec3(F[0, 0], F[1, 0], F[2, 0]), wp.vec3(F[0, 1], F[1, 1], F[2, 1]), wp.vec3(F[0, 2], F[1, 2], F[2, 2])
    return wp.matrix_from_cols(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))


@wp.func
def rotation_of(F: wp.mat33) -> wp.mat33:
    """Rotation R of the polar decomposition F = R S.

    Newton's iteration R ← (R + R⁻ᵀ)/2 (Higham 1986) for healthy F, which stays exact at the identity; near-singular and
    inverted F go through the singular value decomposition, whose factors are proper rotations.
    """
    J = wp.determinant(F)
    size = wp.ddot(F, F)
    R = F
    if J > 0.02 * size * wp.sqrt(size):
        for _ in range(12):
            following = 0.5 * R + (0.5 / wp.determinant(R)) * cofactor(R)
            change = following - R
            R = following
            if wp.ddot(change, change) < 1.0e-9:  # quadratic convergence: the next change would be below rounding
                break
    else:
        U = wp.mat33()
        sigma = wp.vec3()
        V = wp.mat33()
        wp.svd3(F, U, sigma, V)
        R = U * wp.transpose(V)
    return R


@wp.func
def fixed_corotated(F: wp.mat33, mu: float, lam: float) -> wp.mat33:
    """P = 2μ (F − R) + λ (J − 1) cof F (Stomakhin et al. 2012)."""
    return 2.0 * mu * (F - rotation_of(F)) + lam * (wp.determinant(F) - 1.0) * cofactor(F)


def _fixed_corotated(F: Tensor, mu: float, lam: float) -> Tensor:
    """ψ = μ Σ (σᵢ − 1)² + λ/2 (J − 1)² of F [..., 3, 3] with det F > 0, in J/m³."""
    return mu * ((torch.linalg.svdvals(F) - 1) ** 2).sum(-1) + 0.5 * lam * (torch.linalg.det(F) - 1) ** 2


@wp.func
def neo_hookean(F: wp.mat33, mu: float, lam: float) -> wp.mat33:
    """P = μ (F − F⁻ᵀ) + λ ln J F⁻ᵀ; below J = 0.05 the resistance is held, as the logarithm has no value there."""
    J = wp.max(wp.determinant(F), 0.05)
    inverse_transpose = cofactor(F) / J
    return mu * (F - inverse_transpose) + lam * wp.log(J) * inverse_transpose


def _neo_hookean(F: Tensor, mu: float, lam: float) -> Tensor:
    """ψ = μ/2 (tr FᵀF − 3) − μ ln J + λ/2 (ln J)² of F [..., 3, 3] with det F > 0, in J/m³."""
    log_J = torch.linalg.det(F).log()
    return 0.5 * mu * ((F * F).sum((-2, -1)) - 3) - mu * log_J + 0.5 * lam * log_J**2


@wp.func
def second_piola(F: wp.mat33, P: wp.mat33) -> wp.mat33:
    """S = F⁻¹ P, the stress that a rotation of the tissue does not change; finite for collapsed F as well."""
    return (1.0 / wp.max(wp.determinant(F), 0.05)) * (wp.transpose(cofactor(F)) * P)


@wp.func
def maxwell(F: wp.mat33, P: wp.mat33, relaxed: wp.mat33, ratio: float) -> wp.mat33:
    """P of an elastic law with a Maxwell branch beside it (standard linear solid; Simo 1987): P + g (P − F Q).

    The branch has g times the stiffness of the law, of which it has forgotten Q, which follows S: dQ/dt = (S − Q)/τ.
    Fast tissue is 1 + g times as stiff as tissue at rest, and held tissue relaxes with the time τ.

    Args:
        F: Deformation gradient.
        P: First Piola-Kirchhoff stress of the elastic law, Pa.
        relaxed: Q, a second Piola-Kirchhoff stress, Pa.
        ratio: g.
    """
    return P + ratio * (P - F * relaxed)


@wp.func
def kirchhoff_stress(P: wp.mat33, F: wp.mat33) -> wp.mat33:
    """τ = P Fᵀ."""
    return P * wp.transpose(F)


MATERIALS = {"fixed_corotated": (fixed_corotated, _fixed_corotated), "neo_hookean": (neo_hookean, _neo_hookean)}


def energy_density(material: str, F: Tensor, mu: float, lam: float) -> Tensor:
    """Elastic energy density ψ [...] in J/m³ of deformation gradients F [..., 3, 3]."""
    return MATERIALS[material][1](F, mu, lam)
