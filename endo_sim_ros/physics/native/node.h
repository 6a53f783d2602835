// The update of a control node in one substep: from its motion to what it gives to the grid. One definition for every kernel.
//
// The maths is in backends/plain_kernels.py. One node a lane; vectors are three and matrices nine numbers, row by row.
#pragma once
#include "physics/native/materials.h"

namespace endo_sim {

// Cosine of the angle between the ways out of two capsules from which on these face each other: 120°. Links of a wrist meet at
// 100° at most, jaws on either side of tissue at 180°.
constexpr float FACING = -0.5f;

// A node, with pointers to what is only read if need be.
template <class T> struct Node {
    const T* X;  // where it is at rest
    const T* u;  // displacement
    const T* v;
    const T* C;
    const T* F;
    T* Q;  // in and out: stress that the Maxwell branch has forgotten
    const T* force;
    const T* target;  // of the spring
    const T* target_v;
    T mass, volume, mu, lam;
    T stiffness;  // of what grasps it or pushes it at a surface
    T spring;  // zero where free
    T limit;  // of the spring's force, zero without one
    integers_of<T> holder;  // tool that the spring belongs to
};

// What it gives: momentum at the node and its growth along x, y and z (for each of its components r the three 3 r + c), and mass.
template <class T> struct Given {
    T momentum[3], growth[9], mass;
    T pull[3], added;  // the part of momentum and mass that a tool gave
    integers_of<T> source_tool;  // that gave it, -1 = none
};

// Quadratic B-spline weights of the three grid nodes around a point x cells (0.5 to 1.5) past the first.
template <class T> ENDO_SIM_INLINE void spline(T x, T* weights)
{
    ENDO_SIM_FUSE(on)
    const T a = 1.5f - x, b = x - 1.0f, c = x - 0.5f;
    weights[0] = 0.5f * a * a;
    weights[1] = 0.75f - b * b;
    weights[2] = 0.5f * c * c;
}

// Move a node on: u += Δt v, and F += Δt C or, with current kinematics, Δt C F.
template <bool CURRENT, class T> ENDO_SIM_INLINE void move(const T* v, const T* C, float dt, T* u, T* F)
{
    ENDO_SIM_FUSE(on)
    T rate[9];
    for (int i = 0; i < 3; ++i)
        u[i] += dt * v[i];
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
            rate[3 * r + c]

                = CURRENT ? C[3 * r] * F[c] + C[3 * r + 1] * F[3 + c] + C[3 * r + 2] * F[6 + c] : C[3 * r + c];
    for (int i = 0; i < 9; ++i)
        F[i] += dt * rate[i];
}

// P of an elastic law with a Maxwell branch beside it (standard linear solid; Simo 1987): P + g (P − F Q).
//
// The branch has g times the stiffness of the law, of which it has forgotten Q. That follows S = F⁻¹ P, the stress that a
// rotation of the tissue does not change: dQ/dt = (S − Q)/τ. Fast tissue is 1 + g times as stiff as tissue at rest, and held
// tissue relaxes with the time τ. S is finite for collapsed F as well.
template <class T> ENDO_SIM_INLINE void relax(const T* F, T J, float ratio, float forget, T* Q, T* P)
{
    ENDO_SIM_FUSE(on)
    T cofactor[9], given[9];
    cofactor_of(F, cofactor);
    J = larger(J, everywhere<T>(LEAST_VOLUME));
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            const T S = (cofactor[r] * P[c] + cofactor[3 + r] * P[3 + c] + cofactor[6 + r] * P[6 + c]) / J;
            Q[3 * r + c] += forget * (S - Q[3 * r + c]);
        }
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            given[3 * r + c] = P[3 * r + c];
            for (int k = 0; k < 3; ++k)
                given[3 * r + c] -= F[3 * r + k] * Q[3 * k + c];
        }
    for (int i = 0; i < 9; ++i)
        P[i] += ratio * given[i];
}

// τ = P Fᵀ.
template <class T> ENDO_SIM_INLINE void kirchhoff(const T* F, T* P)
{
    ENDO_SIM_FUSE(on)
    T tau[9];
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
            tau[3 * r + c] = P[3 * r + 1] * F[3 * c + 1] + P[3 * r] * F[3 * c] + P[3 * r + 2] * F[3 * c + 2];
    for (int i = 0; i < 9; ++i)
        P[i] = tau[i];
}

// The spring that pins or grasps a node, until `time` of the step: mass Δt² k and momentum −Δt k (u − u*).
//
// Where its force has a limit, as tissue between jaws that hold it by friction, k is as much smaller as keeps the impulse
// Δt² k |v* − v| below the limit; v* = −(u − u*)/Δt is where the spring draws the node to.
template <class T> ENDO_SIM_INLINE void pull_by_spring(const Node<T>& node, float dt, float time, Given<T>& given)
{
    ENDO_SIM_FUSE(on)
    const auto held = node.spring > 0.0f;
    if (!any(held))
        return;
    T spring = node.spring;
    if (any(node.limit > 0.0f)) {
        T wanted[3];  // Δt (v* − v)
        for (int i = 0; i < 3; ++i)
            wanted[i] = -(node.u[i] - node.target[i] - time * node.target_v[i]) - dt * node.v[i];
        const T most = node.limit / larger(root(dot(wanted, wanted)), everywhere<T>(1e-12f));
        spring = node.limit > 0.0f ? smaller(spring, most) : spring;
    }
    given.mass = dt * dt * spring;
    for (int i = 0; i < 3; ++i)
        given.momentum[i] = -dt * spring * (node.u[i] - node.target[i] - time * node.target_v[i]);
    const auto grasped = held & (node.holder >= 0);
    given.added = grasped ? given.mass : given.added;
    for (int i = 0; i < 3; ++i)
        given.pull[i] = grasped ? given.momentum[i] : given.pull[i];
    given.source_tool = grasped ? node.holder : given.source_tool;
}

// Momentum and mass by which the capsule that a node is about to enter deepest pushes it out. The pins of tissue that is held
// resist; tissue that a jaw has grasped is its jaw's.
//
// The capsule is where it will be at the end of the substep, `time`. The node is drawn to its surface along the normal n
// by an implicit spring k, mass Δt² k, with normal velocity −φ/Δt; along the surface that mass moves with the node, less
// what Coulomb's friction takes from the velocity relative to the tool. Where that velocity has a limit, the mass is as much
// larger: a node that is deep inside comes out slowly, but with all the force of the spring, or a tool that tissue resists
// would pass through its nodes. A node between two capsules of a tool that face each
// other, such as its jaws, is pushed by neither: one would push it into the other.
template <class T, class Tools>
ENDO_SIM_INLINE void push_by_tools(
    const Node<T>& node, const Tools& tools, int first, int count, float dt, float time, Given<T>& given)
{
    ENDO_SIM_FUSE(on)
    const T zero = {};
    const auto grasped = given.source_tool >= 0;
    if (!any(negated(grasped)))
        return;
    T deepest = zero, inside = zero, outward = zero, normal[3] = {}, along[3] = {};
    integers_of<T> pushing = integers_of<T>{} - 1, pinched = {};
    for (int capsule = first; capsule < first + count; ++capsule) {
        const int tool = tools.tool.data[capsule];
        const float radius = tools.radius.data[capsule];
        float tip[3], axis[3], square = 0.0f;
        const float *tip_v = tools.tip_v.data[capsule].c, *end_v = tools.end_v.data[capsule].c;
        for (int i = 0; i < 3; ++i) {
            tip[i] = tools.tip.data[capsule].c[i] + time * tip_v[i];
            axis[i] = tools.end.data[capsule].c[i] + time * end_v[i] - tip[i];
            square += axis[i] * axis[i];
        }
        T arm[3], share = zero;
        for (int i = 0; i < 3; ++i) {
            arm[i] = node.X[i] + node.u[i] - tip[i];
            share += arm[i] * axis[i];
        }
        share = clamp(share / (square > 1e-12f ? square : 1e-12f), 0.0f, 1.0f);
        for (int i = 0; i < 3; ++i)
            arm[i] -= share * axis[i];
        const T apart = dot(arm, arm);
        const float reach = radius + dt * 10.0f;
        if (!any(apart < reach * reach))  // nothing comes nearer at 10 m/s
            continue;
        const T distance = root(apart);
        const T gap = distance - radius;
        for (int i = 0; i < 3; ++i)
            arm[i] /= larger(distance, everywhere<T>(1e-9f));
        const T predicted = gap + dt * dot(node.v, arm);
        const auto entering = (distance > 1e-9f) & (predicted < 0.0f) & negated(grasped) & (node.mass > 0.0f);
        if (!any(entering))
            continue;
        const auto facing = entering & (pushing == tool) & (dot(arm, normal) < FACING);
        pinched = facing ? integers_of<T>{} + 1 : pinched;
        const auto deeper = entering & (predicted < deepest);
        T moving[3];
        for (int i = 0; i < 3; ++i)
            moving[i] = tip_v[i] + share * (end_v[i] - tip_v[i]);
        const T out = smaller(-gap / dt, larger(dot(moving, arm), zero) + tools.push_out);
        // The impulse that the spring wants, over Δt² k.
        inside = deeper ? -gap / dt * (1.0f + tools.stiffening.data[capsule] * clamp(-gap / radius, 0.0f, 1.0f)) : inside;
        deepest = deeper ? predicted : deepest;
        pushing = deeper ? integers_of<T>{} + tool : pushing;
        outward = deeper ? out : outward;
        for (int i = 0; i < 3; ++i) {
            normal[i] = deeper ? arm[i] : normal[i];
            along[i] = deeper ? moving[i] : along[i];
        }
    }
    const auto pushed = (pushing >= 0) & (pinched == 0);
    if (!any(pushed))
        return;
    const T times = larger(inside, zero) / larger(outward, everywhere<T>(1e-9f));
    const T weight = dt * dt * node.stiffness * larger(times, everywhere<T>(1.0f));
    const T towards = dot<1>(along, normal);
    T slip[3];
    for (int i = 0; i < 3; ++i)
        slip[i] = node.v[i] - along[i];
    const T parting = dot<1>(slip, normal);
    for (int i = 0; i < 3; ++i)
        slip[i] -= parting * normal[i];
    const T lost = tools.friction * weight * larger(outward - dot<1>(node.v, normal), zero) / (node.mass + weight);
    const T speed = larger(root(dot(slip, slip)), everywhere<T>(1e-12f));
    const T kept = larger(1.0f - lost / speed, zero);
    for (int i = 0; i < 3; ++i) {
        const T push = pushed ? weight * (outward * normal[i] + along[i] - towards * normal[i] + kept * slip[i]) : zero;
        given.pull[i] = pushed ? push : given.pull[i];
        given.momentum[i] += push;
    }
    given.added = pushed ? weight : given.added;
    given.mass += pushed ? weight : zero;
    given.source_tool = pushed ? pushing : given.source_tool;
}

// What a node gives to the grid in a substep that ends at `time` of the step, while so many capsules push, from the first on.
template <class Law, bool CURRENT, class T, class Tools, class Grid, class Substep>
ENDO_SIM_INLINE Given<T> update(
    const Node<T>& node, const Tools& tools, int first_capsule, int capsules, const Grid& grid, const Substep& substep,
    float time)
{
    ENDO_SIM_FUSE(on)
    const float dt = substep.dt;
    T P[9];
    const T J = Law::stress(node.F, node.mu, node.lam, substep, P);
    if (substep.ratio > 0.0f)
        relax(node.F, J, substep.ratio, substep.forget, node.Q, P);
    if (CURRENT)
        kirchhoff(node.F, P);
    Given<T> given = {};
    given.source_tool = integers_of<T>{} - 1;
    pull_by_spring(node, dt, time, given);
    push_by_tools(node, tools, first_capsule, capsules, dt, time, given);
    given.mass += node.mass;
    const T share = dt * 4.0f * grid.inverse_h * node.volume;
    for (int r = 0; r < 3; ++r) {
        given.momentum[r] += node.mass * (node.v[r] + dt * substep.gravity[r]) + dt * node.force[r];
        // What springs and contact add turns with the node: adding mass alone would resist turning.
        for (int c = 0; c < 3; ++c)
            given.growth[3 * r + c] = (given.mass * grid.h) * node.C[3 * r + c] - share * P[3 * r + c];
    }
    return given;
}

// `update` of one control node in the vectors and matrices of Warp. Momentum and pull have their mass
// after x, y and z; returns the tool that gave the pull.
template <class Law, bool CURRENT, class Tools, class Grid, class Substep, class Three, class Nine, class Four>
ENDO_SIM_INLINE int update_one(const Tools& tools, int first_capsule, int capsules, const Grid& grid, const Substep& substep,
    float time, const Three& X, const Three& u, const Three& v, const Nine& C, const Nine& F, Nine& Q, const Three& force,
    const Three& target, const Three& target_v, float mass, float volume, float mu, float lam, float stiffness, float spring,
    float limit, int holder, Four& momentum, Nine& growth, Four& pull)
{
    const Node<float> node = {X.c, u.c, v.c, &C.data[0][0], &F.data[0][0], &Q.data[0][0], force.c, target.c, target_v.c,
        mass, volume, mu, lam, stiffness, spring, limit, holder};
    const auto given = update<Law, CURRENT>(node, tools, first_capsule, capsules, grid, substep, time);
    for (int r = 0; r < 3; ++r) {
        momentum.c[r] = given.momentum[r];
        for (int c = 0; c < 3; ++c)
            growth.data[r][c] = given.growth[3 * r + c];
        pull.c[r] = given.pull[r];
    }
    momentum.c[3] = given.mass;
    pull.c[3] = given.added;
    return given.source_tool;
}

}  // namespace endo_sim
