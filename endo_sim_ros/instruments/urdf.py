"""Arms as a robot description (URDF), for RViz and robot_state_publisher."""

from collections.abc import Mapping, Sequence
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments.kinematics import ArmKinematics
from endo_sim_ros.instruments.shapes import Capsule, build_instrument

_ENDOSCOPE = (6e-3, 0.3)  # m: radius of a 12 mm endoscope, and how much of it is drawn
_EFFORT, _TURNS, _SLIDES = "10", "10", "1"  # URDF asks for limits of effort (N·m, N) and speed (rad/s, m/s); nothing here reads them
_NOWHERE = np.eye(4)


def arm_capsules(arm: ArmKinematics) -> list[Capsule]:
    """The shape of an arm's tool as capsules: of an instrument as in `build_instrument`, none if nobody knows it; of an endoscope a rod."""
    if len(arm.joints) == 4:
        radius, length = _ENDOSCOPE
        return [Capsule("roll", np.array([0.0, 0, -length]), np.zeros(3), radius)]
    try:
        return build_instrument(arm)[1]
    except ConfigError:
        return []  # it has joints all the same


def robot_description(
    arms: Mapping[str, tuple[ArmKinematics, np.ndarray, Sequence[Capsule]]], world: str = "world", name: str = "endo_sim"
) -> str:
    """One URDF of arms that stand in the world.

    Links and joints are named ``PSM1_yaw`` and so on; ``PSM1_base`` is the base and ``PSM1_tip`` the tip. The joint ``PSM1_jaw`` is the
    angle between the jaws, each of which mimics half of it.

    Args:
        arms: Each arm with its tool, the pose [4, 4] of its base in the world, and its shape, drawn as cylinders, by name.
        world: Name of the root link.
        name: Name of the robot.
    """
    robot = ElementTree.Element("robot", name=name)
    ElementTree.SubElement(robot, "link", name=world)
    for arm, (kinematics, base, capsules) in arms.items():
        _add_arm(robot, world, arm.replace("/", "_"), kinematics, base, capsules)
    return ElementTree.tostring(robot, encoding="unicode")


def find_base(description: str, arm: str) -> np.ndarray | None:
    """Pose [4, 4] of the base of an arm in the world, m, from what `robot_description` gave; None if the arm is not in it.

    Args:
        description: The URDF.
        arm: Name of the arm.

    Raises:
        ConfigError: If it is no URDF.
    """
    try:
        robot = ElementTree.fromstring(description)
        joint = robot.find(f"joint[@name='{arm.replace('/', '_')}_base']")
        return None if joint is None or joint.find("origin") is None else read_origin(joint)
    except (ElementTree.ParseError, ValueError) as error:
        raise ConfigError(f"the robot description cannot be read: {error}") from error


def read_origin(element: ElementTree.Element) -> np.ndarray:
    """Pose [4, 4] that the origin of an element says, m; raises ValueError if that is not made of finite numbers."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    turn = Rotation.from_euler("xyz", read_numbers(origin.get("rpy", "0 0 0"), 3))
    return rigid_pose(turn.as_matrix(), read_numbers(origin.get("xyz", "0 0 0"), 3))


def read_numbers(text: str, count: int) -> np.ndarray:
    """So many finite numbers of a text; raises ValueError if it has others."""
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"expected {count} finite {'number' if count == 1 else 'numbers'}, got {text!r:.60}")
    return values


def _add_arm(
    robot: ElementTree.Element, world: str, arm: str, kinematics: ArmKinematics, base: np.ndarray, capsules: Sequence[Capsule]
) -> None:
    # The shapes' names of the frames of the wrist; parameter files may name them otherwise.
    link_of: dict[str, str] = dict(zip(("roll", "wrist_pitch", "wrist_yaw"), (joint.name for joint in kinematics.joints[3:])))

    def link(part: str) -> None:
        element = ElementTree.SubElement(robot, "link", name=f"{arm}_{part}")
        for capsule in capsules:
            if link_of.get(capsule.link, capsule.link) == part:
                _add_cylinder(element, capsule)

    def joint(part: str, kind: str, parent: str, pose: np.ndarray) -> ElementTree.Element:
        element = ElementTree.SubElement(robot, "joint", name=f"{arm}_{part}", type=kind)
        ElementTree.SubElement(element, "parent", link=parent)
        ElementTree.SubElement(element, "child", link=f"{arm}_{part}")
        ElementTree.SubElement(element, "origin", _origin(pose))
        return element

    def limits(element: ElementTree.Element, lower: float, upper: float, speed: str) -> None:
        ElementTree.SubElement(element, "axis", xyz="0 0 1")
        ElementTree.SubElement(element, "limit", lower=f"{lower:.9g}", upper=f"{upper:.9g}", effort=_EFFORT, velocity=speed)

    link("base")
    joint("base", "fixed", world, base)
    frames, parent, before = kinematics.link_frames(np.zeros(len(kinematics.joints))), f"{arm}_base", _NOWHERE
    for each, frame in zip(kinematics.joints, frames):
        link(each.name)
        element = joint(each.name, each.kind, parent, np.linalg.inv(before) @ frame)
        limits(element, each.lower, each.upper, _TURNS if each.kind == "revolute" else _SLIDES)
        parent, before = f"{arm}_{each.name}", frame
    link("tip")
    joint("tip", "fixed", parent, kinematics.tooltip_offset)
    if kinematics.jaw is not None:
        link("jaw")
        limits(joint("jaw", "revolute", parent, _NOWHERE), *kinematics.jaw, _TURNS)
        for part, side in (("jaw_left", -0.5), ("jaw_right", 0.5)):
            link(part)
            element = joint(part, "revolute", parent, _NOWHERE)
            half = 0.5 * max(map(abs, kinematics.jaw))
            limits(element, -half, half, _TURNS)
            ElementTree.SubElement(element, "mimic", joint=f"{arm}_jaw", multiplier=f"{side}")


def _add_cylinder(element: ElementTree.Element, capsule: Capsule) -> None:
    way = capsule.end - capsule.start
    length = float(np.linalg.norm(way))
    turn = Rotation.align_vectors([way / length], [[0.0, 0, 1]])[0] if length > 0 else Rotation.identity()
    pose = rigid_pose(turn.as_matrix(), 0.5 * (capsule.start + capsule.end))
    visual = ElementTree.SubElement(element, "visual")
    ElementTree.SubElement(visual, "origin", _origin(pose))
    geometry = ElementTree.SubElement(visual, "geometry")
    ElementTree.SubElement(geometry, "cylinder", radius=f"{capsule.radius:.6g}", length=f"{length:.6g}")


def _origin(pose: np.ndarray) -> dict[str, str]:
    """Attributes of an origin: position, m, and angles about the fixed axes x, y, z, rad."""
    R = pose[:3, :3]
    level = np.hypot(R[0, 0], R[1, 0])
    pitch = np.arctan2(-R[2, 0], level)
    if level > 1e-9:
        roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    else:  # roll and yaw turn about one axis
        roll, yaw = np.arctan2(-R[1, 2], R[1, 1]), 0.0
    text = lambda values: " ".join(f"{value:.12g}" for value in values)  # noqa: E731
    return {"xyz": text(pose[:3, 3]), "rpy": text((roll, pitch, yaw))}
