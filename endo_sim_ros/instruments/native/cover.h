// Which samples of which pixels of a row a triangle covers; drawing_kernels.py has the terms.
#pragma once
#include "core/native/lanes.h"

namespace endo_sim {

constexpr int TILE = 16;  // pixels a side
constexpr int SAMPLES = 4;  // of a pixel, on a rotated grid

struct Offset {
    float u, v;
};

// Where in a pixel a sample lies, from its corner.
ENDO_SIM_INLINE Offset offset(int sample, int row, int column, float spread)
{
    ENDO_SIM_FUSE(off)
    const float turn = 0.375f + 0.5f * sample - 0.25f * (sample / 2), u = turn >= 1.0f ? turn - 1.0f : turn;
    // Every other pixel has the mirror image, as along an edge of slope 1 : 2 two samples are as one.
    return {0.5f + spread * (((row + column) % 2 ? 1.0f - u : u) - 0.5f), 0.5f + spread * (0.125f + 0.25f * sample - 0.5f)};
}

struct Columns {
    float low, high;
};

// What of the middles of pixels from one column to another may see the inner side of the edge from a to b.
ENDO_SIM_INLINE Columns span(const float* a, const float* b, int row, float spread, Columns columns)
{
    ENDO_SIM_FUSE(off)
    const float slope = a[1] - b[1];  // of the weight, by columns
    const float here = a[0] * b[1] - a[1] * b[0] + (b[0] - a[0]) * ((float)row + 0.5f);  // at column 0
    const float at_best = here - 0.5f * spread * (fabsf(b[0] - a[0]) + fabsf(slope)), edge = -at_best / slope;
    if (slope > 0.0f)
        return {columns.low, edge < columns.high ? edge : columns.high};
    if (slope < 0.0f)
        return {edge > columns.low ? edge : columns.low, columns.high};
    return at_best > 0.0f ? Columns{1.0f, 0.0f} : columns;
}

#if !defined(__CUDA_ARCH__)

typedef long long vlong __attribute__((vector_size(128)));

// A picture, of which nobody else writes to the rows at hand.
struct Sheet {
    long long* samples;  // four of each pixel
    int* middles;  // of pixels: not 0 where one is covered
    unsigned char* marks;  // of tiles
    int width, across;  // pixels, and tiles, in a row
    float spread;  // pixels: side of the square that samples of a pixel lie in
};

// Enter a triangle into rows of a picture: the samples and the middles of four pixels at once.
ENDO_SIM_INLINE void cover_rows(const float* a, const float* b, const float* c, int face, int low, int high, const Sheet& sheet)
{
    ENDO_SIM_FUSE(off)  // as on a GPU
    constexpr vint PIXEL = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
    constexpr vfloat U = {0.375f, 0.875f, 0.125f, 0.625f, 0.625f, 0.125f, 0.875f, 0.375f,  // mirrored in every other pixel
        0.375f, 0.875f, 0.125f, 0.625f, 0.625f, 0.125f, 0.875f, 0.375f};
    constexpr vfloat V = {0.125f, 0.375f, 0.625f, 0.875f, 0.125f, 0.375f, 0.625f, 0.875f,
        0.125f, 0.375f, 0.625f, 0.875f, 0.125f, 0.375f, 0.625f, 0.875f};
    typedef signed char vbyte __attribute__((vector_size(16)));
    const float per_area = 1.0f / ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])), margin = 0.5f * sheet.spread;
    const float least = smaller(smaller(a[0], b[0]), c[0]) - margin, most = larger(larger(a[0], b[0]), c[0]) + margin;
    const Columns all{larger(least, 0.5f), smaller(most, (float)sheet.width - 0.5f)};
    if (all.low > all.high)
        return;
    const vfloat beside = 0.5f + sheet.spread * (U - 0.5f), mirrored = 0.5f + sheet.spread * ((1.0f - U) - 0.5f);
    const vfloat down = 0.5f + sheet.spread * (V - 0.5f);
    const float to_a = 0.5f * ((b[1] - c[1]) + (c[0] - b[0])), to_b = 0.5f * ((c[1] - a[1]) + (a[0] - c[0]));
    const float to_c = 0.5f * ((a[1] - b[1]) + (b[0] - a[0]));  // from the corner of a pixel to its middle
    for (int row = low; row <= high; ++row) {
        const Columns columns = span(c, a, row, sheet.spread, span(b, c, row, sheet.spread, span(a, b, row, sheet.spread, all)));
        const int first = (int)ceilf(columns.low - 0.5f), last = (int)floorf(columns.high - 0.5f);
        const float v = (float)row;
        const vfloat du = row % 2 ? mirrored : beside;
        for (int column = first & ~3; column <= last; column += 4) {  // four pixels of one tile
            const vint at = PIXEL + column;
            const vfloat u = float_of(at);
            const vfloat here_a = (b[0] - u) * (c[1] - v) - (b[1] - v) * (c[0] - u);
            const vfloat here_b = (c[0] - u) * (a[1] - v) - (c[1] - v) * (a[0] - u);
            const vfloat here_c = (a[0] - u) * (b[1] - v) - (a[1] - v) * (b[0] - u);
            const vfloat wa = here_a + du * (b[1] - c[1]) + down * (c[0] - b[0]);
            const vfloat wb = here_b + du * (c[1] - a[1]) + down * (a[0] - c[0]);
            const vfloat wc = here_c + du * (a[1] - b[1]) + down * (b[0] - a[0]);
            const vint reached = (at >= first) & (at <= last), inside = (larger(larger(wa, wb), wc) <= 0.0f) & reached;
            const vint middle = (larger(larger(here_a + to_a, here_b + to_b), here_c + to_c) <= 0.0f) & reached;
            if (!any(inside | middle))
                continue;
            const vfloat inverse = (wa * a[2] + wb * b[2] + wc * c[2]) * per_area;
            // Of positive floats the bits order as they do: what is nearest has the least key.
            const vlong key = __builtin_convertvector(0x7FFFFFFF - bits_of(inverse), vlong) << 32 | (long long)face;
            long long* samples = sheet.samples + 4 * ((size_t)row * sheet.width + column);
            vlong old{};
            copy_items(&old, samples, sizeof(long long), 4 * (sheet.width - column));
            const vlong nearer = __builtin_convertvector(inside, vlong) & (key < old);
            old = nearer ? key : old;
            copy_items(samples, &old, sizeof(long long), 4 * (sheet.width - column));
            // A byte of each sample is an int of each pixel.
            int* middles = sheet.middles + ((size_t)row * sheet.width + column);
            vbyte covered{};
            copy_items(&covered, middles, 1, 4 * (sheet.width - column));
            covered |= __builtin_convertvector(middle, vbyte);
            copy_items(middles, &covered, 1, 4 * (sheet.width - column));
            sheet.marks[row / TILE * sheet.across + column / TILE] = 1;
        }
    }
}

// Enter all triangles of a picture into the rows of some tiles, from one row on, to which nobody else writes.
template <class Frame> ENDO_SIM_INLINE void cover_tiles(const Frame& frame, int picture, int low)
{
    const size_t pixel = (size_t)picture * frame.height * frame.width;
    const Sheet sheet{frame.samples.data + SAMPLES * pixel, frame.middles.data + pixel, frame.marks.data + picture * frame.down * frame.across,
        frame.width, frame.across, frame.spread};
    const int high = low + TILE - 1;
    for (int face = 0; face < frame.faces; ++face) {
        const size_t i = (size_t)picture * frame.faces + face;
        const int first = frame.rows.data[i][0], last = frame.rows.data[i][1];
        if ((first > high) | (last < low) | (first > last))
            continue;
        float corners[3][3];
        __builtin_memcpy(corners, frame.screen.data + 3 * i, sizeof(corners));
        cover_rows(corners[0], corners[1], corners[2], face, first > low ? first : low, last < high ? last : high, sheet);
    }
}

#endif

}  // namespace endo_sim
