"""The material point solver: owns the grid and the state of the control nodes, and takes steps."""

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike

from endo_sim_ros.core.device import on_torch_stream, pick_device
from endo_sim_ros.physics.arrays import new_grid, new_loads, new_nodes, new_state, new_tools, set_stencils
from endo_sim_ros.physics.backends import backend_for
from endo_sim_ros.physics.backends.base import Launch, StepData, Work
from endo_sim_ros.physics.backends.end_kernels import end_step
from endo_sim_ros.physics.backends.structs import Substep
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes, held_sets
from endo_sim_ros.physics.grid import plan_grid
from endo_sim_ros.physics.materials import Stiffening, energy_density, lame_parameters
from endo_sim_ros.physics.motion import HeldMotion
from endo_sim_ros.physics.regions import TissueProperties
from endo_sim_ros.physics.stencils import CutTable, Stencils
from endo_sim_ros.physics.substeps import plan_substeps


class MpmSolver:
    """MLS-MPM over control nodes on one device, for one or many environments.

    The state lives in a local frame (world axes, origin at the grid's corner) as displacement from rest, so that a
    scene metres from the world's origin is as accurate as one at it and an undisturbed rest state is an exact fixed
    point. A step whose end is bad (see `end_step`) is undone in its environment. On a CPU, and on a GPU with rest
    kinematics, the same inputs give the same bits.

    Args:
        nodes: The control nodes at rest, the same in all environments.
        config: Material, substeps, grid and device.
        properties: Stiffness and density of each control node; default: those of the config everywhere.
        environments: Number of independent copies B.
        tools: Number of rigid tools T in each.
        capsules: Most capsules of a tool.
        stiffness: Factor on the moduli of each environment [B], or of each of its control nodes [B, M]; default 1. The
            largest one is also the largest that `set_stiffness` takes later.
        own_cuts: Whether each environment may be cut. Several that may take single launches on a GPU, a few times as long, so that
            what is whole does not depend on who is cut.

    Raises:
        StabilityError: If the substeps are too long for the material.
        ValueError: If the grid would be absurdly large, or nodes, properties and stiffness do not fit together.
    """

    def __init__(
        self,
        nodes: ControlNodes,
        config: PhysicsConfig,
        properties: TissueProperties | None = None,
        *,
        environments: int = 1,
        tools: int = 1,
        capsules: int = 1,
        stiffness: ArrayLike | None = None,
        own_cuts: bool = False,
    ):
        if environments < 1 or tools < 0:
            raise ValueError(f"there must be at least one environment and no fewer than zero tools, not {environments} and {tools}")
        if capsules < 1:
            raise ValueError(f"a tool must have room for at least one capsule, not {capsules}")
        if properties is None:
            properties = TissueProperties.uniform(len(nodes), config.young_modulus, config.poisson_ratio, config.density)
        if len(properties) != len(nodes):
            raise ValueError(f"there are properties of {len(properties)} nodes, but the tissue has {len(nodes)}")
        scale = np.ones(environments) if stiffness is None else np.asarray(stiffness, np.float64)
        good = scale.shape in ((environments,), (environments, len(nodes))) and np.isfinite(scale).all() and (scale > 0).all()
        if not good:
            raise ValueError(f"stiffness must be {environments} positive factors, got {np.round(scale, 4).tolist()}")
        self.config, self.device = config, pick_device(config.device)
        self.backend = backend_for(self.device)
        self.environments, self.tool_count, self.node_count = environments, tools, len(nodes)
        self.capsule_count = capsules
        self.largest_stiffness = float(scale.max())
        plan = plan_grid(nodes, config, environments)
        bad = np.flatnonzero(~((nodes.volumes > 0) & np.isfinite(nodes.volumes)))
        if len(bad):
            raise ValueError(f"the volume of node {bad[0]} is {nodes.volumes[bad[0]]:g} m³; every node must have some")
        self.cell_size, self.origin, self.grid_shape, self.rest_cells = plan.cell_size, plan.origin, plan.shape, plan.rest_cells
        self.substepping = plan_substeps(config, plan.cell_size, properties, self.largest_stiffness)

        device, count = self.device, environments * len(nodes)
        lame = [lame_parameters(*each) for each in zip(properties.young_modulus, properties.poisson_ratio)]
        self.mu, self.lam = np.array(lame).T  # [M] Pa each
        grasp = config.grasp_stiffness * (self.lam + 2 * self.mu) * nodes.volumes / plan.cell_size**2
        self._grasp = torch.from_numpy(grasp).to(device)  # [M] N/m, for a factor of one
        self._pinned = torch.from_numpy(nodes.pinned).to(device)
        # The held rim is where the recording ends, no wall: shafts that enter there meet nothing.
        self._touched = torch.from_numpy(~held_sets(nodes)[1]).to(device)
        self.grid = new_grid(plan)
        self.nodes = new_nodes(nodes, plan, properties, self.mu, self.lam, environments, device)
        self.loads = new_loads(count, device)
        self.pin_springs, self.scale = (wp.zeros(count, float, device=device) for _ in range(2))  # [B · M]; N/m, 1
        self.set_stiffness(slice(None), np.broadcast_to(scale.reshape(environments, -1), (environments, len(nodes))))
        given = new_tools(tools, tools * capsules, environments, len(nodes), config, device)
        self._given, self.rigid = given
        (self._saved, self.state), (self._backed_up, self._backup) = new_state(count, device), new_state(count, device)
        self.bad_nodes = wp.zeros(environments, int, device=device)  # in the last step; where there were any it was undone
        self._speed_sq = wp.zeros(environments, float, device=device)
        self._whole = Stencils(self.rest_cells, self.grid_shape)
        self.motion = HeldMotion(config.motion, config.step_duration, nodes, self._whole, self.cell_size, self.loads, environments)
        self._substep = Substep()
        self._substep.dt = self.substepping.dt
        self._substep.decay = math.exp(-config.damping * self.substepping.dt)
        self._substep.gravity = wp.vec3(*config.gravity)
        self._substep.ratio = config.relaxation
        self._substep.forget = -math.expm1(-self.substepping.dt / config.relaxation_time)
        self._stiffening = Stiffening(config.stiffening, config.stiffening_limit)
        self._substep.stiffening, self._substep.largest_exponent = config.stiffening, math.log(config.stiffening_limit)
        self._before: list[Launch] = []
        self._after: list[Launch] = []
        self._appended: list[Work] = []
        self._advance: Callable[[], object] | None = None
        self._own_cuts = own_cuts and environments > 1
        self._stencils = [self._whole] * environments
        self.set_cuts({})
        self.reset()

    def reset(self, environments: torch.Tensor | slice = slice(None), phases: np.ndarray | None = None) -> None:
        """Back to rest, no force, nothing held but the pinned control nodes, in these environments. Breath and heart begin with these
        phases [K, 2], default: those of the config, and all of the tissue is where they have it."""
        shape = (self.environments, self.node_count)

        def of(array: wp.array) -> torch.Tensor:
            values = wp.to_torch(array)
            return values.view(*shape, *values.shape[1:])

        loads, state = self.loads, self.state
        for array in (loads.force, loads.released, loads.target, loads.target_v, state.u, state.v, state.C, state.Q):
            of(array)[environments] = 0
        self.motion.reset(environments, phases)
        of(self.state.u)[environments] += self.motion.shifts(environments)
        of(self.state.F)[environments] = self.motion.gradients(environments)
        of(self.loads.holder)[environments] = -1
        of(self.loads.spring)[environments] = of(self.pin_springs)[environments]

    def set_stiffness(self, environments: torch.Tensor | slice, stiffness: np.ndarray, holds: np.ndarray | float = 1.0) -> None:
        """Other factors on the moduli [K, M] in these K environments; what pins or pushes their control nodes is as much stiffer.

        Args:
            environments: Which.
            stiffness: The factors.
            holds: Further factors on the springs that pin control nodes [K, M], zero or more: how firmly they are held.

        Raises:
            ValueError: If one is not above zero, or larger than any factor that the substeps were planned for.
        """
        stiffness = np.asarray(stiffness, np.float64)
        if stiffness.ndim != 2 or stiffness.shape[1] != self.node_count:
            raise ValueError(f"stiffness has shape {stiffness.shape}, expected [K, {self.node_count}], a factor for each node")
        if not ((stiffness > 0) & (stiffness <= self.largest_stiffness)).all():
            raise ValueError(f"stiffness factors must lie above 0 and not above {self.largest_stiffness:g}, the largest planned for")
        factors = torch.from_numpy(stiffness.copy()).to(self.device)
        grasp = factors * self._grasp
        pins = self.config.pin_stiffness / self.config.grasp_stiffness * grasp * self._pinned
        pins = pins * torch.as_tensor(holds, dtype=pins.dtype, device=pins.device)
        for array, values in ((self.scale, factors), (self.nodes.stiffness, grasp * self._touched), (self.pin_springs, pins)):
            wp.to_torch(array).view(self.environments, -1)[environments] = values.float()
        springs = wp.to_torch(self.loads.spring).view(self.environments, -1)
        springs[environments] = torch.where(self._pinned, pins.float(), springs[environments])

    def set_cuts(self, cuts: Mapping[int, CutTable | None]) -> None:
        """Let control nodes beside cuts transfer to grid nodes of their own side, in environments of these numbers; None makes the
        tissue whole again. Raises what `require_cuttable` does.
        """
        if any(cut is not None for cut in cuts.values()):
            self.require_cuttable()
        for environment, cut in cuts.items():
            self._stencils[environment] = self._whole if cut is None else Stencils(self.rest_cells, self.grid_shape, cut)
        set_stencils(self.nodes, self.grid, self._stencils, self.device)
        self._change_step()

    def set_released(self, environment: int, forces: np.ndarray) -> None:
        """Forces on the skin's control nodes that move, of all [M, 3], N, in an environment from now on, beside those of tools."""
        values = torch.from_numpy(np.asarray(forces, np.float32)).to(self.device)
        wp.to_torch(self.loads.released).view(self.environments, -1, 3)[environment] = values

    def release_far(self, far: float) -> None:
        """Take the forces of `set_released` away where a node is farther than so many metres from rest."""
        released = wp.to_torch(self.loads.released)
        released *= wp.to_torch(self.state.u).norm(dim=1, keepdim=True) <= far

    def require_cuttable(self) -> None:
        """Raise ValueError with current kinematics, whose control nodes change their grid nodes in every substep, and if there are several
        environments that shall have no cuts of their own."""
        if self.config.kinematics != "rest":
            raise ValueError(f"tissue with kinematics {self.config.kinematics} cannot be cut; set kinematics to rest")
        if self.environments > 1 and not self._own_cuts:
            raise ValueError(f"{self.environments} environments share what is whole; make them with own_cuts to cut one of them")

    def wrap_step(self, before: list[Launch], after: list[Launch]) -> None:
        """Make these launches of `Tools` part of every step, on a GPU of the one graph that it is; see `_build_step`."""
        self._before, self._after = before, after
        self._change_step()

    def append_launches(self, work: list[Work]) -> None:
        """Make this work the end of every step, in place of what was appended earlier."""
        self._appended = work
        self._change_step()

    def _change_step(self) -> None:
        """Make the step ready anew: now, where nobody waits, or where it takes seconds, when the tissue is first touched."""
        self._advance = self._build_step() if self.backend.prepares_early else None

    def prepare(self) -> Callable[[], object]:
        """Make ready now, and return, what the next step would otherwise begin with: on a GPU its capture, and at first its kernels."""
        if self._advance is None:
            self._advance = self._build_step()
        return self._advance

    def step(self) -> None:
        """Take one step in every environment."""
        advance = self.prepare()
        self.motion.begin_step()
        with on_torch_stream(self.device):
            advance()

    @property
    def speed(self) -> float:
        """Speed of the fastest control node at the end of the last step, m/s."""
        with on_torch_stream(self.device):
            return math.sqrt(max(float(self._speed_sq.numpy().max()), 0.0))

    def _build_step(self) -> Callable[[], object]:
        """The whole step as one call; loads and tools are read from their device arrays every time."""
        backend, config = self.backend, self.config
        data = StepData(
            self.environments, self.node_count, config.material, config.kinematics, self.substepping.count, self.nodes, self.state,
            self.loads, self.rigid, self.grid, self._substep, self.scale, self._stencils, self._own_cuts,
        )  # fmt: skip
        check = [backend.threads, self.node_count, config.travel, config.rollback_damping]
        check += [self._backup, self.state, self.bad_nodes, self._speed_sq, self.motion.follows, self.motion.held, self.motion.goal]
        end = Launch(end_step, (self.environments, backend.threads), check, backend.threads)
        return backend.record(
            [
                *(backend.action(launch) for launch in self._before),  # 1. of `Tools`: take hold or let go, load the control nodes
                lambda: wp.copy(self._backed_up, self._saved),  # 2. keep the state, which a bad step returns to
                self._given.zero_,  # 3. tools have given nothing yet
                *backend.substeps(data),  # 4. the material point method
                backend.action(end),  # 5. undo a bad step
                *(backend.action(launch) for launch in self._after),  # 6. of `Tools`: measure reactions
                *(backend.action(work) for work in self._appended),  # 7. such as skinning
            ]
        )

    def displacements(self, environment: int = 0) -> np.ndarray:
        """Displacements [M, 3], m, world axes. Those of pinned control nodes are how far their springs give way, beside what breath and
        heart move them by."""
        return self._of(self.state.u, environment)

    def deformation_gradients(self, environment: int = 0) -> np.ndarray:
        """F of all control nodes [M, 3, 3]."""
        return self._of(self.state.F, environment)

    def _of(self, array: wp.array, environment: int) -> np.ndarray:
        with on_torch_stream(self.device):
            return array.numpy()[environment * self.node_count : (environment + 1) * self.node_count].copy()

    def momentum(self, environment: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Linear momentum [3], kg·m/s, and angular momentum about the world's origin [3], kg·m²/s, of all control nodes.

        The angular momentum has the part that APIC carries in C: Σ m h²/4 ε : C, with rest kinematics ε : C Fᵀ."""
        mass = self.nodes.mass.numpy().astype(np.float64)[:, None]
        v, C, F = (self._of(array, environment).astype(np.float64) for array in (self.state.v, self.state.C, self.state.F))
        x = self.nodes.X.numpy().astype(np.float64) + self.displacements(environment) + self.origin
        if self.config.kinematics == "rest":
            C = C @ F.transpose(0, 2, 1)
        spin = np.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], 1)
        return (mass * v).sum(0), (mass * (np.cross(x, v) + self.cell_size**2 / 4 * spin)).sum(0)

    def energy(self, environment: int = 0) -> tuple[float, float]:
        """Kinetic energy (with the affine motion that APIC carries) and elastic energy, J."""
        mass, volume = self.nodes.mass.numpy().astype(np.float64), self.nodes.volume.numpy().astype(np.float64)
        v, C = (self._of(array, environment).astype(np.float64) for array in (self.state.v, self.state.C))
        kinetic = 0.5 * (mass * ((v**2).sum(1) + self.cell_size**2 / 4 * (C**2).sum((1, 2)))).sum()
        F = torch.from_numpy(self.deformation_gradients(environment)).double()
        mu, lam = (torch.from_numpy(self._of(self.scale, environment) * values) for values in (self.mu, self.lam))
        elastic = energy_density(self.config.material, F, mu, lam, self._stiffening).numpy()
        return float(kinetic), float((volume * elastic).sum())
