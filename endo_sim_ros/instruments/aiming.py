"""Where an instrument works, and how it gets there: whoever aims at tissue aims with the place between the jaws, not with their hinge."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.instruments.inverse import aim_shaft
from endo_sim_ros.instruments.kinematics import ArmKinematics
from endo_sim_ros.instruments.shapes import LINKS, Capsule

__all__ = ["GRIP", "aimed_pose", "working_point"]

GRIP = 0.85
"""Where on the jaws tissue is gripped, from their hinge, 0, to their points, 1: with what lies before the points, not at them."""

AHEAD = 0.02
"""How far in front of the tissue tools wait at the start, come from, straight ahead, and go back to, m."""


def working_point(arm: ArmKinematics, capsules: Sequence[Capsule], share: float = GRIP) -> np.ndarray:
    """Where a tool works [3], m, in the frame of the tip: between its jaws, or at the point of a tool that has none, such as a hook.

    Args:
        arm: The arm with its tool.
        capsules: Those of its instrument, as `build_instrument` gives them.
        share: Where on the jaws, from their hinge, 0, to their points, 1.
    """
    jaws = [[each for each in capsules if each.link == link] for link in LINKS[3:]]
    if all(jaws):
        hinge, points = (0.5 * sum(ends) for ends in ([jaw[0].start for jaw in jaws], [jaw[-1].end for jaw in jaws]))
        place = hinge + share * (points - hinge)
    else:
        place = capsules[-1].end
    return (invert_pose(arm.tooltip_offset) @ np.append(place, 1.0))[:3]


def aimed_pose(arm: ArmKinematics, base: np.ndarray, target: ArrayLike, point: ArrayLike) -> np.ndarray:
    """Pose of the tip [4, 4], world, with which a tool works at a target: straight from the remote centre, with roll and wrist at zero.

    Args:
        arm: The arm with its tool.
        base: Pose [4, 4] of its base, which stands at the remote centre, in the world, m.
        target: What it aims at [3], m, world.
        point: What it aims with [3], m, in the frame of the tip, as `working_point` gives it.
    """
    target = np.asarray(target, np.float64)
    joints = np.clip(np.zeros(len(arm.joints)), arm.lower, arm.upper)
    joints[:2] = np.concatenate(aim_shaft((invert_pose(base) @ np.append(target, 1.0))[None, :3]))
    pose = base @ arm.tip_pose(joints)
    pose[:3, 3] = target - pose[:3, :3] @ np.asarray(point, np.float64)
    return pose
