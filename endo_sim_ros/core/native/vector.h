// Vectors of 16 numbers for CPUs, of the vector types of Clang and GCC, which become whatever the processor has (AVX-512,
// AVX2, SSE, NEON), and what code that is written once needs for a vector (vfloat) and for a number (float). GPUs have the
// numbers only. A condition is a bool for a number and a vint, all bits or none, for a vector: `c ? x : y`, `|` and `&`
// take both.
#pragma once
#include "core/native/warp.h"

namespace endo_sim {

constexpr int LANE_COUNT = 16;

ENDO_SIM_INLINE float negative(float x) { return -fabsf(x); }
ENDO_SIM_INLINE float absolute(float x) { return fabsf(x); }

#if !defined(__CUDA_ARCH__)

typedef float vfloat __attribute__((vector_size(4 * LANE_COUNT)));
typedef int vint __attribute__((vector_size(4 * LANE_COUNT)));

ENDO_SIM_INLINE vfloat broadcast(float x) { return vfloat{} + x; }

// -|x|.
ENDO_SIM_INLINE vfloat negative(vfloat x) { return (vfloat)((vint)x | (vint{} + (int)0x80000000)); }

ENDO_SIM_INLINE vfloat absolute(vfloat x) { return (vfloat)((vint)x & (vint{} + 0x7fffffff)); }

ENDO_SIM_INLINE bool any(vint condition)
{
#if defined(__clang__)
    return __builtin_reduce_or(condition) != 0;
#else
    int bits = 0;
    for (int lane = 0; lane < 16; ++lane)
        bits |= condition[lane];
    return bits != 0;
#endif
}

ENDO_SIM_INLINE float sum(vfloat x)
{
    typedef float half __attribute__((vector_size(32)));
    typedef float quarter __attribute__((vector_size(16)));
    half h = __builtin_shufflevector(x, x, 0, 1, 2, 3, 4, 5, 6, 7) + __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15);
    quarter q = __builtin_shufflevector(h, h, 0, 1, 2, 3) + __builtin_shufflevector(h, h, 4, 5, 6, 7);
    return (q[0] + q[2]) + (q[1] + q[3]);
}

// The first count of 16 items of a size; a copy of constant size is a single instruction.
ENDO_SIM_INLINE void copy_items(void* to, const void* from, size_t size, size_t count)
{
    if (count >= 16)
        __builtin_memcpy(to, from, 16 * size);
    else
        __builtin_memcpy(to, from, count * size);
}

// Three vectors as the numbers of 16 threes, in order.
ENDO_SIM_INLINE void interleave(vfloat a, vfloat b, vfloat c, vfloat* threes)
{
#define ENDO_SIM_OF(x, y, ...) __builtin_shufflevector(x, y, __VA_ARGS__)
    const vfloat ab0 = ENDO_SIM_OF(a, b, 0, 16, -1, 1, 17, -1, 2, 18, -1, 3, 19, -1, 4, 20, -1, 5);
    threes[0] = ENDO_SIM_OF(ab0, c, 0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15);
    const vfloat ab1 = ENDO_SIM_OF(a, b, 21, -1, 6, 22, -1, 7, 23, -1, 8, 24, -1, 9, 25, -1, 10, 26);
    threes[1] = ENDO_SIM_OF(ab1, c, 0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15);
    const vfloat ab2 = ENDO_SIM_OF(a, b, -1, 11, 27, -1, 12, 28, -1, 13, 29, -1, 14, 30, -1, 15, 31, -1);
    threes[2] = ENDO_SIM_OF(ab2, c, 26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31);
#undef ENDO_SIM_OF
}

// Rows of a square of numbers from its columns: four rounds of riffles.
ENDO_SIM_INLINE void transpose(const vfloat* columns, vfloat* rows)
{
    for (int i = 0; i < 16; ++i)
        rows[i] = columns[i];
    for (int round = 0; round < 4; ++round) {
        vfloat before[16];
        for (int i = 0; i < 16; ++i)
            before[i] = rows[i];
        for (int i = 0; i < 8; ++i) {
            const vfloat a = before[i], b = before[i + 8];
            rows[2 * i] = __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
            rows[2 * i + 1] = __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
        }
    }
}

// Multiply 16 threes in order by a number each.
ENDO_SIM_INLINE void scale_threes(vfloat* threes, vfloat by)
{
    threes[0] *= __builtin_shufflevector(by, by, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5);
    threes[1] *= __builtin_shufflevector(by, by, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8, 9, 9, 9, 10, 10);
    threes[2] *= __builtin_shufflevector(by, by, 10, 11, 11, 11, 12, 12, 12, 13, 13, 13, 14, 14, 14, 15, 15, 15);
}

ENDO_SIM_INLINE vint bits_of(vfloat x) { return (vint)x; }
ENDO_SIM_INLINE vfloat of_bits(vint x) { return (vfloat)x; }

ENDO_SIM_INLINE int bits_of(float x)
{
    int bits;
    __builtin_memcpy(&bits, &x, 4);
    return bits;
}

ENDO_SIM_INLINE float of_bits(int bits)
{
    float x;
    __builtin_memcpy(&x, &bits, 4);
    return x;
}

#else

ENDO_SIM_INLINE int bits_of(float x) { return __float_as_int(x); }
ENDO_SIM_INLINE float of_bits(int bits) { return __int_as_float(bits); }

#endif

// a b + c, rounded once or twice.
template <bool fused, class F> ENDO_SIM_INLINE F multiply_add(F a, F b, float c)
{
    if constexpr (fused) {
        ENDO_SIM_FUSE(on)
        return a * b + c;
    } else {
        ENDO_SIM_FUSE(off)
        return a * b + c;
    }
}

// The least exponent of what fades: far below a grey level, and far enough from subnormal numbers that products are none. A CPU
// takes a hundred times as long for those.
constexpr float FAINTEST = -32.0f;

// 2^x for x from -126 to 126, to 2e-7 relative: 2^n times a polynomial for 2^f, |f| <= 1/2 (that of Cephes' exp2f).
template <bool fused, class F> ENDO_SIM_INLINE F exp2(F x)
{
    const float round = 12582912.0f;  // adding 1.5 2^23 leaves no fraction bits, and n in the lowest
    const F n = x + round;
    const F f = x - (n - round);
    F p = F{} + 1.535336188319500e-4f;
    p = multiply_add<fused>(p, f, 1.339887440266574e-3f);
    p = multiply_add<fused>(p, f, 9.618437357674640e-3f);
    p = multiply_add<fused>(p, f, 5.550332471162809e-2f);
    p = multiply_add<fused>(p, f, 2.402264791363012e-1f);
    p = multiply_add<fused>(p, f, 6.931472028550421e-1f);
    p = multiply_add<fused>(p, f, 1.0f);
    return of_bits(bits_of(p) + (bits_of(n) << 23));
}

}  // namespace endo_sim
