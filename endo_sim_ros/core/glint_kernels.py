"""Kernels of `reflections`: glints of pixels, and their gradients; native/glints.h has the work, 16 pixels of a row at once on a CPU.

With the sums over splats Σ w n of normals and Σ w s of strengths, and a = Σ w, that arrive in a pixel whose ray is r:

    m = Σ w n / a,   o = m + r / |r|,   lobe = exp(−½ p |o|²),   glint = a · Σ w s · lobe,

and a colour becomes √(colour² + glint). Backward, with v the gradient of the glint: those of Σ w s, Σ w n and a are v a · lobe,
−p v · glint · o / a and (p o·m + 1) v · glint / a.
"""

import warp as wp

from endo_sim_ros.core.native import LANE_COUNT, native

wp.set_module_options(
    {"enable_backward": False, "default_grid_stride": False, "extra_build_options": native("core/native/glints.h", LANE_COUNT=LANE_COUNT)}
)


@wp.func_native("endo_sim::add_glints(item, {width, height, films.data, alphas.data}, {viewmats.data, Ks.data, sharpness}, colors.data);")
def add(
    item: int,
    width: int,
    height: int,
    films: wp.array[float],
    alphas: wp.array[float],
    viewmats: wp.array[float],
    Ks: wp.array[float],
    sharpness: float,
    colors: wp.array[float],
): ...


@wp.func_native("""
    endo_sim::glint_gradients(
        item, {width, height, films.data, alphas.data}, {viewmats.data, Ks.data, sharpness}, v_light.data, v_films.data,
        v_alphas.data);
""")
def add_gradients(
    item: int,
    width: int,
    height: int,
    films: wp.array[float],
    alphas: wp.array[float],
    viewmats: wp.array[float],
    Ks: wp.array[float],
    sharpness: float,
    v_light: wp.array[float],
    v_films: wp.array[float],
    v_alphas: wp.array[float],
): ...


@wp.kernel
def add_glints(
    first: int,  # of the items
    width: int,
    height: int,
    films: wp.array[float],  # [C · 4 · H·W]
    alphas: wp.array[float],  # [C · H·W]
    viewmats: wp.array[float],
    Ks: wp.array[float],
    sharpness: float,  # p
    colors: wp.array[float],  # [C · H·W · 3], to which glints are added as light
):
    add(first + wp.tid(), width, height, films, alphas, viewmats, Ks, sharpness, colors)


@wp.kernel
def glint_gradients(
    first: int,
    width: int,
    height: int,
    films: wp.array[float],
    alphas: wp.array[float],
    viewmats: wp.array[float],
    Ks: wp.array[float],
    sharpness: float,
    v_light: wp.array[float],  # [C · H·W]
    v_films: wp.array[float],  # out [C · 4 · H·W]
    v_alphas: wp.array[float],  # out [C · H·W]
):
    add_gradients(first + wp.tid(), width, height, films, alphas, viewmats, Ks, sharpness, v_light, v_films, v_alphas)
