"""The instruments of B episodes: where they stand, and the joints that put their tips where a task has them.

A task moves tips without a shape. Here each is a place on the jaws of an instrument, which comes into the picture as
`endo_sim_ros.instruments.place_arm` has it, or in a direction of the task. It keeps that in the world while the tip moves, unless actions
turn it. What a task of A arms has of each is [B A] here, arm after arm of each episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from endo_sim_ros.core.cameras import invert_pose, matrix_to_quat, parse_frames, rigid_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import (
    JOINTS,
    ArmKinematics,
    Capsule,
    Part,
    build_instrument,
    link_poses,
    load_arm,
    place_arm,
    solve_inverse,
    working_point,
)
from endo_sim_ros.instruments.aiming import AHEAD
from endo_sim_ros.instruments.overlap import overlap
from endo_sim_ros.instruments.shapes import SHAPES
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.tasks import Task
from endo_sim_ros.learning.variation import Variation

_WORLD = "world"
_LEVER = 0.1  # m: about how far the tip is from the remote centre, about which yaw and pitch turn it
_WRIST_STEP = 0.05  # rad a step of 0.04 s: about half the speed that the dVRK allows


@dataclass(frozen=True)
class HeldTool:
    """A tool on its arm, as a task holds it.

    Args:
        holder: Name of the arm.
        arm: Its tip is where the task works with the tool; the axes of the tip are those of the world at the start.
        base: Pose [4, 4] of the base in the world, m.
        centre: The tissue in the middle of the picture [3], m, world.
        name: Name of the tool, or the path of its file.
    """

    holder: str
    arm: ArmKinematics
    base: np.ndarray
    centre: np.ndarray
    name: str

    @cached_property
    def start(self) -> np.ndarray:
        """Joint positions [6] before the first command, rad and m; as physics_node has them for an arm with a known base."""
        joints = np.clip(np.zeros(len(self.arm.joints)), self.arm.lower, self.arm.upper)
        joints[2] = np.clip(0.5 * (self.arm.lower[2] + self.arm.upper[2]) - AHEAD, self.arm.lower[2], self.arm.upper[2])
        return joints

    @cached_property
    def frame(self) -> str:
        """The base as an option `frames` of the ROS nodes names it."""
        return _frame(self.holder, self.base)

    @cached_property
    def shape(self) -> tuple[list[Part], list[Capsule]]:
        """Its parts and capsules."""
        return build_instrument(self.arm)

    def jaw(self, angles: np.ndarray) -> np.ndarray:
        """Angles between the jaws [B], rad, as far as they open; closed jaws press, they do not overlap."""
        return np.clip(angles, 0.0, self.arm.jaw[1] if self.arm.jaw else 0.0)


def require_tool(task: type[Task], tool: str) -> None:
    """Raise ValueError if there is no such tool, or a task closes jaws and the tool has none."""
    if not _fits(task, tool):
        raise ValueError(f"{task.name} closes the jaws of its tool, but {tool} has none; name a tool with jaws, or leave tool out")


def hold_tool(task: type[Task], scene: Scene, tool: str = "", holder: str = "PSM1") -> HeldTool:
    """The tool of a task in a scene, on an arm that comes from the lower right of the picture, PSM2 from the lower left.

    Args:
        task: What it is held for.
        scene: Where.
        tool: Name or file of the tool; empty = that of the task.
        holder: Name of the arm.

    Raises:
        ValueError: If there is no such tool, nobody knows its shape, or the arm does not reach the tissue in the picture.
    """
    tool = tool or task.tool_of(holder)
    arm, camera = load_arm("PSM", tool), scene.camera
    _, capsules = build_instrument(arm)
    try:
        placed = place_arm(holder, arm, camera, scene.depth)
    except ConfigError as error:
        raise ConfigError(f"{error}; or leave out the tool (instrument off)") from error
    base = parse_frames(_WORLD, [_frame(holder, placed.base)])[f"{holder}_base"]  # with the bits that physics_node has
    # The tip moves from the hinge to where the jaws work: in the axes of the hinge, and then in those of the world.
    point = working_point(arm, capsules, task.tool_share)
    hinge = task.jaw_axes(camera.pose)
    if hinge is None:
        hinge = (base @ arm.tip_pose(placed.joints))[:3, :3]
    # A ball that pushes has no picture: the tool touches where the ball meets what lies ahead of it.
    ahead = task.physics().contact_radius * camera.pose[:3, 2]
    mount = rigid_pose(hinge, ahead - hinge @ point)
    centre = camera.position + scene.depth * camera.pose[:3, 2]
    return HeldTool(holder, replace(arm, tooltip_offset=arm.tooltip_offset @ invert_pose(mount)), base, centre, tool)


def hold_tools(task: type[Task], scene: Scene, tool: str = "", others: bool = False) -> list[HeldTool]:
    """The tool of each arm of a task, as `hold_tool` has it, and then others, each by all arms; raises as that does.

    Args:
        task, scene, tool: As there.
        others: Whether those in `SHAPES` are wanted, too; only those with jaws where the task closes them.
    """
    if tool:
        require_tool(task, tool)
    more = [name for name in SHAPES if _fits(task, name)] if others else []
    return [hold_tool(task, scene, name, arm) for name in (tool, *more) for arm in task.arms]


def _fits(task: type[Task], tool: str) -> bool:
    """Whether a task can use a tool: one that closes jaws needs a tool that has them."""
    return not np.any(task.closing) or load_arm("PSM", tool).jaw is not None


def _frame(holder: str, base: np.ndarray) -> str:
    w, *xyz = matrix_to_quat(base[:3, :3])
    return " ".join([f"{holder}_base", *(repr(float(value)) for value in (*base[:3, 3], *xyz, w))])


class HeldTools:
    """The tools of B episodes of one task of A arms.

    Args:
        tools: That of the task, of each of its arms, and then all others that an episode may have, in the same way.
        task: The task.
        count: B.
    """

    def __init__(self, tools: Sequence[HeldTool], task: type[Task], count: int):
        self.tools = tuple(tools)
        self._task = task
        self.which = np.tile(np.arange(len(task.arms)), count)  # number of each arm's tool [B A]
        self.bases = np.array([tool.base for tool in tools])[self.which]  # [B A, 4, 4] world
        self.joints = np.array([tool.start for tool in tools])[self.which]  # [B A, 6] rad and m
        self.angles = np.full(len(self.which), task.open_jaw)  # between the jaws [B A], rad

    @property
    def kinds(self) -> list[tuple[HeldTool, ...]]:
        """The tools by kind, one for each arm."""
        arms = len(self._task.arms)
        return [self.tools[i : i + arms] for i in range(0, len(self.tools), arms)]

    def names(self) -> np.ndarray:
        """Names of the tools that episodes have [B, A]."""
        return np.array([tool.name for tool in self.tools])[self.which].reshape(-1, len(self._task.arms))

    def kind(self, episodes: np.ndarray) -> np.ndarray:
        """Number of the kind of tools that each of these episodes [n] has [n]."""
        return self.which[self._task.hands(episodes)[:, 0]] // len(self._task.arms)

    def vary(self, episode: int, variation: Variation) -> None:
        """Give the arms of an episode their tools and places."""
        number, own = variation.tool(len(self.kinds) - 1), self._task.hands([episode])[0]
        self.which[own] = self._task.hands([0 if number is None else number + 1])[0]
        for arm, tool in zip(own, (self.tools[i] for i in self.which[own])):
            self.bases[arm] = variation.trocar(tool.base, tool.centre)

    def begin(self, arms: np.ndarray, poses: np.ndarray) -> None:
        """Begin anew with these arms [n], their tips at poses [n, 4, 4], world."""
        self.joints[arms] = np.array([tool.start for tool in self.tools])[self.which[arms]]
        self.move(arms, poses, np.zeros(len(arms), bool))

    def move(self, arms: np.ndarray, poses: np.ndarray, closed: np.ndarray) -> None:
        """Move the tips of these arms [n] to poses [n, 4, 4], world, or as near as they get, and close their jaws or not [n]."""
        for number, tool in enumerate(self.tools):
            chosen = self.which[arms] == number
            if chosen.any():
                own = arms[chosen]
                reach = solve_inverse(tool.arm, invert_pose(self.bases[own]) @ poses[chosen], self.joints[own])
                self.joints[own] = reach.joints
        self.angles[arms] = self._angles(closed)

    def act(self, task: Task, actions: np.ndarray, relative: bool) -> tuple[np.ndarray, np.ndarray]:
        """Take the step of a task with actions [B, 7 A] of joints, as `Task.act` does with those of tips, and raises what that does.

        Args:
            task: The task.
            actions: Of the joints as in `reach`, and the fourth number of the task, of each arm.
            relative: As for `reach`.

        Returns:
            Poses of the tips [B A, 4, 4], world, and whether jaws are closed [B A].
        """
        actions = task.check_actions(actions, len(JOINTS) + 1)
        self.joints = self.reach(actions[..., :-1].reshape(self.joints.shape), relative)
        poses = self.poses()
        asked = task.find(poses[:, :3, 3].reshape(task.tip.shape))
        tips, closed = (each.reshape(len(poses), *each.shape[task.fourth.ndim :]) for each in task.go(asked, actions[..., -1]))
        clipped = (task.tip != asked).any(-1)
        if clipped.any():
            outside = np.flatnonzero(clipped)
            poses[outside, :3, 3] = tips[outside]
            self.move(outside, poses[outside], closed[outside])
            poses = self.poses()
            task.tip[clipped] = task.find(poses[:, :3, 3].reshape(task.tip.shape))[clipped]
        task.rotations = poses[:, :3, :3].reshape(task.rotations.shape)
        self.angles = self._angles(closed)
        return poses, closed

    def observe(self, state: np.ndarray) -> np.ndarray:
        """State observations [B, n + 6 A], float32: those of the task [B, n], and the joints as `scaled` gives them."""
        return np.concatenate([state, self.scaled().astype(np.float32).reshape(len(state), -1)], 1)

    def _angles(self, closed: np.ndarray) -> np.ndarray:
        return np.where(closed, self._task.closed_jaw, self._task.open_jaw)

    def reach(self, actions: np.ndarray, relative: bool) -> np.ndarray:
        """Joint positions [B A, 6] within their limits that actions [B A, 6] in -1 … 1 ask for, rad and m.

        Args:
            actions: How far each joint moves, in units of `steps`, or where it is between its limits.
            relative: Which of the two.
        """
        lower, upper = self._limits()
        wanted = self.joints + self.steps * actions if relative else lower + 0.5 * (actions + 1) * (upper - lower)
        return np.clip(wanted, lower, upper)

    def _limits(self) -> np.ndarray:
        """Lower and upper limits of the joints [2, B A, 6], rad and m."""
        return np.array([(tool.arm.lower, tool.arm.upper) for tool in self.tools])[self.which].swapaxes(0, 1)

    @cached_property
    def steps(self) -> np.ndarray:
        """How far actions of 1 move the joints [6], rad and m: the first three about as far as they move the tip along an axis."""
        turn = self._task.step_length / _LEVER
        return np.array([turn, turn, self._task.step_length, _WRIST_STEP, _WRIST_STEP, _WRIST_STEP])

    def scaled(self) -> np.ndarray:
        """Joint positions [B A, 6] as parts of their ranges, -1 … 1."""
        lower, upper = self._limits()
        return 2 * (self.joints - lower) / (upper - lower) - 1

    def poses(self) -> np.ndarray:
        """Poses of the tips [B A, 4, 4], world, at the joints."""
        poses = np.empty((len(self.which), 4, 4))
        for number, tool in enumerate(self.tools):
            own = self.which == number
            poses[own] = self.bases[own] @ tool.arm.tip_pose(self.joints[own])
        return poses

    def links(self, number: int, arms: np.ndarray) -> dict[str, np.ndarray]:
        """Poses [n, 4, 4] of the links, world, by name, of arms [n] that have the tool of a number."""
        tool = self.tools[number]
        return link_poses(tool.arm, self.joints[arms], tool.jaw(self.angles[arms]), self.bases[arms])

    def posed(self, kind: int, episodes: np.ndarray) -> list[dict[str, np.ndarray]]:
        """What `links` gives of each arm [A] of episodes [n] that have a kind of tools."""
        numbers, hands = self._task.hands([kind])[0], self._task.hands(episodes)
        return [self.links(number, own) for number, own in zip(numbers, hands.T)]

    def overlap(self) -> np.ndarray:
        """How deep the tools of two arms are in each other [B], m; 0 where they do not touch. Nothing stops them."""
        episodes = np.arange(len(self.which) // len(self._task.arms))
        deepest, kinds = np.zeros(len(episodes)), self.kind(episodes)
        for number in np.unique(kinds):
            own = np.flatnonzero(kinds == number)
            first, second = zip((tool.shape[1] for tool in self.kinds[number]), self.posed(number, own))
            deepest[own] = overlap(first, second)
        return deepest
