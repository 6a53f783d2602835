"""Functions for kernels: sums over the threads of a block."""

import warp as wp

from endo_sim_ros.core.native import native

OPTIONS = {"extra_build_options": native("core/native/threads.h")}
"""Of a module whose kernels call them."""


@wp.func_native("return endo_sim::block_sum(value);")
def block_sum(value: wp.float64) -> wp.float64:
    """Sum over the threads of a block on a GPU, in the same order every time; all must be here. On a CPU there is one."""
    ...


@wp.func_native("return endo_sim::block_max(value);")
def block_max(value: float) -> float:
    """Largest value of the threads of a block on a GPU; all must be here."""
    ...
