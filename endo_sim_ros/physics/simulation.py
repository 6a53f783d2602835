"""The tissue that tools push and pull: control nodes, the solver, wrenches and faults."""

from dataclasses import dataclass, field

import numpy as np

from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes, build_control_nodes
from endo_sim_ros.physics.mpm import MpmSolver, capturing
from endo_sim_ros.physics.wrench import fall_off, minimum_norm_forces


@dataclass(frozen=True)
class NodeState:
    """What the renderer needs to know, at one time; all float32, world frame."""

    rest: np.ndarray  # [M, 3] m
    positions: np.ndarray  # [M, 3] m
    F: np.ndarray  # deformation gradients [M, 3, 3]
    time: float  # s since the start or the last reset


@dataclass
class _Tool:
    tip: np.ndarray  # [3] m, world
    force: np.ndarray  # [3] N
    torque: np.ndarray  # [3] N·m
    nodes: np.ndarray = field(default_factory=lambda: np.empty(0, int))  # attached, indices
    weights: np.ndarray = field(default_factory=lambda: np.empty(0))
    contact: np.ndarray = field(default_factory=lambda: np.zeros(3))  # tip relative to the nodes' centroid, kept, m
    applied: tuple[np.ndarray, np.ndarray] = (np.zeros(3), np.zeros(3))  # force N and torque N·m that arrived


@dataclass
class _Grip:
    """Tissue between the jaws of a tool."""

    pose: np.ndarray  # tip-to-world [4, 4], m
    nodes: np.ndarray  # held, indices
    local: np.ndarray  # their positions in the axes of the tip when the jaw closed [K, 3], m
    displacements: np.ndarray  # that they were last pulled to [K, 3], m
    applied: tuple[np.ndarray, np.ndarray] = (np.zeros(3), np.zeros(3))  # what the jaw exerts: N and N·m about the tip

    def targets(self, rest: np.ndarray) -> np.ndarray:
        """Displacements [K, 3] m that put the nodes where the jaw is now."""
        return self.local @ self.pose[:3, :3].T + self.pose[:3, 3] - rest[self.nodes]


_RESTING_SPEED = 1e-5  # m/s; tissue slower than this, with no tool acting, is left as it is
_SLIP = 0.9  # of the travel; tissue pulled farther slips out of the jaw


class TissueSimulation:
    """Soft tissue behind a reconstructed skin, stepped in fixed steps of ``step_duration``.

    A tool takes hold of the tissue when its wrench becomes non-zero: the moving skin nodes then within
    ``force_radius`` of its tip (in their current positions) are its nodes until the wrench is zero again, so that
    grabbed tissue follows without jitter. The wrench acts at the point of the tissue that was at the tip then, and
    moves with it: about a tip that stays behind, a mere force would be an ever greater couple on the few nodes. A
    tool that reaches no node applies nothing and tries again every step. A jaw that closes holds the nodes in the
    same reach, which then follow the pose of its tip until it opens.
    Tissue that nothing acts on and that has come to rest costs no time.

    Args:
        model: The reconstructed Gaussians, world.
        viewpoint: Camera position [3] or positions [V, 3], metres, world; the tissue extends away from it.
        config: Parameters.

    Raises:
        ValueError: If no tissue can be built from the model, or (:class:`StabilityError`) the substeps are too long.
    """

    def __init__(self, model: GaussianModel, viewpoint: np.ndarray, config: PhysicsConfig):
        self._start(build_control_nodes(model, viewpoint, config), config)

    @classmethod
    def from_nodes(cls, nodes: ControlNodes, config: PhysicsConfig) -> "TissueSimulation":
        """Simulate given nodes, such as a test specimen."""
        simulation = cls.__new__(cls)
        simulation._start(nodes, config)
        return simulation

    def _start(self, nodes: ControlNodes, config: PhysicsConfig) -> None:
        self.nodes = nodes
        self.config = config
        with capturing:
            self.solver = MpmSolver(nodes, config)
        self.substepping = self.solver.substepping
        self.step_duration = config.step_duration
        self.time = 0.0
        self.faults = 0  # steps undone because a node ran away
        self.last_fault = ""
        self.slips = 0  # times that tissue slipped out of a jaw because it was pulled farther than the travel allows
        self._tools: dict[str, _Tool] = {}
        self._touchable = np.flatnonzero(nodes.is_skin & ~nodes.pinned)
        self._grips: dict[str, _Grip] = {}
        self._loaded = False
        self._resting = not any(config.gravity)

    def set_wrench(
        self, tool: str, tip: np.ndarray, force: np.ndarray, torque: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0)
    ) -> bool:
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
        tip, force, torque = (
            _vector(name, value, tool) for name, value in (("tip", tip), ("force", force), ("torque", torque))
        )
        if not (force.any() or torque.any()):
            self._tools.pop(tool, None)
            return True
        held = self._tools.setdefault(tool, _Tool(tip, force, torque))
        held.tip, held.force, held.torque = tip, force, torque
        positions = self._positions()
        self._attach(held, positions)
        self._distribute(held, positions)
        return len(held.nodes) > 0

    def set_grasp(self, tool: str, pose: np.ndarray, closed: bool) -> bool:
        """Close, move or open the jaw of a tool.

        Args:
            tool: Name of the tool.
            pose: Tip-to-world transform [4, 4], metres; held tissue follows it, reaching it at the end of the next step.
            closed: Whether the jaw is closed.

        Returns:
            Whether the jaw holds what it should: False when it is closed on nothing.

        Raises:
            ValueError: If the pose has a wrong shape or is not finite; the jaw then stays as it was.
        """
        pose = np.asarray(pose, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"pose of tool {tool!r} must be a finite 4×4 matrix, got {pose.tolist()}")
        if not closed:
            self._grips.pop(tool, None)
            return True
        if tool not in self._grips:
            positions = self._positions()
            nodes, _ = self._within_reach(pose[:3, 3], positions)
            if not len(nodes):
                return False
            local = (positions[nodes] - pose[:3, 3]) @ pose[:3, :3]
            self._grips[tool] = _Grip(pose, nodes, local, positions[nodes] - self.nodes.rest[nodes])
        self._grips[tool].pose = pose
        return True

    def reaction(self, tool: str) -> tuple[np.ndarray, np.ndarray]:
        """Force [3] N and torque [3] N·m that the tissue exerts back on a tool, world: minus what its wrench applies
        (torque about the point held) and its jaw (about the tip); zero for a tool that is out of reach, has let go or is unknown."""
        force, torque = np.zeros(3), np.zeros(3)
        for acting in (self._tools.get(tool), self._grips.get(tool)):
            if acting is not None:
                force, torque = force - acting.applied[0], torque - acting.applied[1]
        return force, torque

    def held(self, tool: str) -> np.ndarray:
        """Positions now of the nodes that a tool holds on to [K, 3], m, world; none when it is in the air."""
        acting = (self._tools.get(tool), self._grips.get(tool))
        nodes = np.concatenate([np.zeros(0, int)] + [each.nodes for each in acting if each is not None])
        return self.nodes.rest[nodes] + self.solver.displacements()[nodes]

    def in_reach(self, tool: str) -> bool:
        """Whether the tool holds on to tissue."""
        return tool in self._grips or tool in self._tools and len(self._tools[tool].nodes) > 0

    def step(self) -> None:
        """Advance by ``step_duration``. A step that ends badly is undone, counted in ``faults`` and described in
        ``last_fault``; the tissue is then at rest where it was before."""
        if self._resting and not (self._tools or self._grips or self._loaded):
            self.time += self.step_duration
            return
        if self._tools or self._grips or self._loaded:
            self._load()
        bad = self.solver.step()
        self.time += self.step_duration
        self._resting = self.solver.speed < _RESTING_SPEED
        if bad:
            self.solver.restore()
            self.faults += 1
            self.last_fault = (
                f"a step was undone: {bad} of {len(self.nodes)} nodes ended non-finite, torn or"
                f" over {self.config.travel:g} m from rest ({self._describe_tools()}); use less force or more travel"
            )
            for grip in self._grips.values():  # pull on from where the tissue is
                grip.displacements = self.solver.displacements()[grip.nodes].astype(np.float64)
        for grip in self._grips.values():
            forces = self.solver.holding_forces(grip.nodes, grip.displacements)
            offsets = self.nodes.rest[grip.nodes] + grip.displacements - grip.pose[:3, 3]
            grip.applied = (forces.sum(0), np.cross(offsets, forces).sum(0))

    def _load(self) -> None:
        """Hand the wrenches and jaws of the tools to the solver, for the next step."""
        positions = self._positions()
        forces = np.zeros_like(positions)
        for held in self._tools.values():
            self._attach(held, positions)
            np.add.at(forces, held.nodes, self._distribute(held, positions))
        self.solver.set_forces(forces)
        for tool, grip in list(self._grips.items()):
            if np.linalg.norm(grip.targets(self.nodes.rest), axis=1).max() > _SLIP * self.config.travel:
                del self._grips[tool]
                self.slips += 1
        grips = list(self._grips.values())
        starts = [np.zeros((0, 3))] + [grip.displacements for grip in grips]
        for grip in grips:
            grip.displacements = grip.targets(self.nodes.rest)
        ends = [np.zeros((0, 3))] + [grip.displacements for grip in grips]
        nodes = np.concatenate([np.zeros(0, int)] + [grip.nodes for grip in grips])
        self.solver.hold(nodes, np.concatenate(starts), np.concatenate(ends))
        self._loaded = bool(self._tools or grips)

    def reset(self) -> None:
        """Back to the rest state at time zero; tools let go."""
        self.solver.reset()
        self._tools.clear()
        self._grips.clear()
        self._loaded = False
        self._resting = not any(self.config.gravity)
        self.time = 0.0

    def state(self) -> NodeState:
        """Positions and deformation gradients of all nodes now."""
        moving = ~self.nodes.pinned[:, None]
        positions = self.nodes.rest + self.solver.displacements() * moving
        F = np.where(moving[..., None], self.solver.deformation_gradients(), np.eye(3, dtype=np.float32))
        return NodeState(self.nodes.rest, positions, F, self.time)

    def _positions(self) -> np.ndarray:
        return self.nodes.rest.astype(np.float64) + self.solver.displacements()

    def _attach(self, held: _Tool, positions: np.ndarray) -> None:
        if len(held.nodes) == 0:
            held.nodes, distances = self._within_reach(held.tip, positions)
            held.weights = fall_off(distances, self.config.force_radius)
            if len(held.nodes):
                held.contact = held.tip - np.average(positions[held.nodes], 0, held.weights)

    def _within_reach(self, tip: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Moving skin nodes within ``force_radius`` of a tip, and their distances, m."""
        distances = np.linalg.norm(positions[self._touchable] - tip, axis=1)
        near = distances <= self.config.force_radius
        return self._touchable[near], distances[near]

    def _distribute(self, held: _Tool, positions: np.ndarray) -> np.ndarray:
        """Forces on the tool's nodes [K, 3]; remembers what they add up to."""
        if len(held.nodes) == 0:
            held.applied = (np.zeros(3), np.zeros(3))
            return np.zeros((0, 3))
        nodes = positions[held.nodes]
        offsets = nodes - np.average(nodes, 0, held.weights) - held.contact
        forces = minimum_norm_forces(offsets, held.weights, held.force, held.torque)
        held.applied = (forces.sum(0), np.cross(offsets, forces).sum(0))
        return forces

    def _describe_tools(self) -> str:
        parts = [f"{name} {np.linalg.norm(held.force):.3g} N" for name, held in self._tools.items()]
        parts += [f"{name} grasping" for name in self._grips]
        return ", ".join(parts) or "no tool"


def _vector(name: str, value: np.ndarray, tool: str) -> np.ndarray:
    vector = np.asarray(value, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} of tool {tool!r} must be three finite numbers, got {vector.tolist()}")
    return vector
