"""Ray casting and shading of the phantom's height field, one thread per pixel.

The surface is z = h(x, y): a grid of (rows + 1) × (columns + 1) vertices `cell` metres apart, bilinear in between, centred
on the z axis and repeated as in a mirror beyond its border, without end. Grid coordinates are u = x / cell + columns / 2,
v alike with rows. Maps with several levels of detail are stored flat, level after level; level l has (columns >> l) + 1
vertices along x.

Along a ray p(t) = o + t d (t is the depth, since camera-frame rays have unit z), z(t) - h(u(t), v(t)) is a quadratic in
t within one cell, so hits are found exactly. Cells are skipped with a pyramid of their minimal heights
(Tevs, Ihrke and Seidel, "Maximum mipmaps for fast, accurate, and scalable dynamic height field rendering", I3D 2008).
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

TOP_LEVEL = wp.constant(6)  # the coarsest cells a ray skips at once are 2^6 cells wide
FAR = wp.constant(1.0e9)
STEP = wp.constant(2.0e-3)  # metres, length of a chord of a ray through displaced tissue
FENCE_LEVEL = wp.constant(4)  # cells of the bound of displaced tissue are 2^4 cells wide, 2.5 mm


@wp.struct
class Surface:
    """The height field and what it looks like; see the module's header for the layout."""

    rows: int  # cells along y and along x, multiples of the coarsest cells
    columns: int
    cell: float  # width of a cell, metres
    lowest: float  # bounds of the heights, metres
    highest: float
    heights: wp.array[float]  # [(rows + 1) (columns + 1)] metres
    nearest: wp.array[float]  # minimum of the heights over every cell, levels of (rows >> l) (columns >> l) cells, flat
    colours: wp.array[wp.vec4]  # linear albedo and wetness, levels of detail, flat
    slopes: wp.array[wp.vec4]  # dh/dx, dh/dy, and the same of the wet film on top; levels of detail, flat


@wp.struct
class Light:
    """A point light with inverse-square falloff, and how tissue answers it."""

    position: wp.vec3  # world, metres
    power: float  # radiance of a white surface facing the light is power / distance²
    wrap: wp.vec3  # how far each colour scatters past the terminator, 0..1: red the farthest
    sheen: float  # strength of the broad, satin reflection
    glint: float  # strength of the mirror reflection of the wet film
    sharpness: float  # its Blinn-Phong exponent


@wp.struct
class Motion:
    """A displacement of the surface, u(q) = Σ a exp(−|q − c|² / 2 r²)."""

    centres: wp.array[wp.vec3]  # [T] m, world
    amplitudes: wp.array[wp.vec3]  # [T] m; none where the surface is at rest
    radii: wp.array[float]  # [T] m
    first: float  # z before and behind which no displaced tissue lies, m
    last: float
    fence: wp.array[float]  # z before which no displaced tissue is, over the cells of FENCE_LEVEL, m


@wp.func
def deformation(motion: Motion, point: wp.vec3):
    """I + ∂u/∂q at a point at rest."""
    total = wp.identity(n=3, dtype=float)
    for k in range(motion.amplitudes.shape[0]):
        apart = (point - motion.centres[k]) / motion.radii[k]
        total -= wp.exp(-0.5 * wp.dot(apart, apart)) / motion.radii[k] * wp.outer(motion.amplitudes[k], apart)
    return total


@wp.func
def at_rest(motion: Motion, point: wp.vec3, guess: wp.vec3, steps: int):
    """Where a point is at rest: q + u(q) = p, by Newton's method."""
    found = guess
    for _ in range(steps):
        moved = wp.vec3()
        slope = wp.identity(n=3, dtype=float)  # I + ∂u/∂q, as in `deformation`
        for k in range(motion.amplitudes.shape[0]):
            apart = (found - motion.centres[k]) / motion.radii[k]
            part = wp.exp(-0.5 * wp.dot(apart, apart)) * motion.amplitudes[k]
            moved += part
            slope -= wp.outer(part, apart / motion.radii[k])
        found += wp.inverse(slope) * (point - found - moved)
    return found


@wp.func
def mirrored(u: float, n: float):
    """Grid coordinate folded back into [0, n], and the sign that a derivative along it takes."""
    m = u - 2.0 * n * wp.floor(u / (2.0 * n))
    sign = 1.0
    if m > n:
        m = 2.0 * n - m
        sign = -1.0
    return m, sign


@wp.func
def mirrored_cell(i: int, n: int):
    if i >= 0 and i < n:  # nearly always, and remainders are slow
        return i
    m = i % (2 * n)
    if m < 0:
        m += 2 * n
    if m >= n:
        m = 2 * n - 1 - m
    return m


@wp.func
def height_at(surface: Surface, u: float, v: float):
    fu, _ = mirrored(u, float(surface.columns))
    fv, _ = mirrored(v, float(surface.rows))
    i = wp.min(int(fu), surface.columns - 1)
    j = wp.min(int(fv), surface.rows - 1)
    a = fu - float(i)
    b = fv - float(j)
    k = j * (surface.columns + 1) + i
    near = (1.0 - a) * surface.heights[k] + a * surface.heights[k + 1]
    k += surface.columns + 1
    return (1.0 - b) * near + b * ((1.0 - a) * surface.heights[k] + a * surface.heights[k + 1])


@wp.func
def sample(texture: wp.array[wp.vec4], rows: int, columns: int, level: int, u: float, v: float):
    """Bilinear value of one level of detail at folded grid coordinates of level 0."""
    offset = int(0)
    for coarser in range(level):
        offset += ((rows >> coarser) + 1) * ((columns >> coarser) + 1)
    rows = rows >> level
    columns = columns >> level
    scale = 1.0 / float(1 << level)
    i = wp.min(int(u * scale), columns - 1)
    j = wp.min(int(v * scale), rows - 1)
    a = u * scale - float(i)
    b = v * scale - float(j)
    k = offset + j * (columns + 1) + i
    near = (1.0 - a) * texture[k] + a * texture[k + 1]
    k += columns + 1
    return (1.0 - b) * near + b * ((1.0 - a) * texture[k] + a * texture[k + 1])


@wp.func
def hit_in_cell(surface: Surface, u: float, v: float, z: float, du: float, dv: float, dz: float, start: float, end: float):
    """First depth in [start, end], both in one cell, at which the ray is on the surface; negative if there is none."""
    half = 0.5 * (end - start)
    f0 = z + start * dz - height_at(surface, u + start * du, v + start * dv)
    f1 = z + (start + half) * dz - height_at(surface, u + (start + half) * du, v + (start + half) * dv)
    f2 = z + end * dz - height_at(surface, u + end * du, v + end * dv)
    if f0 >= 0.0:
        return start
    # f(s) = f0 + b s + a s² through the three values, s in [0, 2]; the form below is stable as a goes to 0
    a = 0.5 * (f2 - 2.0 * f1 + f0)
    b = f1 - f0 - a
    discriminant = b * b - 4.0 * a * f0
    if discriminant < 0.0:
        return -1.0
    denominator = b + wp.sqrt(discriminant)
    if denominator <= 0.0:
        return -1.0
    s = -2.0 * f0 / denominator
    if s > 2.0:
        if f2 >= 0.0:
            return end
        return -1.0
    return start + s * half


@wp.func
def cast(surface: Surface, origin: wp.vec3, ray: wp.vec3, limit: float):
    """Depth, up to a limit, at which a ray first meets the surface at rest, negative if it never does."""
    u = origin[0] / surface.cell + 0.5 * float(surface.columns)
    v = origin[1] / surface.cell + 0.5 * float(surface.rows)
    du = ray[0] / surface.cell
    dv = ray[1] / surface.cell
    if ray[2] <= 1.0e-3:
        return -1.0
    t = wp.max((surface.lowest - origin[2]) / ray[2], 0.0)
    last = wp.min((surface.highest - origin[2]) / ray[2] + 1.0e-6, limit)
    nudge = 1.0e-3 / wp.max(wp.max(wp.abs(du), wp.abs(dv)), 1.0)  # past a cell's border, in depth
    level = int(TOP_LEVEL)
    for _ in range(4000):
        if t > last:
            break
        size = float(1 << level)
        i = wp.floor((u + t * du) / size)
        j = wp.floor((v + t * dv) / size)
        exit_u = FAR
        exit_v = FAR
        if du > 0.0:
            exit_u = ((i + 1.0) * size - u) / du
        if du < 0.0:
            exit_u = (i * size - u) / du
        if dv > 0.0:
            exit_v = ((j + 1.0) * size - v) / dv
        if dv < 0.0:
            exit_v = (j * size - v) / dv
        leave = wp.min(wp.max(wp.min(exit_u, exit_v), t), last)
        rows = surface.rows >> level
        columns = surface.columns >> level
        offset = 4 * (surface.rows * surface.columns - rows * columns) // 3  # cells of all finer levels, each four times those of the next
        nearest = surface.nearest[offset + mirrored_cell(int(j), rows) * columns + mirrored_cell(int(i), columns)]
        reach = (nearest - origin[2]) / ray[2]  # the depth at which the ray gets down to the cell's nearest point
        if reach > leave:
            t = leave + nudge
            level = wp.min(level + 1, TOP_LEVEL)
        elif level > 0:
            t = wp.max(t, reach)
            level -= 1
        else:
            hit = hit_in_cell(surface, u, v, origin[2], du, dv, ray[2], t, leave)
            if hit >= 0.0:
                return hit
            t = leave + nudge
            level = 1
    return -1.0


@wp.func
def cast_fence(surface: Surface, motion: Motion, origin: wp.vec3, ray: wp.vec3):
    """Depth up to which a ray surely meets no displaced tissue, as all of it lies behind the fence."""
    size = surface.cell * float(1 << FENCE_LEVEL)
    rows = surface.rows >> FENCE_LEVEL
    columns = surface.columns >> FENCE_LEVEL
    u = origin[0] / size + 0.5 * float(columns)
    v = origin[1] / size + 0.5 * float(rows)
    du = ray[0] / size
    dv = ray[1] / size
    nudge = 1.0e-3 / wp.max(wp.max(wp.abs(du), wp.abs(dv)), 1.0)
    t = wp.max((motion.first - origin[2]) / ray[2], 0.0)
    last = (motion.last - origin[2]) / ray[2]
    for _ in range(4000):
        if t > last:
            break
        i = wp.floor(u + t * du)
        j = wp.floor(v + t * dv)
        leave = last
        if du > 0.0:
            leave = wp.min(leave, (i + 1.0 - u) / du)
        if du < 0.0:
            leave = wp.min(leave, (i - u) / du)
        if dv > 0.0:
            leave = wp.min(leave, (j + 1.0 - v) / dv)
        if dv < 0.0:
            leave = wp.min(leave, (j - v) / dv)
        bound = motion.fence[mirrored_cell(int(j), rows) * columns + mirrored_cell(int(i), columns)]
        reach = (bound - origin[2]) / ray[2]
        if reach <= leave:
            return wp.max(t, reach)
        t = wp.max(leave, t) + nudge
    return t


@wp.func
def cast_displaced(surface: Surface, motion: Motion, origin: wp.vec3, ray: wp.vec3):
    """Depth at which a ray first meets the displaced surface, 0 if it never does, and the point there at rest.

    At rest the ray is a curve. It is followed in chords, which are so short that they leave it by some hundredth of a millimetre.
    """
    step = STEP / wp.length(ray)
    t = cast_fence(surface, motion, origin, ray)
    last = (motion.last - origin[2]) / ray[2]
    point = origin + t * ray
    start = at_rest(motion, point, point, 6)
    while t < last:
        point = origin + (t + step) * ray
        end = at_rest(motion, point, start + step * ray, 2)
        hit = cast(surface, start, (end - start) / step, step)
        if hit >= 0.0:
            return t + hit, start + hit / step * (end - start)
        t += step
        start = end
    return 0.0, start


@wp.func
def shade(surface: Surface, motion: Motion, light: Light, rest: wp.vec3, point: wp.vec3, eye: wp.vec3, footprint: float):
    """Linear radiance towards the eye of a surface point, filtered over a footprint in metres; it is another one at rest."""
    rows = surface.rows
    columns = surface.columns
    u, sign_u = mirrored(rest[0] / surface.cell + 0.5 * float(columns), float(columns))
    v, sign_v = mirrored(rest[1] / surface.cell + 0.5 * float(rows), float(rows))
    detail = wp.clamp(wp.log2(footprint / surface.cell), 0.0, 4.999)
    level = int(detail)
    blend = detail - float(level)
    colour = sample(surface.colours, rows, columns, level, u, v)
    slope = sample(surface.slopes, rows, columns, level, u, v)
    if blend > 0.02:
        colour += blend * (sample(surface.colours, rows, columns, level + 1, u, v) - colour)
        slope += blend * (sample(surface.slopes, rows, columns, level + 1, u, v) - slope)
    normal = wp.normalize(wp.vec3(sign_u * slope[0], sign_v * slope[1], -1.0))
    film = wp.normalize(wp.vec3(sign_u * (slope[0] + slope[2]), sign_v * (slope[1] + slope[3]), -1.0))
    if motion.amplitudes.shape[0] > 0:
        turn = wp.transpose(wp.inverse(deformation(motion, rest)))  # of normals
        normal = wp.normalize(turn * normal)
        film = wp.normalize(turn * film)
    to_eye = wp.normalize(eye - point)
    to_light = light.position - point
    irradiance = light.power / wp.dot(to_light, to_light)
    to_light = wp.normalize(to_light)
    halfway = wp.normalize(to_light + to_eye)
    facing = wp.dot(normal, to_light)
    diffuse = wp.vec3()
    for c in range(3):
        w = light.wrap[c]
        lit = wp.max((facing + w) / (1.0 + w), 0.0)
        diffuse[c] = colour[c] * lit * wp.sqrt(lit)
    sheen = light.sheen * wp.pow(wp.max(wp.dot(normal, halfway), 0.0), 24.0)
    glint = light.glint * wp.pow(wp.max(wp.dot(film, halfway), 0.0), light.sharpness)
    reflection = colour[3] * (sheen + colour[3] * glint)
    return irradiance * (diffuse + wp.vec3(reflection, reflection, reflection))


@wp.kernel
def render(
    surface: Surface,
    motion: Motion,
    light: Light,
    pose: wp.mat44,  # camera-to-world
    focal: wp.vec2,  # pixels
    centre: wp.vec2,
    depth: wp.array2d[float],  # out, [H, W] metres, 0 = no surface
    radiance: wp.array2d[wp.vec3],  # out, [H, W] linear
):
    y, x = wp.tid()
    local = wp.vec3((float(x) + 0.5 - centre[0]) / focal[0], (float(y) + 0.5 - centre[1]) / focal[1], 1.0)
    ray = wp.transform_vector(pose, local)
    origin = wp.transform_point(pose, wp.vec3(0.0, 0.0, 0.0))
    t = float(0.0)
    rest = wp.vec3()
    if motion.amplitudes.shape[0] > 0:
        t, rest = cast_displaced(surface, motion, origin, ray)
    else:
        t = wp.max(cast(surface, origin, ray, FAR), 0.0)
        rest = origin + t * ray
    depth[y, x] = t
    radiance[y, x] = wp.vec3()
    if t > 0.0:
        radiance[y, x] = shade(surface, motion, light, rest, origin + t * ray, origin, t / focal[0])
