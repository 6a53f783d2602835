"""The tool of an arm as a node aims with it that hears no more of the arm than its topics."""

from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, rigid_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import ArmKinematics, aimed_pose, load_arm, working_point
from endo_sim_ros.instruments.urdf import find_base
from endo_sim_ros.instruments.urdf_reader import load_shape
from endo_sim_ros.messages import MessageError

OPEN, CLOSED = 1.0, 0.0  # rad: angles of the jaw of who grasps


class AimedTool:
    """Where the tool of an arm works, and from where it comes. Until both are known it is a bare tip, which works where it is.

    Args:
        arm: Name of the arm.

    Attributes:
        links_touch: Whether its links touch tissue (link_contact of physics_node); else it is a bare tip, too.
    """

    def __init__(self, arm: str) -> None:
        self.arm = arm
        self.links_touch = True
        self._tool: tuple[ArmKinematics, np.ndarray] | None = None  # and what it works with [3], m, in the frame of the tip
        self._radius = 0.0  # of the thickest part of its instrument, m
        self._base: np.ndarray | None = None  # [4, 4], world

    @property
    def known(self) -> bool:
        """Whether it is more than a bare tip."""
        return self.links_touch and self._tool is not None and self._base is not None

    def receive_type(self, message: Any) -> None:
        """Take the tool of the arm; raises MessageError if nobody knows it, and the tool stays what it was."""
        name = messages.decode_text(message)
        try:
            kinematics = load_arm("PSM", name.partition("@")[0])  # all kinds of PSM hold a tool alike
            capsules = load_shape(name)[1]
            self._tool, self._radius = (kinematics, working_point(kinematics, capsules)), max(each.radius for each in capsules)
        except (ConfigError, OSError) as error:
            raise MessageError(f"{messages.tool_type(self.arm).name}: {error}") from error

    def receive_description(self, message: Any) -> None:
        """Take where the arm stands; raises MessageError if that cannot be read."""
        try:
            self._base = find_base(messages.decode_text(message), self.arm)
        except ConfigError as error:
            raise MessageError(f"{messages.ROBOT_DESCRIPTION.name}: {error}") from error

    def pose(self, target: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Pose of the tip [4, 4] with which the tool works at a target [3], m, world; a bare tip has these axes [3, 3]."""
        if self.known and self._tool is not None and self._base is not None:
            return aimed_pose(self._tool[0], self._base, target, self._tool[1])
        return rigid_pose(axes, target)

    def has_way(self, targets: np.ndarray, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """Whether the shaft lies in front of all that a picture shows while the tool works at targets; that of a bare tip does.

        Args:
            targets: Places that `pose` is asked for [N, 3], m, world.
            camera: That of the picture.
            depth: Depth of what it shows [H, W], m, 0 where nothing is. What lies outside is no hindrance, as nobody knows of it.

        Returns:
            One for each target [N], bool.
        """
        if not (self.known and self._tool is not None and self._base is not None):
            return np.ones(len(targets), bool)
        ways = self._base[:3, 3] - targets  # to the remote centre
        lengths = np.linalg.norm(ways, axis=1)
        behind = np.arange(np.linalg.norm(self._tool[1]), self._tool[0].length, self._radius)  # m from the target, the wrist first
        shafts = targets[:, None] + np.minimum(behind / lengths[:, None], 1.0)[..., None] * ways[:, None]  # [N, S, 3]
        pixels, depths = camera.project(shafts.reshape(-1, 3))
        inside = camera.contains(pixels, depths)
        columns, rows = pixels[inside].astype(int).T
        surface = np.full(len(depths), np.inf)
        surface[inside] = np.where(depth[rows, columns] > 0, depth[rows, columns], np.inf)
        return (depths + self._radius <= surface).reshape(shafts.shape[:2]).all(1)

    def works_at(self, pose: np.ndarray) -> np.ndarray:
        """Where the tool works [3], m, world, when its tip is at a pose [4, 4]."""
        point = self._tool[1] if self.known and self._tool is not None else np.zeros(3)
        return pose[:3, :3] @ point + pose[:3, 3]
