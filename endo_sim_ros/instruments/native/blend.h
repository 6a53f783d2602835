// Pixels in which instruments and tissue meet, lit and in each other's shadow: one (float), or 16 of a row (vfloat) of a CPU.
// `Frame` is that of drawing_kernels.py and `Look` that of resolving_kernels.py. Lengths are metres, in the camera's frame.
#pragma once
#include "instruments/native/cover.h"
#include "instruments/native/metal.h"

namespace endo_sim {

constexpr long long EMPTY = 0x7fffffffffffffff;  // what a sample is where nothing is drawn
constexpr float SURFACE = 0.5f;  // alpha above which a pixel shows tissue
constexpr float FAR = 1e9f;
constexpr float ALIKE = 0.99f;  // cosine of the angle between normals that are lit as one
constexpr float METAL = 0.1f;  // share of light that is mirrored: above it a surface is metal, below it mirrors a mean
constexpr float BUMP = 0.03f;  // of normals: how uneven metal is
constexpr float BRUSHED = 0.7f;  // part of the slope of facets along the axis of metal that does not count: it is brushed around that
constexpr float DEEP = 0.4f, SHALLOW = 0.88f;  // radii of capsules: gaps of joints lie within these, and are dark

// One of B pictures, and what is drawn into it.
template <class Frame, class Look> struct Scene {
    const Frame& frame;
    const Look& look;
    const float* view;  // fx fy cx cy, the lamp, the exponent of the falloff of its light, and the brightest shine
    const float* surfaces;  // [M, 5] red, green and blue of what is scattered, roughness, and share of light that is mirrored
    int picture;
    Capsules capsules;
    Lamp lamp;

    ENDO_SIM_INLINE Scene(const Frame& frame, const Look& look, int picture, const float* surfaces, const Ends* ends, const float* views)
        : frame(frame), look(look), view(views + 9 * picture), surfaces(surfaces + 5 * picture * frame.surfaces), picture(picture),
          capsules{ends + picture * frame.capsules, frame.radii.data, frame.capsule_owners.data, frame.capsules},
          lamp{{view[4], view[5], view[6]}, look.lamp_size}
    {
    }

    ENDO_SIM_INLINE size_t pixel(int row, int column) const { return ((size_t)picture * frame.height + row) * frame.width + column; }

    template <class F> ENDO_SIM_INLINE void point(F column, float row, F z, F* at) const
    {
        ENDO_SIM_FUSE(on)
        at[0] = (column + 0.5f - view[2]) / view[0] * z;
        at[1] = (row + 0.5f - view[3]) / view[1] * z;
        at[2] = z;
    }
};

ENDO_SIM_INLINE float depth_of(long long key) { return 1.0f / of_bits(0x7fffffff - (int)(key >> 32)); }

// Pictures are gamma-compressed; a root is near enough to 1/2.2, and fast.
template <class F> ENDO_SIM_INLINE F encoded(F light) { return root(larger(light, F{})); }

template <class F> ENDO_SIM_INLINE void normalize(const F* a, F* unit)
{
    ENDO_SIM_FUSE(on)
    const F scale = 1.0f / larger(length(a), everywhere<F>(1e-20f));
    for (int k = 0; k < 3; ++k)
        unit[k] = scale * a[k];
}

// ---------------------------------------------------------------- light

// Of points of instruments all that their light depends on: numbers of four bytes only, a vector of each on a CPU.
template <class F> struct Points {
    F at[3], normal[3];
    F on[3];  // in the frame of the link; of metal alone
    F diffuse[3], roughness, strength;  // of the surface
    integers_of<F> owner;  // number of the instrument
};

// How far the normal of metal is off where it is worked and wet, from -1 to 1 each way, at a point in the frame of its link.
// Sines of sines, over two to six millimetres: irregular enough for the eye, and cheap.
template <class F> ENDO_SIM_INLINE void uneven(const F* at, F* off)
{
    ENDO_SIM_FUSE(on)
    const F x = 1e3f * at[0], y = 1e3f * at[1], z = 1e3f * at[2];
    off[0] = sine(1.1f * x + 0.9f * y - 0.7f * z);
    off[1] = sine(0.8f * z - 1.3f * x + 1.2f * y + 1.5f * off[0]);
    off[2] = sine(HALF_PI + z - 0.9f * y + 1.4f * x + 1.5f * off[1]);
}

// Colours of points: diffuse, a microfacet lobe (GGX) of their roughness, and what they mirror (Fresnel by Schlick).
template <class F, class Frame, class Look> ENDO_SIM_INLINE void light_points(const Scene<Frame, Look>& scene,
    unsigned long long on_links,  // capsules that may keep light from them
    const Points<F>& points, F* color)
{
    ENDO_SIM_FUSE(on)
    const Look& look = scene.look;
    const float *lamp = scene.lamp.at, *around = (const float*)scene.frame.around.data + 3 * scene.picture;
    const F none{}, one = everywhere<F>(1.0f), *at = points.at;
    const F back[3]{-at[0], -at[1], -at[2]}, way[3]{lamp[0] - at[0], lamp[1] - at[1], lamp[2] - at[2]};
    F to_eye[3], to_lamp[3], middle[3], normal[3]{points.normal[0], points.normal[1], points.normal[2]};
    normalize(back, to_eye);
    normalize(way, to_lamp);
    const F sum[3]{to_eye[0] + to_lamp[0], to_eye[1] + to_lamp[1], to_eye[2] + to_lamp[2]};
    normalize(sum, middle);
    Left<F> left{one, one};
    if (on_links)
        left = light_left(on_links, at, normal, 0.5f * at[2] / scene.view[0], scene.lamp, scene.capsules, points.owner);
    F image[3];
    for (int k = 0; k < 3; ++k)
        image[k] = everywhere<F>(look.ambient * around[k]);
    const auto metal = points.strength > METAL;
    if (any(metal)) {
        F off[3], facet[3], seen[3];
        uneven(points.on, off);
        for (int k = 0; k < 3; ++k)
            off[k] = normal[k] + (metal ? BUMP * off[k] : none);
        normalize(off, facet);
        const F twice = 2.0f * product(facet, to_eye);
        const F bounced[3]{twice * facet[0] - to_eye[0], twice * facet[1] - to_eye[1], twice * facet[2] - to_eye[2]};
        mirrored({scene.view, (const Cell*)scene.frame.cells.data + scene.picture * CELLS * CELLS, scene.frame.width, scene.frame.height},
            bounced, at, seen);
        const Within<F> within = deepest(at, scene.capsules, points.owner);
        const F open = clamp((within.away - DEEP) / (SHALLOW - DEEP), 0.3f, 1.0f), gap = metal ? open * open : one;
        left = {left.seen * gap, left.open * gap};
        const F from[3]{middle[0] - facet[0], middle[1] - facet[1], middle[2] - facet[2]};
        const F slope = metal ? BRUSHED * product(from, within.axis) : none;
        F brushed[3];
        for (int k = 0; k < 3; ++k) {
            normal[k] = metal ? facet[k] : normal[k];
            image[k] = metal ? seen[k] : image[k];
            brushed[k] = middle[k] - slope * within.axis[k];
        }
        normalize(brushed, middle);
    }
    const F facing = larger(product(normal, to_lamp), none) * left.seen, aligned = larger(product(normal, middle), none);
    const F rough = points.roughness * points.roughness, spread = rough * rough, steep = aligned * aligned * (spread - 1.0f) + 1.0f;
    const F lobe = smaller(0.25f * spread / (steep * steep), everywhere<F>(1e3f)) * facing;
    const F straight = larger(product(normal, to_eye), none), aside = 1.0f - straight, squared = aside * aside;
    const F fresnel = points.strength + larger(1.0f - rough - points.strength, none) * squared * squared * aside;
    // What a rough surface mirrors at a grazing angle hides itself (Smith).
    const F smith = 2.0f * straight / (straight + root(spread + (1.0f - spread) * straight * straight));
    const F strength = fresnel * look.mirror * left.open * smith;
    for (int k = 0; k < 3; ++k) {
        const F diffuse = points.diffuse[k] * ((1.0f - look.ambient) * facing + look.ambient * around[k] * left.open);
        const F shine = points.strength * (1.0f - look.ambient) * lobe + strength * image[k];
        color[k] = smaller(encoded(diffuse + shine), everywhere<F>(scene.view[8]));
    }
}

// ---------------------------------------------------------------- samples

// What the samples of pixels see that are not in the tissue.
template <class F> struct Seen {
    F total, color[3];  // sums
    F depth, count;  // sums of the link that is nearest
    integers_of<F> link, middle;  // middle is not 0 where a triangle covers the middle of a pixel
};

// Look at the samples of a pixel, and take them out of the frame. `light.start` takes each point that has a colour of its own, and
// `light.add` what a sample counts, which sees the last of these.
template <class Frame, class Look, class Light>
ENDO_SIM_INLINE Seen<float> see(const Scene<Frame, Look>& scene, int row, int column, float tissue, Light& light)
{
    ENDO_SIM_FUSE(on)
    const Frame& frame = scene.frame;
    const size_t pixel = scene.pixel(row, column);
    long long* samples = frame.samples.data + SAMPLES * pixel;
    Seen<float> found{};
    found.link = -1;
    found.middle = frame.middles.data[pixel];
    if (found.middle)
        frame.middles.data[pixel] = 0;
    float nearest = FAR, normal[3]{};
    int before = -1, material = -1;
    for (int sample = 0; sample < SAMPLES; ++sample) {
        const long long key = samples[sample];
        if (key == EMPTY)
            continue;
        samples[sample] = EMPTY;
        const int face = (int)key;
        const float z = depth_of(key), seen = clamp(0.5f + (tissue - z) / scene.look.softness, 0.0f, 1.0f);
        if (!(seen > 0.0f))
            continue;
        if (face != before) {
            before = face;
            const Offset beside = offset(sample, row, column, frame.spread);
            const float across = column + beside.u, down = row + beside.v;
            const int first = 3 * (scene.picture * frame.faces + face);
            const float *screen = (const float*)(frame.screen.data + first), *turned = (const float*)(frame.turned.data + first);
            const float *a = screen, *b = screen + 3, *c = screen + 6;
            const float w[3]{((b[0] - across) * (c[1] - down) - (b[1] - down) * (c[0] - across)) * a[2],
                ((c[0] - across) * (a[1] - down) - (c[1] - down) * (a[0] - across)) * b[2],
                ((a[0] - across) * (b[1] - down) - (a[1] - down) * (b[0] - across)) * c[2]};
            Points<float> point;
            float bent[3];
            for (int k = 0; k < 3; ++k)
                bent[k] = -w[0] * turned[k] - w[1] * turned[3 + k] - w[2] * turned[6 + k];
            const float along = product(bent, normal);
            // Light costs more than all else: what lies as the sample before has its colour.
            if (along * fabsf(along) < ALIKE * ALIKE * product(bent, bent) || frame.materials.data[face] != material) {
                normalize(bent, point.normal);
                material = frame.materials.data[face];
                const float* surface = scene.surfaces + 5 * material;
                const float *corners = (const float*)(frame.corners.data + 3 * face), all = w[0] + w[1] + w[2];
                for (int k = 0; k < 3; ++k) {
                    normal[k] = point.normal[k];
                    point.on[k] = surface[4] > METAL ? (w[0] * corners[k] + w[1] * corners[3 + k] + w[2] * corners[6 + k]) / all : 0.0f;
                    point.diffuse[k] = surface[k];
                }
                point.roughness = surface[3];
                point.strength = surface[4];
                point.owner = frame.owners.data[face];
                scene.point((float)column, (float)row, z, point.at);
                light.start(point);
            }
        }
        light.add(seen);
        found.total += seen;
        const int link = frame.face_links.data[face];
        if (z < nearest && link != found.link) {
            found.link = link;
            found.depth = found.count = 0.0f;
        }
        if (link == found.link) {
            found.depth += z;
            found.count += 1.0f;
        }
        nearest = smaller(nearest, z);
    }
    return found;
}

// Lights one point at a time.
template <class Frame, class Look> struct DirectLight {
    const Scene<Frame, Look>& scene;
    unsigned long long on_links;
    float count, color[3], sum[3];

    ENDO_SIM_INLINE void start(const Points<float>& point)
    {
        finish();
        light_points(scene, on_links, point, color);
        count = 0.0f;
    }

    ENDO_SIM_INLINE void add(float seen) { count += seen; }

    ENDO_SIM_INLINE void finish()
    {
        ENDO_SIM_FUSE(on)
        for (int k = 0; k < 3; ++k)
            sum[k] += count * color[k];
    }
};

// ---------------------------------------------------------------- pixels

// The pictures that instruments come into.
struct Images {
    float *colors, *depths, *alphas;  // depths are Σ w z
    unsigned char* labels;
};

// Put what is seen of instruments into neighbouring pixels of a row, and their tissue into the shadow of instruments.
template <class F, class Frame, class Look> ENDO_SIM_INLINE void blend(const Scene<Frame, Look>& scene, int row, int column, int count,
    unsigned long long on_tissue,  // capsules that may keep light from the tissue here
    const Seen<F>& seen, const Images& images)
{
    ENDO_SIM_FUSE(on)
    const size_t pixel = scene.pixel(row, column);
    const F none{}, one = everywhere<F>(1.0f);
    const F alpha = load<F>(images.alphas + pixel, count), metres = load<F>(images.depths + pixel, count);
    const F share = seen.total / (float)SAMPLES, kept = 1.0f - share;
    const auto some = seen.total > 0.0f;
    const auto shows = (alpha > SURFACE) & (kept > 0.0f);
    const F tissue = shows ? metres / (shows ? alpha : one) : one;
    integers_of<F> label = alpha > SURFACE ? integers_of<F>{} + 1 : integers_of<F>{};
    F by = one, more[3]{};
    if (on_tissue && any(shows)) {
        F at[3], normal[3];
        scene.point(ramp<F>() + (float)column, (float)row, tissue, at);
        const F back[3]{-at[0], -at[1], -at[2]};
        normalize(back, normal);
        const Left<F> left
            = light_left(on_tissue, at, normal, 0.5f * tissue / scene.view[0], scene.lamp, scene.capsules, integers_of<F>{} - 1);
        by = shows ? encoded((1.0f - scene.look.ambient) * left.seen + scene.look.ambient * left.open) : one;
    }
    if (any(some)) {
        const F covered = kept * alpha + share, depth = seen.depth / (some ? seen.count : one);
        F darker = one;  // light on the tissue, as part of that on the instrument
        if (scene.view[7] != 0.0f && any(some & shows))
            darker = some & shows ? power(depth / tissue, scene.view[7]) : one;
        // Colours blend at outlines. Halfway between two surfaces there is none: the depth is that of what the label tells. The light will
        // take all of the pixel to be so deep, hence the colour of the other surface takes the difference.
        // Samples lie in a square that may be larger than the pixel: where half of them are covered, its middle tells.
        const auto own = some & ((kept < 0.5f) | ((kept == 0.5f) & (seen.middle != 0))), under = some & negated(own) & (alpha > 0.0f);
        by *= some ? kept * (own ? darker : one) : one;
        for (int k = 0; k < 3; ++k)
            more[k] = some ? seen.color[k] / (under ? darker : one) / (float)SAMPLES : none;
        store(images.depths + pixel, some ? (under ? metres * (covered / (under ? alpha : one)) : covered * depth) : metres, count);
        store(images.alphas + pixel, some ? covered : alpha, count);
        label = own ? seen.link + 2 : label;
    }
    store_bytes(images.labels + pixel, label, count);
    change_threes(images.colors + 3 * pixel, by, more, count);
}

template <class Frame, class Look> ENDO_SIM_INLINE void blend_pixel(const Scene<Frame, Look>& scene, int row, int column,
    unsigned long long on_tissue, unsigned long long on_links, const Images& images)
{
    const size_t pixel = scene.pixel(row, column);
    const float alpha = images.alphas[pixel];
    DirectLight<Frame, Look> light{scene, on_links, 0.0f, {}, {}};
    Seen<float> seen = see(scene, row, column, alpha > SURFACE ? images.depths[pixel] / alpha : FAR, light);
    light.finish();
    for (int k = 0; k < 3; ++k)
        seen.color[k] = light.sum[k];
    blend(scene, row, column, 1, on_tissue, seen, images);
}

}  // namespace endo_sim
