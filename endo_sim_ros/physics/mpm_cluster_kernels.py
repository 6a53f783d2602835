"""The step of the material point method on a GPU that has clusters of multiprocessors: all substeps in one launch.

Same maths as `mpm_kernels` (read its header first), for rest kinematics. A few thousand nodes cannot keep a GPU busy: the
time goes into launches and into waiting for memory. Here a cluster of blocks has an environment to itself. Each block owns
a compact piece of the tissue, whose nodes stay in the registers of a few lanes each for the whole step, and a *patch* of
the grid, all grid nodes that its piece reaches, in shared memory. In a substep it adds up what its nodes give to its patch,
and publishes that; once all blocks have, it adds up what they published about its
patch, which takes few loads, as pieces touch at their faces only. Every sum has a fixed order: same bits in every run.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from endo_sim_ros.physics.materials import MATERIALS, maxwell, second_piola
from endo_sim_ros.physics.mpm_kernels import Grid, Loads, Nodes, RigidTools, State, Substep, load, push_of_tools, spline, store, three

BLOCK = 256  # threads of a block; with more there are too few registers
CLUSTER = 16  # blocks
THREADS = CLUSTER * BLOCK
AT_ONCE = 4  # loads of a thread that adds up
SHARED = 2880  # fours of float32 in shared memory: 48 kB less what Warp takes


# ---------------------------------------------------------------- who owns what


class Division(NamedTuple):
    """How the nodes and the grid are divided among the blocks of a cluster.

    A node's stencil has three planes of nine grid nodes. What nodes give passes through shared memory some planes at a time.
    """

    lanes: int  # that share a node
    passes: int
    collecting: int  # lanes that share a grid node of a patch,
    rounds: int  # and how many each looks after
    nodes: np.ndarray  # [CLUSTER, P] int32, as all below: nodes of each piece, -1 = none
    corners: np.ndarray  # [CLUSTER, P, 27] place in its patch of each node's grid nodes
    slots: np.ndarray  # [CLUSTER, P, 27] place in shared memory of what it gives to them
    rows: np.ndarray  # [CLUSTER, passes, G + 1] first slot of each grid node of the patch
    shares: np.ndarray  # [CLUSTER, G, 2] first and end of the places where its grid node was published
    published: np.ndarray  # [S] these places


def divide(rest_cells: np.ndarray, corners: np.ndarray) -> Division | None:
    """Divide nodes at [M, 3] (cells), each with the numbers of its grid nodes [M, 27]; None if they are too many."""
    pieces = _bisect(rest_cells, np.arange(len(rest_cells)), CLUSTER)
    largest = max(len(piece) for piece in pieces)
    patches = [np.unique(corners[piece]) for piece in pieces]
    size = max(len(patch) for patch in patches)
    lanes = next((lanes for lanes in (4, 2, 1) if lanes * largest <= BLOCK), 0)
    planes = next((planes for planes in (3, 2, 1) if 9 * planes * largest <= SHARED), 0)
    if not lanes or not planes or size > min(SHARED, 4 * BLOCK):
        return None
    collecting = 2 if 2 * size <= BLOCK else 1
    passes = -(-3 // planes)
    nodes = np.full((CLUSTER, largest), -1, np.int32)
    local, slots = np.zeros((2, CLUSTER, largest, 27), np.int32)
    rows = np.zeros((CLUSTER, passes, size + 1), np.int32)
    shares = np.zeros((CLUSTER, size, 2), np.int32)
    for i, (piece, patch) in enumerate(zip(pieces, patches)):
        nodes[i, : len(piece)] = piece
        local[i, : len(piece)] = np.searchsorted(patch, corners[piece])
        for n in range(passes):
            part = slice(9 * planes * n, 9 * planes * (n + 1))
            given = local[i, : len(piece), part]
            place = np.empty(given.size, np.int32)
            place[np.argsort(given.ravel(), kind="stable")] = np.arange(given.size)
            slots[i, : len(piece), part] = place.reshape(given.shape)
            rows[i, n] = np.searchsorted(np.sort(given.ravel()), np.arange(size + 1))
    numbers = np.concatenate(patches)
    places = np.concatenate([i * size + np.arange(len(patch)) for i, patch in enumerate(patches)])
    order = np.argsort(numbers, kind="stable")
    for i, patch in enumerate(patches):
        shares[i, : len(patch), 0] = np.searchsorted(numbers[order], patch, "left")
        shares[i, : len(patch), 1] = np.searchsorted(numbers[order], patch, "right")
    rounds = -(-size * collecting // BLOCK)
    return Division(lanes, passes, collecting, rounds, nodes, local, slots, rows, shares, places[order].astype(np.int32))


def _bisect(points: np.ndarray, members: np.ndarray, count: int) -> list[np.ndarray]:
    """Divide points [M, 3] into compact sets of nearly the same size, a power of two of them."""
    if count == 1:
        return [np.sort(members)]
    along = np.ptp(points[members], axis=0).argmax() if len(members) else 0
    members = members[np.argsort(points[members, along], kind="stable")]
    half = (len(members) + 1) // 2
    return _bisect(points, members[:half], count // 2) + _bisect(points, members[half:], count // 2)


# ---------------------------------------------------------------- threads together


@wp.func_native("""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    asm volatile("barrier.cluster.arrive.release;" ::: "memory");
    asm volatile("barrier.cluster.wait.acquire;" ::: "memory");
#endif
""")
def wait_for_cluster():
    """Until all threads of the cluster are here, and see what the others wrote."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_block():
    """Until all threads of the block are here."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ float4 memory[{SHARED}];
    return (int)__cvta_generic_to_shared(memory);
#else
    return 0;
#endif
""")
def shared_memory() -> int:
    """Where the shared memory of the block begins."""
    ...


@wp.func_native("""
    wp::vec4 value;
#if defined(__CUDA_ARCH__)
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
        : "=f"(value[0]), "=f"(value[1]), "=f"(value[2]), "=f"(value[3]) : "r"(memory + 16 * i) : "memory");
#endif
    return value;
""")
def load_shared(memory: int, i: int) -> wp.vec4: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("st.shared.v4.f32 [%0], {%1, %2, %3, %4};"
        :: "r"(memory + 16 * i), "f"(value[0]), "f"(value[1]), "f"(value[2]), "f"(value[3]) : "memory");
#endif
""")
def store_shared(memory: int, i: int, value: wp.vec4): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int offset = 1; offset < lanes; offset *= 2)
        value += __shfl_xor_sync(0xffffffffu, value, offset);
#endif
    return value;
""")
def sum_of_lanes(value: float, lanes: int) -> float:
    """Sum over a power of two of neighbouring lanes; all lanes of the warp must be here."""
    ...


@wp.func
def sum3_of_lanes(v: wp.vec3, lanes: int) -> wp.vec3:
    return wp.vec3(sum_of_lanes(v[0], lanes), sum_of_lanes(v[1], lanes), sum_of_lanes(v[2], lanes))


@wp.func
def sum4_of_lanes(v: wp.vec4, lanes: int) -> wp.vec4:
    return wp.vec4(sum_of_lanes(v[0], lanes), sum_of_lanes(v[1], lanes), sum_of_lanes(v[2], lanes), sum_of_lanes(v[3], lanes))


# ---------------------------------------------------------------- the step


@wp.func
def spline_at(distance: float) -> float:
    """Quadratic B-spline weight of a grid node so many cells away."""
    d = wp.abs(distance)
    if d < 0.5:
        return 0.75 - d * d
    return 0.5 * (1.5 - d) * (1.5 - d)


@functools.cache
def make_step_kernel(material: str, lanes: int, passes: int, collecting: int, rounds: int):
    """The kernel of a whole step for a division with these numbers; launched over environments × THREADS.

    Each lane has up to three of the nine lines along i of its node's stencil.
    """
    stress_of = MATERIALS[material][0]
    lines = -(-9 // lanes)
    planes = -(-3 // passes)
    integers = wp.types.vector(length=3 * lines, dtype=wp.int32)
    numbers = wp.types.vector(length=lines, dtype=wp.float32)
    row_ends = wp.types.vector(length=2 * (passes + 1) * rounds, dtype=wp.int32)
    sums = wp.types.matrix(shape=(rounds, 4), dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", cluster_dim=CLUSTER, launch_bounds=BLOCK)
    def take_step(
        nodes: Nodes,
        state: State,
        loads: Loads,
        tools: RigidTools,
        grid: Grid,
        step: Substep,
        substeps: int,
        scale: wp.array[float],  # of the moduli of each node [B · M]
        owned: wp.array2d[int],  # as in `Division`, as all below
        corners: wp.array3d[int],
        slots: wp.array3d[int],
        rows: wp.array3d[int],
        shared: wp.array3d[int],
        published: wp.array[int],
        given: wp.array[wp.vec4],  # [B · 2 · CLUSTER · G] published momentum, kg·m/s, and mass, kg, of even and odd substeps
    ):
        thread = wp.tid()
        b = thread // THREADS
        block = thread // BLOCK % CLUSTER
        thread = thread % BLOCK
        count = nodes.X.shape[0]
        patch = rows.shape[2] - 1
        memory = shared_memory()
        dt = step.dt

        # What stays in this thread: its share of a node,
        owner = wp.min(thread // wp.static(lanes), owned.shape[1] - 1)
        lane = thread % wp.static(lanes)
        p = wp.max(owned[block, owner], 0)
        owns, leads = int(0), int(0)
        if owned[block, owner] >= 0 and thread // wp.static(lanes) == owner:
            owns = 1
            if lane == 0:
                leads = 1
        e = b * count + p
        u = state.u[e]
        v = state.v[e]
        C = state.C[e]
        F = state.F[e]
        Q = state.Q[e]
        X = nodes.X[p]
        mass = nodes.mass[p]
        volume = nodes.volume[p]
        mu = scale[e] * nodes.mu[p]
        lam = scale[e] * nodes.lam[p]
        stiffness = nodes.stiffness[e]
        spring = loads.spring[e]
        holder = loads.holder[e]
        target = loads.target[e]
        target_v = loads.target_v[e]
        push = mass * step.gravity + loads.force[e]
        base = nodes.first[p]
        f = X * grid.inverse_h - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
        wx = spline(f[0])
        my_corners, my_slots = integers(), integers()
        weights, dy, dz = numbers(), numbers(), numbers()  # of each line
        for line in range(wp.static(lines)):
            jk = line * wp.static(lanes) + lane
            dy[line] = float(jk // 3) - f[1]
            dz[line] = float(jk % 3) - f[2]
            for plane in range(3):
                my_slots[3 * line + plane] = -1
                if jk < 9 and owns != 0:
                    weights[line] = spline_at(dy[line]) * spline_at(dz[line])
                    my_corners[3 * line + plane] = corners[block, owner, 9 * plane + jk]
                    my_slots[3 * line + plane] = slots[block, owner, 9 * plane + jk]
        # and some grid nodes of the patch.
        part = thread % wp.static(collecting)
        ends = row_ends()
        for i in range(wp.static(rounds)):
            g = thread // wp.static(collecting) + i * wp.static(BLOCK // collecting)
            if g < patch:
                for n in range(wp.static(passes)):
                    ends[2 * (wp.static(passes + 1) * i + n)] = rows[block, n, g] + part
                    ends[2 * (wp.static(passes + 1) * i + n) + 1] = rows[block, n, g + 1]
                ends[2 * (wp.static(passes + 1) * i + wp.static(passes))] = shared[block, g, 0] + part
                ends[2 * (wp.static(passes + 1) * i + wp.static(passes)) + 1] = shared[block, g, 1]

        for substep in range(substeps):
            time = float(substep + 1) * dt  # at the end of the substep, since the start of the step
            pull = wp.vec4()
            giver = int(-1)
            if spring > 0.0:
                giver = holder
                back = (-dt * spring) * (u - target - time * target_v)
                pull = wp.vec4(back[0], back[1], back[2], dt * dt * spring)
            else:
                pull, giver = push_of_tools(tools, b * tools.count, X + u, v, mass, stiffness, dt, time)
            S = stress_of(F, mu, lam)
            if step.ratio > 0.0:
                Q += step.forget * (second_piola(F, S) - Q)
                S = maxwell(F, S, Q, step.ratio)
            # What springs and contact add turns with the node: adding mass alone would resist turning.
            A = ((mass + pull[3]) * grid.h) * C - (dt * 4.0 * grid.inverse_h * volume) * S
            ax, ay, az = wp.vec3(A[0, 0], A[1, 0], A[2, 0]), wp.vec3(A[0, 1], A[1, 1], A[2, 1]), wp.vec3(A[0, 2], A[1, 2], A[2, 2])
            q = mass * v + dt * push + three(pull) - f[0] * ax
            totals = sums()
            for n in range(wp.static(passes)):
                for line in range(wp.static(lines)):
                    m = q + dy[line] * ay + dz[line] * az
                    for plane in range(wp.static(planes)):
                        if n * wp.static(planes) + plane < 3:
                            if my_slots[3 * line + n * wp.static(planes) + plane] >= 0:
                                w = weights[line] * wx[n * wp.static(planes) + plane]
                                wm = w * (m + float(n * wp.static(planes) + plane) * ax)
                                four = wp.vec4(wm[0], wm[1], wm[2], w * (mass + pull[3]))
                                store_shared(memory, my_slots[3 * line + n * wp.static(planes) + plane], four)
                wait_for_block()
                for i in range(wp.static(rounds)):
                    begin = ends[2 * (wp.static(passes + 1) * i + n)]
                    end = ends[2 * (wp.static(passes + 1) * i + n) + 1]
                    for slot in range(begin, end, wp.static(AT_ONCE * collecting)):
                        for k in range(AT_ONCE):  # loads that need not wait for each other
                            if slot + k * wp.static(collecting) < end:
                                value = load_shared(memory, slot + k * wp.static(collecting))
                                for c in range(4):
                                    totals[i, c] += value[c]
                wait_for_block()
            environment = (2 * b + substep % 2) * CLUSTER * patch
            for i in range(wp.static(rounds)):
                g = thread // wp.static(collecting) + i * wp.static(BLOCK // collecting)
                total = sum4_of_lanes(wp.vec4(totals[i, 0], totals[i, 1], totals[i, 2], totals[i, 3]), wp.static(collecting))
                if g < patch and part == 0:
                    store(given, environment + block * patch + g, total)
            wait_for_cluster()

            for i in range(wp.static(rounds)):
                g = thread // wp.static(collecting) + i * wp.static(BLOCK // collecting)
                total = wp.vec4()
                begin = ends[2 * (wp.static(passes + 1) * i + wp.static(passes))]
                end = ends[2 * (wp.static(passes + 1) * i + wp.static(passes)) + 1]
                for place in range(begin, end, wp.static(collecting)):
                    total += load(given, environment + published[place])
                total = sum4_of_lanes(total, wp.static(collecting))
                grid_v = wp.vec4()
                if total[3] > 0.0:
                    grid_v = (step.decay / total[3]) * total
                if g < patch and part == 0:
                    store_shared(memory, g, grid_v)
            wait_for_block()

            v = wp.vec3()
            cx, cy, cz = wp.vec3(), wp.vec3(), wp.vec3()  # columns of Σ w v_i (X_i − X_p)ᵀ
            for line in range(wp.static(lines)):
                v0 = wx[0] * three(load_shared(memory, my_corners[3 * line]))
                v1 = wx[1] * three(load_shared(memory, my_corners[3 * line + 1]))
                v2 = wx[2] * three(load_shared(memory, my_corners[3 * line + 2]))
                moved = weights[line] * (v0 + v1 + v2)
                v += moved
                cx += weights[line] * (v1 + 2.0 * v2)
                cy += dy[line] * moved
                cz += dz[line] * moved
            v = sum3_of_lanes(v, wp.static(lanes))
            cx = sum3_of_lanes(cx, wp.static(lanes)) - f[0] * v
            cy = sum3_of_lanes(cy, wp.static(lanes))
            cz = sum3_of_lanes(cz, wp.static(lanes))
            C = 4.0 * grid.inverse_h * wp.matrix_from_cols(cx, cy, cz)
            if leads != 0 and giver >= 0:
                felt = three(pull) - (pull[3] / step.decay) * v
                place = (b * tools.count + giver) * count + p
                wp.atomic_add(tools.impulse, place, felt)  # alone there; so it need not wait
                wp.atomic_add(tools.moment, place, wp.cross(X + u, felt))  # where it was given
            u += dt * v
            F += dt * C
            wait_for_block()

        if leads != 0:
            state.u[e] = u
            state.v[e] = v
            state.C[e] = C
            state.F[e] = F
            state.Q[e] = Q

    return take_step
