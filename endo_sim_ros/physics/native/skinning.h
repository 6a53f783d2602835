// Moves one Gaussian by the maps of its control nodes. One definition, for columns in vectors of a CPU and in plain numbers.
//
// The maths is in node_map_kernels.py. A map is 16 numbers: the columns of B and c, each padded to four. A column has four
// numbers, of which the last is zero.
#pragma once
#include "core/native/vector.h"
#include "physics/native/svd.h"

namespace endo_sim {

// Four plain numbers.
struct PlainColumn {
    float c[4];

    ENDO_SIM_INLINE float operator[](int i) const { return c[i]; }
};

ENDO_SIM_INLINE PlainColumn operator*(const PlainColumn& a, float b)
{
    return {{a.c[0] * b, a.c[1] * b, a.c[2] * b, a.c[3] * b}};
}

ENDO_SIM_INLINE PlainColumn operator*(const PlainColumn& a, const PlainColumn& b)
{
    return {{a.c[0] * b.c[0], a.c[1] * b.c[1], a.c[2] * b.c[2], a.c[3] * b.c[3]}};
}

ENDO_SIM_INLINE PlainColumn operator+(const PlainColumn& a, const PlainColumn& b)
{
    return {{a.c[0] + b.c[0], a.c[1] + b.c[1], a.c[2] + b.c[2], a.c[3] + b.c[3]}};
}

ENDO_SIM_INLINE PlainColumn cross_of(const PlainColumn& a, const PlainColumn& b)
{
    ENDO_SIM_FUSE(off)
    return {{a.c[1] * b.c[2] - a.c[2] * b.c[1], a.c[2] * b.c[0] - a.c[0] * b.c[2], a.c[0] * b.c[1] - a.c[1] * b.c[0], 0.0f}};
}

ENDO_SIM_INLINE void set_column(PlainColumn& column, float x, float y, float z) { column = {{x, y, z, 0.0f}}; }

// The weighted sum of `count` maps, in columns.
ENDO_SIM_INLINE void blend(const float* maps, const int* nodes, const float* weights, int count, PlainColumn* sum)
{
    ENDO_SIM_FUSE(off)
    for (int i = 0; i < 4; ++i)
        sum[i] = {};
    for (int j = 0; j < count; ++j)
        for (int i = 0; i < 16; ++i)
            sum[i / 4].c[i % 4] += weights[j] * maps[16 * (size_t)nodes[j] + i];
}

// The first three numbers; the fourth may be written as well if what lies there comes later.
ENDO_SIM_INLINE void store_three(float* out, const PlainColumn& column, bool)
{
    for (int i = 0; i < 3; ++i)
        out[i] = column.c[i];
}

#if !defined(__CUDA_ARCH__)

typedef float VectorColumn __attribute__((vector_size(16), aligned(4)));

ENDO_SIM_INLINE VectorColumn cross_of(VectorColumn a, VectorColumn b)
{
    ENDO_SIM_FUSE(off)
    return __builtin_shufflevector(a, a, 1, 2, 0, 3) * __builtin_shufflevector(b, b, 2, 0, 1, 3)
        - __builtin_shufflevector(a, a, 2, 0, 1, 3) * __builtin_shufflevector(b, b, 1, 2, 0, 3);
}

ENDO_SIM_INLINE void set_column(VectorColumn& column, float x, float y, float z) { column = VectorColumn{x, y, z, 0.0f}; }

// One map is one vector.
ENDO_SIM_INLINE void blend(const float* maps, const int* nodes, const float* weights, int count, VectorColumn* sum)
{
    ENDO_SIM_FUSE(off)
    typedef float Map __attribute__((vector_size(64), aligned(4)));
    Map G{};
    for (int j = 0; j < count; ++j)
        G += weights[j] * *(const Map*)(maps + 16 * (size_t)nodes[j]);
    sum[0] = __builtin_shufflevector(G, G, 0, 1, 2, 3);
    sum[1] = __builtin_shufflevector(G, G, 4, 5, 6, 7);
    sum[2] = __builtin_shufflevector(G, G, 8, 9, 10, 11);
    sum[3] = __builtin_shufflevector(G, G, 12, 13, 14, 15);
}

ENDO_SIM_INLINE void store_three(float* out, VectorColumn column, bool four)
{
    if (four)
        *(VectorColumn*)out = column;
    else
        for (int i = 0; i < 3; ++i)
            out[i] = column[i];
}

#endif

// A B, or A Bᵀ, row by row.
ENDO_SIM_INLINE void multiply(const float* A, const float* B, bool transposed, float* product)
{
    ENDO_SIM_FUSE(on)
    const int along = transposed ? 1 : 3, across = transposed ? 3 : 1;
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            float sum = A[3 * r] * B[across * c];
            for (int k = 1; k < 3; ++k)
                sum += A[3 * r + k] * B[along * k + across * c];
            product[3 * r + c] = sum;
        }
}

// F Σ Fᵀ for F in columns, with its singular values clamped to [low, high] and det F > 0.
template <class Column> ENDO_SIM_INLINE void skin_stretched(const Column* f, const float* covar, float low, float high, float* out)
{
    wp::mat33 F, U, V;
    wp::vec3 sigma;
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
            F.data[r][c] = f[c][r];
    wp::svd3(F, U, sigma, V);
    for (int k = 0; k < 3; ++k) {
        const float stretch = sigma.c[k] < low ? low : sigma.c[k] > high ? high : sigma.c[k];
        for (int r = 0; r < 3; ++r)
            U.data[r][k] *= stretch;
    }
    float clamped[9], half[9];
    multiply(&U.data[0][0], &V.data[0][0], true, clamped);
    multiply(clamped, covar, false, half);
    multiply(half, clamped, true, out);
}

// Move a Gaussian of this mean [3] and covariance [9] by `count` maps of those at `maps`, 16 numbers each, about an origin.
template <class Column>
ENDO_SIM_INLINE void skin(const float* mean, const float* covar, const int* nodes, const float* weights, int count,
    const float* maps, const float* origin, float low, float high, float* out_mean, float* out_covar)
{
    ENDO_SIM_FUSE(off)
    Column g[4], f[3], m[3];
    blend(maps, nodes, weights, count, g);
    for (int i = 0; i < 3; ++i) {
        set_column(f[i], i == 0, i == 1, i == 2);
        f[i] = g[i] + f[i];
    }
    // A bound on the smallest singular value from det F and |F| recognises healthy F, which needs no decomposition.
    const Column squares = f[0] * f[0] + f[1] * f[1] + f[2] * f[2], terms = f[0] * cross_of(f[1], f[2]);
    const float size = squares[0] + squares[1] + squares[2], determinant = terms[0] + terms[1] + terms[2];
    const bool healthy = size <= high * high && 2.0f * determinant > low * size;

    const Column shift = g[0] * (mean[0] - origin[0]) + g[1] * (mean[1] - origin[1]) + g[2] * (mean[2] - origin[2]) + g[3];
    for (int i = 0; i < 3; ++i)
        out_mean[i] = mean[i] + shift[i];
    if (!healthy) {
        skin_stretched(f, covar, low, high, out_covar);
        return;
    }
    for (int i = 0; i < 3; ++i)  // columns of F Σ, and as Σ is symmetric
        m[i] = f[0] * covar[3 * i] + f[1] * covar[3 * i + 1] + f[2] * covar[3 * i + 2];
    for (int i = 0; i < 3; ++i)
        store_three(out_covar + 3 * i, m[0] * f[0][i] + m[1] * f[1][i] + m[2] * f[2][i], i < 2);
}

}  // namespace endo_sim
