"""Kernels that composite with one thread per pixel and one block of threads per tile; native/pixels.h has the work.

They are made for GPUs, and run plainly on a CPU. A tile's splats are `splat_list[ranges[2 t] : ranges[2 t + 1]]`, front to
back. If the lists of all tiles are too long for their memory, every tile gets the list of all splats by depth instead:
slow, but the same picture.
"""

import warp as wp

from endo_sim_ros.splatting.constants import TILE
from endo_sim_ros.splatting.headers import headers

wp.set_module_options({"enable_backward": False, "extra_build_options": headers("pixels.h")})

BLOCK = TILE**2  # threads of a block


# ---------------------------------------------------------------- lists


@wp.kernel
def gather_counts(order: wp.array[int], counts: wp.array[int], sorted_counts: wp.array[wp.int64]):
    i = wp.tid()
    sorted_counts[i] = wp.int64(counts[order[i]])


@wp.kernel
def clear_lists(tile_count: int, ranges: wp.array[int], tiles: wp.array[int]):
    """Empty lists, and intersections that sort behind those of all tiles; launched over the room for them."""
    i = wp.tid()
    tiles[i] = tile_count
    if i < tile_count:
        ranges[2 * i] = 0
        ranges[2 * i + 1] = 0


@wp.kernel
def find_ranges(
    tiles: wp.array[int],  # sorted
    values: wp.array[int],  # splats in the same order
    order: wp.array[int],  # all splats by depth
    ends: wp.array[wp.int64],
    tile_mask: wp.array[wp.uint8],  # or none
    splat_list: wp.array[int],  # out, as long as there is room for intersections
    ranges: wp.array[int],  # out, zero before
    seen: wp.array[wp.int64],  # out, numbers of intersections and of splats
):
    """Launched over the room for intersections, which is no less than the number of splats and of tiles."""
    i = wp.tid()
    splat_count, tile_count = ends.shape[0], ranges.shape[0] // 2
    count = ends[splat_count - 1]
    if i == 0:
        seen[0] = count
        seen[1] = wp.int64(splat_count)
    if count > wp.int64(splat_list.shape[0]):
        if i < splat_count:
            splat_list[i] = order[i]
        if i < tile_count and (tile_mask.shape[0] == 0 or tile_mask[i] != wp.uint8(0)):
            ranges[2 * i + 1] = splat_count
    elif wp.int64(i) < count:
        tile = tiles[i]
        splat_list[i] = values[i]
        if tile < tile_count:
            if i == 0 or tiles[i - 1] != tile:
                ranges[2 * tile] = i
            if wp.int64(i + 1) == count or tiles[i + 1] != tile:
                ranges[2 * tile + 1] = i + 1


# ---------------------------------------------------------------- pixels


@wp.func_native("""
    endo_sim::composite_pixel(
        thread, {splats.data, extras.data, counts.data, splat_list.data, ranges.data, gaussian_count}, background.data,
        {viewmats.data, Ks.data, glints}, width, height,
        {colors.data, depths.data, alphas.data, distortions.data, extra_images.data}, wants_owners ? owners_of_median.data : nullptr);
""")
def composite_pixel(
    thread: int,
    splats: wp.array[float],
    extras: wp.array[float],
    counts: wp.array[int],
    gaussian_count: int,
    splat_list: wp.array[int],
    ranges: wp.array[int],
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
    endo_sim::composite_pixel_backward(
        thread, {splats.data, extras.data, counts.data, splat_list.data, ranges.data, gaussian_count}, background.data, width, height,
        {colors.data, depths.data, alphas.data, distortions.data, extra_images.data},
        {v_colors.data, v_depths.data, v_alphas.data, v_distortions.data, v_extra_images.data}, wants_absolute, records.data);
""")
def composite_pixel_backward(
    thread: int,
    splats: wp.array[float],
    extras: wp.array[float],
    counts: wp.array[int],
    gaussian_count: int,
    splat_list: wp.array[int],
    ranges: wp.array[int],
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


@wp.kernel(launch_bounds=(BLOCK, 5))
def render_pixels(
    splats: wp.array[float],  # [C·N · 16]
    extras: wp.array[float],  # [C·N · 4] or none
    counts: wp.array[int],  # [C·N] intersections of each splat
    gaussian_count: int,
    splat_list: wp.array[int],
    ranges: wp.array[int],
    background: wp.array[float],  # [3]
    viewmats: wp.array[float],  # [C · 4·4]
    Ks: wp.array[float],  # [C · 3·3]
    glints: float,  # their sharpness, where extras are films whose glints are added as light; -1: none are
    width: int,
    height: int,
    colors: wp.array[float],  # out [C·H·W · 3]
    depths: wp.array[float],  # out [C·H·W], as all below
    alphas: wp.array[float],
    distortions: wp.array[float],
    extra_images: wp.array[float],  # [C · 4 · H·W]
    wants_owners: int,
    owners_of_median: wp.array[int],  # splat at the median depth or -1, filled when wants_owners
):
    """Composite a pixel; launched over tiles × 256 threads."""
    composite_pixel(
        wp.tid(), splats, extras, counts, gaussian_count, splat_list, ranges, background, viewmats, Ks, glints, width, height, colors,
        depths, alphas, distortions, extra_images, wants_owners, owners_of_median,
    )  # fmt: skip


@wp.kernel(launch_bounds=(BLOCK, 4))
def render_pixels_backward(
    splats: wp.array[float],
    extras: wp.array[float],
    counts: wp.array[int],
    gaussian_count: int,
    splat_list: wp.array[int],
    ranges: wp.array[int],
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
    records: wp.array[float],  # out [C·N · 16], zeroed before: each warp adds its share
):
    """Add a pixel's gradients to the records of its splats; launched as `render_pixels` is."""
    composite_pixel_backward(
        wp.tid(), splats, extras, counts, gaussian_count, splat_list, ranges, background, width, height, colors, depths, alphas,
        distortions, extra_images, v_colors, v_depths, v_alphas, v_distortions, v_extra_images, wants_absolute, records,
    )  # fmt: skip
