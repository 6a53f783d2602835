// What metal shows of what is around it. Lengths are metres, in the camera's frame.
#pragma once
#include "instruments/native/shadow.h"

namespace endo_sim {

constexpr int CELLS = 16;  // of a picture, each way
constexpr float AHEAD = 0.1f;  // of directions, along the axis of the lens: what lies farther aside counts as far away as there
constexpr float ASIDE = 0.15f;  // likewise: from so much ahead to so much back it gets dark
constexpr float BESIDE = 1e-3f;  // along the axis of the lens: least way to what is mirrored
constexpr float PALE = 0.06f;  // way to tissue that is mirrored with half its hue

typedef float Cell[4];

// Of a picture, fx fy cx cy of its lens, and of each cell the mean light of its tissue, red, green and blue, and its depth.
struct Around {
    const float* lens;
    const Cell* cells;
    int width, height;
};

// What is seen where a point is, from the four cells around; those at the border go on outside.
ENDO_SIM_INLINE void look_up(const Around& around, const float* at, float* found)
{
    ENDO_SIM_FUSE(on)
    const float most = CELLS - 1, per_depth = 1.0f / at[2];
    const float x = clamp((around.lens[0] * at[0] * per_depth + around.lens[2]) * (CELLS / (float)around.width) - 0.5f, 0.0f, most);
    const float y = clamp((around.lens[1] * at[1] * per_depth + around.lens[3]) * (CELLS / (float)around.height) - 0.5f, 0.0f, most);
    const int left = (int)smaller(x, most - 1.0f), top = (int)smaller(y, most - 1.0f);
    const float u = x - left, v = y - top;
    const Cell* cell = around.cells + top * CELLS + left;
    for (int k = 0; k < 4; ++k) {
        const float above = cell[0][k] + u * (cell[1][k] - cell[0][k]);
        const float below = cell[CELLS][k] + u * (cell[CELLS + 1][k] - cell[CELLS][k]);
        found[k] = above + v * (below - above);
    }
}

// Light of the tissue that lies in a direction from a point of an instrument. The lamp gives it as much less as it is farther away than
// that point; what is far away blurs with all else that is lit, and has less of a hue. Back towards the lens all is dark.
ENDO_SIM_INLINE void mirrored(const Around& around, const float* way, const float* at, float* light)
{
    ENDO_SIM_FUSE(on)
    float seen[4];
    look_up(around, at, seen);
    const float deep = larger(seen[3] - at[2], BESIDE), aside = deep / larger(way[2], AHEAD);
    const float step[3]{aside * way[0], aside * way[1], deep}, there[3]{at[0] + step[0], at[1] + step[1], at[2] + step[2]};
    look_up(around, there, seen);
    const float grey = (seen[0] + seen[1] + seen[2]) / 3.0f, hue = PALE / (PALE + length(step));
    const float lit = clamp(0.5f + 0.5f / ASIDE * way[2], 0.0f, 1.0f) * product(at, at) / product(there, there);
    for (int k = 0; k < 3; ++k)
        light[k] = lit * (grey + hue * (seen[k] - grey));
}

struct Within {
    float axis[3];  // of unit length, or nothing where there is no axis
    float away;  // distance from it in radii
};

// In which of the capsules of its instrument a point lies deepest.
ENDO_SIM_INLINE Within deepest(const float* at, const Capsules& capsules, int owner)
{
    ENDO_SIM_FUSE(on)
    int which = -1;
    float least = 1e18f;
    for (int c = 0; c < capsules.count; ++c) {
        if (capsules.owners[c] != owner)
            continue;
        const float *a = capsules.ends[c][0], *b = capsules.ends[c][1], radius = capsules.radii[c];
        const float along[3]{b[0] - a[0], b[1] - a[1], b[2] - a[2]}, from[3]{at[0] - a[0], at[1] - a[1], at[2] - a[2]};
        const float share = clamp(product(from, along) / larger(product(along, along), 1e-14f), 0.0f, 1.0f);
        const float way[3]{from[0] - share * along[0], from[1] - share * along[1], from[2] - share * along[2]};
        const float away = product(way, way) / (radius * radius);
        if (away < least) {
            least = away;
            which = c;
        }
    }
    Within found{{0.0f, 0.0f, 0.0f}, root(least)};
    if (which >= 0) {
        const float *a = capsules.ends[which][0], *b = capsules.ends[which][1];
        const float along[3]{b[0] - a[0], b[1] - a[1], b[2] - a[2]}, scale = 1.0f / larger(length(along), 1e-6f);
        for (int k = 0; k < 3; ++k)
            found.axis[k] = scale * along[k];
    }
    return found;
}

}  // namespace endo_sim
