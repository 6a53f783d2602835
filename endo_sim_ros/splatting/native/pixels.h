// Compositing with one thread per pixel and one block of threads per tile: for GPUs, and plainly on a CPU.
//
// The threads of a block read the tile's splats together, 256 at a time, into shared memory, and find out which of its
// eight 8x4 blocks of pixels each one meets. A warp has one of these blocks, and looks at the splats that meet it. On a
// CPU, where a block has one thread, each reads what it needs, and the functions that concern other threads do nothing.
#pragma once
#include "splatting/native/blending.h"

namespace endo_sim {

constexpr int BATCH = TILE * TILE;  // threads of a block, pixels of a tile, and splats that are read at a time

// Splats of tile t, front to back: those at ranges[2 t] to ranges[2 t + 1] - 1 of the list, if they are of its camera and
// in the image: the list of all splats, which stands in where the lists of tiles would be too long, has others, too.
struct SplatLists {
    const float *splats, *extras;  // rows of EXTRAS, or null
    const int *counts, *list, *ranges;
    int gaussian_count;

    ENDO_SIM_INLINE const float* extras_of(int index) const { return extras + EXTRAS * (size_t)index; }
    ENDO_SIM_INLINE const Splat& splat(int index) const { return *(const Splat*)(splats + SPLAT_SIZE * (size_t)index); }
    ENDO_SIM_INLINE bool has(int index, int camera) const { return counts[index] > 0 && index / gaussian_count == camera; }
};

// What a pixel needs of a splat, as it lies in shared memory.
struct StagedSplat {
    float x, y, a, shear, aspect, opacity, z;
    int index;
    float red, green, blue, unused;
};

// ---------------------------------------------------------------- threads together

#if defined(__CUDA_ARCH__)

// Whether the condition holds in any thread of the warp, which must be here together.
ENDO_SIM_INLINE bool warp_any(bool condition) { return __any_sync(0xffffffffu, condition); }

// Whether the condition holds in any thread of the block, which waits here for all its threads.
ENDO_SIM_INLINE bool block_any(bool condition) { return __syncthreads_or(condition); }

// Which 8x4 blocks of a tile with its corner at (x0, y0) an ellipse meets, as bits, row by row: as `visit_rows` does it.
ENDO_SIM_INLINE int blocks_met(const Splat splat, float x0, float y0)
{
    const float x = splat.x - x0, y = splat.y - y0, extent = splat.extent_y;
    int met = 0;
    for (int row = 0; row < 4; ++row) {
        const float low = fmaxf(4 * row + 0.5f - y - PIXEL_SLACK, -extent);
        const float high = fminf(4 * row + 3.5f - y + PIXEL_SLACK, extent);
        if (low <= high) {
            const Span<float> span = ellipse_span(x, low, high, -splat.shear_y * splat.extent_x, splat.shear_x, splat.aspect_x, extent);
            for (int column = 0; column < 2; ++column)
                if (span.low - PIXEL_SLACK <= 8 * column + 7.5f && span.high + PIXEL_SLACK >= 8 * column + 0.5f)
                    met |= 1 << (2 * row + column);
        }
    }
    return met;
}

// Bring the next 256 splats of a list, and the blocks that each meets, into shared memory, and wait for the other threads.
// Returns the place of the first splat; the blocks lie behind the splats.
ENDO_SIM_INLINE int stage(const SplatLists& lists, int first, int end, const Place& place)
{
    __shared__ float4 rows[3 * BATCH + BATCH / 4];
    const int i = threadIdx.x;
    int splat = 0, met = 0;
    if (first + i < end) {
        splat = lists.list[first + i];
        if (lists.has(splat, place.camera))
            met = blocks_met(lists.splat(splat), place.column0, place.row0);
    }
    reinterpret_cast<int*>(rows + 3 * BATCH)[i] = met;
    if (met) {
        const float4* splat_row = reinterpret_cast<const float4*>(lists.splats) + 4 * (size_t)splat;
        const float4 a = __ldg(splat_row), b = __ldg(splat_row + 1), c = __ldg(splat_row + 2), d = __ldg(splat_row + 3);
        rows[3 * i] = make_float4(a.x, a.y, a.z, d.z);
        rows[3 * i + 1] = make_float4(d.x, b.y, b.z, __int_as_float(splat));
        rows[3 * i + 2] = make_float4(b.w, c.x, c.y, 0.0f);
    }
    __syncthreads();
    return (int)__cvta_generic_to_shared(rows);
}

// Which of 32 splats of a batch this thread and those of its warp have to look at, as bits.
ENDO_SIM_INLINE unsigned splats_to_draw(const SplatLists&, int batch, int word, int, int, int)
{
    int blocks;
    const int place = batch + BATCH * (int)sizeof(StagedSplat) + 4 * (32 * word + (int)(threadIdx.x & 31));
    asm volatile("ld.shared.s32 %0, [%1];" : "=r"(blocks) : "r"(place));
    return __ballot_sync(0xffffffffu, blocks >> (threadIdx.x / 32) & 1);
}

ENDO_SIM_INLINE int lowest_bit(unsigned bits) { return __ffs(bits) - 1; }

ENDO_SIM_INLINE StagedSplat staged_splat(const SplatLists&, int batch, int, int i)
{
    StagedSplat s;
    const int place = batch + (int)sizeof(StagedSplat) * i;
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];" : "=f"(s.x), "=f"(s.y), "=f"(s.a), "=f"(s.shear) : "r"(place));
    float index;
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
        : "=f"(s.aspect), "=f"(s.opacity), "=f"(s.z), "=f"(index)
        : "r"(place + 16));
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
        : "=f"(s.red), "=f"(s.green), "=f"(s.blue), "=f"(s.unused)
        : "r"(place + 32));
    s.index = __float_as_int(index);
    return s;
}

// Add the first count numbers of the shares of all threads of the warp, which must be here together, to a record.
template <bool with_extras> ENDO_SIM_INLINE void add_record(const Record& share, float* record, int count)
{
    const float* values = (const float*)&share;
    // At each step a thread keeps half of its sums and gives the other half to a partner, until it has a single one.
    const int lane = threadIdx.x & 31;
    const auto halve = [&](float a, float b, int step) {
        const bool upper = lane & step;
        return (upper ? b : a) + __shfl_xor_sync(0xffffffffu, upper ? a : b, step);
    };
    const auto add = [&](float a, int step) { return a + __shfl_xor_sync(0xffffffffu, a, step); };
    const float a0 = halve(values[0], values[8], 16), a1 = halve(values[1], values[9], 16);
    const float a2 = halve(values[2], values[10], 16), a3 = halve(values[3], values[11], 16);
    const auto last = [&](int k) { return with_extras ? halve(values[k], values[k + 8], 16) : add(values[k], 16); };
    const float a4 = last(4), a5 = last(5), a6 = last(6), a7 = last(7);
    const float b0 = halve(a0, a4, 8), b1 = halve(a1, a5, 8), b2 = halve(a2, a6, 8), b3 = halve(a3, a7, 8);
    const float c0 = halve(b0, b2, 4), c1 = halve(b1, b3, 4);
    const float sum = add(halve(c0, c1, 2), 1);
    if ((lane & 1) == 0 && lane / 2 < count)
        atomicAdd(record + lane / 2, sum);
}

#else

ENDO_SIM_INLINE bool warp_any(bool condition) { return condition; }
ENDO_SIM_INLINE bool block_any(bool condition) { return condition; }
ENDO_SIM_INLINE int stage(const SplatLists&, int, int, const Place&) { return 0; }

ENDO_SIM_INLINE unsigned splats_to_draw(const SplatLists& lists, int, int word, int first, int end, int camera)
{
    unsigned bits = 0;
    for (int i = 0; i < 32; ++i) {
        const int slot = first + 32 * word + i;
        if (slot < end && lists.has(lists.list[slot], camera))
            bits |= 1u << i;
    }
    return bits;
}

ENDO_SIM_INLINE int lowest_bit(unsigned bits) { return __builtin_ctz(bits); }

ENDO_SIM_INLINE StagedSplat staged_splat(const SplatLists& lists, int, int first, int i)
{
    const int index = lists.list[first + i];
    const Splat& s = lists.splat(index);
    return {s.x, s.y, s.a, s.shear_x, s.aspect_x, s.opacity, s.z, index, s.red, s.green, s.blue, 0.0f};
}

template <bool with_extras> ENDO_SIM_INLINE void add_record(const Record& share, float* record, int count)
{
    const float* values = (const float*)&share;
    for (int k = 0; k < count; ++k)
        record[k] += values[k];
}

#endif

// ---------------------------------------------------------------- pixels

// The pixel of a thread. A warp covers 8x4 pixels, so that its threads agree more often.
struct ThreadPixel {
    int tile;
    Place place;
    int column, row;
    bool inside;  // the image
    size_t index;

    ENDO_SIM_INLINE ThreadPixel(int thread, int width, int height)
        : tile(thread / BATCH)
        , place(tile, width, height)
    {
        const int lane = thread - tile * BATCH, warp = lane / 32;
        const int x = warp % 2 * 8 + lane % 8, y = warp / 2 * 4 + lane % 32 / 8;
        column = place.column0 + x;
        row = place.row0 + y;
        inside = column < width && row < height;
        index = place.pixel0 + (size_t)y * width + x;
    }
};

// Depth of the first splat of a tile, if it is of the tile's camera.
ENDO_SIM_INLINE float reference_depth(const SplatLists& lists, const ThreadPixel& own)
{
    const int start = lists.ranges[2 * own.tile], end = lists.ranges[2 * own.tile + 1];
    return start < end && lists.has(lists.list[start], own.place.camera) ? lists.splat(lists.list[start]).z : 0.0f;
}

// Call visit(splat) for the splats of a tile that this thread's warp has to look at, until live() is false in all of it.
// All threads of a warp visit the same splats, also those whose pixel is finished.
template <class Live, class Visit>
ENDO_SIM_INLINE void visit_splats(const SplatLists& lists, const ThreadPixel& own, Live live, Visit visit)
{
    const int start = lists.ranges[2 * own.tile], end = lists.ranges[2 * own.tile + 1];
    for (int first = start; first < end; first += BATCH) {
        if (!block_any(live()))
            break;
        const int batch = stage(lists, first, end, own.place);
        const int words = ((end - first < BATCH ? end - first : BATCH) + 31) / 32;
        for (int word = 0; word < words; ++word) {
            if (!warp_any(live()))
                break;
            unsigned bits = splats_to_draw(lists, batch, word, first, end, own.place.camera);
            while (bits != 0) {
                const StagedSplat splat = staged_splat(lists, batch, first, 32 * word + lowest_bit(bits));
                bits &= bits - 1;
                visit(splat);
            }
        }
    }
}

template <bool with_extras>
ENDO_SIM_INLINE void draw_pixel(int thread, const SplatLists& lists, const float* background, const GlintLenses& lenses,
    int width, int height, const Images& images, int* owners_of_median)
{
    const ThreadPixel own(thread, width, height);
    const float px = own.column + 0.5f, py = own.row + 0.5f, reference = reference_depth(lists, own);
    Pixel<float> pixel{own.inside ? 1.0f : -1.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    float extras[EXTRAS]{};
    int owner = -1;
    const auto live = [&] { return pixel.transmittance > 0.0f; };
    visit_splats(lists, own, live, [&](const StagedSplat& s) {
        const float alpha = limited(s.opacity * falloff(s.x - px, s.y - py, s.a, s.shear, s.aspect));
        if (live() && alpha >= ALPHA_MIN) {
            const Layer<float> layer = pixel.add(alpha, s.z - reference, s.red, s.green, s.blue);
            if (with_extras)
                add_extras(extras, layer.weight, lists.extras_of(s.index));
            if (crosses_median(layer))
                owner = s.index;
        }
    });
    if (own.inside) {
        Shown<float> seen = shown(pixel, background, reference);
        if (with_extras && lenses.sharpness >= 0.0f)
            add_glint(seen, lenses, own.place.camera, px, py, extras);
        finish(pixel, seen, own.index, images);
        for (int k = 0; with_extras && images.extras && k < EXTRAS; ++k)
            images.extras[own.place.plane(k) + own.index] = extras[k];
        if (owners_of_median)
            owners_of_median[own.index] = owner;
    }
}

// Draw a pixel; the owner of the median depth is written unless null. Launched over tiles x 256 threads.
ENDO_SIM_INLINE void composite_pixel(int thread, const SplatLists& lists, const float* background, const GlintLenses& lenses,
    int width, int height, const Images& images, int* owners_of_median)
{
    if (lists.extras)
        draw_pixel<true>(thread, lists, background, lenses, width, height, images, owners_of_median);
    else
        draw_pixel<false>(thread, lists, background, lenses, width, height, images, owners_of_median);
}

template <bool with_extras>
ENDO_SIM_INLINE void add_pixel_gradients(int thread, const SplatLists& lists, const float* background, int width, int height,
    const ConstImages& images, const ConstImages& v_images, bool wants_absolute, float* records)
{
    ENDO_SIM_FUSE(on)
    const ThreadPixel own(thread, width, height);
    const float px = own.column + 0.5f, py = own.row + 0.5f, reference = reference_depth(lists, own);
    PixelGradient<float> pixel{};
    pixel.transmittance = -1.0f;
    float v_extras[EXTRAS]{};
    for (int k = 0; with_extras && own.inside && k < EXTRAS; ++k)
        v_extras[k] = v_images.extras[own.place.plane(k) + own.index];
    if (own.inside)
        pixel = begin(own.index, own.place, background, reference, images, v_images);
    const auto live = [&] { return pixel.transmittance > 0.0f; };
    visit_splats(lists, own, live, [&](const StagedSplat& s) {
        ENDO_SIM_FUSE(on)
        const float dx = s.x - px, dy = s.y - py, fall = falloff(dx, dy, s.a, s.shear, s.aspect);
        const float alpha = limited(s.opacity * fall);
        const bool draws = live() && alpha >= ALPHA_MIN;
        if (warp_any(draws)) {
            Record v{};
            if (draws) {
                const float v_extra = with_extras ? gradient_of_extras(v_extras, lists.extras_of(s.index)) : 0.0f;
                const auto share = pixel.add(alpha, s.z - reference, s.red, s.green, s.blue, v_extra);
                for (int k = 0; with_extras && k < EXTRAS; ++k)
                    v.extras[k] = share.weight * v_extras[k];
                v.z = share.weight * share.v_z_by_weight;
                v.red = share.weight * pixel.v_red;
                v.green = share.weight * pixel.v_green;
                v.blue = share.weight * pixel.v_blue;
                if (!(share.ends | (s.opacity * fall > ALPHA_MAX))) {
                    const float run = dx + s.shear * dy, rise = s.aspect * dy;
                    const float v_sigma = alpha * share.minus_v_alpha;
                    v.opacity = -fall * share.minus_v_alpha;
                    // A dx + B dy and B dx + C dy.
                    v.x = v_sigma * s.a * run;
                    v.y = v_sigma * s.a * (s.shear * run + s.aspect * rise);
                    v.a = 0.5f * v_sigma * dx * dx;
                    v.b = v_sigma * dx * dy;
                    v.c = 0.5f * v_sigma * dy * dy;
                    v.absolute_x = fabsf(v.x);
                    v.absolute_y = fabsf(v.y);
                }
            }
            const int count = with_extras ? RECORD_SIZE : RECORD_SIZE - EXTRAS - (wants_absolute ? 0 : 2);
            add_record<with_extras>(v, records + RECORD_SIZE * (size_t)s.index, count);
        }
    });
}

// Add a pixel's share to the records of its splats, which are zero before.
ENDO_SIM_INLINE void composite_pixel_backward(int thread, const SplatLists& lists, const float* background, int width, int height,
    const ConstImages& images, const ConstImages& v_images, bool wants_absolute, float* records)
{
    if (lists.extras)
        add_pixel_gradients<true>(thread, lists, background, width, height, images, v_images, wants_absolute, records);
    else
        add_pixel_gradients<false>(thread, lists, background, width, height, images, v_images, wants_absolute, records);
}

}  // namespace endo_sim
