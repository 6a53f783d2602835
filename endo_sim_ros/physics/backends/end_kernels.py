"""The end of a step: what went wrong is undone."""

import warp as wp

from endo_sim_ros.core.block_sums import OPTIONS, block_max, block_sum
from endo_sim_ros.physics.backends.structs import State

wp.set_module_options({"enable_backward": False, **OPTIONS})
THREADS = 512
"""Of a GPU's block, which is one environment; kernels are bound to as few registers as leave room for these."""


@wp.kernel(launch_bounds=THREADS)
def end_step(
    threads: int,
    count: int,
    travel: float,
    kept: float,  # share of its deformation that is left to tissue of which two steps in a row were bad
    backup: State,
    state: State,
    faults: wp.array[int],
    speed_sq: wp.array[float],
    held: wp.array[wp.vec3],  # how far breath and heart had moved what is held, and so rest, when the step began [B], m
    goal: wp.array[wp.vec3],  # the same when it ends
):
    """Count control nodes that are not finite or out of bounds (the comparisons are false for NaN) and find the largest v².

    Environments where there are any return to the state before the step, at rest there. Where the step before was bad as
    well, they give way towards rest: from tissue that is turned inside out or stretched too far for its substeps every step
    is bad. u and F − 1 shrink together, and still fit. A control node that somebody has put into a state in which no step ends, such
    as one of infinite strain, is put to rest: no part of infinity is finite. What is held has reached its goal where the step was good.
    """
    b, thread = wp.tid()
    before = faults[b]
    bad, fastest = wp.float64(0.0), float(0.0)
    for p in range(thread, count, threads):
        e = b * count + p
        # |F| of 100: tissue a hundred times as long has torn, also where its nodes are still within the travel.
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
                state.u[e] = held[b] + kept * (backup.u[e] - held[b])
                state.F[e] = kept * (backup.F[e] - wp.identity(3, float)) + wp.identity(3, float)
                state.Q[e] = kept * backup.Q[e]
                if not (wp.length_sq(backup.u[e]) + wp.ddot(backup.F[e], backup.F[e]) < 1.0e6):  # travel is 10 m at most
                    state.u[e] = held[b]
                    state.F[e] = wp.identity(3, float)
                    state.Q[e] = wp.mat33()
            state.v[e] = wp.vec3()
            state.C[e] = wp.mat33()
    elif thread == 0:
        held[b] = goal[b]
