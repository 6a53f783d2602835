"""B episodes of a task in the simulation: one batched solver, one renderer, no framework; what environments and training share."""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.device import single_threaded_torch
from endo_sim_ros.learning.actions import Actions, Contact, action_size, arm_state, observed_names, require_contact, tip_poses
from endo_sim_ros.learning.config import Randomisation, SightConfig
from endo_sim_ros.learning.held_tools import HeldTool, HeldTools, hold_tools, require_tool
from endo_sim_ros.learning.pictures import IMAGE, SEGMENTATION, Pictures
from endo_sim_ros.learning.scenes import Scene, load_scenes
from endo_sim_ros.learning.tasks import Outcome, find_task, moving, set_up
from endo_sim_ros.learning.variation import Variation
from endo_sim_ros.physics import MotionConfig, TissueBatch, ToolLinks
from endo_sim_ros.physics.simulation import has_settled

Observations = Literal["state", "image", "both", "sensors"]
Observed = np.ndarray | dict[str, np.ndarray]
"""Observations: state or image, or what there is in a dict."""

ARM_STATE = "arm"
"""Name of what the arm measures of itself."""


_logger = logging.getLogger(__name__)
_Made = TypeVar("_Made")


def usable(scenes: Sequence[str | Path], make: Callable[[Scene], _Made]) -> tuple[list[str | Path], list[_Made]]:
    """Those scenes that a task can take place in, and what is made of each; of the others it is said why not.

    Args:
        scenes: Each once, as `load_scene` takes it.
        make: Makes a `TaskBatch` in a scene, or several; where that raises ValueError, the scene is left out.

    Raises:
        ModelError: If a model cannot be read.
        ValueError: If there is no scene, one is given twice, or none is left.
    """
    names, made, refused = [], [], {}
    for scene, loaded in zip(scenes, load_scenes(scenes)):
        try:
            made.append(make(loaded))
            names.append(scene)
        except ValueError as error:
            refused[scene] = str(error)
    if not names:
        reasons = {text: scene for scene, text in refused.items()}  # each once
        raise ValueError("; ".join(f"{scene}: {text}" for text, scene in reasons.items()))
    for scene, text in refused.items():
        _logger.warning("%s is left out: %s", scene, text)
    return names, made


class TaskBatch:
    """B episodes of one task.

    On a CPU the same seeds and actions give the same observations, images too, bit by bit, whatever the number of threads and B.

    Args:
        task: Its name.
        scene: What is touched.
        count: B.
        observations: ``state``: float32 [B, n]; ``image``: uint8 [B, H, W, 3]; ``both``: a dict of the two by these names;
            ``sensors``: a dict of ``image`` and ``arm``, what a robot has, see `arm_state`. Where there are more pictures, a dict
            of all, see `Pictures.draw`.
        randomisation: How episodes differ.
        sight: What the endoscope shows.
        device: Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N.
        images: Make `images` possible also where images are not observed.
        actions: ``cartesian``: four numbers, or five, see `Task`. ``joints``: how far the six joints of the tool's arm move, in units of
            `HeldTools.steps`, and the fourth number of the task. ``joint_positions``: where they are, -1 and 1 being their limits,
            and the same. With joints the state ends with their positions as parts of their ranges. A tip that would leave where
            the task allows it comes as near as its joints get. Several arms have as many such actions, one after the other.
        contact: What touches the tissue: ``point``, the tip that the task describes, or ``links``, the links of the instrument, whose
            jaws hold what lies between them, as in physics_node.
        motion: Breath and heart; at rest, those of the task. Each episode begins in phases of its own, not in those of the motion.

    Raises:
        ValueError: If there is no such task or tool, the scene is too small for it, an arm does not reach it, links shall touch
            where each episode has another tool or tools cut, actions are of the tool's joints where they move the endoscope, or tissue
            cannot move so far.
    """

    def __init__(
        self,
        task: str,
        scene: Scene,
        count: int = 1,
        observations: Observations = "state",
        randomisation: Randomisation = Randomisation(),
        sight: SightConfig = SightConfig(),
        device: str = "auto",
        images: bool = False,
        actions: Actions = "cartesian",
        contact: Contact = "point",
        motion: MotionConfig = MotionConfig(),
    ):
        kind = find_task(task)
        if kind.turns and actions != "cartesian":
            raise ValueError(f"{task} acts by the joints of the endoscope, not by those of the tool; leave actions at cartesian")
        config = moving(kind.physics(device), motion)
        nodes = scene.nodes(config)
        self.task, self.count = set_up(kind, nodes, scene.camera.pose, count), count
        self.observations, self.randomisation = observations, randomisation
        largest = kind.largest_stiffness * float(np.exp(randomisation.stiffness))
        stiffness = np.full(count, largest) if largest != 1 else None
        held: list[HeldTool] = []
        shown = images or observations != "state" or sight.segmentation
        if shown and sight.instrument or actions != "cartesian" or contact == "links":
            held = hold_tools(kind, scene, sight.tool, others=randomisation.tool > 0)
        elif sight.tool:
            require_tool(kind, sight.tool)  # what is wrong with it is told where nothing shows it, too
        if contact == "links" and randomisation.tool:
            raise ValueError("contact is links, which all episodes share, but randomisation gives each its tool; set its tool to 0")
        require_contact(task, contact)
        arms = len(kind.arms)
        self._links = [ToolLinks(tool.shape[1]) for tool in held] if contact == "links" else []
        self._linked = [torch.zeros(0)] * arms  # poses of the links, of a single tissue
        capsules = max(map(len, self._links), default=1)
        parts = kind.cutting or config.tear_strain > 0
        self.tissue = TissueBatch(nodes, config, count, arms, stiffness=stiffness, capsules=capsules, own_cuts=parts)
        self._varies = largest != 1
        self._moves = config.motion.breathing + config.motion.heartbeat > 0
        self._works = not kind.turns or self._moves or bool(self._links)  # else nothing touches the tissue
        self._rest = torch.from_numpy(nodes.rest)
        self._resting, self._placed, self._torn, self._quiet = True, False, False, 0.0  # of a single tissue
        self._observed = False  # since it moved last: tasks follow the tissue where they observe it
        self.sight = sight
        self.tools = HeldTools(held, kind, count) if held else None
        self.pictures: Pictures | None = None
        self.actions: Actions = actions
        self.action_size = action_size(kind, actions) * arms
        self.varied: dict[str, np.ndarray] = {}
        """What each episode has of each kind of randomisation that there is [B, …], by the names of the options."""
        if shown:
            self.pictures = Pictures(scene, self.tissue, self.task, sight, randomisation, self.tools if sight.instrument else None)

    @single_threaded_torch()
    def reset(self, episodes: Sequence[int], generators: Sequence[np.random.Generator]) -> None:
        """Begin these episodes anew, each by the chance of its generator."""
        variations, self._observed = [], False
        for b, rng in zip(episodes, generators):
            self.task.reset(b, rng)
            variation = Variation.draw(self.randomisation, rng)
            if self._varies:
                self.tissue.solver.set_stiffness(slice(b, b + 1), variation.stiffness * self.task.stiffness(b)[None])
            if self.tools is not None:
                self.tools.vary(b, variation)
            self._note(b, variation)
            variations.append(variation)
        chosen = torch.as_tensor(list(episodes), dtype=torch.long, device=self.tissue.solver.device)
        self.tissue.reset(chosen, np.array([variation.phases for variation in variations]) if self._moves else None)
        self._resting, self._placed, self._torn, self._quiet = True, False, False, 0.0
        own = self.task.hands(episodes).ravel()
        if self.tools is not None:
            self.tools.begin(own, self._poses()[own])
        if self.pictures is not None:
            self.pictures.reset(chosen, variations, [self.task.dyed_spots(b) for b in episodes])
            self._look()

    def _look(self) -> None:
        """Let the endoscopes be where the task has them."""
        poses = self.task.endoscopes()
        if poses is not None and self.pictures is not None:
            self.pictures.look_from(poses)

    def _note(self, b: int, variation: Variation) -> None:
        """Keep what an episode has."""
        values: dict[str, Any] = dict(variation.values()) | ({"phases": variation.phases} if self._moves else {})
        if self.randomisation.tool and self.tools is not None:
            values["tool"] = str(self.tools.names()[b, 0])
        for name, value in values.items():
            if name not in self.varied:
                kind = object if isinstance(value, str) else np.float64
                self.varied[name] = np.zeros((self.count, *np.shape(value)), kind)
            self.varied[name][b] = value

    def _poses(self) -> np.ndarray:
        """Poses of the tips [B A, 4, 4], world."""
        return tip_poses(self.task, self.task.tips())

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the numbers of the state."""
        return observed_names(self.task, self.actions)

    @single_threaded_torch()
    def step(
        self, actions: np.ndarray, renew: Sequence[int] = (), generators: Sequence[np.random.Generator] = ()
    ) -> tuple[Observed, Outcome]:
        """Take one step with actions [B, 4, 5 or 7 A]. Episodes in ``renew`` take none: each begins anew, by the chance of its generator.

        Returns:
            What `observe` gives at the end of the step, and its outcome.
        """
        self._advance(actions, renew, generators)
        observations = self.observe()
        return observations, self.task.judge()

    def _advance(self, actions: np.ndarray, renew: Sequence[int], generators: Sequence[np.random.Generator]) -> None:
        tips, closed = self.task.act(actions) if self.actions == "cartesian" else self._act_by_joints(actions)
        self._look()
        if len(renew):
            self.reset(renew, generators)
        tools, closed = self.tissue.tools, closed.reshape(self.count, -1)
        tips = torch.from_numpy(tips).to(tools.tips.device).view_as(tools.tips)
        turned = torch.from_numpy(self.task.rotations).to(tools.tips.device).view_as(tools.rotations)
        # Of one alone: a comparison waits for a GPU.
        moved = self._moved(tips, turned) if self.count == 1 else []
        present = torch.ones(closed.shape, dtype=torch.int32)
        present[list(renew)] = 0
        tools.tips.copy_(tips)
        tools.rotations.copy_(turned)
        tools.present.copy_(present)
        tools.closed.copy_(torch.from_numpy(closed.astype(np.int32)) * present)
        self._placed = True
        going = self.task.hands(np.setdiff1d(np.arange(self.count), renew)).ravel()
        if self.tools is not None and self._links:
            if self.actions == "cartesian":
                self.tools.move(going, self._poses()[going], closed.ravel()[going])
            for number, (links, posed) in enumerate(zip(self._links, self.tools.posed(0, np.arange(self.count)))):
                linked = torch.from_numpy(np.stack([posed[link] for link in links.links], 1))
                if moved:
                    moved[number] |= not torch.equal(linked, self._linked[number])
                self._linked[number] = linked
                tools.set_links(number, links, linked)
        parted = self._torn
        if self.task.cutting:
            cutting = self.task.cuts(self.task.fourth).reshape(closed.shape) & present.numpy().astype(bool)
            parted |= bool(self.tissue.move_edges(self._poses().reshape(*closed.shape, 4, 4), cutting))
        step = self._works and (self.count > 1 or not self._rests(moved, parted))
        faults = int(self.tissue.tools.faults[0]) if self.count == 1 else 0
        if step:
            self._torn = bool(self.tissue.step())
        if self.tools is not None and not self._links and self.actions == "cartesian":  # while a GPU takes the step
            self.tools.move(going, self._poses()[going], closed.ravel()[going])
        if step:
            whole = self.count == 1 and int(self.tissue.tools.faults[0]) == faults
            self._resting = whole and has_settled(self.tissue.solver, self._quiet)

    def _act_by_joints(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What `Task.act` returns, for actions [B, 7 A] of joints."""
        assert self.tools is not None
        poses, closed = self.tools.act(self.task, actions, self.actions == "joints")
        return poses[:, :3, 3].copy(), closed

    def _moved(self, tips: Tensor, turned: Tensor) -> list[bool]:
        """Of a single tissue: which of its arms [A] come to other places [1, A, 3] and axes [1, A, 3, 3] than before."""
        tools = self.tissue.tools
        same = lambda new, old, a: torch.equal(new[:, a], old[:, a])
        return [not (self._placed and same(tips, tools.tips, a) and same(turned, tools.rotations, a)) for a in range(len(self.task.arms))]

    def _rests(self, moved: list[bool], parted: bool) -> bool:
        """Whether a single tissue is left as it is, as TissueSimulation does, so that the graph gives the same bits."""
        tools = self.tissue.tools
        before = tools.gripping[0].tolist()
        tools.take_hold()
        holding, touching = tools.gripping[0].tolist(), tools.contact_radius > 0 or bool(self._links)
        disturbed = any(moves and (holds or touching) for moves, holds in zip(moved, holding))
        acts = parted or disturbed or holding != before or self._moves
        if self._resting and not acts:
            return True
        self._quiet = 0.0 if acts else self._quiet + self.tissue.step_duration
        return False

    def observe(self) -> Observed:
        """Observations of all episodes now."""
        state = self.state()  # which is judged, too
        found = {"state": state} if self.observations in ("state", "both") else {}
        if self.observations == "sensors":
            found[ARM_STATE] = self.arm_state()
        seen = self.observations != "state"
        if self.pictures is not None and (seen or self.sight.segmentation):
            drawn = self.pictures.draw(right=seen and self.sight.eyes == 2, labels=self.sight.segmentation)
            found |= {name: picture for name, picture in drawn.items() if seen or name == SEGMENTATION}
        return found if len(found) > 1 else next(iter(found.values()))

    def state(self) -> np.ndarray:
        """What a policy sees of each environment, numbers alone [B, D]."""
        sites, device = torch.from_numpy(self.task.sites), self.tissue.solver.device
        rows = torch.arange(self.count)[:, None]
        moved = self.tissue.displacements[rows.to(device), sites.to(device)].cpu()
        positions = (self._rest[sites] + moved).numpy()
        for b in range(self.count if self.task.cutting else 0):
            self.task.hear_cuts(b, self.tissue.cuts(b).astype(np.float32))
        forces = self.tissue.tools.reaction_forces.cpu().numpy().reshape(self.task.force.shape)
        state, self._observed = self.task.observe(positions, forces), True
        return state if self.actions == "cartesian" or self.tools is None else self.tools.observe(state)

    def arm_state(self) -> np.ndarray:
        """What the arms of each episode measure of themselves [B, 11 A], see `arm_state`; forces are those of the last observation."""
        return arm_state(self.task, None if self.pictures is None else self.pictures.moved)

    def images(self) -> np.ndarray:
        """What the left eye of the endoscope sees of all episodes [B, H, W, 3], uint8.

        Raises:
            ValueError: If the batch was made without images.
        """
        if self.pictures is None:
            raise ValueError("this batch was made without images; make it with images=True")
        if not self._observed:
            self.state()
        return self.pictures.draw()[IMAGE]
