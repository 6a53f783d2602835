"""Physics on a GPU: a step is one captured graph, on a GPU with thread block clusters of one launch.

Within `core.kernels.compare_plain` its plain kernels run on a CPU, to compare with the vectorised ones.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import no_garbage_collection, on_torch_stream
from endo_sim_ros.core.kernels import launch
from endo_sim_ros.physics.backends import cluster_division as cluster, plain_skinning_kernels
from endo_sim_ros.physics.backends.base import Action, Launch, StepData, Work, capturing, viewed
from endo_sim_ros.physics.backends.cluster_kernels import make_step_kernel
from endo_sim_ros.physics.backends.cpu import cpu_action
from endo_sim_ros.physics.backends.end_kernels import THREADS
from endo_sim_ros.physics.backends.plain_kernels import collect, make_advance_kernel, scatter, update_grid
from endo_sim_ros.physics.backends.plain_skinning_kernels import skin_environments
from endo_sim_ros.physics.backends.structs import Skin, Transfer


class CudaBackend:
    """Plain Warp kernels, and those of a thread block cluster; see `Backend`."""

    skin_modules = (plain_skinning_kernels,)

    def __init__(self, device: str):
        self.device = device
        self._comparing = device == "cpu"  # within `compare_plain`
        self.threads = 1 if self._comparing else THREADS
        self.prepares_early = self._comparing

    def substeps(self, step: StepData) -> list[Action]:
        """One launch where the control nodes fit into a cluster, otherwise two or three for each substep."""
        return self._clustered(step) or self._launched(step)

    def action(self, work: Work) -> Action:
        """A launch; several run in order."""
        if self._comparing:
            return cpu_action(work)
        if isinstance(work, list):
            actions = [self.action(each) for each in work]
            return lambda: [action() for action in actions]
        wp.load_module(work.kernel.module, device=self.device, block_dim=work.block)
        return functools.partial(wp.launch, work.kernel, work.dim, work.inputs, device=self.device, block_dim=work.block)

    def record(self, actions: Sequence[Action]) -> Action:
        """The actions as one captured graph."""
        if self._comparing:
            return lambda: [action() for action in actions]
        with capturing, no_garbage_collection(), wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for action in actions:
                action()
        wp.synchronize_device(self.device)  # its arrays were filled on another stream than torch's, on which it runs
        return _Replay(capture.graph, actions)

    def launch(self, launch: Launch) -> None:
        with on_torch_stream(self.device):
            wp.launch(launch.kernel, launch.dim, launch.inputs, device=self.device, block_dim=launch.block)

    def load_for_cuts(self, material: str, kinematics: str) -> None:
        """Load the kernels of single substeps: the grid nodes of tissue that is much cut no longer fit into a cluster."""
        if not self._comparing:
            for kernel in (make_advance_kernel(material, kinematics), collect):
                wp.load_module(kernel.module, self.device, block_dim=Launch.block)

    def over_items(self, kernel: Any, count: int, arguments: Sequence) -> None:
        if count:
            launch(kernel, count, [0, *arguments], self.device)

    def skin(self, rest: Skin, maps: Tensor, means: Tensor, covars: Tensor) -> None:
        if len(means):
            launch(skin_environments, (1, len(means)), [0, rest, maps, means, covars], self.device)

    def skin_work(self, rest: Skin, maps: Tensor, means: Tensor, covars: Tensor) -> list[Work]:
        outputs = [viewed(means.view(-1, 3), wp.vec3), viewed(covars.view(-1, 3, 3), wp.mat33)]
        inputs = [maps.shape[1], rest, viewed(maps.view(-1, 4, 4), wp.mat44), *outputs]
        return [Launch(skin_environments, means.shape[:2], inputs)]

    def _clustered(self, step: StepData) -> list[Action]:
        """One launch for all substeps, on a GPU with clusters of multiprocessors; none for more control nodes than they hold."""
        # What it compiles for, which is less than the GPU where another one in the machine is older.
        arch = wp.get_device(self.device).get_cuda_compile_arch()
        if arch is None or arch < 90 or step.kinematics == "current" or step.own_cuts:  # a division is of all environments
            return []
        device, memory = wp.get_device(self.device), 16 * cluster.SHARED
        if device.max_shared_memory_per_block < memory + cluster.OTHERS:
            return []
        rest_cells, corners = step.stencils[0].rest_cells, step.stencils[0].corners()
        for blocks in cluster.by_preference(step.environments, device.sm_count):
            division = cluster.divide(rest_cells, corners, blocks)
            if division is None:
                continue
            kernel = make_step_kernel(step.material, division.lanes, blocks)
            if wp.get_cuda_max_cluster_dim(kernel, device, block_dim=cluster.BLOCK, dynamic_smem_bytes=memory) < blocks:
                continue
            tables = [wp.array(values, dtype=int, device=device) for values in division[3:]]
            inputs = [step.nodes, step.state, step.loads, step.tools, step.grid, step.substep, step.substeps, step.scale]
            inputs += [division.slots, division.inbox, *tables]
            return [self.action(Launch(kernel, step.environments * blocks * cluster.BLOCK, inputs, cluster.BLOCK))]
        return []

    def _launched(self, step: StepData) -> list[Action]:
        """Two launches for each substep with rest kinematics, three with current kinematics."""
        current, device = step.kinematics == "current", self.device
        advance = make_advance_kernel(step.material, step.kinematics)
        every, grid_count = (step.environments, step.node_count), step.environments * step.grid.count
        transfer = Transfer()
        transfer.given, transfer.pull = (wp.zeros(n * math.prod(every), wp.vec4, device=device) for n in (4, 1))
        transfer.source_tool = wp.full(math.prod(every), -1, dtype=int, device=device)
        grid_v, decay = wp.zeros(grid_count, wp.vec4, device=device), step.substep.decay
        if current:
            grid_mv = wp.zeros(grid_count, wp.vec4, device=device)
            collecting = [
                self.action(Launch(scatter, every, [step.nodes, step.state, transfer, step.grid, grid_mv])),
                self.action(Launch(update_grid, grid_count, [decay, grid_mv, grid_v])),
            ]
            actions: list[Action] = [grid_mv.zero_]
        else:
            lanes, (most, entries) = 1 if self._comparing else 32, self._entries(step)
            inputs = [*entries, lanes, step.node_count, step.grid, decay, transfer, grid_v]
            collecting = [self.action(Launch(collect, (step.environments, most, lanes), inputs))]
            actions = []
        constants = [step.nodes, step.state, step.loads, step.tools, transfer, step.grid, step.substep, step.scale]
        count = step.substeps
        for substep in range(count + 1):
            halves = [int(substep > 0), int(substep < count)]
            time = (substep + 1) * step.substep.dt
            actions.append(self.action(Launch(advance, every, [*constants, time, *halves, grid_v])))
            if substep < count:
                actions += collecting
        return actions

    def _entries(self, step: StepData) -> tuple[int, list[wp.array]]:
        """The most grid nodes that an environment uses, and for each the control nodes that give to it, as `collect` reads them."""
        different = list(dict.fromkeys(step.stencils))
        starts, members, offsets, places = zip(*(stencils.by_grid_node for stencils in different))
        ends = np.cumsum([len(each) for each in places])
        lists = np.stack([ends - [len(each) for each in places], ends], 1)
        lists = lists[[different.index(stencils) for stencils in step.stencils]]
        entries = np.cumsum([0, *(len(each) for each in members)])
        starts = [*(each[:-1] + before for each, before in zip(starts, entries)), entries[-1:]]
        values = [lists.astype(np.int32), *(np.concatenate(each) for each in (starts, members, offsets, places))]
        values[1] = values[1].astype(np.int32)
        arrays = [wp.array(each, dtype=dtype, device=self.device) for each, dtype in zip(values, (wp.vec2i, int, int, wp.vec4, int))]
        return int(np.ptp(lists, 1).max()), arrays


class _Replay:
    """Replays a graph, and keeps what it works on: a graph does not keep the memory."""

    def __init__(self, graph: Any, actions: Sequence[Action]):
        self._graph, self._actions = graph, actions

    def __call__(self) -> None:
        wp.capture_launch(self._graph)
