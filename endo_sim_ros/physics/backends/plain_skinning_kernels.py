"""Plain kernels that move Gaussians by the maps of their control nodes, see `node_map_kernels`."""

import warp as wp

from endo_sim_ros.core.native import native
from endo_sim_ros.physics.backends.structs import Skin

wp.set_module_options({"enable_backward": False, "extra_build_options": native("physics/native/skinning.h")})


@wp.func_native("""
    const size_t first = (size_t)n * rest.neighbours.shape[1];
    endo_sim::skin<endo_sim::PlainColumn>(rest.means.data[n].c, &rest.covars.data[n].data[0][0],
        rest.neighbours.data + first, rest.weights.data + first, rest.neighbours.shape[1], (const float*)(maps.data + first_map),
        rest.origin.c, rest.low, rest.high, out_means.data[out].c, &out_covars.data[out].data[0][0]);
""")
def skin_gaussian(
    n: int,
    out: int,  # where to write
    first_map: int,
    rest: Skin,
    maps: wp.array[wp.mat44],
    out_means: wp.array[wp.vec3],
    out_covars: wp.array[wp.mat33],
): ...


@wp.kernel
def skin_environments(
    nodes: int,  # M
    rest: Skin,
    maps: wp.array[wp.mat44],  # [B · M]
    out_means: wp.array[wp.vec3],  # out [B · N]
    out_covars: wp.array[wp.mat33],  # out [B · N]
):
    """The same Gaussians in all environments at once."""
    b, n = wp.tid()
    skin_gaussian(n, b * rest.means.shape[0] + n, b * nodes, rest, maps, out_means, out_covars)
