// Splats of Gaussians in a camera, and the tiles that they meet: of one Gaussian (F = float), or of 16 of a CPU's vectors
// (F = vfloat). `common_kernels.py` has the formulas and defines the terms.
#pragma once
#include "core/native/lanes.h"
#include "splatting/native/blending.h"

namespace endo_sim {

// Neighbouring items, one for each lane. Lanes beyond the last item repeat it.
template <class F> struct Block {
    int count;

    ENDO_SIM_INLINE explicit Block(int rest) : count(rest < Lanes<F>::count ? rest : Lanes<F>::count) { }

    ENDO_SIM_INLINE int item(int lane) const { return Lanes<F>::count == 1 || lane < count ? lane : count - 1; }

    // The first columns of rows of a size, one row for each item.
    template <int columns> ENDO_SIM_INLINE void read(const float* rows, int size, F* found) const
    {
        if constexpr (Lanes<F>::count == 1) {
            for (int k = 0; k < columns; ++k)
                found[k] = rows[k];
        } else {
            F each[Lanes<F>::count]{}, all[Lanes<F>::count];
            for (int lane = 0; lane < Lanes<F>::count; ++lane)
                __builtin_memcpy(&each[lane], rows + size * item(lane), sizeof(float) * columns);
            transpose(each, all);
            for (int k = 0; k < columns; ++k)
                found[k] = all[k];
        }
    }

    // Write the splats of all items from their columns.
    ENDO_SIM_INLINE void write(float* splats, const F* columns) const
    {
        if constexpr (Lanes<F>::count == 1) {
            for (int k = 0; k < SPLAT_SIZE; ++k)
                splats[k] = columns[k];
        } else {
            static_assert(SPLAT_SIZE == Lanes<F>::count);
            F each[SPLAT_SIZE];
            transpose(columns, each);
            for (int lane = 0; lane < count; ++lane)
                __builtin_memcpy(splats + SPLAT_SIZE * lane, &each[lane], sizeof(Splat));
        }
    }
};

// ---------------------------------------------------------------- Gaussians

// The rotation matrix of a quaternion wxyz; the zero quaternion stands for no rotation.
template <class F> ENDO_SIM_INLINE void rotation_of(const F* quat, F* rotation)
{
    ENDO_SIM_FUSE(on)
    const F norm = root(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
    const auto none = norm < 1e-12f;
    const F one = everywhere<F>(1.0f), by = none ? one : norm;
    const F w = none ? one : quat[0] / by, x = none ? F{} : quat[1] / by, y = none ? F{} : quat[2] / by, z = none ? F{} : quat[3] / by;
    rotation[0] = 1.0f - 2.0f * (y * y + z * z);
    rotation[1] = 2.0f * (x * y - w * z);
    rotation[2] = 2.0f * (x * z + w * y);
    rotation[3] = 2.0f * (x * y + w * z);
    rotation[4] = 1.0f - 2.0f * (x * x + z * z);
    rotation[5] = 2.0f * (y * z - w * x);
    rotation[6] = 2.0f * (x * z - w * y);
    rotation[7] = 2.0f * (y * z + w * x);
    rotation[8] = 1.0f - 2.0f * (x * x + y * y);
}

// x/z and y/z, limited to the image plus 0.3 half fields of view, where the linearised projection still holds.
template <class F> ENDO_SIM_INLINE void clamped_slopes(const F* p, const float* K, int width, int height, F* slopes)
{
    ENDO_SIM_FUSE(on)
    const float sizes[2]{(float)width, (float)height};
    for (int k = 0; k < 2; ++k) {
        const float focal = K[4 * k], center = K[3 * k + 2], margin = 0.15f * sizes[k] / focal;
        slopes[k] = clamp(p[k] / p[2], -center / focal - margin, (sizes[k] - center) / focal + margin);
    }
}

// d(u, v)/d(x, y, z) [2, 3], pixel/m, of points with a depth z and slopes (x/z, y/z).
template <class F> ENDO_SIM_INLINE void projection_jacobian(const F* slopes, F z, const float* K, F* jacobian)
{
    for (int k = 0; k < 2; ++k) {
        const F scale = K[4 * k] / z;
        jacobian[3 * k] = jacobian[3 * k + 1] = F{};
        jacobian[4 * k] = scale;
        jacobian[3 * k + 2] = -scale * slopes[k];
    }
}

// Covariances of Gaussians: quaternions and scales, or matrices where these are not null.
struct Shapes {
    const float *quats, *scales, *covars;
};

// Blurred covariances in the image, pixel^2, and their determinants.
template <class F> struct Footprint {
    F xx, xy, yy, det;
};

// Footprints of Gaussians from `first` on with the matrix `to_image` [2, 3]. Of M M^T + e I, with M's rows r and s, the
// determinant is |r x s|^2 + e (|r|^2 + |s|^2) + e^2: nothing cancels.
template <class F>
ENDO_SIM_INLINE Footprint<F> footprint(const Shapes& shapes, size_t first, Block<F> block, const F* to_image, float eps2d)
{
    ENDO_SIM_FUSE(on)
    const F *u = to_image, *v = to_image + 3;
    if (shapes.covars) {
        F c[9], by_u[3], by_v[3];
        block.template read<9>(shapes.covars + 9 * first, 9, c);
        const F yx = 0.5f * (c[1] + c[3]), zx = 0.5f * (c[2] + c[6]), zy = 0.5f * (c[5] + c[7]);
        const F rows[3][3]{{c[0], yx, zx}, {yx, c[4], zy}, {zx, zy, c[8]}};
        for (int k = 0; k < 3; ++k) {
            by_u[k] = dot(rows[k], u);
            by_v[k] = dot(rows[k], v);
        }
        const F xx = dot(u, by_u) + eps2d, xy = dot(u, by_v), yy = dot(v, by_v) + eps2d;
        return {xx, xy, yy, xx * yy - xy * xy};
    }
    F quat[4], scale[3], rotation[9], r[3], s[3];
    block.template read<4>(shapes.quats + 4 * first, 4, quat);
    block.template read<3>(shapes.scales + 3 * first, 3, scale);
    rotation_of(quat, rotation);
    for (int k = 0; k < 3; ++k) {
        r[k] = scale[k] * (u[0] * rotation[k] + u[1] * rotation[3 + k] + u[2] * rotation[6 + k]);
        s[k] = scale[k] * (v[0] * rotation[k] + v[1] * rotation[3 + k] + v[2] * rotation[6 + k]);
    }
    const F normal[3]{r[1] * s[2] - r[2] * s[1], r[2] * s[0] - r[0] * s[2], r[0] * s[1] - r[1] * s[0]};
    const F rr = dot(r, r), ss = dot(s, s);
    return {rr + eps2d, dot(r, s), ss + eps2d, dot(normal, normal) + eps2d * (rr + ss) + eps2d * eps2d};
}

// The first 1, 4, 9 or 16 real spherical harmonics in a unit direction, ordered and signed as in 3DGS files.
template <class F> ENDO_SIM_INLINE void sh_basis(int count, const F* direction, F* b)
{
    ENDO_SIM_FUSE(on)
    const F x = direction[0], y = direction[1], z = direction[2];
    b[0] = everywhere<F>(0.28209479177387814f);
    if (count > 1) {
        b[1] = -0.4886025119029199f * y;
        b[2] = 0.4886025119029199f * z;
        b[3] = -0.4886025119029199f * x;
    }
    if (count > 4) {
        b[4] = 1.0925484305920792f * x * y;
        b[5] = -1.0925484305920792f * y * z;
        b[6] = 0.31539156525252005f * (2.0f * z * z - x * x - y * y);
        b[7] = -1.0925484305920792f * x * z;
        b[8] = 0.5462742152960396f * (x * x - y * y);
    }
    if (count > 9) {
        b[9] = -0.5900435899266435f * y * (3.0f * x * x - y * y);
        b[10] = 2.890611442640554f * x * y * z;
        b[11] = -0.4570457994644658f * y * (4.0f * z * z - x * x - y * y);
        b[12] = 0.3731763325901154f * z * (2.0f * z * z - 3.0f * x * x - 3.0f * y * y);
        b[13] = -0.4570457994644658f * x * (4.0f * z * z - x * x - y * y);
        b[14] = 1.445305721320277f * z * (x * x - y * y);
        b[15] = -0.5900435899266435f * x * (x * x - 3.0f * y * y);
    }
}

// ---------------------------------------------------------------- tiles

// Tiles of C pictures, and whether anybody looks at each; null: somebody looks at all.
struct Grid {
    int columns, rows;
    const unsigned char* seen;
};

// Where splats are seen: fields of Splat.
template <class F> struct Ellipse {
    F x, y, extent_x, extent_y, aspect_x, shear_x, shear_y;
};

template <class F> struct Range {
    integers_of<F> first, end;
};

// Those of `count` tiles, along one axis, that have a pixel centre from low to high.
template <class F> ENDO_SIM_INLINE Range<F> tiles_between(F low, F high, int count)
{
    const F first = ceil_of((low - PIXEL_SLACK - (TILE - 0.5f)) / (float)TILE), last = floor_of((high + PIXEL_SLACK - 0.5f) / (float)TILE);
    return {whole(clamp(first, 0.0f, (float)count)), whole(clamp(last + 1.0f, 0.0f, (float)count))};
}

// Call visit(first, end) for the ranges of tiles that the ellipses of wanted lanes meet in one row after the other of a
// picture whose tiles begin with `picture`. Ellipse and row are convex, so the tiles met are exactly a range. At height d the
// ellipse spans -shear_x d -+ aspect_x sqrt(extent_y^2 - d^2); it is widest to the right at d = -shear_y extent_x.
template <class F, class Wanted, class Visit>
ENDO_SIM_INLINE void visit_rows(const Grid& grid, integers_of<F> picture, const Ellipse<F>& e, Wanted wanted, Visit visit)
{
    ENDO_SIM_FUSE(on)
    const Range<F> rows = tiles_between(e.y - e.extent_y, e.y + e.extent_y, grid.rows);
    const integers_of<F> end = wanted ? rows.end : rows.first;
    const F widest = -e.shear_y * e.extent_x;
    for (integers_of<F> row = rows.first; any(row < end); row += 1) {
        const F top = float_of(row * TILE) + 0.5f - e.y;
        const F low = larger(top - PIXEL_SLACK, -e.extent_y), high = smaller(top + ((TILE - 1) + PIXEL_SLACK), e.extent_y);
        const Span<F> span = ellipse_span(e.x, low, high, widest, e.shear_x, e.aspect_x, e.extent_y);
        const Range<F> columns = tiles_between(span.low, span.high, grid.columns);
        const integers_of<F> tile = picture + row * grid.columns, first = tile + columns.first;
        const auto met = (row < end) & (columns.first < columns.end);
        visit(first, met ? tile + columns.end : first);
    }
}

// Call visit(lane, first, end) for the ranges of all lanes.
template <class F, class Visit> ENDO_SIM_INLINE void visit_lanes(integers_of<F> first, integers_of<F> end, Visit visit)
{
    constexpr int lanes = Lanes<F>::count;
    int firsts[lanes], ends[lanes];
    store(firsts, first, lanes);
    store(ends, end, lanes);
    for (int lane = 0; lane < lanes; ++lane)
        visit(lane, firsts[lane], ends[lane]);
}

// ---------------------------------------------------------------- projection

// N Gaussians that each camera sees.
struct Gaussians {
    const float* means;
    Shapes shapes;
    const float *opacities, *sh;
    int count, sh_count;
    bool own, own_sh;  // whether each camera has means and shapes of its own, one after the other, and sh
};

struct Cameras {
    const float *viewmats, *Ks;
    int width, height;
    float near, eps2d;
};

struct Projected {
    float* splats;
    int *radii, *depth_keys, *order, *counts;
};

// Project as many Gaussians as there are lanes; the items are all Gaussians of the first camera, then of the second one.
template <class F>
ENDO_SIM_INLINE void project(int item, const Gaussians& gaussians, const Cameras& cameras, const Grid& grid, const Projected& out)
{
    ENDO_SIM_FUSE(on)
    constexpr int lanes = Lanes<F>::count;
    typedef integers_of<F> I;
    const int items = (gaussians.count + lanes - 1) / lanes, camera = item / items, n = (item - camera * items) * lanes;
    const Block<F> block(gaussians.count - n);
    const size_t splat = (size_t)camera * gaussians.count + n, own = gaussians.own ? splat : n;
    const I none{};
    store(out.radii + splat, none, block.count);
    store(out.depth_keys + splat, none, block.count);
    store(out.order + splat, whole(ramp<F>()) + (int)splat, block.count);
    store(out.counts + splat, none, block.count);

    const float *view = cameras.viewmats + 16 * camera, *K = cameras.Ks + 9 * camera;
    F mean[3], p[3];
    block.template read<3>(gaussians.means + 3 * own, 3, mean);
    for (int k = 0; k < 3; ++k)
        p[k] = view[4 * k] * mean[0] + view[4 * k + 1] * mean[1] + view[4 * k + 2] * mean[2] + view[4 * k + 3];
    const F opacity = load<F>(gaussians.opacities + n, block.count);
    // Written so that NaN fails these tests too.
    auto drawn = (p[2] >= cameras.near) & (opacity >= ALPHA_MIN);
    if (!any(drawn))
        return;
    F slopes[2], jacobian[6], to_image[6];
    clamped_slopes(p, K, cameras.width, cameras.height, slopes);
    projection_jacobian(slopes, p[2], K, jacobian);
    for (int k = 0; k < 3; ++k) {
        to_image[k] = jacobian[0] * view[k] + jacobian[2] * view[8 + k];
        to_image[3 + k] = jacobian[4] * view[4 + k] + jacobian[5] * view[8 + k];
    }
    const Footprint<F> cov = footprint(gaussians.shapes, own, block, to_image, cameras.eps2d);
    drawn = drawn & (cov.det > 0.0f) & (cov.xx > 0.0f);
    if (!any(drawn))
        return;
    const F x = K[0] * p[0] / p[2] + K[2], y = K[4] * p[1] / p[2] + K[5];
    const F a = cov.yy / cov.det, b = -cov.xy / cov.det, c = cov.xx / cov.det;
    const F level = 2.0f * (logarithm(255.0f * opacity) + LOG_ALPHA_SLACK), deviation = root(cov.det);
    const Ellipse<F> ellipse{
        x, y, root(level * cov.xx), root(level * cov.yy), deviation / cov.yy, -cov.xy / cov.yy, -cov.xy / cov.xx};
    const F aspect_y = deviation / cov.xx;

    F direction[3]{}, basis[16];
    if (gaussians.sh_count > 1) {
        for (int k = 0; k < 3; ++k)
            direction[k] = mean[k] + (view[k] * view[3] + view[4 + k] * view[7] + view[8 + k] * view[11]);
        const F distance = root(dot(direction, direction));
        for (int k = 0; k < 3; ++k)
            direction[k] = direction[k] / (distance > 0.0f ? distance : everywhere<F>(1.0f));
    }
    sh_basis(gaussians.sh_count, direction, basis);
    const float* sh = gaussians.sh + (size_t)3 * gaussians.sh_count * (gaussians.own_sh ? own : n);
    F color[3]{everywhere<F>(0.5f), everywhere<F>(0.5f), everywhere<F>(0.5f)}, own_sh[3];
    for (int j = 0; j < gaussians.sh_count; ++j) {
        block.template read<3>(sh + 3 * j, 3 * gaussians.sh_count, own_sh);
        for (int k = 0; k < 3; ++k)
            color[k] += basis[j] * own_sh[k];
    }
    const float most = 3.402823466e38f;
    const F all = x + y + a + b + c + ellipse.extent_x + ellipse.extent_y + ellipse.aspect_x + aspect_y + opacity;
    drawn = drawn & (absolute(all) <= most) & (absolute(color[0] + color[1] + color[2]) <= most);
    drawn = drawn & (x + ellipse.extent_x >= 0.0f) & (x - ellipse.extent_x <= (float)cameras.width);
    drawn = drawn & (y + ellipse.extent_y >= 0.0f) & (y - ellipse.extent_y <= (float)cameras.height);
    if (!any(drawn))
        return;

    const F fields[SPLAT_SIZE]{x, y, a, b, c, opacity, p[2], larger(color[0], F{}), larger(color[1], F{}), larger(color[2], F{}),
        ellipse.extent_x, ellipse.extent_y, ellipse.aspect_x, aspect_y, ellipse.shear_x, ellipse.shear_y};
    block.write(out.splats + SPLAT_SIZE * splat, fields);
    const F radius = smaller(ceil_of(larger(ellipse.extent_x, ellipse.extent_y)), everywhere<F>(1e6f));
    store(out.radii + splat, drawn ? whole(radius) : none, block.count);
    store(out.depth_keys + splat, drawn ? bits_of(p[2]) : none, block.count);  // bits of positive floats order as the floats do
    I count{};
    visit_rows(grid, none + camera * grid.columns * grid.rows, ellipse, drawn, [&](I first, I end) {
        count += end - first;
        if (grid.seen)
            visit_lanes<F>(first, end, [&](int lane, int tile, int last) {
                for (; tile < last; ++tile)
                    set_lane(count, lane, lane_of(count, lane) - !grid.seen[tile]);
            });
    });
    store(out.counts + splat, count, block.count);
}

// ---------------------------------------------------------------- intersections

// Splats by depth: their number, a running sum of their counts, and counts by number.
struct Depths {
    const int* order;
    const long long* ends;
    const int* counts;
    int count;
};

struct Lists {
    int *tiles, *owners, *firsts;  // tile and splat of each intersection; first intersection of each splat, or null
    int capacity, tile_count;
};

// List the intersections of as many splats as there are lanes; does nothing if there are more than the lists can hold.
template <class F> ENDO_SIM_INLINE void list_intersections(
    int item, const Depths& depths, const float* splats, int gaussian_count, const Grid& grid, const Lists& out)
{
    constexpr int lanes = Lanes<F>::count;
    typedef integers_of<F> I;
    const int rank = item * lanes, last = depths.count - 1;
    const Block<F> block(depths.count - rank);
    if (depths.ends[last] > out.capacity)
        return;
    int owners[lanes], at[lanes], ends[lanes];
    const Splat* rows[lanes];
    for (int lane = 0; lane < lanes; ++lane) {
        const int place = rank + block.item(lane), next = place + lanes;
        prefetch(splats + SPLAT_SIZE * (size_t)depths.order[next < last ? next : last]);
        owners[lane] = depths.order[place];
        rows[lane] = (const Splat*)(splats + SPLAT_SIZE * (size_t)owners[lane]);
        ends[lane] = (int)depths.ends[place];
        at[lane] = ends[lane] - depths.counts[owners[lane]];
        if (out.firsts)
            out.firsts[owners[lane]] = at[lane];
        if (lane >= block.count)
            at[lane] = ends[lane];
    }
    const auto field = [&](auto number) { return each_lane<F>([&](int lane) { return rows[lane]->*number; }); };
    const Ellipse<F> ellipse{field(&Splat::x), field(&Splat::y), field(&Splat::extent_x), field(&Splat::extent_y),
        field(&Splat::aspect_x), field(&Splat::shear_x), field(&Splat::shear_y)};
    const I some = each_lane<I>([&](int lane) { return depths.counts[owners[lane]]; });
    const I picture = each_lane<I>([&](int lane) { return owners[lane] / gaussian_count * (grid.columns * grid.rows); });
    visit_rows(grid, picture, ellipse, some > 0, [&](I first, I end) {
        visit_lanes<F>(first, end, [&](int lane, int tile, int last) {
            int to = at[lane];
            for (; tile < last && to < ends[lane]; ++tile)
                if (!grid.seen || grid.seen[tile]) {
                    out.tiles[to] = tile;
                    out.owners[to++] = owners[lane];
                }
            at[lane] = to;
        });
    });
    // Compilers may round differently in the two kernels: an intersection that was counted but not met here goes to the
    // tile after the last one, which nobody draws.
    for (int lane = 0; lane < lanes; ++lane)
        for (int to = at[lane]; to < ends[lane]; ++to) {
            out.tiles[to] = out.tile_count;
            out.owners[to] = owners[lane];
        }
}

// ---------------------------------------------------------------- kernels

// As above, with one lane, or with all of a CPU.
ENDO_SIM_INLINE void project(
    int item, [[maybe_unused]] int lanes, const Gaussians& gaussians, const Cameras& cameras, const Grid& grid, const Projected& out)
{
#if !defined(__CUDA_ARCH__)
    if (lanes > 1)
        return project<vfloat>(item, gaussians, cameras, grid, out);
#endif
    project<float>(item, gaussians, cameras, grid, out);
}

ENDO_SIM_INLINE void list_intersections(int item, [[maybe_unused]] int lanes, const Depths& depths, const float* splats,
    int gaussian_count, const Grid& grid, const Lists& out)
{
#if !defined(__CUDA_ARCH__)
    if (lanes > 1)
        return list_intersections<vfloat>(item, depths, splats, gaussian_count, grid, out);
#endif
    list_intersections<float>(item, depths, splats, gaussian_count, grid, out);
}

}  // namespace endo_sim
