"""One tool arm as physics_node knows it: what it was last told and, where there is no robot, how it moves and what state it is in."""

from dataclasses import dataclass

import numpy as np

from endo_sim_ros.core.cameras import interpolate_pose
from endo_sim_ros.physics.simulation import MOST_WRENCH

ROUNDED = 1 + 1e-9  # a way that takes a whole number of steps must not take one more
JAW_AT_START = 1.0  # rad
ENABLED, DISABLED, PAUSED = "ENABLED", "DISABLED", "PAUSED"  # CRTK; an ideal arm has no FAULT
_TRANSITIONS = {  # of CRTK: from which states a command leads to which
    "enable": ({ENABLED, DISABLED}, ENABLED),
    "disable": ({ENABLED, DISABLED, PAUSED}, DISABLED),
    "pause": ({ENABLED, PAUSED}, PAUSED),
    "resume": ({PAUSED}, ENABLED),
}


@dataclass
class Arm:
    """What was last heard from one arm, and where it is on its way to."""

    name: str
    pose: np.ndarray | None = None  # [4, 4], world
    force: np.ndarray | None = None  # [3] N, world
    torque: np.ndarray | None = None  # [3] N·m about the point held, world
    heard: float = 0.0  # time of the last wrench, seconds of the clock
    acting: bool = False  # whether the tissue was last given a wrench of it
    angle: float = JAW_AT_START  # of the jaw, rad
    closed: bool = False  # the jaw
    empty: bool = False  # whether it is closed on nothing, and that was told
    cutting: bool = False
    state: str = ENABLED
    homed: bool = True
    felt: float = 0.0  # reaction in the last step, N
    acts: bool = True  # False at a start where nobody has commanded it yet: it touches nothing there
    pose_goal: np.ndarray | None = None  # [4, 4], world; None while no move is under way
    angle_goal: float | None = None  # rad

    @property
    def busy(self) -> bool:
        """Whether a move is under way."""
        return self.moving or self.angle_goal is not None

    def exert(self, force: np.ndarray, torque: np.ndarray, now: float) -> None:
        """Exert a wrench on the tissue from the next step on.

        Args:
            force: Force [3], N, world.
            torque: Torque [3] about the point held, N·m, world.
            now: Seconds of the clock.

        Raises:
            ValueError: If it is beyond any unit; the one before goes on.
        """
        if max(np.abs(force).max(), np.abs(torque).max()) > MOST_WRENCH:
            raise ValueError(f"{self.name}: a wrench of more than {MOST_WRENCH:g} N or N·m; is it in newtons?")
        self.force, self.torque, self.heard = force, torque, now

    def command_state(self, command: str) -> None:
        """Follow a state command of CRTK: enable, disable, pause, resume, home or unhome.

        Raises:
            ValueError: If there is no such command, or none in this state.
        """
        if command in ("home", "unhome"):
            self.homed = command == "home"
            return
        if command not in _TRANSITIONS:
            raise ValueError(f"{command[:40]!r} is no state command; there are {', '.join(_TRANSITIONS)}, home, unhome")
        states, after = _TRANSITIONS[command]
        if self.state not in states:
            raise ValueError(f"{command} is not possible while {self.name} is {self.state}")
        self.state = after
        if after != ENABLED:
            self.stop()
        if after == DISABLED:
            self.force = self.torque = None
            self.closed = self.cutting = False  # enabled again it holds nothing before it is told to

    def require_enabled(self) -> None:
        """Raise ValueError if the arm does not move now."""
        if self.state != ENABLED:
            what = "resume" if self.state == PAUSED else "enable"
            raise ValueError(f"{self.name} is {self.state}; send {what} on {self.name}/state_command")

    @property
    def angle_at_start(self) -> float:
        """Angle of the jaw until told otherwise, rad: open."""
        return JAW_AT_START

    def check_jaw(self, angle: float) -> float:
        """An angle of the jaw, rad, that the arm may take; every one, as nobody knows its tool."""
        return angle

    @property
    def works_at(self) -> np.ndarray:
        """Where a wrench acts [3], m, world: at the tip, as nobody knows its tool. The arm has a pose."""
        assert self.pose is not None
        return self.pose[:3, 3]

    @property
    def moving(self) -> bool:
        """Whether the tip is on its way to a goal."""
        return self.pose_goal is not None

    def servo(self, pose: np.ndarray) -> None:
        """Put the tip at a pose [4, 4], world, now."""
        self.pose, self.pose_goal, self.acts = pose, None, True

    def move_to(self, pose: np.ndarray) -> str:
        """Let the tip move to a pose [4, 4], world; returns what it will miss, in a sentence."""
        self.pose_goal, self.acts = pose, True
        return ""

    def stop(self) -> None:
        """End all moves where they are."""
        self.pose_goal = self.angle_goal = None

    def move(self, seconds: float, speed: float, turn_speed: float) -> str:
        """Go on for some seconds towards the goals, with at most these speeds, m/s and rad/s.

        Returns:
            What the arm misses of the pose that it is told, in a sentence; empty if nothing.
        """
        self._move_tip(seconds, speed, turn_speed)
        self._move_jaw(seconds, turn_speed)
        return ""

    def _move_tip(self, seconds: float, speed: float, turn_speed: float) -> None:
        if self.pose_goal is None:
            return
        if self.pose is None:  # nobody knows where it comes from
            self.pose = self.pose_goal
        needed = seconds_between(self.pose, self.pose_goal, speed, turn_speed)
        if needed <= seconds * ROUNDED:
            self.pose, self.pose_goal = self.pose_goal, None
        else:
            self.pose = interpolate_pose(self.pose, self.pose_goal, seconds / needed)

    def _move_jaw(self, seconds: float, turn_speed: float) -> None:
        if self.angle_goal is None:
            return
        way, most = self.angle_goal - self.angle, seconds * turn_speed
        if abs(way) <= most * ROUNDED:
            self.angle, self.angle_goal = self.angle_goal, None
        else:
            self.angle += float(np.copysign(most, way))

    def hold(self, closed_at: float, open_at: float) -> None:
        """Close or open the jaw by its angle; between the two it stays as it is."""
        if self.angle <= closed_at:
            self.closed = True
        elif self.angle >= open_at:
            self.closed = False

    def reset(self) -> None:
        """Let go of everything; pose and state stay."""
        self.force = self.torque = None
        self.closed, self.angle, self.cutting = False, self.angle_at_start, False
        self.stop()


def seconds_between(pose: np.ndarray, goal: np.ndarray, speed: float, turn_speed: float) -> float:
    """Time from one pose [4, 4] to another, s, with at most these speeds, m/s and rad/s."""
    turn = pose[:3, :3].T @ goal[:3, :3]
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    return float(max(np.linalg.norm(goal[:3, 3] - pose[:3, 3]) / speed, angle / turn_speed))
