// How much of a lamp, and of the light from all around, capsules keep from points: one (float), or 16 (vfloat) of a CPU's vectors.
// Lengths are metres, in the camera's frame.
#pragma once
#include "core/native/lanes.h"
#include "core/native/threads.h"

namespace endo_sim {

constexpr float REACH = 4.0f;  // radii of a capsule beyond which it takes less than a sixteenth of the light from all around
constexpr float PI = 3.14159265f, HALF_PI = 1.57079633f, QUARTER_PI = 0.785398163f;

typedef float Ends[2][3];

// Capsules, and which instrument each belongs to.
struct Capsules {
    const Ends* ends;
    const float* radii;
    const int* owners;
    int count;
};

struct Lamp {
    float at[3];
    float size;  // its radius
};

// Arc sine of x from -1 to 1, to 3e-7 (Cephes' asinf).
template <class F> ENDO_SIM_INLINE F arcsine(F x)
{
    ENDO_SIM_FUSE(on)
    const F a = larger(x, -x);
    const auto steep = a > 0.5f;
    const F z = steep ? 0.5f * (1.0f - a) : a * a, y = steep ? root(z) : a;
    const F p = y + y * z
            * (1.6666752422e-1f + z * (7.4953002686e-2f + z * (4.5470025998e-2f + z * (2.4181311049e-2f + z * 4.2163199048e-2f))));
    const F found = steep ? HALF_PI - 2.0f * p : p;
    return x < 0.0f ? -found : found;
}

// Arc tangent of any x, to 2e-7 (Cephes' atanf).
template <class F> ENDO_SIM_INLINE F arctangent(F x)
{
    ENDO_SIM_FUSE(on)
    const F a = larger(x, -x), none = everywhere<F>(0.0f);
    const auto steep = a > 2.41421356f, level = a <= 0.414213562f;
    const F above = steep ? everywhere<F>(-1.0f) : a - 1.0f, below = steep ? a : a + 1.0f;
    const F y = level ? a : above / below, z = y * y;
    const F from = level ? none : steep ? everywhere<F>(HALF_PI) : everywhere<F>(QUARTER_PI);
    const F found = from + (y + y * z * (-3.33329491539e-1f + z * (1.99777106478e-1f + z * (-1.38776856032e-1f + z * 8.05374449538e-2f))));
    return x < 0.0f ? -found : found;
}

template <class A, class B> ENDO_SIM_INLINE auto product(const A* a, const B* b)
{
    ENDO_SIM_FUSE(on)
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

template <class F> ENDO_SIM_INLINE F length(const F* a) { return root(product(a, a)); }

template <class F> struct Shares {
    F s, t;
};

// Where segments a b and p q come closest: the share of the way along each (Ericson, Real-Time Collision Detection, 5.1.9).
template <class P, class F> ENDO_SIM_INLINE Shares<F> closest(const float* a, const float* b, const P* p, const F* q)
{
    ENDO_SIM_FUSE(on)
    const float tiny = 1e-14f;  // m²: a segment that short is a point
    const F d2[3]{q[0] - p[0], q[1] - p[1], q[2] - p[2]}, none = everywhere<F>(0.0f);
    const float d1[3]{b[0] - a[0], b[1] - a[1], b[2] - a[2]}, aa = product(d1, d1);
    const P r[3]{a[0] - p[0], a[1] - p[1], a[2] - p[2]};
    const F ee = product(d2, d2), f = product(d2, r), some = larger(ee, everywhere<F>(tiny));
    if (aa < tiny)
        return {none, clamp(f / some, 0.0f, 1.0f)};
    const F c = none + product(d1, r), bb = product(d1, d2), cross = aa * ee - bb * bb;
    const F s = cross > 1e-6f * aa * ee ? clamp((bb * f - c * ee) / cross, 0.0f, 1.0f) : none, t = (bb * s + f) / some;
    const auto before = (ee < tiny) | (t < 0.0f);
    const F at_start = clamp(-c / aa, 0.0f, 1.0f), at_end = clamp((bb - c) / aa, 0.0f, 1.0f);
    return {before ? at_start : (t > 1.0f ? at_end : s), before ? none : smaller(t, everywhere<F>(1.0f))};
}

// Distance between these places of segments a b and p q.
template <class P, class F> ENDO_SIM_INLINE F gap(const float* a, const float* b, const P* p, const F* q, Shares<F> where)
{
    ENDO_SIM_FUSE(on)
    F way[3];
    for (int k = 0; k < 3; ++k)
        way[k] = p[k] + where.t * (q[k] - p[k]) - a[k] - where.s * (b[k] - a[k]);
    return length(way);
}

// Share of the unit disc on one side of a line at distance x from its middle.
template <class F> ENDO_SIM_INLINE F disc_below(F x)
{
    ENDO_SIM_FUSE(on)
    const F y = clamp(x, -1.0f, 1.0f);
    return 0.5f + (y * root(1.0f - y * y) + arcsine(y)) / PI;
}

// Share of a lamp that a capsule hides from points, exact where the edges of the capsule look straight across the lamp; no edge is
// sharper than blur (m), half its width.
template <class F>
ENDO_SIM_INLINE F hidden(const float* a, const float* b, float radius, const Lamp& lamp, const F* at, F blur)
{
    ENDO_SIM_FUSE(on)
    const Shares<F> where = closest(a, b, lamp.at, at);
    const F beside = gap(a, b, lamp.at, at, where), half = larger(lamp.size * (1.0f - where.t), blur);
    const auto some = beside <= radius + half;  // which it is not if it is not a number
    if (!any(some))
        return everywhere<F>(0.0f);
    return some ? disc_below((beside + radius) / half) - disc_below((beside - radius) / half) : everywhere<F>(0.0f);
}

template <class F> ENDO_SIM_INLINE F angle_sum(F along, F off)
{
    ENDO_SIM_FUSE(on)
    const F slope = along / off;
    return arctangent(slope) + slope / (1.0f + slope * slope);
}

// Share of the light from all around surfaces that a capsule takes: the view factor of a thin tube, and of a sphere where it has no
// length.
template <class F> ENDO_SIM_INLINE F covered(const float* a, const float* b, float radius, const F* at, const F* normal)
{
    ENDO_SIM_FUSE(on)
    const float axis[3]{b[0] - a[0], b[1] - a[1], b[2] - a[2]}, long_ = length(axis), square = product(axis, axis);
    const F none = everywhere<F>(0.0f), away[3]{at[0] - a[0], at[1] - a[1], at[2] - a[2]};
    const F share = clamp(product(away, axis) / (square > 1e-14f ? square : 1e-14f), 0.0f, 1.0f);
    const F way[3]{share * axis[0] - away[0], share * axis[1] - away[1], share * axis[2] - away[2]}, distance = length(way);
    const auto some = distance <= REACH * radius;
    if (!any(some))
        return none;
    if (long_ < 1e-6f) {
        const F off = larger(distance, everywhere<F>(radius));
        const F facing = larger(product(normal, way) / larger(distance, everywhere<F>(1e-9f)), none);
        return some ? radius * radius / (off * off) * facing : none;
    }
    const float u[3]{axis[0] / long_, axis[1] / long_, axis[2] / long_};
    const F start = -product(away, u), foot[3]{-away[0] - start * u[0], -away[1] - start * u[1], -away[2] - start * u[2]};
    const F clear = length(foot), off = larger(clear, everywhere<F>(radius));
    const F facing = larger(product(normal, foot) / larger(clear, everywhere<F>(1e-9f)), none);
    return some ? radius / off * facing * (angle_sum(start + long_, off) - angle_sum(start, off)) / PI : none;
}

// Whether a capsule may keep light from points at most slack (m) from one.
ENDO_SIM_INLINE bool may_hide(const float* at, float slack, const Lamp& lamp, const Capsules& capsules, int c)
{
    ENDO_SIM_FUSE(on)
    const float *a = capsules.ends[c][0], *b = capsules.ends[c][1], around = REACH * capsules.radii[c] + slack;
    const float beside = gap(a, b, lamp.at, at, closest(a, b, lamp.at, at));
    if (beside < capsules.radii[c] + lamp.size + slack)
        return true;
    if (beside >= around)  // the whole way from the lamp is as near as its end at least
        return false;
    return gap(a, b, at, at, closest(a, b, at, at)) < around;
}

// The capsules that may keep light from points at most slack (m) from one, a bit for each. On a GPU all threads of a block, which has 64
// or more, ask for the same, and each looks at one capsule.
ENDO_SIM_INLINE unsigned long long near_capsules(const float* at, float slack, const Lamp& lamp, const Capsules& capsules)
{
#if defined(__CUDA_ARCH__)
    const int c = threadIdx.x;
    return block_bits(c < capsules.count && may_hide(at, slack, lamp, capsules, c));
#else
    unsigned long long found = 0;
    for (int c = 0; c < capsules.count; ++c)
        found |= (unsigned long long)may_hide(at, slack, lamp, capsules, c) << c;
    return found;
#endif
}

template <class F> struct Left {
    F seen;  // share of the lamp that points see
    F open;  // share of the light from all around that they get
};

// What these capsules leave of the light; those of an instrument do not count.
template <class F> ENDO_SIM_INLINE Left<F> light_left(
    unsigned long long which, const F* at, const F* normal, F blur, const Lamp& lamp, const Capsules& capsules, integers_of<F> but)
{
    ENDO_SIM_FUSE(on)
    const F one = everywhere<F>(1.0f), none{};
    F seen = one, open = one;
    for (int c = 0; c < capsules.count; ++c) {
        const auto others = but != capsules.owners[c];
        if ((which >> c & 1) && any(others)) {
            const float *a = capsules.ends[c][0], *b = capsules.ends[c][1], radius = capsules.radii[c];
            seen *= others ? 1.0f - hidden(a, b, radius, lamp, at, blur) : one;
            open -= others ? covered(a, b, radius, at, normal) : none;
        }
    }
    return {seen, larger(open, none)};
}

}  // namespace endo_sim
