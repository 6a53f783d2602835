"""Kernels that carry Gaussians along with control nodes (paper eq. 10, 11).

    μ' = Σ w (A_k (μ − p_k) + p_k')      Σ' = F Σ Fᵀ,  F = Σ w F_k

with A_k = F_k (affine fields are then exact) or, as printed, its rotation R_k. The mean is evaluated as
μ + Σ w ((A_k − 1)(μ − p_k) + p_k' − p_k), which leaves an undeformed Gaussian untouched bit for bit.
"""

import warp as wp

from endo_sim_ros.physics.materials import rotation_of

wp.set_module_options({"enable_backward": False})


@wp.func
def clamp_stretch(F: wp.mat33, low: float, high: float) -> wp.mat33:
    """F with its singular values clamped to [low, high] and det F > 0.

    Healthy F, which a bound on the smallest singular value from det F and |F| recognises, skips the decomposition.
    """
    size = wp.ddot(F, F)
    result = F
    if not (size <= high * high and 2.0 * wp.determinant(F) > low * size):
        U = wp.mat33()
        sigma = wp.vec3()
        V = wp.mat33()
        wp.svd3(F, U, sigma, V)
        clamped = wp.vec3(wp.clamp(sigma[0], low, high), wp.clamp(sigma[1], low, high), wp.clamp(sigma[2], low, high))
        result = U * wp.diag(clamped) * wp.transpose(V)
    return result


@wp.kernel
def node_rotations(F: wp.array[wp.mat33], R: wp.array[wp.mat33]):
    """R_k of F_k = R_k S_k for every node."""
    k = wp.tid()
    R[k] = rotation_of(F[k])


@wp.kernel
def skin_gaussians(
    means: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    neighbours: wp.array2d[int],
    weights: wp.array2d[float],
    node_rest: wp.array[wp.vec3],
    node_positions: wp.array[wp.vec3],
    node_F: wp.array[wp.mat33],
    node_A: wp.array[wp.mat33],
    low: float,
    high: float,
    out_means: wp.array[wp.vec3],
    out_covars: wp.array[wp.mat33],
):
    n = wp.tid()
    mean = means[n]
    shift = wp.vec3()
    F = wp.mat33()
    for j in range(neighbours.shape[1]):
        k = neighbours[n, j]
        w = weights[n, j]
        rest = node_rest[k]
        arm = mean - rest
        shift += w * (node_A[k] * arm - arm + node_positions[k] - rest)
        F += w * node_F[k]
    F = clamp_stretch(F, low, high)
    out_means[n] = mean + shift
    out_covars[n] = F * covars[n] * wp.transpose(F)


@wp.kernel
def blend_rotations(
    neighbours: wp.array2d[int], weights: wp.array2d[float], node_F: wp.array[wp.mat33], out: wp.array[wp.mat33]
):
    """Rotation of every Gaussian's blended F."""
    n = wp.tid()
    F = wp.mat33()
    for j in range(neighbours.shape[1]):
        F += weights[n, j] * node_F[neighbours[n, j]]
    out[n] = rotation_of(F)
