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

// What is seen where points are, from the four cells around each; those at the border go on outside.
template <class F> ENDO_SIM_INLINE void look_up(const Around& around, const F* at, F* found)
{
    ENDO_SIM_FUSE(on)
    const float most = CELLS - 1;
    const F per_depth = 1.0f / at[2], last = everywhere<F>(most - 1.0f);
    const F x = clamp((around.lens[0] * at[0] * per_depth + around.lens[2]) * (CELLS / (float)around.width) - 0.5f, 0.0f, most);
    const F y = clamp((around.lens[1] * at[1] * per_depth + around.lens[3]) * (CELLS / (float)around.height) - 0.5f, 0.0f, most);
    const auto left = whole(smaller(x, last)), top = whole(smaller(y, last)), first = top * CELLS + left;
    const F u = x - float_of(left), v = y - float_of(top);
    for (int lane = 0; lane < Lanes<F>::count; ++lane) {
        const Cell* cell = around.cells + lane_of(first, lane);
        for (int k = 0; k < 4; ++k) {
            const float above = cell[0][k] + lane_of(u, lane) * (cell[1][k] - cell[0][k]);
            const float below = cell[CELLS][k] + lane_of(u, lane) * (cell[CELLS + 1][k] - cell[CELLS][k]);
            set_lane(found[k], lane, above + lane_of(v, lane) * (below - above));
        }
    }
}

// Light of the tissue that lies in a direction from points of instruments. The lamp gives it as much less as it is farther away than
// they are; what is far away blurs with all else that is lit, and has less of a hue. Back towards the lens all is dark.
template <class F> ENDO_SIM_INLINE void mirrored(const Around& around, const F* way, const F* at, F* light)
{
    ENDO_SIM_FUSE(on)
    F seen[4];
    look_up(around, at, seen);
    const F deep = larger(seen[3] - at[2], everywhere<F>(BESIDE)), aside = deep / larger(way[2], everywhere<F>(AHEAD));
    const F step[3]{aside * way[0], aside * way[1], deep}, there[3]{at[0] + step[0], at[1] + step[1], at[2] + step[2]};
    look_up(around, there, seen);
    const F grey = (seen[0] + seen[1] + seen[2]) / 3.0f, hue = PALE / (PALE + length(step));
    const F lit = clamp(0.5f + 0.5f / ASIDE * way[2], 0.0f, 1.0f) * product(at, at) / product(there, there);
    for (int k = 0; k < 3; ++k)
        light[k] = lit * (grey + hue * (seen[k] - grey));
}

template <class F> struct Within {
    F axis[3];  // of unit length, or nothing where there is no axis
    F away;  // distance from it in radii
};

// In which of the capsules of their instrument points lie deepest.
template <class F> ENDO_SIM_INLINE Within<F> deepest(const F* at, const Capsules& capsules, integers_of<F> owner)
{
    ENDO_SIM_FUSE(on)
    Within<F> found{};
    F least = everywhere<F>(1e18f);
    for (int c = 0; c < capsules.count; ++c) {
        const auto own = owner == capsules.owners[c];
        if (!any(own))
            continue;
        const float *a = capsules.ends[c][0], *b = capsules.ends[c][1], radius = capsules.radii[c];
        const float along[3]{b[0] - a[0], b[1] - a[1], b[2] - a[2]}, square = product(along, along);
        const float scale = 1.0f / larger(root(square), 1e-6f);
        const F from[3]{at[0] - a[0], at[1] - a[1], at[2] - a[2]}, share = clamp(product(from, along) / larger(square, 1e-14f), 0.0f, 1.0f);
        const F way[3]{from[0] - share * along[0], from[1] - share * along[1], from[2] - share * along[2]};
        const F away = product(way, way) / (radius * radius);
        const auto nearer = own & (away < least);
        least = nearer ? away : least;
        for (int k = 0; k < 3; ++k)
            found.axis[k] = nearer ? everywhere<F>(scale * along[k]) : found.axis[k];
    }
    found.away = root(least);
    return found;
}

}  // namespace endo_sim
