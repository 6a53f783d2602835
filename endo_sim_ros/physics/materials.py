"""Materials: hyperelastic laws of which tissue is made, each of the deformation gradient, Lamé's parameters and `Stiffening`.

To add one, write under its name

1. the stress, a struct in native/materials.h, which says how. All kernels compile that one definition: for 16 control nodes
   at a time on a CPU, for one in the plain kernels and in those of a GPU's clusters;
2. its energy density here, a function with a leading underscore and a line in ``MATERIALS``;
3. a choice of `PhysicsConfig.material`.

A further number that is the same for the whole tissue goes into `Stiffening` and, for the kernels, into `Substep`. Tests take it
from ``MATERIALS``: they compare the stress with the gradient of the energy, and all backends with each other.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

LEAST_VOLUME = 0.05  # of that at rest; below it the laws have no value


def lame_parameters(young_modulus: Any, poisson_ratio: Any) -> tuple[Any, Any]:
    """Lamé's parameters (mu, lambda) in Pa of Young's modulus in Pa and Poisson's ratio; of numbers or arrays of them."""
    mu = young_modulus / (2 * (1 + poisson_ratio))
    lam = young_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))
    return mu, lam


def sound_speed(young_modulus: float, poisson_ratio: float, density: float, stiffened: float = 1.0) -> float:
    """Speed of pressure waves √((λ + 2μ s)/ρ) in m/s, the fastest signal in tissue whose shear modulus has grown by s."""
    mu, lam = lame_parameters(young_modulus, poisson_ratio)
    return math.sqrt((lam + 2 * mu * stiffened) / density)


class Stiffening(NamedTuple):
    """How tissue stiffens that is stretched; for laws that do."""

    rate: float = 1.0
    """a in exp(a W); W is about 2 ε:ε of a small strain ε."""
    limit: float = 1.0
    """Largest exp(a W); 1 = none."""


def _fixed_corotated(F: Tensor, mu: Tensor | float, lam: Tensor | float, stiffening: Stiffening) -> Tensor:
    """ψ = μ Σ (σᵢ − 1)² + λ/2 (J − 1)² (Stomakhin et al. 2012)."""
    return mu * ((torch.linalg.svdvals(F) - 1) ** 2).sum(-1) + 0.5 * lam * (torch.linalg.det(F) - 1) ** 2


def _neo_hookean(F: Tensor, mu: Tensor | float, lam: Tensor | float, stiffening: Stiffening) -> Tensor:
    """ψ = μ/2 (tr FᵀF − 3) − μ ln J + λ/2 (ln J)²."""
    log_J = torch.linalg.det(F).log()
    return 0.5 * mu * ((F * F).sum((-2, -1)) - 3) - mu * log_J + 0.5 * lam * log_J**2


def _fung(F: Tensor, mu: Tensor | float, lam: Tensor | float, stiffening: Stiffening) -> Tensor:
    """ψ = μ/(2a) (exp(a W) − 1) + λ/2 (ln J)², W = tr FᵀF − 3 − 2 ln J, and linear in W from the limit on (Fung 1967, Demiray 1972).

    Neo-Hookean at rest. Tension, shear and compression stiffen it alike, and no stretch makes it infinitely stiff.
    """
    rate, limit = stiffening
    log_J = torch.linalg.det(F).log()
    W = (F * F).sum((-2, -1)) - 3 - 2 * log_J
    within = W.clamp(max=math.log(limit) / rate)
    return 0.5 * mu * (torch.expm1(rate * within) / rate + limit * (W - within)) + 0.5 * lam * log_J**2


def _tangent_of_fung(stiffening: Stiffening) -> float:
    """P = μ exp(a W) dW/dF / 2 grows fastest along a stretch ε at the limit: by exp(a W) (1 + 2 a W), as W is about 2 ε²."""
    return stiffening.limit * (1 + 2 * math.log(stiffening.limit))


class Material(NamedTuple):
    """What Python knows of a material."""

    energy: Callable[[Tensor, Tensor | float, Tensor | float, Stiffening], Tensor]
    """Energy density ψ [...], J/m³, of deformation gradients [..., 3, 3] with det F > 0, Lamé's parameters, Pa, and stiffening."""
    fast_math: bool = False
    """Whether a GPU's approximate quotients and roots are good enough for the stress."""
    tangent: Callable[[Stiffening], float] = lambda stiffening: 1.0
    """Largest ratio of the shear modulus, as waves meet it in strained tissue, to that at rest; it bounds the substeps."""


MATERIALS = {
    "fixed_corotated": Material(_fixed_corotated, fast_math=True),
    "neo_hookean": Material(_neo_hookean),
    "fung": Material(_fung, tangent=_tangent_of_fung),
}


def energy_density(material: str, F: Tensor, mu: Tensor | float, lam: Tensor | float, stiffening: Stiffening = Stiffening()) -> Tensor:
    """Elastic energy density ψ [...] in J/m³ of deformation gradients F [..., 3, 3] with det F > 0.

    Args:
        material: Name in ``MATERIALS``.
        F: Deformation gradients.
        mu: Lamé's first parameter, Pa, one or [...].
        lam: The second.
        stiffening: Of laws that stiffen.
    """
    return MATERIALS[material].energy(F, mu, lam, stiffening)
