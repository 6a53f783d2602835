"""What the backends have in common: the mathematics of a splat, projection and its gradients, tile lists.

Notation. A splat is one Gaussian n seen by one camera c; splats are numbered c·N + n. With mean position p in the
camera frame, J the Jacobian of the pinhole projection (x/z and y/z clamped to 1.3 fields of view), R the camera
rotation and Σ the world covariance, its footprint in the image is a 2D Gaussian (EWA splatting, Zwicker et al. 2001;
3DGS, eq. 5)

    mean = (fx x/z + cx, fy y/z + cy),   cov = J R Σ Rᵀ Jᵀ + eps2d I,   conic = cov⁻¹ = [[A, B], [B, C]]
    σ(d) = ½ (A dx² + C dy²) + B dx dy = ½ A ((dx + B/A dy)² + det(cov)/cov_yy² dy²),
    α = min(0.999, opacity · exp(−σ)), nothing below 1/255.

Compositing, front to back, with w_i = α_i T_i and T_{i+1} = T_i (1 − α_i), until T would drop below 1e-4:

    colour = Σ w_i c_i + T background,   depth = Σ w_i z_i,   alpha = Σ w_i,
    distortion L = Σ_ij w_i w_j |z_i − z_j| = Σ_i 2 w_i (z_i W_i − D_i),   W_i = Σ_{j<i} w_j,   D_i = Σ_{j<i} w_j z_j,
    median depth = z_i of the splat i with T_i > ½ ≥ T_{i+1}, if there is one: the kernels name it, torch does the rest.

Extras e_i, four numbers that a splat may carry, are composited as colours are, without a background: Σ w_i e_i.

Backward, in one front-to-back pass (v_x is the gradient of the loss with respect to x): with

    ∂L/∂w_i = 2 [z_i (W_i + W_{i+1} − W) + D − D_i − D_{i+1}],     ∂L/∂z_i = 2 w_i (W_i + W_{i+1} − W),
    g_i = v_colour·c_i + v_extra·e_i + v_depth z_i + v_alpha + v_L ∂L/∂w_i,       v_α_i = T_i g_i − (S − Σ_{j≤i} w_j g_j) / (1 − α_i),
    S = Σ_i w_i g_i = v_colour·colour + v_extra·extra + v_depth D + v_alpha W + 2 v_L L   (colour without background here).

Depths are taken relative to the first splat of a tile: L does not change, and float32 keeps the small differences.

Memory layout. `splats` is one float32 row of 16 per splat, one cache line; its columns are the constants below. A splat
touches the tiles whose pixel centres its ellipse α ≥ 1/255 meets. Those (splat, tile) pairs are *intersections*,
numbered in depth order of their splats, so that the intersections of a splat are consecutive, and listed by tile, within
a tile by depth. On a CPU the backward pass writes one gradient row of 16 per intersection, and `project_backward` adds
up the consecutive rows of a splat: no two threads write to the same place, so results repeat bit for bit. On a GPU all
tiles add to one row per splat. The absolute gradients of the mean, Σ_pixels |∂L/∂mean|, are added up alike.
"""

import warp as wp

from endo_sim_ros.splatting.constants import ABSOLUTE, ALPHA_MIN, LOG_ALPHA_SLACK, PIXEL_SLACK, TILE
from endo_sim_ros.splatting.headers import headers

wp.set_module_options({"enable_backward": False, "extra_build_options": headers("blending.h")})

# Columns of a splat: the fields of Splat in native/blending.h.
X, Y = wp.constant(0), wp.constant(1)  # mean, pixels
A, B, C = wp.constant(2), wp.constant(3), wp.constant(4)  # conic, 1/pixel²
OPACITY = wp.constant(5)
Z = wp.constant(6)  # depth, metres
RED = wp.constant(7)  # and green, blue
EXTENT_X, EXTENT_Y = wp.constant(10), wp.constant(11)  # half size of the ellipse's bounding box, pixels
ASPECT_X, ASPECT_Y = wp.constant(12), wp.constant(13)  # half width on the row through the centre / EXTENT_Y, and vice versa
SHEAR_X, SHEAR_Y = wp.constant(14), wp.constant(15)  # B/A and B/C
# A gradient record, Record there, has the gradients of columns 0 to 9 in the same order, then, if wanted, the sums over pixels of the
# absolute gradients of columns 0 and 1, and the gradients of the extras.
EXTRA = wp.constant(ABSOLUTE + 2)

LOOK_AHEAD = wp.constant(8)  # items from one to that whose memory is asked for
TILE_LAST = wp.constant(float(TILE - 1))

mat23 = wp.types.matrix(shape=(2, 3), dtype=wp.float32)
vec10 = wp.types.vector(length=10, dtype=wp.float32)
vec16 = wp.types.vector(length=16, dtype=wp.float32)


# ---------------------------------------------------------------- one Gaussian


@wp.func
def unit_quat(quat: wp.vec4) -> wp.vec4:
    """Normalised quaternion; the zero quaternion stands for no rotation."""
    norm = wp.length(quat)
    if norm < 1.0e-12:
        return wp.vec4(1.0, 0.0, 0.0, 0.0)
    return quat / norm


@wp.func
def quat_to_matrix(q: wp.vec4) -> wp.mat33:
    """Rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def quat_gradient(quat: wp.vec4, v: wp.mat33) -> wp.vec4:
    """Gradient of a quaternion (not necessarily normalised) from that of its rotation matrix."""
    norm = wp.length(quat)
    if norm < 1.0e-12:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    q = quat / norm
    w, x, y, z = q[0], q[1], q[2], q[3]
    v_q = 2.0 * wp.vec4(
        x * (v[2, 1] - v[1, 2]) + y * (v[0, 2] - v[2, 0]) + z * (v[1, 0] - v[0, 1]),
        w * (v[2, 1] - v[1, 2]) + y * (v[1, 0] + v[0, 1]) + z * (v[2, 0] + v[0, 2]) - 2.0 * x * (v[1, 1] + v[2, 2]),
        w * (v[0, 2] - v[2, 0]) + x * (v[1, 0] + v[0, 1]) + z * (v[2, 1] + v[1, 2]) - 2.0 * y * (v[0, 0] + v[2, 2]),
        w * (v[1, 0] - v[0, 1]) + x * (v[2, 0] + v[0, 2]) + y * (v[2, 1] + v[1, 2]) - 2.0 * z * (v[0, 0] + v[1, 1]),
    )
    return (v_q - q * wp.dot(q, v_q)) / norm


@wp.func
def scaled_rotation(quat: wp.vec4, scale: wp.vec3) -> wp.mat33:
    """M = R diag(scale), so that the covariance is M Mᵀ."""
    return quat_to_matrix(unit_quat(quat)) * wp.diag(scale)


@wp.func
def world_covariance(n: int, quats: wp.array[wp.vec4], scales: wp.array[wp.vec3], covars: wp.array[wp.mat33], has_covars: int) -> wp.mat33:
    """Covariance of Gaussian n, m²: the symmetric part of the one given, or R S Sᵀ Rᵀ."""
    if has_covars != 0:
        return 0.5 * (covars[n] + wp.transpose(covars[n]))
    m = scaled_rotation(quats[n], scales[n])
    return m * wp.transpose(m)


@wp.func
def sh_basis(count: int, d: wp.vec3) -> vec16:
    """The first 1, 4, 9 or 16 real spherical harmonics in a unit direction, ordered and signed as in 3DGS files."""
    x, y, z = d[0], d[1], d[2]
    b = vec16()
    b[0] = 0.28209479177387814
    if count > 1:
        b[1] = -0.4886025119029199 * y
        b[2] = 0.4886025119029199 * z
        b[3] = -0.4886025119029199 * x
    if count > 4:
        b[4] = 1.0925484305920792 * x * y
        b[5] = -1.0925484305920792 * y * z
        b[6] = 0.31539156525252005 * (2.0 * z * z - x * x - y * y)
        b[7] = -1.0925484305920792 * x * z
        b[8] = 0.5462742152960396 * (x * x - y * y)
    if count > 9:
        b[9] = -0.5900435899266435 * y * (3.0 * x * x - y * y)
        b[10] = 2.890611442640554 * x * y * z
        b[11] = -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y)
        b[12] = 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        b[13] = -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y)
        b[14] = 1.445305721320277 * z * (x * x - y * y)
        b[15] = -0.5900435899266435 * x * (x * x - 3.0 * y * y)
    return b


@wp.func
def sh_direction_gradient(count: int, d: wp.vec3, v: vec16) -> wp.vec3:
    """Gradient of the direction from those of the basis values."""
    x, y, z = d[0], d[1], d[2]
    g = wp.vec3()
    if count > 1:
        g += 0.4886025119029199 * wp.vec3(-v[3], -v[1], v[2])
    if count > 4:
        g += 1.0925484305920792 * wp.vec3(v[4] * y - v[7] * z, v[4] * x - v[5] * z, -v[5] * y - v[7] * x)
        g += 0.31539156525252005 * v[6] * wp.vec3(-2.0 * x, -2.0 * y, 4.0 * z)
        g += 0.5462742152960396 * v[8] * wp.vec3(2.0 * x, -2.0 * y, 0.0)
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        g += -0.5900435899266435 * v[9] * wp.vec3(6.0 * x * y, 3.0 * (xx - yy), 0.0)
        g += 2.890611442640554 * v[10] * wp.vec3(y * z, x * z, x * y)
        g += -0.4570457994644658 * v[11] * wp.vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z)
        g += 0.3731763325901154 * v[12] * wp.vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy)
        g += -0.4570457994644658 * v[13] * wp.vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z)
        g += 1.445305721320277 * v[14] * wp.vec3(2.0 * x * z, -2.0 * y * z, xx - yy)
        g += -0.5900435899266435 * v[15] * wp.vec3(3.0 * (xx - yy), -6.0 * x * y, 0.0)
    return g


@wp.func
def sh_color(n: int, count: int, basis: vec16, sh: wp.array2d[wp.vec3]) -> wp.vec3:
    """Colour of Gaussian n before it is clamped at zero."""
    color = wp.vec3(0.5, 0.5, 0.5)
    for k in range(count):
        color += basis[k] * sh[n, k]
    return color


@wp.func
def camera_rotation(viewmat: wp.mat44) -> wp.mat33:
    return wp.mat33(
        viewmat[0, 0], viewmat[0, 1], viewmat[0, 2],
        viewmat[1, 0], viewmat[1, 1], viewmat[1, 2],
        viewmat[2, 0], viewmat[2, 1], viewmat[2, 2],
    )  # fmt: skip


@wp.func
def camera_translation(viewmat: wp.mat44) -> wp.vec3:
    return wp.vec3(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])


@wp.func
def clamped_slopes(p: wp.vec3, K: wp.mat33, width: int, height: int) -> wp.vec2:
    """x/z and y/z, limited to the image plus 0.3 half fields of view, where the linearised projection still holds."""
    margin_x = 0.15 * float(width) / K[0, 0]
    margin_y = 0.15 * float(height) / K[1, 1]
    return wp.vec2(
        wp.clamp(p[0] / p[2], -K[0, 2] / K[0, 0] - margin_x, (float(width) - K[0, 2]) / K[0, 0] + margin_x),
        wp.clamp(p[1] / p[2], -K[1, 2] / K[1, 1] - margin_y, (float(height) - K[1, 2]) / K[1, 1] + margin_y),
    )


@wp.func
def projection_jacobian(slopes: wp.vec2, z: float, K: wp.mat33) -> mat23:
    """∂(u, v)/∂(x, y, z) [2, 3], pixel/m, of a point in the camera's frame with depth z, m, and slopes (x/z, y/z), see `clamped_slopes`."""
    fx, fy = K[0, 0] / z, K[1, 1] / z
    return mat23(fx, 0.0, -fx * slopes[0], 0.0, fy, -fy * slopes[1])


@wp.func
def image_covariance(
    n: int,
    to_image: mat23,
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    has_covars: int,
    eps2d: float,
) -> wp.vec4:
    """xx, xy and yy of the blurred covariance of Gaussian n in the image, pixel², and their determinant.

    Of M Mᵀ + εI, with M's rows r and s, the determinant is |r × s|² + ε (|r|² + |s|²) + ε²: nothing cancels.
    """
    if has_covars != 0:
        cov = to_image * world_covariance(n, quats, scales, covars, has_covars) * wp.transpose(to_image)
        xx, yy = cov[0, 0] + eps2d, cov[1, 1] + eps2d
        return wp.vec4(xx, cov[0, 1], yy, xx * yy - cov[0, 1] * cov[0, 1])
    m = to_image * scaled_rotation(quats[n], scales[n])
    r, s = wp.vec3(m[0, 0], m[0, 1], m[0, 2]), wp.vec3(m[1, 0], m[1, 1], m[1, 2])
    rr, ss, normal = wp.dot(r, r), wp.dot(s, s), wp.cross(r, s)
    return wp.vec4(rr + eps2d, wp.dot(r, s), ss + eps2d, wp.dot(normal, normal) + eps2d * (rr + ss) + eps2d * eps2d)


# ---------------------------------------------------------------- tiles


@wp.func
def tile_rows(y: float, extent_y: float, tiles_y: int) -> wp.vec2i:
    """Rows [first, end) of tiles that have a pixel centre within extent_y of y."""
    size = float(TILE)
    first = wp.ceil((y - extent_y - PIXEL_SLACK - TILE_LAST - 0.5) / size)
    last = wp.floor((y + extent_y + PIXEL_SLACK - 0.5) / size)
    end = float(tiles_y)
    return wp.vec2i(int(wp.clamp(first, 0.0, end)), int(wp.clamp(last + 1.0, 0.0, end)))


@wp.func_native("""
    const endo_sim::Span span = endo_sim::ellipse_span(center, low, high, widest, shear, aspect, extent);
    return {span.low, span.high};
""")
def ellipse_span(center: float, low: float, high: float, widest: float, shear: float, aspect: float, extent: float) -> wp.vec2:
    """First and last coordinate of an ellipse along one axis, between low and high on the other; see the header."""
    ...


@wp.func
def tile_columns(row: int, x: float, y: float, shear: wp.vec2, extent: wp.vec2, aspect: float, tiles_x: int) -> wp.vec2i:
    """Columns [first, end) of tiles in one row that have a pixel centre in the x-range of ellipse ∩ row.

    Ellipse and row are convex, so the tiles met are exactly a range. At height dy the ellipse spans
    −(B/A) dy ± aspect √(extent_y² − dy²); it is widest to the right at dy = −(B/C) extent_x.
    """
    size = float(TILE)
    low = wp.max(float(row * TILE) + 0.5 - y - PIXEL_SLACK, -extent[1])
    high = wp.min(float(row * TILE) + 0.5 + TILE_LAST - y + PIXEL_SLACK, extent[1])
    span = ellipse_span(x, low, high, -shear[1] * extent[0], shear[0], aspect, extent[1])
    left, right = span[0] - PIXEL_SLACK, span[1] + PIXEL_SLACK
    first = wp.ceil((left - TILE_LAST - 0.5) / size)
    last = wp.floor((right - 0.5) / size)
    end = float(tiles_x)
    return wp.vec2i(int(wp.clamp(first, 0.0, end)), int(wp.clamp(last + 1.0, 0.0, end)))


@wp.kernel
def project(
    offset: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    has_covars: int,
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    viewmats: wp.array[wp.mat44],
    Ks: wp.array[wp.mat33],
    width: int,
    height: int,
    near: float,
    eps2d: float,
    per_camera: int,  # whether means and covars are those of each camera, one after the other; sh may be, too
    tile_mask: wp.array[wp.uint8],  # [C · tiles], 0 = nobody looks at this tile
    splats: wp.array2d[float],  # out
    radii: wp.array[int],  # out, pixels, 0 = not in the image
    depth_keys: wp.array[int],  # out, order as depths do
    order: wp.array[int],  # out, number of each splat, to be sorted by depth
    counts: wp.array[int],  # out, intersections of each splat
):
    splat = offset + wp.tid()
    gaussian_count = opacities.shape[0]
    camera = splat // gaussian_count
    n = splat - camera * gaussian_count
    own = n + per_camera * camera * gaussian_count
    radii[splat] = 0
    depth_keys[splat] = 0
    order[splat] = splat
    counts[splat] = 0

    viewmat, K = viewmats[camera], Ks[camera]
    rotation, translation = camera_rotation(viewmat), camera_translation(viewmat)
    p = rotation * means[own] + translation
    opacity = opacities[n]
    # Written so that NaN fails the test too.
    if not (p[2] >= near and opacity >= ALPHA_MIN):
        return
    to_image = projection_jacobian(clamped_slopes(p, K, width, height), p[2], K) * rotation
    cov = image_covariance(own, to_image, quats, scales, covars, has_covars, eps2d)
    det = cov[3]
    if not (det > 0.0 and cov[0] > 0.0):
        return
    x, y = K[0, 0] * p[0] / p[2] + K[0, 2], K[1, 1] * p[1] / p[2] + K[1, 2]
    a, b, c = cov[2] / det, -cov[1] / det, cov[0] / det
    level = 2.0 * (wp.log(255.0 * opacity) + LOG_ALPHA_SLACK)
    extent = wp.vec2(wp.sqrt(level * cov[0]), wp.sqrt(level * cov[2]))
    aspect = wp.vec2(wp.sqrt(det) / cov[2], wp.sqrt(det) / cov[0])
    shear = wp.vec2(-cov[1] / cov[2], -cov[1] / cov[0])

    basis = vec16()
    if sh.shape[1] == 1:
        basis[0] = 0.28209479177387814
    else:
        basis = sh_basis(sh.shape[1], wp.normalize(means[own] + wp.transpose(rotation) * translation))
    color = sh_color(wp.where(sh.shape[0] > gaussian_count, own, n), sh.shape[1], basis, sh)
    finite = wp.isfinite(x + y + a + b + c + extent[0] + extent[1] + aspect[0] + aspect[1] + opacity)
    if not (finite and wp.isfinite(color[0] + color[1] + color[2])):
        return
    if x + extent[0] < 0.0 or x - extent[0] > float(width) or y + extent[1] < 0.0 or y - extent[1] > float(height):
        return
    color = wp.max(color, wp.vec3())

    splats[splat, X] = x
    splats[splat, Y] = y
    splats[splat, A] = a
    splats[splat, B] = b
    splats[splat, C] = c
    splats[splat, OPACITY] = opacity
    splats[splat, Z] = p[2]
    splats[splat, RED] = color[0]
    splats[splat, RED + 1] = color[1]
    splats[splat, RED + 2] = color[2]
    splats[splat, EXTENT_X] = extent[0]
    splats[splat, EXTENT_Y] = extent[1]
    splats[splat, ASPECT_X] = aspect[0]
    splats[splat, ASPECT_Y] = aspect[1]
    splats[splat, SHEAR_X] = shear[0]
    splats[splat, SHEAR_Y] = shear[1]
    radii[splat] = int(wp.min(wp.ceil(wp.max(extent[0], extent[1])), 1.0e6))
    depth_keys[splat] = wp.cast(p[2], wp.int32)  # the bits of positive floats order as the floats do

    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    rows = tile_rows(y, extent[1], tiles_y)
    count = int(0)
    for row in range(rows[0], rows[1]):
        columns = tile_columns(row, x, y, shear, extent, aspect[0], tiles_x)
        for column in range(columns[0], columns[1]):
            count += int(tile_mask[(camera * tiles_y + row) * tiles_x + column])
    counts[splat] = count


@wp.func_native("endo_sim::prefetch(rows.data + (size_t)row * rows.shape[1]);")
def prefetch_row(rows: wp.array2d[float], row: int): ...


@wp.kernel
def emit_intersections(
    offset: int,
    order: wp.array[int],  # [C·N] splats by depth (the first half is used)
    ends: wp.array[wp.int64],  # [C·N] running sum of counts in that order
    counts: wp.array[int],
    gaussian_count: int,
    splats: wp.array2d[float],
    tile_mask: wp.array[wp.uint8],
    tiles_x: int,
    tiles_y: int,
    capacity: int,  # of the lists
    by_splat: int,  # whether values are splats, rather than numbers of intersections with the two arrays after them
    tiles: wp.array[int],  # out, tile of each intersection (the first half is used)
    values: wp.array[int],  # out, what is sorted with it (the first half is used)
    firsts: wp.array[int],  # out, first intersection of each splat
    owners: wp.array[int],  # out, splat of each intersection
):
    """List the intersections; does nothing if there are more than the lists can hold."""
    rank = offset + wp.tid()
    prefetch_row(splats, order[wp.min(rank + LOOK_AHEAD, ends.shape[0] - 1)])
    splat = order[rank]
    if counts[splat] == 0 or ends[ends.shape[0] - 1] > wp.int64(capacity):
        return
    end = int(ends[rank])
    i = end - counts[splat]
    if by_splat == 0:
        firsts[splat] = i
        for j in range(i, end):
            owners[j] = splat
            values[j] = j
    else:
        for j in range(i, end):
            values[j] = splat
    camera = splat // gaussian_count
    x, y = splats[splat, X], splats[splat, Y]
    extent = wp.vec2(splats[splat, EXTENT_X], splats[splat, EXTENT_Y])
    shear = wp.vec2(splats[splat, SHEAR_X], splats[splat, SHEAR_Y])
    rows = tile_rows(y, extent[1], tiles_y)
    for row in range(rows[0], rows[1]):
        columns = tile_columns(row, x, y, shear, extent, splats[splat, ASPECT_X], tiles_x)
        for column in range(columns[0], columns[1]):
            tile = (camera * tiles_y + row) * tiles_x + column
            if tile_mask[tile] != wp.uint8(0) and i < end:
                tiles[i] = tile
                i += 1
    # Compilers may round differently in the two kernels: an intersection that was counted but not met here
    # goes to the tile after the last one, which nobody draws.
    while i < end:
        tiles[i] = tile_mask.shape[0]
        i += 1


@wp.kernel
def project_backward(
    offset: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    has_covars: int,
    sh: wp.array2d[wp.vec3],
    viewmats: wp.array[wp.mat44],
    Ks: wp.array[wp.mat33],
    width: int,
    height: int,
    eps2d: float,
    counts: wp.array[int],
    by_splat: int,  # whether there is one record for each splat, rather than for each intersection
    firsts: wp.array[int],
    records: wp.array2d[float],
    wants_pose: int,
    image_column: int,  # of the records, which v_image adds up: ABSOLUTE, X for signed ones, below 0 for none
    v_means: wp.array[wp.vec3],  # out, as all below
    v_quats: wp.array[wp.vec4],
    v_scales: wp.array[wp.vec3],
    v_covars: wp.array[wp.mat33],
    v_opacities: wp.array[float],
    v_sh: wp.array2d[wp.vec3],
    v_extras: wp.array2d[wp.vec4],  # [C, N], filled where there are extras
    v_viewmats: wp.array2d[wp.mat44],  # [C, N], each Gaussian's share, filled when wants_pose
    v_image: wp.array2d[wp.vec2],  # [C, N], sums of gradients of the mean in the image
):
    """Gradients of Gaussian n over all cameras: adds up the records of its splats and goes back through `project`."""
    n = offset + wp.tid()
    gaussian_count = means.shape[0]
    sh_count = sh.shape[1]
    if by_splat == 0 and n + LOOK_AHEAD < gaussian_count and counts[n + LOOK_AHEAD] > 0:
        prefetch_row(records, firsts[n + LOOK_AHEAD])
    v_mean = wp.vec3()
    v_covariance = wp.mat33()
    v_opacity = float(0.0)
    drawn = int(0)
    for k in range(sh_count):
        v_sh[n, k] = wp.vec3()

    for camera in range(viewmats.shape[0]):
        # ---- Sum of the records of the splat.
        splat = camera * gaussian_count + n
        if wants_pose != 0:
            v_viewmats[camera, n] = wp.mat44()
        first = splat + 0
        end = splat + wp.min(counts[splat], 1)
        if by_splat == 0:
            first = firsts[splat] + 0
            end = first + counts[splat]
        if image_column >= 0:
            total = wp.vec2()
            for i in range(first, end):
                total += wp.vec2(records[i, image_column], records[i, image_column + 1])
            v_image[camera, n] = total
        if v_extras.shape[0] > 0:
            share = wp.vec4()
            for i in range(first, end):
                share += wp.vec4(records[i, EXTRA], records[i, EXTRA + 1], records[i, EXTRA + 2], records[i, EXTRA + 3])
            v_extras[camera, n] = share
        if counts[splat] > 0:
            drawn = 1
            v = vec10()
            for i in range(first, end):
                for k in range(10):
                    v[k] += records[i, k]

            # ---- What `project` computed.
            viewmat, K = viewmats[camera], Ks[camera]
            rotation, translation = camera_rotation(viewmat), camera_translation(viewmat)
            mean = means[n]
            p = rotation * mean + translation
            z = p[2]
            slopes = clamped_slopes(p, K, width, height)
            to_image = projection_jacobian(slopes, z, K) * rotation
            covariance = world_covariance(n, quats, scales, covars, has_covars)
            cov = image_covariance(n, to_image, quats, scales, covars, has_covars, eps2d)
            det = cov[3]
            conic = wp.mat22(cov[2] / det, -cov[1] / det, -cov[1] / det, cov[0] / det)

            # ---- Covariance: conic = cov⁻¹ and cov = T Σ Tᵀ with T = J R.
            v_conic = wp.mat22(v[A], 0.5 * v[B], 0.5 * v[B], v[C])
            v_cov = -1.0 * (conic * v_conic * conic)
            v_covariance += wp.transpose(to_image) * v_cov * to_image
            v_to_image = 2.0 * (v_cov * to_image * covariance)
            v_jacobian = v_to_image * wp.transpose(rotation)
            v_rotation = wp.transpose(projection_jacobian(slopes, z, K)) * v_to_image

            # ---- Mean in the image: J depends on z and on the slopes, which depend on p unless clamped.
            fx, fy = K[0, 0] / z, K[1, 1] / z
            v_slope_x, v_slope_y = -fx * v_jacobian[0, 2], -fy * v_jacobian[1, 2]
            v_p = wp.vec3(fx * v[X], fy * v[Y], v[Z] - (fx * v[X] * p[0] + fy * v[Y] * p[1]) / z)
            v_p[2] -= fx / z * (v_jacobian[0, 0] - slopes[0] * v_jacobian[0, 2])
            v_p[2] -= fy / z * (v_jacobian[1, 1] - slopes[1] * v_jacobian[1, 2])
            if slopes[0] == p[0] / z:
                v_p += wp.vec3(v_slope_x / z, 0.0, -v_slope_x * slopes[0] / z)
            if slopes[1] == p[1] / z:
                v_p += wp.vec3(0.0, v_slope_y / z, -v_slope_y * slopes[1] / z)
            v_opacity += v[OPACITY]

            # ---- Colour: c = max(Σ basis_k sh_k + 0.5, 0).
            basis = vec16()
            to_gaussian = mean + wp.transpose(rotation) * translation
            distance = wp.length(to_gaussian)
            direction = wp.normalize(to_gaussian)
            if sh_count == 1:
                basis[0] = 0.28209479177387814
            else:
                basis = sh_basis(sh_count, direction)
            color = sh_color(n, sh_count, basis, sh)
            v_color = wp.vec3(v[RED], v[RED + 1], v[RED + 2])
            for k in range(3):
                if color[k] <= 0.0:
                    v_color[k] = 0.0
            v_basis = vec16()
            for k in range(sh_count):
                v_sh[n, k] = v_sh[n, k] + basis[k] * v_color
                v_basis[k] = wp.dot(sh[n, k], v_color)
            v_position = wp.vec3()
            if sh_count > 1 and distance > 0.0:
                v_direction = sh_direction_gradient(sh_count, direction, v_basis)
                v_position = (v_direction - direction * wp.dot(direction, v_direction)) / distance
            v_mean += wp.transpose(rotation) * v_p + v_position

            if wants_pose != 0:  # ---- Pose: the direction is mean + Rᵀ t.
                v_rotation += wp.outer(v_p, mean) + wp.outer(translation, v_position)
                v_t = v_p + rotation * v_position
                v_viewmats[camera, n] = wp.mat44(
                    v_rotation[0, 0], v_rotation[0, 1], v_rotation[0, 2], v_t[0],
                    v_rotation[1, 0], v_rotation[1, 1], v_rotation[1, 2], v_t[1],
                    v_rotation[2, 0], v_rotation[2, 1], v_rotation[2, 2], v_t[2],
                    0.0, 0.0, 0.0, 0.0,
                )  # fmt: skip

    v_means[n] = v_mean
    v_opacities[n] = v_opacity
    if has_covars != 0:
        v_covars[n] = v_covariance
    elif drawn == 0:  # perhaps because its numbers are not finite
        v_scales[n] = wp.vec3()
        v_quats[n] = wp.vec4()
    else:
        # ---- Scale and quaternion: Σ = M Mᵀ, M = R diag(scale).
        r = quat_to_matrix(unit_quat(quats[n]))
        scale = scales[n]
        v_m = 2.0 * (v_covariance * r * wp.diag(scale))
        rv = wp.transpose(r) * v_m
        v_scales[n] = wp.vec3(rv[0, 0], rv[1, 1], rv[2, 2])
        v_quats[n] = quat_gradient(quats[n], v_m * wp.diag(scale))
