"""The step of the material point method on a GPU that has clusters of multiprocessors: all substeps in one launch.

Same maths as `plain_kernels` (read its header first), for rest kinematics. A few thousand nodes cannot keep a GPU busy: the
time goes into launches and into waiting for memory. Here a cluster of blocks has an environment to itself, and after the
first loads works in registers and shared memory alone. Each block owns a compact piece of the tissue, whose nodes stay in
the registers of a few lanes each for the whole step, and a *patch* of the grid, all grid nodes that its piece reaches. In a
substep it adds up what its nodes give to its patch, and sends that to the blocks whose patches touch its own, which wait for
no others. Every sum has a fixed order: same bits in every run. How many blocks a cluster has is up to the number of
environments (`by_preference`); clusters of other sizes differ by rounding.

Shared memory, in fours of float32: a slot for what each node gives to each of its grid nodes, where threads next to each
other add up what lies next to each other (sliced ELLPACK, as for sparse matrices); the inbox, of even and odd substeps, with
the block's own totals and what it got from others; the velocities of the patch; two barriers that count what has come.
"""

import functools

import warp as wp

from endo_sim_ros.core.native import native
from endo_sim_ros.physics.backends.cluster_division import AT_ONCE, BANKS, BLOCK, ROUNDS, SHARED, WARP
from endo_sim_ros.physics.backends.plain_kernels import node_move, node_update, spline, three
from endo_sim_ros.physics.backends.structs import Grid, Loads, Nodes, RigidTools, State, Substep
from endo_sim_ros.physics.materials import MATERIALS

BUILD = native("physics/native/node.h", "physics/native/cluster.h")


@wp.func_native("endo_sim::wait_for_cluster();")
def wait_for_cluster():
    """Until all threads of the cluster are here, and see what the others wrote."""


@wp.func_native("endo_sim::wait_for_block();")
def wait_for_block():
    """Until all threads of the block are here; those of a warp go on together."""


@wp.func_native("return endo_sim::shared_memory();")
def shared_memory() -> int:
    """Where the shared memory begins that tiles take; the same in all blocks."""


@wp.func_native("return endo_sim::load_shared<wp::vec4>(memory, i);")
def load_shared(memory: int, i: int) -> wp.vec4: ...


@wp.func_native("endo_sim::store_shared(memory, i, value);")
def store_shared(memory: int, i: int, value: wp.vec4): ...


@wp.func_native("endo_sim::make_barriers(barrier);")
def make_barriers(barrier: int):
    """Two of them, at this address; others may use them after `wait_for_cluster`."""


@wp.func_native("endo_sim::send(block, memory, i, value, barrier);")
def send(block: int, memory: int, i: int, value: wp.vec4, barrier: int):
    """Store in the shared memory of another block, and count it at that block's barrier."""


@wp.func_native("endo_sim::receive(barrier, count, turn);")
def receive(barrier: int, count: int, turn: int):
    """Wait until that many fours have been sent to the barrier, which is used for the turn-th time; all threads of the block."""


@wp.func_native("return endo_sim::sum_of_lanes<3>(value, apart, lanes);")
def sum3_of_lanes(value: wp.vec3, apart: int, lanes: int) -> wp.vec3:
    """Sum over a power of two of lanes so far apart; all lanes of the warp must be here."""


@wp.func_native("return endo_sim::sum_of_lanes<4>(value, apart, lanes);")
def sum4_of_lanes(value: wp.vec4, apart: int, lanes: int) -> wp.vec4: ...


@wp.func
def spline_at(distance: float) -> float:
    """Quadratic B-spline weight of a grid node so many cells away."""
    d = wp.abs(distance)
    if d < 0.5:
        return 0.75 - d * d
    return 0.5 * (1.5 - d) * (1.5 - d)


@functools.cache
def make_step_kernel(material: str, lanes: int, blocks: int):
    """The kernel of a whole step for a division with so many lanes and blocks; launched over environments × blocks × BLOCK.

    Each lane has up to three of the nine lines along i of its node's stencil.
    """
    options = {"fast_math": MATERIALS[material].fast_math, "extra_build_options": BUILD}
    update, move = node_update(material, "rest"), node_move("rest")
    lines = -(-9 // lanes)
    integers = wp.types.vector(length=3 * lines, dtype=wp.int32)
    numbers = wp.types.vector(length=lines, dtype=wp.float32)
    four_each = wp.types.vector(length=4 * ROUNDS, dtype=wp.int32)
    three_each = wp.types.vector(length=3 * ROUNDS, dtype=wp.int32)

    @wp.kernel(enable_backward=False, module="unique", cluster_dim=blocks, launch_bounds=BLOCK, module_options=options)
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
        slot_of: wp.array3d[int],
        sums: wp.array4d[int],
        outgoing: wp.array4d[int],
        addends: wp.array3d[int],
        received: wp.array[int],
    ):
        thread = wp.tid()
        b = thread // wp.static(blocks * BLOCK)
        block = thread // BLOCK % wp.static(blocks)
        thread = thread % BLOCK
        count = nodes.X.shape[0]
        patch = addends.shape[2]

        # ---- Shared memory, empty.
        wp.tile_empty(shape=wp.static(4 * SHARED), dtype=float, storage="shared")  # asks for the memory
        memory = shared_memory()
        grid_v = slots + 2 * inbox
        barrier = memory + 16 * (grid_v + patch)
        for i in range(thread, grid_v, BLOCK):
            store_shared(memory, i, wp.vec4())
        make_barriers(barrier)
        wait_for_cluster()
        dt = step.dt

        # ---- What stays in this thread: its share of a node,
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
        limit = loads.limit[e]
        holder = loads.holder[e]
        target = loads.target[e]
        target_v = loads.target_v[e]
        force = loads.force[e]
        touching = tools.used[b]  # capsules that may push
        source_tool = int(-1)  # that gave impulse and moment
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
                    stencil[3 * line + plane] = corners[block, owner, 9 * plane + jk] + (slot_of[block, owner, 9 * plane + jk] << 16)
        # ---- and some of the sums and of what is sent.
        my_sums, my_outgoing = four_each(), three_each()
        for i in range(ROUNDS):
            for n in range(4):
                my_sums[4 * i + n] = sums[block, i, thread, n]
            for n in range(3):
                my_outgoing[3 * i + n] = outgoing[block, i, thread, n]

        for substep in range(substeps):
            time = float(substep + 1) * dt  # at the end of the substep, since the start of the step
            # ---- Nodes give: the update of the node, and into its slots what it gives to each of its grid nodes.
            momentum, growth, pull = wp.vec4(), wp.mat33(), wp.vec4()
            source = update(
                tools, b * tools.room, touching, grid, step, time, X, u, v, C, F, Q, force, target, target_v,
                mass, volume, mu, lam, stiffness, spring, limit, holder, momentum, growth, pull,
            )  # fmt: skip
            ax = wp.vec3(growth[0, 0], growth[1, 0], growth[2, 0])
            ay = wp.vec3(growth[0, 1], growth[1, 1], growth[2, 1])
            az = wp.vec3(growth[0, 2], growth[1, 2], growth[2, 2])
            q = three(momentum) - f[0] * ax
            for line in range(wp.static(lines)):
                m = q + dy[line] * ay + dz[line] * az
                for plane in range(3):
                    w = weights[line] * wx[plane]
                    wm = w * (m + float(plane) * ax)
                    store_shared(memory, stencil[3 * line + plane] >> 16, wp.vec4(wm[0], wm[1], wm[2], w * momentum[3]))
            wait_for_block()

            # ---- The block adds up what its nodes gave to each grid node of its patch.
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

            # ---- It sends totals to blocks that have the grid node too, and adds what they sent: the grid's velocities.
            for i in range(ROUNDS):
                if my_outgoing[3 * i] >= 0:
                    total = load_shared(memory, now + my_outgoing[3 * i])
                    send(my_outgoing[3 * i + 1], memory, now + my_outgoing[3 * i + 2], total, barrier + 8 * (substep % 2))
            first_addends = four_each()
            for i in range(ROUNDS):
                if thread + i * BLOCK < patch:
                    for k in range(AT_ONCE):
                        first_addends[AT_ONCE * i + k] = addends[block, k, thread + i * BLOCK]
            receive(barrier + 8 * (substep % 2), received[block], substep // 2)
            for i in range(ROUNDS):
                if thread + i * BLOCK < patch:
                    total = wp.vec4()
                    for k in range(AT_ONCE):
                        total += load_shared(memory, now + first_addends[AT_ONCE * i + k])
                    for k in range(AT_ONCE, addends.shape[1]):
                        total += load_shared(memory, now + addends[block, k, thread + i * BLOCK])
                    velocity = wp.vec4()
                    if total[3] > 0.0:
                        velocity = (step.decay / total[3]) * total
                    store_shared(memory, grid_v + thread + i * BLOCK, velocity)
            wait_for_block()

            # ---- Nodes take: velocity and its gradient from the grid, what a tool gave, and the move.
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
            if source >= 0:
                if source != source_tool:
                    if leads != 0 and source_tool >= 0:
                        give(tools, (b * tools.count + source_tool) * count + p, impulse, moment)
                    source_tool = source
                    impulse = wp.vec3()
                    moment = wp.vec3()
                felt = three(pull) - (pull[3] / step.decay) * v
                impulse += felt
                moment += wp.cross(X + u, felt)  # where it was given
            move(v, C, dt, u, F)

        # ---- The end of the step, out of the registers.
        if leads != 0:
            if source_tool >= 0:
                give(tools, (b * tools.count + source_tool) * count + p, impulse, moment)
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
