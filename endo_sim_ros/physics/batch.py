"""Many copies of one tissue, stepped together, in tensors."""

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike
from torch import Tensor

from endo_sim_ros.physics.backends.base import capturing
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.physics.regions import TissueProperties, paint_regions
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.physics.solver import MpmSolver
from endo_sim_ros.physics.tools import Tools


def tissue_properties(nodes: ControlNodes, config: PhysicsConfig) -> TissueProperties:
    """Stiffness and density of each node [M]: those of the config with its regions painted over."""
    uniform = TissueProperties.uniform(len(nodes), config.young_modulus, config.poisson_ratio, config.density)
    return paint_regions(uniform, nodes.rest, config.regions)


class TissueBatch:
    """B independent copies of the same tissue, stepped together, with T tools each; for learning.

    Everything is a tensor on the simulation's device, and nothing waits for it: write commands into ``tools`` (see
    :class:`Tools`), call :meth:`step`, read ``displacements``, ``F`` and the reactions. Copies differ by their tools
    and, if asked for, by their stiffness. A step that ends badly is undone in its copy and counted in ``tools.faults``.

    Args:
        nodes: The nodes at rest.
        config: Parameters.
        environments: B.
        tools: T.
        properties: Stiffness and density of each node; default: those of the config, with its regions.
        stiffness: Factor on the moduli of each copy [B], or of each of its nodes [B, M]; default 1. See `MpmSolver.set_stiffness`.
        capsules: Room for the capsules of each tool's links, see `Tools.set_links`.

    Raises:
        ValueError: If the config or the nodes make no tissue, see :class:`MpmSolver`.
    """

    def __init__(
        self,
        nodes: ControlNodes,
        config: PhysicsConfig,
        environments: int,
        tools: int = 1,
        properties: TissueProperties | None = None,
        stiffness: ArrayLike | None = None,
        capsules: int = 1,
    ):
        self.nodes, self.config = nodes, config
        properties = tissue_properties(nodes, config) if properties is None else properties
        with capturing:
            self.solver = MpmSolver(
                nodes, config, properties, environments=environments, tools=tools, capsules=capsules, stiffness=stiffness
            )
            self.tools = Tools(self.solver, nodes, config)
        self.step_duration = config.step_duration
        self.displacements: Tensor = wp.to_torch(self.solver.state.u).view(environments, -1, 3)  # [B, M, 3] m
        self.F: Tensor = wp.to_torch(self.solver.state.F).view(environments, -1, 3, 3)  # [B, M, 3, 3]
        self._rest = torch.from_numpy(nodes.rest).to(self.solver.device)
        self._free = torch.from_numpy(~nodes.pinned).to(self.solver.device)

    def step(self) -> None:
        """Advance all copies by ``step_duration``."""
        self.solver.step()

    def positions(self) -> Tensor:
        """Positions of the nodes [B, M, 3], m, world; pinned ones where they rest, or where breath and heart have them."""
        return self._rest + torch.where(self._free[:, None], self.displacements, wp.to_torch(self.solver.held)[:, None])

    def append_skinning(self, skinning: Skinning) -> tuple[Tensor, Tensor]:
        """Make skinning part of every step from now on, in place of another that was; on a GPU of the one graph that a step is.

        Args:
            skinning: With compact weights, bound to these nodes at rest, on this device; cuts that come later count.

        Returns:
            Means [B, N, 3], m, world, and covariances [B, N, 3, 3], m², of the Gaussians at the end of each step, which the
            next overwrites: the same bits as `Skinning.deform` gives.

        Raises:
            ValueError: If the skinning is another's.
        """
        state = self.solver.state
        work, means, covars = skinning.work(state.u, state.F, self.nodes.pinned, self.solver.held, self.solver.environments)
        self.solver.append_launches(work)
        return means, covars

    def reset(self, environments: Tensor | slice = slice(None), phases: np.ndarray | None = None) -> None:
        """Back to rest, in these K copies; their tools let go. Breath and heart begin with phases [K, 2], default: those of the config."""
        self.solver.reset(environments, phases)
        self.tools.reset(environments)
