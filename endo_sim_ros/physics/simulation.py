"""The tissue that tools push, pull, grasp and cut: one scene by name and message, or many copies of it in tensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.physics.backends.base import capturing
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes, RenderDepth, build_control_nodes
from endo_sim_ros.physics.cutting.blade import Blade
from endo_sim_ros.physics.cutting.stencils import CutStencils
from endo_sim_ros.physics.regions import TissueProperties, paint_regions
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.physics.solver import MpmSolver
from endo_sim_ros.physics.tools import Tools

MAX_TOOLS = 8  # of a TissueSimulation
_RESTING_SPEED = 1e-5  # m/s; tissue slower than this, with no tool acting, is left as it is
_RELAXED = 8.0  # relaxation times after the last touch, too


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
    ):
        self.nodes, self.config = nodes, config
        properties = tissue_properties(nodes, config) if properties is None else properties
        with capturing:
            self.solver = MpmSolver(nodes, config, properties, environments=environments, tools=tools, stiffness=stiffness)
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
        """Positions of the nodes [B, M, 3], m, world; pinned ones where they rest."""
        return self._rest + self.displacements * self._free[:, None]

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
        work, means, covars = skinning.work(state.u, state.F, self.nodes.pinned, self.solver.environments)
        self.solver.append_launches(work)
        return means, covars

    def reset(self, environments: Tensor | slice = slice(None)) -> None:
        """Back to rest, in these copies; their tools let go."""
        self.solver.reset(environments)
        self.tools.reset(environments)


@dataclass(frozen=True)
class TissueState:
    """What the renderer needs to know, at one time; all float32, world frame."""

    rest: np.ndarray  # [M, 3] m
    positions: np.ndarray  # [M, 3] m
    F: np.ndarray  # deformation gradients [M, 3, 3]
    time: float  # s since the start or the last reset


class TissueSimulation:
    """Soft tissue behind a reconstructed skin, stepped in fixed steps of ``step_duration``.

    A tool takes hold of the tissue when its wrench becomes non-zero: the moving skin nodes then within
    ``force_radius`` of its tip (in their current positions) are its nodes until the wrench is zero again, so that
    grabbed tissue follows without jitter. The wrench acts at the point of the tissue that was at the tip then, and
    moves with it: about a tip that stays behind, a mere force would be an ever greater couple on the few nodes. A
    tool that reaches no node applies nothing and tries again every step. A jaw that closes holds the nodes in the
    same reach, which then follow the pose of its tip until it opens. With a ``contact_radius`` tools are rigid capsules
    that push tissue away.
    Tissue that nothing acts on and that has come to rest costs no time.

    Args:
        model: The reconstructed Gaussians, world.
        viewpoint: Camera position [3] or positions [V, 3], metres, world; the tissue extends away from it.
        config: Parameters.
        cameras: Those that the model was seen from; where they see through the extruded tissue it is left out.
        render_depth: Renders the model's depth in these cameras, see `build_control_nodes`.

    Raises:
        ValueError: If no tissue can be built from the model, or (:class:`StabilityError`) the substeps are too long.
    """

    def __init__(
        self,
        model: GaussianModel,
        viewpoint: np.ndarray,
        config: PhysicsConfig,
        cameras: Sequence[Camera] = (),
        render_depth: RenderDepth | None = None,
    ):
        self._start(build_control_nodes(model, viewpoint, config, cameras, render_depth), config)

    @classmethod
    def from_nodes(cls, nodes: ControlNodes, config: PhysicsConfig, properties: TissueProperties | None = None) -> "TissueSimulation":
        """Simulate given nodes, such as a test specimen."""
        simulation = cls.__new__(cls)
        simulation._start(nodes, config, properties)
        return simulation

    def _start(self, nodes: ControlNodes, config: PhysicsConfig, properties: TissueProperties | None = None) -> None:
        self.nodes = nodes
        self.config = config
        self._batch = TissueBatch(nodes, config, 1, MAX_TOOLS, properties)
        self.solver, self._tools = self._batch.solver, self._batch.tools
        self.substepping = self.solver.substepping
        self.step_duration = config.step_duration
        self.time = 0.0
        self.last_fault = ""
        self._slots: dict[str, int] = {}  # of tools, by name
        self._stencils: CutStencils | None = None  # from the first cut on
        self._blades: dict[str, Blade] = {}  # of tools that cut
        self.disturbed = False  # since the last step: a tool moved, took hold or let go
        self._quiet = 0.0  # s since tools did anything
        self.resting = not any(config.gravity)

    @property
    def faults(self) -> int:
        """Steps undone because a node ran away."""
        return int(self._tools.faults[0])

    @property
    def slips(self) -> int:
        """Times that tissue slipped out of a jaw because it was pulled farther than the travel allows."""
        return int(self._tools.slips[0].sum())

    @property
    def contact_radius(self) -> float:
        """Radius of the capsule that tools push with, m; 0 = none."""
        return self._tools.contact_radius

    def _slot(self, tool: str) -> int:
        if tool not in self._slots:
            if len(self._slots) == MAX_TOOLS:
                raise ValueError(f"tool {tool!r} is one too many; there can be {MAX_TOOLS}: {', '.join(self._slots)}")
            self._slots[tool] = len(self._slots)
        return self._slots[tool]

    def set_wrench(self, tool: str, tip: np.ndarray, force: np.ndarray, torque: ArrayLike = (0.0, 0.0, 0.0)) -> bool:
        """The wrench that a tool exerts on the tissue at its tip, until changed; zero lets go.

        Args:
            tool: Name of the tool.
            tip: Tip position [3], metres, world; what counts is where it is when the tool takes hold.
            force: Force [3], N, world.
            torque: Torque about the point held [3], N·m, world.

        Returns:
            Whether the wrench arrives: False when it is not zero but no moving skin node is in reach.

        Raises:
            ValueError: If an input has a wrong shape or is not finite; the tool then keeps its previous wrench.
        """
        tip, force, torque = (_vector(name, value, tool) for name, value in (("tip", tip), ("force", force), ("torque", torque)))
        wanted = bool(force.any() or torque.any())
        if not wanted and tool not in self._slots:
            return True
        slot, tools = self._slot(tool), self._tools
        for tensor, value in ((tools.grasp_points, tip), (tools.forces, force), (tools.torques, torque)):
            tensor[0, slot] = torch.from_numpy(value)
        was = bool(tools.attached[0, slot])
        if wanted != was:
            tools.take_hold()
            self.disturbed = True
        if not wanted:
            tools.reaction_forces[0, slot], tools.reaction_torques[0, slot] = 0.0, 0.0
        return not wanted or bool(tools.attached[0, slot])

    def set_grasp(self, tool: str, pose: np.ndarray, closed: bool) -> bool:
        """Move a tool, and close or open its jaw.

        Args:
            tool: Name of the tool.
            pose: Tip-to-world transform [4, 4], metres; held tissue, and the capsule of contact, reach it at the end
                of the next step.
            closed: Whether the jaw is closed.

        Returns:
            Whether the jaw holds what it should: False when it is closed on nothing.

        Raises:
            ValueError: If the pose has a wrong shape or is not finite; the tool then stays as it was.
        """
        pose = _pose(tool, pose)
        slot, tools = self._slot(tool), self._tools
        R, tip = torch.from_numpy(pose[:3, :3].copy()), torch.from_numpy(pose[:3, 3].copy())
        moved = not (torch.equal(tools.tips[0, slot].cpu(), tip) and torch.equal(tools.rotations[0, slot].cpu(), R))
        moved = moved or not tools.present[0, slot]
        tools.tips[0, slot], tools.rotations[0, slot], tools.present[0, slot] = tip, R, 1
        tools.closed[0, slot] = int(closed)
        was = bool(tools.gripping[0, slot])
        if closed != was:
            tools.take_hold()
        holding = bool(tools.gripping[0, slot])
        self.disturbed |= holding != was or moved and (holding or self.contact_radius > 0)
        if closed and not holding:
            tools.closed[0, slot] = 0
        return holding or not closed

    def set_cut(self, tool: str, pose: np.ndarray, cutting: bool) -> None:
        """Move the cutting edge of a tool; what it sweeps between two calls while cutting is cut.

        The edge is ``blade_length`` long, from the tip backwards against the tool's z axis. Nodes on both sides of the
        cut then share no momentum; ``cuts`` tells the skinning what not to bridge.

        Args:
            tool: Name of the tool.
            pose: Tip-to-world transform [4, 4], metres.
            cutting: Whether the edge cuts.

        Raises:
            ValueError: If the pose has a wrong shape or is not finite, or kinematics is not rest.
        """
        pose = _pose(tool, pose)
        if not cutting:
            self._blades.pop(tool, None)
            return
        stencils = self._prepared_stencils()
        self._blades.setdefault(tool, Blade(self.config.blade_length, self.nodes.spacing))
        state = self.state()
        triangles = self._blades[tool].move(pose, state.rest, state.positions, state.F, self.cuts)
        if stencils.cut(triangles):
            with capturing:
                self.solver.set_cut(stencils.table())
            self.disturbed = True

    def prepare(self) -> None:
        """Make the first step ready now; a tool would otherwise wait for it (on a GPU, for seconds when kernels are compiled)."""
        self.solver.prepare()

    def prepare_cutting(self) -> None:
        """Find the links between nodes now, which the first cut would otherwise wait for (a tenth of a second), and on a GPU load
        the kernels for tissue that cuts have divided too much for one launch (many seconds, when they are compiled).

        Raises:
            ValueError: If kinematics is not rest.
        """
        self._prepared_stencils()

    def _prepared_stencils(self) -> CutStencils:
        if self.config.kinematics != "rest":
            raise ValueError(f"tissue with kinematics {self.config.kinematics} cannot be cut; set kinematics to rest")
        if self._stencils is None:
            self._stencils = CutStencils(self.nodes.rest, self.solver.rest_cells, self.solver.grid_shape)
            with capturing:
                self.solver.load_for_cuts()
        return self._stencils

    @property
    def cuts(self) -> np.ndarray:
        """All that has been cut, as triangles in the tissue at rest [T, 3, 3], m, world."""
        return np.zeros((0, 3, 3)) if self._stencils is None else self._stencils.triangles

    def reaction(self, tool: str) -> tuple[np.ndarray, np.ndarray]:
        """Force [3] N and torque [3] N·m that the tissue exerts back on a tool, world: minus what its wrench applies
        (torque about the point held) and the mean over the last step of what its jaw and its capsule gave (about the tip);
        zero for a tool that is out of reach, has let go or is unknown. In a step that is undone it stays for a tool that holds
        tissue, so that it does not vanish where the tissue can follow no farther."""
        if tool not in self._slots:
            return np.zeros(3), np.zeros(3)
        slot, tools = self._slots[tool], self._tools
        return tools.reaction_forces[0, slot].cpu().numpy().copy(), tools.reaction_torques[0, slot].cpu().numpy().copy()

    def held(self, tool: str) -> np.ndarray:
        """Positions now of the nodes that a tool holds on to [K, 3], m, world; none when it is in the air."""
        nodes = self.held_nodes(tool)
        return self.nodes.rest[nodes] + self.solver.displacements()[nodes]

    def held_nodes(self, tool: str) -> np.ndarray:
        """Numbers of the nodes that a tool's wrench and jaw hold on to [K]."""
        if not self.in_reach(tool):
            return np.zeros(0, int)
        slot, tools = self._slots[tool], self._tools
        held = (tools.weights[0, slot] > 0) & bool(tools.attached[0, slot])
        held |= (tools.held[0, slot] > 0) & bool(tools.gripping[0, slot])
        return tools.touchable[held.cpu().numpy()]

    def in_reach(self, tool: str) -> bool:
        """Whether the tool holds on to tissue."""
        if tool not in self._slots:
            return False
        slot, tools = self._slots[tool], self._tools
        return bool(tools.attached[0, slot] or tools.gripping[0, slot])

    def step(self) -> None:
        """Advance by ``step_duration``. A step that ends badly is undone, counted in ``faults`` and described in
        ``last_fault``; the tissue is then at rest where it was before, or, after several in a row, nearer to its rest state."""
        before = self.faults
        self.time += self.step_duration
        if self.resting and not (self.disturbed or self._wrenches_act()):
            return
        self._quiet = 0.0 if self.disturbed or self._wrenches_act() else self._quiet + self.step_duration
        self._batch.step()
        self.disturbed = False
        relaxed = not self.config.relaxation or self._quiet > _RELAXED * self.config.relaxation_time
        undone = self.faults > before
        self.resting = relaxed and not undone and self.solver.speed < _RESTING_SPEED
        if undone:
            turned = float(self._tools.torques.norm()) > float(self._tools.forces.norm())  # with levers below a metre
            less = "torque" if turned else "force"
            self.last_fault = (
                f"a step was undone: {self.solver.bad_nodes.numpy()[0]} of {len(self.nodes)} nodes ended non-finite, torn or"
                f" over {self.config.travel:g} m from rest ({self._describe_tools()}); use less {less} or more travel"
            )

    def _wrenches_act(self) -> bool:
        return bool(self._tools.forces.any() or self._tools.torques.any())

    def reset(self) -> None:
        """Back to the rest state at time zero; tools let go, cuts heal."""
        self._batch.reset()
        self._slots.clear()
        self._blades.clear()
        if self._stencils is not None:
            self._stencils.reset()
            with capturing:
                self.solver.set_cut(None)
        self.disturbed, self._quiet = False, 0.0
        self.resting = not any(self.config.gravity)
        self.time, self.last_fault = 0.0, ""

    def continue_from(self, other: "TissueSimulation") -> bool:
        """Take over shape, motion, cuts and tools of other tissue; returns whether that can be: if it has the same nodes.

        For tissue whose material changes while it is being touched.
        """
        same = self.nodes.rest.shape == other.nodes.rest.shape and np.array_equal(self.nodes.rest, other.nodes.rest)
        same = same and np.array_equal(self.nodes.pinned, other.nodes.pinned) and self.solver.device == other.solver.device
        if not same or (len(other.cuts) and self.config.kinematics != "rest"):
            return False
        for name in ("u", "v", "C", "F", "Q"):
            wp.copy(getattr(self.solver.state, name), getattr(other.solver.state, name))
        self._tools.copy(other._tools)
        self._slots, self._blades, self.time = dict(other._slots), dict(other._blades), other.time
        self.last_fault = other.last_fault
        if len(other.cuts):
            if self.solver.grid_shape == other.solver.grid_shape and self.solver.cell_size == other.solver.cell_size:
                self._stencils = other._stencils
            stencils = self._prepared_stencils()
            if stencils is not other._stencils:
                stencils.cut(other.cuts)
            with capturing:
                self.solver.set_cut(stencils.table())
        self.disturbed = True
        return True

    def state(self) -> TissueState:
        """Positions and deformation gradients of all nodes now."""
        moving = ~self.nodes.pinned[:, None]
        positions = self.nodes.rest + self.solver.displacements() * moving
        F = np.where(moving[..., None], self.solver.deformation_gradients(), np.eye(3, dtype=np.float32))
        return TissueState(self.nodes.rest, positions, F, self.time)

    def _describe_tools(self) -> str:
        tools, parts = self._tools, []
        for name, slot in self._slots.items():
            force, torque = float(tools.forces[0, slot].norm()), float(tools.torques[0, slot].norm())
            acting = [f"{value:.3g} {unit}" for value, unit in ((force, "N"), (torque, "N·m")) if value]
            if acting:
                parts.append(f"{name} {' and '.join(acting)}")
            if tools.gripping[0, slot]:
                parts.append(f"{name} grasping")
            elif self.contact_radius and tools.present[0, slot]:
                parts.append(f"{name} pushing")
        return ", ".join(parts) or "no tool"


def _pose(tool: str, value: np.ndarray) -> np.ndarray:
    pose = np.asarray(value, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"pose of tool {tool!r} must be a finite 4×4 matrix, got {pose.tolist()}")
    R = pose[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise ValueError(f"pose of tool {tool!r} must turn and shift, not scale or mirror, got {pose.round(4).tolist()}")
    return pose


def _vector(name: str, value: ArrayLike, tool: str) -> np.ndarray:
    vector = np.array(value, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} of tool {tool!r} must be three finite numbers, got {vector.tolist()}")
    return vector
