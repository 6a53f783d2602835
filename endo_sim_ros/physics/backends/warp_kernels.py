"""Kernels of the material point method: MLS-MPM (Hu et al. 2018) with APIC transfers and quadratic B-splines.

For node p with weights w at grid nodes i (a distance d = X_i − X_p away), cell size h:

    P2G   (mv)_i += w [m (v + Δt g) + Δt (f − k (u − u*)) + (m C − Δt 4/h² V S) d],   m_i += w (m + Δt² k)
    grid  v_i = (mv)_i / m_i · exp(−c Δt)
    G2P   v = Σ w v_i,   C = 4/h² Σ w v_i dᵀ,   u += Δt v

With current kinematics X is the current position, S = τ and F ← (I + Δt C) F. With rest kinematics (total Lagrangian,
de Vaucorbeil et al. 2020) X is the rest position, S = P and F ← F + Δt C; the weights then never change, so stretched
tissue cannot lose contact with itself, and each grid node can add up its own nodes, in a fixed order: no atomics, and
the same bits in every run.

The state is a displacement u from rest in the solver's local frame, all float32. A launch covers all environments,
which are independent copies of the same nodes: node p of environment b is element b M + p.

Pinned nodes are held by springs k to the displacement u* = 0, grasped ones to a u* that moves evenly through the step;
k is zero for all others. Δt² k is the springs' implicit part, lumped, which makes them stable at any stiffness. (Holding
grid nodes instead puts the wall up to half a cell off, and kinematic nodes without stress leave the tissue next to the
wall hanging on nothing.) Rigid tools push in the same way, see `push_of_tools`; what springs and tools give to a node
is added up as impulses, so that the reaction is what the tissue really got.
"""

import functools

import warp as wp

from endo_sim_ros.physics.materials import MATERIALS, kirchhoff_stress, maxwell, second_piola

wp.set_module_options({"enable_backward": False})

PUSH_OUT = 0.5  # m/s; a tool that suddenly is deep within tissue pushes it out no faster than this
REDUCING = 512  # threads of a GPU's block that adds up over an environment
EASED = 0.9  # of its deformation is left to tissue of which two steps in a row were bad


@wp.struct
class Grid:
    """A regular grid whose node (i, j, k) lies at h (i, j, k) in the local frame and is number (i ny + j) nz + k.
    Behind the regular nodes lie copies of those that a cut has split; `count` is the number of all."""

    h: float
    inverse_h: float
    nx: int
    ny: int
    nz: int
    count: int


@wp.struct
class Nodes:
    """What all environments share [M]."""

    X: wp.array[wp.vec3]  # rest position, local, m
    mass: wp.array[float]  # kg
    volume: wp.array[float]  # at rest, m³
    mu: wp.array[float]  # Lamé's parameters, Pa
    lam: wp.array[float]
    stiffness: wp.array[float]  # N/m, of what holds or pushes the node; of each environment its own, [B · M]
    first: wp.array[wp.vec3i]  # first grid node (i, j, k) of its stencil at rest
    row: wp.array[int]  # in the table, of nodes beside a cut; -1 for all others
    table: wp.array[int]  # [A · 27] numbers of the grid nodes of each such node, k fastest


@wp.struct
class State:
    """What is stepped, all [B · M]."""

    u: wp.array[wp.vec3]  # displacement, m
    v: wp.array[wp.vec3]  # velocity, m/s
    C: wp.array[wp.mat33]  # APIC matrix: velocity gradient, 1/s
    F: wp.array[wp.mat33]  # deformation gradient
    Q: wp.array[wp.mat33]  # stress that the Maxwell branch has forgotten, Pa


@wp.struct
class Loads:
    """What acts on each node during the step, all [B · M]."""

    force: wp.array[wp.vec3]  # N
    spring: wp.array[float]  # N/m, of pinned and grasped nodes; zero where free
    target: wp.array[wp.vec3]  # displacement u* at the start of the step that the spring pulls to, m
    target_v: wp.array[wp.vec3]  # its velocity during the step, m/s
    holder: wp.array[int]  # tool whose jaw the spring belongs to, or did when the node was held last; -1 = none


@wp.struct
class RigidTools:
    """Capsules in the local frame, all [B · T]; their ends move evenly through the step."""

    count: int  # T
    friction: float  # Coulomb's coefficient
    tip: wp.array[wp.vec3]  # one end at the start of the step, m
    tip_v: wp.array[wp.vec3]  # m/s
    end: wp.array[wp.vec3]  # the other
    end_v: wp.array[wp.vec3]
    radius: wp.array[float]  # m; zero or less: touches nothing
    impulse: wp.array[wp.vec3]  # out [B · T · M]: what each gave to each node during the step, N·s
    moment: wp.array[wp.vec3]  # out [B · T · M]: its moment about the local origin, N·m·s


@wp.struct
class Transfer:
    """From nodes to the grid, all [B · M] but for the first, in fours that a GPU loads at once."""

    given: wp.array[wp.vec4]  # [B · M · 4] momentum at the node (kg·m/s) and mass with springs and contact (kg); its growth along x, y, z
    pull: wp.array[wp.vec4]  # the part of momentum and mass that springs and contact gave
    giver: wp.array[int]  # tool that gave it, -1 = none


@wp.struct
class Substep:
    dt: float  # s
    decay: float  # exp(-c Δt)
    gravity: wp.vec3  # m/s²
    ratio: float  # stiffness of the Maxwell branch over that of the elastic law, 0 = none
    forget: float  # 1 - exp(-Δt/τ) of it


_FOUR = "reinterpret_cast<float4*>(array.data)[index]"


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const float4 four = {_FOUR};
    return wp::vec4(four.x, four.y, four.z, four.w);
#else
    return array.data[index];
#endif
""")
def load(array: wp.array[wp.vec4], index: int) -> wp.vec4:
    """array[index], on a GPU in one piece."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    {_FOUR} = make_float4(value[0], value[1], value[2], value[3]);
#else
    array.data[index] = value;
#endif
""")
def store(array: wp.array[wp.vec4], index: int, value: wp.vec4):
    """array[index] = value, on a GPU in one piece."""
    ...


@wp.func
def three(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.func
def spline(x: float) -> wp.vec3:
    """Quadratic B-spline weights of the three grid nodes around a point x cells (0.5 to 1.5) past the first."""
    a, b, c = 1.5 - x, x - 1.0, x - 0.5
    return wp.vec3(0.5 * a * a, 0.75 - b * b, 0.5 * c * c)


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


@wp.func
def push_of_tools(tools: RigidTools, first: int, x: wp.vec3, v: wp.vec3, mass: float, stiffness: float, dt: float, time: float):
    """Momentum (x, y, z) and mass (w) by which the tool that a node is about to enter deepest pushes it out, and which.

    The tool is where it will be at the end of the substep, `time`. The node is drawn to the tool's surface along the
    normal n by an implicit spring k, mass Δt² k, with normal velocity −φ/Δt; along the surface that mass moves with the
    node, less what Coulomb's friction takes from the velocity relative to the tool.
    """
    deepest = float(0.0)
    giver = int(-1)
    normal, along = wp.vec3(), wp.vec3()
    outward = float(0.0)
    for t in range(tools.count):
        radius = tools.radius[first + t]
        if radius > 0.0:
            tip = tools.tip[first + t] + time * tools.tip_v[first + t]
            axis = tools.end[first + t] + time * tools.end_v[first + t] - tip
            share = wp.clamp(wp.dot(x - tip, axis) / wp.max(wp.length_sq(axis), 1.0e-12), 0.0, 1.0)
            arm = x - tip - share * axis
            distance = wp.length(arm)
            if distance > 1.0e-9:
                n = arm / distance
                gap = distance - radius
                if gap + dt * wp.dot(v, n) < deepest:
                    deepest = gap + dt * wp.dot(v, n)
                    giver = t
                    normal = n
                    along = tools.tip_v[first + t] + share * (tools.end_v[first + t] - tools.tip_v[first + t])
                    outward = wp.min(-gap / dt, wp.max(wp.dot(along, n), 0.0) + PUSH_OUT)
    pull = wp.vec4()
    if giver >= 0:
        added = dt * dt * stiffness
        slip = v - along - wp.dot(v - along, normal) * normal
        lost = tools.friction * added * wp.max(outward - wp.dot(v, normal), 0.0) / (mass + added)
        kept = wp.max(1.0 - lost / wp.max(wp.length(slip), 1.0e-12), 0.0)
        p = added * (outward * normal + along - wp.dot(along, normal) * normal + kept * slip)
        pull = wp.vec4(p[0], p[1], p[2], added)
    return pull, giver


@functools.cache
def make_advance_kernel(material: str, kinematics: str):
    """The kernel that takes grid velocities to nodes (G2P) and prepares what they give back; either half can be off."""
    stress_of = MATERIALS[material][0]
    current = kinematics == "current"

    @wp.kernel(enable_backward=False, module="unique")
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
            row = nodes.row[p]
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
            u += dt * v
            if wp.static(current):
                F += dt * (C * F)
            else:
                F += dt * C
            state.u[e] = u
            state.F[e] = F
            if scatter == 0:  # else they are only for what the node gives below
                state.v[e] = v
                state.C[e] = C
            giver = transfer.giver[e]
            if giver >= 0:
                pull = load(transfer.pull, e)
                given = three(pull) - (pull[3] / step.decay) * v
                tools.impulse[(b * tools.count + giver) * count + p] += given
                tools.moment[(b * tools.count + giver) * count + p] += wp.cross(X + u - dt * v, given)  # where it was given

        if scatter != 0:
            mass = nodes.mass[p]
            S = scale[e] * stress_of(F, nodes.mu[p], nodes.lam[p])
            if step.ratio > 0.0:
                Q = state.Q[e]
                Q += step.forget * (second_piola(F, S) - Q)
                state.Q[e] = Q
                S = maxwell(F, S, Q, step.ratio)
            if wp.static(current):
                S = kirchhoff_stress(S, F)
            spring = loads.spring[e]
            pull = wp.vec4()
            giver = int(-1)
            if spring > 0.0:
                giver = loads.holder[e]
                back = (-dt * spring) * (u - loads.target[e] - time * loads.target_v[e])
                pull = wp.vec4(back[0], back[1], back[2], dt * dt * spring)
            else:
                pull, giver = push_of_tools(tools, b * tools.count, X + u, v, mass, nodes.stiffness[e], dt, time)
            store(transfer.pull, e, pull)
            transfer.giver[e] = giver
            q = mass * (v + dt * step.gravity) + dt * loads.force[e] + three(pull)
            store(transfer.given, 4 * e, wp.vec4(q[0], q[1], q[2], mass + pull[3]))
            # What springs and contact add turns with the node: adding mass alone would resist turning.
            A = ((mass + pull[3]) * grid.h) * C - (dt * 4.0 * grid.inverse_h * nodes.volume[p]) * S
            for axis in range(3):
                store(transfer.given, 4 * e + 1 + axis, wp.vec4(A[0, axis], A[1, axis], A[2, axis], 0.0))

    return advance


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset /= 2)
        value += __shfl_xor_sync(0xffffffffu, value, offset);
#endif
    return value;
""")
def lane_sum(value: float) -> float:
    """Sum over the 32 lanes of a warp on a GPU, in the same order every time; on a CPU there is one lane."""
    ...


@wp.kernel
def collect(
    starts: wp.array[int],  # [n + 1] of the entries of each grid node that has any
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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ double sums[32];
    for (int offset = 16; offset > 0; offset /= 2)
        value += __shfl_xor_sync(0xffffffffu, value, offset);
    __syncthreads();  // the sums before have been read
    if (threadIdx.x % 32 == 0)
        sums[threadIdx.x / 32] = value;
    __syncthreads();
    value = 0.0;
    for (int warp = 0; warp < blockDim.x / 32; ++warp)
        value += sums[warp];
#endif
    return value;
""")
def block_sum(value: wp.float64) -> wp.float64:
    """Sum over the threads of a block on a GPU, in the same order every time; all must be here. On a CPU there is one."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float most[32];
    for (int offset = 16; offset > 0; offset /= 2)
        value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, offset));
    __syncthreads();
    if (threadIdx.x % 32 == 0)
        most[threadIdx.x / 32] = value;
    __syncthreads();
    for (int warp = 0; warp < blockDim.x / 32; ++warp)
        value = fmaxf(value, most[warp]);
#endif
    return value;
""")
def block_max(value: float) -> float:
    """Largest value of the threads of a block on a GPU; all must be here."""
    ...


@wp.kernel
def end_step(threads: int, count: int, travel: float, backup: State, state: State, faults: wp.array[int], speed_sq: wp.array[float]):
    """Count nodes that are not finite or out of bounds (the comparisons are false for NaN) and find the largest v².

    Environments where there are any return to the state before the step, at rest there. Where the step before was bad as
    well, they give way towards rest: from tissue that is turned inside out or stretched too far for its substeps every step
    is bad. u and F − 1 shrink together, and still fit.
    """
    b, thread = wp.tid()
    before = faults[b]
    bad, fastest = wp.float64(0.0), float(0.0)
    for p in range(thread, count, threads):
        e = b * count + p
        if not (wp.length_sq(state.u[e]) <= travel * travel and wp.ddot(state.F[e], state.F[e]) < 1.0e4):
            bad += wp.float64(1.0)
        fastest = wp.max(fastest, wp.length_sq(state.v[e]))
    bad, fastest = block_sum(bad), block_max(fastest)
    if thread == 0:
        faults[b] = int(bad)
        speed_sq[b] = fastest
    if bad > wp.float64(0.0):
        for p in range(thread, count, threads):
            e = b * count + p
            state.u[e] = backup.u[e]
            state.F[e] = backup.F[e]
            state.Q[e] = backup.Q[e]
            if before > 0:
                state.u[e] = EASED * backup.u[e]
                state.F[e] = EASED * (backup.F[e] - wp.identity(3, float)) + wp.identity(3, float)
                state.Q[e] = EASED * backup.Q[e]
            state.v[e] = wp.vec3()
            state.C[e] = wp.mat33()
