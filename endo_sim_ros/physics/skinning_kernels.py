"""Kernels that carry Gaussians along with control nodes (paper eq. 9, 10).

    μ' = Σ w (A_k (μ − p_k) + p_k')      Σ' = F Σ Fᵀ,  F = Σ w F_k

with A_k = F_k (affine fields are then exact) or, as printed, its rotation R_k. As the weights add up to one, both are
linear in one affine map per node, G_k = [B_k | c_k] with B_k = A_k − 1 and c_k = p_k' − p_k − B_k (p_k − o):

    μ' = μ + B (μ − o) + c,  F = 1 + B,  where [B | c] = Σ w G_k

A node that has not moved has G_k = 0, which leaves its Gaussians untouched bit for bit. The origin o lies within the
tissue, so that the sum loses no digits however far the tissue is from the world's origin. A map takes 16 floats, a
cache line: the columns of B and c, each padded to four. Kernels over Gaussians start at an offset, so that several
threads can share them.
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


@wp.func
def node_map(rest: wp.vec3, position: wp.vec3, A: wp.mat33, origin: wp.vec3) -> wp.mat44:
    """G_k: the columns of B_k and c_k as rows of four."""
    B = A - wp.identity(3, float)
    c = position - rest - B * (rest - origin)
    G = wp.mat44()
    for i in range(3):
        for j in range(3):
            G[j, i] = B[i, j]
        G[3, i] = c[i]
    return G


@wp.kernel
def node_maps(
    node_rest: wp.array[wp.vec3],
    node_positions: wp.array[wp.vec3],
    node_A: wp.array[wp.mat33],
    origin: wp.vec3,
    maps: wp.array[wp.mat44],  # out
):
    """G_k of every node."""
    k = wp.tid()
    maps[k] = node_map(node_rest[k], node_positions[k], node_A[k], origin)


@wp.kernel
def moved_node_maps(
    node_rest: wp.array[wp.vec3],  # [M]
    pinned: wp.array[int],  # [M]
    u: wp.array[wp.vec3],  # displacements [B · M]
    F: wp.array[wp.mat33],  # [B · M]
    origin: wp.vec3,
    maps: wp.array[wp.mat44],  # out [B · M]
):
    """G_k of every node in every environment, A_k = F_k; pinned nodes have not moved."""
    b, k = wp.tid()
    e = b * node_rest.shape[0] + k
    if pinned[k] != 0:
        maps[e] = wp.mat44()
    else:
        maps[e] = node_map(node_rest[k], node_rest[k] + u[e], F[e], origin)


@wp.func
def skin_gaussian(
    n: int,
    out: int,  # where to write
    first_map: int,
    means: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    neighbours: wp.array2d[int],
    weights: wp.array2d[float],
    maps: wp.array[wp.mat44],
    origin: wp.vec3,
    low: float,
    high: float,
    out_means: wp.array[wp.vec3],
    out_covars: wp.array[wp.mat33],
):
    G = wp.mat44()
    for j in range(neighbours.shape[1]):
        G += weights[n, j] * maps[first_map + neighbours[n, j]]
    B = wp.mat33(G[0, 0], G[1, 0], G[2, 0], G[0, 1], G[1, 1], G[2, 1], G[0, 2], G[1, 2], G[2, 2])
    out_means[out] = means[n] + (B * (means[n] - origin) + wp.vec3(G[3, 0], G[3, 1], G[3, 2]))
    F = clamp_stretch(wp.identity(3, float) + B, low, high)
    out_covars[out] = F * covars[n] * wp.transpose(F)


@wp.kernel
def skin_gaussians(
    first: int,
    means: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    neighbours: wp.array2d[int],
    weights: wp.array2d[float],
    maps: wp.array[wp.mat44],
    origin: wp.vec3,
    low: float,
    high: float,
    out_means: wp.array[wp.vec3],
    out_covars: wp.array[wp.mat33],
):
    n = first + wp.tid()
    skin_gaussian(n, n, 0, means, covars, neighbours, weights, maps, origin, low, high, out_means, out_covars)


@wp.kernel
def skin_environments(
    nodes: int,  # M
    means: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    neighbours: wp.array2d[int],
    weights: wp.array2d[float],
    maps: wp.array[wp.mat44],  # [B · M]
    origin: wp.vec3,
    low: float,
    high: float,
    out_means: wp.array[wp.vec3],  # out [B · N]
    out_covars: wp.array[wp.mat33],  # out [B · N]
):
    """The same Gaussians in all environments at once."""
    b, n = wp.tid()
    out = b * means.shape[0] + n
    skin_gaussian(n, out, b * nodes, means, covars, neighbours, weights, maps, origin, low, high, out_means, out_covars)


@wp.kernel
def blend_rotations(
    first: int, neighbours: wp.array2d[int], weights: wp.array2d[float], node_F: wp.array[wp.mat33], out: wp.array[wp.mat33]
):
    """Rotation of every Gaussian's blended F."""
    n = first + wp.tid()
    F = wp.mat33()
    for j in range(neighbours.shape[1]):
        F += weights[n, j] * node_F[neighbours[n, j]]
    out[n] = rotation_of(F)
