"""The end of a step: what went wrong is undone."""

import warp as wp

from endo_sim_ros.core.block_sums import OPTIONS, block_max, block_sum
from endo_sim_ros.physics.backends.motion_kernels import rest_gradient, rest_shift
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
    follows: wp.array2d[wp.vec4],  # how control nodes follow breath and heart, which move what is held, and so rest [M, P]
    held: wp.array2d[wp.vec3],  # where the paths of these were when the step began [B, P], m
    goal: wp.array2d[wp.vec3],  # the same when it ends
):
    """Count control nodes that are not finite or out of bounds (the comparisons are false for NaN) and find the largest v².

    Environments where there are any return to the state before the step, at rest there. Where the step before was bad as
    well, they give way towards rest: from tissue that is turned inside out or stretched too far for its substeps every step
    is bad. u and F shrink together, to where tissue rests, and still fit. A control node that somebody has put into a state in which no
    step ends, such as one of infinite strain, is put to rest: no part of infinity is finite. What is held has reached its goal where the
    step was good.
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
                shift, gradient = rest_shift(follows, held, b, p), rest_gradient(follows, held, b, p)
                state.u[e] = shift + kept * (backup.u[e] - shift)
                state.F[e] = kept * (backup.F[e] - gradient) + gradient
                state.Q[e] = kept * backup.Q[e]
                if not (wp.length_sq(backup.u[e]) + wp.ddot(backup.F[e], backup.F[e]) < 1.0e6):  # travel is 10 m at most
                    state.u[e] = shift
                    state.F[e] = gradient
                    state.Q[e] = wp.mat33()
            state.v[e] = wp.vec3()
            state.C[e] = wp.mat33()
    elif thread == 0:
        for i in range(held.shape[1]):
            held[b, i] = goal[b, i]
