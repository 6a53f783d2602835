"""CPU compositing, one tile at a time, vectorised over the 16 pixels of a tile row.

Same maths and memory layout as `rasterizer_kernels` (read its header first). The native code below is C++ with the
vector types of Clang, which become whatever the processor has (AVX-512, AVX2, SSE, NEON). The loop
runs over splats outside and tile rows inside; the state of the 256 pixels stays in the first-level cache. A pixel
whose transmittance would drop below 1e-4 is finished, and remembers that in the sign of its stored transmittance.
All threads launch the same kernel and draw tiles from a shared counter until none is left, so that a thread on a busy
core simply draws fewer.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

VECTOR_TYPES = """
    // Fused multiply-adds within a statement only: both passes then round alike and finish pixels at the same splat.
    #pragma clang fp contract(on)
    typedef float vfloat __attribute__((vector_size(64)));  // one tile row
    typedef int vint __attribute__((vector_size(64)));
    struct simd {
        static inline __attribute__((always_inline)) vfloat set(float x) { return vfloat{} + x; }

        static inline __attribute__((always_inline)) vfloat negative(vfloat x)
        {
            return (vfloat)((vint)x | (vint{} + (int)0x80000000));  // sets the sign, whatever it is
        }

        // 2^x for x <= 0, to 2e-7 relative: 2^n times a polynomial for 2^f, |f| <= 1/2 (that of Cephes' exp2f).
        static inline __attribute__((always_inline)) vfloat exp2(vfloat x)
        {
            x = x < -126.0f ? set(-126.0f) : x;
            const float round = 12582912.0f;  // adding 1.5 2^23 leaves no fraction bits, and n in the lowest
            vfloat n = x + round;
            vfloat f = x - (n - round);
            vfloat p = set(1.535336188319500e-4f);
            p = p * f + 1.339887440266574e-3f;
            p = p * f + 9.618437357674640e-3f;
            p = p * f + 5.550332471162809e-2f;
            p = p * f + 2.402264791363012e-1f;
            p = p * f + 6.931472028550421e-1f;
            p = p * f + 1.0f;
            return (vfloat)((vint)p + ((vint)n << 23));
        }

        // opacity * exp(-sigma) at offsets from a splat's mean; sigma as in splat_exponential of the other kernels.
        static inline __attribute__((always_inline)) vfloat alpha(const float* splat, vfloat dx, float dy)
        {
            const float rise = splat[12] * dy;
            const vfloat run = dx + splat[14] * dy;
            return splat[5] * exp2(-0.5f * 1.44269504f * splat[2] * (run * run + rise * rise));
        }

        static inline __attribute__((always_inline)) float sum(vfloat x)
        {
            typedef float half __attribute__((vector_size(32)));
            typedef float quarter __attribute__((vector_size(16)));
            half h = __builtin_shufflevector(x, x, 0, 1, 2, 3, 4, 5, 6, 7)
                + __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15);
            quarter q = __builtin_shufflevector(h, h, 0, 1, 2, 3) + __builtin_shufflevector(h, h, 4, 5, 6, 7);
            return (q[0] + q[2]) + (q[1] + q[3]);
        }

        // Whether all 256 pixels are finished.
        static inline __attribute__((always_inline)) bool finished(const vfloat* transmittance)
        {
            vint live = transmittance[0] > 0.0f;
            for (int row = 1; row < 16; ++row)
                live |= transmittance[row] > 0.0f;
            return __builtin_reduce_or(live) == 0;
        }

        // The rows [first, end) of a tile at (x0, y0) that have pixels in the y-range of ellipse and tile columns: the
        // same as tile_columns of the other kernels, with x and y exchanged.
        static inline __attribute__((always_inline)) void
        rows(const float* splat, float x0, float y0, int& first, int& end)
        {
            const float extent = splat[10], widest = splat[14] * splat[11];
            const float left = x0 + 0.49f - splat[0], right = left + 15.02f;
            const float low_x = left > -extent ? left : -extent, high_x = right < extent ? right : extent;
            const float x_low = widest < low_x ? low_x : widest > high_x ? high_x : widest;
            const float x_high = -widest < low_x ? low_x : -widest > high_x ? high_x : -widest;
            const float aspect = splat[13], square = extent * extent;
            const float under = square - x_low * x_low, over = square - x_high * x_high;
            const float low_y = splat[1] - splat[15] * x_low - aspect * sqrtf(under > 0.0f ? under : 0.0f);
            const float high_y = splat[1] - splat[15] * x_high + aspect * sqrtf(over > 0.0f ? over : 0.0f);
            const float low = ceilf(low_y - y0 - 0.51f), high = floorf(high_y - y0 - 0.49f);
            first = low > 0.0f ? (int)low : 0;
            end = high < 15.0f ? (int)high + 1 : 16;
        }
    };
    const vfloat lanes = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    const float alpha_min = 1.0f / 255.0f, alpha_max = 0.999f, transmittance_min = 1e-4f, median = 0.5f;
"""

TILE_PLACE = """
    const int tiles_x = (width + 15) / 16, tiles_y = (height + 15) / 16;
    const int column0 = tile % tiles_x * 16, row0 = tile / tiles_x % tiles_y * 16;
    const int columns = wp::min(16, width - column0), rows = wp::min(16, height - row0);
    const size_t pixel0 = ((size_t)(tile / (tiles_x * tiles_y)) * height + row0) * width + column0;
    const int start = starts.data[tile], end = starts.data[tile + 1];
    const auto splat_at = [&](int slot) { return splats.data + 16 * (size_t)owners.data[slots.data[slot]]; };
    const float reference = start < end ? splat_at(start)[6] : 0.0f;
    const vfloat px = lanes + (column0 + 0.5f);
"""


@wp.func_native("return __atomic_fetch_add(counter.data, 1, __ATOMIC_RELAXED);")
def draw(counter: wp.array[int]) -> int:
    """The next number of a counter shared by all threads."""
    ...


@wp.func_native(
    VECTOR_TYPES
    + TILE_PLACE
    + """
    vfloat transmittance[16], depth[16], distortion[16], red[16], green[16], blue[16];
    vint owner[16];  // splat at the median depth
    for (int row = 0; row < 16; ++row) {
        // Pixels outside the image count as finished from the start.
        transmittance[row] = lanes < (row < rows ? (float)columns : 0.0f) ? simd::set(1.0f) : simd::set(-1.0f);
        depth[row] = distortion[row] = red[row] = green[row] = blue[row] = vfloat{};
        owner[row] = vint{} - 1;
    }
    int next_first, next_last;  // rows of the next splat, known before the processor asks for them
    if (start < end)
        simd::rows(splat_at(start), column0, row0, next_first, next_last);
    for (int slot = start; slot < end; ++slot) {
        if ((slot - start) % 8 == 7 && simd::finished(transmittance))
            break;
        if (slot + 8 < end)
            __builtin_prefetch(splat_at(slot + 8));
        const float* splat = splat_at(slot);
        const float z = splat[6] - reference;
        const vfloat dx = px - splat[0];
        const int first = next_first, last = next_last;
        if (slot + 1 < end)
            simd::rows(splat_at(slot + 1), column0, row0, next_first, next_last);
        for (int row = first; row < last; ++row) {
            const float dy = (row0 + row + 0.5f) - splat[1];
            vfloat alpha = simd::alpha(splat, dx, dy);
            alpha = alpha < alpha_max ? alpha : simd::set(alpha_max);
            alpha = alpha < alpha_min ? vfloat{} : alpha;
            const vfloat before = transmittance[row];
            const vfloat after = before - before * alpha;
            const vint stop = after < transmittance_min;  // always true of a finished pixel
            const vfloat weight = stop ? vfloat{} : before * alpha;
            transmittance[row] = stop ? simd::negative(before) : after;
            distortion[row] += 2.0f * weight * (z * (1.0f - before) - depth[row]);
            depth[row] += weight * z;
            red[row] += weight * splat[7];
            green[row] += weight * splat[8];
            blue[row] += weight * splat[9];
            if (wants_owners) {
                // A pixel whose transmittance is above a half is not finished by one splat, as alpha_max is below 1.
                const vint crosses = (before > median) & (after <= median);
                owner[row] = crosses ? vint{} + owners.data[slots.data[slot]] : owner[row];
            }
        }
    }
    for (int row = 0; row < rows; ++row) {
        for (int column = 0; column < columns; ++column) {
            const size_t pixel = pixel0 + (size_t)row * width + column;
            const float seen_through = fabsf(transmittance[row][column]);
            colors.data[3 * pixel] = red[row][column] + seen_through * background.data[0];
            colors.data[3 * pixel + 1] = green[row][column] + seen_through * background.data[1];
            colors.data[3 * pixel + 2] = blue[row][column] + seen_through * background.data[2];
            depths.data[pixel] = depth[row][column] + reference * (1.0f - seen_through);
            alphas.data[pixel] = 1.0f - seen_through;
            distortions.data[pixel] = distortion[row][column];
            if (wants_owners)
                owners_of_median.data[pixel] = owner[row][column];
        }
    }
"""
)
def composite_tile(
    tile: int,
    splats: wp.array[float],
    owners: wp.array[int],
    slots: wp.array[int],
    starts: wp.array[int],
    background: wp.array[float],
    width: int,
    height: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    wants_owners: int,
    owners_of_median: wp.array[int],
): ...


@wp.func_native(
    VECTOR_TYPES
    + TILE_PLACE
    + """
    // Gradients of the pixels' outputs, their totals, and what is left of S = sum of w_i g_i.
    vfloat v_red[16], v_green[16], v_blue[16], v_depth[16], v_alpha[16], v_distortion[16];
    vfloat total_weight[16], total_depth[16], remaining[16], transmittance[16], depth[16];
    for (int row = 0; row < 16; ++row) {
        v_red[row] = v_green[row] = v_blue[row] = v_depth[row] = v_alpha[row] = v_distortion[row] = vfloat{};
        total_weight[row] = total_depth[row] = remaining[row] = depth[row] = vfloat{};
        transmittance[row] = simd::set(-1.0f);
        for (int column = 0; row < rows && column < columns; ++column) {
            const size_t pixel = pixel0 + (size_t)row * width + column;
            const float* v_color = v_colors.data + 3 * pixel;
            const float* color = colors.data + 3 * pixel;
            const float weight = alphas.data[pixel], seen_through = 1.0f - weight;
            const float relative_depth = depths.data[pixel] - reference * weight;
            const float vd = v_depths.data[pixel], vl = 2.0f * v_distortions.data[pixel];
            float va = v_alphas.data[pixel] + vd * reference, rest = vd * relative_depth + vl * distortions.data[pixel];
            for (int k = 0; k < 3; ++k) {
                va -= v_color[k] * background.data[k];
                rest += v_color[k] * (color[k] - seen_through * background.data[k]);
            }
            v_red[row][column] = v_color[0];
            v_green[row][column] = v_color[1];
            v_blue[row][column] = v_color[2];
            v_depth[row][column] = vd;
            v_alpha[row][column] = va;
            v_distortion[row][column] = vl;  // twice the gradient, as it is used
            total_weight[row][column] = weight;
            total_depth[row][column] = relative_depth;
            remaining[row][column] = rest + va * weight;
            transmittance[row][column] = 1.0f;
        }
    }
    int next_first, next_last;
    if (start < end)
        simd::rows(splat_at(start), column0, row0, next_first, next_last);
    int slot = start;
    for (; slot < end; ++slot) {
        if ((slot - start) % 8 == 7 && simd::finished(transmittance))
            break;
        const int intersection = slots.data[slot];
        if (slot + 8 < end) {
            __builtin_prefetch(splat_at(slot + 8));
            __builtin_prefetch(records.data + 12 * (size_t)slots.data[slot + 8], 1);
        }
        const float* splat = splat_at(slot);
        const float z = splat[6] - reference;
        const vfloat dx = px - splat[0];
        // Sums over the rows of the gradients; s0, s1, s2 are the moments of v_sigma in dy.
        vfloat s0{}, s1{}, s2{}, sum_red{}, sum_green{}, sum_blue{}, sum_z{}, absolute_x{}, absolute_y{};
        const int first = next_first, last = next_last;
        if (slot + 1 < end)
            simd::rows(splat_at(slot + 1), column0, row0, next_first, next_last);
        for (int row = first; row < last; ++row) {
            const float dy = (row0 + row + 0.5f) - splat[1];
            vfloat alpha = simd::alpha(splat, dx, dy);
            const vint clamped = alpha > alpha_max;
            alpha = alpha < alpha_max ? alpha : simd::set(alpha_max);
            alpha = alpha < alpha_min ? vfloat{} : alpha;
            const vfloat before = transmittance[row];
            const vfloat after = before - before * alpha;
            const vint stop = after < transmittance_min;
            const vfloat weight = stop ? vfloat{} : before * alpha;
            transmittance[row] = stop ? simd::negative(before) : after;

            const vfloat spread = 2.0f - before - after - total_weight[row];
            const vfloat twice_distortion = v_distortion[row];
            const vfloat new_depth = depth[row] + weight * z;
            const vfloat v_weight = v_red[row] * splat[7] + v_green[row] * splat[8] + v_blue[row] * splat[9]
                + v_depth[row] * z + v_alpha[row]
                + twice_distortion * (z * spread + total_depth[row] - depth[row] - new_depth);
            depth[row] = new_depth;
            const vfloat rest = remaining[row] - weight * v_weight;
            remaining[row] = rest;
            // alpha * v_alpha_i is zero where alpha is.
            const vfloat v_sigma = stop | clamped ? vfloat{} : alpha * (rest / (1.0f - alpha) - before * v_weight);
            s0 += v_sigma;
            s1 += v_sigma * dy;
            s2 += v_sigma * (dy * dy);
            sum_red += weight * v_red[row];
            sum_green += weight * v_green[row];
            sum_blue += weight * v_blue[row];
            sum_z += weight * (v_depth[row] + twice_distortion * spread);
            if (wants_absolute) {
                absolute_x += __builtin_elementwise_abs(v_sigma * (splat[2] * dx + splat[3] * dy));
                absolute_y += __builtin_elementwise_abs(v_sigma * (splat[3] * dx + splat[4] * dy));
            }
        }
        // Here d = pixel - mean, so the gradient of the mean has the opposite sign.
        float* record = records.data + 12 * (size_t)intersection;
        const float sum_x = simd::sum(s0 * dx), sum_y = simd::sum(s1);
        record[0] = -(splat[2] * sum_x + splat[3] * sum_y);
        record[1] = -(splat[3] * sum_x + splat[4] * sum_y);
        record[2] = 0.5f * simd::sum(s0 * dx * dx);
        record[3] = simd::sum(s1 * dx);
        record[4] = 0.5f * simd::sum(s2);
        record[5] = -simd::sum(s0) / splat[5];
        record[6] = simd::sum(sum_z);
        record[7] = simd::sum(sum_red);
        record[8] = simd::sum(sum_green);
        record[9] = simd::sum(sum_blue);
        if (wants_absolute) {
            record[10] = simd::sum(absolute_x);
            record[11] = simd::sum(absolute_y);
        }
    }
    for (; slot < end; ++slot)
        for (int k = 0; k < 12; ++k)
            records.data[12 * (size_t)slots.data[slot] + k] = 0.0f;
"""
)
def composite_tile_backward(
    tile: int,
    splats: wp.array[float],
    owners: wp.array[int],
    slots: wp.array[int],
    starts: wp.array[int],
    background: wp.array[float],
    width: int,
    height: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    v_colors: wp.array[float],
    v_depths: wp.array[float],
    v_alphas: wp.array[float],
    v_distortions: wp.array[float],
    wants_absolute: int,
    records: wp.array[float],
): ...


@wp.kernel
def find_tile_starts(offset: int, tiles: wp.array[int], count: int, starts: wp.array[int]):
    """starts[t] = first slot whose tile is t or later; launched over count + 1 slots of the sorted tiles."""
    slot = offset + wp.tid()
    low, high = int(0), starts.shape[0]
    if slot > 0:
        low = tiles[slot - 1] + 1
    if slot < count:
        high = tiles[slot] + 1
    for tile in range(low, wp.min(high, starts.shape[0])):
        starts[tile] = slot


@wp.kernel
def render_tiles(
    counter: wp.array[int],
    splats: wp.array[float],
    owners: wp.array[int],
    slots: wp.array[int],
    starts: wp.array[int],
    background: wp.array[float],
    width: int,
    height: int,
    colors: wp.array[float],  # out, as all below
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    wants_owners: int,
    owners_of_median: wp.array[int],
):
    tile = draw(counter)
    if tile < starts.shape[0] - 1:
        composite_tile(
            tile, splats, owners, slots, starts, background, width, height, colors, depths, alphas, distortions,
            wants_owners, owners_of_median,
        )  # fmt: skip


@wp.kernel
def render_tiles_backward(
    counter: wp.array[int],
    splats: wp.array[float],
    owners: wp.array[int],
    slots: wp.array[int],
    starts: wp.array[int],
    background: wp.array[float],
    width: int,
    height: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    v_colors: wp.array[float],
    v_depths: wp.array[float],
    v_alphas: wp.array[float],
    v_distortions: wp.array[float],
    wants_absolute: int,
    records: wp.array[float],  # out
):
    tile = draw(counter)
    if tile < starts.shape[0] - 1:
        composite_tile_backward(
            tile, splats, owners, slots, starts, background, width, height, colors, depths, alphas, distortions,
            v_colors, v_depths, v_alphas, v_distortions, wants_absolute, records,
        )  # fmt: skip
