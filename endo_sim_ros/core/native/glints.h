// Glints of pixels and their gradients: of one pixel on a GPU, of 16 of a row on a CPU; `glint_kernels.py` has the formula.
#pragma once
#include "core/native/lanes.h"

namespace endo_sim {

constexpr float LEAST_ALPHA = 1e-3f;  // fainter tissue has no normal

// A colour with more light, as both are in encoded images: roughly the square root of light.
template <class F> ENDO_SIM_INLINE F with_light(F color, F light)
{
    ENDO_SIM_FUSE(on)
    return root(color * color + light);
}

#if defined(__CUDA_ARCH__)
typedef float Pixels;
constexpr int PIXELS = 1;
ENDO_SIM_INLINE Pixels columns_from(int first) { return first + 0.5f; }
ENDO_SIM_INLINE void copy_pixels(void* to, const void* from, int) { *(float*)to = *(const float*)from; }
ENDO_SIM_INLINE void add_to_colors(float* colors, Pixels white, int)
{
    for (int k = 0; k < 3; ++k)
        colors[k] = with_light(colors[k], white);
}
#else
typedef vfloat Pixels;
constexpr int PIXELS = LANE_COUNT;
ENDO_SIM_INLINE Pixels columns_from(int first)
{
    const vfloat lanes = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    return lanes + (first + 0.5f);
}
ENDO_SIM_INLINE void copy_pixels(void* to, const void* from, int count) { copy_items(to, from, sizeof(float), count); }
ENDO_SIM_INLINE void add_to_colors(float* colors, Pixels white, int count)
{
    vfloat threes[3]{}, whites[3];
    interleave(white, white, white, whites);
    copy_items(threes, colors, 3 * sizeof(float), count);
    for (int k = 0; k < 3; ++k)
        threes[k] = with_light(threes[k], whites[k]);
    copy_items(colors, threes, 3 * sizeof(float), count);
}
#endif

// Of the cameras: world to camera [C, 4, 4] and intrinsics [C, 3, 3], and the sharpness of glints, below 0 where there are none.
struct GlintLenses {
    const float *viewmats, *Ks;
    float sharpness;
};

// The film that pixels see.
template <class F> struct SeenFilm {
    F normal[3], off[3], alpha, lobe;  // the mean normal, and how far it is from the direction to the lens, world

    // Column and row are those of the pixels' centres, sums are Σ w n, and Σ w.
    ENDO_SIM_INLINE SeenFilm(const GlintLenses& lenses, int camera, F column, float row, const F* sums, F opacity)
    {
        ENDO_SIM_FUSE(on)
        const float *K = lenses.Ks + 9 * camera, *R = lenses.viewmats + 16 * camera;
        const F x = (column - K[2]) / K[0];
        const float y = (row - K[5]) / K[4];
        const auto thin = opacity < LEAST_ALPHA;
        alpha = thin ? F{} + 1.0f : opacity;
        const F inverse = 1.0f / root(x * x + y * y + 1.0f);
        F squares{};
        for (int k = 0; k < 3; ++k) {
            normal[k] = sums[k] / alpha;
            off[k] = normal[k] + (x * R[k] + y * R[4 + k] + R[8 + k]) * inverse;
            squares += off[k] * off[k];
        }
        const F exponent = (-0.5f * 1.44269504f) * lenses.sharpness * squares;
        const F shape = exp2<true>(exponent < FAINTEST ? F{} + FAINTEST : exponent);
        lobe = thin ? F{} : shape;
    }

    // The light of a strength Σ w s. Before black, tissue that covers a part a of the pixel is as bright as a whole pixel of it, times a.
    ENDO_SIM_INLINE F glint(F strength) const { return alpha * strength * lobe; }
};

// Pictures of cameras that films were drawn in.
struct FilmImages {
    int width, height;
    const float *films, *alphas;  // [C, 4, H, W], [C, H, W]
};

// Neighbouring pixels of such pictures, and what they hold.
struct FilmPixels {
    int camera, column, row, count;
    size_t first, films, plane;  // indices of the first pixel, and of its film; from one number of a film to the next
    Pixels sums[4], alpha;

    // Item i has the pixels from PIXELS i on, in rows that are padded to whole items.
    ENDO_SIM_INLINE FilmPixels(int item, const FilmImages& images)
    {
        const int items = (images.width + PIXELS - 1) / PIXELS;
        column = item % items * PIXELS, row = item / items % images.height, camera = item / items / images.height;
        plane = (size_t)images.height * images.width;
        first = camera * plane + (size_t)row * images.width + column;
        films = first + 3 * camera * plane;
        count = images.width - column < PIXELS ? images.width - column : PIXELS;
        alpha = Pixels{};
        copy_pixels(&alpha, images.alphas + first, count);
        for (int k = 0; k < 4; ++k) {
            sums[k] = Pixels{};
            copy_pixels(&sums[k], images.films + films + k * plane, count);
        }
    }

    ENDO_SIM_INLINE SeenFilm<Pixels> seen(const GlintLenses& lenses) const
    {
        return {lenses, camera, columns_from(column), row + 0.5f, sums, alpha};
    }
};

// Add glints to colors [C, H, W, 3].
ENDO_SIM_INLINE void add_glints(int item, const FilmImages& images, const GlintLenses& lenses, float* colors)
{
    const FilmPixels pixels(item, images);
    add_to_colors(colors + 3 * pixels.first, pixels.seen(lenses).glint(pixels.sums[3]), pixels.count);
}

// Write the gradients of films and opacities from those of the light that was added.
ENDO_SIM_INLINE void glint_gradients(
    int item, const FilmImages& images, const GlintLenses& lenses, const float* v_light, float* v_films, float* v_alphas)
{
    ENDO_SIM_FUSE(on)
    const FilmPixels pixels(item, images);
    const SeenFilm<Pixels> seen = pixels.seen(lenses);
    Pixels v{};
    copy_pixels(&v, v_light + pixels.first, pixels.count);
    const Pixels v_strength = v * seen.glint(Pixels{} + 1.0f), by_off = -lenses.sharpness * v_strength * pixels.sums[3] / seen.alpha;
    Pixels v_alpha = v * seen.lobe * pixels.sums[3];
    for (int k = 0; k < 3; ++k) {
        const Pixels v_normal = by_off * seen.off[k];
        v_alpha -= v_normal * seen.normal[k];
        copy_pixels(v_films + pixels.films + k * pixels.plane, &v_normal, pixels.count);
    }
    copy_pixels(v_alphas + pixels.first, &v_alpha, pixels.count);
    copy_pixels(v_films + pixels.films + 3 * pixels.plane, &v_strength, pixels.count);
}

}  // namespace endo_sim
