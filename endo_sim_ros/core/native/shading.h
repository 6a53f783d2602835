// What a camera makes of a rendered picture, on a CPU, 16 pixels or numbers at a time; `shading_kernels.py` has the formula.
#pragma once
#include "core/native/vector.h"

#if !defined(__CUDA_ARCH__)

namespace endo_sim {

// log2 of positive x: its exponent, and of the mantissa m from 0.7 to 1.4 the series in t = (m - 1) / (m + 1).
ENDO_SIM_INLINE vfloat log2_of(vfloat x)
{
    const vint bits = bits_of(x), exponent = (bits - 0x3f3504f3) >> 23;
    const vfloat m = of_bits(bits - (exponent << 23)), t = (m - 1.0f) / (m + 1.0f), s = t * t;
    const vfloat series = 1.0f + s * (1.0f / 3 + s * (1.0f / 5 + s * (1.0f / 7 + s * (1.0f / 9))));
    return __builtin_convertvector(exponent, vfloat) + 2.88539008f * t * series;
}

ENDO_SIM_INLINE vfloat bounded_exp2(vfloat y)
{
    return exp2<false>(y < -126.0f ? broadcast(-126.0f) : y > 126.0f ? broadcast(126.0f) : y);
}

// Light 16 pixels, or the last ones of count, from the one at 16 block on.
ENDO_SIM_INLINE void light_pixels(int block, size_t count, const float* colors, const float* depths, const float* alphas,
    const float* fixed, float distance, float reference, float nearest, float* out)
{
    ENDO_SIM_FUSE(off)
    const size_t start = 16 * (size_t)block;
    count -= start;
    vfloat z{}, w{}, gain{}, rgb[3]{};
    copy_items(&z, depths + start, sizeof(float), count);
    copy_items(&w, alphas + start, sizeof(float), count);
    copy_items(&gain, fixed + start, sizeof(float), count);
    copy_items(rgb, colors + 3 * start, 3 * sizeof(float), count);
    const vint drawn = w > nearest;
    vfloat depth = z / (drawn ? w : broadcast(nearest));
    depth = depth > nearest ? depth : broadcast(nearest);
    const vfloat x = drawn ? depth / reference : broadcast(1.0f);

    gain *= bounded_exp2(-distance * log2_of(x));
    scale_threes(rgb, gain);
    copy_items(out + 3 * start, rgb, 3 * sizeof(float), count);
}

// The same with the lamp elsewhere: motion [12] takes points from the camera to it, slopes [2 count] are x/z and y/z of pixels.
ENDO_SIM_INLINE void light_pixels_from(int block, size_t count, const float* colors, const float* depths, const float* alphas,
    const float* slopes, const float* motion, float distance, float angle, float tilt_x, float tilt_y, float reference, float nearest,
    float* out)
{
    ENDO_SIM_FUSE(off)
    const size_t start = 16 * (size_t)block, pixels = count;
    count -= start;
    vfloat z{}, w{}, x{}, y{}, rgb[3]{}, at[3]{};
    copy_items(&z, depths + start, sizeof(float), count);
    copy_items(&w, alphas + start, sizeof(float), count);
    copy_items(&x, slopes + start, sizeof(float), count);
    copy_items(&y, slopes + pixels + start, sizeof(float), count);
    copy_items(rgb, colors + 3 * start, 3 * sizeof(float), count);
    const vint drawn = w > nearest;
    z = drawn ? z / (drawn ? w : broadcast(nearest)) : broadcast(reference);
    for (int i = 0; i < 3; i++)
        at[i] = (motion[4 * i] * x + motion[4 * i + 1] * y + motion[4 * i + 2]) * z + motion[4 * i + 3];
    at[2] = at[2] > nearest ? at[2] : broadcast(nearest);
    const vfloat aside = at[0] / at[2], above = at[1] / at[2], secant = 1.0f + aside * aside + above * above;  // squared
    const vfloat tilted = 1.44269504f * (tilt_x * aside + tilt_y * above);
    scale_threes(rgb, bounded_exp2(tilted - distance * log2_of(at[2] / reference) - 0.5f * (distance + angle) * log2_of(secant)));
    copy_items(out + 3 * start, rgb, 3 * sizeof(float), count);
}

// Expose and tone 16 pixels in place, or the last ones of count: gains [3] are of the channels; without a shoulder brightness stays.
ENDO_SIM_INLINE void expose_pixels(int block, size_t count, const float* gains, float shoulder, float* lit)
{
    ENDO_SIM_FUSE(off)
    const size_t start = 16 * (size_t)block;
    count -= start;
    vfloat rgb[3]{};
    copy_items(rgb, lit + 3 * start, 3 * sizeof(float), count);
    const float knee = 1.0f - shoulder, slower = shoulder > 0.0f ? 0.5f / shoulder : 0.0f;
    for (int i = 0; i < 3; i++) {
        vfloat gain;
        for (int k = 0; k < 16; k++)
            gain[k] = gains[(16 * i + k) % 3];
        rgb[i] *= gain;
        if (shoulder > 0.0f) {
            vfloat rise = (rgb[i] - knee) * slower;
            rise = rise > 0.0f ? rise : vfloat{};
            rise = rise < 1.0f ? rise : broadcast(1.0f);
            rgb[i] = (rgb[i] < knee ? rgb[i] : broadcast(knee)) + shoulder * rise * (2.0f - rise);
        }
    }
    copy_items(lit + 3 * start, rgb, 3 * sizeof(float), count);
}

// Make bytes of 16 numbers from 0 to 1, or of the last ones of count, from the one at 16 block on.
ENDO_SIM_INLINE void round_values(int block, size_t count, const float* values, unsigned char* out)
{
    ENDO_SIM_FUSE(off)  // rounds like torch
    typedef unsigned char vbyte __attribute__((vector_size(16)));
    const size_t start = 16 * (size_t)block;
    count -= start;
    vfloat x{};
    copy_items(&x, values + start, sizeof(float), count);
    x = x > 0.0f ? x : vfloat{};
    x = x < 1.0f ? x : broadcast(1.0f);
    const vbyte bytes = __builtin_convertvector(__builtin_convertvector(x * 255.0f + 0.5f, vint), vbyte);
    copy_items(out + start, &bytes, 1, count);
}

}  // namespace endo_sim

#endif
