"""The step of the material point method on a GPU that has clusters of multiprocessors: all substeps in one launch.

Same maths as `mpm_kernels` (read its header first), for rest kinematics. A few thousand nodes cannot keep a GPU busy: the
time goes into launches and into waiting for memory. Here a cluster of blocks has an environment to itself, and after the
first loads works in registers and shared memory alone. Each block owns a compact piece of the tissue, whose nodes stay in
the registers of a few lanes each for the whole step, and a *patch* of the grid, all grid nodes that its piece reaches. In a
substep it adds up what its nodes give to its patch, and sends that to the blocks whose patches touch its own, which wait for
no others. Every sum has a fixed order: same bits in every run.

Shared memory, in fours of float32: a slot for what each node gives to each of its grid nodes, where threads next to each
other add up what lies next to each other (sliced ELLPACK, as for sparse matrices); the inbox, of even and odd substeps, with
the block's own totals and what it got from others; the velocities of the patch; two barriers that count what has come.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from endo_sim_ros.physics.backends.warp_kernels import Grid, Loads, Nodes, RigidTools, State, Substep, push_of_tools, spline, three
from endo_sim_ros.physics.materials import MATERIALS, maxwell, second_piola

BLOCK = 256  # threads of a block; with more there are too few registers
CLUSTER = 16  # blocks
THREADS = CLUSTER * BLOCK
WARP = 32
ROUNDS = 4  # of a block's threads over its patch, or over what it sends
AT_ONCE = 4  # loads of a thread that adds up
BANKS = 8  # of shared memory, for fours: those of eight threads that load or store at once should differ
SHARED = 14_000  # fours of float32 in shared memory
OTHERS = 4096  # bytes of it that Warp and the GPU's own take at most


# ---------------------------------------------------------------- who owns what


class Division(NamedTuple):
    """How the nodes and the grid are divided among the blocks of a cluster.

    All are tables int32. Places in shared memory are numbers of fours; those in the inbox count from its beginning.
    """

    lanes: int  # that share a node
    slots: int  # fours that hold what nodes give; the last is for lanes that have nothing to give
    inbox: int  # fours; the first are the totals of the patch, the last is zero
    nodes: np.ndarray  # [CLUSTER, P] nodes of each piece, -1 = none
    corners: np.ndarray  # [CLUSTER, P, 27] number in its patch of each node's grid nodes
    places: np.ndarray  # [CLUSTER, P, 27] slot of what it gives to them
    sums: np.ndarray  # [CLUSTER, ROUNDS, BLOCK, 4] of each thread: first slot, end, threads that share a sum, its grid node or -1
    sends: np.ndarray  # [CLUSTER, ROUNDS, BLOCK, 3] of each thread: grid node or -1, block, and place in its inbox
    shares: np.ndarray  # [CLUSTER, K, G] places in the inbox that add up to each grid node
    received: np.ndarray  # [CLUSTER] fours that other blocks send


def divide(rest_cells: np.ndarray, corners: np.ndarray) -> Division | None:
    """Divide nodes at [M, 3] (cells), each with the numbers of its grid nodes [M, 27]; None if they are too many."""
    pieces = _bisect(rest_cells, np.arange(len(rest_cells)), CLUSTER)
    largest = max(len(piece) for piece in pieces)
    lanes = next((lanes for lanes in (4, 2, 1) if lanes * largest <= BLOCK), 0)
    if not lanes:
        return None
    # A stencil's grid nodes lie in banks that follow each other, so that lanes of a node, which have neighbours, do not collide.
    begins = np.floor(rest_cells - 0.5).astype(int) @ [9, 3, 1] % BANKS
    bank = np.zeros(corners.max() + 1, int)
    bank[corners] = (begins[:, None] + np.arange(27)) % BANKS
    pieces = [piece[_spread(begins[piece], lanes)] for piece in pieces]
    patches = [_by_bank(np.unique(corners[piece]), bank) for piece in pieces]
    size = max(len(patch) for patch in patches)
    if size > ROUNDS * BLOCK:
        return None
    nodes = np.full((CLUSTER, largest), -1, np.int32)
    local, places = np.zeros((2, CLUSTER, largest, 27), np.int32)
    sums = np.zeros((CLUSTER, ROUNDS, BLOCK, 4), np.int32)
    slots = 0
    for i, (piece, patch) in enumerate(zip(pieces, patches)):
        nodes[i, : len(piece)] = piece
        index = np.argsort(patch)
        local[i, : len(piece)] = index[np.searchsorted(patch, corners[piece], sorter=index)]
        # Fewer and longer sums take less time, more and shorter ones less memory, which many nodes need.
        place, sums[i], end = _sliced(local[i, : len(piece)].ravel(), len(patch), ROUNDS if lanes == 1 else ROUNDS // 2)
        places[i, : len(piece)] = place.reshape(-1, 27)
        slots = max(slots, end + 1)

    # All pairs of a grid node of a patch and the same one of any patch; those of one grid node follow each other, by block.
    owner, index = np.repeat(np.arange(CLUSTER), [len(patch) for patch in patches]), np.concatenate([np.arange(len(p)) for p in patches])
    numbers = np.concatenate(patches)
    order = np.flatnonzero(numbers >= 0)
    order = order[np.argsort(numbers[order], kind="stable")]
    owner, index, numbers = owner[order], index[order], numbers[order]
    first, end = np.searchsorted(numbers, numbers), np.searchsorted(numbers, numbers, "right")
    mine = np.repeat(np.arange(len(numbers)), end - first)
    rank = np.arange(len(mine)) - np.repeat(np.cumsum(end - first) - (end - first), end - first)
    theirs = first[mine] + rank
    # What a block gets from another lies together, and is sent together.
    place = index[theirs]  # of the own totals
    foreign = np.flatnonzero(owner[mine] != owner[theirs])
    foreign = foreign[np.lexsort((numbers[mine[foreign]], owner[theirs[foreign]], owner[mine[foreign]]))]
    received = np.bincount(owner[mine[foreign]], minlength=CLUSTER)
    place[foreign] = size + np.arange(len(foreign)) - np.repeat(np.cumsum(received) - received, received)
    inbox = size + int(received.max()) + 1
    sent = np.bincount(owner[theirs[foreign]], minlength=CLUSTER)
    if sent.max() > ROUNDS * BLOCK or slots + 2 * inbox + size + 1 > SHARED:
        return None
    shares = np.full((CLUSTER, max(AT_ONCE, rank.max() + 1), size), inbox - 1, np.int32)
    shares[owner[mine], rank, index[mine]] = place
    source, target = owner[theirs[foreign]], owner[mine[foreign]]
    foreign = foreign[np.lexsort((place[foreign], (target - source) % CLUSTER, source))]  # not all to the same block at first
    sends = np.full((CLUSTER, ROUNDS * BLOCK, 3), -1, np.int32)
    number = np.arange(len(foreign)) - np.repeat(np.cumsum(sent) - sent, sent)
    sends[owner[theirs[foreign]], number] = np.stack([index[theirs[foreign]], owner[mine[foreign]], place[foreign]], 1)
    return Division(lanes, slots, inbox, nodes, local, places, sums, sends.reshape(CLUSTER, ROUNDS, BLOCK, 3), shares, received)


def _sliced(rows: np.ndarray, size: int, rounds: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Slots [E] for entries of rows [E], the threads' sums [ROUNDS, BLOCK, 4] as in `Division`, of which the first rounds are
    used if they suffice, and the number of slots.

    One, two or four threads of a warp share a row, so that all have about as many entries; entry k of a warp's threads lies
    together, and a row in its own bank.
    """
    lengths = np.bincount(rows, minlength=size)
    slice_of, lane_of = np.zeros((2, size), int)
    longest, count = max(len(rows) // (rounds * BLOCK), 1), ROUNDS * BLOCK
    while count > rounds * BLOCK // WARP:
        sharing = np.minimum(4, 2 ** np.ceil(np.log2(np.maximum(lengths / longest, 1))).astype(int))
        count = 0
        for n in (4, 2, 1):
            group = np.flatnonzero((sharing == n) & (lengths > 0))
            group = group[np.lexsort((-lengths[group], group % BANKS))]
            rank = np.arange(len(group)) - np.searchsorted(group % BANKS, group % BANKS)  # among the rows of its bank
            slice_of[group], lane_of[group] = count + rank * n // 4, group % BANKS + BANKS * n * (rank % (4 // n))
            count += -(-(rank.max(initial=-1) + 1) * n // 4)
        if sharing.max() == 1:
            rounds = ROUNDS  # which hold any patch
        longest += 1 + longest // 8
    depth = np.zeros(count, int)
    np.maximum.at(depth, slice_of, -(-lengths // (2 * sharing)) * 2)  # two at once
    ends = WARP * np.cumsum([0, *depth])
    order = np.argsort(rows, kind="stable")
    entry = np.empty(len(rows), int)  # number within its row
    entry[order] = np.arange(len(rows)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    shared = sharing[rows]
    places = ends[slice_of[rows]] + WARP * (entry // shared) + lane_of[rows] + BANKS * (entry % shared)

    # The longest sums first, each to the warp that has least to do.
    sums, load, row = np.zeros((ROUNDS * BLOCK // WARP, WARP, 4), np.int32), np.zeros(BLOCK // WARP), np.empty(count, int)
    sums[..., 2], sums[..., 3] = 1, -1
    used = np.zeros(BLOCK // WARP, int)
    for number in np.argsort(-depth, kind="stable"):
        warp = np.where(used < ROUNDS, load, np.inf).argmin()
        row[number] = used[warp] * len(used) + warp
        load[warp] += depth[number]
        used[warp] += 1
    sums[row, :, 0], sums[row, :, 1] = ends[:-1, None] + np.arange(WARP), ends[1:, None]
    summed = np.flatnonzero(lengths)
    sums[row[slice_of[summed]], :, 2] = sharing[summed, None]
    sums[row[slice_of[summed]], lane_of[summed], 3] = summed
    return places, sums.reshape(ROUNDS, BLOCK, 4), int(ends[-1])


def _by_bank(numbers: np.ndarray, bank: np.ndarray) -> np.ndarray:
    """Numbers of grid nodes in an order in which each lies in its bank, and -1 in between."""
    columns = [numbers[bank[numbers] == column] for column in range(BANKS)]
    table = np.full((max(map(len, columns)), BANKS), -1)
    for column, members in enumerate(columns):
        table[: len(members), column] = members
    return table.ravel()


def _spread(banks: np.ndarray, lanes: int) -> np.ndarray:
    """An order of nodes with stencils that begin in these banks [P], in which those whose lanes load at once load from others."""
    queues = [list(np.flatnonzero(banks == bank)) for bank in range(BANKS)]
    order: list[int] = []
    while len(order) < len(banks):
        lengths = np.array([len(queue) for queue in queues])
        first = lengths.reshape(-1, lanes).sum(0).argmax()  # of banks that follow each other at this distance
        for bank in range(first, BANKS, lanes):
            queue = queues[bank] or max(queues, key=len)
            if queue:
                order.append(queue.pop())
    return np.array(order, int)


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
    __syncwarp();
#endif
""")
def wait_for_block():
    """Until all threads of the block are here; those of a warp go on together."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    extern __shared__ char memory[];
    return (int)__cvta_generic_to_shared(memory);
#else
    return 0;
#endif
""")
def shared_memory() -> int:
    """Where the shared memory begins that tiles take; the same in all blocks."""
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
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    if (threadIdx.x == 0) {
        asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(barrier) : "memory");
        asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(barrier + 8) : "memory");
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    }
#endif
""")
def make_barriers(barrier: int):
    """Two of them, at this address; others may use them after `wait_for_cluster`."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    unsigned int place, at;
    asm("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(place) : "r"(memory + 16 * i), "r"(block));
    asm("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(at) : "r"(barrier), "r"(block));
    asm volatile("st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.v4.f32 [%0], {%1, %2, %3, %4}, [%5];"
        :: "r"(place), "f"(value[0]), "f"(value[1]), "f"(value[2]), "f"(value[3]), "r"(at) : "memory");
#endif
""")
def send(block: int, memory: int, i: int, value: wp.vec4, barrier: int):
    """Store in the shared memory of another block, and count it at that block's barrier."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    if (threadIdx.x == 0)
        asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" :: "r"(barrier), "r"(16 * count) : "memory");
    int done = 0;
    while (!done)
        asm volatile("{ .reg .pred p; mbarrier.try_wait.parity.shared::cta.b64 p, [%1], %2; selp.b32 %0, 1, 0, p; }"
            : "=r"(done) : "r"(barrier), "r"(turn & 1) : "memory");
    __syncwarp();
#endif
""")
def receive(barrier: int, count: int, turn: int):
    """Wait until that many fours have been sent to the barrier, which is used for the turn-th time; all threads of the block."""
    ...


_SUM = """
#if defined(__CUDA_ARCH__)
    __syncwarp();
    for (int offset = apart; offset < apart * lanes; offset *= 2)
        for (int c = 0; c < SIZE; ++c)
            value[c] += __shfl_xor_sync(0xffffffffu, value[c], offset);
#endif
    return value;
"""


@wp.func_native(_SUM.replace("SIZE", "3"))
def sum3_of_lanes(value: wp.vec3, apart: int, lanes: int) -> wp.vec3:
    """Sum over a power of two of lanes so far apart; all lanes of the warp must be here."""
    ...


@wp.func_native(_SUM.replace("SIZE", "4"))
def sum4_of_lanes(value: wp.vec4, apart: int, lanes: int) -> wp.vec4: ...


# ---------------------------------------------------------------- the step


@wp.func
def spline_at(distance: float) -> float:
    """Quadratic B-spline weight of a grid node so many cells away."""
    d = wp.abs(distance)
    if d < 0.5:
        return 0.75 - d * d
    return 0.5 * (1.5 - d) * (1.5 - d)


@functools.cache
def make_step_kernel(material: str, lanes: int):
    """The kernel of a whole step for a division with so many lanes; launched over environments × THREADS.

    Each lane has up to three of the nine lines along i of its node's stencil.
    """
    stress_of = MATERIALS[material][0]
    options = {"fast_math": material == "fixed_corotated"}  # approximate quotients are good enough, approximate logarithms are not
    lines = -(-9 // lanes)
    integers = wp.types.vector(length=3 * lines, dtype=wp.int32)
    numbers = wp.types.vector(length=lines, dtype=wp.float32)
    four_each = wp.types.vector(length=4 * ROUNDS, dtype=wp.int32)
    three_each = wp.types.vector(length=3 * ROUNDS, dtype=wp.int32)

    @wp.kernel(enable_backward=False, module="unique", cluster_dim=CLUSTER, launch_bounds=BLOCK, module_options=options)
    def take_step(
        nodes: Nodes,
        state: State,
        loads: Loads,
        tools: RigidTools,
        grid: Grid,
        step: Substep,
        substeps: int,
        scale: wp.array[float],  # of the moduli of each node [B · M]
        slots: int,  # as in `Division`, as all below
        inbox: int,
        owned: wp.array2d[int],
        corners: wp.array3d[int],
        places: wp.array3d[int],
        sums: wp.array4d[int],
        sends: wp.array4d[int],
        shares: wp.array3d[int],
        received: wp.array[int],
    ):
        thread = wp.tid()
        b = thread // THREADS
        block = thread // BLOCK % CLUSTER
        thread = thread % BLOCK
        count = nodes.X.shape[0]
        patch = shares.shape[2]
        wp.tile_empty(shape=wp.static(4 * SHARED), dtype=float, storage="shared")  # asks for the memory
        memory = shared_memory()
        grid_v = slots + 2 * inbox
        barrier = memory + 16 * (grid_v + patch)
        for i in range(thread, grid_v, BLOCK):
            store_shared(memory, i, wp.vec4())
        make_barriers(barrier)
        wait_for_cluster()
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
        touching = int(0)  # whether any tool pushes
        for t in range(tools.count):
            if tools.radius[b * tools.count + t] > 0.0:
                touching = 1
        giver = int(-1)  # tool that gave impulse and moment
        impulse, moment = wp.vec3(), wp.vec3()
        base = nodes.first[p]
        f = X * grid.inverse_h - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
        wx = spline(f[0])
        stencil = integers()  # corner and place of each grid node, 16 bits each
        weights, dy, dz = numbers(), numbers(), numbers()  # of each line
        for line in range(wp.static(lines)):
            jk = line * wp.static(lanes) + lane
            dy[line] = float(jk // 3) - f[1]
            dz[line] = float(jk % 3) - f[2]
            for plane in range(3):
                stencil[3 * line + plane] = (slots - 1) << 16
                if jk < 9 and owns != 0:
                    weights[line] = spline_at(dy[line]) * spline_at(dz[line])
                    stencil[3 * line + plane] = corners[block, owner, 9 * plane + jk] + (places[block, owner, 9 * plane + jk] << 16)
        # and some of the sums and of what is sent.
        my_sums, my_sends = four_each(), three_each()
        for i in range(ROUNDS):
            for n in range(4):
                my_sums[4 * i + n] = sums[block, i, thread, n]
            for n in range(3):
                my_sends[3 * i + n] = sends[block, i, thread, n]

        for substep in range(substeps):
            time = float(substep + 1) * dt  # at the end of the substep, since the start of the step
            pull = wp.vec4()
            gives = int(-1)
            if spring > 0.0:
                gives = holder
                back = (-dt * spring) * (u - target - time * target_v)
                pull = wp.vec4(back[0], back[1], back[2], dt * dt * spring)
            elif touching != 0:
                pull, gives = push_of_tools(tools, b * tools.count, X + u, v, mass, stiffness, dt, time)
            S = stress_of(F, mu, lam)
            if step.ratio > 0.0:
                Q += step.forget * (second_piola(F, S) - Q)
                S = maxwell(F, S, Q, step.ratio)
            # What springs and contact add turns with the node: adding mass alone would resist turning.
            A = ((mass + pull[3]) * grid.h) * C - (dt * 4.0 * grid.inverse_h * volume) * S
            ax, ay, az = wp.vec3(A[0, 0], A[1, 0], A[2, 0]), wp.vec3(A[0, 1], A[1, 1], A[2, 1]), wp.vec3(A[0, 2], A[1, 2], A[2, 2])
            q = mass * v + dt * push + three(pull) - f[0] * ax
            for line in range(wp.static(lines)):
                m = q + dy[line] * ay + dz[line] * az
                for plane in range(3):
                    w = weights[line] * wx[plane]
                    wm = w * (m + float(plane) * ax)
                    store_shared(memory, stencil[3 * line + plane] >> 16, wp.vec4(wm[0], wm[1], wm[2], w * (mass + pull[3])))
            wait_for_block()

            now = slots + (substep % 2) * inbox
            for i in range(ROUNDS):
                begin, end, sharing = my_sums[4 * i], my_sums[4 * i + 1], my_sums[4 * i + 2]
                if begin < end:
                    total = wp.vec4()
                    for slot in range(begin, end, 2 * WARP):
                        total += load_shared(memory, slot) + load_shared(memory, slot + WARP)
                    total = sum4_of_lanes(total, BANKS, sharing)
                    if my_sums[4 * i + 3] >= 0:
                        store_shared(memory, now + my_sums[4 * i + 3], total)
            wait_for_block()

            for i in range(ROUNDS):
                if my_sends[3 * i] >= 0:
                    total = load_shared(memory, now + my_sends[3 * i])
                    send(my_sends[3 * i + 1], memory, now + my_sends[3 * i + 2], total, barrier + 8 * (substep % 2))
            first_shares = four_each()
            for i in range(ROUNDS):
                if thread + i * BLOCK < patch:
                    for k in range(AT_ONCE):
                        first_shares[AT_ONCE * i + k] = shares[block, k, thread + i * BLOCK]
            receive(barrier + 8 * (substep % 2), received[block], substep // 2)
            for i in range(ROUNDS):
                if thread + i * BLOCK < patch:
                    total = wp.vec4()
                    for k in range(AT_ONCE):
                        total += load_shared(memory, now + first_shares[AT_ONCE * i + k])
                    for k in range(AT_ONCE, shares.shape[1]):
                        total += load_shared(memory, now + shares[block, k, thread + i * BLOCK])
                    velocity = wp.vec4()
                    if total[3] > 0.0:
                        velocity = (step.decay / total[3]) * total
                    store_shared(memory, grid_v + thread + i * BLOCK, velocity)
            wait_for_block()

            v = wp.vec3()
            cx, cy, cz = wp.vec3(), wp.vec3(), wp.vec3()  # columns of Σ w v_i (X_i − X_p)ᵀ
            for line in range(wp.static(lines)):
                v0 = wx[0] * three(load_shared(memory, grid_v + (stencil[3 * line] & 0xFFFF)))
                v1 = wx[1] * three(load_shared(memory, grid_v + (stencil[3 * line + 1] & 0xFFFF)))
                v2 = wx[2] * three(load_shared(memory, grid_v + (stencil[3 * line + 2] & 0xFFFF)))
                moved = weights[line] * (v0 + v1 + v2)
                v += moved
                cx += weights[line] * (v1 + 2.0 * v2)
                cy += dy[line] * moved
                cz += dz[line] * moved
            v = sum3_of_lanes(v, 1, wp.static(lanes))
            cx = sum3_of_lanes(cx, 1, wp.static(lanes)) - f[0] * v
            cy = sum3_of_lanes(cy, 1, wp.static(lanes))
            cz = sum3_of_lanes(cz, 1, wp.static(lanes))
            C = 4.0 * grid.inverse_h * wp.matrix_from_cols(cx, cy, cz)
            if gives >= 0:
                if gives != giver:
                    if leads != 0 and giver >= 0:
                        give(tools, (b * tools.count + giver) * count + p, impulse, moment)
                    giver = gives
                    impulse = wp.vec3()
                    moment = wp.vec3()
                felt = three(pull) - (pull[3] / step.decay) * v
                impulse += felt
                moment += wp.cross(X + u, felt)  # where it was given
            u += dt * v
            F += dt * C

        if leads != 0:
            if giver >= 0:
                give(tools, (b * tools.count + giver) * count + p, impulse, moment)
            state.u[e] = u
            state.v[e] = v
            state.C[e] = C
            state.F[e] = F
            state.Q[e] = Q
        wait_for_cluster()  # what a block sent has come before its memory is another's

    return take_step


@wp.func
def give(tools: RigidTools, place: int, impulse: wp.vec3, moment: wp.vec3):
    """Add to what a tool gave to a node; nobody else does."""
    tools.impulse[place] = tools.impulse[place] + impulse
    tools.moment[place] = tools.moment[place] + moment
