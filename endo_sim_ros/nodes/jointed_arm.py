"""An arm with joints and an instrument: where its links are when its tip is at a pose, and how it gets to where it is told."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import ArmKinematics, link_poses, load_arm, place_arm, solve_inverse
from endo_sim_ros.nodes.arm import Arm

NO_INSTRUMENT = "none"
_WITHDRAWN = 0.02  # m: at the start the jaws, 1 to 2 cm long, are in front of the tissue, and two instruments do not meet


@dataclass(kw_only=True)
class JointedArm(Arm):
    """An arm with a base, joints and an instrument.

    Until it has a base it is as an arm without joints: nobody knows what it reaches.

    Args:
        kinematics: The arm with its tool.
        tool_type: What loads the tool: its name and number, or the path of its file.
        commanded: Whether it has no robot, so that it is where its joints get to.
    """

    kinematics: ArmKinematics = field()
    tool_type: str = ""
    commanded: bool = True
    base: np.ndarray | None = None  # [4, 4], world
    joints: np.ndarray | None = None  # [n] rad and m
    _start: np.ndarray | None = None  # [n] joints when nobody has commanded anything
    _followed: np.ndarray | None = None  # [4, 4] pose that the joints of a robot's arm were found for

    def stand(self, base: np.ndarray, joints: np.ndarray) -> None:
        """Stand at a base [4, 4], world; a commanded arm with its joints at positions [n], waiting for a command."""
        self.base, self._start, self._followed = base, joints, None
        if self.commanded:
            self._return()
        else:
            self.joints = joints

    def _return(self) -> None:
        """Back to the start; there the arm touches nothing until it is commanded."""
        if self._start is not None and self.base is not None:
            self.stop()
            self.joints, self.pose, self.acts = self._start, self.base @ self.kinematics.tip_pose(self._start), False

    def reach(self, pose: np.ndarray) -> str:
        """Put the tip at a pose [4, 4], world, or as near to it as the joints allow; returns what is missing, in a sentence."""
        if not self.commanded or self.base is None or self.joints is None:
            return super().reach(pose)
        reach = solve_inverse(self.kinematics, invert_pose(self.base) @ pose, self.joints)
        self.joints = reach.joints
        if reach.reached:
            return super().reach(pose)  # exactly, without the rounding of the joints
        super().reach(self.base @ self.kinematics.tip_pose(self.joints))
        return f"{self.name}: {reach.shortfall()}"

    def links(self) -> list[np.ndarray]:
        """Poses [4, 4] of the links in the world, in the order of `link_poses`; none while they are not known."""
        if self.base is None or self.joints is None or self.pose is None or len(self.kinematics.joints) < 6:
            return []
        if not self.commanded and self._followed is not self.pose:
            self.joints = solve_inverse(self.kinematics, invert_pose(self.base) @ self.pose, self.joints).joints
            self._followed = self.pose
        widest = self.kinematics.jaw[1] if self.kinematics.jaw else 0.0
        poses = link_poses(self.kinematics, self.joints, np.clip(self.angle, 0.0, widest))  # closed jaws press, they do not overlap
        return [self.base @ pose for pose in poses.values()]

    def reset(self) -> None:
        """Let go of everything; a commanded arm is back at its start."""
        super().reset()
        if self.commanded:
            self._return()


def make_arms(names: Sequence[str], instruments: Sequence[str], models: Sequence[str], commanded: bool) -> dict[str, Arm]:
    """The arms by name.

    Args:
        names: Their names.
        instruments: Tool of each as `load_arm` takes it, or of all; ``none`` makes an arm that is only a tip.
        models: Arm of each as `load_arm` takes it, or of all.
        commanded: Whether they have no robots.

    Raises:
        ConfigError: If there are neither one nor as many instruments and models as arms, or one cannot be loaded.
    """
    arms: dict[str, Arm] = {}
    for name, tool, model in zip(names, _for_each("instruments", instruments, names), _for_each("arm_models", models, names)):
        if tool == NO_INSTRUMENT:
            arms[name] = Arm(name)
            continue
        kinematics = load_arm(model, tool)
        if len(kinematics.joints) < 6:
            raise ConfigError(f"instruments: {name} has {kinematics.tool or model}, which is no instrument; give one, or {NO_INSTRUMENT}")
        kind, _, number = kinematics.tool.rpartition("_")
        tool_type = str(Path(tool).resolve()) if tool.endswith(".json") else f"{kind}:{number}"
        arms[name] = JointedArm(name, kinematics=kinematics, tool_type=tool_type, commanded=commanded)
    return arms


def _for_each(option: str, values: Sequence[str], names: Sequence[str]) -> Sequence[str]:
    values = [value.strip() for value in values]
    if len(values) not in (1, len(names)):
        raise ConfigError(
            f"{option}: there are {len(values)} for {len(names)} arms; give one for all, or one for each in the order of arms"
        )
    return values * len(names) if len(values) == 1 else values


def place_arms(arms: Mapping[str, Arm], frames: Mapping[str, np.ndarray], view: tuple[Camera, float] | None) -> str:
    """Give each arm with joints a place: its base in `frames`, or else a sensible one in front of a camera.

    Args:
        arms: The arms by name.
        frames: Poses [4, 4] of known frames in the world, by name; ``PSM1_base`` is the base of PSM1.
        view: A camera and the depth of the tissue that it sees, m, or None where neither is known.

    Returns:
        Why arms have no place, in a sentence; empty if all have one. Such an arm is a tip without joints.
    """
    missing = []
    for name, arm in arms.items():
        if not isinstance(arm, JointedArm):
            continue
        kinematics, short = arm.kinematics, name.rpartition("/")[2]
        lower, upper = kinematics.lower[2], kinematics.upper[2]
        try:
            if f"{name}_base" in frames:
                base, joints = frames[f"{name}_base"], np.clip(np.zeros(len(kinematics.joints)), kinematics.lower, kinematics.upper)
                joints[2] = 0.5 * (lower + upper)
            elif view is None:
                raise ConfigError(f"{name}: no camera shows where the tissue is; give its base in frames")
            else:
                placement = place_arm(short, kinematics, *view)
                base, joints = placement.base, placement.joints.copy()
            joints[2] = np.clip(joints[2] - _WITHDRAWN, lower, upper)
            arm.stand(base, joints)
        except ConfigError as error:
            missing.append(str(error))
    return "; ".join(missing)
