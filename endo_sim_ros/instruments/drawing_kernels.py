"""Kernels of `drawing`, for B pictures at once: triangles to samples, the nearest in each. `resolving_kernels` makes pixels of them."""

import warp as wp

from endo_sim_ros.core.native import native

SAMPLES = wp.constant(4)  # of a pixel, on a rotated grid: as many levels of grey along any edge
EMPTY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
BEYOND = wp.constant(1.0e6)  # pixels: float32 cannot tell on which side of an edge a sample lies from so far
TILE = wp.constant(16)  # pixels a side: what one item takes on a CPU
CELLS = wp.constant(16)  # of a picture, each way, whose mean light polished surfaces mirror
APART = wp.constant(4)  # columns from one that a thread takes on a GPU to its next

wp.set_module_options(
    {
        "enable_backward": False,
        "default_grid_stride": False,
        "extra_build_options": native("instruments/native/cover.h", SAMPLES=SAMPLES, TILE=TILE),
    }
)


@wp.struct
class Frame:
    """B pictures of one size, what is drawn into each, and what kernels write for each other.

    One struct, as each array that is an argument of its own costs time at every launch.
    """

    width: int
    height: int
    across: int  # tiles in a row
    down: int
    faces: int
    links: int
    capsules: int
    shadows: int  # whether they throw any
    several: int  # whether there is more than one instrument
    stride: int  # rows of tiles are taken in steps of it, so that threads share the work evenly
    spread: float  # pixels: side of the square from which a pixel takes light
    nearest: float  # m: what is nearer to the plane of the lens is not drawn
    surfaces: int  # rows of surfaces from those of one picture to the next; 0 = all have the same
    lanes: int  # threads that share a triangle on a GPU
    corners: wp.array[wp.vec3]  # [3 F] m, in the frames of their links
    normals: wp.array[wp.vec3]  # [3 F]
    face_links: wp.array[int]  # [F] what faces count as
    corner_links: wp.array[int]  # [3 F]
    materials: wp.array[int]  # [F]
    owners: wp.array[int]  # [F] numbers of the instruments
    radii: wp.array[float]  # [C] m
    capsule_owners: wp.array[int]  # [C]
    around: wp.array[wp.vec3]  # [B] hue of the light that comes from the tissue
    cells: wp.array[wp.vec4]  # [B · CELLS²] of each the mean light of its tissue and its depth, m; 0 = none
    screen: wp.array[wp.vec3]  # [3 B F] column and row in pixels, and one over the depth
    turned: wp.array[wp.vec3]  # [3 B F] normals, camera
    rows: wp.array[wp.vec2i]  # [B F] the first and the last row that a triangle may reach; none if it is not seen
    samples: wp.array[wp.int64]  # [P · 4] left empty for the next picture
    middles: wp.array[int]  # [P] not 0 where a triangle covers the middle of a pixel; left at zero
    marks: wp.array[wp.uint8]  # of tiles that something is drawn in, on a CPU; left at zero


@wp.func_native("""
    const endo_sim::Offset beside = endo_sim::offset(sample, row, column, spread);
    return {beside.u, beside.v};
""")
def offset(sample: int, row: int, column: int, spread: float) -> wp.vec2:
    """Where in a pixel a sample lies, from its corner."""
    ...


@wp.func
def lens(views: wp.array2d[float], picture: int) -> wp.vec4:
    return wp.vec4(views[picture, 0], views[picture, 1], views[picture, 2], views[picture, 3])


@wp.kernel
def project(
    first: int,
    poses: wp.array[wp.mat44],  # [B L], in the camera
    views: wp.array2d[float],  # [B, 9] fx fy cx cy, the lamp, m, camera, the exponent of the falloff of its light, and the brightest shine
    frame: Frame,
):
    i = first + wp.tid()
    picture, face = i // frame.faces, i % frame.faces
    view = lens(views, picture)
    frame.rows[i] = wp.vec2i(1, 0)
    for k in range(3):
        at = wp.transform_point(poses[picture * frame.links + frame.corner_links[3 * face + k]], frame.corners[3 * face + k])
        u, v = view[0] * at[0] / at[2] + view[2], view[1] * at[1] / at[2] + view[3]
        if not (at[2] > frame.nearest and wp.abs(u) < BEYOND and wp.abs(v) < BEYOND):  # nor if it is not a number
            return
        frame.screen[3 * i + k] = wp.vec3(u, v, 1.0 / at[2])
    a, b, c = corner(frame, 3 * i), corner(frame, 3 * i + 1), corner(frame, 3 * i + 2)
    if (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) >= 0.0:  # rows count downwards: it turns its back
        return
    margin = 0.5 * (frame.spread - 1.0)
    top = wp.floor(wp.clamp(wp.min(wp.min(a[1], b[1]), c[1]) - margin, 0.0, float(frame.height)))
    bottom = wp.floor(wp.clamp(wp.max(wp.max(a[1], b[1]), c[1]) + margin, -1.0, float(frame.height) - 0.5))
    frame.rows[i] = wp.vec2i(int(top), int(bottom))
    for k in range(3):
        pose = poses[picture * frame.links + frame.corner_links[3 * face + k]]
        frame.turned[3 * i + k] = wp.transform_vector(pose, frame.normals[3 * face + k])


@wp.func
def weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: float, v: float) -> wp.vec3:
    """Shares of the corners in a point of the picture, times the area of the triangle twice; their signs tell on which sides it lies."""
    return wp.vec3(
        (b[0] - u) * (c[1] - v) - (b[1] - v) * (c[0] - u),
        (c[0] - u) * (a[1] - v) - (c[1] - v) * (a[0] - u),
        (a[0] - u) * (b[1] - v) - (a[1] - v) * (b[0] - u),
    )


@wp.func
def corner(frame: Frame, i: int) -> wp.vec3:
    return frame.screen[i]


@wp.func_native("""
    const float from[2]{a[0], a[1]}, to[2]{b[0], b[1]};
    const endo_sim::Columns left = endo_sim::span(from, to, row, spread, {columns[0], columns[1]});
    return {left.low, left.high};
""")
def span(a: wp.vec3, b: wp.vec3, row: int, spread: float, columns: wp.vec2) -> wp.vec2:
    """What of the middles of pixels from one column to another may see the inner side of the edge from a to b."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    endo_sim::cover_tiles(frame, picture, low);
#endif
""")
def cover_tiles(picture: int, low: int, frame: Frame):
    """On a CPU: what `cover` does with all triangles in the rows of some tiles, from one row on; no other thread writes to these."""
    ...


@wp.func
def cover(
    i: int,  # of B F triangles
    row: int,
    first: int,  # of the columns that the triangle may reach
    step: int,
    frame: Frame,
):
    """Enter a triangle into the samples of every ``step``-th column of a row."""
    a, b, c = corner(frame, 3 * i), corner(frame, 3 * i + 1), corner(frame, 3 * i + 2)
    picture, face = i // frame.faces, i % frame.faces
    per_area = 1.0 / ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
    by_u = wp.vec3(b[1] - c[1], c[1] - a[1], a[1] - b[1])  # of the weights
    by_v = wp.vec3(c[0] - b[0], a[0] - c[0], b[0] - a[0])
    to_middle = 0.5 * (by_u + by_v)
    margin = 0.5 * frame.spread
    leftmost = wp.max(wp.min(wp.min(a[0], b[0]), c[0]) - margin, 0.5)
    rightmost = wp.min(wp.max(wp.max(a[0], b[0]), c[0]) + margin, float(frame.width) - 0.5)
    if leftmost > rightmost:
        return
    columns = wp.vec2(leftmost, rightmost)
    columns = span(a, b, row, frame.spread, columns)
    columns = span(b, c, row, frame.spread, columns)
    columns = span(c, a, row, frame.spread, columns)
    for column in range(int(wp.ceil(columns[0] - 0.5)) + first, int(wp.floor(columns[1] - 0.5)) + 1, step):
        here = weights(a, b, c, float(column), float(row))
        pixel = (picture * frame.height + row) * frame.width + column
        middle = here + to_middle
        if wp.max(wp.max(middle[0], middle[1]), middle[2]) <= 0.0:
            frame.middles[pixel] = 1  # whichever thread is last
        for sample in range(SAMPLES):
            beside = offset(sample, row, column, frame.spread)
            w = here + beside[0] * by_u + beside[1] * by_v
            if wp.max(wp.max(w[0], w[1]), w[2]) <= 0.0:
                inverse = (w[0] * a[2] + w[1] * b[2] + w[2] * c[2]) * per_area
                # Of positive floats the bits order as they do: what is nearest has the least key.
                key = (wp.int64(0x7FFFFFFF - wp.cast(inverse, wp.int32)) << wp.int64(32)) | wp.int64(face)
                if key < frame.samples[pixel * SAMPLES + sample]:
                    wp.atomic_min(frame.samples, pixel * SAMPLES + sample, key)


@wp.kernel
def cover_rows(
    first: int,
    frame: Frame,
):
    """On a CPU: the rows of some tiles, to which no other thread writes."""
    i = first + wp.tid()
    cover_tiles(i // frame.down, TILE * ((i % frame.down * frame.stride) % frame.down), frame)


@wp.kernel
def cover_faces(
    first: int,
    frame: Frame,
):
    """On a GPU: a share of one triangle; those of a shaft reach across the picture, and all would wait for the thread that has one."""
    i = first + wp.tid()
    face = i // frame.lanes
    reached = frame.rows[face]
    for part in range(i % frame.lanes, APART * (reached[1] - reached[0] + 1), frame.lanes):
        cover(face, reached[0] + part // APART, part % APART, APART, frame)
