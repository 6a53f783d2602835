// Farthest-point sampling (Qi et al. 2017) on a CPU.
#pragma once
#include "core/native/vector.h"

#if !defined(__CUDA_ARCH__)

namespace endo_sim {

// Pick `count` of n points, each the one farthest from all picked before, beginning with `start`; of equals the lowest index.
//
// `nearest` are squared distances to the nearest sample, infinite at first. Blocks of points keep them in cache, and the
// largest is found on the bit patterns, which for non-negative floats order like the floats: integer maxima vectorise, float
// maxima do not.
inline void sample_farthest(
    const float* x, const float* y, const float* z, int n, int count, int start, float* nearest, int* samples)
{
    int chosen = start;
    for (int s = 0; s < count; ++s) {
        samples[s] = chosen;
        const float cx = x[chosen], cy = y[chosen], cz = z[chosen];
        int best = -1, best_block = 0;
        for (int block = 0; block < n; block += 512) {
            const int end = block + 512 < n ? block + 512 : n;
            int farthest = -1;
            for (int i = block; i < end; ++i) {
                const float dx = x[i] - cx, dy = y[i] - cy, dz = z[i] - cz;
                const float d = dx * dx + dy * dy + dz * dz;
                const float m = d < nearest[i] ? d : nearest[i];
                nearest[i] = m;
                const int bits = bits_of(m);
                farthest = bits > farthest ? bits : farthest;
            }
            if (farthest > best) {
                best = farthest;
                best_block = block;
            }
        }
        for (chosen = best_block; bits_of(nearest[chosen]) != best; ++chosen) {}
    }
}

}  // namespace endo_sim

#endif
