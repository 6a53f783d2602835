"""Kernels of the material point method: MLS-MPM (Hu et al. 2018) with APIC transfers and quadratic B-splines.

For control node p with weights w at grid nodes i (a distance d = X_i − X_p away), cell size h:

    P2G   (mv)_i += w [m (v + Δt g) + Δt (f − k (u − u*)) + (m C − Δt 4/h² V S) d],   m_i += w (m + Δt² k)
    grid  v_i = (mv)_i / m_i · exp(−c Δt)
    G2P   v = Σ w v_i,   C = 4/h² Σ w v_i dᵀ,   u += Δt v

With current kinematics X is the current position, S = τ and F ← (I + Δt C) F. With rest kinematics (total Lagrangian,
de Vaucorbeil et al. 2020) X is the rest position, S = P and F ← F + Δt C; the weights then never change, so stretched
tissue cannot lose contact with itself, and each grid node can add up its own control nodes, in a fixed order: no atomics,
and the same bits in every run. The state is a displacement u from rest, see `structs`.

Pinned control nodes are held by springs k to the displacement u* = 0, grasped ones to a u* that moves evenly through the step;
k is zero for all others. Δt² k is the springs' implicit part, lumped, which makes them stable at any stiffness. (Holding
grid nodes instead puts the wall up to half a cell off, and kinematic nodes without stress leave the tissue next to the
wall hanging on nothing.) Rigid tools push in the same way, see native/node.h; what springs and tools give to a control
node is added up as impulses, so that the reaction is what the tissue really got.
"""

import functools

import warp as wp

from endo_sim_ros.core.native import native
from endo_sim_ros.physics.backends.structs import Grid, Loads, Nodes, RigidTools, State, Substep, Transfer

OPTIONS = {"extra_build_options": native("physics/native/node.h", "core/native/threads.h")}
wp.set_module_options({"enable_backward": False, **OPTIONS})


@wp.func_native("return endo_sim::load_four(array.data + index);")
def load(array: wp.array[wp.vec4], index: int) -> wp.vec4:
    """array[index], on a GPU in one piece."""


@wp.func_native("endo_sim::store_four(array.data + index, value);")
def store(array: wp.array[wp.vec4], index: int, value: wp.vec4):
    """array[index] = value, on a GPU in one piece."""


@wp.func
def three(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.func_native("wp::vec3 weights; endo_sim::spline(x, weights.c); return weights;")
def spline(x: float) -> wp.vec3:
    """Quadratic B-spline weights of the three grid nodes around a point x cells (0.5 to 1.5) past the first."""


@wp.func
def first_cell(x: float, n: int) -> int:
    """First of the three grid nodes along one axis; clamped, so that a runaway node stays inside the grid.

    Before the conversion: what an integer cannot hold, and NaN, would become any integer, past a later clamp.
    """
    first = wp.floor(x - 0.5)
    if first > 0.0:  # not NaN
        return int(wp.min(first, float(n - 3)))
    return 0


@wp.func
def grid_node(nodes: Nodes, row: int, entry: int, regular: int) -> int:
    """Number of a grid node: the regular one, or the one in the table for a node beside a cut."""
    if row < 0:
        return regular
    return nodes.table[27 * row + entry]


@functools.cache
def node_update(material: str, kinematics: str) -> wp.Function:
    """`update` of native/node.h for one control node: what it gives to the grid in a substep that ends at `time` of the step."""

    @wp.func_native(f"""
        return endo_sim::update_one<endo_sim::{material}, {native_bool(kinematics == "current")}>(
            tools, first_capsule, capsules, grid, substep, time, X, u, v, C, F, Q, force, target, target_v,
            mass, volume, mu, lam, stiffness, spring, limit, holder, momentum, growth, pull);
    """)
    def update(
        tools: RigidTools,
        first_capsule: int,
        capsules: int,
        grid: Grid,
        substep: Substep,
        time: float,
        X: wp.vec3,
        u: wp.vec3,
        v: wp.vec3,
        C: wp.mat33,
        F: wp.mat33,
        Q: wp.ref[wp.mat33],
        force: wp.vec3,
        target: wp.vec3,
        target_v: wp.vec3,
        mass: float,
        volume: float,
        mu: float,
        lam: float,
        stiffness: float,
        spring: float,
        limit: float,
        holder: int,
        momentum: wp.ref[wp.vec4],
        growth: wp.ref[wp.mat33],
        pull: wp.ref[wp.vec4],
    ) -> int: ...

    return update


@functools.cache
def node_move(kinematics: str) -> wp.Function:
    """`move` of native/node.h for one control node: displacement and deformation gradient at the end of a substep."""

    @wp.func_native(f"endo_sim::move<{native_bool(kinematics == 'current')}>(v.c, &C.data[0][0], dt, u.c, &F.data[0][0]);")
    def move(v: wp.vec3, C: wp.mat33, dt: float, u: wp.ref[wp.vec3], F: wp.ref[wp.mat33]): ...

    return move


def native_bool(value: bool) -> str:
    """A truth value as C++ has it."""
    return str(value).lower()


@functools.cache
def make_advance_kernel(material: str, kinematics: str):
    """The kernel that takes grid velocities to nodes (G2P) and prepares what they give back; either half can be off."""
    current = kinematics == "current"
    update, move = node_update(material, kinematics), node_move(kinematics)

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS)
    def advance(
        nodes: Nodes,
        state: State,
        loads: Loads,
        tools: RigidTools,
        transfer: Transfer,
        grid: Grid,
        step: Substep,
        scale: wp.array[float],  # of the moduli of each node [B · M]
        time: float,  # at the end of the substep, since the start of the step
        gather: int,
        scatter: int,
        grid_v: wp.array[wp.vec4],  # [B · count]
    ):
        b, p = wp.tid()
        count = nodes.X.shape[0]
        e = b * count + p
        dt = step.dt
        u = state.u[e]
        F = state.F[e]
        X = nodes.X[p]
        v = wp.vec3()
        C = wp.mat33()
        if gather == 0:
            v = state.v[e]
            C = state.C[e]
        else:
            x = X * grid.inverse_h
            first_node = nodes.first[p]
            if wp.static(current):
                x = (X + u) * grid.inverse_h
                first_node = wp.vec3i(first_cell(x[0], grid.nx), first_cell(x[1], grid.ny), first_cell(x[2], grid.nz))
            i0, j0, k0 = first_node[0], first_node[1], first_node[2]
            f = wp.vec3(x[0] - float(i0), x[1] - float(j0), x[2] - float(k0))
            wx, wy, wz = spline(f[0]), spline(f[1]), spline(f[2])
            row = nodes.row[e]
            first = b * grid.count
            cx, cy, cz = wp.vec3(), wp.vec3(), wp.vec3()  # columns of Σ w v_i (i, j, k)
            for i in range(3):
                plane, plane_y, plane_z = wp.vec3(), wp.vec3(), wp.vec3()
                for j in range(3):
                    regular = ((i0 + i) * grid.ny + j0 + j) * grid.nz + k0
                    entry = 9 * i + 3 * j
                    g0 = wz[0] * three(load(grid_v, first + grid_node(nodes, row, entry, regular)))
                    g1 = wz[1] * three(load(grid_v, first + grid_node(nodes, row, entry + 1, regular + 1)))
                    g2 = wz[2] * three(load(grid_v, first + grid_node(nodes, row, entry + 2, regular + 2)))
                    line = g0 + g1 + g2
                    plane += wy[j] * line
                    plane_y += wy[j] * float(j) * line
                    plane_z += wy[j] * (g1 + 2.0 * g2)
                v += wx[i] * plane
                cx += wx[i] * float(i) * plane
                cy += wx[i] * plane_y
                cz += wx[i] * plane_z
            # Σ w v_i (X_i − X_p)ᵀ, with X_p at f cells.
            C = 4.0 * grid.inverse_h * wp.matrix_from_cols(cx - f[0] * v, cy - f[1] * v, cz - f[2] * v)
            move(v, C, dt, u, F)
            state.u[e] = u
            state.F[e] = F
            if scatter == 0:  # else they are only for what the node gives below
                state.v[e] = v
                state.C[e] = C
            source_tool = transfer.source_tool[e]
            if source_tool >= 0:
                pulled = load(transfer.pull, e)
                given = three(pulled) - (pulled[3] / step.decay) * v
                tools.impulse[(b * tools.count + source_tool) * count + p] += given
                tools.moment[(b * tools.count + source_tool) * count + p] += wp.cross(X + u - dt * v, given)  # where it was given

        if scatter != 0:
            Q = wp.mat33()
            if step.ratio > 0.0:
                Q = state.Q[e]
            momentum, growth, pull = wp.vec4(), wp.mat33(), wp.vec4()
            transfer.source_tool[e] = update(
                tools, b * tools.room, tools.used[b], grid, step, time, X, u, v, C, F, Q, loads.force[e], loads.target[e],
                loads.target_v[e], nodes.mass[p], nodes.volume[p], scale[e] * nodes.mu[p], scale[e] * nodes.lam[p],
                nodes.stiffness[e], loads.spring[e], loads.limit[e], loads.holder[e], momentum, growth, pull,
            )  # fmt: skip
            if step.ratio > 0.0:
                state.Q[e] = Q
            store(transfer.pull, e, pull)
            store(transfer.given, 4 * e, momentum)
            for axis in range(3):
                store(transfer.given, 4 * e + 1 + axis, wp.vec4(growth[0, axis], growth[1, axis], growth[2, axis], 0.0))

    return advance


@wp.func_native("return endo_sim::lane_sum(value);")
def lane_sum(value: float) -> float:
    """Sum over the 32 lanes of a warp on a GPU, in the same order every time; on a CPU there is one lane."""


@wp.kernel
def collect(
    lists: wp.array[wp.vec2i],  # [B] the grid nodes of each environment that have any: first and end, in the next
    starts: wp.array[int],  # [n + 1] of the entries of each grid node
    members: wp.array[int],  # [E] nodes that give to it
    offsets: wp.array[wp.vec4],  # [E] from node to grid node, cells, and weight
    places: wp.array[int],  # [n] numbers of the grid nodes
    lanes: int,
    count: int,  # M
    grid: Grid,
    decay: float,
    transfer: Transfer,
    grid_v: wp.array[wp.vec4],
):
    """Grid velocities with decay, each grid node adding up what its nodes give. For rest kinematics, whose weights stay."""
    b, n, lane = wp.tid()
    n += lists[b][0]
    if n >= lists[b][1]:
        return
    total = wp.vec4()
    for entry in range(starts[n] + lane, starts[n + 1], lanes):
        e = 4 * (b * count + members[entry])
        offset = load(offsets, entry)
        given = load(transfer.given, e)
        given += offset[0] * load(transfer.given, e + 1) + offset[1] * load(transfer.given, e + 2)
        total += offset[3] * (given + offset[2] * load(transfer.given, e + 3))
    total = wp.vec4(lane_sum(total[0]), lane_sum(total[1]), lane_sum(total[2]), lane_sum(total[3]))
    if lane == 0:
        v = wp.vec4()
        if total[3] > 0.0:
            v = (decay / total[3]) * total
        store(grid_v, b * grid.count + places[n], v)


@wp.kernel
def scatter(nodes: Nodes, state: State, transfer: Transfer, grid: Grid, grid_mv: wp.array[wp.vec4]):
    """Grid momenta and masses, each node adding what it gives. For current kinematics."""
    b, p = wp.tid()
    e = b * nodes.X.shape[0] + p
    x = (nodes.X[p] + state.u[e]) * grid.inverse_h
    i0, j0, k0 = first_cell(x[0], grid.nx), first_cell(x[1], grid.ny), first_cell(x[2], grid.nz)
    f = wp.vec3(x[0] - float(i0), x[1] - float(j0), x[2] - float(k0))
    wx, wy, wz = spline(f[0]), spline(f[1]), spline(f[2])
    q, ax, ay, az = (
        load(transfer.given, 4 * e), load(transfer.given, 4 * e + 1), load(transfer.given, 4 * e + 2), load(transfer.given, 4 * e + 3),
    )  # fmt: skip
    for i in range(3):
        for j in range(3):
            for k in range(3):
                given = q + (float(i) - f[0]) * ax + (float(j) - f[1]) * ay + (float(k) - f[2]) * az
                w = wx[i] * wy[j] * wz[k]
                place = b * grid.count + ((i0 + i) * grid.ny + j0 + j) * grid.nz + k0 + k
                wp.atomic_add(grid_mv, place, w * given)


@wp.kernel
def update_grid(decay: float, grid_mv: wp.array[wp.vec4], grid_v: wp.array[wp.vec4]):
    """Momenta to velocities with decay, then clear the momenta. For current kinematics."""
    i = wp.tid()
    q = load(grid_mv, i)
    v = wp.vec4()
    if q[3] > 0.0:
        v = (decay / q[3]) * q
    store(grid_v, i, v)
    store(grid_mv, i, wp.vec4())
