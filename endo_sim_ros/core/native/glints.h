// Glints of pixels and their gradients: of one pixel on a GPU, of 16 of a row on a CPU; `glint_kernels.py` has the formula.
#pragma once
#include "core/native/vector.h"

namespace endo_sim {

constexpr float LEAST_ALPHA = 1e-3f;  // fainter tissue has no normal

#if defined(__CUDA_ARCH__)
typedef float Pixels;
constexpr int PIXELS = 1;
ENDO_SIM_INLINE Pixels columns_from(int first) { return first + 0.5f; }
ENDO_SIM_INLINE void copy_pixels(void* to, const void* from, int) { *(float*)to = *(const float*)from; }
ENDO_SIM_INLINE void add_to_colors(float* colors, Pixels white, int)
{
    for (int k = 0; k < 3; ++k)
        colors[k] += white;
}
#else
typedef vfloat Pixels;
constexpr int PIXELS = 16;
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
        threes[k] += whites[k];
    copy_items(colors, threes, 3 * sizeof(float), count);
}
#endif

// Pictures of cameras that films were drawn in.
struct FilmImages {
    int width, height;
    const float *films, *alphas, *viewmats, *Ks;  // [C, 4, H, W], [C, H, W], [C, 4, 4], [C, 3, 3]
};

// The films that neighbouring pixels see.
struct SeenFilms {
    size_t first, films, plane;  // indices of the first pixel, and of its film; from one number of a film to the next
    int count;
    Pixels tilt[3], strength, alpha, lobe;  // the normal's part across the ray, world; lobe is 0 where it turns away

    // Item i has the pixels from PIXELS i on, in rows that are padded to whole items.
    ENDO_SIM_INLINE SeenFilms(int item, const FilmImages& images, float sharpness)
    {
        ENDO_SIM_FUSE(on)
        const int items = (images.width + PIXELS - 1) / PIXELS, column = item % items * PIXELS;
        const int row = item / items % images.height, camera = item / items / images.height;
        plane = (size_t)images.height * images.width;
        first = camera * plane + (size_t)row * images.width + column;
        films = first + 3 * camera * plane;
        count = images.width - column < PIXELS ? images.width - column : PIXELS;
        const float *K = images.Ks + 9 * camera, *R = images.viewmats + 16 * camera;
        const Pixels x = (columns_from(column) - K[2]) / K[0];
        const float y = (row + 0.5f - K[5]) / K[4];
        alpha = strength = Pixels{};
        copy_pixels(&alpha, images.alphas + first, count);
        copy_pixels(&strength, images.films + films + 3 * plane, count);
        const auto thin = alpha < LEAST_ALPHA;
        alpha = thin ? Pixels{} + 1.0f : alpha;
        Pixels ray[3], along{}, squares{};
        for (int k = 0; k < 3; ++k) {
            Pixels sum{};
            copy_pixels(&sum, images.films + films + k * plane, count);
            tilt[k] = sum / alpha;
            ray[k] = x * R[k] + y * R[4 + k] + R[8 + k];
            along += tilt[k] * ray[k];
        }
        const auto away = along > 0.0f;
        along = along / (x * x + y * y + 1.0f);
        for (int k = 0; k < 3; ++k) {
            tilt[k] -= along * ray[k];
            squares += tilt[k] * tilt[k];
        }
        const Pixels exponent = (-0.5f * 1.44269504f) * sharpness * squares;
        const Pixels shape = exp2<true>(exponent < -126.0f ? Pixels{} - 126.0f : exponent);
        lobe = thin | away ? Pixels{} : shape;
    }
};

// Add glints to colors [C, H, W, 3].
ENDO_SIM_INLINE void add_glints(int item, const FilmImages& images, float sharpness, float* colors)
{
    const SeenFilms seen(item, images, sharpness);
    add_to_colors(colors + 3 * seen.first, seen.strength * seen.lobe, seen.count);
}

// Write the gradients of films and opacities from those of colours.
ENDO_SIM_INLINE void glint_gradients(
    int item, const FilmImages& images, float sharpness, const float* v_colors, float* v_films, float* v_alphas)
{
    ENDO_SIM_FUSE(on)
    const SeenFilms seen(item, images, sharpness);
    Pixels v{};
    for (int i = 0; i < seen.count; ++i)
        for (int k = 0; k < 3; ++k)
            ((float*)&v)[i] += v_colors[3 * (seen.first + i) + k];
    const Pixels v_strength = v * seen.lobe, by_tilt = -sharpness * v_strength * seen.strength / seen.alpha;
    Pixels v_alpha{};
    for (int k = 0; k < 3; ++k) {
        const Pixels v_normal = by_tilt * seen.tilt[k];
        v_alpha -= v_normal * seen.tilt[k];
        copy_pixels(v_films + seen.films + k * seen.plane, &v_normal, seen.count);
    }
    copy_pixels(v_alphas + seen.first, &v_alpha, seen.count);
    copy_pixels(v_films + seen.films + 3 * seen.plane, &v_strength, seen.count);
}

}  // namespace endo_sim
