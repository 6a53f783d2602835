"""Instruments for the tests of physics: jaws made of two capsules, and those of the da Vinci at a pose."""

import numpy as np

from endo_sim_ros.instruments import Capsule, build_instrument, link_poses, load_arm

LENGTH, HALF = 0.01, 0.0005  # of a plain jaw, m, and its distance from the plane between the two


def plain_jaws(radius: float = 0.001, length: float = LENGTH) -> list[Capsule]:
    """Two jaws along x of their links, which close along y."""
    return [
        Capsule(link, np.array([0.0, y, 0.0]), np.array([length, y, 0.0]), radius) for link, y in (("jaw_left", HALF), ("jaw_right", -HALF))
    ]


def opened(pose: np.ndarray, angle: float) -> dict[str, np.ndarray]:
    """Poses of the links of plain jaws at an angle, whose hinge and plane are those of a pose; they turn about its z axis."""
    poses = {}
    for link, side in (("jaw_left", 0.5), ("jaw_right", -0.5)):
        c, s = np.cos(side * angle), np.sin(side * angle)
        turn = np.eye(4)
        turn[:2, :2] = [[c, -s], [s, c]]
        poses[link] = pose @ turn
    return poses


class Instrument:
    """A tool of the da Vinci whose tip is where it is told, for tests that need all its links."""

    def __init__(self, tool: str = "LARGE_NEEDLE_DRIVER"):
        self._arm = load_arm("PSM", tool)
        self.capsules = build_instrument(self._arm)[1]
        self._joints = np.array([0.0, 0.0, 0.12, 0.0, 0.0, 0.0])

    def at(self, hinge, tilt: float = 0.0, jaw: float = 0.0) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Pose of the tip and of the links with the hinge of the jaws at a point and the shaft tilted from z towards x, rad."""
        tip = self._arm.tip_pose(self._joints)
        c, s = np.cos(tilt), np.sin(tilt)
        base = np.eye(4)
        base[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ tip[:3, :3].T
        base[:3, 3] = np.asarray(hinge) - base[:3, :3] @ tip[:3, 3]
        return base @ tip, {name: base @ pose for name, pose in link_poses(self._arm, self._joints, jaw).items()}
