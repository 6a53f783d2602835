"""Kernels of `shading` for a CPU: light, exposure with the tone curve, and bytes; native/shading.h takes 16 pixels, or numbers, at a time.

Light is `falloff` of `features`: brightness = fixed · (max(d, nearest) / reference)^−distance, where ``fixed`` is the part
that depends on the pixel alone; pixels without tissue have d = reference.
"""

import warp as wp

from endo_sim_ros.core.native import native

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "extra_build_options": native("core/native/shading.h")})


@wp.func_native("""
    endo_sim::light_pixels(
        block, depths.shape[0], colors.data, depths.data, alphas.data, fixed.data, distance, reference, nearest, out.data);
""")
def light_pixels(
    block: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    fixed: wp.array[float],
    distance: float,
    reference: float,
    nearest: float,
    out: wp.array[float],
): ...


@wp.kernel
def light_picture(
    first: int,  # of the blocks of 16 pixels, as below
    colors: wp.array[float],  # [3 · P]
    depths: wp.array[float],  # [P] Σ w z, m
    alphas: wp.array[float],  # [P] Σ w
    fixed: wp.array[float],  # [P]
    distance: float,
    reference: float,  # m
    nearest: float,  # m, and alpha from which on there is a depth
    out: wp.array[float],  # out [3 · P]
):
    light_pixels(first + wp.tid(), colors, depths, alphas, fixed, distance, reference, nearest, out)


@wp.func_native("""
    endo_sim::light_pixels_from(block, depths.shape[0], colors.data, depths.data, alphas.data, slopes.data, motion.data,
        exponents.data[0], exponents.data[1], exponents.data[2], exponents.data[3], reference, nearest, out.data);
""")
def light_pixels_from(
    block: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    slopes: wp.array[float],
    motion: wp.array[float],
    exponents: wp.array[float],
    reference: float,
    nearest: float,
    out: wp.array[float],
): ...


@wp.kernel
def light_picture_from(
    first: int,
    colors: wp.array[float],  # [3 · P]
    depths: wp.array[float],  # [P] Σ w z, m
    alphas: wp.array[float],  # [P] Σ w
    slopes: wp.array[float],  # [2 · P] x/z, then y/z
    motion: wp.array[float],  # [12] from the camera's frame to the lamp's
    exponents: wp.array[float],  # [4] of distance and angle, tilt_x, tilt_y
    reference: float,  # m
    nearest: float,  # m, and alpha from which on there is a depth
    out: wp.array[float],  # out [3 · P]
):
    light_pixels_from(first + wp.tid(), colors, depths, alphas, slopes, motion, exponents, reference, nearest, out)


@wp.func_native("endo_sim::expose_pixels(block, lit.shape[0] / 3, gains.data, shoulder, lit.data);")
def expose_pixels(block: int, gains: wp.array[float], shoulder: float, lit: wp.array[float]): ...


@wp.kernel
def expose_picture(
    first: int,
    gains: wp.array[float],  # [3] of the channels
    shoulder: float,  # of `toned`; 0 = brightness stays
    lit: wp.array[float],  # in and out [3 · P]
):
    expose_pixels(first + wp.tid(), gains, shoulder, lit)


@wp.func_native("endo_sim::round_values(block, values.shape[0], values.data, out.data);")
def round_values(block: int, values: wp.array[float], out: wp.array[wp.uint8]): ...


@wp.kernel
def to_bytes(first: int, values: wp.array[float], out: wp.array[wp.uint8]):
    round_values(first + wp.tid(), values, out)
