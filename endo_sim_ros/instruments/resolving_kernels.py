"""Kernels of `drawing`, for B pictures at once: samples to pixels, lit and in each other's shadow."""

import warp as wp

from endo_sim_ros.core.block_sums import block_max
from endo_sim_ros.core.native import native
from endo_sim_ros.instruments.drawing_kernels import CELLS, EMPTY, SAMPLES, TILE, Frame, corner, lens, offset, weights
from endo_sim_ros.instruments.shadow_kernels import light_left, near

wp.set_module_options(
    {
        "enable_backward": False,
        "default_grid_stride": False,
        "extra_build_options": native("instruments/native/metal.h", "instruments/native/tiles.h", CELLS=CELLS),
    }
)

ALIKE = wp.constant(0.99)  # cosine of the angle between normals that are lit as one
METAL = wp.constant(0.1)  # share of light that is mirrored: above it a surface is metal, below it mirrors a mean
BUMP = wp.constant(0.03)  # of normals: how uneven metal is
BRUSHED = wp.constant(0.7)  # part of the slope of facets along the axis of metal that does not count: it is brushed around that
DEEP, SHALLOW = wp.constant(0.4), wp.constant(0.88)  # radii of capsules: gaps of joints lie within these, and are dark


@wp.struct
class Look:
    """How instruments and tissue are lit."""

    ambient: float  # share of the light that comes from all around
    softness: float  # m: over such a depth an instrument comes out of the tissue
    lamp_size: float  # m: radius of the lamp
    white: float  # of encoded colours: what is brighter saturates the camera
    mirror: float  # how much of the tissue shines back from what is polished


@wp.func
def depth_of(key: wp.int64) -> float:
    return 1.0 / wp.cast(0x7FFFFFFF - wp.int32(key >> wp.int64(32)), wp.float32)


@wp.func
def point(view: wp.vec4, column: float, row: float, z: float) -> wp.vec3:
    return wp.vec3((column - view[2]) / view[0] * z, (row - view[3]) / view[1] * z, z)


@wp.func
def encoded(light: float) -> float:
    """Pictures are gamma-compressed; a root is near enough to 1/2.2, and fast."""
    return wp.sqrt(wp.max(light, 0.0))


@wp.func
def uneven(at: wp.vec3) -> wp.vec3:
    """How far the normal of metal is off where it is worked and wet, from -1 to 1 each way; ``at`` in the frame of its link, m.

    Sines of sines, over two to six millimetres: irregular enough for the eye, and cheap.
    """
    x, y, z = 1.0e3 * at[0], 1.0e3 * at[1], 1.0e3 * at[2]
    first = wp.sin(1.1 * x + 0.9 * y - 0.7 * z)
    second = wp.sin(0.8 * z - 1.3 * x + 1.2 * y + 1.5 * first)
    return wp.vec3(first, second, wp.cos(1.0 * z - 0.9 * y + 1.4 * x + 1.5 * second))


@wp.func_native("""
    const float lens[4]{view[0], view[1], view[2], view[3]}, direction[3]{way[0], way[1], way[2]}, place[3]{at[0], at[1], at[2]};
    float light[3];
    endo_sim::mirrored({lens, (const endo_sim::Cell*)cells.data + first, width, height}, direction, place, light);
    return {light[0], light[1], light[2]};
""")
def mirrored(way: wp.vec3, at: wp.vec3, view: wp.vec4, first: int, width: int, height: int, cells: wp.array[wp.vec4]) -> wp.vec3:
    """Light of the tissue that lies in a direction from a point of an instrument; ``first`` is the number of the picture's first cell."""
    ...


@wp.func_native("""
    const float place[3]{at[0], at[1], at[2]};
    const auto found = endo_sim::deepest(place, {(const endo_sim::Ends*)ends.data + first, radii.data, owners.data, count}, owner);
    return {found.axis[0], found.axis[1], found.axis[2], found.away};
""")
def deepest(
    at: wp.vec3, owner: int, first: int, count: int, ends: wp.array2d[wp.vec3], radii: wp.array[float], owners: wp.array[int]
) -> wp.vec4:
    """In which of its own capsules a point of an instrument lies deepest: the axis of that, and the distance from it in radii."""
    ...


@wp.func
def reflected(
    normal: wp.vec3,
    axis: wp.vec3,  # along which the surface is rougher, or nothing
    at: wp.vec3,
    lamp: wp.vec3,
    surfaces: wp.array2d[float],
    row: int,
    around: wp.vec3,
    image: wp.vec3,  # what it mirrors
    left: wp.vec2,
    look: Look,
) -> wp.vec3:
    """Colour of a surface: diffuse, a microfacet lobe (GGX) of its roughness, and what it mirrors (Fresnel by Schlick)."""
    to_eye, to_lamp = wp.normalize(-at), wp.normalize(lamp - at)
    middle = wp.normalize(to_eye + to_lamp)
    strength = surfaces[row, 4]
    if strength > METAL:
        middle = wp.normalize(middle - BRUSHED * wp.dot(middle - normal, axis) * axis)
    facing = wp.max(wp.dot(normal, to_lamp), 0.0) * left[0]
    aligned = wp.max(wp.dot(normal, middle), 0.0)
    rough = surfaces[row, 3] * surfaces[row, 3]
    spread = rough * rough
    steep = aligned * aligned * (spread - 1.0) + 1.0
    lobe = wp.min(0.25 * spread / (steep * steep), 1.0e3) * facing
    light = (1.0 - look.ambient) * facing
    straight = wp.max(wp.dot(normal, to_eye), 0.0)
    away = 1.0 - straight
    strength += wp.max(1.0 - rough - strength, 0.0) * away * away * away * away * away
    # What a rough surface mirrors at a grazing angle hides itself (Smith).
    strength *= look.mirror * left[1] * 2.0 * straight / (straight + wp.sqrt(spread + (1.0 - spread) * straight * straight))
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        diffuse = surfaces[row, k] * (light + look.ambient * left[1] * around[k])
        shine = surfaces[row, 4] * (1.0 - look.ambient) * lobe + strength * image[k]
        total[k] = wp.min(encoded(diffuse + shine), look.white)
    return total


@wp.func
def blend(
    pixel: int,  # of all pictures, as are column and row of its own
    column: int,
    row: int,
    picture: int,
    on_tissue: wp.uint64,  # capsules that may keep light from the tissue here
    on_links: wp.uint64,  # and from instruments
    surfaces: wp.array2d[float],  # [M or B M, 5] red, green, blue, roughness, strength of the shine
    ends: wp.array2d[wp.vec3],
    views: wp.array2d[float],
    frame: Frame,
    look: Look,
    colors: wp.array[wp.vec3],
    depths: wp.array[float],
    alphas: wp.array[float],
    labels: wp.array[wp.uint8],
):
    """One pixel: the tissue in the shadow of instruments, and what is seen of them."""
    view = lens(views, picture)
    lamp = wp.vec3(views[picture, 4], views[picture, 5], views[picture, 6])
    u, v = float(column) + 0.5, float(row) + 0.5
    alpha = alphas[pixel]
    tissue = float(1.0e9)
    if alpha > 0.5:
        tissue = depths[pixel] / alpha
    total = float(0.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    lit = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    material = int(-1)
    nearest = float(1.0e9)
    shown = int(-1)  # the link of the nearest sample, and how deep its samples are together
    depth = float(0.0)
    count = float(0.0)
    middle = frame.middles[pixel]
    if middle != 0:
        frame.middles[pixel] = 0
    before = int(-1)
    for sample in range(SAMPLES):
        key = frame.samples[SAMPLES * pixel + sample]
        if key != EMPTY:
            frame.samples[SAMPLES * pixel + sample] = EMPTY
            face = int(key & wp.int64(0xFFFFFFFF))
            z = depth_of(key)
            seen = wp.clamp(0.5 + (tissue - z) / look.softness, 0.0, 1.0)
            if seen > 0.0:
                if face != before:
                    before = face
                    i = 3 * (picture * frame.faces + face)
                    a, b, c = corner(frame, i), corner(frame, i + 1), corner(frame, i + 2)
                    beside = offset(sample, row, column, frame.spread)
                    w = wp.cw_mul(weights(a, b, c, u - 0.5 + beside[0], v - 0.5 + beside[1]), wp.vec3(a[2], b[2], c[2]))
                    bent = wp.normalize(-w[0] * frame.turned[i] - w[1] * frame.turned[i + 1] - w[2] * frame.turned[i + 2])
                    # Light costs more than all else: what lies as the sample before has its colour.
                    if wp.dot(bent, normal) < ALIKE or frame.materials[face] != material:
                        normal = bent
                        material = frame.materials[face]
                        at = point(view, u, v, z)
                        surface = picture * frame.surfaces + material
                        left = wp.vec2(1.0, 1.0)
                        if on_links != wp.uint64(0):
                            left = light_left(
                                on_links, at, normal, 0.5 * z / view[0], lamp, look.lamp_size,
                                picture * frame.capsules, frame.capsules, ends, frame.radii, frame.capsule_owners, frame.owners[face],
                            )  # fmt: skip
                        facet = normal
                        axis = wp.vec3(0.0, 0.0, 0.0)
                        around = frame.around[picture]
                        image = look.ambient * around
                        if surfaces[surface, 4] > METAL:
                            k = 3 * face
                            on = w[0] * frame.corners[k] + w[1] * frame.corners[k + 1] + w[2] * frame.corners[k + 2]
                            facet = wp.normalize(normal + BUMP * uneven(on / (w[0] + w[1] + w[2])))
                            back = wp.normalize(-at)
                            way = 2.0 * wp.dot(facet, back) * facet - back
                            image = mirrored(way, at, view, picture * CELLS * CELLS, frame.width, frame.height, frame.cells)
                            within = deepest(
                                at, frame.owners[face], picture * frame.capsules, frame.capsules, ends, frame.radii, frame.capsule_owners
                            )  # fmt: skip
                            axis = wp.vec3(within[0], within[1], within[2])
                            gap = wp.clamp((within[3] - DEEP) / (SHALLOW - DEEP), 0.3, 1.0)
                            left *= gap * gap
                        lit = reflected(facet, axis, at, lamp, surfaces, surface, around, image, left, look)
                color += seen * lit
                total += seen
                if z < nearest and frame.face_links[face] != shown:
                    shown = frame.face_links[face]
                    depth = 0.0
                    count = 0.0
                if frame.face_links[face] == shown:
                    depth += z
                    count += 1.0
                nearest = wp.min(nearest, z)
    kept = 1.0 - total / float(SAMPLES)
    behind = colors[pixel]
    if kept > 0.0 and alpha > 0.5 and on_tissue != wp.uint64(0):
        at = point(view, u, v, tissue)
        left = light_left(
            on_tissue, at, wp.normalize(-at), 0.5 * tissue / view[0], lamp, look.lamp_size,
            picture * frame.capsules, frame.capsules, ends, frame.radii, frame.capsule_owners, -1,
        )  # fmt: skip
        behind *= encoded((1.0 - look.ambient) * left[0] + look.ambient * left[1])
    if total > 0.0:
        covered = kept * alpha + total / float(SAMPLES)
        metres = depth / count
        darker = float(1.0)  # light on the tissue, as part of that on the instrument
        if kept > 0.0 and alpha > 0.5:
            darker = wp.pow(metres / tissue, views[picture, 7])
        # Colours blend at outlines. Halfway between two surfaces there is none: the depth is that of what the label tells. The light will
        # take all of the pixel to be so deep, hence the colour of the other surface takes the difference.
        # Samples lie in a square that may be larger than the pixel: where half of them are covered, its middle tells.
        if kept < 0.5 or kept == 0.5 and middle != 0:
            labels[pixel] = wp.uint8(2 + shown)
            depths[pixel] = covered * metres
            behind *= darker
        elif alpha > 0.0:
            depths[pixel] *= covered / alpha
            color /= darker
        else:
            depths[pixel] = covered * metres
        alphas[pixel] = covered
        behind = kept * behind + color / float(SAMPLES)
    colors[pixel] = behind


@wp.func
def blend_square(
    left: int,
    top: int,
    right: int,
    bottom: int,
    picture: int,
    on_tissue: wp.uint64,
    on_links: wp.uint64,
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
    """Pixels of one picture. On a CPU a call copies all structs and arrays, which for each pixel takes a quarter of the time."""
    for row in range(top, bottom):
        for column in range(left, right):
            blend(
                (picture * frame.height + row) * frame.width + column, column, row, picture, on_tissue, on_links,
                surfaces, ends, views, frame, look, colors, depths, alphas, labels,
            )  # fmt: skip


@wp.func
def about(
    picture: int,
    left: int,
    top: int,
    low: float,
    high: float,
    ends: wp.array2d[wp.vec3],
    views: wp.array2d[float],
    frame: Frame,
    look: Look,
) -> wp.uint64:
    """Capsules that may keep light from what a tile shows between two depths."""
    if low > high:
        return wp.uint64(0)
    view = lens(views, picture)
    lamp = wp.vec3(views[picture, 4], views[picture, 5], views[picture, 6])
    half = 0.5 * float(TILE)
    at = point(view, float(left) + half, float(top) + half, 0.5 * (low + high))
    across = wp.length(wp.vec2(half / view[0], half / view[1])) * high
    slack = across + 0.5 * (high - low) * wp.length(at) / at[2] + high / view[0]
    return near(at, slack, lamp, look.lamp_size, picture * frame.capsules, frame.capsules, ends, frame.radii, frame.capsule_owners)


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const auto seen = endo_sim::tissue_depths({left, top, right, bottom, (size_t)start, width}, depths.data, alphas.data);
    return {seen.low, seen.high};
#else
    return {0.0f, 0.0f};
#endif
""")
def tissue_depths(
    left: int, top: int, right: int, bottom: int, start: int, width: int, depths: wp.array[float], alphas: wp.array[float]
) -> wp.vec2:
    """On a CPU: the nearest and the farthest tissue in a tile of the picture that begins at pixel ``start``, m."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const endo_sim::Capsules capsules{(const endo_sim::Ends*)ends.data + first, radii.data, owners.data, count};
    endo_sim::shade_tissue(
        mask, {left, top, right, bottom, (size_t)start, width}, {view[0], view[1], view[2], view[3]}, {{lamp[0], lamp[1], lamp[2]}, size},
        capsules, ambient, depths.data, alphas.data, (float*)colors.data);
#endif
""")
def shade_tissue(
    mask: wp.uint64,
    left: int,
    top: int,
    right: int,
    bottom: int,
    start: int,
    width: int,
    view: wp.vec4,
    lamp: wp.vec3,
    size: float,
    first: int,
    count: int,
    ends: wp.array2d[wp.vec3],
    radii: wp.array[float],
    owners: wp.array[int],
    ambient: float,
    depths: wp.array[float],
    alphas: wp.array[float],
    colors: wp.array[wp.vec3],
):
    """On a CPU: put the tissue of a tile into the shadow of capsules, as `blend` does on a GPU."""
    ...


@wp.kernel
def resolve_tiles(
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
    """On a CPU: a tile, most of which nothing happens to."""
    each = frame.across * frame.down
    i = first + wp.tid()
    picture, number = i // each, (i % each * frame.stride) % each
    left, top = TILE * (number % frame.across), TILE * (number // frame.across)
    right, bottom = wp.min(left + TILE, frame.width), wp.min(top + TILE, frame.height)
    start = picture * frame.height * frame.width
    marked = frame.marks[picture * each + number] != wp.uint8(0)
    on_links = wp.uint64(0)
    if frame.shadows != 0:
        seen = tissue_depths(left, top, right, bottom, start, frame.width, depths, alphas)
        on_tissue = about(picture, left, top, seen[0], seen[1], ends, views, frame, look)
        if marked and frame.several != 0:
            low = float(1.0e9)
            high = float(0.0)
            for row in range(top, bottom):
                for pixel in range(start + row * frame.width + left, start + row * frame.width + right):
                    for sample in range(SAMPLES):
                        key = frame.samples[SAMPLES * pixel + sample]
                        if key != EMPTY:
                            z = depth_of(key)
                            low, high = wp.min(low, z), wp.max(high, z)
            on_links = about(picture, left, top, low, high, ends, views, frame, look)
        if on_tissue != wp.uint64(0):
            shade_tissue(
                on_tissue, left, top, right, bottom, start, frame.width, lens(views, picture),
                wp.vec3(views[picture, 4], views[picture, 5], views[picture, 6]), look.lamp_size,
                picture * frame.capsules, frame.capsules, ends, frame.radii, frame.capsule_owners,
                look.ambient, depths, alphas, colors,
            )  # fmt: skip
    if not marked:
        return
    frame.marks[picture * each + number] = wp.uint8(0)
    blend_square(
        left, top, right, bottom, picture, wp.uint64(0), on_links,
        surfaces, ends, views, frame, look, colors, depths, alphas, labels,
    )  # fmt: skip


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
        on_tissue = about(picture, left, top, -block_max(-low), block_max(high), ends, views, frame, look)
        if frame.several != 0:
            low, high = 1.0e9, 0.0
            if inside:
                for sample in range(SAMPLES):
                    key = frame.samples[SAMPLES * pixel + sample]
                    if key != EMPTY:
                        z = depth_of(key)
                        low, high = wp.min(low, z), wp.max(high, z)
            on_links = about(picture, left, top, -block_max(-low), block_max(high), ends, views, frame, look)
    if not inside:
        return
    labels[pixel] = wp.where(alphas[pixel] > 0.5, wp.uint8(1), wp.uint8(0))
    blend_square(
        column, row, column + 1, row + 1, picture, on_tissue, on_links,
        surfaces, ends, views, frame, look, colors, depths, alphas, labels,
    )  # fmt: skip
