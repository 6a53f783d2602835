"""The end of a step: what went wrong is undone. And sums over the threads of a block, as of one environment."""

import warp as wp

from endo_sim_ros.core.native import native
from endo_sim_ros.physics.backends.structs import State

OPTIONS = {"extra_build_options": native("physics/native/threads.h")}
wp.set_module_options({"enable_backward": False, **OPTIONS})
THREADS = 512
"""Of a GPU's block, which is one environment; kernels are bound to as few registers as leave room for these."""


@wp.func_native("return endo_sim::block_sum(value);")
def block_sum(value: wp.float64) -> wp.float64:
    """Sum over the threads of a block on a GPU, in the same order every time; all must be here. On a CPU there is one."""


@wp.func_native("return endo_sim::block_max(value);")
def block_max(value: float) -> float:
    """Largest value of the threads of a block on a GPU; all must be here."""


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
):
    """Count control nodes that are not finite or out of bounds (the comparisons are false for NaN) and find the largest v².

    Environments where there are any return to the state before the step, at rest there. Where the step before was bad as
    well, they give way towards rest: from tissue that is turned inside out or stretched too far for its substeps every step
    is bad. u and F − 1 shrink together, and still fit.
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
                state.u[e] = kept * backup.u[e]
                state.F[e] = kept * (backup.F[e] - wp.identity(3, float)) + wp.identity(3, float)
                state.Q[e] = kept * backup.Q[e]
            state.v[e] = wp.vec3()
            state.C[e] = wp.mat33()
