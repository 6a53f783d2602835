"""Kernels of `drawing`: triangles to samples, the nearest in each, and samples to pixels."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

SAMPLES = wp.constant(4)  # of a pixel, on a rotated grid: as many levels of grey along any edge
EMPTY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
BLOCK = wp.constant(32)  # rows that one item of `cover_rows` takes


@wp.struct
class View:
    """A camera and the size of its picture."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    nearest: float  # m: what is nearer to the plane of the lens is not drawn


@wp.struct
class Look:
    """How instruments are lit."""

    lamp: wp.vec3  # m, camera
    ambient: float  # share of the light that comes from all around
    softness: float  # m: over such a depth an instrument comes out of the tissue


@wp.func
def offset(sample: int) -> wp.vec2:
    return wp.vec2((0.375 + 0.5 * float(sample) - 0.25 * float(sample // 2)) % 1.0, 0.125 + 0.25 * float(sample))


@wp.kernel
def project(
    first: int,
    corners: wp.array[wp.vec3],  # [3 F] m, in the frame of the link
    normals: wp.array[wp.vec3],  # [3 F]
    links: wp.array[int],  # [F]
    poses: wp.array[wp.mat44],  # [L], in the camera
    view: View,
    screen: wp.array[wp.vec3],  # out [3 F]: column and row in pixels, and one over the depth, 0 behind the lens
    turned: wp.array[wp.vec3],  # out [3 F]: normals, camera
):
    i = first + wp.tid()
    pose = poses[links[i // 3]]
    at = wp.transform_point(pose, corners[i])
    turned[i] = wp.transform_vector(pose, normals[i])
    screen[i] = wp.vec3(0.0, 0.0, 0.0)
    if at[2] > view.nearest:
        screen[i] = wp.vec3(view.fx * at[0] / at[2] + view.cx, view.fy * at[1] / at[2] + view.cy, 1.0 / at[2])


@wp.func
def weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: float, v: float) -> wp.vec3:
    """Shares of the corners in a point of the picture, times the area of the triangle twice; their signs tell on which sides it lies."""
    return wp.vec3(
        (b[0] - u) * (c[1] - v) - (b[1] - v) * (c[0] - u),
        (c[0] - u) * (a[1] - v) - (c[1] - v) * (a[0] - u),
        (a[0] - u) * (b[1] - v) - (a[1] - v) * (b[0] - u),
    )


@wp.func
def corner(screen: wp.array[wp.vec3], face: int, i: int) -> wp.vec3:
    return screen[3 * face + i]


@wp.func
def span(a: wp.vec3, b: wp.vec3, row: int, columns: wp.vec2) -> wp.vec2:
    """What of the columns from one to another may lie on the inner side of the edge from a to b, anywhere in a row."""
    slope = a[1] - b[1]  # of the weight, by columns
    here = a[0] * b[1] - a[1] * b[0] + (b[0] - a[0]) * (float(row) + 0.5)  # at column 0
    at_best = here - 0.5 * wp.abs(b[0] - a[0])
    if slope > 0.0:
        return wp.vec2(columns[0], wp.min(columns[1], -at_best / slope))
    if slope < 0.0:
        return wp.vec2(wp.max(columns[0], -at_best / slope), columns[1])
    return wp.where(at_best > 0.0, wp.vec2(1.0, 0.0), columns)


@wp.func
def cover(face: int, low: int, high: int, screen: wp.array[wp.vec3], view: View, samples: wp.array[wp.int64], marks: wp.array[wp.uint8]):
    """Enter a triangle into the samples of rows from ``low`` to below ``high``, and mark their pixels."""
    a, b, c = corner(screen, face, 0), corner(screen, face, 1), corner(screen, face, 2)
    if wp.min(wp.min(a[2], b[2]), c[2]) <= 0.0:
        return
    if wp.max(wp.max(a[1], b[1]), c[1]) < float(low) or wp.min(wp.min(a[1], b[1]), c[1]) > float(high):
        return
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if area >= 0.0:  # rows count downwards: it turns its back
        return
    top = wp.max(int(wp.floor(wp.min(wp.min(a[1], b[1]), c[1]))), low)
    bottom = wp.min(int(wp.floor(wp.max(wp.max(a[1], b[1]), c[1]))), high - 1)
    for row in range(top, bottom + 1):
        columns = wp.vec2(0.0, float(view.width) - 0.5)
        columns = span(a, b, row, span(b, c, row, span(c, a, row, columns)))
        for column in range(int(columns[0]), int(wp.floor(columns[1])) + 1):
            for sample in range(SAMPLES):
                beside = offset(sample)
                w = weights(a, b, c, float(column) + beside[0], float(row) + beside[1])
                if wp.max(wp.max(w[0], w[1]), w[2]) <= 0.0:
                    depth = area / (w[0] * a[2] + w[1] * b[2] + w[2] * c[2])
                    key = (wp.int64(wp.cast(depth, wp.int32)) << wp.int64(32)) | wp.int64(face)
                    wp.atomic_min(samples, (row * view.width + column) * SAMPLES + sample, key)
                    marks[row * view.width + column] = wp.uint8(1)


@wp.kernel
def cover_rows(first: int, faces: int, screen: wp.array[wp.vec3], view: View, samples: wp.array[wp.int64], marks: wp.array[wp.uint8]):
    """On a CPU: some rows, to which no other thread writes."""
    low = BLOCK * (first + wp.tid())
    high = wp.min(low + BLOCK, view.height)
    for face in range(faces):
        cover(face, low, high, screen, view, samples, marks)


@wp.kernel
def cover_faces(first: int, faces: int, screen: wp.array[wp.vec3], view: View, samples: wp.array[wp.int64], marks: wp.array[wp.uint8]):
    """On a GPU: one triangle."""
    cover(first + wp.tid(), 0, view.height, screen, view, samples, marks)


@wp.func
def reflected(normal: wp.vec3, at: wp.vec3, color: wp.vec3, roughness: float, strength: float, look: Look) -> wp.vec3:
    """Colour of a surface with the light at the lamp: diffuse, and a microfacet lobe (GGX) of its roughness."""
    to_eye, to_lamp = wp.normalize(-at), wp.normalize(look.lamp - at)
    half = wp.normalize(to_eye + to_lamp)
    facing = wp.max(wp.dot(normal, to_lamp), 0.0)
    aligned = wp.max(wp.dot(normal, half), 0.0)
    spread = roughness * roughness
    lobe = spread / wp.pow(aligned * aligned * (spread * spread - 1.0) + 1.0, 2.0) * spread
    diffuse = look.ambient + (1.0 - look.ambient) * wp.pow(facing, 0.4545)  # pictures are gamma-compressed
    shine = strength * wp.pow(wp.min(0.25 * lobe * facing, 1.0e3), 0.4545)
    return color * diffuse + wp.vec3(shine, shine, shine)


@wp.kernel
def resolve(
    first: int,
    samples: wp.array[wp.int64],  # [P · 4], left empty for the next picture
    screen: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    links: wp.array[int],
    materials: wp.array[int],  # [F]
    surfaces: wp.array2d[float],  # [M, 5] red, green, blue, roughness, strength of the shine
    view: View,
    look: Look,
    colors: wp.array[wp.vec3],  # in and out [P], as are the next two
    depths: wp.array[float],  # Σ w z, m
    alphas: wp.array[float],  # Σ w
    labels: wp.array[wp.uint8],  # in and out [P]: marks at first
):
    pixel = first + wp.tid()
    alpha = alphas[pixel]
    marked = labels[pixel] != wp.uint8(0)
    labels[pixel] = wp.where(alpha > 0.5, wp.uint8(1), wp.uint8(0))
    if not marked:
        return
    tissue = float(1.0e9)
    if alpha > 0.5:
        tissue = depths[pixel] / alpha
    total = float(0.0)
    depth = float(0.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    polish = wp.vec2(0.0, 0.0)
    nearest = float(1.0e9)
    link = int(0)
    for sample in range(SAMPLES):
        key = samples[SAMPLES * pixel + sample]
        if key != EMPTY:
            samples[SAMPLES * pixel + sample] = EMPTY
            face = int(key & wp.int64(0xFFFFFFFF))
            a, b, c = corner(screen, face, 0), corner(screen, face, 1), corner(screen, face, 2)
            beside = offset(sample)
            u, v = float(pixel % view.width) + beside[0], float(pixel // view.width) + beside[1]
            w = wp.cw_mul(weights(a, b, c, u, v), wp.vec3(a[2], b[2], c[2]))
            share = w / (w[0] + w[1] + w[2])
            z = wp.cast(wp.int32(key >> wp.int64(32)), wp.float32)
            seen = wp.clamp(0.5 + (tissue - z) / look.softness, 0.0, 1.0)
            if seen > 0.0:
                bent = share[0] * normals[3 * face] + share[1] * normals[3 * face + 1] + share[2] * normals[3 * face + 2]
                normal += seen * wp.normalize(bent)
                surface = surfaces[materials[face]]
                color += seen * wp.vec3(surface[0], surface[1], surface[2])
                polish += seen * wp.vec2(surface[3], surface[4])
                depth += seen * z
                total += seen
                if z < nearest:
                    nearest = z
                    link = links[face]
    if total > 0.0:
        # Lit once, as the mean of what its samples show: light costs more than all else.
        z = depth / total
        x = (float(pixel % view.width) + 0.5 - view.cx) / view.fx * z
        y = (float(pixel // view.width) + 0.5 - view.cy) / view.fy * z
        lit = reflected(wp.normalize(normal), wp.vec3(x, y, z), color / total, polish[0] / total, polish[1] / total, look)
        kept = 1.0 - total / float(SAMPLES)
        colors[pixel] = kept * colors[pixel] + (1.0 - kept) * lit
        depths[pixel] = kept * depths[pixel] + depth / float(SAMPLES)
        alphas[pixel] = kept * alpha + total / float(SAMPLES)
        if kept < 0.5:
            labels[pixel] = wp.uint8(2 + link)
