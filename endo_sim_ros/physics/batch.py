"""Many copies of one tissue, stepped together, in tensors."""

import copy
from collections.abc import Mapping, Sequence

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike
from torch import Tensor

from endo_sim_ros.physics.backends.base import capturing
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.physics.cutting.blade import Blade
from endo_sim_ros.physics.cutting.stencils import CutStencils
from endo_sim_ros.physics.cutting.tearing import Tearing, may_tear
from endo_sim_ros.physics.cutting.tension import released_forces
from endo_sim_ros.physics.regions import TissueProperties, paint_regions
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.physics.solver import MpmSolver
from endo_sim_ros.physics.tools import Tools

_SHREDS = 0.5  # of the travel; skin that the tension of a cut has drawn so far hangs by a thread


def tissue_properties(nodes: ControlNodes, config: PhysicsConfig) -> TissueProperties:
    """Stiffness and density of each node [M]: those of the config with its regions painted over."""
    uniform = TissueProperties.uniform(len(nodes), config.young_modulus, config.poisson_ratio, config.density)
    return paint_regions(uniform, nodes.rest, config.regions)


class TissueBatch:
    """B independent copies of the same tissue, stepped together, with T tools each; for learning.

    Everything is a tensor on the simulation's device, and nothing waits for it: write commands into ``tools`` (see
    :class:`Tools`), call :meth:`step`, read ``displacements``, ``F`` and the reactions. Copies differ by their tools
    and, if asked for, by their stiffness and by their cuts. A step that ends badly is undone in its copy and counted in ``tools.faults``.

    Args:
        nodes: The nodes at rest.
        config: Parameters.
        environments: B.
        tools: T.
        properties: Stiffness and density of each node; default: those of the config, with its regions.
        stiffness: Factor on the moduli of each copy [B], or of each of its nodes [B, M]; default 1. See `MpmSolver.set_stiffness`.
        capsules: Room for the capsules of each tool's links, see `Tools.set_links`.
        own_cuts: Whether each copy may be cut, see :class:`MpmSolver`. Each tears by itself then, too, where `tear_strain` is
            above zero, for which a step waits for the device.

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
        own_cuts: bool = False,
    ):
        self.nodes, self.config = nodes, config
        properties = tissue_properties(nodes, config) if properties is None else properties
        with capturing:
            self.solver = MpmSolver(
                nodes, config, properties, environments=environments, tools=tools, capsules=capsules, stiffness=stiffness,
                own_cuts=own_cuts,
            )  # fmt: skip
            self.tools = Tools(self.solver, nodes, config)
        self.step_duration = config.step_duration
        self.displacements: Tensor = wp.to_torch(self.solver.state.u).view(environments, -1, 3)  # [B, M, 3] m
        self.F: Tensor = wp.to_torch(self.solver.state.F).view(environments, -1, 3, 3)  # [B, M, 3, 3]
        self._rest = torch.from_numpy(nodes.rest).to(self.solver.device)
        self._free = torch.from_numpy(~nodes.pinned).to(self.solver.device)
        self._cuts: dict[int, CutStencils] = {}  # of copies that have been cut
        self._blades: dict[tuple[int, int], Blade] = {}  # of tools that cut, by copy and number
        self._tears = own_cuts and config.tear_strain > 0 and config.kinematics == "rest"
        rest = nodes.rest.astype(np.float64)
        self.tearing = [Tearing(rest, config.tear_strain, self.solver.cell_size) for _ in range(environments if own_cuts else 0)]
        """What has torn of each copy that may be cut."""

    def step(self) -> list[int]:
        """Advance all copies by ``step_duration``, and return those that tore at its end."""
        faults = self.tools.faults.clone() if self._tears else None
        self.solver.step()
        if self._cuts and self.config.skin_strain:
            self.solver.release_far(_SHREDS * self.config.travel)
        return [] if faults is None else self._tear(self.tools.faults == faults)

    def _tear(self, whole: Tensor) -> list[int]:
        """Tear copies whose step was not undone [B], where they are strained beyond what they bear."""
        F = self.gradients()
        able = torch.nonzero(whole & may_tear(F, self.config.tear_strain))[:, 0].tolist()
        along = {b: triangles for b in able if len(triangles := self.tearing[b].tear(F[b].cpu().numpy()))}
        known = {b: len(self.cuts(b)) for b in along}
        parted = self.cut(along)
        for b in along:
            self.tearing[b].triangles += range(known[b], len(self.cuts(b)))
        return parted

    def positions(self) -> Tensor:
        """Positions of the nodes [B, M, 3], m, world; pinned ones where they rest, or where breath and heart have them."""
        return self._rest + torch.where(self._free[:, None], self.displacements, self.solver.motion.shifts())

    def gradients(self, environments: Tensor | slice = slice(None)) -> Tensor:
        """Deformation gradients of the nodes in these K copies [K, M, 3, 3]; pinned ones are whole, or as breath and heart strain them."""
        return torch.where(self._free[:, None, None], self.F[environments], self.solver.motion.gradients(environments))

    def state(self, environment: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Positions [M, 3], m, world, and deformation gradients [M, 3, 3] of the nodes of a copy now, float32; pinned ones are where breath
        and heart have them."""
        free = ~self.nodes.pinned[:, None]
        motion, one = self.solver.motion, slice(environment, environment + 1)
        shifts, gradients = motion.shifts(one)[0].cpu().numpy(), motion.gradients(one)[0].cpu().numpy()
        positions = self.nodes.rest + np.where(free, self.displacements[environment].cpu().numpy(), shifts)
        return positions, np.where(free[..., None], self.F[environment].cpu().numpy(), gradients)

    def cuts(self, environment: int = 0) -> np.ndarray:
        """All that has been cut of a copy, as triangles in the tissue at rest [T, 3, 3], m, world."""
        return self._cuts[environment].triangles if environment in self._cuts else np.zeros((0, 3, 3))

    def parted_links(self, environment: int = 0) -> int:
        """How many links between neighbouring control nodes cuts of a copy have parted."""
        return int(self._cuts[environment].broken.sum()) if environment in self._cuts else 0

    def prepare_cuts(self, environment: int = 0) -> CutStencils:
        """Find what cuts of a copy part, which the first would otherwise wait for.

        Raises:
            ValueError: As `MpmSolver.require_cuttable` does.
        """
        self.solver.require_cuttable()
        if not self._cuts:
            self._cuts[environment] = CutStencils(self.nodes.rest, self.solver.rest_cells, self.solver.grid_shape)
            with capturing:
                self.solver.backend.load_for_cuts(self.config.material, self.config.kinematics)
        if environment not in self._cuts:
            self._cuts[environment] = copy.copy(next(iter(self._cuts.values())))
            self._cuts[environment].reset()  # which makes arrays of its own
        return self._cuts[environment]

    def cut(self, triangles: Mapping[int, np.ndarray]) -> list[int]:
        """Part copies along triangles [T, 3, 3], m, world, at rest, by their numbers, and return those where that changed anything."""
        parted = [b for b, own in triangles.items() if len(own) and self.prepare_cuts(b).cut(own)]
        self._open(parted)
        return parted

    def _open(self, environments: Sequence[int]) -> None:
        """Let copies be parted as their stencils are, and their edges draw back."""
        solver = self.solver
        if not environments:
            return
        with capturing:
            solver.set_cuts({b: self._cuts[b].table() for b in environments})
            if self.config.skin_strain:
                stress = 2 * solver.mu * (3 * solver.lam + 2 * solver.mu) / (solver.lam + 2 * solver.mu)  # of strain 1 in both directions
                pulls = self.config.skin_strain * stress * self.nodes.volumes ** (2 / 3)
                rest, pinned = self.nodes.rest.astype(np.float64), self.nodes.pinned
                for b in environments:
                    links = self._cuts[b].links[self._cuts[b].broken]
                    links = links[self.nodes.is_skin[links].all(1)]
                    solver.set_released(b, released_forces(rest, links, pulls, self._cuts[b].pieces(), pinned))

    def take_cuts(self, other: "TissueBatch") -> None:
        """Take over the cuts and tears of the first copy of other tissue with the same nodes, which is not stepped any more."""
        self.tearing[0].copy(other.tearing[0])
        if not len(other.cuts()):
            return
        if self.solver.grid_shape == other.solver.grid_shape and self.solver.cell_size == other.solver.cell_size:
            self._cuts[0] = other._cuts[0]
        stencils = self.prepare_cuts()
        if stencils is not other._cuts[0]:
            stencils.cut(other.cuts())
        self._open([0])

    def move_edges(self, poses: np.ndarray, cutting: np.ndarray) -> list[int]:
        """Move the cutting edges of tools, as `TissueSimulation.set_cut` does with that of one.

        Args:
            poses: Tip-to-world transforms [B, T, 4, 4], m.
            cutting: Which edges cut [B, T].

        Returns:
            Copies that were parted.
        """
        parted: list[int] = []
        for tool in range(cutting.shape[1]):
            swept = {}
            for b in range(len(cutting)):
                if not cutting[b, tool]:
                    self._blades.pop((b, tool), None)
                    continue
                blade = self._blades.setdefault((b, tool), Blade(self.config.blade_length, self.nodes.spacing))
                swept[b] = blade.move(poses[b, tool], self.nodes.rest, *self.state(b), self.cuts(b))
            parted += self.cut(swept)
        return parted

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
        work, means, covars = skinning.work(state.u, state.F, self.nodes.pinned, self.solver.motion, self.solver.environments)
        self.solver.append_launches(work)
        return means, covars

    def reset(self, environments: Tensor | slice = slice(None), phases: np.ndarray | None = None) -> None:
        """Back to rest, in these K copies; their tools let go, their cuts heal. Breath and heart begin with phases [K, 2], default: those
        of the config."""
        self.solver.reset(environments, phases)
        self.tools.reset(environments)
        if self._cuts or self._blades or self.tearing:
            numbers = torch.arange(self.solver.environments)
            chosen = set(numbers[environments if isinstance(environments, slice) else environments.cpu()].tolist())
            for b in chosen if self.tearing else ():
                self.tearing[b].reset()
            self._blades = {key: blade for key, blade in self._blades.items() if key[0] not in chosen}
            healed = [b for b in chosen & self._cuts.keys() if len(self._cuts[b].triangles)]
            for b in healed:
                self._cuts[b].reset()
            if healed:
                with capturing:
                    self.solver.set_cuts(dict.fromkeys(healed))
