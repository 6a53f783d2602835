"""Tasks to learn, free of any framework: B episodes at once, as arrays [B, …]; B = 1 is the same code and the same bits.

A task knows the nodes of the tissue at rest and where it is seen from. It turns actions into commands of a tool, and what can be
measured (where some nodes of the skin are, what the tool feels) into observations, rewards and an end. It never looks into the
simulation, so that the same task runs over topics.

All lengths of a task are in its own frame: the origin on the skin, z towards the endoscope, x to the right and y up in its picture. An
action [4] in -1 … 1 is how far the tip moves in this step along x, y and z, in parts of `step_length`, and a fourth number that each
task explains; a fifth turns the tip about z, where the task has a `twist`. A task of several arms has as many of such actions and tips:
what is [B, 3] here is then [B, A, 3], and [B] is [B, A].
To add a task, write a subclass of :class:`Task`, with a scripted policy, in a file of its own. Every command and the policy's ROS node
take it as ``path/to/file.py:Name``. One that belongs to the package is a file here and has a name in `TASKS`.

Sums are written out, term by term, so that their bits do not depend on B.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.instruments import Capsule, Part
from endo_sim_ros.physics import ControlNodes, MotionConfig, PhysicsConfig

if TYPE_CHECKING:
    from endo_sim_ros.learning.policies import Policy

LENGTH, FORCE = 0.02, 1.0  # m and N; observations are in these units
BOUND = 10.0  # observations are clipped to ± this


@dataclass
class Outcome:
    """Of one step of B episodes."""

    reward: np.ndarray  # [B]
    success: np.ndarray  # [B] bool
    terminated: np.ndarray  # [B] bool: success, or too much force
    truncated: np.ndarray  # [B] bool: out of time


class Task(ABC):
    """B episodes of one task.

    Args:
        nodes: The tissue at rest.
        endoscope: Pose of the endoscope [4, 4], camera to world, m, optical axes (x right, y down, z forward).
        count: B.

    Raises:
        ValueError: If the tissue is too small for the task.
    """

    name: str
    sentence: str  # what is to be done, for policies that read it
    observation_names: tuple[str, ...]
    horizon: int  # steps of an episode
    arms: tuple[str, ...] = ("PSM1",)  # that hold a tool each: PSM1 on the right of the picture, PSM2 on the left
    step_length = 0.002  # m in one step, per axis
    roams = False  # whether the endoscope is elsewhere than that of the scene, see `endoscopes`
    turns = False  # whether actions move the endoscope, and not the tool; their fourth number is a speed then, which rests at 0
    twist = 0.0  # rad in one step, counter-clockwise in the picture, by which a fifth number of actions turns the tip; 0 = it has none
    most_twist = np.pi  # rad to either side
    fourth_does = ""  # what the fourth number of actions does, in words, for READMEs of datasets; empty = it closes the jaw above 0
    working_fourth = -1.0  # fourth action of a tool at work in the tissue, as benchmarks give it
    force_limit: float  # N; above it tissue is hurt, and the episode lost
    low: tuple[float, float, float]  # where the tip may be, m, task frame
    high: tuple[float, float, float]
    site_count = 1  # nodes per episode whose positions are observed
    closing: bool | tuple[bool, ...] = False  # whether the fourth number of actions closes jaws above 0; of each arm, if they differ
    cutting = False  # whether tools have edges that cut the tissue, see `cuts`
    largest_stiffness = 1.0  # factor on the moduli that an episode may have
    same_tissue = True  # in all episodes, but for randomisation
    margin = 0.012  # m from tissue that is held in place to a place that is worked on
    around = 0.012  # m; the skin within this distance of a place is compared with a plane
    smooth = 0.6  # share of the places that is used: the flattest
    tool = "LARGE_NEEDLE_DRIVER"  # what is seen of it; what it does is up to the physics
    tool_share = 1.0  # where on its jaws it works: from their hinge, 0, to their points, 1
    open_jaw, closed_jaw = 1.0, 0.0  # rad: as they are commanded
    dyed_radius = 0.003  # m, of the spot that pictures show of where an episode is about

    @staticmethod
    @abstractmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """The tissue and the tools of the task."""

    @classmethod
    def thing(cls) -> tuple[list[Part], list[Capsule]] | None:
        """Parts and capsules, each of a link, of what else is drawn with the tools, if there is something."""
        return None

    @classmethod
    def action_size(cls) -> int:
        """How many numbers an action of the tip has for each arm."""
        return 5 if cls.twist else 4

    @classmethod
    def jaw_axes(cls, endoscope: np.ndarray) -> np.ndarray | None:
        """Axes [3, 3] in the world, z along the jaws and x along their hinge, of a tool whose tip has the axes of the world.

        None where they are as the arm is placed, straight from its remote centre.

        Args:
            endoscope: Pose of that of the scene [4, 4], camera to world.
        """
        return None

    @classmethod
    def tool_of(cls, arm: str) -> str:
        """What is seen of the tool that an arm of this name holds."""
        return cls.tool

    @staticmethod
    def script(count: int) -> "Policy":
        """A policy that solves the task by its state, for a number of episodes.

        Raises:
            ValueError: If nobody has written one.
        """
        raise ValueError("the task has no scripted policy; name the .npz file of a trained one")

    @classmethod
    def hands(cls, episodes: Sequence[int] | np.ndarray) -> np.ndarray:
        """Where the arms of episodes [n] are [n, A] in arrays [B A], which have those of each episode one after the other."""
        return np.asarray(episodes, int)[:, None] * len(cls.arms) + np.arange(len(cls.arms))

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        self.nodes, self.endoscope, self.count = nodes, np.asarray(endoscope, np.float64), count
        self.rest = nodes.rest.astype(np.float64)  # [M, 3] m, world
        self.skin = np.flatnonzero(nodes.is_skin & ~nodes.pinned)
        self.places = self.skin[self._clearances() >= self.margin]  # nodes that an episode may be about
        if not len(self.places):
            raise ValueError(f"{self.name}: no skin node is {self.margin:g} m from where tissue is held; the model is too small")
        relief = np.array([self._relief(place) for place in self.places])
        self.places = self.places[relief <= np.quantile(relief, self.smooth)]
        self.origin, self.axes = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))  # rows: x, y, z in the world
        self.sites = np.zeros((count, self.site_count), int)
        hands = (count,) if len(self.arms) == 1 else (count, len(self.arms))
        self.tip = np.zeros((*hands, 3))  # m, task frame
        self.fourth = np.zeros(hands)  # of the last action
        self.raised = np.zeros(hands, int)  # steps that it has been above zero, one after the other
        self.steps = np.zeros(count, int)
        self.twisted = np.zeros(hands)  # by fifth numbers, rad
        self.rotations = np.tile(np.eye(3), (*hands, 1, 1))  # axes of the tips, world; where an arm starts they are those of the world
        self.force = np.zeros((*hands, 3))  # what the tissue exerts on the tool, N, task frame
        self._potential = np.zeros(count)

    def _clearances(self) -> np.ndarray:
        held = self.rest[self.nodes.is_skin & self.nodes.pinned]
        if not len(held):
            return np.full(len(self.skin), np.inf)
        return np.sqrt(((self.rest[self.skin, None] - held) ** 2).sum(2).min(1))

    def _relief(self, place: int) -> float:
        """How far the skin around a node departs from a plane (root mean square), m."""
        near = self.rest[self.skin] - self.rest[place]
        near = near[(near**2).sum(1) <= self.around**2]
        return float(np.linalg.svd(near - near.mean(0), compute_uv=False)[-1] / np.sqrt(len(near)))

    def reset(self, b: int, rng: np.random.Generator) -> None:
        """Begin episode b anew; all chance comes from the generator."""
        self._choose(b, rng)
        self.tip[b] = rng.uniform(self.low, self.high, self.tip[b].shape)
        self.fourth[b], self.raised[b], self.steps[b], self.force[b], self.twisted[b] = -1.0, 0, 0, 0.0, 0.0
        self._reset(b, rng)
        self.rotations[b] = turned_about(self.axes[b, 2], self.twisted[b])

    def _choose(self, b: int, rng: np.random.Generator) -> None:
        """Choose what episode b is about: its sites and its frame."""
        self.sites[b] = place = int(rng.choice(self.places))
        self._look(b, self.rest[place])

    def _look(self, b: int, place: np.ndarray) -> None:
        """Put the frame of episode b at a place [3], m, world."""
        right, eye = self.endoscope[:3, 0], self.endoscope[:3, 3]
        z = eye - place
        z /= np.sqrt(dot(z, z))
        x = right - dot(right, z) * z  # as in the picture, so that a policy that sees can learn what its actions do
        x /= np.sqrt(dot(x, x))
        self.origin[b], self.axes[b] = place, np.stack([x, cross(z, x), z])

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        """What else begins anew."""

    def tips(self) -> np.ndarray:
        """Where the tips are [B, 3], m, world."""
        return _of_each(self.origin, self.tip) + self._to_world(self.tip)

    def act(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the tips shall be at the end of the step [B, 3], m, world, and whether jaws are closed [B], for actions [B, 4 A].

        Raises:
            ValueError: If actions have another shape, or are not finite; nothing has changed then.
        """
        actions = self.check_actions(actions, self.action_size())
        self.twisted, self.rotations = self._twist_to(actions), self.orient(actions)
        return self.go(self.tip + self.step_length * actions[..., :3], actions[..., 3])

    def check_actions(self, actions: np.ndarray, size: int) -> np.ndarray:
        """Actions [B, size A] as those of each arm [B, size] or [B, A, size], each number within -1 … 1, float64.

        Raises:
            ValueError: If they have another shape, or are not finite.
        """
        whole = size * len(self.arms)
        try:
            actions = np.asarray(actions, np.float64)
        except (TypeError, ValueError, RuntimeError) as error:  # of torch, where a tensor has a gradient
            raise ValueError(f"{self.name}: actions must be {self.count} × {whole} numbers ({error})") from error
        if actions.shape != (self.count, whole):
            raise ValueError(f"{self.name}: actions must be {self.count} × {whole} numbers, got the shape {actions.shape}")
        if not np.isfinite(actions).all():
            wrong = int((~np.isfinite(actions)).any(1).argmax())
            raise ValueError(f"{self.name}: the action of episode {wrong} is not finite: {actions[wrong].tolist()}; has learning diverged?")
        return np.clip(actions, -1.0, 1.0).reshape(*self.fourth.shape, size)

    def go(self, tips: np.ndarray, fourth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take a step with the tips at places [B, 3], m, task frame, as far as they may be there; returns what `act` does.

        Args:
            tips: The places.
            fourth: What the fourth number of actions means [B].
        """
        self.tip = np.clip(tips, self.low, self.high)
        self.fourth = fourth
        self.raised = np.where(self.fourth > 0, self.raised + 1, 0)
        self.steps = self.steps + 1
        return self.tips(), self.closes(fourth)

    def forces(self) -> np.ndarray:
        """What the tissue exerted on the tools when they were last observed [B, 3], N, world."""
        return self._to_world(self.force)

    def find(self, places: np.ndarray) -> np.ndarray:
        """Places [B, 3], or several of each episode [B, K, 3], of the world, m, in the task frame."""
        return self._to_task(places - _of_each(self.origin, places))

    def closes(self, fourth: np.ndarray) -> np.ndarray:
        """Whether a fourth number of actions [B] closes the jaws."""
        return (np.asarray(fourth) > 0) & np.array(self.closing)

    def cuts(self, fourth: np.ndarray) -> np.ndarray:
        """Whether the edge of a tool cuts with a fourth number of actions [B]; it reaches from the tip against the z of its axes."""
        return np.zeros(np.shape(fourth), bool)

    def hear_cuts(self, b: int, triangles: np.ndarray) -> None:
        """All that has been cut in episode b, triangles [T, 3, 3] in the tissue at rest, m, world, float32; before each `observe`."""

    def reach(self, actions: np.ndarray) -> np.ndarray:
        """Where actions [B, 4 A] in -1 … 1 put the tips [B, 3], m, world."""
        actions = actions.reshape(*self.fourth.shape, -1)
        places = np.clip(self.tip + self.step_length * actions[..., :3], self.low, self.high)
        return _of_each(self.origin, places) + self._to_world(places)

    def orient(self, actions: np.ndarray) -> np.ndarray:
        """What axes of the tips [B, 3, 3], world, actions [B, 4 A] in -1 … 1 lead to."""
        if not self.twist:
            return self.rotations
        turned = self._twist_to(actions.reshape(*self.fourth.shape, -1))
        return turned_about(_of_each(self.axes[:, 2], turned[..., None]), turned)

    def _twist_to(self, actions: np.ndarray) -> np.ndarray:
        """How far tips are turned after actions of each arm [B, n], rad."""
        return np.clip(self.twisted + self.twist * actions[..., -1], -self.most_twist, self.most_twist)

    def observe(self, positions: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Observations [B, n], float32.

        Args:
            positions: Of the nodes `sites` [B, K, 3], m, world, float32.
            forces: What the tissue exerts on the tools [B, 3], N, world.

        Raises:
            RuntimeError: If `_columns` or `_value` give something else than they are to, or no numbers.
        """
        self.force = self._to_task(np.asarray(forces, np.float64))
        own = self._columns(self.find(positions.astype(np.float64)))
        columns = [] if own is None else [*own]
        columns += [*self._by_arm(self.force / FORCE).T, *self._by_arm(norm(self.force) / FORCE).T, 1 - self.steps / self.horizon]
        if len(columns) != len(self.observation_names):
            names = f"observation_names has {len(self.observation_names)} names for {len(columns)} numbers"
            raise RuntimeError(
                f"{self.name}: {names}; beside those of the task there are the force of each arm, x, y, z and length, and time_left"
            )
        columns = [self._of_all(f"_columns, for {name},", column) for name, column in zip(self.observation_names, columns)]
        observation = np.clip(np.stack(columns, 1), -BOUND, BOUND).astype(np.float32) + np.float32(0)  # no negative zeros
        if np.isnan(observation).any():
            wrong, column = np.argwhere(np.isnan(observation))[0]
            raise RuntimeError(f"{self.name}: the observation {self.observation_names[column]} of episode {wrong} is not a number")
        fresh = self.steps == 0
        self._potential[fresh] = self._of_all("_value", self._value())[fresh]
        return observation

    def _of_all(self, method: str, values: np.ndarray) -> np.ndarray:
        """What a method gave for the episodes, which is one value for each [B]; raises RuntimeError if not."""
        if np.shape(values) != (self.count,):
            given = "nothing" if values is None else f"the shape {list(np.shape(values))}"
            raise RuntimeError(
                f"{self.name}: {method} gives {given}, and must give a value for each episode, here the shape [{self.count}]"
            )
        return values

    @abstractmethod
    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        """The task's own observations, [B] each; here [B, K, 3] m, task frame: where the sites are now."""

    @abstractmethod
    def _value(self) -> np.ndarray:
        """How near to the goal each episode is [B]; the reward of a step is how much it grows."""

    @abstractmethod
    def _judge_goal(self) -> np.ndarray:
        """Count the step towards the goal, and tell whether each episode has reached it [B]; `judge` calls this once a step."""

    def _ended(self) -> np.ndarray:
        """Whether an episode has ended by its own action [B]."""
        return np.zeros(self.count, bool)

    def judge(self) -> Outcome:
        """The outcome of a step. Reward: progress, 1 for success, -1 for too much force.

        Call it once a step, after `observe`, which stores the force and the positions that are judged.

        Raises:
            RuntimeError: If a reward is not finite, or the goal is not judged for each episode.
        """
        hurt = (self._by_arm(norm(self.force)) > self.force_limit).any(1)
        truncated = self.steps >= self.horizon
        success = self._of_all("_judge_goal", self._judge_goal()) & ~hurt
        value = self._of_all("_value", self._value())
        reward = value - self._potential + success - hurt
        if not np.isfinite(reward).all():
            wrong = int((~np.isfinite(reward)).argmax())
            raise RuntimeError(
                f"{self.name}: the reward of episode {wrong} is {reward[wrong]}, as _value is {value[wrong]}; it must be finite"
            )
        self._potential = value
        terminated = hurt | success | self._of_all("_ended", self._ended())
        return Outcome(reward, success, terminated, truncated & ~terminated)

    def stiffness(self, b: int) -> np.ndarray:
        """Factor on the moduli of each node [M] in episode b."""
        return np.ones(len(self.nodes))

    def endoscopes(self, actions: np.ndarray | None = None) -> np.ndarray | None:
        """Poses of the endoscopes [B, 4, 4], camera to world, m, now, or where actions [B, n] take them; None where they stay where the
        scene has theirs."""
        return None

    def endoscope_joints(self, actions: np.ndarray | None = None) -> np.ndarray | None:
        """Joints of the arms of the endoscopes [B, 4], rad and m, now, or where actions [B, n] take them; None where none does."""
        return None

    def dyed_spots(self, b: int) -> tuple[DyedSpot, ...]:
        """What is dyed in episode b, so that pictures tell the goal: the place that it is about."""
        return (DyedSpot(self.origin[b].copy(), self.dyed_radius),)

    def goal_lines(self) -> tuple[str, ...]:
        """What pictures do not show a person about the goal of the first episode now, a line each."""
        return ()

    def thing_poses(self) -> dict[str, np.ndarray]:
        """Where the links of the `thing` are [B, 4, 4], m, world, by name."""
        return {}

    def regions(self) -> tuple[str, ...]:
        """The stiffness of the first episode as physics_node's parameter `regions`; empty where it is 1 everywhere."""
        return ()

    def _by_arm(self, values: np.ndarray) -> np.ndarray:
        """Values of the arms [B, …] or [B, A, …], those of an episode in a row [B, n]."""
        return values.reshape(self.count, -1)

    def _to_world(self, v: np.ndarray) -> np.ndarray:
        return dot(_of_each(self.axes.transpose(0, 2, 1), v), v[..., None, :])

    def _to_task(self, v: np.ndarray) -> np.ndarray:
        return dot(_of_each(self.axes, v), v[..., None, :])


def _of_each(values: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values of the episodes [B, …], so that they go with vectors [B, 3] or with several of each episode [B, A, 3]."""
    return values if v.ndim == 2 else values[:, None]


class Script:
    """What scripted policies have in common: they move the tip and take the state, see `endo_sim_ros.learning.policies.Policy`."""

    actions: Literal["cartesian"] = "cartesian"
    sight = None
    fade = 0.008  # m: how far from where a jaw closes the fourth number is as low as it gets

    def closing(self, distance: np.ndarray, grasp: float) -> np.ndarray:
        """Fourth numbers of jaws at distances [...], m, that close nearer than `grasp`, m, and say by and by that they are coming near.

        They are for policies that copy them: of a number that jumps, hardly a row of a demonstration would tell when to close.
        """
        return np.clip((grasp - distance) / self.fade, -1, 1)

    @staticmethod
    def states(observations: Any) -> np.ndarray:
        """State observations [B, n] as they are computed with; raises ValueError for others, such as a dict of several."""
        if not isinstance(observations, np.ndarray) or observations.ndim != 2:
            got = f"an array {list(observations.shape)}" if isinstance(observations, np.ndarray) else f"a {type(observations).__name__}"
            raise ValueError(f"a scripted policy takes states, an array [B, n], got {got}; of a dict give the part named state")
        return observations.astype(np.float64)

    def reset(self, episodes: Sequence[int]) -> None:
        """These episodes begin anew; nothing to do for a script without a memory."""


def moving(physics: PhysicsConfig, motion: MotionConfig) -> PhysicsConfig:
    """The physics of a task with another motion in place of its own; at its defaults, its own.

    Raises:
        ValueError: If a motion is described that moves nothing.
    """
    if motion.breathing or motion.heartbeat:
        return replace(physics, motion=motion)
    if motion.idle:
        raise ValueError(motion.idle)
    return physics


def turned_about(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotations [..., 3, 3] by angles [...], rad, about unit axes [..., 3]."""
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    c, s = np.cos(angles), np.sin(angles)
    turned = np.empty((*np.shape(angles), 3, 3))
    turned[..., 0, 0], turned[..., 0, 1], turned[..., 0, 2] = c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s
    turned[..., 1, 0], turned[..., 1, 1], turned[..., 1, 2] = x * y * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s
    turned[..., 2, 0], turned[..., 2, 1], turned[..., 2, 2] = x * z * (1 - c) - y * s, y * z * (1 - c) + x * s, c + z * z * (1 - c)
    return turned


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum over the last axis, of three, in one order."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of two vectors [3], in a tenth of the time of NumPy's."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def norm(v: np.ndarray) -> np.ndarray:
    """Lengths of vectors [..., 3]."""
    return np.sqrt(dot(v, v))
