"""Kernels of skinning: the maps of control nodes, by which Gaussians follow them (paper eq. 9, 10), and what lenses see of them then.

    μ' = Σ w (A_k (μ − p_k) + p_k')      Σ' = F Σ Fᵀ,  F = Σ w F_k

with A_k = F_k (affine fields are then exact) or, as printed, its rotation R_k. As the weights add up to one, both are
linear in one affine map per node, G_k = [B_k | c_k] with B_k = A_k − 1 and c_k = p_k' − p_k − B_k (p_k − o):

    μ' = μ + B (μ − o) + c,  F = 1 + B,  where [B | c] = Σ w G_k

A control node that has not moved has G_k = 0, which leaves its Gaussians untouched bit for bit. The origin o lies within the
tissue, so that the sum loses no digits however far the tissue is from the world's origin. A map takes 16 floats, a
cache line: the columns of B and c, each padded to four. Kernels that several threads share start at an offset.
"""

import warp as wp

from endo_sim_ros.core import gaussians
from endo_sim_ros.core.native import native
from endo_sim_ros.physics.backends.motion_kernels import rest_gradient, rest_shift

wp.set_module_options({"enable_backward": False, "extra_build_options": native("physics/native/materials.h")})

SH_C0 = wp.constant(gaussians.SH_C0)


@wp.func_native("wp::mat33 R; endo_sim::rotation_of(&F.data[0][0], &R.data[0][0]); return R;")
def rotation_of(F: wp.mat33) -> wp.mat33:
    """Rotation R of the polar decomposition F = R S."""


@wp.kernel
def node_rotations(first: int, F: wp.array[wp.mat33], R: wp.array[wp.mat33]):
    """R_k of F_k = R_k S_k for every control node."""
    k = first + wp.tid()
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
    first: int,
    node_rest: wp.array[wp.vec3],
    node_positions: wp.array[wp.vec3],
    node_A: wp.array[wp.mat33],
    origin: wp.vec3,
    maps: wp.array[wp.mat44],  # out
):
    """G_k of every control node."""
    k = first + wp.tid()
    maps[k] = node_map(node_rest[k], node_positions[k], node_A[k], origin)


@wp.kernel
def moved_node_maps(
    node_rest: wp.array[wp.vec3],  # [M]
    pinned: wp.array[int],  # [M]
    u: wp.array[wp.vec3],  # displacements [B · M]
    F: wp.array[wp.mat33],  # [B · M]
    follows: wp.array2d[wp.vec4],  # how pinned ones follow breath and heart [M, P]
    held: wp.array2d[wp.vec3],  # where the paths of these are [B, P]
    origin: wp.vec3,
    maps: wp.array[wp.mat44],  # out [B · M]
):
    """G_k of every control node in every environment, A_k = F_k; pinned ones are where breath and heart have them."""
    b, k = wp.tid()
    e = b * node_rest.shape[0] + k
    if pinned[k] != 0:
        shift, gradient = rest_shift(follows, held, b, k), rest_gradient(follows, held, b, k)
        maps[e] = node_map(node_rest[k], node_rest[k] + shift, gradient, origin)
    else:
        maps[e] = node_map(node_rest[k], node_rest[k] + u[e], F[e], origin)


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


@wp.kernel
def node_strains(first: int, node_F: wp.array[wp.mat33], out: wp.array[float]):
    """‖Fᵀ F − 1‖ / 2 of every control node; exactly 0 at rest."""
    i = first + wp.tid()
    D = node_F[i] - wp.identity(3, float)
    strain = D + wp.transpose(D) + wp.transpose(D) * D
    out[i] = 0.5 * wp.sqrt(wp.ddot(strain, strain))


@wp.kernel
def largest_strains(
    first: int,
    neighbours: wp.array2d[int],  # [N, K]
    weights: wp.array2d[float],  # [N, K]
    strains: wp.array[float],  # [M], or [B · M] of as many copies of the tissue
    nodes: int,  # M
    out: wp.array[float],  # [B · N]
):
    """The largest strain of the control nodes that move each Gaussian."""
    i = first + wp.tid()
    n = i % neighbours.shape[0]
    b = i / neighbours.shape[0]
    largest = float(0.0)
    for j in range(neighbours.shape[1]):
        if weights[n, j] > 0.0:
            largest = wp.max(largest, strains[b * nodes + neighbours[n, j]])
    out[i] = largest


@wp.kernel
def see(
    first: int,
    neighbours: wp.array2d[int],  # [N, K]
    weights: wp.array2d[float],  # [N, K]
    normals: wp.array2d[wp.vec3],  # [N, 2] at rest
    strengths: wp.array[wp.vec2],  # [N] of sheen and glints
    sharpness: float,  # of the sheen
    exponent: float,
    grazing: float,  # least cosine that shades
    node_F: wp.array[wp.mat33],  # [M], or [B · M] of as many copies of the tissue
    nodes: int,  # from one copy to the next: M, or 0 where there is one
    means: wp.array[wp.vec3],  # [N], or [B · N]
    eyes: wp.array[wp.vec3],  # [B]
    sh: wp.array[wp.vec3],  # [N], or [B · N]
    seen: wp.array[wp.vec3],  # out [B · N]
    films: wp.array[wp.vec4],  # out [B · N]
):
    """What an eye sees of every Gaussian, as `reflections` has the formula: its colour without glints, its film's normal and strength.

    Normals are cof(F) n, F blended from the nodes.
    """
    i = first + wp.tid()
    n = i % normals.shape[0]
    b = i / normals.shape[0]
    F = wp.mat33()
    for j in range(neighbours.shape[1]):
        F += weights[n, j] * node_F[b * nodes + neighbours[n, j]]
    x = wp.vec3(F[0, 0], F[1, 0], F[2, 0])
    y = wp.vec3(F[0, 1], F[1, 1], F[2, 1])
    z = wp.vec3(F[0, 2], F[1, 2], F[2, 2])
    cofactor = wp.matrix_from_cols(wp.cross(y, z), wp.cross(z, x), wp.cross(x, y))
    towards = eyes[b] - means[i % means.shape[0]]
    normal = cofactor * normals[n, 0]
    c = wp.dot(normal, towards) / wp.max(wp.sqrt(wp.dot(normal, normal) * wp.dot(towards, towards)), 1.0e-30)
    shade = wp.pow(wp.max(c, grazing), exponent)
    sheen = strengths[n][0] * wp.exp(sharpness * (c - 1.0))
    half = wp.vec3(0.5 / SH_C0)
    own = wp.max(shade * (sh[i % sh.shape[0]] + half), wp.vec3())
    sheen = sheen / (SH_C0 * SH_C0)
    seen[i] = wp.vec3(wp.sqrt(own[0] * own[0] + sheen), wp.sqrt(own[1] * own[1] + sheen), wp.sqrt(own[2] * own[2] + sheen)) - half
    film = cofactor * normals[n, 1]
    film = film / wp.max(wp.length(film), 1.0e-30)
    films[i] = wp.vec4(film[0], film[1], film[2], strengths[n][1])
