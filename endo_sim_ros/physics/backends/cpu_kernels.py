"""Kernels for a CPU, vectorised: a step of the material point method, all substeps in one launch, and skinning.

The maths is in `plain_kernels` and `node_map_kernels`, the code in native/cpu_step.h and native/skinning.h. Environments are
independent: different threads may step different ones.
"""

import functools

import warp as wp

from endo_sim_ros.core.native import LANE_COUNT, native
from endo_sim_ros.physics.backends.structs import Grid, Loads, Nodes, RigidTools, Skin, State, Substep
from endo_sim_ros.physics.materials import LEAST_VOLUME

SCRATCH = 57  # vectors of scratch for 16 control nodes: 41 components and 16 rows of weights
HEADER = native("physics/native/cpu_step.h", LANE_COUNT=LANE_COUNT, CPU_SCRATCH=SCRATCH, LEAST_VOLUME=LEAST_VOLUME)
OPTIONS = {"default_grid_stride": False, "extra_build_options": HEADER}
SKINNING = {"default_grid_stride": False, "extra_build_options": native("physics/native/skinning.h")}

wp.set_module_options({"enable_backward": False, **SKINNING})


@functools.cache
def make_step_kernel(material: str, kinematics: str):
    """The kernel that takes a whole step for the environments [first, first + n) of an n-thread launch."""
    law, current = f"endo_sim::{material}", str(kinematics == "current").lower()

    @wp.func_native(f"""
        endo_sim::take_step<{law}, {current}>(b, slot, nodes, state, loads, tools, grid, substep, substeps, scale.data, order.data,
            momenta.data, velocities.data, scratch.data, bases.data, pulled.data, source_tools.data);
    """)
    def step_environment(
        b: int,
        slot: int,
        nodes: Nodes,
        state: State,
        loads: Loads,
        tools: RigidTools,
        grid: Grid,
        substep: Substep,
        substeps: int,
        scale: wp.array[float],
        order: wp.array[int],
        momenta: wp.array[float],
        velocities: wp.array[float],
        scratch: wp.array[float],
        bases: wp.array[int],
        pulled: wp.array[float],
        source_tools: wp.array[int],
    ): ...

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS)
    def step(
        first: int,
        slot: int,  # of the scratch memory
        nodes: Nodes,
        state: State,
        loads: Loads,
        tools: RigidTools,
        grid: Grid,
        substep: Substep,
        substeps: int,
        scale: wp.array[float],  # [B · M]
        order: wp.array[int],  # control nodes sorted by cell, padded by -1 to a multiple of 16
        momenta: wp.array[float],  # scratch of each slot, as all below: [S, count + 4, 4]
        velocities: wp.array[float],
        scratch: wp.array[float],
        bases: wp.array[int],  # [S, padded]
        pulled: wp.array[float],  # [S, padded / 16, 4, 16]
        source_tools: wp.array[int],  # [S, padded]
    ):
        step_environment(
            first + wp.tid(), slot, nodes, state, loads, tools, grid, substep, substeps, scale, order, momenta, velocities,
            scratch, bases, pulled, source_tools,
        )  # fmt: skip

    return step


@wp.func_native("""
    const size_t first = (size_t)n * rest.neighbours.shape[1];
    endo_sim::skin<endo_sim::VectorColumn>((const float*)(rest.means.data + n), (const float*)(rest.covars.data + n),
        rest.neighbours.data + first, rest.weights.data + first, rest.neighbours.shape[1], (const float*)maps.data,
        rest.origin.c, rest.low, rest.high, (float*)(out_means.data + n), (float*)(out_covars.data + n));
""")
def skin_gaussian(n: int, rest: Skin, maps: wp.array[wp.mat44], out_means: wp.array[wp.vec3], out_covars: wp.array[wp.mat33]): ...


@wp.kernel
def skin_gaussians(first: int, rest: Skin, maps: wp.array[wp.mat44], out_means: wp.array[wp.vec3], out_covars: wp.array[wp.mat33]):
    """The Gaussians from the first one on, see `node_map_kernels`; the numbers of a map are one vector."""
    skin_gaussian(first + wp.tid(), rest, maps, out_means, out_covars)
