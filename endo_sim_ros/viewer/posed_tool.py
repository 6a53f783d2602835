"""An instrument that is moved by the pose of its tip, where no graph has an arm for it."""

import numpy as np

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.instruments import ArmKinematics, Capsule, Part, Placement, aimed_pose, link_poses, solve_inverse, working_point
from endo_sim_ros.instruments.aiming import AHEAD
from endo_sim_ros.instruments.drawing import InstrumentDrawing, PosedInstruments


class PosedTool:
    """An instrument, open and in front of the tissue until it is moved.

    Args:
        arm: Its arm.
        shape: Its parts and capsules, as `load_shape` gives them.
        place: Where that stands.
        device: Where it is drawn.

    Attributes:
        capsules: What of it touches tissue.
        pose: Pose of the tip [4, 4], world, m.
    """

    def __init__(self, arm: ArmKinematics, shape: tuple[list[Part], list[Capsule]], place: Placement, device: str):
        self._arm, self._base, self._start = arm, place.base, place.joints.copy()
        self._start[2] = max(self._start[2] - AHEAD, arm.lower[2])
        parts, self.capsules = shape
        self._point = working_point(arm, self.capsules)
        self._drawing = InstrumentDrawing([parts], device=device, capsules=[self.capsules])
        self._widest = arm.jaw[1] if arm.jaw else 0.0
        self.return_to_start()

    def return_to_start(self) -> None:
        """Be where it was at first."""
        self._joints, self._closed = self._start, False
        self.pose = self._base @ self._arm.tip_pose(self._joints)

    def aim(self, target: np.ndarray) -> np.ndarray:
        """Pose of the tip [4, 4] with which the tool works at a target [3], m, world."""
        return aimed_pose(self._arm, self._base, target, self._point)

    @property
    def works_at(self) -> np.ndarray:
        """Where the tool works [3], m, world."""
        return self.pose[:3, :3] @ self._point + self.pose[:3, 3]

    def move(self, pose: np.ndarray, closed: bool) -> dict[str, np.ndarray]:
        """Move the tip to a pose [4, 4], m, world, or as near as the joints get; returns the poses [4, 4] of the links by name."""
        self._joints = solve_inverse(self._arm, invert_pose(self._base) @ pose, self._joints).joints
        self.pose, self._closed = self._base @ self._arm.tip_pose(self._joints), closed
        return self.links()

    def links(self) -> dict[str, np.ndarray]:
        """Poses [4, 4] of the links by name, m, world."""
        return link_poses(self._arm, self._joints, 0.0 if self._closed else self._widest, self._base)

    def drawn(self) -> PosedInstruments:
        """What draws it where it is."""
        return self._drawing.at([self.links()])
