"""The arms of physics_node from its options, and where they stand."""

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import Capsule, build_instrument, link_poses, load_arm, place_arm
from endo_sim_ros.instruments.aiming import AHEAD
from endo_sim_ros.instruments.overlap import Posed, overlap
from endo_sim_ros.instruments.urdf_reader import read_urdf
from endo_sim_ros.nodes.arm import Arm
from endo_sim_ros.nodes.camera_arm import CameraArm
from endo_sim_ros.nodes.configs import PhysicsNodeConfig, arm_names
from endo_sim_ros.nodes.jointed_arm import JointedArm
from endo_sim_ros.physics.simulation import MAX_TOOLS

CAMERA_ARM = "ECM"
_OF_CAMERA = {"PSM": "ECM", "PSM_Si": "ECM_Si"}  # which one goes with the instruments' arms where there is one model for all
_NO_INSTRUMENT = "none"
_BACK, _TRIES = 0.005, 10  # m by which instruments that are too near to each other are drawn back at once, and how often
_CLEAR = 0.005  # m that two instruments are apart at their start, so that neither seems to touch the other in a picture


def make_arms(options: PhysicsNodeConfig) -> dict[str, Arm]:
    """The arms by name.

    Raises:
        ConfigError: If there are too many arms, or neither one nor as many instruments and models, one cannot be loaded or is no
            instrument, nobody knows the shape of one whose links shall touch, or the ECM shall be that of a robot.
    """
    names = arm_names(options.arms)
    if (count := sum(name != CAMERA_ARM for name in names)) > MAX_TOOLS:
        raise ConfigError(f"arms: there are {count} for tools; tissue takes up to {MAX_TOOLS}, beside {CAMERA_ARM}")
    arms: dict[str, Arm] = {}
    capsules: dict[str, list[Capsule]] = {}  # of shapes that are not ours
    commanded = options.arm_source == "commanded"
    tools, models = _for_each("instruments", options.instruments, names), _for_each("arm_models", options.arm_models, names)
    for name, tool, model in zip(names, tools, models):
        if name == CAMERA_ARM:
            if not commanded:
                raise ConfigError(f"arms: {name} needs arm_source commanded; the pose of a robot's is heard on {name}/measured_cp anyway")
            tool = tool if len(options.instruments) > 1 else ""  # the one for all is an instrument
            model = _OF_CAMERA.get(model, model) if len(options.arm_models) == 1 else model
            arms[name] = CameraArm(name, kinematics=load_arm(model, tool))
        elif tool == _NO_INSTRUMENT:
            arms[name] = Arm(name)
        else:
            tool, _, description = tool.partition("@")
            if not tool:
                raise ConfigError(f"instruments: that of {name} has no name; give one, or {_NO_INSTRUMENT}")
            try:
                kinematics = load_arm(model, tool)
            except ConfigError as error:
                raise ConfigError(f"instruments or arm_models of {name}: {error}") from error
            kind, _, number = kinematics.tool.rpartition("_")
            tool_type = str(Path(tool).resolve()) if tool.endswith(".json") else f"{kind}:{number}"
            if description:
                capsules[name] = read_urdf(description, kinematics)[1]
                tool_type += f"@{Path(description).resolve()}"
            arms[name] = JointedArm(name, kinematics=kinematics, tool_type=tool_type, commanded=commanded)
        arm = arms[name]
        if isinstance(arm, JointedArm) and (len(arm.kinematics.joints) == 4) != (name == CAMERA_ARM):
            wrong = f"{arm.kinematics.name} with {arm.kinematics.tool or 'no tool'}"
            raise ConfigError(f"arms: {name} cannot be {wrong}; {CAMERA_ARM} takes an endoscope, every other arm an instrument")
        if isinstance(arm, JointedArm) and name != CAMERA_ARM and options.link_contact:
            arm.capsules = capsules[name] if name in capsules else build_instrument(arm.kinematics)[1]
    return arms


def _for_each(option: str, values: Sequence[str], names: Sequence[str]) -> Sequence[str]:
    values = [value.strip() for value in values]
    if len(values) not in (1, len(names)):
        number = f"{len(names)} arms" if len(names) > 1 else "1 arm"
        raise ConfigError(f"{option}: there are {len(values)} for {number}; give one for all, or one for each in the order of arms")
    return values * len(names) if len(values) == 1 else values


def place_arms(
    arms: Mapping[str, Arm],
    frames: Mapping[str, np.ndarray],
    view: tuple[Camera, float] | None,
    anew: bool = False,
    kept: Collection[str] = (),
) -> str:
    """Give each arm with joints a place: its base in `frames`, or else a sensible one in front of a camera.

    An arm whose place changes is at its start then.

    Args:
        arms: The arms by name.
        frames: Poses [4, 4] of known frames in the world, by name; ``PSM1_base`` is the base of PSM1.
        view: A camera and the depth of the tissue that it sees, m, or None where neither is known.
        anew: Whether an arm that is in its place already goes to its start, too.
        kept: Names of arms that stay as they are if they are not in `frames`.

    Returns:
        Why arms have no place, or hardly the right one, in a sentence; empty if all have one. An arm without is a tip without joints.
    """
    missing, placed = [], []
    asking = [name for name, arm in reversed([*arms.items()]) if isinstance(arm, JointedArm) and f"{name}_base" not in frames]
    places = {name.rpartition("/")[2]: name for name in sorted(asking, key=lambda name: -name.count("/"))}  # PSM1 before left/PSM1
    for name, arm in arms.items():
        if not isinstance(arm, JointedArm) or name in kept and name in asking:
            continue
        kinematics, short = arm.kinematics, name.rpartition("/")[2]
        lower, upper = kinematics.lower, kinematics.upper
        try:
            if f"{name}_base" in frames:
                base, joints = frames[f"{name}_base"], np.clip(np.zeros(len(lower)), lower, upper)
                joints[2] = 0.5 * (lower[2] + upper[2])
                away = 0.0 if view is None else math.dist(base[:3, 3], view[0].pose[:3, 3])
                if view is not None and away > 2 * kinematics.length + view[1]:
                    size = f"the whole arm is {kinematics.length:.2g} m long"
                    missing.append(f"{name}_base in frames is {away:.3g} m from the camera, and {size}; is it in metres?")
            elif view is None:
                raise ConfigError(f"{name}: no camera shows where the tissue is; give {name}_base in frames")
            elif places[short] != name or (short == CAMERA_ARM) != isinstance(arm, CameraArm):
                other = places[short] if places[short] != name else "a camera"
                raise ConfigError(f"{name}: the place of {short} in front of a camera is that of {other}; give {name}_base in frames")
            else:
                placement = place_arm(short, kinematics, *view)
                base, joints = placement.base, placement.joints.copy()
            if not isinstance(arm, CameraArm):  # its jaws are in front of the tissue then
                joints[2] = np.clip(joints[2] - AHEAD, lower[2], upper[2])
            placed.append((arm, base, joints))
        except ConfigError as error:
            missing.append(str(error))
    _part([each for each in placed if each[0].name in asking and not isinstance(each[0], CameraArm)])
    for arm, base, joints in placed:
        if anew or arm.base is None or not np.array_equal(arm.base, base):
            arm.stand(base, joints)
    return "; ".join(missing)


def _part(placed: Sequence[tuple[JointedArm, np.ndarray, np.ndarray]]) -> None:
    """Draw instruments at their start back until all are clear of each other: long jaws that are open reach far to the side.

    Args:
        placed: Arms, their bases [4, 4], world, and their joints [n], which change.
    """
    shapes = {arm.name: build_instrument(arm.kinematics)[1] for arm, *_ in placed} if len(placed) > 1 else {}

    def posed(arm: JointedArm, base: np.ndarray, joints: np.ndarray) -> Posed:
        return shapes[arm.name], link_poses(arm.kinematics, joints, arm.angle_at_start, base)

    for one, other in combinations(placed, 2):
        for _ in range(_TRIES):
            if not overlap(posed(*one), posed(*other), _CLEAR):
                break
            for arm, _, joints in (one, other):
                joints[2] = max(joints[2] - _BACK, arm.kinematics.lower[2])
