"""Tool wrenches: forces on nodes that add up to a force and a torque at the tool's tip."""

import numpy as np


def minimum_norm_forces(offsets: np.ndarray, weights: np.ndarray, force: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Nodal forces f [K, 3] with Σ f = F and Σ r × f = τ that minimise Σ |f|²/w.

    The minimiser is f = w (F/Σw + β × s) with s the offset from the weighted centroid c, and
    β = J⁻¹ (τ − c × F), J = Σ w (|s|² 1 − s sᵀ). Nodes on one line or point resist no torque about it: there J has no
    inverse, the force is still exact and the torque is the nearest that the nodes can take.

    Args:
        offsets: Nodes relative to the tip r [K, 3], metres.
        weights: Positive weights w [K]; larger ones carry more.
        force: F [3], N.
        torque: τ about the tip [3], N·m.
    """
    r, w = np.asarray(offsets, np.float64), np.asarray(weights, np.float64)[:, None]
    w = w / w.sum()
    centre = (w * r).sum(0)
    s = r - centre
    inertia = (w * s**2).sum() * np.eye(3) - (w * s).T @ s
    values, axes = np.linalg.eigh(inertia)
    resisted = values > 1e-6 * max(values[-1], (w * r**2).sum(), 1e-30)
    needed = torque - np.cross(centre, force)
    beta = axes[:, resisted] @ ((axes[:, resisted].T @ needed) / values[resisted])
    return w * (np.asarray(force, np.float64) + np.cross(beta, s))


def fall_off(distances: np.ndarray, radius: float) -> np.ndarray:
    """Smooth weights (1 − (d/r)²)² of distances d <= r; never quite zero, so that a node at the rim still counts."""
    return np.maximum(1 - (distances / radius) ** 2, 1e-3) ** 2
