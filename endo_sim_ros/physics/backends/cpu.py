"""Physics on a CPU: vectorised kernels, shared out among threads."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import cpu_threads, run_in_threads, shares
from endo_sim_ros.core.kernels import launch_in_shares
from endo_sim_ros.core.native import LANE_COUNT
from endo_sim_ros.physics.backends import cpu_kernels
from endo_sim_ros.physics.backends.base import Action, Launch, StepData, Work, viewed
from endo_sim_ros.physics.backends.cpu_kernels import SCRATCH, make_step_kernel, skin_gaussians
from endo_sim_ros.physics.backends.structs import Skin

SHARED_FROM = 4096  # Gaussians; fewer are done before a second thread has begun


class CpuBackend:
    """The vectorised kernels; see `Backend`."""

    device = "cpu"
    threads = 1
    prepares_early = True
    skin_modules = (cpu_kernels,)

    def substeps(self, step: StepData) -> list[Action]:
        """One launch for all substeps; environments are shared out among threads, each with its scratch memory."""
        kernel = make_step_kernel(step.material, step.kinematics)
        slots = min(cpu_threads(), step.environments)
        padded = -(-step.node_count // LANE_COUNT) * LANE_COUNT
        order = np.full(padded, -1, np.int32)
        order[: step.node_count] = step.stencils[0].sorted_nodes()
        floats = functools.partial(wp.zeros, dtype=float, device="cpu")
        scratch = [wp.array(order, dtype=int, device="cpu")]
        scratch += [floats(slots * 4 * (step.grid.count + 4)) for _ in range(2)]
        scratch += [floats(slots * SCRATCH * padded), wp.zeros(slots * padded, int, device="cpu")]
        scratch += [floats(slots * 4 * padded), wp.full(slots * padded, -1, dtype=int, device="cpu")]
        inputs = [step.nodes, step.state, step.loads, step.tools, step.grid, step.substep, step.substeps, step.scale]
        ends = [step.environments * slot // slots for slot in range(slots + 1)]
        launches = [
            self.action(Launch(kernel, end - begin, [begin, slot, *inputs, *scratch]))
            for slot, (begin, end) in enumerate(zip(ends, ends[1:]))
        ]
        return [lambda: run_in_threads(launches)]

    def action(self, work: Work) -> Action:
        """A recorded launch, or several that are shared out among threads."""
        return cpu_action(work)

    def record(self, actions: Sequence[Action]) -> Action:
        """The actions one after the other. No graph: its capture on a CPU takes in, and does not run, what other threads
        of the process launch meanwhile."""
        return lambda: [action() for action in actions]

    def launch(self, launch: Launch) -> None:
        wp.launch(launch.kernel, launch.dim, launch.inputs, device="cpu")

    def load_for_cuts(self, material: str, kinematics: str) -> None:
        pass

    def over_items(self, kernel: Any, count: int, arguments: Sequence) -> None:
        launch_in_shares(kernel, count, arguments, SHARED_FROM)

    def skin(self, rest: Skin, maps: Tensor, means: Tensor, covars: Tensor) -> None:
        if maps.any():
            self.over_items(skin_gaussians, len(means), [rest, maps, means, covars])
        else:  # nothing has moved yet
            means.copy_(wp.to_torch(rest.means))
            covars.copy_(wp.to_torch(rest.covars))

    def skin_work(self, rest: Skin, maps: Tensor, means: Tensor, covars: Tensor) -> list[Work]:
        done: list[Work] = []
        for b in range(len(means)):
            inputs = [rest, viewed(maps[b], wp.mat44), viewed(means[b], wp.vec3), viewed(covars[b], wp.mat33)]
            done.append([Launch(skin_gaussians, size, [first, *inputs]) for first, size in shares(means.shape[1], SHARED_FROM)])
        return done


def cpu_action(work: Work) -> Action:
    """Return work on the CPU as a call."""
    if isinstance(work, list):
        actions = [cpu_action(each) for each in work]
        return functools.partial(run_in_threads, actions)
    wp.load_module(work.kernel.module, device="cpu")
    command: Any = wp.launch(work.kernel, work.dim, work.inputs, device="cpu", record_cmd=True)
    return command.launch
