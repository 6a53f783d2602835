"""The step of the material point method on a CPU: all substeps in one launch, vectorised.

Same maths as `mpm_kernels` (read its header first). The native code below is C++ with the vector types of Clang, which
become whatever the processor has (AVX-512, AVX2, SSE, NEON). What concerns one node (stress, springs, contact) is done
for 16 nodes at a time, one in each lane. Transfers take one node at a time: three grid nodes in a row, with momentum and
mass each, are 12 neighbouring floats, so that a row is one vector and a node has nine of them. Nodes are sorted by cell, and the rows
of a cell stay in registers for all its nodes. Serial, so the same bits come out in every run; environments are
independent, and different threads may step different ones.
"""

import functools

import warp as wp

from endo_sim_ros.physics.backends.warp_kernels import PUSH_OUT, Grid, Loads, Nodes, RigidTools, State, Substep

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

LANES = 16
SCRATCH = 56  # vectors of scratch for 16 nodes: 40 components and 16 rows of weights

# Vectorised twins of the laws in `materials`: P[9] of F[9] (row by row) for mu, lam.
STRESSES = {
    "fixed_corotated": """
        vfloat R[9], cofactor[9];
        simd::rotation(F, R);
        const vfloat pressure = lam * (simd::cofactor(F, cofactor) - 1.0f);
        for (int i = 0; i < 9; ++i)
            P[i] = 2.0f * mu * (F[i] - R[i]) + pressure * cofactor[i];
""",
    "neo_hookean": """
        vfloat inverse_transpose[9];
        const vfloat J = simd::max(simd::cofactor(F, inverse_transpose), simd::set(0.05f));
        const vfloat log_J = simd::log(J);
        for (int i = 0; i < 9; ++i) {
            inverse_transpose[i] /= J;
            P[i] = mu * (F[i] - inverse_transpose[i]) + lam * log_J * inverse_transpose[i];
        }
""",
}

_VECTORS = """
    // Fused multiply-adds; nothing here relies on two expressions rounding alike.
    #pragma clang fp contract(fast)
    typedef float vfloat __attribute__((vector_size(64)));
    typedef float vfloat_anywhere __attribute__((vector_size(64), aligned(4)));
    typedef int vint __attribute__((vector_size(64)));
    typedef float quad __attribute__((vector_size(16)));
    typedef float quad_anywhere __attribute__((vector_size(16), aligned(4)));
    struct simd {
        #define INLINE static inline __attribute__((always_inline))
        INLINE vfloat set(float x) { return vfloat{} + x; }
        INLINE vfloat max(vfloat a, vfloat b) { return a > b ? a : b; }
        INLINE vfloat min(vfloat a, vfloat b) { return a < b ? a : b; }
        INLINE bool any(vint mask) { return __builtin_reduce_or(mask) != 0; }
        INLINE vfloat load(const float* x) { return *(const vfloat_anywhere*)x; }
        INLINE void store(float* x, vfloat y) { *(vfloat_anywhere*)x = y; }
        INLINE vfloat repeat(quad x) { return __builtin_shufflevector(x, x, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3); }

        // The transpose of 16 vectors: four perfect shuffles of all 256 elements.
        INLINE void transpose(vfloat* x)
        {
            for (int stage = 0; stage < 4; ++stage) {
                vfloat y[16];
                for (int i = 0; i < 8; ++i) {
                    y[2 * i] = __builtin_shufflevector(
                        x[i], x[i + 8], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
                    y[2 * i + 1] = __builtin_shufflevector(
                        x[i], x[i + 8], 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
                }
                for (int i = 0; i < 16; ++i)
                    x[i] = y[i];
            }
        }

        // Of each of four vectors the sum of its four quarters, as the four quarters of one.
        INLINE vfloat sums(vfloat a, vfloat b, vfloat c, vfloat d)
        {
            const vfloat ab = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
                + __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
            const vfloat cd = __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
                + __builtin_shufflevector(c, d, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
            return __builtin_shufflevector(ab, cd, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27)
                + __builtin_shufflevector(ab, cd, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
        }

        // cof F; returns det F.
        INLINE vfloat cofactor(const vfloat* F, vfloat* out)
        {
            for (int r = 0; r < 3; ++r)
                for (int c = 0; c < 3; ++c) {
                    const int r1 = (r + 1) % 3, r2 = (r + 2) % 3, c1 = (c + 1) % 3, c2 = (c + 2) % 3;
                    out[3 * r + c] = F[3 * r1 + c1] * F[3 * r2 + c2] - F[3 * r1 + c2] * F[3 * r2 + c1];
                }
            return F[0] * out[0] + F[1] * out[1] + F[2] * out[2];
        }

        INLINE vfloat dot(const vfloat* a, const vfloat* b, int n)
        {
            vfloat sum = a[0] * b[0];
            for (int i = 1; i < n; ++i)
                sum += a[i] * b[i];
            return sum;
        }

        // R of F = R S: `rotation_of` of the other kernels, lane by lane the same branches.
        INLINE void rotation(const vfloat* F, vfloat* R)
        {
            vfloat inverse[9];
            const vfloat J = cofactor(F, inverse), size = dot(F, F, 9);
            const vint healthy = J > 0.02f * size * __builtin_elementwise_sqrt(size);
            for (int i = 0; i < 9; ++i)  // the identity where this cannot work
                R[i] = healthy ? F[i] : set(i % 4 == 0 ? 1.0f : 0.0f);
            for (int round = 0; round < 12; ++round) {
                const vfloat half = 0.5f / cofactor(R, inverse);
                vfloat change = {};
                for (int i = 0; i < 9; ++i) {
                    const vfloat next = 0.5f * R[i] + half * inverse[i];
                    change += (next - R[i]) * (next - R[i]);
                    R[i] = next;
                }
                if (!any(change >= 1e-9f))
                    break;
            }
            for (int lane = 0; lane < 16; ++lane)
                if (!healthy[lane]) {
                    wp::mat33 one, U, V;
                    wp::vec3 sigma;
                    for (int i = 0; i < 9; ++i)
                        one.data[i / 3][i % 3] = F[i][lane];
                    wp::svd3(one, U, sigma, V);
                    for (int i = 0; i < 9; ++i) {
                        float sum = 0.0f;
                        for (int k = 0; k < 3; ++k)
                            sum += U.data[i / 3][k] * V.data[i % 3][k];
                        R[i][lane] = sum;
                    }
                }
        }

        // ln x of x >= 0.05, to 1e-7: 2^n (1 + f) with a polynomial in f (that of Cephes' logf).
        INLINE vfloat log(vfloat x)
        {
            vint n = ((vint)x >> 23) - 126;
            vfloat m = (vfloat)(((vint)x & 0x007fffff) | 0x3f000000);  // in [1/2, 1)
            const vint low = m < 0.70710678f;
            n += low;
            vfloat f = (low ? m + m : m) - 1.0f;
            vfloat e = __builtin_convertvector(n, vfloat), z = f * f;
            vfloat p = set(7.0376836292e-2f);
            p = p * f - 1.1514610310e-1f;
            p = p * f + 1.1676998740e-1f;
            p = p * f - 1.2420140846e-1f;
            p = p * f + 1.4249322787e-1f;
            p = p * f - 1.6668057665e-1f;
            p = p * f + 2.0000714765e-1f;
            p = p * f - 2.4999993993e-1f;
            p = p * f + 3.3333331174e-1f;
            return f * z * p - 2.12194440e-4f * e - 0.5f * z + f + 0.693359375f * e;
        }

        INLINE vfloat clamp(vfloat x, float low, float high) { return min(max(x, set(low)), set(high)); }
    };
"""

_STEP = (
    _VECTORS
    + """
    const int M = (int)nodes.X.shape.dims[0], padded = (M + 15) / 16 * 16, T = tools.count;
    const float dt = substep.dt, h = grid.h, inverse_h = grid.inverse_h;
    const size_t sx = 4 * (size_t)grid.ny * grid.nz, sy = 4 * (size_t)grid.nz;
    float* mv = momenta.data + slot * 4 * (size_t)(grid.count + 4);
    float* gv = velocities.data + slot * 4 * (size_t)(grid.count + 4);
    vfloat* const soa = (vfloat*)scratch.data + slot * (size_t)(SCRATCH_VECTORS * padded / 16);
    float* const weights = (float*)(soa + (SCRATCH_VECTORS - 16) * (size_t)(padded / 16));  // [padded, 16]
    int* const base = bases.data + slot * (size_t)padded;
    const size_t e0 = b * (size_t)M;
    const auto at = [&](int block, int component) -> vfloat& { return soa[block * (SCRATCH_VECTORS - 16) + component]; };
    enum { MASS, VOLUME, MU, LAM, STIFFNESS, SPRING, HOLDER, X, U = X + 3, F0 = U + 3, FORCE = F0 + 9,
           TARGET = FORCE + 3, TARGET_V = TARGET + 3, Q0 = TARGET_V + 3 };  // 40 in all
    vfloat* const pulls = (vfloat*)pulled.data + slot * (size_t)(4 * padded / 16);
    vint* const givers = (vint*)gave.data + slot * (size_t)(padded / 16);
    const vfloat zero = {};
    // From the order and layout of the arrays to that of the lanes. Padding has no mass and rests in cell zero.
    for (int block = 0; block < padded / 16; ++block)
        for (int lane = 0; lane < 16; ++lane) {
            const int p = order.data[16 * block + lane];
            const size_t e = e0 + p;
            const auto fill = [&](int component, const void* from, size_t index, int count) {
                for (int i = 0; i < count; ++i)
                    at(block, component + i)[lane] = p < 0 ? 0.0f : ((const float*)from)[index * count + i];
            };
            fill(MASS, nodes.mass.data, p, 1);
            fill(VOLUME, nodes.volume.data, p, 1);
            fill(MU, nodes.mu.data, p, 1);
            fill(LAM, nodes.lam.data, p, 1);
            const float factor = p < 0 ? 0.0f : scale.data[e];
            at(block, MU)[lane] *= factor;
            at(block, LAM)[lane] *= factor;
            fill(STIFFNESS, nodes.stiffness.data, e, 1);
            fill(SPRING, loads.spring.data, e, 1);
            fill(HOLDER, loads.holder.data, e, 1);  // an integer, bit by bit
            fill(X, nodes.X.data, p, 3);
            fill(U, state.u.data, e, 3);
            fill(F0, state.F.data, e, 9);
            fill(FORCE, loads.force.data, e, 3);
            fill(TARGET, loads.target.data, e, 3);
            fill(TARGET_V, loads.target_v.data, e, 3);
            if (substep.ratio > 0.0f)
                fill(Q0, state.Q.data, e, 9);
            if (p < 0)
                at(block, F0)[lane] = at(block, F0 + 4)[lane] = at(block, F0 + 8)[lane] = 1.0f;
        }

    for (size_t i = 0; i < 4 * (size_t)(grid.count + 4); ++i)
        mv[i] = 0.0f;
    // The part of the grid that nodes give to; momenta are zero everywhere when a substep begins.
    int low[3], high[3];
    const auto empty_box = [&]() {
        for (int axis = 0; axis < 3; ++axis)
            low[axis] = grid.count, high[axis] = 0;
    };
    // Weights of 16 nodes, the first grid node of each, and where it lies among its grid nodes, in cells.
    const auto place = [&](int block, vfloat* f) {
        vfloat rows[16] = {}, first[3];
        const int n[3] = {grid.nx, grid.ny, grid.nz};
        for (int axis = 0; axis < 3; ++axis) {
            vfloat x = at(block, X + axis);
            if (CURRENT) {
                x = (x + at(block, U + axis)) * inverse_h;
                first[axis] = __builtin_elementwise_floor(x - 0.5f);
                first[axis] = first[axis] > 0.0f ? simd::min(first[axis], simd::set((float)(n[axis] - 3))) : zero;  // not NaN
            } else {
                x *= inverse_h;
                for (int lane = 0; lane < 16; ++lane) {
                    const int p = order.data[16 * block + lane];
                    first[axis][lane] = p < 0 ? 0.0f : (float)((const int*)nodes.first.data)[3 * p + axis];
                }
            }
            f[axis] = x - first[axis];
            const vfloat a = 1.5f - f[axis], c = f[axis] - 1.0f, d = f[axis] - 0.5f;
            rows[4 * axis] = 0.5f * a * a;
            rows[4 * axis + 1] = 0.75f - c * c;
            rows[4 * axis + 2] = 0.5f * d * d;
        }
        rows[12] = f[0], rows[13] = f[1], rows[14] = f[2];
        simd::transpose(rows);
        for (int lane = 0; lane < 16; ++lane) {
            ((vfloat*)weights)[16 * block + lane] = rows[lane];
            base[16 * block + lane] = ((int)first[0][lane] * grid.ny + (int)first[1][lane]) * grid.nz + (int)first[2][lane];
        }
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = wp::min(low[axis], (int)__builtin_reduce_min(first[axis]));
            high[axis] = wp::max(high[axis], (int)__builtin_reduce_max(first[axis]));
        }
    };
    empty_box();
    for (int block = 0; block < padded / 16; ++block) {
        vfloat f[3];
        place(block, f);
    }
    // Where nodes lay among their grid nodes when they were placed last.
    const auto remembered = [&](int block, vfloat* f) {
        for (int lane = 0; lane < 16; ++lane)
            for (int axis = 0; axis < 3; ++axis)
                f[axis][lane] = weights[16 * (size_t)(16 * block + lane) + 12 + axis];
    };

    // Nodes beside a cut name their grid nodes one by one.
    const auto entry = [&](int node, int i, int j, int k) {
        return 4 * (size_t)nodes.table.data[27 * (size_t)nodes.row.data[order.data[node]] + 9 * i + 3 * j + k];
    };
    const auto beside_cut = [&](int node) { return order.data[node] >= 0 && nodes.row.data[order.data[node]] >= 0; };
    const vint three = {-1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0};  // grid nodes of a row
    const vfloat third = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0};

    for (int s = 0; s <= substeps; ++s) {
        const bool gather = s > 0, scatter = s < substeps;
        const float time = (s + 1) * dt;
        if (CURRENT)
            empty_box();
        int gathered = -1, scattered = -1;  // cells whose rows are in registers
        vfloat from[9], to[9];
        const auto flush = [&]() {
            if (scattered >= 0)
                for (int i = 0; i < 3; ++i)
                    for (int j = 0; j < 3; ++j) {
                        float* row = mv + 4 * (size_t)scattered + i * sx + j * sy;
                        simd::store(row, simd::load(row) + to[3 * i + j]);
                    }
        };
        for (int block = 0; block < padded / 16; ++block) {
            vfloat v[3], C[9], u[3], F[9], f[3], rows[16];
            for (int i = 0; i < 3; ++i)
                u[i] = at(block, U + i);
            for (int i = 0; i < 9; ++i)
                F[i] = at(block, F0 + i);

            if (gather) {
                for (int lane = 0; lane < 16; ++lane) {
                    const int node = 16 * block + lane;
                    const float* w = weights + 16 * (size_t)node;
                    const quad wz = *(const quad*)(w + 8);
                    const vfloat z = __builtin_shufflevector(wz, wz, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
                    if (beside_cut(node)) {
                        gathered = -1;
                        for (int i = 0; i < 3; ++i)
                            for (int j = 0; j < 3; ++j) {
                                vfloat row = {};
                                for (int k = 0; k < 3; ++k)
                                    for (int c = 0; c < 4; ++c)
                                        row[4 * k + c] = gv[entry(node, i, j, k) + c];
                                from[3 * i + j] = row;
                            }
                    } else if (base[node] != gathered) {
                        gathered = base[node];
                        for (int i = 0; i < 3; ++i)
                            for (int j = 0; j < 3; ++j)
                                from[3 * i + j]
                                    = three ? simd::load(gv + 4 * (size_t)gathered + i * sx + j * sy) : zero;
                    }
                    vfloat sum = zero, sum_x = zero, sum_y = zero;  // Σ w v (1, i, j) along x and y
                    for (int i = 0; i < 3; ++i) {
                        const vfloat second = w[5] * from[3 * i + 1], last = w[6] * from[3 * i + 2];
                        const vfloat plane = w[4] * from[3 * i] + second + last;
                        sum += w[i] * plane;
                        sum_x += (i * w[i]) * plane;
                        sum_y += w[i] * (second + 2.0f * last);
                    }
                    rows[lane] = simd::sums(z * sum, z * sum_x, z * sum_y, third * z * sum);
                }
                simd::transpose(rows);
                for (int i = 0; i < 3; ++i) {
                    v[i] = rows[i];
                    u[i] += dt * v[i];
                }
                remembered(block, f);
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c)
                        C[3 * r + c] = 4.0f * inverse_h * (rows[4 * (c + 1) + r] - f[c] * v[r]);
                vfloat rate[9];
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c)
                        rate[3 * r + c] = CURRENT ? C[3 * r] * F[c] + C[3 * r + 1] * F[3 + c] + C[3 * r + 2] * F[6 + c]
                                                  : C[3 * r + c];
                for (int i = 0; i < 9; ++i)
                    at(block, F0 + i) = F[i] += dt * rate[i];
                for (int i = 0; i < 3; ++i)
                    at(block, U + i) = u[i];
                if (T > 0) {
                    const vint giver = givers[block];
                    if (simd::any(giver >= 0))
                        for (int lane = 0; lane < 16; ++lane)
                            if (giver[lane] >= 0) {
                                const int p = order.data[16 * block + lane];
                                const size_t place = 3 * ((b * (size_t)T + giver[lane]) * M + p);
                                float *impulse = (float*)tools.impulse.data + place, *moment = (float*)tools.moment.data + place;
                                float given[3], x[3];
                                for (int i = 0; i < 3; ++i) {
                                    given[i] = pulls[4 * block + i][lane]
                                        - pulls[4 * block + 3][lane] / substep.decay * v[i][lane];
                                    x[i] = at(block, X + i)[lane] + u[i][lane] - dt * v[i][lane];  // where it was given
                                }
                                for (int i = 0; i < 3; ++i) {
                                    impulse[i] += given[i];
                                    moment[i] += x[(i + 1) % 3] * given[(i + 2) % 3] - x[(i + 2) % 3] * given[(i + 1) % 3];
                                }
                            }
                }
            } else {
                for (int lane = 0; lane < 16; ++lane) {
                    const int p = order.data[16 * block + lane];
                    for (int i = 0; i < 3; ++i)
                        v[i][lane] = p < 0 ? 0.0f : ((const float*)state.v.data)[3 * (e0 + p) + i];
                    for (int i = 0; i < 9; ++i)
                        C[i][lane] = p < 0 ? 0.0f : ((const float*)state.C.data)[9 * (e0 + p) + i];
                }
            }
            if (!scatter) {
                for (int lane = 0; lane < 16; ++lane) {
                    const int p = order.data[16 * block + lane];
                    if (p < 0)
                        continue;
                    for (int i = 0; i < 3; ++i) {
                        ((float*)state.u.data)[3 * (e0 + p) + i] = u[i][lane];
                        ((float*)state.v.data)[3 * (e0 + p) + i] = v[i][lane];
                    }
                    for (int i = 0; i < 9; ++i) {
                        ((float*)state.C.data)[9 * (e0 + p) + i] = C[i][lane];
                        ((float*)state.F.data)[9 * (e0 + p) + i] = F[i][lane];
                        if (substep.ratio > 0.0f)
                            ((float*)state.Q.data)[9 * (e0 + p) + i] = at(block, Q0 + i)[lane];
                    }
                }
                continue;
            }

            if (CURRENT)
                place(block, f);
            const vfloat mass = at(block, MASS), mu = at(block, MU), lam = at(block, LAM);
            vfloat P[9];
            { STRESS }
            if (substep.ratio > 0.0f) {
                vfloat cofactor[9], given[9];
                const vfloat J = simd::max(simd::cofactor(F, cofactor), simd::set(0.05f));
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c) {  // S = F⁻¹ P
                        const vfloat S = (cofactor[r] * P[c] + cofactor[3 + r] * P[3 + c] + cofactor[6 + r] * P[6 + c]) / J;
                        at(block, Q0 + 3 * r + c) += substep.forget * (S - at(block, Q0 + 3 * r + c));
                    }
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c) {
                        given[3 * r + c] = P[3 * r + c];
                        for (int k = 0; k < 3; ++k)
                            given[3 * r + c] -= F[3 * r + k] * at(block, Q0 + 3 * k + c);
                    }
                for (int i = 0; i < 9; ++i)
                    P[i] += substep.ratio * given[i];
            }
            if (CURRENT) {  // τ = P Fᵀ
                vfloat tau[9];
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c)
                        tau[3 * r + c] = P[3 * r] * F[3 * c] + P[3 * r + 1] * F[3 * c + 1] + P[3 * r + 2] * F[3 * c + 2];
                for (int i = 0; i < 9; ++i)
                    P[i] = tau[i];
            }

            // Springs and tools.
            const vfloat spring = at(block, SPRING);
            vfloat pull[3] = {zero, zero, zero}, added = zero;
            vint giver = vint{} - 1;
            const vint held = spring > 0.0f;
            if (simd::any(held)) {
                added = dt * dt * spring;
                for (int i = 0; i < 3; ++i)
                    pull[i] = -dt * spring * (u[i] - at(block, TARGET + i) - time * at(block, TARGET_V + i));
                giver = held ? (vint)at(block, HOLDER) : giver;
            }
            vfloat deepest = zero, outward = zero, normal[3] = {}, along[3] = {};
            vint pushing = vint{} - 1;
            for (int t = 0; t < T; ++t) {
                const size_t tool = b * (size_t)T + t;
                const float radius = tools.radius.data[tool];
                if (!(radius > 0.0f))
                    continue;
                float tip[3], axis[3], square = 0.0f;
                const float *tip_v = (const float*)(tools.tip_v.data + tool), *end_v = (const float*)(tools.end_v.data + tool);
                for (int i = 0; i < 3; ++i) {
                    tip[i] = ((const float*)(tools.tip.data + tool))[i] + time * tip_v[i];
                    axis[i] = ((const float*)(tools.end.data + tool))[i] + time * end_v[i] - tip[i];
                    square += axis[i] * axis[i];
                }
                vfloat arm[3], share = zero;
                for (int i = 0; i < 3; ++i) {
                    arm[i] = at(block, X + i) + u[i] - tip[i];
                    share += arm[i] * axis[i];
                }
                share = simd::clamp(share / (square > 1e-12f ? square : 1e-12f), 0.0f, 1.0f);
                for (int i = 0; i < 3; ++i)
                    arm[i] -= share * axis[i];
                const vfloat distance = __builtin_elementwise_sqrt(simd::dot(arm, arm, 3));
                if (!simd::any(distance < radius + dt * 10.0f))  // nothing comes nearer at 10 m/s
                    continue;
                const vfloat gap = distance - radius;
                for (int i = 0; i < 3; ++i)
                    arm[i] /= simd::max(distance, simd::set(1e-9f));
                const vfloat predicted = gap + dt * simd::dot(v, arm, 3);
                const vint deeper = (distance > 1e-9f) & (predicted < deepest) & ~held & (mass > 0.0f);
                vfloat moving[3];
                for (int i = 0; i < 3; ++i)
                    moving[i] = tip_v[i] + share * (end_v[i] - tip_v[i]);
                const vfloat out = simd::min(-gap / dt, simd::max(simd::dot(moving, arm, 3), zero) + PUSH_OUT);
                deepest = deeper ? predicted : deepest;
                pushing = deeper ? vint{} + t : pushing;
                outward = deeper ? out : outward;
                for (int i = 0; i < 3; ++i) {
                    normal[i] = deeper ? arm[i] : normal[i];
                    along[i] = deeper ? moving[i] : along[i];
                }
            }
            const vint pushed = pushing >= 0;
            if (simd::any(pushed)) {
                const vfloat weight = dt * dt * at(block, STIFFNESS), towards = simd::dot(along, normal, 3);
                vfloat slip[3];
                for (int i = 0; i < 3; ++i)
                    slip[i] = v[i] - along[i];
                const vfloat parting = simd::dot(slip, normal, 3);
                for (int i = 0; i < 3; ++i)
                    slip[i] -= parting * normal[i];
                const vfloat lost = tools.friction * weight * simd::max(outward - simd::dot(v, normal, 3), zero) / (mass + weight);
                const vfloat speed = simd::max(__builtin_elementwise_sqrt(simd::dot(slip, slip, 3)), simd::set(1e-12f));
                const vfloat kept = simd::max(1.0f - lost / speed, zero);
                for (int i = 0; i < 3; ++i)
                    pull[i] = pushed
                        ? weight * (outward * normal[i] + along[i] - towards * normal[i] + kept * slip[i]) : pull[i];
                added = pushed ? weight : added;
                giver = pushed ? pushing : giver;
            }
            if (T > 0) {
                givers[block] = giver;
                for (int i = 0; i < 3; ++i)
                    pulls[4 * block + i] = pull[i];
                pulls[4 * block + 3] = added;
            }

            // What the node gives: at its first grid node momentum and mass, then their growth along x, y and z.
            const float gravity[3] = {substep.gravity[0], substep.gravity[1], substep.gravity[2]};
            if (!gather && !CURRENT)
                remembered(block, f);
            const vfloat share = dt * 4.0f * inverse_h * at(block, VOLUME);
            for (int r = 0; r < 3; ++r) {
                rows[r] = mass * (v[r] + dt * gravity[r]) + dt * at(block, FORCE + r) + pull[r];
                for (int c = 0; c < 3; ++c) {
                    rows[4 * (c + 1) + r] = ((mass + added) * h) * C[3 * r + c] - share * P[3 * r + c];
                    rows[r] -= rows[4 * (c + 1) + r] * f[c];
                }
            }
            rows[3] = mass + added;
            rows[7] = rows[11] = rows[15] = zero;
            simd::transpose(rows);
            for (int lane = 0; lane < 16; ++lane) {
                const int node = 16 * block + lane;
                const float* w = weights + 16 * (size_t)node;
                const quad wz = *(const quad*)(w + 8);
                const vfloat z = __builtin_shufflevector(wz, wz, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
                const vfloat row = rows[lane];
                const vfloat corner = __builtin_shufflevector(row, row, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
                const vfloat ax = __builtin_shufflevector(row, row, 4, 5, 6, 7, 4, 5, 6, 7, 4, 5, 6, 7, 4, 5, 6, 7);
                const vfloat ay = __builtin_shufflevector(row, row, 8, 9, 10, 11, 8, 9, 10, 11, 8, 9, 10, 11, 8, 9, 10, 11);
                const vfloat az
                    = __builtin_shufflevector(row, row, 12, 13, 14, 15, 12, 13, 14, 15, 12, 13, 14, 15, 12, 13, 14, 15);
                const vfloat start = z * (corner + third * az), growth_x = z * ax, growth_y = z * ay;
                const bool cut = beside_cut(node);
                if (!cut && base[node] != scattered) {
                    flush();
                    scattered = base[node];
                    for (int i = 0; i < 9; ++i)
                        to[i] = zero;
                }
                for (int i = 0; i < 3; ++i) {
                    const vfloat edge = w[i] * (start + (float)i * growth_x), growth = w[i] * growth_y;
                    for (int j = 0; j < 3; ++j) {
                        const vfloat given = w[4 + j] * (edge + (float)j * growth);
                        if (!cut)
                            to[3 * i + j] += given;
                        else
                            for (int k = 0; k < 3; ++k)
                                for (int c = 0; c < 4; ++c)
                                    mv[entry(node, i, j, k) + c] += given[4 * k + c];
                    }
                }
            }
        }
        if (scatter) {
            flush();
            const auto update = [&](size_t begin, size_t end) {
                size_t i = 4 * begin;
                for (; i + 16 <= 4 * end; i += 16) {
                    const vfloat q = simd::load(mv + i);
                    const vfloat m
                        = __builtin_shufflevector(q, q, 3, 3, 3, 3, 7, 7, 7, 7, 11, 11, 11, 11, 15, 15, 15, 15);
                    simd::store(gv + i, m > 0.0f ? q * (substep.decay / m) : zero);
                    simd::store(mv + i, zero);
                }
                for (; i < 4 * end; i += 4) {
                    const quad q = *(const quad_anywhere*)(mv + i), none = {};
                    *(quad_anywhere*)(gv + i) = q[3] > 0.0f ? q * (substep.decay / q[3]) : none;
                    *(quad_anywhere*)(mv + i) = none;
                }
            };
            for (int i = low[0]; i < high[0] + 3; ++i)
                for (int j = low[1]; j < high[1] + 3; ++j) {
                    const size_t row = ((size_t)i * grid.ny + j) * grid.nz;
                    update(row + low[2], row + high[2] + 3);
                }
            const size_t regular = (size_t)grid.nx * grid.ny * grid.nz;
            update(regular, grid.count);
        }
    }
"""
)


@functools.cache
def make_step_kernel(material: str, kinematics: str):
    """The kernel that takes a whole step for the environments [first, first + n) of an n-thread launch."""
    text = _STEP.replace("{ STRESS }", "{" + STRESSES[material] + "}")
    text = text.replace("CURRENT", str(int(kinematics == "current"))).replace("PUSH_OUT", f"{PUSH_OUT}f")
    text = text.replace("SCRATCH_VECTORS", str(SCRATCH))

    @wp.func_native(text)
    def step_environment(
        b: int,
        slot: int,
        nodes: Nodes,
        state: State,
        loads: Loads,
        tools: RigidTools,
        grid: Grid,
        substep: Substep,
        substeps: int,
        scale: wp.array[float],
        order: wp.array[int],
        momenta: wp.array[float],
        velocities: wp.array[float],
        scratch: wp.array[float],
        bases: wp.array[int],
        pulled: wp.array[float],
        gave: wp.array[int],
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def step(
        first: int,
        slot: int,  # of the scratch memory
        nodes: Nodes,
        state: State,
        loads: Loads,
        tools: RigidTools,
        grid: Grid,
        substep: Substep,
        substeps: int,
        scale: wp.array[float],  # [B · M]
        order: wp.array[int],  # nodes sorted by cell, padded by -1 to a multiple of 16
        momenta: wp.array[float],  # scratch of each slot, as all below: [S, count + 4, 4]
        velocities: wp.array[float],
        scratch: wp.array[float],
        bases: wp.array[int],  # [S, padded]
        pulled: wp.array[float],  # [S, padded / 16, 4, 16]
        gave: wp.array[int],  # [S, padded]
    ):
        step_environment(
            first + wp.tid(), slot, nodes, state, loads, tools, grid, substep, substeps, scale, order, momenta, velocities,
            scratch, bases, pulled, gave,
        )  # fmt: skip

    return step
