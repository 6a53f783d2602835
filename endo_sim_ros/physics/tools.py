"""Tools: wrenches, jaws, rigid capsules and the links of instruments that act on the nodes, in device memory."""

import numpy as np
import torch
import warp as wp
from scipy.spatial import KDTree
from torch import Tensor

from endo_sim_ros.physics.arrays import zeroed
from endo_sim_ros.physics.backends.base import Launch
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes, skin_normals
from endo_sim_ros.physics.links import ToolLinks
from endo_sim_ros.physics.solver import MpmSolver
from endo_sim_ros.physics.tool_state_kernels import Commands, Holds, ToolConstants
from endo_sim_ros.physics.tools_kernels import load_nodes, measure_reactions, take_hold

# A capsule acts as at least this thick: of the distance between skin nodes, as a thinner one would part them and pass, and of
# a cell of the grid, as it would touch too few of its nodes to push the cell away.
THINNEST, THINNEST_CELL = 1.5, 0.3
# Distances between skin nodes by which jaws hold past the surface of such a capsule: a fold that they close on lies on it, and the
# next node of the skin may be as far away as that.
_MARGIN = 0.5


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
        shape, slots = (solver.environments, solver.tool_count), solver.capsule_count
        tools, entries = solver.environments * solver.tool_count, solver.environments * solver.tool_count * len(self.touchable)

        def view(array: wp.array, *rest: int) -> torch.Tensor:
            return wp.to_torch(array).view(*shape, *rest)

        links = dict.fromkeys(("start", "end", "radius", "link"), slots * tools)
        commands = zeroed(Commands, tools, solver.device, jaws=3 * tools, **links)
        links = dict.fromkeys(("last_start", "last_end", "link_force", "link_torque"), slots * tools)
        holds = zeroed(Holds, tools, solver.device, **links, **dict.fromkeys(("weight", "held", "local", "pulled"), entries))
        told = [getattr(commands, name) for name in Commands.vars] + [getattr(holds, name) for name in Holds.vars]
        self._everything = [wp.to_torch(array) for array in told]
        constants = ToolConstants()

        self.forces, self.torques = view(commands.force, 3), view(commands.torque, 3)  # [B, T, 3], N and N·m about the point held
        self.grasp_points = view(commands.grasp_point, 3)  # where the wrench takes hold [B, T, 3], m
        self.tips, self.rotations = view(commands.tip, 3), view(commands.R, 3, 3)  # at the end of the step: [B, T, 3], m; axes [B, T, 3, 3]
        self.present = view(commands.present)  # whether tip and axes mean anything [B, T], int32
        self.closed = view(commands.closed)  # whether the jaw is to be closed [B, T], int32
        self.linked = view(commands.linked)  # whether the tool is its links rather than the one capsule of all tools [B, T], int32
        self.jawed = view(commands.jawed)  # whether these hold what lies between two jaws, else nothing [B, T], int32
        self.starts, self.ends = view(commands.start, slots, 3), view(commands.end, slots, 3)  # of the links' capsules [B, T, K, 3], m
        self.radii = view(commands.radius, slots)  # of these, 0 = none [B, T, K], m, float32
        self.jaws = view(commands.jaws, 3, 3)  # hinge of the jaws, tips of the left and the right one [B, T, 3, 3], m
        self._jaw_radii = view(commands.jaw_radius)
        self.attached, self.gripping = view(holds.attached), view(holds.gripping)  # whether wrench and jaw hold tissue [B, T], int32
        self.slips = view(holds.slips)  # how often tissue slipped out of the jaw [B, T], int32
        self._placed, self._joined, self._shut = view(holds.placed), view(holds.joined), view(holds.shut)
        # What the tissue exerts back [B, T, 3], N and N·m (of a wrench about the point held, else about the tip).
        self.reaction_forces, self.reaction_torques = view(holds.reaction_force, 3), view(holds.reaction_torque, 3)
        # The part of the reaction of jaw and contact that each link feels, in the order of `ToolLinks.links` [B, T, K, 3], torques about
        # the tip.
        self.link_forces, self.link_torques = view(holds.link_force, slots, 3), view(holds.link_torque, slots, 3)
        self._link, self._links = view(commands.link, slots), view(commands.links)
        self.weights, self.held = (view(each, len(self.touchable)) for each in (holds.weight, holds.held))
        constants.touchable = wp.array(self.touchable.astype(np.int32), dtype=int, device=solver.device)
        constants.origin = wp.vec3d(*solver.origin)
        constants.radius, constants.travel, constants.duration = config.force_radius, config.travel, config.step_duration
        skin = nodes.rest[nodes.is_skin].astype(np.float64)
        apart = float(np.median(KDTree(skin).query(skin, k=2)[0][:, 1])) if len(skin) > 1 else 0.0
        thinnest = max(THINNEST * apart, THINNEST_CELL * solver.cell_size)
        radius = max(config.contact_radius, thinnest) if config.contact_radius else 0.0
        constants.contact_radius, constants.contact_length = radius, config.contact_length
        self.contact_radius = radius  # of the capsule that acts, m; 0 = none
        constants.capsules, constants.thinnest = slots, thinnest
        self.thinnest = thinnest  # radius as which thinner capsules act, m
        constants.cell, constants.stiffening = solver.cell_size, config.contact_stiffness / config.grasp_stiffness - 1
        constants.seen = int(nodes.seen_from is not None)
        constants.eye = wp.vec3d(*(np.zeros(3) if nodes.seen_from is None else nodes.seen_from))
        constants.margin = thinnest + _MARGIN * apart
        normals = skin_normals(nodes)[~nodes.pinned[nodes.is_skin]].astype(np.float32)
        constants.normal = wp.array(normals, dtype=wp.vec3, device=solver.device)
        constants.apart, constants.grasp_gap = apart, config.grasp_gap
        self.most_pull = 2 * config.friction * config.grip_force  # of jaws, N: friction at two faces; 0 = without limit
        constants.most_pull = self.most_pull
        self._faults = wp.zeros(solver.environments, int, device=solver.device)
        self.faults = wp.to_torch(self._faults)  # steps undone [B], int32

        threads = solver.backend.threads
        dim = (solver.environments, threads)
        common = [solver.tool_count, threads, commands, holds, constants, solver.nodes, solver.state]
        self._take_hold = Launch(take_hold, dim, [*common, solver.rigid], threads)
        load = Launch(load_nodes, dim, [*common, solver.loads, solver.rigid, solver.bad_nodes], threads)
        measure = Launch(measure_reactions, dim, [*common, solver.rigid, solver.bad_nodes, self._faults], threads)
        solver.wrap_step([self._take_hold, load], [measure])

    def take_hold(self) -> None:
        """Take hold of, or let go, now what commands say; otherwise the next step begins with it."""
        self._solver.backend.launch(self._take_hold)

    def set_links(self, tool: int, links: ToolLinks, poses: Tensor, touching: Tensor | None = None) -> None:
        """Let a tool be the links of an instrument from now on, which reach these poses at the end of the next step; nothing waits.

        Tip and axes of the tool stay what jaws carry tissue with and what reactions are about: write them, and `present`, too.

        Args:
            tool: Number of the tool, the same in all environments.
            links: The instrument.
            poses: Link-to-world transforms [B, L, 4, 4], m, float64, in the order of `ToolLinks.links`.
            touching: Which of its capsules push [K] or [B, K], bool; None = all.

        Raises:
            ValueError: If the instrument has more capsules than the tools have room for, or the poses have another shape.
        """
        environments, slots = self.radii.shape[0], self.radii.shape[2]
        if len(links) > slots:
            raise ValueError(f"the instrument has {len(links)} capsules, but tools have room for {slots}; give `capsules` when you begin")
        if tuple(poses.shape) != (environments, len(links.links), 4, 4):
            expected = f"[{environments}, {len(links.links)}, 4, 4] ({', '.join(links.links)})"
            raise ValueError(f"poses of links have shape {list(poses.shape)}, expected {expected}")
        placed = links.place(poses.to(self.starts))
        self.starts[:, tool, : len(links)], self.ends[:, tool, : len(links)] = placed.starts, placed.ends
        self.radii[:, tool] = 0
        radii, self._link[:, tool, : len(links)] = links.on(self.radii.device)
        self._links[:, tool] = len(links.links)
        self.radii[:, tool, : len(links)] = radii.float() if touching is None else (radii * touching.to(radii.device)).float()
        self.jaws[:, tool], self._jaw_radii[:, tool] = placed.jaws, links.jaw_radius
        self.linked[:, tool], self.jawed[:, tool] = 1, int(links.grasps)

    def copy(self, other: "Tools") -> None:
        """Take over commands, holds and counts of the tools of other tissue with the same nodes and environments."""
        for mine, theirs in zip(self._everything, other._everything):
            mine.copy_(theirs)
        self.faults.copy_(other.faults)

    def reset(self, environments: torch.Tensor | slice = slice(None)) -> None:
        """No command, nothing held, nothing counted in these environments."""
        for tensor in (self.forces, self.torques, self.reaction_forces, self.reaction_torques, self.link_forces, self.link_torques):
            tensor[environments] = 0
        for tensor in (self.present, self.closed, self.attached, self.gripping, self.slips, self._placed, self.faults):
            tensor[environments] = 0
        for tensor in (self.linked, self.jawed, self._joined, self._shut):
            tensor[environments] = 0
