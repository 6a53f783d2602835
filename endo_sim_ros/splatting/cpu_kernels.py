"""Kernels that composite on a CPU, a tile at a time; native/tiles.h has the work, `common_kernels` the formulas.

All threads launch the same kernel and draw tiles from a shared counter until none is left, so that a thread on a busy
core draws fewer.
"""

import warp as wp

from endo_sim_ros.splatting.headers import headers

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "extra_build_options": headers("tiles.h")})


@wp.func_native("return endo_sim::draw_number(counter.data);")
def draw_number(counter: wp.array[int]) -> int: ...


@wp.func_native("""
    endo_sim::composite_tile(
        tile, {splats.data, extras.data, owners.data, slots.data, starts.data}, background.data, {viewmats.data, Ks.data, glints},
        width, height, {colors.data, depths.data, alphas.data, distortions.data, extra_images.data},
        wants_owners ? owners_of_median.data : nullptr);
""")
def composite_tile(
    tile: int,
    splats: wp.array[float],
    extras: wp.array[float],
    owners: wp.array[int],
    slots: wp.array[int],
    starts: wp.array[int],
    background: wp.array[float],
    viewmats: wp.array[float],
    Ks: wp.array[float],
    glints: float,
    width: int,
    height: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    extra_images: wp.array[float],
    wants_owners: int,
    owners_of_median: wp.array[int],
): ...


@wp.func_native("""
    endo_sim::composite_tile_backward(
        tile, {splats.data, extras.data, owners.data, slots.data, starts.data}, background.data, width, height,
        {colors.data, depths.data, alphas.data, distortions.data, extra_images.data},
        {v_colors.data, v_depths.data, v_alphas.data, v_distortions.data, v_extra_images.data}, wants_absolute, records.data);
""")
def composite_tile_backward(
    tile: int,
    splats: wp.array[float],
    extras: wp.array[float],
    owners: wp.array[int],
    slots: wp.array[int],
    starts: wp.array[int],
    background: wp.array[float],
    width: int,
    height: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    extra_images: wp.array[float],
    v_colors: wp.array[float],
    v_depths: wp.array[float],
    v_alphas: wp.array[float],
    v_distortions: wp.array[float],
    v_extra_images: wp.array[float],
    wants_absolute: int,
    records: wp.array[float],
): ...


@wp.func_native("endo_sim::sort_by_tile(tiles.data, (int)tiles.shape[0], (int)starts.shape[0] - 1, slots.data, starts.data);")
def list_by_tile(tiles: wp.array[int], slots: wp.array[int], starts: wp.array[int]): ...


@wp.kernel
def sort_by_tile(
    tiles: wp.array[int],  # of each intersection
    slots: wp.array[int],  # out, intersections by tile, then by number
    starts: wp.array[int],  # out [tiles + 1], first slot of each tile
):
    """One thread counts, and then puts each where it belongs."""
    list_by_tile(tiles, slots, starts)


@wp.kernel
def render_tiles(
    counter: wp.array[int],
    splats: wp.array[float],
    extras: wp.array[float],
    owners: wp.array[int],
    slots: wp.array[int],
    starts: wp.array[int],
    background: wp.array[float],
    viewmats: wp.array[float],  # [C · 4·4]
    Ks: wp.array[float],  # [C · 3·3]
    glints: float,  # their sharpness, where extras are films whose glints are added as light; -1: none are
    width: int,
    height: int,
    colors: wp.array[float],  # out, as all below
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    extra_images: wp.array[float],
    wants_owners: int,
    owners_of_median: wp.array[int],
):
    tile = draw_number(counter)
    if tile < starts.shape[0] - 1:
        composite_tile(
            tile, splats, extras, owners, slots, starts, background, viewmats, Ks, glints, width, height, colors, depths, alphas,
            distortions, extra_images, wants_owners, owners_of_median,
        )  # fmt: skip


@wp.kernel
def render_tiles_backward(
    counter: wp.array[int],
    splats: wp.array[float],
    extras: wp.array[float],
    owners: wp.array[int],
    slots: wp.array[int],
    starts: wp.array[int],
    background: wp.array[float],
    width: int,
    height: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    extra_images: wp.array[float],
    v_colors: wp.array[float],
    v_depths: wp.array[float],
    v_alphas: wp.array[float],
    v_distortions: wp.array[float],
    v_extra_images: wp.array[float],
    wants_absolute: int,
    records: wp.array[float],  # out
):
    tile = draw_number(counter)
    if tile < starts.shape[0] - 1:
        composite_tile_backward(
            tile, splats, extras, owners, slots, starts, background, width, height, colors, depths, alphas, distortions, extra_images,
            v_colors, v_depths, v_alphas, v_distortions, v_extra_images, wants_absolute, records,
        )  # fmt: skip
