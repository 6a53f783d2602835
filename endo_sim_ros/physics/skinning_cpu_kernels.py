"""CPU skinning, vectorised over the 16 numbers of a node's map.

Same maths and memory layout as `skinning_kernels` (read its header first). The native code below is C++ with the
vector types of Clang, which become whatever the processor has: one map is one vector, its columns are four. A
Gaussian that is stretched beyond the range is left to the other kernel's code.
"""

import warp as wp

from endo_sim_ros.physics.skinning_kernels import skin_gaussian

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func_native("""
    typedef float vmap __attribute__((vector_size(64), aligned(4)));  // columns of B and c, padded
    typedef float vcolumn __attribute__((vector_size(16), aligned(4)));
    const int count = neighbours.shape[1];
    const int* nodes = neighbours.data + (size_t)n * count;
    const float* weight = weights.data + (size_t)n * count;
    vmap G{};
    for (int j = 0; j < count; ++j)
        G += weight[j] * *(const vmap*)(maps.data + nodes[j]);
    const vcolumn b0 = __builtin_shufflevector(G, G, 0, 1, 2, 3), b1 = __builtin_shufflevector(G, G, 4, 5, 6, 7);
    const vcolumn b2 = __builtin_shufflevector(G, G, 8, 9, 10, 11), c = __builtin_shufflevector(G, G, 12, 13, 14, 15);

    // Healthy F, as in clamp_stretch.
    const vcolumn f0 = b0 + vcolumn{1, 0, 0, 0}, f1 = b1 + vcolumn{0, 1, 0, 0}, f2 = b2 + vcolumn{0, 0, 1, 0};
    const vcolumn squares = f0 * f0 + f1 * f1 + f2 * f2;
    const vcolumn cross = __builtin_shufflevector(f1, f1, 1, 2, 0, 3) * __builtin_shufflevector(f2, f2, 2, 0, 1, 3)
        - __builtin_shufflevector(f1, f1, 2, 0, 1, 3) * __builtin_shufflevector(f2, f2, 1, 2, 0, 3);
    const vcolumn terms = f0 * cross;
    const float size = squares[0] + squares[1] + squares[2], determinant = terms[0] + terms[1] + terms[2];
    if (!(size <= high * high && 2.0f * determinant > low * size))
        return false;

    const float* mean = (const float*)(means.data + n);
    float* out_mean = (float*)(out_means.data + n);
    const vcolumn shift = (mean[0] - origin[0]) * b0 + (mean[1] - origin[1]) * b1 + (mean[2] - origin[2]) * b2 + c;
    for (int i = 0; i < 3; ++i)
        out_mean[i] = mean[i] + shift[i];

    const float* S = (const float*)(covars.data + n);
    float* out_covar = (float*)(out_covars.data + n);
    const vcolumn m0 = f0 * S[0] + f1 * S[1] + f2 * S[2];  // columns of F S, and as S is symmetric
    const vcolumn m1 = f0 * S[3] + f1 * S[4] + f2 * S[5];
    const vcolumn m2 = f0 * S[6] + f1 * S[7] + f2 * S[8];
    *(vcolumn*)out_covar = m0 * f0[0] + m1 * f1[0] + m2 * f2[0];  // rows; the fourth number is overwritten by the next
    *(vcolumn*)(out_covar + 3) = m0 * f0[1] + m1 * f1[1] + m2 * f2[1];
    const vcolumn last = m0 * f0[2] + m1 * f1[2] + m2 * f2[2];
    for (int i = 0; i < 3; ++i)
        out_covar[6 + i] = last[i];
    return true;
""")
def skin_healthy(
    n: int,
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
) -> bool:
    """Skin one Gaussian, unless its stretch may have to be clamped."""
    ...


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
    if not skin_healthy(n, means, covars, neighbours, weights, maps, origin, low, high, out_means, out_covars):
        skin_gaussian(n, n, 0, means, covars, neighbours, weights, maps, origin, low, high, out_means, out_covars)
