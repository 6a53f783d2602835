// Compositing on a CPU, one tile at a time, 16 pixels of a row at once. The loop runs over splats outside and tile rows
// inside; the state of the 256 pixels stays in the first-level cache.
#pragma once
#include "splatting/native/blending.h"

#if !defined(__CUDA_ARCH__)

namespace endo_sim {

struct Extras {
    float values[EXTRAS];
};

// Splats of each tile, front to back: those of the intersections slots[starts[t]] to slots[starts[t + 1] - 1].
struct TileLists {
    const float *splats, *extras;  // rows of EXTRAS, or null
    const int *owners, *slots, *starts;

    ENDO_SIM_INLINE int owner(int slot) const { return owners[slots[slot]]; }
    ENDO_SIM_INLINE const Splat& splat(int slot) const { return *(const Splat*)(splats + SPLAT_SIZE * (size_t)owner(slot)); }
    ENDO_SIM_INLINE const float* extras_at(int slot) const { return extras + EXTRAS * (size_t)owner(slot); }

    ENDO_SIM_INLINE Extras extras_of(int slot) const
    {
        Extras own{};
        if (extras)
            __builtin_memcpy(&own, extras_at(slot), sizeof(own));
        return own;
    }
};

// Whether all 256 pixels are finished.
template <class P> ENDO_SIM_INLINE bool finished(const P* rows)
{
    vint live = rows[0].transmittance > 0.0f;
    for (int row = 1; row < TILE; ++row)
        live |= rows[row].transmittance > 0.0f;
    return !any(live);
}

struct Rows {
    int first, end;
};

// Rows of a tile that have pixels in the y-range of ellipse and tile columns: `visit_rows` with x and y exchanged.
ENDO_SIM_INLINE Rows rows_met(const Splat& splat, float x0, float y0)
{
    ENDO_SIM_FUSE(on)
    const float left = x0 + 0.49f - splat.x, right = left + 15.02f, extent = splat.extent_x;
    const float low = left > -extent ? left : -extent, high = right < extent ? right : extent;
    const Span<float> span = ellipse_span(splat.y, low, high, -splat.shear_x * splat.extent_y, splat.shear_y, splat.aspect_y, extent);
    const float first = ceilf(span.low - y0 - 0.51f), last = floorf(span.high - y0 - 0.49f);
    return {first > 0.0f ? (int)first : 0, last < 15.0f ? (int)last + 1 : TILE};
}

// Call visit(slot, splat, rows) for the splats of a tile until all pixels are finished; returns the first slot that is not
// visited. What a splat needs of memory, and its rows, are asked for before its turn.
template <class P, class Visit> ENDO_SIM_INLINE int visit_splats(
    const TileLists& lists, int tile, const Place& place, const P* pixels, const float* records, Visit visit)
{
    const int start = lists.starts[tile], end = lists.starts[tile + 1];
    Rows next{};
    if (start < end)
        next = rows_met(lists.splat(start), place.column0, place.row0);
    int slot = start;
    for (; slot < end; ++slot) {
        if ((slot - start) % 8 == 7 && finished(pixels))
            break;
        if (slot + 8 < end) {
            prefetch(&lists.splat(slot + 8));
            if (lists.extras)
                prefetch(lists.extras_at(slot + 8));
            if (records)
                __builtin_prefetch(records + RECORD_SIZE * (size_t)lists.slots[slot + 8], 1);
        }
        const Rows rows = next;
        if (slot + 1 < end)
            next = rows_met(lists.splat(slot + 1), place.column0, place.row0);
        visit(slot, lists.splat(slot), rows);
    }
    return slot;
}

// List intersections by tile, by depth within each: `slots`, and in `starts` the first of each tile and of the one after the last.
ENDO_SIM_INLINE void sort_by_tile(const int* tiles, int count, int tile_count, int* slots, int* starts)
{
    for (int tile = 0; tile <= tile_count; ++tile)
        starts[tile] = 0;
    for (int i = 0; i < count; ++i)
        ++starts[tiles[i]];
    for (int tile = 1; tile <= tile_count; ++tile)
        starts[tile] += starts[tile - 1];
    for (int i = count - 1; i >= 0; --i)
        slots[--starts[tiles[i]]] = i;
}

// The next number of a counter that all threads share.
ENDO_SIM_INLINE int draw_number(int* counter) { return __atomic_fetch_add(counter, 1, __ATOMIC_RELAXED); }

// A row of a tile: the extras lie beside the rest, so that a splat finds them there.
template <bool with_extras> struct DrawnRow : Pixel<vfloat> { };
template <> struct DrawnRow<true> : Pixel<vfloat> {
    vfloat extras[EXTRAS];
};

constexpr vfloat LANES = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

template <bool with_extras> ENDO_SIM_INLINE void draw_tile(
    int tile, const TileLists& lists, const float* background, const GlintLenses& lenses,
    int width, int height, const Images& images, int* owners_of_median)
{
    ENDO_SIM_FUSE(on)
    const Place place(tile, width, height);
    const int columns = width - place.column0 < TILE ? width - place.column0 : TILE;
    const int rows = height - place.row0 < TILE ? height - place.row0 : TILE;
    const vfloat px = LANES + (place.column0 + 0.5f);
    const int start = lists.starts[tile];
    const float reference = start < lists.starts[tile + 1] ? lists.splat(start).z : 0.0f;

    DrawnRow<with_extras> pixels[TILE];
    vint owner[TILE];  // splat at the median depth
    for (int row = 0; row < TILE; ++row) {
        // Pixels outside the image count as finished from the start.
        pixels[row] = DrawnRow<with_extras>{};
        pixels[row].transmittance = LANES < (row < rows ? (float)columns : 0.0f) ? broadcast(1.0f) : broadcast(-1.0f);
        owner[row] = vint{} - 1;
    }
    visit_splats(lists, tile, place, pixels, nullptr, [&](int slot, const Splat& splat, Rows met) {
        ENDO_SIM_FUSE(on)
        const float z = splat.z - reference;
        const vfloat dx = px - splat.x;
        const Extras own = lists.extras_of(slot);
        for (int row = met.first; row < met.end; ++row) {
            const float dy = (place.row0 + row + 0.5f) - splat.y;
            vfloat alpha = limited(splat.opacity * falloff(dx, dy, splat.a, splat.shear_x, splat.aspect_x));
            alpha = alpha < ALPHA_MIN ? vfloat{} : alpha;
            const Layer<vfloat> layer = pixels[row].add(alpha, z, splat.red, splat.green, splat.blue);
            if constexpr (with_extras)
                add_extras(pixels[row].extras, layer.weight, own.values);
            if (owners_of_median)
                owner[row] = crosses_median(layer) ? vint{} + lists.owner(slot) : owner[row];
        }
    });
    for (int row = 0; row < rows; ++row) {
        const DrawnRow<with_extras>& p = pixels[row];
        const size_t index = place.pixel0 + (size_t)row * width;
        Shown<vfloat> seen = shown<vfloat>(p, background, reference);
        if constexpr (with_extras) {
            if (lenses.sharpness >= 0.0f)
                add_glint(seen, lenses, place.camera, px, place.row0 + row + 0.5f, p.extras);
            for (int k = 0; images.extras && k < EXTRAS; ++k)
                copy_items(images.extras + place.plane(k) + index, &p.extras[k], sizeof(float), columns);
        }
        vfloat rgb[3];
        interleave(seen.red, seen.green, seen.blue, rgb);
        copy_items(images.colors + 3 * index, rgb, 3 * sizeof(float), columns);
        copy_items(images.depths + index, &seen.depth, sizeof(float), columns);
        copy_items(images.alphas + index, &seen.alpha, sizeof(float), columns);
        copy_items(images.distortions + index, &p.distortion, sizeof(float), columns);
        if (owners_of_median)
            copy_items(owners_of_median + index, &owner[row], sizeof(int), columns);
    }
}

// Draw a tile; owners of the median depth are written unless null.
ENDO_SIM_INLINE void composite_tile(
    int tile, const TileLists& lists, const float* background, const GlintLenses& lenses,
    int width, int height, const Images& images, int* owners_of_median)
{
    if (lists.extras)
        draw_tile<true>(tile, lists, background, lenses, width, height, images, owners_of_median);
    else
        draw_tile<false>(tile, lists, background, lenses, width, height, images, owners_of_median);
}

// Write the gradient records of a tile's intersections.
ENDO_SIM_INLINE void composite_tile_backward(int tile, const TileLists& lists, const float* background, int width, int height,
    const ConstImages& images, const ConstImages& v_images, bool wants_absolute, float* records)
{
    ENDO_SIM_FUSE(on)
    const Place place(tile, width, height);
    const int columns = width - place.column0 < TILE ? width - place.column0 : TILE;
    const int rows = height - place.row0 < TILE ? height - place.row0 : TILE;
    const vfloat px = LANES + (place.column0 + 0.5f);
    const int start = lists.starts[tile], end = lists.starts[tile + 1];
    const float reference = start < end ? lists.splat(start).z : 0.0f;

    PixelGradient<vfloat> pixels[TILE];
    vfloat v_extras[TILE][EXTRAS];
    for (int row = 0; row < TILE; ++row) {
        PixelGradient<vfloat>& p = pixels[row];
        p = PixelGradient<vfloat>{};
        p.transmittance = broadcast(-1.0f);
        for (int k = 0; k < EXTRAS; ++k) {
            v_extras[row][k] = vfloat{};
            if (lists.extras && row < rows)
                copy_items(
                    &v_extras[row][k], v_images.extras + place.plane(k) + place.pixel0 + (size_t)row * width, sizeof(float), columns);
        }
        for (int column = 0; row < rows && column < columns; ++column) {
            const PixelGradient<float> pixel =
                begin(place.pixel0 + (size_t)row * width + column, place, background, reference, images, v_images);
            p.v_red[column] = pixel.v_red;
            p.v_green[column] = pixel.v_green;
            p.v_blue[column] = pixel.v_blue;
            p.v_depth[column] = pixel.v_depth;
            p.v_alpha[column] = pixel.v_alpha;
            p.twice_v_distortion[column] = pixel.twice_v_distortion;
            p.total_weight[column] = pixel.total_weight;
            p.total_depth[column] = pixel.total_depth;
            p.remaining[column] = pixel.remaining;
            p.transmittance[column] = pixel.transmittance;
        }
    }
    int slot = visit_splats(lists, tile, place, pixels, records, [&](int slot, const Splat& splat, Rows met) {
        ENDO_SIM_FUSE(on)
        const float z = splat.z - reference;
        const vfloat dx = px - splat.x;
        // Sums over the rows of the gradients; s0, s1, s2 are the moments of v_sigma in dy.
        const Extras own = lists.extras_of(slot);
        vfloat s0{}, s1{}, s2{}, sum_red{}, sum_green{}, sum_blue{}, sum_z{}, absolute_x{}, absolute_y{}, sum_extras[EXTRAS]{};
        for (int row = met.first; row < met.end; ++row) {
            PixelGradient<vfloat>& p = pixels[row];
            const float dy = (place.row0 + row + 0.5f) - splat.y;
            vfloat alpha = splat.opacity * falloff(dx, dy, splat.a, splat.shear_x, splat.aspect_x);
            const vint above = alpha > ALPHA_MAX;
            alpha = limited(alpha);
            alpha = alpha < ALPHA_MIN ? vfloat{} : alpha;
            const vfloat v_extra = lists.extras ? gradient_of_extras(v_extras[row], own.values) : vfloat{};
            const auto share = p.add(alpha, z, splat.red, splat.green, splat.blue, v_extra);
            const vfloat v_sigma = share.ends | above ? vfloat{} : alpha * share.minus_v_alpha;
            s0 += v_sigma;
            s1 += v_sigma * dy;
            s2 += v_sigma * (dy * dy);
            sum_red += share.weight * p.v_red;
            sum_green += share.weight * p.v_green;
            sum_blue += share.weight * p.v_blue;
            sum_z += share.weight * share.v_z_by_weight;
            if (lists.extras)
                for (int k = 0; k < EXTRAS; ++k)
                    sum_extras[k] += share.weight * v_extras[row][k];
            if (wants_absolute) {
                absolute_x += absolute(v_sigma * (splat.a * dx + splat.b * dy));
                absolute_y += absolute(v_sigma * (splat.b * dx + splat.c * dy));
            }
        }
        // Here d = pixel - mean, so the gradient of the mean has the opposite sign.
        Record& record = *(Record*)(records + RECORD_SIZE * (size_t)lists.slots[slot]);
        const float sum_x = sum(s0 * dx), sum_y = sum(s1);
        record.x = -(splat.a * sum_x + splat.b * sum_y);
        record.y = -(splat.b * sum_x + splat.c * sum_y);
        record.a = 0.5f * sum(s0 * dx * dx);
        record.b = sum(s1 * dx);
        record.c = 0.5f * sum(s2);
        record.opacity = -sum(s0) / splat.opacity;
        record.z = sum(sum_z);
        record.red = sum(sum_red);
        record.green = sum(sum_green);
        record.blue = sum(sum_blue);
        if (wants_absolute) {
            record.absolute_x = sum(absolute_x);
            record.absolute_y = sum(absolute_y);
        }
        for (int k = 0; lists.extras && k < EXTRAS; ++k)
            record.extras[k] = sum(sum_extras[k]);
    });
    for (; slot < end; ++slot)
        for (int k = 0; k < RECORD_SIZE; ++k)
            records[RECORD_SIZE * (size_t)lists.slots[slot] + k] = 0.0f;
}

}  // namespace endo_sim

#endif
