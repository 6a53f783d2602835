"""Tools: wrenches, jaws and rigid capsules that act on the nodes, in device memory."""

import numpy as np
import torch
import warp as wp
from scipy.spatial import KDTree

from endo_sim_ros.physics.backends.base import Launch
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.physics.solver import MpmSolver
from endo_sim_ros.physics.tools_kernels import Commands, Holds, ToolConstants, load_nodes, measure_reactions, take_hold

# A capsule acts as at least this thick: of the distance between skin nodes, as a thinner one would part them and pass, and of
# a cell of the grid, as it would touch too few of its nodes to push the cell away.
_THINNEST, _THINNEST_CELL = 1.5, 0.3


class Tools:
    """T tools in each of the solver's B environments.

    All tensors live on the solver's device and are read and written by its step; indexed [b, t], world frame, float64.

    Args:
        solver: Whose nodes the tools touch.
        nodes: These nodes at rest.
        config: Reach of wrenches and jaws, contact, travel.
    """

    def __init__(self, solver: MpmSolver, nodes: ControlNodes, config: PhysicsConfig):
        self._solver = solver
        self.touchable = np.flatnonzero(nodes.is_skin & ~nodes.pinned)  # [S]
        shape = (solver.environments, solver.tool_count)
        tools, entries = solver.environments * solver.tool_count, solver.environments * solver.tool_count * len(self.touchable)

        self._everything: list[torch.Tensor] = []  # that commands and holds are

        def zeros(dtype: type, count: int = tools) -> wp.array:
            array = wp.zeros(count, dtype, device=solver.device)
            self._everything.append(wp.to_torch(array))
            return array

        def view(array: wp.array, *rest: int) -> torch.Tensor:
            return wp.to_torch(array).view(*shape, *rest)

        commands, holds, constants = Commands(), Holds(), ToolConstants()
        commands.force, commands.torque, commands.grasp_point, commands.tip = (zeros(wp.vec3d) for _ in range(4))
        commands.R, commands.present, commands.closed = zeros(wp.mat33d), zeros(int), zeros(int)
        holds.contact, holds.applied_force, holds.applied_torque = (zeros(wp.vec3d) for _ in range(3))
        holds.reaction_force, holds.reaction_torque = zeros(wp.vec3d), zeros(wp.vec3d)
        holds.attached, holds.gripping, holds.slips = (zeros(int) for _ in range(3))
        holds.last_tip, holds.last_R, holds.placed = zeros(wp.vec3d), zeros(wp.mat33d), zeros(int)
        holds.weight, holds.held = zeros(float, entries), zeros(int, entries)
        holds.local, holds.pulled = zeros(wp.vec3d, entries), zeros(wp.vec3d, entries)

        self.forces, self.torques = view(commands.force, 3), view(commands.torque, 3)  # [B, T, 3], N and N·m about the point held
        self.grasp_points = view(commands.grasp_point, 3)  # where the wrench takes hold [B, T, 3], m
        self.tips, self.rotations = view(commands.tip, 3), view(commands.R, 3, 3)  # at the end of the step: [B, T, 3], m; axes [B, T, 3, 3]
        self.present = view(commands.present)  # whether tip and axes mean anything [B, T], int32
        self.closed = view(commands.closed)  # whether the jaw is to be closed [B, T], int32
        self.attached, self.gripping = view(holds.attached), view(holds.gripping)  # whether wrench and jaw hold tissue [B, T], int32
        self.slips = view(holds.slips)  # how often tissue slipped out of the jaw [B, T], int32
        self._placed = view(holds.placed)
        # What the tissue exerts back [B, T, 3], N and N·m (of a wrench about the point held, else about the tip).
        self.reaction_forces, self.reaction_torques = view(holds.reaction_force, 3), view(holds.reaction_torque, 3)
        self.weights, self.held = (view(each, len(self.touchable)) for each in (holds.weight, holds.held))
        constants.touchable = wp.array(self.touchable.astype(np.int32), dtype=int, device=solver.device)
        constants.origin = wp.vec3d(*solver.origin)
        constants.radius, constants.travel, constants.duration = config.force_radius, config.travel, config.step_duration
        skin = nodes.rest[nodes.is_skin].astype(np.float64)
        apart = float(np.median(KDTree(skin).query(skin, k=2)[0][:, 1])) if len(skin) > 1 else 0.0
        thinnest = max(_THINNEST * apart, _THINNEST_CELL * solver.cell_size)
        radius = max(config.contact_radius, thinnest) if config.contact_radius else 0.0
        constants.contact_radius, constants.contact_length = radius, config.contact_length
        self.contact_radius = radius  # of the capsule that acts, m; 0 = none
        self._faults = wp.zeros(solver.environments, int, device=solver.device)
        self.faults = wp.to_torch(self._faults)  # steps undone [B], int32

        threads = solver.backend.threads
        dim = (solver.environments, threads)
        common = [solver.tool_count, threads, commands, holds, constants, solver.nodes, solver.state]
        self._take_hold = Launch(take_hold, dim, common, threads)
        load = Launch(load_nodes, dim, [*common, solver.loads, solver.rigid, solver.bad_nodes], threads)
        measure = Launch(measure_reactions, dim, [*common, solver.rigid, solver.bad_nodes, self._faults], threads)
        solver.wrap_step([self._take_hold, load], [measure])

    def take_hold(self) -> None:
        """Take hold of, or let go, now what commands say; otherwise the next step begins with it."""
        self._solver.backend.launch(self._take_hold)

    def copy(self, other: "Tools") -> None:
        """Take over commands, holds and counts of the tools of other tissue with the same nodes and environments."""
        for mine, theirs in zip(self._everything, other._everything):
            mine.copy_(theirs)
        self.faults.copy_(other.faults)

    def reset(self, environments: torch.Tensor | slice = slice(None)) -> None:
        """No command, nothing held, nothing counted in these environments."""
        for tensor in (self.forces, self.torques, self.reaction_forces, self.reaction_torques):
            tensor[environments] = 0
        for tensor in (self.present, self.closed, self.attached, self.gripping, self.slips, self._placed, self.faults):
            tensor[environments] = 0
