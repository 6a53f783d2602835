"""Rigid poses, and the frames in which they are given."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from endo_sim_ros.core.cameras import matrix_to_quat, quat_to_matrix
from endo_sim_ros.messages.headers import check_frame, make_header
from endo_sim_ros.messages.topics import TRAINING_CAMERAS
from endo_sim_ros.messages.types import Message, MessageError, MessageTypes, ros_types

__all__ = ["VIEW_IN_CAMERA", "decode_pose", "decode_poses", "decode_tip", "encode_pose", "encode_poses"]

VIEW_IN_CAMERA = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Pose of `ECM_VIEW` in the optical frame of the camera: x to the left and y up in the picture."""


def _decode_poses(poses: Sequence[Message], topic: str) -> np.ndarray:
    """Poses [N, 4, 4] of geometry_msgs/Pose, all at once."""
    numbers = [(p.x, p.y, p.z, q.w, q.x, q.y, q.z) for p, q in ((pose.position, pose.orientation) for pose in poses)]
    placed = np.array(numbers, np.float64).reshape(-1, 7)
    for values in placed[~np.isfinite(placed).all(1)]:
        raise MessageError(f"{topic}: the pose is not finite (position {values[:3]}, quaternion wxyz {values[3:]})")
    lengths = np.linalg.norm(placed[:, 3:], axis=1)
    for length in lengths[np.abs(lengths - 1) > 0.01]:
        raise MessageError(f"{topic}: the orientation's quaternion has length {length:.3g}, not 1; normalise it before publishing")
    found = np.zeros((len(placed), 4, 4))
    found[:, :3, :3], found[:, :3, 3], found[:, 3, 3] = quat_to_matrix(placed[:, 3:]), placed[:, :3], 1
    return found


def decode_pose(message: Message, frames: str | Mapping[str, np.ndarray], topic: str) -> np.ndarray:
    """Pose [4, 4] of a PoseStamped, metres, in the world.

    Args:
        message: The message.
        frames: Name of the world frame, or the poses [4, 4] of known frames in the world, by name.
        topic: For errors.

    Raises:
        MessageError: If the frame is unknown, a number is not finite, or the quaternion's length is not 1 within 1 %.
    """
    frame = check_frame(message, (frames,) if isinstance(frames, str) else frames, topic)
    (pose,) = _decode_poses([message.pose], topic)
    return pose if isinstance(frames, str) else frames[frame] @ pose


def decode_tip(message: Message, frames: Mapping[str, np.ndarray], arm: str, topic: str) -> np.ndarray:
    """Pose [4, 4] of an arm's tip from a PoseStamped that is measured, metres, in the world.

    Clients of CRTK leave the frame empty. It is the arm's base then, ``PSM1_base`` for PSM1, or the world if that is unknown.

    Args:
        message: The message.
        frames: Poses [4, 4] of known frames in the world, by name.
        arm: Name of the arm.
        topic: For errors.

    Raises:
        MessageError: As from `decode_pose`.
    """
    return decode_pose(message, {**frames, "": frames.get(f"{arm}_base", np.eye(4))}, topic)


def decode_poses(message: Message, topic: str = TRAINING_CAMERAS.name) -> np.ndarray:
    """Poses [V, 4, 4] of a PoseArray, metres, in the frame of its header.

    Raises:
        MessageError: If a number is not finite, or a quaternion's length is not 1 within 1 %.
    """
    return _decode_poses(message.poses, topic)


def _encode_poses(types: MessageTypes, poses: np.ndarray) -> list[Message]:
    """Poses of rigid transforms [N, 4, 4], whose quaternions are found all at once."""
    placed = zip(poses[:, :3, 3].tolist(), matrix_to_quat(poses[:, :3, :3]).tolist())
    return [
        types.Pose(position=types.Point(x=px, y=py, z=pz), orientation=types.Quaternion(x=x, y=y, z=z, w=w))
        for (px, py, pz), (w, x, y, z) in placed
    ]


def encode_pose(pose: np.ndarray, stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """PoseStamped of a rigid transform [4, 4], metres."""
    return types.PoseStamped(
        header=make_header(types, stamp_ns, frame_id), pose=_encode_poses(types, np.asarray(pose, np.float64)[None])[0]
    )


def encode_poses(poses: Iterable[np.ndarray], stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """PoseArray of rigid transforms [4, 4], metres."""
    stacked = np.array([*poses], np.float64).reshape(-1, 4, 4)
    return types.PoseArray(header=make_header(types, stamp_ns, frame_id), poses=_encode_poses(types, stacked))
