"""Kernels of `drawing`, for B pictures at once: samples to pixels, lit and in each other's shadow; native/blend.h has the work."""

import warp as wp

from endo_sim_ros.core.block_sums import block_max
from endo_sim_ros.core.light import SURFACE
from endo_sim_ros.core.native import native
from endo_sim_ros.instruments.drawing_kernels import CELLS, EMPTY, SAMPLES, TILE, Frame

wp.set_module_options(
    {
        "enable_backward": False,
        "default_grid_stride": False,
        "extra_build_options": native("instruments/native/tiles.h", CELLS=CELLS, EMPTY=EMPTY, SURFACE=SURFACE),
    }
)

MOST = wp.constant(64)  # capsules: a tile keeps those that matter to it in one word


@wp.struct
class Look:
    """How instruments and tissue are lit."""

    ambient: float  # share of the light that comes from all around
    softness: float  # m: over such a depth an instrument comes out of the tissue
    lamp_size: float  # m: radius of the lamp
    mirror: float  # how much of the tissue shines back from what is polished


@wp.func_native("return endo_sim::depth_of(key);")
def depth_of(key: wp.int64) -> float: ...


@wp.func_native("""
    const endo_sim::Scene scene(frame, look, picture, surfaces.data, (const endo_sim::Ends*)ends.data, views.data);
    return endo_sim::about(scene, left, top, low, high);
""")
def about(
    picture: int,
    left: int,
    top: int,
    low: float,
    high: float,
    surfaces: wp.array2d[float],
    ends: wp.array2d[wp.vec3],
    views: wp.array2d[float],
    frame: Frame,
    look: Look,
) -> wp.uint64:
    """Capsules that may keep light from what a tile shows between two depths, m; on a GPU all threads of its block must be here."""
    ...


@wp.func_native("""
    const endo_sim::Scene scene(frame, look, picture, surfaces.data, (const endo_sim::Ends*)ends.data, views.data);
    endo_sim::blend_pixel(scene, row, column, on_tissue, on_links, {(float*)colors.data, depths.data, alphas.data, labels.data});
""")
def blend_pixel(
    picture: int,
    row: int,
    column: int,
    on_tissue: wp.uint64,  # capsules that may keep light from the tissue here
    on_links: wp.uint64,  # and from instruments
    surfaces: wp.array2d[float],
    ends: wp.array2d[wp.vec3],
    views: wp.array2d[float],
    frame: Frame,
    look: Look,
    colors: wp.array[wp.vec3],
    depths: wp.array[float],
    alphas: wp.array[float],
    labels: wp.array[wp.uint8],
):
    """A pixel: the tissue in the shadow of instruments, and what is seen of them."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const endo_sim::Scene scene(frame, look, picture, surfaces.data, (const endo_sim::Ends*)ends.data, views.data);
    endo_sim::blend_tile(scene, number, {(float*)colors.data, depths.data, alphas.data, labels.data});
#endif
""")
def blend_tile(
    picture: int,
    number: int,
    surfaces: wp.array2d[float],
    ends: wp.array2d[wp.vec3],
    views: wp.array2d[float],
    frame: Frame,
    look: Look,
    colors: wp.array[wp.vec3],
    depths: wp.array[float],
    alphas: wp.array[float],
    labels: wp.array[wp.uint8],
):
    """On a CPU: all pixels of a tile, as `blend_pixel`."""
    ...


@wp.kernel
def resolve_tiles(
    first: int,
    surfaces: wp.array2d[float],  # [M or B M, 5] as in `Scene` of native/blend.h
    ends: wp.array2d[wp.vec3],  # [B C, 2] m, camera
    views: wp.array2d[float],  # [B, 9] as in `drawing_kernels`
    frame: Frame,
    look: Look,
    colors: wp.array[wp.vec3],  # [P]
    depths: wp.array[float],  # [P] Σ w z, m
    alphas: wp.array[float],  # [P]
    labels: wp.array[wp.uint8],  # [P]
):
    """On a CPU: a tile, most of which nothing happens to."""
    each = frame.across * frame.down
    i = first + wp.tid()
    number = (i % each // frame.across * frame.stride) % frame.down * frame.across + i % frame.across
    blend_tile(i // each, number, surfaces, ends, views, frame, look, colors, depths, alphas, labels)


@wp.kernel
def resolve_blocks(
    first: int,
    surfaces: wp.array2d[float],
    ends: wp.array2d[wp.vec3],
    views: wp.array2d[float],
    frame: Frame,
    look: Look,
    colors: wp.array[wp.vec3],
    depths: wp.array[float],
    alphas: wp.array[float],
    labels: wp.array[wp.uint8],
):
    """On a GPU: a pixel. A block has those of a tile, whose threads find together which capsules matter to it."""
    i = first + wp.tid()
    tile, lane, each = i // (TILE * TILE), i % (TILE * TILE), frame.across * frame.down
    picture, number = tile // each, tile % each
    left, top = TILE * (number % frame.across), TILE * (number // frame.across)
    column, row = left + lane % TILE, top + lane // TILE
    inside = column < frame.width and row < frame.height
    pixel = (picture * frame.height + row) * frame.width + column
    on_tissue = wp.uint64(0)
    on_links = wp.uint64(0)
    if frame.shadows != 0:
        low = float(1.0e9)
        high = float(0.0)
        if inside and alphas[pixel] > 0.5:
            low = depths[pixel] / alphas[pixel]
            high = low
        on_tissue = about(picture, left, top, -block_max(-low), block_max(high), surfaces, ends, views, frame, look)
        if frame.several != 0:
            low, high = 1.0e9, 0.0
            if inside:
                for sample in range(SAMPLES):
                    key = frame.samples[SAMPLES * pixel + sample]
                    if key != EMPTY:
                        z = depth_of(key)
                        low, high = wp.min(low, z), wp.max(high, z)
            on_links = about(picture, left, top, -block_max(-low), block_max(high), surfaces, ends, views, frame, look)
    if inside:
        blend_pixel(picture, row, column, on_tissue, on_links, surfaces, ends, views, frame, look, colors, depths, alphas, labels)
