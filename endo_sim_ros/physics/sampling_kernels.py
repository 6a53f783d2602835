"""Kernel of farthest-point sampling."""

import warp as wp

from endo_sim_ros.core.native import native

wp.set_module_options({"enable_backward": False, "extra_build_options": native("physics/native/sampling.h")})


@wp.func_native("endo_sim::sample_farthest(x.data, y.data, z.data, n, count, start, distances.data, samples.data);")
def sample(
    x: wp.array[float],
    y: wp.array[float],
    z: wp.array[float],
    n: int,
    count: int,
    start: int,
    distances: wp.array[float],
    samples: wp.array[int],
): ...


@wp.kernel
def sample_farthest_points(
    x: wp.array[float],
    y: wp.array[float],
    z: wp.array[float],
    n: int,
    count: int,
    start: int,
    distances: wp.array[float],  # squared distance to the nearest sample, infinite at first
    samples: wp.array[int],
):
    """One thread, CPU: pick `count` points, each the one farthest from all picked before (Qi et al. 2017)."""
    sample(x, y, z, n, count, start, distances, samples)
