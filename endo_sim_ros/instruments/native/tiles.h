// Tiles of a picture: which capsules matter to one and, on a CPU, all that happens to it, many points or pixels at once.
#pragma once
#include "instruments/native/blend.h"

namespace endo_sim {

// Capsules that may keep light from what a tile shows between two depths; on a GPU all threads of its block must be here.
template <class Frame, class Look>
ENDO_SIM_INLINE unsigned long long about(const Scene<Frame, Look>& scene, int left, int top, float low, float high)
{
    ENDO_SIM_FUSE(on)
    if (low > high)
        return 0;
    const float half = 0.5f * TILE, z = 0.5f * (low + high), aside[2]{half / scene.view[0], half / scene.view[1]};
    float at[3];
    scene.point(left + half - 0.5f, top + half - 0.5f, z, at);
    const float across = root(aside[0] * aside[0] + aside[1] * aside[1]) * high;
    const float slack = across + 0.5f * (high - low) * length(at) / z + high / scene.view[0];
    return near_capsules(at, slack, scene.lamp, scene.capsules);
}

#if !defined(__CUDA_ARCH__)

// Make a struct of numbers of four bytes one lane of the same struct of vectors.
template <class One, class Sixteen> ENDO_SIM_INLINE void put(Sixteen& all, int lane, const One& one)
{
    static_assert(sizeof(Sixteen) == 16 * sizeof(One));
    for (size_t k = 0; k < sizeof(One) / 4; ++k)
        __builtin_memcpy((char*)&all + 64 * k + 4 * lane, (const char*)&one + 4 * k, 4);
}

// Lights the points of a tile's pixels, 16 at a time, whichever pixels they are of.
template <class Frame, class Look> struct TileLight {
    const Scene<Frame, Look>& scene;
    unsigned long long on_links;
    int row, column;  // of the pixel at hand, in the tile
    int count, rows[16], columns[16];  // points that wait, and where each is seen
    float counts[16];  // samples that see it
    Points<vfloat> points;
    float colors[TILE][3][TILE];  // sums over the samples of pixels

    ENDO_SIM_INLINE void start(const Points<float>& point)
    {
        if (count == 16)
            finish();
        put(points, count, point);
        rows[count] = row;
        columns[count] = column;
        counts[count++] = 0.0f;
    }

    ENDO_SIM_INLINE void add(float seen) { counts[count - 1] += seen; }

    __attribute__((noinline)) void finish()  // which leaves registers to what looks at samples
    {
        ENDO_SIM_FUSE(on)
        vfloat color[3];
        light_points(scene, on_links, points, color);
        for (int i = 0; i < count; ++i)
            for (int k = 0; k < 3; ++k)
                colors[rows[i]][k][columns[i]] += counts[i] * lane_of(color[k], i);
        count = 0;
    }
};

// Draw a tile of a picture, by its number.
template <class Frame, class Look> ENDO_SIM_INLINE void blend_tile(const Scene<Frame, Look>& scene, int number, const Images& images)
{
    ENDO_SIM_FUSE(on)
    const Frame& frame = scene.frame;
    const int left = TILE * (number % frame.across), top = TILE * (number / frame.across);
    const int count = frame.width - left < TILE ? frame.width - left : TILE, rows = frame.height - top < TILE ? frame.height - top : TILE;
    unsigned char& mark = frame.marks.data[scene.picture * frame.across * frame.down + number];
    const bool marked = mark != 0, among_others = marked && frame.several && frame.shadows;
    mark = 0;
    float tissue[TILE][TILE], nearest = FAR, farthest = 0.0f;  // depths, and those of instruments
    vfloat low = broadcast(FAR), high{};
    for (int row = 0; row < rows; ++row) {
        const size_t pixel = scene.pixel(top + row, left);
        const vfloat alpha = load<vfloat>(images.alphas + pixel, count), metres = load<vfloat>(images.depths + pixel, count);
        const vint shows = alpha > SURFACE;
        const vfloat z = shows ? metres / (shows ? alpha : broadcast(1.0f)) : broadcast(FAR);
        low = smaller(low, z);
        high = larger(high, shows ? z : vfloat{});
        store(tissue[row], z, TILE);
        store_bytes(images.labels + pixel, shows ? vint{} + 1 : vint{}, count);
        for (int i = 0; among_others && i < SAMPLES * count; ++i) {
            const long long key = frame.samples.data[SAMPLES * pixel + i];
            if (key != EMPTY) {
                nearest = smaller(nearest, depth_of(key));
                farthest = larger(farthest, depth_of(key));
            }
        }
    }
    const unsigned long long on_tissue = frame.shadows ? about(scene, left, top, smallest(low), largest(high)) : 0;
    Seen<vfloat> seen[TILE];
    if (marked) {
        TileLight<Frame, Look> light{scene, about(scene, left, top, nearest, farthest)};
        for (light.row = 0; light.row < rows; ++light.row) {
            seen[light.row] = {};
            for (light.column = 0; light.column < count; ++light.column) {
                const float z = tissue[light.row][light.column];
                put(seen[light.row], light.column, see(scene, top + light.row, left + light.column, z, light));
            }
        }
        light.finish();
        for (int row = 0; row < rows; ++row)
            for (int k = 0; k < 3; ++k)
                seen[row].color[k] = load<vfloat>(light.colors[row][k], TILE);
    }
    if (marked || on_tissue)
        for (int row = 0; row < rows; ++row)
            blend(scene, top + row, left, count, on_tissue, marked ? seen[row] : Seen<vfloat>{}, images);
}

#endif

}  // namespace endo_sim
