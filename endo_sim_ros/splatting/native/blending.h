// Compositing of splats, front to back, and its gradients, for one pixel (F = float) or for 16 of them (F = vfloat).
// `common_kernels.py` has the formulas and defines the terms.
#pragma once
#include "core/native/glints.h"
#include "core/native/lanes.h"

namespace endo_sim {

constexpr int TILE = 16;
constexpr float ALPHA_MIN = 1.0f / 255.0f, ALPHA_MAX = 0.999f, TRANSMITTANCE_MIN = 1e-4f, MEDIAN = 0.5f;
constexpr float LOG_ALPHA_SLACK = 0.01f, PIXEL_SLACK = 0.01f;

// A row of `splats`, as its columns.
struct Splat {
    float x, y, a, b, c, opacity, z, red, green, blue, extent_x, extent_y, aspect_x, aspect_y, shear_x, shear_y;
};
constexpr int SPLAT_SIZE = sizeof(Splat) / sizeof(float);

constexpr int EXTRAS = 4;  // numbers that splats may have beside a colour

// A row of `records`.
struct Record {
    float x, y, a, b, c, opacity, z, red, green, blue, absolute_x, absolute_y, extras[EXTRAS];
};
constexpr int RECORD_SIZE = sizeof(Record) / sizeof(float);

// Extras are null where splats have none, or are films whose glints are added to colours as light.
struct Images {
    float *colors, *depths, *alphas, *distortions, *extras;
};

struct ConstImages {
    const float *colors, *depths, *alphas, *distortions, *extras;
};

// Of what makes pixels finish, a product and a sum must round alike in both passes: they have to draw the same splats.
// Clang fuses within a statement wherever that is inlined; other compilers are told.
#if defined(__CUDA_ARCH__)

ENDO_SIM_INLINE float minus_product(float a, float b, float c) { return __fmaf_rn(-a, b, c); }

ENDO_SIM_INLINE float divide(float x, float y) { return __fdividef(x, y); }

// exp(-sigma) at an offset from the mean (pixels), to a few units in the last place. Sigma as a sum of squares: far from
// the mean of a needle the terms of the other form cancel.
ENDO_SIM_INLINE float falloff(float dx, float dy, float a, float shear, float aspect)
{
    const float run = __fmaf_rn(shear, dy, dx), rise = __fmul_rn(aspect, dy);
    return __expf(__fmul_rn(__fmul_rn(-0.5f, a), __fmaf_rn(run, run, __fmul_rn(rise, rise))));
}

#else

// c - a b.
template <class F> ENDO_SIM_INLINE F minus_product(F a, F b, F c)
{
    ENDO_SIM_FUSE(on)
    return c - a * b;
}

template <class F> ENDO_SIM_INLINE F divide(F x, F y) { return x / y; }

template <class F> ENDO_SIM_INLINE F falloff(F dx, float dy, float a, float shear, float aspect)
{
    ENDO_SIM_FUSE(on)
    const float rise = aspect * dy, slope = shear * dy;
    const F run = dx + slope;
    const F exponent = -0.5f * 1.44269504f * a * (run * run + rise * rise);
    return exp2<true>(exponent < FAINTEST ? F{} + FAINTEST : exponent);
}

#endif

template <class F> ENDO_SIM_INLINE F limited(F alpha) { return alpha < ALPHA_MAX ? alpha : F{} + ALPHA_MAX; }

template <class F> struct Layer {
    F before, after, weight;  // transmittances T_i and T_{i+1}, and alpha_i T_i
    decltype(F{} < F{}) ends;  // whether it finishes the pixel, or finds it finished
};

// Let light through a splat. A pixel whose transmittance would drop below the least one is finished, which its sign tells.
template <class F> ENDO_SIM_INLINE Layer<F> pass(F& transmittance, F alpha)
{
    const F before = transmittance;
    const F after = minus_product(before, alpha, before);
    const auto ends = after < TRANSMITTANCE_MIN;  // always true of a finished pixel
    const F weight = ends ? F{} : before * alpha;
    transmittance = ends ? negative(before) : after;
    return {before, after, weight, ends};
}

// What pixels have gathered from the splats so far. Depths are relative to the first splat of the tile.
template <class F> struct Pixel {
    F transmittance, depth, distortion, red, green, blue;

    ENDO_SIM_INLINE Layer<F> add(F alpha, float z, float splat_red, float splat_green, float splat_blue)
    {
        ENDO_SIM_FUSE(on)
        const Layer<F> layer = pass(transmittance, alpha);
        const F weight = layer.weight;
        distortion += 2.0f * weight * (z * (1.0f - layer.before) - depth);
        depth += weight * z;
        red += weight * splat_red;
        green += weight * splat_green;
        blue += weight * splat_blue;
        return layer;
    }
};

// What a splat of a weight adds to the extras of pixels.
template <class F> ENDO_SIM_INLINE void add_extras(F* sums, F weight, const float* extras)
{
    ENDO_SIM_FUSE(on)
    for (int k = 0; k < EXTRAS; ++k)
        sums[k] += weight * extras[k];
}

// The sum of a splat's extras, each times the gradient of its image.
template <class F> ENDO_SIM_INLINE F gradient_of_extras(const F* v_extras, const float* extras)
{
    ENDO_SIM_FUSE(on)
    F total{};
    for (int k = 0; k < EXTRAS; ++k)
        total += v_extras[k] * extras[k];
    return total;
}

// Whether the transmittance reaches a half here. One splat does not finish a pixel above that, as ALPHA_MAX is below 1.
template <class F> ENDO_SIM_INLINE auto crosses_median(const Layer<F>& layer)
{
    return (layer.before > MEDIAN) & (layer.after <= MEDIAN);
}

// What pixels show in the end, over a background.
template <class F> struct Shown {
    F red, green, blue, depth, alpha;
};

template <class F> ENDO_SIM_INLINE Shown<F> shown(const Pixel<F>& pixel, const float* background, float reference)
{
    ENDO_SIM_FUSE(on)
    const F seen_through = absolute(pixel.transmittance), alpha = 1.0f - seen_through;
    return {pixel.red + seen_through * background[0], pixel.green + seen_through * background[1],
        pixel.blue + seen_through * background[2], pixel.depth + reference * alpha, alpha};
}

// What pixels of a row show of a film with the sums `extras`.
template <class F>
ENDO_SIM_INLINE void add_glint(Shown<F>& seen, const GlintLenses& lenses, int camera, F column, float row, const F* extras)
{
    const F white = SeenFilm<F>(lenses, camera, column, row, extras, seen.alpha).glint(extras[EXTRAS - 1]);
    seen.red = with_light(seen.red, white);
    seen.green = with_light(seen.green, white);
    seen.blue = with_light(seen.blue, white);
}

// Write one pixel's images.
ENDO_SIM_INLINE void finish(const Pixel<float>& pixel, const Shown<float>& seen, size_t index, const Images& images)
{
    images.colors[3 * index] = seen.red;
    images.colors[3 * index + 1] = seen.green;
    images.colors[3 * index + 2] = seen.blue;
    images.depths[index] = seen.depth;
    images.alphas[index] = seen.alpha;
    images.distortions[index] = pixel.distortion;
}

// Gradients of the pixels' images, their totals W and D, what is left of S = sum of w_i g_i, and T_i and D_i so far.
template <class F> struct PixelGradient {
    F v_red, v_green, v_blue, v_depth, v_alpha, twice_v_distortion;
    F total_weight, total_depth, remaining, transmittance, depth;

    struct Share {
        F weight;  // w_i; times v_red, v_green and v_blue the gradient of the colour
        F v_z_by_weight;
        F minus_v_alpha;  // of alpha before it is limited
        decltype(F{} < F{}) ends;
    };

    ENDO_SIM_INLINE Share add(F splat_alpha, float z, float red, float green, float blue, F v_extras)
    {
        ENDO_SIM_FUSE(on)
        const Layer<F> layer = pass(transmittance, splat_alpha);
        const F weight = layer.weight;
        const F spread = 2.0f - layer.before - layer.after - total_weight;  // W_i + W_{i+1} - W
        const F new_depth = depth + weight * z;
        const F v_weight = v_red * red + v_green * green + v_blue * blue + v_depth * z + v_alpha + v_extras
            + twice_v_distortion * (z * spread + total_depth - depth - new_depth);
        depth = new_depth;
        const F rest = remaining - weight * v_weight;
        remaining = rest;
        const F minus_v_alpha = divide(rest, 1.0f - splat_alpha) - layer.before * v_weight;
        return {weight, v_depth + twice_v_distortion * spread, minus_v_alpha, layer.ends};
    }
};

// The tile of a picture of the cameras one below the other.
struct Place {
    int camera, column0, row0;  // its first pixel
    size_t pixel0;  // index of that
    size_t pixels;  // of a camera

    ENDO_SIM_INLINE Place(int tile, int width, int height)
    {
        const int tiles_x = (width + TILE - 1) / TILE, tiles_y = (height + TILE - 1) / TILE;
        camera = tile / (tiles_x * tiles_y);
        column0 = tile % tiles_x * TILE;
        row0 = tile / tiles_x % tiles_y * TILE;
        pixels = (size_t)height * width;
        pixel0 = ((size_t)camera * height + row0) * width + column0;
    }

    // From the index of a pixel to the number k of its extras: each camera has a plane for each.
    ENDO_SIM_INLINE size_t plane(int k) const { return ((EXTRAS - 1) * (size_t)camera + k) * pixels; }
};

// A pixel before its first splat, on the way back.
ENDO_SIM_INLINE PixelGradient<float> begin(size_t index, const Place& place, const float* background, float reference,
    const ConstImages& images, const ConstImages& v_images)
{
    ENDO_SIM_FUSE(on)
    const float *v_color = v_images.colors + 3 * index, *color = images.colors + 3 * index;
    const float weight = images.alphas[index], seen_through = 1.0f - weight;
    const float depth = images.depths[index] - reference * weight;
    const float vd = v_images.depths[index], vl = 2.0f * v_images.distortions[index];
    // The background is seen through the transmittance 1 - alpha, and depths count from the reference.
    float va = v_images.alphas[index] + vd * reference, rest = vd * depth + vl * images.distortions[index];
    for (int k = 0; k < 3; ++k) {
        va -= v_color[k] * background[k];
        rest += v_color[k] * (color[k] - seen_through * background[k]);
    }
    for (int k = 0; images.extras && k < EXTRAS; ++k)
        rest += v_images.extras[place.plane(k) + index] * images.extras[place.plane(k) + index];
    return {v_color[0], v_color[1], v_color[2], vd, va, vl, weight, depth, rest + va * weight, 1.0f, 0.0f};
}

// Ask a CPU's memory for what is needed soon, from places that it cannot guess.
ENDO_SIM_INLINE void prefetch([[maybe_unused]] const void* address)
{
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(address);
#endif
}

template <class F> struct Span {
    F low, high;
};

// From where to where an ellipse reaches along one axis between two places on the other, all relative to its centre:
// at place d it spans -shear d -+ aspect sqrt(extent^2 - d^2), and reaches highest at d = widest.
template <class F> ENDO_SIM_INLINE Span<F> ellipse_span(F center, F low, F high, F widest, F shear, F aspect, F extent)
{
    ENDO_SIM_FUSE(on)
    const F at_high = widest < low ? low : widest > high ? high : widest;
    const F at_low = -widest < low ? low : -widest > high ? high : -widest;
    const F square = extent * extent;
    const F under = square - at_low * at_low, over = square - at_high * at_high;
    return {center - shear * at_low - aspect * root(larger(under, F{})), center - shear * at_high + aspect * root(larger(over, F{}))};
}

}  // namespace endo_sim
