// A step of the material point method on a CPU: all substeps of one environment, serial, so the same bits in every run.
//
// The update of a control node is done for 16 of them at a time, one in each lane. Transfers take one at a time: three grid
// nodes in a row, with momentum and mass each, are 12 neighbouring floats, so that a row is one vector and a control node has
// nine of them. Control nodes are sorted by cell, and the rows of a cell stay in registers for all of its nodes.
#pragma once
#include "physics/native/node.h"

#if !defined(__CUDA_ARCH__)
namespace endo_sim {

typedef float vfloat_anywhere __attribute__((vector_size(64), aligned(4)));
typedef float quad __attribute__((vector_size(16)));
typedef float quad_anywhere __attribute__((vector_size(16), aligned(4)));

ENDO_SIM_INLINE vfloat load(const float* x) { return *(const vfloat_anywhere*)x; }
ENDO_SIM_INLINE void store(float* x, vfloat y) { *(vfloat_anywhere*)x = y; }

// The transpose of 16 vectors: four perfect shuffles of all 256 elements.
ENDO_SIM_INLINE void transpose(vfloat* x)
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
ENDO_SIM_INLINE vfloat sums(vfloat a, vfloat b, vfloat c, vfloat d)
{
    const vfloat ab = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
        + __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    const vfloat cd = __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
        + __builtin_shufflevector(c, d, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    return __builtin_shufflevector(ab, cd, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27)
        + __builtin_shufflevector(ab, cd, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
}

// Where the components of 16 control nodes lie; behind them are 16 vectors of weights.
enum Component {
    MASS,
    VOLUME,
    MU,
    LAM,
    STIFFNESS,
    SPRING,
    LIMIT,
    HOLDER,
    X,
    U = X + 3,
    F0 = U + 3,
    FORCE = F0 + 9,
    TARGET = FORCE + 3,
    TARGET_V = TARGET + 3,
    Q0 = TARGET_V + 3,
    COMPONENTS = Q0 + 9
};
constexpr int CPU_SCRATCH = COMPONENTS + 16;  // vectors for 16 control nodes

// The nine rows of a stencil, and the cell that they are of; -1 = none.
struct Rows {
    int cell = -1;
    vfloat row[9];
};

template <bool CURRENT, class Nodes, class State, class Loads, class Tools, class Grid, class Substep> struct CpuStep {
    const size_t b;  // environment
    const Nodes& nodes;
    const State& state;
    const Loads& loads;
    const Tools& tools;
    const Grid& grid;
    const Substep& substep;
    const int* order;  // control nodes sorted by cell, padded by -1 to a multiple of 16
    float *mv, *gv;  // grid: momenta, zero everywhere when a substep begins, and velocities, four floats a grid node
    vfloat* soa;  // [blocks, COMPONENTS]
    float* weights;  // [padded, 16]: of each control node three along x, y and z, four apart, and where it lies in its cell
    int* base;  // [padded] first grid node of each control node
    vfloat* pulls;  // [blocks, 4] what tools gave in the last substep
    vint* source_tools;  // [blocks] which of them did
    const int M, padded;
    const size_t sx, sy;  // floats from a grid node to the next along x and y
    int low[3], high[3];  // the part of the grid that control nodes give to

    ENDO_SIM_INLINE vfloat& at(int block, int component) { return soa[block * COMPONENTS + component]; }
    ENDO_SIM_INLINE float* weights_of(int node) { return weights + 16 * (size_t)node; }

    // Numbers of a lane: of the array of a component, for whoever it is of; padding has zeros.
    ENDO_SIM_INLINE void fill(int block, int lane, int component, const void* from, size_t index, int count)
    {
        ENDO_SIM_FUSE(fast)
        const bool padding = order[16 * block + lane] < 0;
        for (int i = 0; i < count; ++i)
            at(block, component + i)[lane] = padding ? 0.0f : ((const float*)from)[index * count + i];
    }

    // From the order and layout of the arrays to that of the lanes. Padding has no mass and rests in cell zero.
    ENDO_SIM_INLINE void load_nodes(const float* scale)
    {
        ENDO_SIM_FUSE(fast)
        const size_t e0 = b * (size_t)M;
        for (int block = 0; block < padded / 16; ++block)
            for (int lane = 0; lane < 16; ++lane) {
                const int p = order[16 * block + lane];
                const size_t e = e0 + p;
                fill(block, lane, MASS, nodes.mass.data, p, 1);
                fill(block, lane, VOLUME, nodes.volume.data, p, 1);
                fill(block, lane, MU, nodes.mu.data, p, 1);
                fill(block, lane, LAM, nodes.lam.data, p, 1);
                const float factor = p < 0 ? 0.0f : scale[e];
                at(block, MU)[lane] *= factor;
                at(block, LAM)[lane] *= factor;
                fill(block, lane, STIFFNESS, nodes.stiffness.data, e, 1);
                fill(block, lane, SPRING, loads.spring.data, e, 1);
                fill(block, lane, LIMIT, loads.limit.data, e, 1);
                fill(block, lane, HOLDER, loads.holder.data, e, 1);  // an integer, bit by bit
                fill(block, lane, X, nodes.X.data, p, 3);
                fill(block, lane, U, state.u.data, e, 3);
                fill(block, lane, F0, state.F.data, e, 9);
                fill(block, lane, FORCE, loads.force.data, e, 3);
                fill(block, lane, TARGET, loads.target.data, e, 3);
                fill(block, lane, TARGET_V, loads.target_v.data, e, 3);
                if (substep.ratio > 0.0f)
                    fill(block, lane, Q0, state.Q.data, e, 9);
                if (p < 0)
                    at(block, F0)[lane] = at(block, F0 + 4)[lane] = at(block, F0 + 8)[lane] = 1.0f;
            }
    }

    ENDO_SIM_INLINE void load_motion(int block, vfloat* v, vfloat* C)
    {
        ENDO_SIM_FUSE(fast)
        for (int lane = 0; lane < 16; ++lane) {
            const int p = order[16 * block + lane];
            const size_t e = b * (size_t)M + p;
            for (int i = 0; i < 3; ++i)
                v[i][lane] = p < 0 ? 0.0f : ((const float*)state.v.data)[3 * e + i];
            for (int i = 0; i < 9; ++i)
                C[i][lane] = p < 0 ? 0.0f : ((const float*)state.C.data)[9 * e + i];
        }
    }

    ENDO_SIM_INLINE void store_nodes(int block, const vfloat* u, const vfloat* v, const vfloat* C, const vfloat* F)
    {
        ENDO_SIM_FUSE(fast)
        for (int lane = 0; lane < 16; ++lane) {
            const int p = order[16 * block + lane];
            const size_t e = b * (size_t)M + p;
            if (p < 0)
                continue;
            for (int i = 0; i < 3; ++i) {
                ((float*)state.u.data)[3 * e + i] = u[i][lane];
                ((float*)state.v.data)[3 * e + i] = v[i][lane];
            }
            for (int i = 0; i < 9; ++i) {
                ((float*)state.C.data)[9 * e + i] = C[i][lane];
                ((float*)state.F.data)[9 * e + i] = F[i][lane];
                if (substep.ratio > 0.0f)
                    ((float*)state.Q.data)[9 * e + i] = at(block, Q0 + i)[lane];
            }
        }
    }

    ENDO_SIM_INLINE void empty_box()
    {
        ENDO_SIM_FUSE(fast)
        for (int axis = 0; axis < 3; ++axis)
            low[axis] = grid.count, high[axis] = 0;
    }

    // Weights of 16 control nodes, the first grid node of each, and where it lies among its grid nodes, in cells.
    ENDO_SIM_INLINE void place(int block, vfloat* f)
    {
        ENDO_SIM_FUSE(fast)
        const vfloat zero = {};
        vfloat rows[16] = {}, first[3];
        const int n[3] = {grid.nx, grid.ny, grid.nz};
        for (int axis = 0; axis < 3; ++axis) {
            vfloat x = at(block, X + axis);
            if (CURRENT) {
                x = (x + at(block, U + axis)) * grid.inverse_h;
                first[axis] = floor_of(x - 0.5f);
                const vfloat last = everywhere<vfloat>((float)(n[axis] - 3));
                first[axis] = first[axis] > 0.0f ? smaller(first[axis], last) : zero;  // not NaN
            } else {
                x *= grid.inverse_h;
                for (int lane = 0; lane < 16; ++lane) {
                    const int p = order[16 * block + lane];
                    first[axis][lane] = p < 0 ? 0.0f : (float)((const int*)nodes.first.data)[3 * p + axis];
                }
            }
            f[axis] = x - first[axis];
            spline(f[axis], rows + 4 * axis);
        }
        rows[12] = f[0], rows[13] = f[1], rows[14] = f[2];
        transpose(rows);
        for (int lane = 0; lane < 16; ++lane) {
            ((vfloat*)weights)[16 * block + lane] = rows[lane];
            base[16 * block + lane] = ((int)first[0][lane] * grid.ny + (int)first[1][lane]) * grid.nz + (int)first[2][lane];
        }
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = smaller(low[axis], (int)smallest(first[axis]));
            high[axis] = larger(high[axis], (int)largest(first[axis]));
        }
    }

    // Where control nodes lay among their grid nodes when they were placed last.
    ENDO_SIM_INLINE void remembered(int block, vfloat* f)
    {
        ENDO_SIM_FUSE(fast)
        for (int lane = 0; lane < 16; ++lane)
            for (int axis = 0; axis < 3; ++axis)
                f[axis][lane] = weights_of(16 * block + lane)[12 + axis];
    }

    // Control nodes beside a cut name their grid nodes one by one.
    ENDO_SIM_INLINE int table_row(int node) { return nodes.row.data[b * (size_t)M + order[node]]; }
    ENDO_SIM_INLINE bool beside_cut(int node) { return order[node] >= 0 && table_row(node) >= 0; }
    ENDO_SIM_INLINE size_t entry(int node, int i, int j, int k)
    {
        ENDO_SIM_FUSE(fast)
        return 4 * (size_t)nodes.table.data[27 * (size_t)table_row(node) + 9 * i + 3 * j + k];
    }

    // The weights along z of a node, each four times, as the grid nodes of a row lie.
    ENDO_SIM_INLINE vfloat along_row(const float* w)
    {
        ENDO_SIM_FUSE(fast)
        const quad wz = *(const quad*)(w + 8);
        return __builtin_shufflevector(wz, wz, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
    }

    // From the grid to 16 control nodes: in `rows` Σ w v, and Σ w v times the number of the grid node along x, y and z.
    ENDO_SIM_INLINE void gather(int block, Rows& from, vfloat* rows)
    {
        ENDO_SIM_FUSE(fast)
        const vfloat zero = {}, third = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0};
        const vint three = {-1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0};  // grid nodes of a row
        for (int lane = 0; lane < 16; ++lane) {
            const int node = 16 * block + lane;
            const float* w = weights_of(node);
            const vfloat z = along_row(w);
            if (beside_cut(node)) {
                from.cell = -1;
                for (int i = 0; i < 3; ++i)
                    for (int j = 0; j < 3; ++j) {
                        vfloat row = {};
                        for (int k = 0; k < 3; ++k)
                            for (int c = 0; c < 4; ++c)
                                row[4 * k + c] = gv[entry(node, i, j, k) + c];
                        from.row[3 * i + j] = row;
                    }
            } else if (base[node] != from.cell) {
                from.cell = base[node];
                for (int i = 0; i < 3; ++i)
                    for (int j = 0; j < 3; ++j)
                        from.row[3 * i + j] = three ? load(gv + 4 * (size_t)from.cell + i * sx + j * sy) : zero;
            }
            vfloat sum = zero, sum_x = zero, sum_y = zero;  // Σ w v (1, i, j) along x and y
            for (int i = 0; i < 3; ++i) {
                const vfloat second = w[5] * from.row[3 * i + 1], last = w[6] * from.row[3 * i + 2];
                const vfloat plane = w[4] * from.row[3 * i] + second + last;
                sum += w[i] * plane;
                sum_x += (i * w[i]) * plane;
                sum_y += w[i] * (second + 2.0f * last);
            }
            rows[lane] = sums(z * sum, z * sum_x, z * sum_y, third * z * sum);
        }
        transpose(rows);
    }

    // Add what tools gave in the substep that has just ended to the impulses of the tools.
    ENDO_SIM_INLINE void add_impulses(int block, const vfloat* u, const vfloat* v)
    {
        ENDO_SIM_FUSE(fast)
        const vint source_tool = source_tools[block];
        if (!any(source_tool >= 0))
            return;
        for (int lane = 0; lane < 16; ++lane)
            if (source_tool[lane] >= 0) {
                const int p = order[16 * block + lane];
                const size_t place = 3 * ((b * (size_t)tools.count + source_tool[lane]) * M + p);
                float *impulse = (float*)tools.impulse.data + place, *moment = (float*)tools.moment.data + place;
                float given[3], x[3];
                for (int i = 0; i < 3; ++i) {
                    given[i] = pulls[4 * block + i][lane] - pulls[4 * block + 3][lane] / substep.decay * v[i][lane];
                    x[i] = at(block, X + i)[lane] + u[i][lane] - substep.dt * v[i][lane];  // where it was given
                }
                for (int i = 0; i < 3; ++i) {
                    impulse[i] += given[i];
                    moment[i] += x[(i + 1) % 3] * given[(i + 2) % 3] - x[(i + 2) % 3] * given[(i + 1) % 3];
                }
            }
    }

    ENDO_SIM_INLINE void flush(const Rows& to)
    {
        ENDO_SIM_FUSE(fast)
        if (to.cell >= 0)
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    float* row = mv + 4 * (size_t)to.cell + i * sx + j * sy;
                    store(row, load(row) + to.row[3 * i + j]);
                }
    }

    // From 16 control nodes to the grid: `rows` are momentum and mass at the first grid node, and their growth along x, y, z.
    ENDO_SIM_INLINE void scatter(int block, vfloat* rows, Rows& to)
    {
        ENDO_SIM_FUSE(fast)
        const vfloat zero = {}, third = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0};
        transpose(rows);
        for (int lane = 0; lane < 16; ++lane) {
            const int node = 16 * block + lane;
            const float* w = weights_of(node);
            const vfloat z = along_row(w);
            const vfloat row = rows[lane];
            const vfloat corner = __builtin_shufflevector(row, row, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
            const vfloat ax = __builtin_shufflevector(row, row, 4, 5, 6, 7, 4, 5, 6, 7, 4, 5, 6, 7, 4, 5, 6, 7);
            const vfloat ay = __builtin_shufflevector(row, row, 8, 9, 10, 11, 8, 9, 10, 11, 8, 9, 10, 11, 8, 9, 10, 11);
            const vfloat az
                = __builtin_shufflevector(row, row, 12, 13, 14, 15, 12, 13, 14, 15, 12, 13, 14, 15, 12, 13, 14, 15);
            const vfloat start = z * (corner + third * az), growth_x = z * ax, growth_y = z * ay;
            const bool cut = beside_cut(node);
            if (!cut && base[node] != to.cell) {
                flush(to);
                to.cell = base[node];
                for (int i = 0; i < 9; ++i)
                    to.row[i] = zero;
            }
            for (int i = 0; i < 3; ++i) {
                const vfloat edge = w[i] * (start + (float)i * growth_x), growth = w[i] * growth_y;
                for (int j = 0; j < 3; ++j) {
                    const vfloat given = w[4 + j] * (edge + (float)j * growth);
                    if (!cut)
                        to.row[3 * i + j] += given;
                    else
                        for (int k = 0; k < 3; ++k)
                            for (int c = 0; c < 4; ++c)
                                mv[entry(node, i, j, k) + c] += given[4 * k + c];
                }
            }
        }
    }

    // Momenta to velocities with decay, then clear the momenta.
    ENDO_SIM_INLINE void update_grid(size_t begin, size_t end)
    {
        ENDO_SIM_FUSE(fast)
        const vfloat zero = {};
        size_t i = 4 * begin;
        for (; i + 16 <= 4 * end; i += 16) {
            const vfloat q = load(mv + i);
            const vfloat m = __builtin_shufflevector(q, q, 3, 3, 3, 3, 7, 7, 7, 7, 11, 11, 11, 11, 15, 15, 15, 15);
            store(gv + i, m > 0.0f ? q * (substep.decay / m) : zero);
            store(mv + i, zero);
        }
        for (; i < 4 * end; i += 4) {
            const quad q = *(const quad_anywhere*)(mv + i), none = {};
            *(quad_anywhere*)(gv + i) = q[3] > 0.0f ? q * (substep.decay / q[3]) : none;
            *(quad_anywhere*)(mv + i) = none;
        }
    }

    ENDO_SIM_INLINE void update_grid()
    {
        ENDO_SIM_FUSE(fast)
        for (int i = low[0]; i < high[0] + 3; ++i)
            for (int j = low[1]; j < high[1] + 3; ++j) {
                const size_t row = ((size_t)i * grid.ny + j) * grid.nz;
                update_grid(row + low[2], row + high[2] + 3);
            }
        update_grid((size_t)grid.nx * grid.ny * grid.nz, grid.count);  // the copies beside cuts
    }

    // One pass over the control nodes: what comes from the grid, if anything, and what goes to it, if anything.
    template <class Law> ENDO_SIM_INLINE void pass(bool gathers, bool scatters, float time)
    {
        ENDO_SIM_FUSE(fast)
        Rows from, to;
        for (int block = 0; block < padded / 16; ++block) {
            vfloat v[3], C[9], u[3], F[9], f[3], rows[16];
            for (int i = 0; i < 3; ++i)
                u[i] = at(block, U + i);
            for (int i = 0; i < 9; ++i)
                F[i] = at(block, F0 + i);
            if (gathers) {
                gather(block, from, rows);
                for (int i = 0; i < 3; ++i)
                    v[i] = rows[i];
                remembered(block, f);
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c)
                        C[3 * r + c] = 4.0f * grid.inverse_h * (rows[4 * (c + 1) + r] - f[c] * v[r]);
                move<CURRENT>(v, C, substep.dt, u, F);
                for (int i = 0; i < 9; ++i)
                    at(block, F0 + i) = F[i];
                for (int i = 0; i < 3; ++i)
                    at(block, U + i) = u[i];
                if (tools.count > 0)
                    add_impulses(block, u, v);
            } else {
                load_motion(block, v, C);
            }
            if (!scatters) {
                store_nodes(block, u, v, C, F);
                continue;
            }

            if (CURRENT)
                place(block, f);
            const Node<vfloat> node
                = {&at(block, X), u, v, C, F, &at(block, Q0), &at(block, FORCE), &at(block, TARGET), &at(block, TARGET_V),
                   at(block, MASS), at(block, VOLUME), at(block, MU), at(block, LAM), at(block, STIFFNESS), at(block, SPRING),
                   at(block, LIMIT), (vint)at(block, HOLDER)};
            const auto given = update<Law, CURRENT>(node, tools, b * tools.room, tools.used.data[b], grid, substep, time);
            if (tools.count > 0) {
                source_tools[block] = given.source_tool;
                for (int i = 0; i < 3; ++i)
                    pulls[4 * block + i] = given.pull[i];
                pulls[4 * block + 3] = given.added;
            }
            if (!gathers && !CURRENT)
                remembered(block, f);
            for (int r = 0; r < 3; ++r) {
                rows[r] = given.momentum[r];
                for (int c = 0; c < 3; ++c) {
                    rows[4 * (c + 1) + r] = given.growth[3 * r + c];
                    rows[r] -= given.growth[3 * r + c] * f[c];
                }
            }
            rows[3] = given.mass;
            rows[7] = rows[11] = rows[15] = vfloat{};
            scatter(block, rows, to);
        }
        if (scatters)
            flush(to);
    }

    template <class Law> ENDO_SIM_INLINE void run(int substeps, const float* scale)
    {
        ENDO_SIM_FUSE(fast)
        load_nodes(scale);
        for (size_t i = 0; i < 4 * (size_t)(grid.count + 4); ++i)
            mv[i] = 0.0f;
        empty_box();
        for (int block = 0; block < padded / 16; ++block) {
            vfloat f[3];
            place(block, f);
        }
        for (int s = 0; s <= substeps; ++s) {
            if (CURRENT)
                empty_box();
            pass<Law>(s > 0, s < substeps, (s + 1) * substep.dt);
            if (s < substeps)
                update_grid();
        }
    }
};

// All substeps of environment b, in the scratch memory of a slot.
template <class Law, bool CURRENT, class Nodes, class State, class Loads, class Tools, class Grid, class Substep>
ENDO_SIM_INLINE void take_step(
    size_t b, size_t slot, const Nodes& nodes, const State& state, const Loads& loads, const Tools& tools, const Grid& grid,
    const Substep& substep, int substeps, const float* scale, const int* order, float* momenta, float* velocities,
    float* scratch, int* bases, float* pulled, int* source_tools)
{
    ENDO_SIM_FUSE(fast)
    const int M = (int)nodes.X.shape.dims[0], padded = (M + 15) / 16 * 16;
    const size_t blocks = padded / 16, grid_floats = 4 * (size_t)(grid.count + 4);
    vfloat* const soa = (vfloat*)scratch + slot * CPU_SCRATCH * blocks;
    CpuStep<CURRENT, Nodes, State, Loads, Tools, Grid, Substep> step = {
        b, nodes, state, loads, tools, grid, substep, order,
        momenta + slot * grid_floats, velocities + slot * grid_floats,
        soa, (float*)(soa + COMPONENTS * blocks), bases + slot * (size_t)padded,
        (vfloat*)pulled + slot * 4 * blocks, (vint*)source_tools + slot * blocks,
        M, padded, 4 * (size_t)grid.ny * grid.nz, 4 * (size_t)grid.nz, {}, {}};
    step.template run<Law>(substeps, scale);
}

}  // namespace endo_sim
#endif
