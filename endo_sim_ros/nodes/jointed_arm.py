"""An arm with joints: where its links are when its tip is at a pose, and how its joints get to where they are told."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.instruments import ArmKinematics, Capsule, link_poses, solve_inverse, working_point
from endo_sim_ros.nodes.arm import DISABLED, ROUNDED, Arm, seconds_between

_WITHIN = 1e-6  # rad, m: how far a command may leave the limits, as what is sent back was rounded
_JAW_WITHIN = 0.01  # rad: the same of the jaw, whose limits clients have in whole degrees
_LEAP = 10.0  # times the speed of a joint: the straight way passes a singularity or goes on with another bend of the wrist
_AT_START = 1e-3  # s, in place of the last step: before the first one nothing goes far
_TRIES = 4  # to find how far the tip gets in a step; one or two are enough where joints follow in proportion
_JOINTS_OF_LINK = {"roll": 4, "wrist_pitch": 5}  # joints that move it: the first ones; all others move with all joints
_SLOWEST = 1e-3  # part of all speeds: less makes a quarter of an hour of a move of a second
_MEASURED_WRONG, _MEASURED_TURNED = 1e-3, np.radians(1.0)  # m, rad: less is what calibrations are off


@dataclass(kw_only=True)
class JointedArm(Arm):
    """An arm with a base, joints and a tool.

    Until it has a base it is as an arm without joints: nobody knows what it reaches.

    Args:
        kinematics: The arm with its tool.
        tool_type: What loads the tool: its name and number, or the path of its file.
        commanded: Whether it has no robot, so that it is where its joints get to.
        capsules: What of its instrument touches tissue; none = its tip alone does.
        joint_speed, slide_speed: Largest speeds of joints that turn and that slide during moves, rad/s and m/s.
    """

    kinematics: ArmKinematics = field()
    tool_type: str = ""
    commanded: bool = True
    capsules: Sequence[Capsule] = ()
    link_reactions: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)  # force N and torque about the tip N·m
    joint_speed: float = np.inf
    slide_speed: float = np.inf
    base: np.ndarray | None = None  # [4, 4], world
    speed_ratio: float = 1.0  # part of all speeds with which moves go
    joints: np.ndarray | None = None  # [n] rad and m
    joint_goal: np.ndarray | None = None  # [n]; None while no move of joints is under way
    _to_pose: bool = False  # whether that move is the rest of one to a pose
    velocities: np.ndarray | None = None  # [n] rad/s and m/s, in the last step
    missing: str = ""  # what the joints miss of the pose that a robot measured, in a sentence
    start: np.ndarray | None = None  # [n] joints while nobody has commanded anything
    _posed: np.ndarray | None = None  # the pose that belongs to the joints
    _linked: tuple[np.ndarray | None, np.ndarray | None, float, dict[str, np.ndarray]] = (None, None, 0.0, {})  # of which links were found
    _stepped: np.ndarray | None = None  # joints at the end of the last step
    advancing: bool = False  # whether the last step was one of a move, be it the last one of that
    _began: np.ndarray | None = None  # joints where the last step began
    _retreat: np.ndarray | None = None  # joints to be at after the next step, as the last one of a move met too much force
    _seconds: float = _AT_START  # of the last step
    _untold: str = ""  # what it missed of a pose that it was told between two steps, in a sentence

    def __post_init__(self) -> None:
        self.angle = self.angle_at_start

    def stand(self, base: np.ndarray, joints: np.ndarray) -> None:
        """Stand at a base [4, 4], world; a commanded arm with its joints at positions [n], waiting for a command."""
        self.base, self.start, self._posed = base, joints, None
        if self.commanded:
            self.return_to_start()
        else:
            self.joints = joints

    def return_to_start(self) -> None:
        """Let go of everything and be at the start, which touches nothing until the arm is commanded."""
        super().reset()
        self._untold, self._seconds, self._retreat = "", _AT_START, None
        if self.start is not None:
            self._take(self.start)
            self._stepped, self.velocities, self.acts = self.start, np.zeros(len(self.start)), False

    @property
    def moving(self) -> bool:
        """Whether the tip or the joints are on their way to a goal, or back from one."""
        return self.pose_goal is not None or self.joint_goal is not None or self._retreat is not None

    def stop(self) -> None:
        """End all moves where they are."""
        super().stop()
        self.joint_goal = None

    def halt(self) -> None:
        """End the move of tip or joints where it is; the jaw goes on."""
        self.pose_goal = self.joint_goal = None

    def turn_back(self) -> None:
        """End the move of tip or joints, and be where its last step began after the next step, which no other move begins before."""
        self.halt()
        self._retreat = self._began

    # ---------------------------------------------------------------- commands

    @property
    def astray(self) -> bool:
        """Whether a robot measures a pose beyond any reach: its unit or the base is wrong, and nobody knows where it is."""
        return self.pose is not None and bool(self._astray(self.pose))

    def _astray(self, pose: np.ndarray) -> str:
        """Why a pose is beyond any reach, by more than the whole length of the arm, in a sentence; empty if it is not."""
        if self.base is None:
            return ""
        distance = math.dist(pose[:3, 3], self.base[:3, 3])
        if distance <= 2 * self.kinematics.length:
            return ""
        return f"the pose is {distance:.3g} m from the base, and the whole arm is {self.kinematics.length:.2g} m long; is it in metres?"

    def _require_sense(self, pose: np.ndarray) -> None:
        astray = self._astray(pose)
        if self.commanded and astray:
            raise ValueError(f"{self.name} stays where it is: {astray}")

    def servo(self, pose: np.ndarray) -> None:
        """Put the tip at a pose [4, 4], world; `move` finds out whether the joints get there.

        Where they do not, the nearest pose is taken if the joints get to that in a step, else the arm stays where it is.

        Raises:
            ValueError: If a commanded arm is not long enough by far; nothing changes then.
        """
        self._require_sense(pose)
        super().servo(pose)
        self.joint_goal = self._retreat = None

    def move_to(self, pose: np.ndarray) -> str:
        """Let the tip move to a pose [4, 4], world, or as near as the joints get; returns what it will miss, in a sentence.

        Raises:
            ValueError: As `servo` does.
        """
        self._require_sense(pose)
        self.joint_goal, missing = None, ""
        if self.base is not None and self.joints is not None:
            reach = solve_inverse(self.kinematics, invert_pose(self.base) @ pose, self.joints)
            missing = reach.shortfall()
            if missing:
                pose = self.base @ self.kinematics.tip_pose(reach.joints)
        super().move_to(pose)
        return missing and f"{self.name}: {missing}"

    def servo_joints(self, joints: ArrayLike) -> None:
        """Put the joints at positions [n], rad and m, now.

        Raises:
            ValueError: If they are not n finite numbers within the limits; nothing changes then.
        """
        self._take(self.check_joints(joints))
        self.halt()
        self.acts, self._retreat = True, None

    def move_joints(self, joints: ArrayLike) -> None:
        """Let the joints move to positions [n], rad and m; raises as `servo_joints` does."""
        self.joint_goal = self.check_joints(joints)
        self.pose_goal, self.acts, self._to_pose = None, True, False

    def check_joints(self, joints: ArrayLike, names: Sequence[str] = ()) -> np.ndarray:
        """Joint positions [n] that the arm may take, in the order of its joints, by whose names they may be called.

        Raises:
            ValueError: As from `servo_joints`, and if they have other names.
        """
        arm, positions = self.kinematics, self.check_numbers(joints, names)
        if self.base is None:
            raise ValueError(f"{self.name} has no place yet; publish a model, or give {self.name}_base in frames")
        for joint, value in zip(arm.joints, positions):
            if not joint.lower - _WITHIN <= value <= joint.upper + _WITHIN:
                slides = joint.kind == "prismatic"
                scale, unit, asked = (1e3, "mm", "metres") if slides else (np.degrees(1.0), "degrees", "radians")
                doubt = f"; is it in {asked}?" if abs(value) > (arm.length if slides else 2 * np.pi) else ""
                lower, upper, value = (f"{scale * number:.4g}" for number in (joint.lower, joint.upper, value))
                limits = f"its limits are {lower} and {upper} {unit}"
                raise ValueError(f"{self.name}: {joint.name} cannot be at {value} {unit}; {limits}{doubt}")
        return np.clip(positions, arm.lower, arm.upper)

    def check_numbers(self, joints: ArrayLike, names: Sequence[str] = ()) -> np.ndarray:
        """One number for each joint [n], whatever its limits; raises ValueError if they are not n finite ones, or have other names."""
        arm, known = self.kinematics, [joint.name for joint in self.kinematics.joints]
        if any(names) and list(names) != known:
            given = ", ".join(map(repr, names))  # as they may have line feeds
            raise ValueError(f"{self.name}: the joints are {', '.join(known)}, in this order, not {given:.200}; send these names or none")
        try:
            return arm.check_joints(joints)
        except ValueError as error:
            raise ValueError(f"{self.name}: {str(error).removeprefix(f'{arm.name}: ')}") from None

    def joints_after(self, change: np.ndarray, of_goal: bool = False) -> np.ndarray:
        """Joint positions [n] that differ by a change [n] from the present ones or, while joints move, from their goal if asked."""
        self._untold = self.settle() or self._untold  # `move` tells it
        goal = self.joint_goal if self._retreat is None else self._retreat
        before = goal if of_goal and goal is not None else self.joints
        return change if before is None else before + change  # without any the arm has no place either, and takes none

    def set_speed_ratio(self, ratio: float) -> None:
        """Let moves go with a part of their largest speeds; raises ValueError if it is not from 0.001 to 1."""
        if not _SLOWEST <= ratio <= 1:
            raise ValueError(f"{self.name}: the ratio of speeds is {ratio!r}; send one from {_SLOWEST:g} to 1")
        self.speed_ratio = ratio

    @property
    def angle_at_start(self) -> float:
        """Angle of the jaw until told otherwise, rad: open, as far as the tool opens."""
        jaw = self.kinematics.jaw
        return super().angle_at_start if jaw is None else min(super().angle_at_start, jaw[1])

    def check_jaw(self, angle: float) -> float:
        """An angle of the jaw, rad, that a commanded arm may take; ValueError if it is beyond the limits of the tool."""
        if self.commanded and self.kinematics.jaw is None:
            raise ValueError(f"{self.name}: {self.kinematics.tool} has no jaw, so it neither opens nor closes")
        if self.commanded and self.kinematics.jaw is not None:
            lower, upper = self.kinematics.jaw
            if not lower - _JAW_WITHIN <= angle <= upper + _JAW_WITHIN:
                shown, *limits = (f"{np.degrees(number):.4g}" for number in (angle, lower, upper))
                raise ValueError(f"{self.name}: the jaw cannot be at {shown} degrees; its limits are {' and '.join(limits)} degrees")
        return angle

    def hold(self, closed_at: float, open_at: float) -> None:
        """Close or open the jaw by its angle; a tool without one holds nothing, whatever its robot measures."""
        if self.kinematics.jaw is not None:
            super().hold(closed_at, open_at)

    @property
    def works_at(self) -> np.ndarray:
        """Where a wrench acts [3], m, world: between the jaws or at the point of an instrument that touches, else at the tip."""
        if not self.capsules or self.base is None or self.pose is None:
            return super().works_at
        return self.pose[:3, :3] @ working_point(self.kinematics, self.capsules) + self.pose[:3, 3]

    # ------------------------------------------------------------------ motion

    def move(self, seconds: float, speed: float, turn_speed: float) -> str:
        """Go on for some seconds towards the goals, or take the pose last commanded, with joints within their limits.

        The tip moves straight, and as slowly as the fastest joint needs. Where the straight way leaves what the joints reach, or asks
        one to leap, the rest of it is a move of the joints.

        Returns:
            What the arm misses of the pose that it is told, in a sentence; empty if nothing.
        """
        self.advancing, self._began = self.moving, None
        if not self.commanded or self.base is None or self.joints is None:
            return super().move(seconds, speed, turn_speed)
        speed, turn_speed, self._seconds = self.speed_ratio * speed, self.speed_ratio * turn_speed, seconds
        self._move_jaw(seconds, turn_speed)
        missing, self._untold = self.settle() or self._untold, ""
        self._began = self.joints
        if self._retreat is not None:
            self._take(self._retreat)
            self.advancing, self._retreat = False, None
        elif self.pose_goal is not None:
            self._move_straight(seconds, speed, turn_speed)
        elif self.joint_goal is not None:
            self._move_joints(seconds, speed, turn_speed)
        before, self._stepped = self._stepped, self.joints
        self.velocities = (self.joints - before) / seconds if before is not None else np.zeros(len(self.joints))
        return missing

    def settle(self) -> str:
        """Find the joints of the pose last commanded or measured; a commanded arm then is where they get.

        Returns:
            What a commanded arm misses, in a sentence; `missing` has that of a measured one.
        """
        if self.pose is None or self.pose is self._posed or self.base is None or self.joints is None:
            return ""
        if not self.commanded and (astray := self._astray(self.pose)):
            self.missing, self._posed = f"{self.name}: {astray}", self.pose
            return ""
        reach = solve_inverse(self.kinematics, invert_pose(self.base) @ self.pose, self.joints)
        short = "" if reach.reached else f"{self.name}: {reach.shortfall()}"
        if self.commanded and short:
            if (np.abs(reach.joints - self.joints) > self._speeds * self._seconds * ROUNDED).any():
                self.pose = self._posed
                return f"{self.name} stays where it is, as it would leap to the nearest pose in reach: {reach.shortfall()}"
            self.pose = self.base @ self.kinematics.tip_pose(reach.joints)
        self.joints, self._posed = reach.joints, self.pose  # as it was told where it is reached, without the rounding of the joints
        if self.commanded:
            return short
        wrong = reach.position_error > _MEASURED_WRONG or reach.rotation_error > _MEASURED_TURNED
        check = f"the robot measures that pose: check {self.name}_base in frames, arm_models and instruments"
        self.missing = f"{short}; {check}" if wrong else ""
        return ""

    def _take(self, joints: np.ndarray) -> np.ndarray:
        """Be at joint positions [n]; returns the pose of the tip there."""
        assert self.base is not None
        self.joints = joints
        self.pose = self._posed = pose = self.base @ self.kinematics.tip_pose(joints)
        return pose

    @property
    def _speeds(self) -> np.ndarray:
        """Largest speeds of the joints [n], rad/s and m/s."""
        return np.where(self.kinematics.prismatic, self.slide_speed, self.joint_speed)

    def _haste(self, joints: np.ndarray, seconds: float) -> float:
        """How many times too fast it is to come from some joint positions to the present ones in some seconds."""
        assert self.joints is not None
        return float(np.max(np.abs(self.joints - joints) / (self.speed_ratio * self._speeds * seconds)))

    def _move_joints(self, seconds: float, speed: float, turn_speed: float) -> None:
        """Go on towards the goal of the joints; on the way to a pose with at most these speeds of the tip, m/s and rad/s, too."""
        before, goal, pose = self.joints, self.joint_goal, self.pose
        assert before is not None and goal is not None and pose is not None
        self.joints = goal
        haste, there = self._haste(before, seconds), False
        for _ in range(_TRIES * _TRIES):
            there = haste <= ROUNDED
            reached = self._take(goal if there else before + (goal - before) / haste)
            too_fast = seconds_between(pose, reached, speed, turn_speed) / seconds if self._to_pose else 0.0
            if too_fast <= ROUNDED:
                break
            haste = max(haste, 1.0) * 1.01 * too_fast  # a little less, as the tip does not follow in proportion
        if there:
            self.joint_goal = None

    def _move_straight(self, seconds: float, speed: float, turn_speed: float) -> None:
        pose, goal, joints, share = self.pose, self.pose_goal, self.joints, 1.0
        assert joints is not None and goal is not None and self.base is not None
        for _ in range(_TRIES):
            self._move_tip(share * seconds, speed, turn_speed)
            left = bool(self.settle())  # what lies between two poses in reach may be out of it
            haste = self._haste(joints, seconds)
            if haste <= ROUNDED and not left:
                return
            self.pose, self._posed, self.pose_goal, self.joints = pose, pose, goal, joints
            if haste > _LEAP or left:
                break
            share /= 1.01 * haste  # a little less, so that it is enough where joints do not follow in proportion
        self.joint_goal, self.pose_goal = solve_inverse(self.kinematics, invert_pose(self.base) @ goal, joints).joints, None
        self._to_pose = True
        self._move_joints(seconds, speed, turn_speed)

    # ------------------------------------------------------------------ states

    def links(self) -> dict[str, np.ndarray]:
        """Poses [4, 4] of the links in the world by name, in the order of `link_poses`; none while they are not known.

        They are found once: the same are returned while neither joints nor jaw have moved. Do not write to them.
        """
        self._untold = self.settle() or self._untold
        if self.base is None or self.joints is None or self.pose is None:
            return {}
        base, joints, gape, links = self._linked
        if base is not self.base or joints is not self.joints or gape != self.gape:
            links = link_poses(self.kinematics, self.joints, self.gape, self.base)
            self._linked = self.base, self.joints, self.gape, links
        return links

    @property
    def gape(self) -> float:
        """Angle at which the jaws stand to each other, rad: closed jaws press, they do not overlap."""
        return float(np.clip(self.angle, 0.0, self.kinematics.jaw[1])) if self.kinematics.jaw else 0.0

    def dynamics(self, force: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the joints and the tip do under a wrench on the tip.

        Args:
            force: Force [3], N, world.
            torque: Torque [3] about the tip, N·m, world.

        Returns:
            Efforts of the joints [n], N·m and N: Jᵀ times the wrench, where a joint bears nothing of what the links before it feel
            (`link_reactions`). Velocity [3], m/s, and angular velocity [3], rad/s, of the tip in the last step, world.
        """
        assert self.base is not None and self.joints is not None
        R = self.base[:3, :3]
        J = self.kinematics.jacobian(self.joints)
        twist = J @ (np.zeros(len(self.joints)) if self.velocities is None else self.velocities)
        efforts = J.T @ np.concatenate([R.T @ force, R.T @ torque])
        for link, (part, turning) in self.link_reactions.items():
            beyond = _JOINTS_OF_LINK.get(link, len(self.joints))
            efforts[beyond:] -= J.T[beyond:] @ np.concatenate([R.T @ part, R.T @ turning])
        return efforts, R @ twist[:3], R @ twist[3:]

    def reset(self) -> None:
        """Let go of everything; a commanded arm is back at its start, unless it is disabled, as it does not move then."""
        if self.commanded and self.state != DISABLED:
            self.return_to_start()
        else:
            super().reset()
