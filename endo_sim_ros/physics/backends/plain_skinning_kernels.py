"""Plain kernels that move Gaussians by the maps of their control nodes, see `node_map_kernels`."""

import warp as wp

from endo_sim_ros.core.native import native

wp.set_module_options({"enable_backward": False, "extra_build_options": native("physics/native/skinning.h")})


@wp.func_native("""
    endo_sim::skin<endo_sim::PlainColumn>(means.data[n].c, &covars.data[n].data[0][0], neighbours.data + (size_t)n * neighbours.shape[1],
        weights.data + (size_t)n * neighbours.shape[1], neighbours.shape[1], (const float*)(maps.data + first_map), origin.c, low, high,
        out_means.data[out].c, &out_covars.data[out].data[0][0]);
""")
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
): ...


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
