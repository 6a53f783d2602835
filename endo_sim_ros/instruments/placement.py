"""Where the bases of the arms, which are their remote centres, stand when nobody has measured that.

As on a da Vinci, PSM1 is the surgeon's right hand: its instrument comes from the right of the picture, that of PSM2 from the left. (The
dVRK's wiki, page SUJ: PSM1 is mounted on the right of the cart, PSM2 on the left; its configurations pair MTMR with PSM1.)
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from endo_sim_ros.core.cameras import Camera, invert_pose, rigid_pose
from endo_sim_ros.core.config import ConfigError, Range, StageConfig
from endo_sim_ros.instruments.inverse import aim_shaft
from endo_sim_ros.instruments.kinematics import ArmKinematics

__all__ = ["Placement", "PlacementConfig", "place_arm"]

_SIDES = {"PSM1": 1.0, "PSM2": -1.0}  # along x of the picture
_LEAST_ANGLE, _ANGLE_STEP = 5.0, 5.0  # degrees between shaft and view


@dataclass(frozen=True)
class PlacementConfig(StageConfig):
    """Where the arms stand around a camera and the tissue that it sees."""

    angle: Annotated[float, Range(10, 80, "degrees")] = 45.0
    """Largest angle between a shaft and the optical axis, about that of ports beside the endoscope's. It is less where the arm would
    not reach the tissue half way to the corners of the picture."""
    below: Annotated[float, Range(-80, 80, "degrees")] = 35.0
    """How far below the horizontal of the picture the shafts come from; 35 is towards the lower corners."""
    insertion: Annotated[float, Range(0.05, 0.95)] = 0.5
    """How far an arm is inserted at the start, as part of the range of its insertion joint."""


@dataclass(frozen=True)
class Placement:
    """Where an arm stands and how it starts.

    Args:
        base: Pose [4, 4] of its base in the world, m.
        joints: Joint positions [n] at the start, rad and m: yaw, pitch, roll and wrist straight.
    """

    base: np.ndarray
    joints: np.ndarray


def place_arm(name: str, arm: ArmKinematics, camera: Camera, depth: float, config: PlacementConfig = PlacementConfig()) -> Placement:
    """A sensible place for an arm in a scene that a camera sees.

    The tip frame of an ECM is the camera at the start. The tip of PSM1 or PSM2 is at the start on the optical axis at the depth of the
    tissue, and its shaft comes into the picture from the lower right or left. It reaches the middle of the picture, and what lies half
    way to the corners at that depth, with a straight wrist. Axes of a base at the start: x to the left of the picture, z against
    the shaft, as those of an ECM.

    Args:
        name: ``PSM1``, ``PSM2`` or ``ECM``.
        arm: The arm with its tool.
        camera: Camera with its pose in the world.
        depth: Depth of the tissue in the middle of the picture, m.
        config: Angles and insertion.

    Raises:
        ConfigError: If no place is known for the name, the depth is not positive, or the arm cannot reach so wide a picture.
    """
    joints = np.zeros(len(arm.joints))
    joints[2] = arm.lower[2] + config.insertion * (arm.upper[2] - arm.lower[2])
    joints = np.clip(joints, arm.lower, arm.upper)
    tip = arm.tip_pose(joints)
    if name == "ECM":
        return Placement(camera.pose @ invert_pose(tip), joints)
    if name not in _SIDES:
        raise ConfigError(f"there is no default place for {name}, only for {', '.join(_SIDES)} and ECM; give its base in frames")
    if not 0 < depth < np.inf:
        raise ConfigError(f"{name}: the depth of the tissue must be positive and finite, got {depth:g} m")
    corners = np.array([(u, v) for u in (0.25, 0.75) for v in (0.25, 0.75)]) * (camera.width, camera.height)
    rays = np.column_stack([(corners - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], np.ones(4)])
    below = np.radians(config.below)
    for angle in np.radians(np.arange(config.angle, _LEAST_ANGLE - 1e-9, -_ANGLE_STEP)):
        outward = np.array([_SIDES[name] * np.cos(below), np.sin(below), 0.0])
        z = np.sin(angle) * outward - np.array([0, 0, np.cos(angle)])  # from the tip to the remote centre
        y = np.cross(z, (-1.0, 0.0, 0.0))
        y /= np.linalg.norm(y)
        R = np.stack([np.cross(y, z), y, z], 1)
        base = rigid_pose(R, (0, 0, depth) - R @ tip[:3, 3])
        if _reaches(arm, joints[2] + tip[2, 3], (depth * rays - base[:3, 3]) @ base[:3, :3]):
            return Placement(camera.pose @ base, joints)
    width = depth * camera.width / camera.K[0, 0]
    raise ConfigError(
        f"{name} ({arm.name}) does not reach half way to the corners of a picture that shows {100 * width:.0f} cm of tissue "
        f"at {100 * depth:.0f} cm; if tissue is nearer, correct the scale of the poses, else give its base in frames"
    )


def _reaches(arm: ArmKinematics, short: float, points: np.ndarray) -> bool:
    """Whether a straight instrument reaches points [N, 3], base frame, if its tip is `short` metres less far than its insertion says."""
    wanted = np.column_stack([*aim_shaft(points), np.linalg.norm(points, axis=1) + short])
    return bool(((wanted >= arm.lower[:3]) & (wanted <= arm.upper[:3])).all())
