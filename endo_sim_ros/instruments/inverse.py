"""Inverse kinematics through the remote centre: joint positions that put the tip at a pose.

The shaft always passes through the remote centre, the origin of the base. With the wrist's two axes a length a apart, the origin p of
the last frame is s d + a x, where d is the direction of the shaft, s how far the wrist pitch axis is inserted, and x points from that
axis to the wrist yaw axis. The wrist pitch axis is perpendicular to d, to x and to the wrist yaw axis z, so that it is ±(p × z). Each
sign gives x, then s d = p - a x with either sign of s, then yaw and pitch of d, insertion, and the angles of the wrist.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.core.config import Range, StageConfig
from endo_sim_ros.instruments.kinematics import ArmKinematics, nearest_rotations

__all__ = ["Reach", "ReachConfig", "solve_inverse"]

_REACHED = 1e-8  # m, rad: errors below come from rounding
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]  # axes of a cross product
_UNDECIDED = 1e-9  # m: shorter vectors have no direction
_WITHIN = 1e-9  # rad, m: how far rounding may leave the limits
_STILL = 1e-6  # rad, m, or part of the squared distance: the search ends when a step brings no more


@dataclass(frozen=True)
class ReachConfig(StageConfig):
    """What counts as near where a pose is out of reach."""

    radian_length: Annotated[float, Range(1e-4, 1, "m")] = 0.01
    """Distance that is as bad as a rotation by one radian. One centimetre, about the length of a jaw, lets the tip give way little and
    the direction of the jaw much."""
    iterations: Annotated[int, Range(1, 1000)] = 100
    """Most steps of the search for the nearest pose in reach; most poses need 20."""


@dataclass(frozen=True)
class Reach:
    """Where an arm gets to when it is to put its tip at some poses.

    Args:
        arm: The arm.
        joints: Joint positions [..., n] within the limits, rad and m.
        position_error: Distance [...] from the tip to where it should be, m.
        rotation_error: Angle [...] between the axes of the tip and those it should have, rad.
    """

    arm: ArmKinematics
    joints: np.ndarray
    position_error: np.ndarray
    rotation_error: np.ndarray

    @property
    def reached(self) -> np.ndarray:
        """Whether the tip gets to the pose [...], bool."""
        return (self.position_error < _REACHED) & (self.rotation_error < _REACHED)

    def shortfall(self, index: tuple[int, ...] | int = ()) -> str:
        """A sentence that tells what one of the poses misses and which joints are at their limit; empty where it is reached."""
        if self.reached[index]:
            return ""
        stuck = []
        for joint, value in zip(self.arm.joints, self.joints[index]):
            shown = f"{1e3 * value:.0f} mm" if joint.kind == "prismatic" else f"{np.degrees(value):.0f} degrees"
            if min(value - joint.lower, joint.upper - value) < _STILL:
                stuck.append(f"{joint.name} at its limit of {shown}")
        missing = f"{1e3 * self.position_error[index]:.1f} mm and {np.degrees(self.rotation_error[index]):.1f} degrees"
        return f"{self.arm.name} stops {missing} from the pose, with {' and '.join(stuck) or 'no joint at its limit'}"


def solve_inverse(arm: ArmKinematics, poses: ArrayLike, present: ArrayLike | None = None, config: ReachConfig = ReachConfig()) -> Reach:
    """Joint positions within the limits that put the tip at poses in the base frame.

    In closed form where a pose is in reach. Of several joint positions the one nearest to the present one (in rad and m) is taken.
    Otherwise a damped Gauss-Newton search within the limits gives the nearest pose: least squared distance, plus squared angle times
    the square of ``radian_length``. Where a pose leaves a joint free, that keeps its present position as far as it can: the shaft's
    direction when the wrist lies in the remote centre, the roll when the wrist yaw axis points through it.

    Args:
        arm: The arm with its tool.
        poses: Poses of the tip [..., 4, 4] in the base frame, m.
        present: Joint positions [n] or [..., n] to stay near to; None takes zero.
        config: What counts as near.

    Raises:
        ValueError: If a pose is not finite or no rotation and position, or the present joint positions are not n finite numbers.
    """
    poses = _check_poses(arm, poses)
    batch, count = poses.shape[:-2], len(arm.joints)
    present = np.zeros(count) if present is None else arm.check_joints(present)
    try:
        present = np.broadcast_to(present, (*batch, count))
    except ValueError:
        raise ValueError(f"{arm.name}: present joint positions {present.shape} do not fit poses {poses.shape}") from None
    target, present = poses.reshape(-1, 4, 4), np.clip(present.reshape(-1, count), arm.lower, arm.upper)

    found = _closed_form(arm, target @ invert_pose(arm.tooltip_offset), present)  # [K, N, n]
    found = _unwound(arm, found, present)
    clipped = np.clip(found, arm.lower, arm.upper)
    outside, away = np.abs(found - clipped).max(-1), np.linalg.norm(clipped - present, axis=-1)
    best = np.lexsort((away, outside > _WITHIN), axis=0)[0]
    joints = clipped[best, np.arange(len(target))]
    position, rotation = _errors(arm, joints, target)

    missed = (position >= _REACHED) | (rotation >= _REACHED)
    if missed.any():
        middle = np.broadcast_to((arm.lower + arm.upper) / 2, (1, missed.sum(), count))
        straight = clipped[:, missed]  # from a wrist that is bent one way the search may not find that the other one is nearer
        straight[..., 3:] = middle[..., 3:]
        starts = np.concatenate([clipped[:, missed], straight, middle])
        many = np.broadcast_to(target[missed], (len(starts), *target[missed].shape))
        tried, costs = _search(arm, starts.reshape(-1, count), many.reshape(-1, 4, 4), config)
        tried, costs = tried.reshape(starts.shape), costs.reshape(starts.shape[:2])
        joints[missed] = tried[costs.argmin(0), np.arange(missed.sum())]
        position[missed], rotation[missed] = _errors(arm, joints[missed], target[missed])
    return Reach(arm, joints.reshape(*batch, count), position.reshape(batch), rotation.reshape(batch))


def _check_poses(arm: ArmKinematics, poses: ArrayLike) -> np.ndarray:
    """Poses [..., 4, 4] with exact rotations."""
    try:
        poses = np.array(poses, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{arm.name}: a pose of the tip must be a 4×4 matrix, got {poses!r:.60}") from None
    if poses.shape[-2:] != (4, 4) or not np.isfinite(poses).all():
        shown = "one that is not finite" if poses.shape[-2:] == (4, 4) else f"shape {poses.shape}"
        raise ValueError(f"{arm.name}: a pose of the tip must be a finite 4×4 matrix, got {shown}")
    R = poses[..., :3, :3]
    wrong = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max((-1, -2)) > 1e-3
    if (wrong | (np.linalg.det(R) < 0) | (poses[..., 3, :] != [0, 0, 0, 1]).any(-1)).any():
        raise ValueError(f"{arm.name}: a pose of the tip must be a rotation and a position, with the last row 0 0 0 1")
    poses[..., :3, :3] = nearest_rotations(R)
    return poses


def _closed_form(arm: ArmKinematics, last: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Joint positions [K, N, n], whatever the limits, for poses [N, 4, 4] of the last frame; exact for 6 joints."""
    frames = arm.link_frames(present)
    p, z = last[:, :3, 3], last[:, :3, 2]
    if len(arm.joints) == 4:
        direction = _unit(p, frames[:, 2, :3, 2])  # never the opposite: the tip of an endoscope stays beyond the remote centre
        before = np.stack([*_cross_axes(direction), direction], -1)  # axes of the insertion joint [N, 3, 3]
        M = np.swapaxes(before, -1, -2) @ last[:, :3, :3]
        roll = np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1])  # the nearest turn about the shaft
        found = np.stack([*aim_shaft(direction), (p * direction).sum(-1), roll], -1)[None]
    else:
        a, x6 = arm.joints[5].a, last[:, :3, 0]
        axis = _unit(_cross(p, z), _flat(frames[:, 4, :3, 2], z))
        pitch_axis = np.stack([axis, -axis])  # [2, N, 3]
        pitch_axis = _unit(_flat(pitch_axis, z), pitch_axis)  # rounding may have tilted it
        x = _cross(z, pitch_axis)
        shaft = p - a * x
        along = _unit(_flat(_unit(shaft, frames[:, 3, :3, 2]), pitch_axis), x)
        direction = np.stack([along, -along], 1)  # [2, 2, N, 3]
        pitch_axis, x, shaft = pitch_axis[:, None], x[:, None], shaft[:, None]
        x3, y3 = _cross_axes(direction)
        roll = np.arctan2(-(x3 * pitch_axis).sum(-1), (y3 * pitch_axis).sum(-1))
        pitch = np.arctan2((x * _cross(pitch_axis, direction)).sum(-1), (x * direction).sum(-1))
        yaw = np.arctan2((x6 * x).sum(-1), (x6 * pitch_axis).sum(-1))
        found = np.empty((*direction.shape[:-1], len(arm.joints)))  # [2, 2, N, n]
        for i, positions in enumerate((*aim_shaft(direction), (shaft * direction).sum(-1), roll, pitch, yaw)):
            found[..., i] = positions
        found = found.reshape(4, len(last), len(arm.joints))
    found[..., 2] -= arm.joints[2].shift + arm.joints[3].shift
    found[..., 3] -= arm.joints[3].angle
    return found


def _unit(vectors: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of length one, in the direction of others [..., 3] where they are too short to have one."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    other = otherwise / np.maximum(np.linalg.norm(otherwise, axis=-1, keepdims=True), _UNDECIDED)
    return np.where(length > _UNDECIDED, vectors / np.maximum(length, _UNDECIDED), other)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products [..., 3] of vectors [..., 3], number by number what ``np.cross`` says: that takes four times as long for one."""
    return a.take(_NEXT, -1) * b.take(_AFTER, -1) - a.take(_AFTER, -1) * b.take(_NEXT, -1)


def _flat(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] without what they have along unit normals [..., 3]."""
    return vectors - (vectors * normals).sum(-1, keepdims=True) * normals


def aim_shaft(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Yaw and pitch [...], rad, that point the shaft in directions [..., 3] in the base frame, which need not be of length one.

    The direction is (sin yaw cos pitch, -sin pitch, -cos yaw cos pitch).
    """
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    return np.arctan2(x, -z), np.arctan2(-y, np.hypot(x, z))


def _cross_axes(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes x and y [..., 3] of the insertion joint when the shaft points in a direction [..., 3]."""
    yaw, pitch = aim_shaft(direction)
    x = np.stack([-np.sin(yaw) * np.sin(pitch), -np.cos(pitch), np.cos(yaw) * np.sin(pitch)], -1)
    return x, _cross(direction, x)


def _unwound(arm: ArmKinematics, joints: np.ndarray, present: np.ndarray) -> np.ndarray:
    """The same joint positions [K, N, n] by whole turns nearer to the present ones [N, n], within the limits where that is possible."""
    lower, upper = arm.lower - _WITHIN, arm.upper + _WITHIN
    turn = np.where(arm.prismatic, 0, 2 * np.pi)
    joints = joints + turn * np.round((present - joints) / (2 * np.pi))
    for other in (joints - turn, joints + turn):
        joints = np.where((lower <= joints) & (joints <= upper) | (other < lower) | (other > upper), joints, other)
    return joints


def _residual(tip: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is missing from poses [N, 4, 4] to others: positions [N, 3], m, and rotation vectors [N, 3], rad, in the axes of the base."""
    if not len(tip):
        return np.zeros((0, 3)), np.zeros((0, 3))  # older scipy has no empty rotation
    turn = Rotation.from_matrix(target[:, :3, :3] @ np.swapaxes(tip[:, :3, :3], -1, -2)).as_rotvec()
    return target[:, :3, 3] - tip[:, :3, 3], turn


def _errors(arm: ArmKinematics, joints: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    position, turn = _residual(arm.tip_pose(joints), target)
    return np.linalg.norm(position, axis=-1), np.linalg.norm(turn, axis=-1)


def _search(arm: ArmKinematics, joints: np.ndarray, target: np.ndarray, config: ReachConfig) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions [M, n] within the limits near poses [M, 4, 4], and their squared distances [M], m².

    Levenberg-Marquardt; a joint at a limit stays there while the slope presses it against it (projected gradient).
    """
    weights = np.repeat([1.0, config.radian_length], 3)

    def missing(joints: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        frames = arm.link_frames(joints)
        tip = frames[:, -1] @ arm.tooltip_offset
        residual = np.concatenate(_residual(tip, target), -1) * weights
        return residual, arm._jacobian(frames, tip[:, :3, 3]) * weights[:, None], (residual**2).sum(-1)

    joints, going = joints.copy(), np.arange(len(joints))
    residual, J, cost = missing(joints, target)
    damping, eye = np.full(len(joints), 1e-3), np.eye(joints.shape[1])
    for _ in range(config.iterations):
        now, slope = joints[going], (J[going] * residual[going, :, None]).sum(1)
        free = ~((now <= arm.lower) & (slope < 0) | (now >= arm.upper) & (slope > 0))
        H = np.swapaxes(J[going], -1, -2) @ J[going]
        diagonal = np.where(free, damping[going, None] * (np.einsum("mii->mi", H) + 1e-9), 1.0)
        H = H * free[:, :, None] * free[:, None, :] + eye * diagonal[:, None, :]
        tried = np.clip(now + np.linalg.solve(H, (slope * free)[..., None])[..., 0], arm.lower, arm.upper)
        new_residual, new_J, new_cost = missing(tried, target[going])
        gain = cost[going] - new_cost
        better = gain > 0
        damping[going] *= np.where(better, 0.2, 5)
        finished = (np.abs(tried - now).max(-1) < _STILL) | better & (gain < _STILL * new_cost)
        taken = going[better]
        joints[taken], residual[taken], J[taken], cost[taken] = tried[better], new_residual[better], new_J[better], new_cost[better]
        going = going[~finished]
        if not len(going):
            break
    return joints, cost
