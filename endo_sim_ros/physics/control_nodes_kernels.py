"""Kernel of farthest-point sampling."""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Blocks of points keep the distances in cache, and the largest distance is found on the bit patterns, which for
# non-negative floats order like the floats: integer maxima vectorise, float maxima do not. Ties go to the lowest index.
_SAMPLE = """
    const float* px = x.data; const float* py = y.data; const float* pz = z.data;
    float* nearest = distances.data;
    int chosen = start;
    for (int s = 0; s < count; ++s) {
        samples.data[s] = chosen;
        const float cx = px[chosen], cy = py[chosen], cz = pz[chosen];
        int best = -1, best_block = 0;
        for (int block = 0; block < n; block += 512) {
            const int end = block + 512 < n ? block + 512 : n;
            int farthest = -1;
            for (int i = block; i < end; ++i) {
                const float dx = px[i] - cx, dy = py[i] - cy, dz = pz[i] - cz;
                const float d = dx * dx + dy * dy + dz * dz;
                const float m = d < nearest[i] ? d : nearest[i];
                nearest[i] = m;
                const int bits = __builtin_bit_cast(int, m);
                farthest = bits > farthest ? bits : farthest;
            }
            if (farthest > best) { best = farthest; best_block = block; }
        }
        for (chosen = best_block; __builtin_bit_cast(int, nearest[chosen]) != best; ++chosen) {}
    }
"""


@wp.func_native(_SAMPLE)
def sample(
    x: wp.array[float],
    y: wp.array[float],
    z: wp.array[float],
    n: int,
    count: int,
    start: int,
    distances: wp.array[float],
    samples: wp.array[int],
): ...


@wp.kernel
def sample_farthest_points(
    x: wp.array[float],
    y: wp.array[float],
    z: wp.array[float],
    n: int,
    count: int,
    start: int,
    distances: wp.array[float],  # squared distance to the nearest sample, infinite at first
    samples: wp.array[int],
):
    """One thread, CPU: pick `count` points, each the one farthest from all picked before (Qi et al. 2017)."""
    sample(x, y, z, n, count, start, distances, samples)
