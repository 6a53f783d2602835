"""The tissue that tools push, pull, grasp and cut, each by its name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.instruments.shapes import Capsule
from endo_sim_ros.physics.batch import TissueBatch
from endo_sim_ros.physics.config import MotionConfig, PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes, RenderDepth, build_control_nodes
from endo_sim_ros.physics.cutting.blade import Blade, Scissors
from endo_sim_ros.physics.links import ToolLinks, rigid_pose
from endo_sim_ros.physics.motion import MotionState
from endo_sim_ros.physics.regions import TissueProperties
from endo_sim_ros.physics.solver import MpmSolver

MAX_TOOLS = 8  # of a TissueSimulation
MAX_CAPSULES = 12  # of each; the instruments of the da Vinci have five or six
_RESTING_SPEED = 1e-5  # m/s; tissue slower than this, with no tool acting, is left as it is
MOST_WRENCH = 1e9  # N, N·m; more is beyond what float32 can square
_RELAXED = 8.0  # relaxation times after the last touch, too


def has_settled(solver: MpmSolver, quiet: float) -> bool:
    """Whether one tissue has come to rest, which nothing has touched for so many seconds: it is slow, and has relaxed."""
    config = solver.config
    return solver.speed < _RESTING_SPEED and (not config.relaxation or quiet > _RELAXED * config.relaxation_time)


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
    that push tissue away. A tool with an instrument is its links instead: they push, and its jaws hold what lies between them.
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
        self._batch = TissueBatch(nodes, config, 1, MAX_TOOLS, properties, capsules=MAX_CAPSULES, own_cuts=True)
        self.solver, self._tools = self._batch.solver, self._batch.tools
        self.substepping = self.solver.substepping
        self.step_duration = config.step_duration
        self.time = 0.0
        self.last_fault = ""
        self.faults = 0  # steps undone because a node ran away
        self._slots: dict[str, int] = {}  # of tools, by name
        # What tools were told, as to read or write one number of a GPU takes it longer than to compare them all here:
        self._poses: dict[str, np.ndarray] = {}  # of those that are present [4, 4]
        self._wrenches: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}  # tip, force and torque [3]
        self._closing: set[str] = set()  # whose jaw was closed; that of others is open and holds nothing
        self._shut: set[str] = set()  # whose two jaws were closed in the last step: they take hold of nothing until they open
        self._links: dict[str, ToolLinks] = {}  # of tools with an instrument
        self._placed: dict[str, Tensor] = {}  # poses of these [L, 4, 4], while known
        self._blades: dict[str, Blade] = {}  # of tools that cut
        self._scissors: dict[str, Scissors] = {}  # of tools whose jaws are blades
        self.disturbed = False  # since the last step: a tool moved, took hold or let go
        self._quiet = 0.0  # s since tools did anything
        self.resting = not any(config.gravity)

    @property
    def slips(self) -> int:
        """Times that tissue slipped out of a jaw because it was pulled farther than the travel allows."""
        return int(self._tools.slips[0].sum())

    @property
    def tears(self) -> int:
        """Places where the tissue tore."""
        return self._batch.tearing[0].count

    @property
    def last_tear(self) -> str:
        """A sentence about the newest tear; empty without any."""
        if (newest := self._batch.tearing[0].newest) is None:
            return ""
        at, strain, limit = newest
        where = f"where at rest is {np.round(at, 4).tolist()} m"
        return f"the tissue tore {where}: its true strain was {strain:.2f}, tear_strain is {limit:g}"

    def slips_by_tool(self) -> dict[str, int]:
        """The same of each tool, by its name."""
        counts = self._tools.slips[0].tolist()
        return {tool: counts[slot] for tool, slot in self._slots.items()}

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

        Of a wrench that takes tissue beyond its travel as much arrives as the tissue bears, which the steps after the first, which is
        undone, find within a few percent.

        Args:
            tool: Name of the tool.
            tip: Tip position [3], metres, world; what counts is where it is when the tool takes hold.
            force: Force [3], N, world.
            torque: Torque about the point held [3], N·m, world.

        Returns:
            Whether the wrench arrives: False when it is not zero but no moving skin node is in reach.

        Raises:
            ValueError: If an input has a wrong shape, is not finite, or is beyond any unit; the tool then keeps its previous wrench.
        """
        tip, force, torque = (_vector(name, value, tool) for name, value in (("tip", tip), ("force", force), ("torque", torque)))
        if max(np.abs(force).max(), np.abs(torque).max()) > MOST_WRENCH:
            raise ValueError(f"the wrench of tool {tool!r} is more than {MOST_WRENCH:g} N or N·m; is it in newtons?")
        wanted = bool(force.any() or torque.any())
        if not wanted and tool not in self._slots:
            return True
        slot, tools = self._slot(tool), self._tools
        told, self._wrenches[tool] = self._wrenches.get(tool), (tip, force, torque)
        for i, tensor in enumerate((tools.grasp_points, tools.forces, tools.torques)):
            value = self._wrenches[tool][i]
            if told is None or told[i].tobytes() != value.tobytes():
                tensor[0, slot] = torch.from_numpy(value)
        attached = bool(tools.attached[0, slot])
        if wanted != attached:
            tools.take_hold()
            self.disturbed = True
            attached = wanted and bool(tools.attached[0, slot])
        if not wanted:
            tools.reaction_forces[0, slot], tools.reaction_torques[0, slot] = 0.0, 0.0
        return not wanted or attached

    def set_instrument(self, tool: str, capsules: Sequence[Capsule]) -> None:
        """Let a tool have the links of an instrument, which touch tissue wherever `set_grasp` says that they are.

        Args:
            tool: Name of the tool.
            capsules: Of the links, such as those of `build_instrument`; none = a bare tip. Two links with the names ``jaw_left`` and
                ``jaw_right`` are jaws, between which tissue is held, or cut if they are blades.

        Raises:
            ValueError: If they are no instrument, see :class:`ToolLinks`, or too many, or they are scissors and kinematics is not rest;
                the tool then keeps what it had.
        """
        links = ToolLinks(capsules) if capsules else None
        if links is not None and links.scissors:
            self.solver.require_cuttable()
        if links is not None and len(links) > MAX_CAPSULES:
            raise ValueError(f"the instrument of tool {tool!r} has {len(links)} capsules; there can be {MAX_CAPSULES}")
        if tool in self._placed:
            self._lose_links(tool)
        self._links.pop(tool, None)
        self._scissors.pop(tool, None)
        if links is not None:
            self._links[tool] = links

    def has_instrument(self, tool: str) -> bool:
        """Whether a tool has links, see `set_instrument`."""
        return tool in self._links

    def set_grasp(self, tool: str, pose: np.ndarray, closed: bool, links: Mapping[str, ArrayLike] | None = None) -> bool:
        """Move a tool, and close or open its jaw.

        Args:
            tool: Name of the tool.
            pose: Tip-to-world transform [4, 4], metres; held tissue, and the capsule of contact, reach it at the end
                of the next step.
            closed: Whether the jaw is closed. A bare tip then holds what is near it, an instrument what lies between its jaws if they
                touch tissue. Jaws that hold nothing after a step, or that tissue slips out of, hold nothing until a step with them
                open. Scissors cut what lies between while they close.
            links: Link-to-world transforms [4, 4], metres, of a tool with an instrument by the names of its links (`link_poses`), at
                the end of the next step; None = nobody knows, and the tool is a bare tip meanwhile.

        Returns:
            Whether the jaw holds what it should: False when it is closed on nothing.

        Raises:
            ValueError: If the pose or that of a link has a wrong shape or is not finite, a link is missing, or the tool has no
                instrument; the tool then stays as it was.
        """
        pose = rigid_pose(f"tool {tool!r}", pose)
        if links is not None and tool not in self._links:
            raise ValueError(f"tool {tool!r} has no instrument, so it has no links; give it one with set_instrument")
        placed = None if links is None else self._links[tool].order(tool, links)
        slot, tools = self._slot(tool), self._tools
        told = self._poses.get(tool)
        moved = told is None or not np.array_equal(told, pose)
        if told is None or told.tobytes() != pose.tobytes():
            self._poses[tool] = pose = pose.copy()
            tools.tips[0, slot], tools.rotations[0, slot] = torch.from_numpy(pose[:3, 3].copy()), torch.from_numpy(pose[:3, :3].copy())
        if told is None:
            tools.present[0, slot] = 1
        touches = self.contact_radius > 0
        if placed is not None:
            before, self._placed[tool] = self._placed.get(tool, placed), placed
            moved = moved or before is placed or not torch.equal(before, placed)
            own = self._links[tool]
            # Open blades slip past tissue, closed ones are blunt; the edge of a tool that cuts would keep off what it is to cut.
            sharp = own.scissors and not closed or tool in self._blades
            tools.set_links(slot, own, placed[None], ~own.sharp if sharp else None)
            touches = moved and (self.disturbed or self._reaches(tool, before, placed))
            if own.scissors:
                jaws = own.place(placed).jaws.numpy()
                self._cut(self._scissors.setdefault(tool, Scissors(self.nodes.spacing)).move, jaws, closed)
                closed = False  # blades hold nothing
        elif tool in self._placed:
            self._lose_links(tool)
        jaws = placed is not None and self._links[tool].grasps or tool in self._shut
        self.disturbed |= jaws and closed != (tool in self._closing)  # a step notes that jaws are closed, or open
        was = holding = False
        if closed or tool in self._closing:
            tools.closed[0, slot] = int(closed)
            was = holding = bool(tools.gripping[0, slot])
            if closed != was and not (closed and tool in self._shut):
                tools.take_hold()
                holding = bool(tools.gripping[0, slot])
            self._closing.add(tool)
        self.disturbed |= holding != was or moved and (holding or touches)
        if not holding and tool in self._closing and not (closed and jaws):  # jaws stay shut until they open
            tools.closed[0, slot] = 0
            self._closing.discard(tool)
        return holding or not closed

    def is_closed(self, tool: str) -> bool:
        """Whether the jaw of a tool is closed now: two jaws are until they are told to open, a bare tip only while it holds tissue."""
        return tool in self._closing and (tool in self._shut or bool(self._tools.closed[0, self._slots[tool]]))

    def withdraw(self, tool: str) -> None:
        """Let a tool go and touch nothing any more, with its jaw, wrench, edge, capsule and links, until `set_grasp` moves it again.

        Args:
            tool: Name of the tool.
        """
        if tool not in self._slots:
            return
        slot, tools = self._slots[tool], self._tools
        if not (tool in self._poses or self.in_reach(tool)):
            return
        for known in (self._blades, self._scissors, self._poses, self._wrenches):
            known.pop(tool, None)
        self._closing.discard(tool)
        if tool in self._placed:
            self._lose_links(tool)
        for tensor in (tools.forces, tools.torques, tools.reaction_forces, tools.reaction_torques, tools.closed, tools.present):
            tensor[0, slot] = 0
        tools.take_hold()
        self.disturbed = True

    def _lose_links(self, tool: str) -> None:
        """Let a tool be a bare tip."""
        slot = self._slots[tool]
        self._tools.linked[0, slot] = self._tools.jawed[0, slot] = 0
        del self._placed[tool]

    def _reaches(self, tool: str, before: Tensor, after: Tensor) -> bool:
        """Whether the links of a tool may touch tissue on their way from poses to others [L, 4, 4]: instruments move a lot in the air."""
        links = self._links[tool]
        placed = links.place(torch.stack([before, after]))
        ends = torch.stack([placed.starts, placed.ends]).numpy()  # [2, 2, K, 3]
        radii = links.radii.numpy()[:, None]
        reach = 2 * np.maximum(radii, self._tools.thinnest) - radii + self.nodes.spacing  # as far as capsules are set back, too
        low, high = ends.min((0, 1)) - reach, ends.max((0, 1)) + reach
        positions = self.nodes.rest + self.solver.displacements()
        return bool(((low <= positions.max(0)) & (high >= positions.min(0))).all(1).any())

    def set_cut(self, tool: str, pose: np.ndarray, cutting: bool) -> None:
        """Move the cutting edge of a tool; what it sweeps between two calls while cutting is cut.

        The edge is ``blade_length`` long, from the tip backwards against the tool's z axis. That of an instrument is its wire, or the
        line between its jaws, where `set_grasp` has put its links. Nodes on both sides of the cut then share no momentum; ``cuts``
        tells the skinning what not to bridge.

        Args:
            tool: Name of the tool.
            pose: Tip-to-world transform [4, 4], metres.
            cutting: Whether the edge cuts.

        Raises:
            ValueError: If the pose has a wrong shape or is not finite, or kinematics is not rest.
        """
        pose = rigid_pose(f"tool {tool!r}", pose)
        if not cutting:
            self._blades.pop(tool, None)
            return
        self.solver.require_cuttable()
        own = self._links[tool] if tool in self._placed else None
        if own is None or not own.sharp.any():
            self._cut(self._blades.setdefault(tool, Blade(self.config.blade_length, self.nodes.spacing)).move, pose)
        else:
            corners = own.place(self._placed[tool]).edge(own.wire)
            length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
            self._cut(self._blades.setdefault(tool, Blade(length, self.nodes.spacing)).draw, corners)

    def _cut(self, move: Callable[..., np.ndarray], *to: object) -> None:
        """Cut what an edge sweeps on its way to where it now is, both as `Blade` and `Scissors` take them."""
        state = self.state()
        self._part(move(*to, state.rest, state.positions, state.F, self.cuts))

    def _part(self, triangles: np.ndarray) -> None:
        """Part the tissue along triangles [T, 3, 3], m, world, at rest."""
        self.disturbed |= bool(self._batch.cut({0: triangles}))

    def prepare(self) -> None:
        """Make the first step ready now; a tool would otherwise wait for it (on a GPU, for seconds when kernels are compiled)."""
        self.solver.prepare()

    def prepare_cutting(self) -> None:
        """Find the links between nodes now, which the first cut would otherwise wait for (a tenth of a second), and on a GPU load
        the kernels for tissue that cuts have divided too much for one launch (many seconds, when they are compiled).

        Raises:
            ValueError: If kinematics is not rest.
        """
        self._batch.prepare_cuts()

    @property
    def cuts(self) -> np.ndarray:
        """All that has been cut, and has torn, as triangles in the tissue at rest [T, 3, 3], m, world."""
        return self._batch.cuts()

    @property
    def torn(self) -> np.ndarray:
        """Which of these triangles tore [T], bool; tools cut the others."""
        torn = np.zeros(len(self.cuts), bool)
        torn[self._batch.tearing[0].triangles] = True
        return torn

    @property
    def parted_links(self) -> int:
        """How many links between neighbouring control nodes cuts and tears have parted; what is swept in the air parts none."""
        return self._batch.parted_links()

    def reaction(self, tool: str) -> tuple[np.ndarray, np.ndarray]:
        """Force [3] N and torque [3] N·m that the tissue exerts back on a tool, world: minus what its wrench applies
        (torque about the point held) and the mean over the last step of what its jaw and its capsule gave (about the tip);
        zero for a tool that is out of reach, has let go or is unknown. In a step that is undone it stays for a tool that holds
        or pushes tissue, so that it does not vanish where the tissue can follow no farther."""
        if tool not in self._slots:
            return np.zeros(3), np.zeros(3)
        slot, tools = self._slots[tool], self._tools
        return tools.reaction_forces[0, slot].cpu().numpy().copy(), tools.reaction_torques[0, slot].cpu().numpy().copy()

    def link_reactions(self, tool: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """The parts of `reaction` that the links of an instrument feel, by name: force [3] N, torque [3] N·m about the tip, world.

        They add up to what jaw and contact give. A control node counts for the link that it is nearest to at the end of the step.
        Empty where nobody knows the links.
        """
        if tool not in self._placed:
            return {}
        slot, tools = self._slots[tool], self._tools
        forces, torques = tools.link_forces[0, slot].cpu().numpy(), tools.link_torques[0, slot].cpu().numpy()
        return {link: (forces[i].copy(), torques[i].copy()) for i, link in enumerate(self._links[tool].links)}

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
        self.time += self.step_duration
        acts = self.disturbed or self._wrenches_act() or self.solver.motion.moving
        if self.resting and not acts:
            return
        self._quiet = 0.0 if acts else self._quiet + self.step_duration
        torn = self._batch.step()
        self._shut = {tool for tool in self._closing if tool in self._shut or tool in self._placed and self._links[tool].grasps}
        self.disturbed = bool(torn)
        before, self.faults = self.faults, int(self._tools.faults[0])
        undone = self.faults > before
        self.resting = not undone and has_settled(self.solver, self._quiet)
        if undone:
            turned = float(self._tools.torques.norm()) > self.config.force_radius * float(self._tools.forces.norm())  # its levers
            less = "torque" if turned else "force"
            limited = "; until then as much of the wrench acts as the tissue bears" if self._wrenches_act() else ""
            loose = "; what has torn off follows whatever pulls it" if self.tears else ""
            self.last_fault = (
                f"a step was undone: {self.solver.bad_nodes.numpy()[0]} of {len(self.nodes)} nodes ended non-finite, torn or"
                f" over {self.config.travel:g} m from rest ({self._describe_tools()}); use less {less} or more travel{limited}{loose}"
            )

    def _wrenches_act(self) -> bool:
        return any(force.any() or torque.any() for _, force, torque in self._wrenches.values())

    def reset(self) -> None:
        """Back to the rest state at time zero; tools let go, cuts heal. Breath and heart begin anew, with their whole amplitude."""
        self._batch.reset()
        for known in (self._slots, self._placed, self._blades, self._scissors, self._poses, self._wrenches, self._closing, self._shut):
            known.clear()
        self.faults = 0
        self.disturbed, self._quiet = False, 0.0
        self.resting = not any(self.config.gravity)
        self.time, self.last_fault = 0.0, ""

    def set_motion(self, motion: MotionConfig) -> None:
        """Let breath and heart move held tissue like this from now on, without a jump, see `HeldMotion.change`.

        Raises:
            ValueError: If that is more than the travel leaves room for, or of another file; nothing changes then.
        """
        config = replace(self.config, motion=motion)
        self.solver.motion.change(motion)
        self.config = config

    @property
    def motion(self) -> MotionState:
        """Breath and heart now."""
        return self.solver.motion.state

    def continue_from(self, other: "TissueSimulation") -> bool:
        """Take over shape, motion, cuts and tools of other tissue; returns whether that can be: if it has the same nodes, and the same
        file of its motion. Scissors are left behind where nothing can be cut.

        For tissue whose material changes while it is being touched.
        """
        same = self.nodes.rest.shape == other.nodes.rest.shape and np.array_equal(self.nodes.rest, other.nodes.rest)
        same = same and np.array_equal(self.nodes.pinned, other.nodes.pinned) and self.solver.device == other.solver.device
        same = same and self.config.motion.file == other.config.motion.file
        if not same or (len(other.cuts) and self.config.kinematics != "rest"):
            return False
        for name in ("u", "v", "C", "F", "Q"):
            wp.copy(getattr(self.solver.state, name), getattr(other.solver.state, name))
        self.solver.motion.copy(other.solver.motion)
        self._tools.copy(other._tools)
        self._slots, self._blades, self.time = dict(other._slots), dict(other._blades), other.time
        self._poses, self._wrenches = dict(other._poses), dict(other._wrenches)
        self._closing, self._shut = set(other._closing), set(other._shut)
        self.faults = other.faults
        self._links, self._placed, self._scissors = dict(other._links), dict(other._placed), dict(other._scissors)
        for tool in [tool for tool, links in self._links.items() if links.scissors and self.config.kinematics != "rest"]:
            self.set_instrument(tool, ())
        self.last_fault = other.last_fault
        self._batch.take_cuts(other._batch)
        self.disturbed = True
        return True

    def state(self) -> TissueState:
        """Positions and deformation gradients of all nodes now."""
        return TissueState(self.nodes.rest, *self._batch.state(), self.time)

    def _describe_tools(self) -> str:
        tools, parts = self._tools, []
        for name, slot in self._slots.items():
            force, torque = float(tools.forces[0, slot].norm()), float(tools.torques[0, slot].norm())
            acting = [f"{value:.3g} {unit}" for value, unit in ((force, "N"), (torque, "N·m")) if value]
            if acting:
                parts.append(f"{name} {' and '.join(acting)}")
            if tools.gripping[0, slot]:
                parts.append(f"{name} grasping")
            elif (self.contact_radius or name in self._placed) and tools.present[0, slot]:
                parts.append(f"{name} pushing")
        return ", ".join(parts) or "no tool"


def _vector(name: str, value: ArrayLike, tool: str) -> np.ndarray:
    vector = np.array(value, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} of tool {tool!r} must be three finite numbers, got {vector.tolist()}")
    return vector
