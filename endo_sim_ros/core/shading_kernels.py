"""What a camera makes of a rendered picture, on a CPU: light, and bytes. Vectorised over 16 pixels, or 16 numbers.

The native code is C++ with the vector types of Clang, which become whatever the processor has. A kernel's first argument
is an offset to its number of the thread, for launches in shares. Light is `falloff` of `features`:
brightness = around · (max(d, nearest) / reference)^−distance, where ``around`` is what depends on the pixel alone; pixels
without tissue have d = reference.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_TYPES = """
    typedef float vfloat __attribute__((vector_size(64)));
    typedef int vint __attribute__((vector_size(64)));
    const size_t start = 16 * (size_t)block;
    // The first count of 16 items; a copy of constant size is a single instruction.
    const auto copy = [](void* to, const void* from, size_t size, size_t count) {
        if (count >= 16)
            __builtin_memcpy(to, from, 16 * size);
        else
            __builtin_memcpy(to, from, count * size);
    };
"""


@wp.func_native(
    _TYPES
    + """
    const size_t count = (size_t)depths.shape[0] - start;
    vfloat z{}, w{}, gain{}, rgb[3]{};
    copy(&z, depths.data + start, sizeof(float), count);
    copy(&w, alphas.data + start, sizeof(float), count);
    copy(&gain, around.data + start, sizeof(float), count);
    copy(rgb, colors.data + 3 * start, 3 * sizeof(float), count);
    const vint drawn = w > nearest;
    vfloat depth = z / (drawn ? w : vfloat{} + nearest);
    depth = depth > nearest ? depth : vfloat{} + nearest;
    const vfloat x = drawn ? depth / reference : vfloat{} + 1.0f;

    // log2 of x: its exponent, and of the mantissa m from 0.7 to 1.4 the series in t = (m - 1) / (m + 1).
    const vint bits = (vint)x, exponent = (bits - 0x3f3504f3) >> 23;
    const vfloat m = (vfloat)(bits - (exponent << 23)), t = (m - 1.0f) / (m + 1.0f), s = t * t;
    const vfloat series = 1.0f + s * (1.0f / 3 + s * (1.0f / 5 + s * (1.0f / 7 + s * (1.0f / 9))));
    const vfloat log2 = __builtin_convertvector(exponent, vfloat) + 2.88539008f * t * series;

    // 2^y: 2^n times a polynomial for 2^f, |f| <= 1/2 (that of Cephes' exp2f).
    vfloat y = -distance * log2;
    y = y < -126.0f ? vfloat{} - 126.0f : y > 126.0f ? vfloat{} + 126.0f : y;
    const vfloat n = y + 12582912.0f;  // 1.5 2^23 leaves no fraction bits, and n in the lowest
    const vfloat f = y - (n - 12582912.0f);
    vfloat p = f * 1.535336188319500e-4f + 1.339887440266574e-3f;
    p = p * f + 9.618437357674640e-3f;
    p = p * f + 5.550332471162809e-2f;
    p = p * f + 2.402264791363012e-1f;
    p = p * f + 6.931472028550421e-1f;
    p = p * f + 1.0f;
    gain *= (vfloat)((vint)p + ((vint)n << 23));
    rgb[0] *= __builtin_shufflevector(gain, gain, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5);
    rgb[1] *= __builtin_shufflevector(gain, gain, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8, 9, 9, 9, 10, 10);
    rgb[2] *= __builtin_shufflevector(gain, gain, 10, 11, 11, 11, 12, 12, 12, 13, 13, 13, 14, 14, 14, 15, 15, 15);
    copy(out.data + 3 * start, rgb, 3 * sizeof(float), count);
"""
)
def light_pixels(
    block: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    around: wp.array[float],
    distance: float,
    reference: float,
    nearest: float,
    out: wp.array[float],
): ...


@wp.kernel
def light_picture(
    first: int,
    colors: wp.array[float],
    depths: wp.array[float],
    alphas: wp.array[float],
    around: wp.array[float],
    distance: float,
    reference: float,
    nearest: float,
    out: wp.array[float],
):
    light_pixels(first + wp.tid(), colors, depths, alphas, around, distance, reference, nearest, out)


@wp.func_native(
    """
    #pragma clang fp contract(off)  // rounds like torch
    """
    + _TYPES
    + """
    typedef unsigned char vbyte __attribute__((vector_size(16)));
    const size_t count = (size_t)values.shape[0] - start;
    vfloat x{};
    copy(&x, values.data + start, sizeof(float), count);
    x = x > 0.0f ? x : vfloat{};
    x = x < 1.0f ? x : vfloat{} + 1.0f;
    const vbyte bytes = __builtin_convertvector(__builtin_convertvector(x * 255.0f + 0.5f, vint), vbyte);
    copy(out.data + start, &bytes, 1, count);
"""
)
def round_values(block: int, values: wp.array[float], out: wp.array[wp.uint8]): ...


@wp.kernel
def to_bytes(first: int, values: wp.array[float], out: wp.array[wp.uint8]):
    round_values(first + wp.tid(), values, out)
