"""What the backends have in common: the mathematics of a splat, projection and its gradients, tile lists.

native/projection.h has the way forward, for one splat on a GPU and for as many as a vector holds on a CPU.

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

Memory layout. `splats` is one float32 row of 16 per splat, one cache line; its columns are the fields of Splat in
native/blending.h. A splat touches the tiles whose pixel centres its ellipse α ≥ 1/255 meets. Those (splat, tile) pairs
are *intersections*, numbered in depth order of their splats, so that the intersections of a splat are consecutive, and
listed by tile, within a tile by depth. On a CPU the backward pass writes one gradient row of 16 per intersection, and
`project_backward` adds up the consecutive rows of a splat: no two threads write to the same place, so results repeat bit
for bit. On a GPU all tiles add to one row per splat. The absolute gradients of the mean, Σ_pixels |∂L/∂mean|, are added
up alike.
"""

import warp as wp

from endo_sim_ros.splatting.constants import ABSOLUTE
from endo_sim_ros.splatting.headers import headers

wp.set_module_options({"enable_backward": False, "extra_build_options": headers("projection.h")})

# Columns of a gradient record, the fields of Record in native/blending.h.
X, Y = wp.constant(0), wp.constant(1)
A, B, C = wp.constant(2), wp.constant(3), wp.constant(4)
OPACITY = wp.constant(5)
Z = wp.constant(6)
RED = wp.constant(7)  # and green, blue
EXTRA = wp.constant(ABSOLUTE + 2)

LOOK_AHEAD = wp.constant(8)  # items from one to that whose memory is asked for

mat23 = wp.types.matrix(shape=(2, 3), dtype=wp.float32)
vec10 = wp.types.vector(length=10, dtype=wp.float32)
vec16 = wp.types.vector(length=16, dtype=wp.float32)


# ---------------------------------------------------------------- one Gaussian


@wp.func_native("wp::mat33 found; endo_sim::rotation_of((const float*)&quat, (float*)&found); return found;")
def rotation_of(quat: wp.vec4) -> wp.mat33:
    """Rotation matrix of a quaternion wxyz, not necessarily normalised; the zero quaternion stands for no rotation."""
    ...


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
def world_covariance(n: int, quats: wp.array[wp.vec4], scales: wp.array[wp.vec3], covars: wp.array[wp.mat33]) -> wp.mat33:
    """Covariance of Gaussian n, m²: the symmetric part of the one given, or R S Sᵀ Rᵀ."""
    if covars.shape[0] > 0:
        return 0.5 * (covars[n] + wp.transpose(covars[n]))
    m = rotation_of(quats[n]) * wp.diag(scales[n])
    return m * wp.transpose(m)


@wp.func_native("wp::vec_t<16, float> found{}; endo_sim::sh_basis(count, (const float*)&d, (float*)&found); return found;")
def sh_basis(count: int, d: wp.vec3) -> vec16:
    """The first 1, 4, 9 or 16 real spherical harmonics in a unit direction, ordered and signed as in 3DGS files."""
    ...


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


@wp.func_native(
    "wp::vec2 found; endo_sim::clamped_slopes((const float*)&p, (const float*)&K, width, height, (float*)&found); return found;"
)
def clamped_slopes(p: wp.vec3, K: wp.mat33, width: int, height: int) -> wp.vec2:
    """x/z and y/z, limited to the image plus 0.3 half fields of view, where the linearised projection still holds."""
    ...


@wp.func_native("""
    wp::mat_t<2, 3, float> found;
    endo_sim::projection_jacobian((const float*)&slopes, z, (const float*)&K, (float*)&found);
    return found;
""")
def projection_jacobian(slopes: wp.vec2, z: float, K: wp.mat33) -> mat23:
    """∂(u, v)/∂(x, y, z) [2, 3], pixel/m, of a point in the camera's frame with depth z, m, and slopes (x/z, y/z), see `clamped_slopes`."""
    ...


@wp.func_native("""
    const endo_sim::Shapes shapes{(const float*)quats.data, (const float*)scales.data, (const float*)covars.data};
    const auto found = endo_sim::footprint(shapes, n, endo_sim::Block<float>(1), (const float*)&to_image, eps2d);
    return {found.xx, found.xy, found.yy, found.det};
""")
def image_covariance(
    n: int,
    to_image: mat23,
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    eps2d: float,
) -> wp.vec4:
    """xx, xy and yy of the blurred covariance of Gaussian n in the image, pixel², and their determinant."""
    ...


# ---------------------------------------------------------------- kernels


@wp.func_native("""
    endo_sim::project(
        item, lanes,
        {(const float*)means.data, {(const float*)quats.data, (const float*)scales.data, (const float*)covars.data}, opacities.data,
            (const float*)sh.data, opacities.shape[0], sh.shape[1], per_camera != 0, sh.shape[0] > opacities.shape[0]},
        {viewmats.data, Ks.data, width, height, near, eps2d}, {tiles_x, tiles_y, tile_mask.data},
        {splats.data, radii.data, depth_keys.data, order.data, counts.data});
""")
def project_items(
    item: int,
    lanes: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    viewmats: wp.array[float],
    Ks: wp.array[float],
    width: int,
    height: int,
    near: float,
    eps2d: float,
    per_camera: int,
    tiles_x: int,
    tiles_y: int,
    tile_mask: wp.array[wp.uint8],
    splats: wp.array[float],
    radii: wp.array[int],
    depth_keys: wp.array[int],
    order: wp.array[int],
    counts: wp.array[int],
): ...


@wp.kernel
def project(
    offset: int,
    lanes: int,  # Gaussians of an item, 1 or 16; the last item of each camera may have fewer
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    viewmats: wp.array[float],  # [C · 4·4]
    Ks: wp.array[float],  # [C · 3·3]
    width: int,
    height: int,
    near: float,
    eps2d: float,
    per_camera: int,  # whether means and covars are those of each camera, one after the other; sh may be, too
    tiles_x: int,  # of an image
    tiles_y: int,
    tile_mask: wp.array[wp.uint8],  # [C · tiles], 0 = nobody looks at this tile; or none
    splats: wp.array[float],  # out [C·N · 16]
    radii: wp.array[int],  # out, pixels, 0 = not in the image
    depth_keys: wp.array[int],  # out, order as depths do
    order: wp.array[int],  # out, number of each splat, to be sorted by depth
    counts: wp.array[int],  # out, intersections of each splat
):
    project_items(
        offset + wp.tid(), lanes, means, quats, scales, covars, opacities, sh, viewmats, Ks, width, height, near, eps2d, per_camera,
        tiles_x, tiles_y, tile_mask, splats, radii, depth_keys, order, counts,
    )  # fmt: skip


@wp.func_native("""
    endo_sim::list_intersections(
        item, lanes, {order.data, (const long long*)ends.data, counts.data, (int)ends.shape[0]}, splats.data, gaussian_count,
        {tiles_x, tiles_y, tile_mask.data}, {tiles.data, owners.data, firsts.data, capacity, tile_count});
""")
def list_intersections(
    item: int,
    lanes: int,
    order: wp.array[int],
    ends: wp.array[wp.int64],
    counts: wp.array[int],
    gaussian_count: int,
    splats: wp.array[float],
    tiles_x: int,
    tiles_y: int,
    tile_mask: wp.array[wp.uint8],
    tile_count: int,
    capacity: int,
    tiles: wp.array[int],
    owners: wp.array[int],
    firsts: wp.array[int],
): ...


@wp.kernel
def emit_intersections(
    offset: int,
    lanes: int,  # splats of an item, 1 or 16
    order: wp.array[int],  # [C·N] splats by depth (the first half is used)
    ends: wp.array[wp.int64],  # [C·N] running sum of counts in that order
    counts: wp.array[int],
    gaussian_count: int,
    splats: wp.array[float],
    tiles_x: int,
    tiles_y: int,
    tile_mask: wp.array[wp.uint8],
    tile_count: int,
    capacity: int,  # of the lists
    tiles: wp.array[int],  # out, tile of each intersection
    owners: wp.array[int],  # out, splat of each intersection
    firsts: wp.array[int],  # out, first intersection of each splat, or none
):
    """List the intersections; does nothing if there are more than the lists can hold."""
    list_intersections(
        offset + wp.tid(), lanes, order, ends, counts, gaussian_count, splats, tiles_x, tiles_y, tile_mask, tile_count, capacity,
        tiles, owners, firsts,
    )  # fmt: skip


@wp.func_native("endo_sim::prefetch(rows.data + (size_t)row * rows.shape[1]);")
def prefetch_row(rows: wp.array2d[float], row: int): ...


@wp.kernel
def project_backward(
    offset: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    covars: wp.array[wp.mat33],
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
            covariance = world_covariance(n, quats, scales, covars)
            cov = image_covariance(n, to_image, quats, scales, covars, eps2d)
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
            to_gaussian = mean + wp.transpose(rotation) * translation
            distance = wp.length(to_gaussian)
            direction = wp.normalize(to_gaussian)
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
    if covars.shape[0] > 0:
        v_covars[n] = v_covariance
    elif drawn == 0:  # perhaps because its numbers are not finite
        v_scales[n] = wp.vec3()
        v_quats[n] = wp.vec4()
    else:
        # ---- Scale and quaternion: Σ = M Mᵀ, M = R diag(scale).
        r = rotation_of(quats[n])
        scale = scales[n]
        v_m = 2.0 * (v_covariance * r * wp.diag(scale))
        rv = wp.transpose(r) * v_m
        v_scales[n] = wp.vec3(rv[0, 0], rv[1, 1], rv[2, 2])
        v_quats[n] = quat_gradient(quats[n], v_m * wp.diag(scale))
