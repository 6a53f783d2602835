// What code that is written once needs for one number (float: CUDA, and Warp's kernels on a CPU) and for the 16 of a CPU's
// vectors (vfloat): one item in each lane.
#pragma once
#include "core/native/vector.h"

namespace endo_sim {

// ---------------------------------------------------------------- one lane

template <class T> struct Lanes {
    static constexpr int count = 1;
    typedef int integers;
};

ENDO_SIM_INLINE bool any(bool condition) { return condition; }
ENDO_SIM_INLINE bool negated(bool condition) { return !condition; }
ENDO_SIM_INLINE float root(float x) { return sqrtf(x); }
ENDO_SIM_INLINE float float_of(int x) { return (float)x; }
ENDO_SIM_INLINE int whole(float x) { return (int)x; }
ENDO_SIM_INLINE float floor_of(float x) { return floorf(x); }
ENDO_SIM_INLINE float lane_of(float x, int) { return x; }
ENDO_SIM_INLINE int lane_of(int x, int) { return x; }
ENDO_SIM_INLINE bool lane_of(bool condition, int) { return condition; }
ENDO_SIM_INLINE void set_lane(float& x, int, float value) { x = value; }
ENDO_SIM_INLINE void set_lane(int& x, int, int value) { x = value; }

// 0, 1, 2 and so on, numbers in memory, and their first bytes.
template <class F> ENDO_SIM_INLINE F ramp() { return 0.0f; }
template <class F> ENDO_SIM_INLINE F load(const float* from, int) { return *from; }
ENDO_SIM_INLINE void store(float* to, float x, int) { *to = x; }
ENDO_SIM_INLINE void store(int* to, int x, int) { *to = x; }
ENDO_SIM_INLINE void store_bytes(unsigned char* to, int x, int) { *to = (unsigned char)x; }

// Each three of colours times a number, and more of each.
ENDO_SIM_INLINE void change_threes(float* threes, float by, const float* more, int)
{
    ENDO_SIM_FUSE(on)
    for (int k = 0; k < 3; ++k)
        threes[k] = threes[k] * by + more[k];
}

// ---------------------------------------------------------------- sixteen lanes

#if !defined(__CUDA_ARCH__)

template <> struct Lanes<vfloat> {
    static constexpr int count = LANE_COUNT;
    typedef vint integers;
};
template <> struct Lanes<vint> : Lanes<vfloat> { };

ENDO_SIM_INLINE vint negated(vint condition) { return ~condition; }
ENDO_SIM_INLINE vfloat float_of(vint x) { return __builtin_convertvector(x, vfloat); }
ENDO_SIM_INLINE vint whole(vfloat x) { return __builtin_convertvector(x, vint); }
ENDO_SIM_INLINE float lane_of(vfloat x, int lane) { return x[lane]; }
ENDO_SIM_INLINE int lane_of(vint x, int lane) { return x[lane]; }
ENDO_SIM_INLINE void set_lane(vfloat& x, int lane, float value) { x[lane] = value; }
ENDO_SIM_INLINE void set_lane(vint& x, int lane, int value) { x[lane] = value; }
template <> ENDO_SIM_INLINE vfloat ramp<vfloat>() { return vfloat{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}; }

template <> ENDO_SIM_INLINE vfloat load<vfloat>(const float* from, int count)
{
    vfloat found{};
    copy_items(&found, from, sizeof(float), count);
    return found;
}

ENDO_SIM_INLINE void store(float* to, vfloat x, int count) { copy_items(to, &x, sizeof(float), count); }
ENDO_SIM_INLINE void store(int* to, vint x, int count) { copy_items(to, &x, sizeof(int), count); }

ENDO_SIM_INLINE void store_bytes(unsigned char* to, vint x, int count)
{
    typedef unsigned char vbyte __attribute__((vector_size(16)));
    const vbyte bytes = __builtin_convertvector(x, vbyte);
    copy_items(to, &bytes, 1, count);
}

ENDO_SIM_INLINE void change_threes(float* threes, vfloat by, const vfloat* more, int count)
{
    ENDO_SIM_FUSE(on)
    vfloat old[3]{}, factors[3], added[3];
    copy_items(old, threes, 3 * sizeof(float), count);
    interleave(by, by, by, factors);
    interleave(more[0], more[1], more[2], added);
    for (int k = 0; k < 3; ++k)
        old[k] = old[k] * factors[k] + added[k];
    copy_items(threes, old, 3 * sizeof(float), count);
}

#if defined(__clang__)
ENDO_SIM_INLINE vfloat root(vfloat x) { return __builtin_elementwise_sqrt(x); }
ENDO_SIM_INLINE vfloat floor_of(vfloat x) { return __builtin_elementwise_floor(x); }
ENDO_SIM_INLINE float smallest(vfloat x) { return __builtin_reduce_min(x); }
ENDO_SIM_INLINE float largest(vfloat x) { return __builtin_reduce_max(x); }
#else  // for a compiler that only checks
vfloat root(vfloat x);
vfloat floor_of(vfloat x);
float smallest(vfloat x);
float largest(vfloat x);
#endif

#endif

// ---------------------------------------------------------------- any number of lanes

template <class T> using integers_of = typename Lanes<T>::integers;

template <class T> ENDO_SIM_INLINE T everywhere(float x) { return T{} + x; }
template <class T> ENDO_SIM_INLINE T ceil_of(T x) { return -floor_of(-x); }

// What a function returns for the number of each lane.
template <class T, class Of> ENDO_SIM_INLINE T each_lane(Of of)
{
    if constexpr (Lanes<T>::count == 1)
        return of(0);
    else
        return T{of(0), of(1), of(2), of(3), of(4), of(5), of(6), of(7), of(8), of(9), of(10), of(11), of(12), of(13), of(14), of(15)};
}

template <class T> ENDO_SIM_INLINE T larger(T a, T b) { return a > b ? a : b; }
template <class T> ENDO_SIM_INLINE T smaller(T a, T b) { return a < b ? a : b; }

template <class T> ENDO_SIM_INLINE T clamp(T x, float low, float high)
{
    return smaller(larger(x, everywhere<T>(low)), everywhere<T>(high));
}

// a · b of vectors of three. `unrounded` tells which of the first two products is fused, and so is not rounded: sums in
// either order are as good, but a result must not depend on who computes it.
template <int unrounded = 0, class T> ENDO_SIM_INLINE T dot(const T* a, const T* b)
{
    ENDO_SIM_FUSE(on)
    constexpr int other = 1 - unrounded;
    return a[unrounded] * b[unrounded] + a[other] * b[other] + a[2] * b[2];
}

// sin x of |x| < 1e4, to 4e-6: a polynomial (Taylor's) for what is left of x to the nearest multiple of π.
template <class T> ENDO_SIM_INLINE T sine(T x)
{
    ENDO_SIM_FUSE(on)
    const float round = 12582912.0f;  // adding 1.5 2^23 leaves no fraction bits
    const T turns = x * 0.318309886f + round, n = turns - round;
    const T r = x - n * 3.140625f - n * 9.67653589793e-4f, z = r * r;
    const T found = r + r * z * (-1.66666667e-1f + z * (8.33333333e-3f + z * (-1.98412698e-4f + z * 2.75573192e-6f)));
    return (bits_of(turns) & 1) != 0 ? -found : found;
}

// ln x of x >= LEAST_VOLUME, to 1e-7: 2^n (1 + f) with a polynomial in f (that of Cephes' logf).
template <class T> ENDO_SIM_INLINE T logarithm(T x)
{
    ENDO_SIM_FUSE(on)
    const T m = of_bits((bits_of(x) & 0x007fffff) | 0x3f000000);  // in [1/2, 1)
    const auto low = m < 0.70710678f;
    const integers_of<T> exponent = (bits_of(x) >> 23) - 126, n = low ? exponent - 1 : exponent;
    const T f = (low ? m + m : m) - 1.0f;
    const T e = float_of(n), z = f * f;
    T p = everywhere<T>(7.0376836292e-2f);
    p = p * f - 1.1514610310e-1f;
    p = p * f + 1.1676998740e-1f;
    p = p * f - 1.2420140846e-1f;
    p = p * f + 1.4249322787e-1f;
    p = p * f - 1.6668057665e-1f;
    p = p * f + 2.0000714765e-1f;
    p = p * f - 2.4999993993e-1f;
    p = p * f + 3.3333331174e-1f;
    return f * z * p - 2.12194440e-4f * e - 0.5f * z + f + 0.693359375f * e;
}

// x^y of x >= LEAST_VOLUME, as far as it is from 2^-126 to 2^126.
template <class T> ENDO_SIM_INLINE T power(T x, float y)
{
    ENDO_SIM_FUSE(on)
    return exp2<true>(clamp(1.44269504f * y * logarithm(x), -126.0f, 126.0f));
}

}  // namespace endo_sim
