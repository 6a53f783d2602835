"""How hard the tissue is strained, from the deformation gradients of its nodes."""

import numpy as np
import torch

from endo_sim_ros.physics.materials import LEAST_VOLUME, Stiffening, energy_density, lame_parameters


def von_mises(
    F: np.ndarray,
    young_modulus: float | np.ndarray,
    poisson_ratio: float | np.ndarray,
    material: str = "fixed_corotated",
    stiffening: Stiffening = Stiffening(),
) -> np.ndarray:
    """Von Mises stress √(3/2 s:s), s the deviator of the Cauchy stress σ = P Fᵀ / J with P = ∂ψ/∂F.

    Args:
        F: Deformation gradients [M, 3, 3].
        young_modulus: Pa, one for all or one for each node [M].
        poisson_ratio: Poisson's ratio, likewise.
        material: Name of the law in `MATERIALS`.
        stiffening: Of laws that stiffen.

    Returns:
        Stress [M], Pa, float32; zero where F is collapsed, inverted or not finite, as the laws have no value there.
    """
    mu, lam = (torch.as_tensor(each, dtype=torch.float32) for each in lame_parameters(young_modulus, poisson_ratio))
    gradients = torch.tensor(F, dtype=torch.float32)
    J = torch.linalg.det(gradients)
    sound = (J > LEAST_VOLUME) & gradients.isfinite().all(2).all(1)
    gradients = torch.where(sound[:, None, None], gradients, torch.eye(3)).requires_grad_()
    (P,) = torch.autograd.grad(energy_density(material, gradients, mu, lam, stiffening).sum(), gradients)
    with torch.no_grad():
        cauchy = P @ gradients.transpose(1, 2) / torch.where(sound, J, 1.0)[:, None, None]
        mean = cauchy.diagonal(dim1=1, dim2=2).mean(1)
        deviator = cauchy - mean[:, None, None] * torch.eye(3)
        return (1.5 * (deviator**2).sum((1, 2))).sqrt().numpy()
