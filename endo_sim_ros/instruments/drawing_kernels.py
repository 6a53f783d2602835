"""Kernels of `drawing`, for B pictures at once: triangles to samples, the nearest in each. `resolving_kernels` makes pixels of them."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

SAMPLES = wp.constant(4)  # of a pixel, on a rotated grid: as many levels of grey along any edge
EMPTY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
BEYOND = wp.constant(1.0e6)  # pixels: float32 cannot tell on which side of an edge a sample lies from so far
TILE = wp.constant(16)  # pixels a side: what one item takes on a CPU
APART = wp.constant(4)  # columns from one that a thread takes on a GPU to its next


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
    several: int  # whether there is more than one instrument
    stride: int  # tiles are taken in steps of it, so that threads share the work evenly
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
    around: wp.array[wp.vec3d]  # [B] in the hue of the light that comes from the tissue
    screen: wp.array[wp.vec3]  # [3 B F] column and row in pixels, and one over the depth
    turned: wp.array[wp.vec3]  # [3 B F] normals, camera
    rows: wp.array[wp.vec2i]  # [B F] the first and the last row that a triangle may reach; none if it is not seen
    samples: wp.array[wp.int64]  # [P · 4] left empty for the next picture
    marks: wp.array[wp.uint8]  # of tiles that something is drawn in, on a CPU; left at zero


@wp.func
def offset(sample: int, row: int, column: int, spread: float) -> wp.vec2:
    """Where in a pixel a sample lies, from its corner."""
    u = (0.375 + 0.5 * float(sample) - 0.25 * float(sample // 2)) % 1.0
    if (row + column) % 2 == 1:  # the mirror image, as along an edge of slope 1 : 2 two samples are as one
        u = 1.0 - u
    return wp.vec2(0.5 + spread * (u - 0.5), 0.5 + spread * (0.125 + 0.25 * float(sample) - 0.5))


@wp.func
def lens(views: wp.array2d[float], picture: int) -> wp.vec4:
    return wp.vec4(views[picture, 0], views[picture, 1], views[picture, 2], views[picture, 3])


@wp.kernel
def project(
    first: int,
    poses: wp.array[wp.mat44],  # [B L], in the camera
    views: wp.array2d[float],  # [B, 7] fx fy cx cy, and the lamp, m, camera
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


@wp.func
def span(a: wp.vec3, b: wp.vec3, row: int, spread: float, columns: wp.vec2) -> wp.vec2:
    """What of the middles of pixels from one column to another may see the inner side of the edge from a to b."""
    slope = a[1] - b[1]  # of the weight, by columns
    here = a[0] * b[1] - a[1] * b[0] + (b[0] - a[0]) * (float(row) + 0.5)  # at column 0
    at_best = here - 0.5 * spread * (wp.abs(b[0] - a[0]) + wp.abs(slope))
    if slope > 0.0:
        return wp.vec2(columns[0], wp.min(columns[1], -at_best / slope))
    if slope < 0.0:
        return wp.vec2(wp.max(columns[0], -at_best / slope), columns[1])
    return wp.where(at_best > 0.0, wp.vec2(1.0, 0.0), columns)


@wp.func
def cover(
    i: int,  # of B F triangles
    low: int,  # row
    high: int,
    first: int,  # of the columns that the triangle may reach
    step: int,
    alone: int,  # whether no other thread writes to these rows
    frame: Frame,
):
    """Enter a triangle into the samples of every ``step``-th column of rows from ``low`` to ``high``, and mark their tiles."""
    a, b, c = corner(frame, 3 * i), corner(frame, 3 * i + 1), corner(frame, 3 * i + 2)
    picture, face = i // frame.faces, i % frame.faces
    per_area = 1.0 / ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
    by_u = wp.vec3(b[1] - c[1], c[1] - a[1], a[1] - b[1])  # of the weights
    by_v = wp.vec3(c[0] - b[0], a[0] - c[0], b[0] - a[0])
    margin = 0.5 * frame.spread
    leftmost = wp.max(wp.min(wp.min(a[0], b[0]), c[0]) - margin, 0.5)
    rightmost = wp.min(wp.max(wp.max(a[0], b[0]), c[0]) + margin, float(frame.width) - 0.5)
    if leftmost > rightmost:
        return
    for row in range(wp.max(frame.rows[i][0], low), wp.min(frame.rows[i][1], high) + 1):
        columns = wp.vec2(leftmost, rightmost)
        columns = span(a, b, row, frame.spread, columns)
        columns = span(b, c, row, frame.spread, columns)
        columns = span(c, a, row, frame.spread, columns)
        tile = (picture * frame.down + row // TILE) * frame.across
        for column in range(int(wp.ceil(columns[0] - 0.5)) + first, int(wp.floor(columns[1] - 0.5)) + 1, step):
            here = weights(a, b, c, float(column), float(row))
            pixel = (picture * frame.height + row) * frame.width + column
            for sample in range(SAMPLES):
                beside = offset(sample, row, column, frame.spread)
                w = here + beside[0] * by_u + beside[1] * by_v
                if wp.max(wp.max(w[0], w[1]), w[2]) <= 0.0:
                    inverse = (w[0] * a[2] + w[1] * b[2] + w[2] * c[2]) * per_area
                    # Of positive floats the bits order as they do: what is nearest has the least key.
                    key = (wp.int64(0x7FFFFFFF - wp.cast(inverse, wp.int32)) << wp.int64(32)) | wp.int64(face)
                    if key < frame.samples[pixel * SAMPLES + sample]:
                        if alone != 0:
                            frame.samples[pixel * SAMPLES + sample] = key
                        else:
                            wp.atomic_min(frame.samples, pixel * SAMPLES + sample, key)
                        frame.marks[tile + column // TILE] = wp.uint8(1)


@wp.kernel
def cover_rows(
    first: int,
    frame: Frame,
):
    """On a CPU: the rows of some tiles, to which no other thread writes."""
    i = first + wp.tid()
    picture, low = i // frame.down, TILE * ((i % frame.down * frame.stride) % frame.down)
    for face in range(picture * frame.faces, (picture + 1) * frame.faces):
        reached = frame.rows[face]
        if reached[0] < low + TILE and reached[1] >= low and reached[0] <= reached[1]:
            cover(face, low, low + TILE - 1, 0, 1, 1, frame)


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
        row = reached[0] + part // APART
        cover(face, row, row, part % APART, APART, 0, frame)
