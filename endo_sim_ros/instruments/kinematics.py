"""Forward kinematics of an arm with its tool.

Frames follow the modified DH convention (Craig, Introduction to Robotics, ch. 3): joint i turns about or slides along z of its own
frame. The base frame of an arm stands at its remote centre. Lengths are metres, angles radians.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["JOINTS", "ArmKinematics", "Joint"]

JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
"""Names of the joints of an arm with an instrument."""


@dataclass(frozen=True)
class Joint:
    """One joint, and the way from the frame before it to its own: Rx(alpha) Tx(a) Rz(angle) Tz(shift).

    Args:
        name: Such as ``wrist_pitch``.
        kind: A revolute joint adds its position to ``angle``, a prismatic one to ``shift``.
        alpha, a, angle, shift: Modified DH at position zero, rad and m.
        lower, upper: Limits of the position, rad or m.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    alpha: float
    a: float
    angle: float
    shift: float
    lower: float
    upper: float


@dataclass(frozen=True)
class ArmKinematics:
    """An arm with its tool; `load_arm` reads one from parameter files.

    Args:
        name: Such as ``PSM``.
        tool: Such as ``LARGE_NEEDLE_DRIVER_400006``.
        joints: From the base to the wrist: yaw, pitch, insertion, roll, and for an instrument wrist_pitch, wrist_yaw.
        tooltip_offset: Pose [4, 4] of the tip in the frame of the last joint.
        jaw: Limits of the opening angle of the jaw, rad, or None where there is no jaw.
        coupling: Matrix [4, 4] from the four discs of a tool to roll, wrist_pitch, wrist_yaw and jaw, or None.
    """

    name: str
    tool: str
    joints: tuple[Joint, ...]
    tooltip_offset: np.ndarray
    jaw: tuple[float, float] | None = None
    coupling: np.ndarray | None = None

    @cached_property
    def lower(self) -> np.ndarray:
        """Lower limits of the joints [n], rad or m."""
        return np.array([joint.lower for joint in self.joints])

    @cached_property
    def upper(self) -> np.ndarray:
        """Upper limits of the joints [n], rad or m."""
        return np.array([joint.upper for joint in self.joints])

    @cached_property
    def length(self) -> float:
        """Length of all links in a row, drawn out, m: no pose of the tip is farther from the base."""
        links = sum(np.hypot(joint.a, joint.shift) for joint in self.joints)
        slides = sum(max(abs(joint.lower), abs(joint.upper)) for joint in self.joints if joint.kind == "prismatic")
        return float(links + slides + np.linalg.norm(self.tooltip_offset[:3, 3]))

    @cached_property
    def prismatic(self) -> np.ndarray:
        """Which joints slide [n], bool; the others turn."""
        return np.array([joint.kind == "prismatic" for joint in self.joints])

    def check_joints(self, joints: ArrayLike) -> np.ndarray:
        """Joint positions [..., n] as float64.

        Raises:
            ValueError: If they are not n finite numbers each; limits do not matter here.
        """
        try:
            positions = np.asarray(joints, np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"{self.name}: a joint position must be {len(self.joints)} numbers, got {joints!r:.80}") from None
        names = ", ".join(joint.name for joint in self.joints)
        if positions.ndim == 0 or positions.shape[-1] != len(self.joints):
            given = f"{positions.shape[-1]} numbers" if positions.ndim else "one number"
            raise ValueError(f"{self.name}: {given}, not {len(self.joints)}; the joints are {names}")
        if not np.isfinite(positions).all():
            wrong = self.joints[np.argwhere(~np.isfinite(positions))[0][-1]].name
            raise ValueError(f"{self.name}: {wrong} is not finite; send rad and m ({names})")
        return positions

    def link_frames(self, joints: ArrayLike) -> np.ndarray:
        """Poses [..., n, 4, 4] of the frames of all joints in the base frame, at joint positions [..., n].

        Raises:
            ValueError: As `check_joints` does.
        """
        joints = self.check_joints(joints)
        alpha, a, angle, shift = np.array([(j.alpha, j.a, j.angle, j.shift) for j in self.joints]).T
        angle, shift = angle + np.where(self.prismatic, 0, joints), shift + np.where(self.prismatic, joints, 0)
        ca, sa, c, s = np.cos(alpha), np.sin(alpha), np.cos(angle), np.sin(angle)
        frames = np.zeros((*joints.shape, 4, 4))
        frames[..., 0, 0], frames[..., 0, 1], frames[..., 0, 3] = c, -s, a
        frames[..., 1, 0], frames[..., 1, 1], frames[..., 1, 2], frames[..., 1, 3] = s * ca, c * ca, -sa, -sa * shift
        frames[..., 2, 0], frames[..., 2, 1], frames[..., 2, 2], frames[..., 2, 3] = s * sa, c * sa, ca, ca * shift
        frames[..., 3, 3] = 1
        for i in range(1, len(self.joints)):
            frames[..., i, :, :] = frames[..., i - 1, :, :] @ frames[..., i, :, :]
        return frames

    def tip_pose(self, joints: ArrayLike) -> np.ndarray:
        """Poses [..., 4, 4] of the tip in the base frame, at joint positions [..., n]; raises as `check_joints` does."""
        return self.link_frames(joints)[..., -1, :, :] @ self.tooltip_offset

    def jacobian(self, joints: ArrayLike) -> np.ndarray:
        """Geometric Jacobian [..., 6, n] at joint positions [..., n]; raises as `check_joints` does.

        Times joint speeds it gives the velocity of the tip, m/s, and the angular velocity, rad/s, both in the axes of the base.
        """
        frames = self.link_frames(joints)
        return self._jacobian(frames, (frames[..., -1, :, :] @ self.tooltip_offset)[..., :3, 3])

    def body_jacobian(self, joints: ArrayLike) -> np.ndarray:
        """Geometric Jacobian [..., 6, n] at joint positions [..., n], rad and m, in the frame of the tip; raises as `check_joints` does.

        Times joint speeds, rad/s and m/s, it gives the velocity of the tip, m/s, and the angular velocity, rad/s, both relative to the
        base and in the axes of the tip.
        """
        R = np.swapaxes(self.tip_pose(joints)[..., :3, :3], -1, -2)
        J = self.jacobian(joints)
        return np.concatenate([R @ J[..., :3, :], R @ J[..., 3:, :]], -2)

    def spatial_jacobian(self, joints: ArrayLike) -> np.ndarray:
        """Spatial Jacobian [..., 6, n] at joint positions [..., n], rad and m, in the frame of the base; raises as `check_joints` does.

        Times joint speeds, rad/s and m/s, it gives the velocity, m/s, of the point that moves with the tip and is at the origin of the
        base, and the angular velocity, rad/s, both in the axes of the base.
        """
        J, tip = self.jacobian(joints), self.tip_pose(joints)[..., :3, 3]
        at_origin = J[..., :3, :] + np.cross(tip[..., :, None], J[..., 3:, :], axis=-2)
        return np.concatenate([at_origin, J[..., 3:, :]], -2)

    def _jacobian(self, frames: np.ndarray, tip: np.ndarray) -> np.ndarray:
        axes, origins = frames[..., :3, 2], frames[..., :3, 3]  # [..., n, 3]
        turning = np.concatenate([np.cross(axes, tip[..., None, :] - origins), axes], -1)
        sliding = np.concatenate([axes, np.zeros_like(axes)], -1)
        return np.swapaxes(np.where(self.prismatic[:, None], sliding, turning), -1, -2)

    def joints_of_discs(self, discs: ArrayLike) -> np.ndarray:
        """Roll, wrist_pitch, wrist_yaw and jaw [..., 4] of the angles of the four discs that drive a tool [..., 4], rad.

        Raises:
            ValueError: If the files give no coupling.
        """
        return np.asarray(discs, np.float64) @ self._coupling().T

    def discs_of_joints(self, joints: ArrayLike) -> np.ndarray:
        """Angles of the four discs [..., 4] at roll, wrist_pitch, wrist_yaw and jaw [..., 4], rad; raises as `joints_of_discs` does."""
        return np.asarray(joints, np.float64) @ np.linalg.inv(self._coupling()).T

    def _coupling(self) -> np.ndarray:
        if self.coupling is None:
            raise ValueError(f"{self.tool or self.name}: its parameter file gives no coupling; add coupling.ActuatorToJointPosition")
        return self.coupling


def nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Rotations [..., 3, 3] nearest to matrices that are at most a thousandth off, by Newton's iteration for the polar factor."""
    for _ in range(2):  # 1e-3 off, then 1e-6, then 1e-12
        matrices = matrices @ (3 * np.eye(3) - np.swapaxes(matrices, -1, -2) @ matrices) / 2
    return matrices
