// What happens to a tile of the tissue's picture on a CPU, 16 pixels of a row at once; resolving_kernels.py has the rest.
#pragma once
#include "instruments/native/shadow.h"

#if !defined(__CUDA_ARCH__)

namespace endo_sim {

constexpr float SURFACE = 0.5f;  // alpha above which a pixel shows tissue

struct Tile {
    int left, top, right, bottom;  // pixels of a picture, 16 columns at most
    size_t first;  // of the picture
    int width;  // of the picture
};

struct Lens {
    float fx, fy, cx, cy;
};

struct Depths {
    float low, high;
};

// The nearest and the farthest tissue; none where low is more than high.
ENDO_SIM_INLINE Depths tissue_depths(const Tile& tile, const float* depths, const float* alphas)
{
    ENDO_SIM_FUSE(off)
    vfloat low = broadcast(1e9f), high{};
    for (int row = tile.top; row < tile.bottom; ++row) {
        const size_t start = tile.first + (size_t)row * tile.width + tile.left;
        vfloat z{}, alpha{};
        copy_items(&z, depths + start, sizeof(float), tile.right - tile.left);
        copy_items(&alpha, alphas + start, sizeof(float), tile.right - tile.left);
        const vint drawn = alpha > SURFACE;
        z /= drawn ? alpha : broadcast(1.0f);
        low = smaller(low, drawn ? z : broadcast(1e9f));
        high = larger(high, drawn ? z : vfloat{});
    }
    return {smallest(low), largest(high)};
}

// Put tissue into the shadow of capsules; ambient is the share of the light that comes from all around.
ENDO_SIM_INLINE void shade_tissue(unsigned long long which, const Tile& tile, const Lens& lens, const Lamp& lamp,
    const Capsules& capsules, float ambient, const float* depths, const float* alphas, float* colors)
{
    ENDO_SIM_FUSE(off)
    constexpr vfloat LANES = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    const int count = tile.right - tile.left;
    const vfloat across = (LANES + ((float)tile.left + 0.5f) - lens.cx) / lens.fx;
    for (int row = tile.top; row < tile.bottom; ++row) {
        const size_t start = tile.first + (size_t)row * tile.width + tile.left;
        vfloat z{}, alpha{}, rgb[3]{};
        copy_items(&z, depths + start, sizeof(float), count);
        copy_items(&alpha, alphas + start, sizeof(float), count);
        const vint drawn = alpha > SURFACE;
        if (!any(drawn))
            continue;
        z = drawn ? z / alpha : broadcast(1.0f);
        const vfloat at[3]{across * z, ((float)row + 0.5f - lens.cy) / lens.fy * z, z}, far = -length(at);
        const vfloat normal[3]{at[0] / far, at[1] / far, at[2] / far};
        const Left<vfloat> left = light_left(which, at, normal, 0.5f * z / lens.fx, lamp, capsules, -1);
        const vfloat light = root(larger((1.0f - ambient) * left.seen + ambient * left.open, vfloat{}));
        copy_items(rgb, colors + 3 * start, 3 * sizeof(float), count);
        scale_threes(rgb, drawn ? light : broadcast(1.0f));
        copy_items(colors + 3 * start, rgb, 3 * sizeof(float), count);
    }
}

}  // namespace endo_sim

#endif
