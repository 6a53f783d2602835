"""The arm of the endoscope, which carries the camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.instruments import ReachConfig, solve_inverse
from endo_sim_ros.nodes.jointed_arm import JointedArm
from endo_sim_ros.physics import ControlNodes

_CAMERA_REACH = ReachConfig(radian_length=1e-4)  # the direction of an endoscope follows from its place
_CAMERA_THERE, _CAMERA_TURNED = 1e-4, np.radians(1.0)  # m, rad: nearer is at the pose
_ENDOSCOPE = 6e-3  # m: radius of a 12 mm endoscope


@dataclass(kw_only=True)
class CameraArm(JointedArm):
    """The arm of the endoscope, whose tip is the optical frame of its camera. It touches no tissue."""

    def servo(self, pose: np.ndarray) -> None:
        """Put the camera where a pose [4, 4], world, says. Its direction follows from that; `move` tells how far it is from the pose's.

        Raises:
            ValueError: If it does not get there, or would be upside down; nothing changes then.
        """
        joints, missing = self._aim(pose)
        self.servo_joints(joints)
        self._untold = missing

    def move_to(self, pose: np.ndarray) -> str:
        """Let the camera move, joint by joint, to where a pose [4, 4], world, says.

        Returns how far its direction will be from the pose's, in a sentence, and raises as `servo` does.
        """
        joints, missing = self._aim(pose)
        self.move_joints(joints)
        return missing

    def check_joints(self, joints: ArrayLike, names: Sequence[str] = ()) -> np.ndarray:
        """Joint positions [n] that the arm may take; raises as `servo` does."""
        positions = super().check_joints(joints, names)
        assert self.start is not None
        down, was = (self.kinematics.tip_pose(at)[:3, 1] for at in (positions, self.start))
        self._require_upright(down, was)
        return positions

    def in_tissue(self, nodes: ControlNodes) -> str:
        """That the camera is in the tissue at rest or touches it, in a sentence, as nothing stops it; empty if it is not."""
        near = max(_ENDOSCOPE, nodes.spacing)  # inside the tissue no place is farther from a control node
        if self.pose is None or np.linalg.norm(nodes.rest - self.pose[:3, 3], axis=1).min() >= near:
            return ""
        return f"{self.name} is in the tissue or within {1e3 * near:.0f} mm of it; nothing stops it there, so draw the endoscope back"

    def _aim(self, pose: np.ndarray) -> tuple[np.ndarray, str]:
        """Joints [n] that put the camera at a pose, and how far their direction is from the pose's, in a sentence; empty if it is not."""
        if self.base is None or self.joints is None or self.start is None:
            raise ValueError(f"{self.name} has no place yet; publish a model, or give {self.name}_base in frames")
        self._require_sense(pose)
        wanted = invert_pose(self.base) @ pose
        self._require_upright(wanted[:3, 1], self.kinematics.tip_pose(self.start)[:3, 1])
        reach = solve_inverse(self.kinematics, wanted, self.joints, _CAMERA_REACH)
        if reach.position_error > _CAMERA_THERE:
            raise ValueError(f"{self.name} stays where it is: {reach.shortfall()}")
        if reach.rotation_error < _CAMERA_TURNED:
            return reach.joints, ""
        away = f"{np.degrees(reach.rotation_error):.0f} degrees from that of the pose"
        return reach.joints, f"{self.name}: its direction is {away}; but for the roll it follows from the place"

    def _require_upright(self, down: np.ndarray, was: np.ndarray) -> None:
        if down @ was <= 0:
            raise ValueError(
                f"{self.name} stays where it is: the camera would be upside down; y of its frame must point down as at the start"
            )
