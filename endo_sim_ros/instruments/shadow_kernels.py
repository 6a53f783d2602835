"""Functions for kernels: how much of a lamp, and of the light from all around, capsules keep from a point."""

import warp as wp

MOST = wp.constant(64)  # capsules: a tile keeps those that matter to it in one word
REACH = wp.constant(4.0)  # radii of a capsule beyond which it takes less than a sixteenth of the light from all around


@wp.func
def closest(a: wp.vec3, b: wp.vec3, p: wp.vec3, q: wp.vec3) -> wp.vec2:
    """Where segments a b and p q come closest: the share of the way along each (Ericson, Real-Time Collision Detection, 5.1.9)."""
    d1, d2, r = b - a, q - p, a - p
    aa, ee, f = wp.dot(d1, d1), wp.dot(d2, d2), wp.dot(d2, r)
    if aa < 1.0e-14:
        return wp.vec2(0.0, wp.clamp(f / wp.max(ee, 1.0e-14), 0.0, 1.0))
    c = wp.dot(d1, r)
    if ee < 1.0e-14:
        return wp.vec2(wp.clamp(-c / aa, 0.0, 1.0), 0.0)
    bb = wp.dot(d1, d2)
    cross = aa * ee - bb * bb
    s = float(0.0)
    if cross > 1.0e-6 * aa * ee:
        s = wp.clamp((bb * f - c * ee) / cross, 0.0, 1.0)
    t = (bb * s + f) / ee
    if t < 0.0:
        return wp.vec2(wp.clamp(-c / aa, 0.0, 1.0), 0.0)
    if t > 1.0:
        return wp.vec2(wp.clamp((bb - c) / aa, 0.0, 1.0), 1.0)
    return wp.vec2(s, t)


@wp.func
def disc_below(x: float) -> float:
    """Share of the unit disc on one side of a line at distance x from its middle."""
    y = wp.clamp(x, -1.0, 1.0)
    return 0.5 + (y * wp.sqrt(1.0 - y * y) + wp.asin(y)) / wp.pi


@wp.func
def hidden(a: wp.vec3, b: wp.vec3, radius: float, lamp: wp.vec3, size: float, at: wp.vec3, blur: float) -> float:
    """Share of a lamp, a disc of some size, that a capsule hides from a point.

    It is exact where the edges of the capsule look straight across the lamp. ``blur`` (m) is the least half width of an edge.
    """
    where = closest(a, b, lamp, at)
    gap = wp.length(lamp + where[1] * (at - lamp) - a - where[0] * (b - a))
    half = wp.max(size * (1.0 - where[1]), blur)
    if not (gap <= radius + half):  # nor if it is not a number
        return 0.0
    return disc_below((gap + radius) / half) - disc_below((gap - radius) / half)


@wp.func
def angle_sum(along: float, off: float) -> float:
    slope = along / off
    return wp.atan(slope) + slope / (1.0 + slope * slope)


@wp.func
def covered(a: wp.vec3, b: wp.vec3, radius: float, at: wp.vec3, normal: wp.vec3) -> float:
    """Share of the light from all around a surface that a capsule takes: the view factor of a thin tube, and of a sphere where it has
    no length."""
    axis = b - a
    length = wp.length(axis)
    share = wp.clamp(wp.dot(at - a, axis) / wp.max(length * length, 1.0e-14), 0.0, 1.0)
    way = a + share * axis - at
    distance = wp.length(way)
    if not (distance <= REACH * radius):
        return 0.0
    if length < 1.0e-6:
        off = wp.max(distance, radius)
        return radius * radius / (off * off) * wp.max(wp.dot(normal, way) / wp.max(distance, 1.0e-9), 0.0)
    u = axis / length
    start = wp.dot(a - at, u)
    foot = a - at - start * u
    clear = wp.length(foot)
    off = wp.max(clear, radius)
    facing = wp.max(wp.dot(normal, foot) / wp.max(clear, 1.0e-9), 0.0)
    return radius / off * facing * (angle_sum(start + length, off) - angle_sum(start, off)) / wp.pi


@wp.func
def near(
    at: wp.vec3,  # m, camera
    slack: float,  # m: points at most so far from there
    lamp: wp.vec3,
    size: float,
    first: int,  # capsule of this picture
    count: int,
    ends: wp.array2d[wp.vec3],  # [B C, 2], camera
    radii: wp.array[float],  # [C]
    owners: wp.array[int],  # [C] number of the instrument
    but: int,  # an instrument that does not count, or -1
) -> wp.uint64:
    """The capsules that may keep light from points about one: a bit for each."""
    found = wp.uint64(0)
    for c in range(count):
        if owners[c] != but:
            a, b = ends[first + c, 0], ends[first + c, 1]
            where = closest(a, b, lamp, at)
            gap = wp.length(lamp + where[1] * (at - lamp) - a - where[0] * (b - a))
            reached = gap < radii[c] + size + slack
            if not reached and gap < REACH * radii[c] + slack:  # the whole way from the lamp is as near as its end at least
                beside = closest(a, b, at, at)
                reached = wp.length(a + beside[0] * (b - a) - at) < REACH * radii[c] + slack
            if reached:
                found = found | (wp.uint64(1) << wp.uint64(c))
    return found


@wp.func
def light_left(
    mask: wp.uint64,
    at: wp.vec3,
    normal: wp.vec3,
    blur: float,
    lamp: wp.vec3,
    size: float,
    first: int,
    count: int,
    ends: wp.array2d[wp.vec3],
    radii: wp.array[float],
    owners: wp.array[int],
    but: int,
) -> wp.vec2:
    """Share of the lamp that a point sees, and of the light from all around that it gets."""
    seen = float(1.0)
    open = float(1.0)
    for c in range(count):
        if ((mask >> wp.uint64(c)) & wp.uint64(1)) != wp.uint64(0) and owners[c] != but:
            a, b = ends[first + c, 0], ends[first + c, 1]
            seen *= 1.0 - hidden(a, b, radii[c], lamp, size, at, blur)
            open -= covered(a, b, radii[c], at, normal)
    return wp.vec2(seen, wp.max(open, 0.0))
