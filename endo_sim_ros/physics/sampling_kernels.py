"""Kernel of farthest-point sampling."""

import warp as wp

from endo_sim_ros.core.native import native

wp.set_module_options({"enable_backward": False, "extra_build_options": native("physics/native/sampling.h")})


@wp.func_native("""
    const size_t n = points.shape[1];
    endo_sim::sample_farthest(points.data, points.data + n, points.data + 2 * n, n, count, start, distances.data, samples.data);
""")
def sample(points: wp.array2d[float], count: int, start: int, distances: wp.array[float], samples: wp.array[int]): ...


@wp.kernel
def sample_farthest_points(points: wp.array2d[float], count: int, start: int, distances: wp.array[float], samples: wp.array[int]):
    """One thread, CPU: pick `count` of points [3, N], each the one farthest from all picked before (Qi et al. 2017).

    Distances [N], infinite at first, are squared ones to the nearest sample.
    """
    sample(points, count, start, distances, samples)
