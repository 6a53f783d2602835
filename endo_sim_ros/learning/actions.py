"""What the numbers of actions mean, what acts by them, and what is observed beside the state of a task for them."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from endo_sim_ros.instruments import JOINTS
from endo_sim_ros.learning.tasks import Task, find_task
from endo_sim_ros.learning.tasks.task import dot
from endo_sim_ros.learning.variation import departed

POSE_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")
ARM_NAMES = (*POSE_NAMES, "jaw", "force_x", "force_y", "force_z")
"""Names of the numbers of `arm_state`."""

Actions = Literal["cartesian", "joints", "joint_positions"]
"""How far the tip of the tool moves, how far the joints of its arm move, or where these are; see `TaskBatch`."""

Contact = Literal["point", "links"]
"""What touches the tissue: the tip as a task describes it, or the links of the instrument; see `TaskBatch`."""

CARTESIAN_SIZES = 4, 5
"""How many numbers actions of tips may have for each arm, see `Task.twist`."""


def require_contact(task: str, contact: Contact) -> None:
    """Raise ValueError if a task cannot have that contact."""
    if contact == "links" and find_task(task).cutting:
        raise ValueError(f"{task} cuts with the edges of points, which links have none of; leave contact at point")


def action_size(task: Task | type[Task], actions: Actions) -> int:
    """How many numbers an action has for each arm."""
    return task.action_size() if actions == "cartesian" else len(JOINTS) + 1


def by_arm(task: Task | type[Task], names: Sequence[str]) -> list[str]:
    """Names of numbers that there are of each arm of a task."""
    return [f"{arm}.{name}" for arm in task.arms for name in names]


def observed_names(task: Task | type[Task], actions: Actions) -> tuple[str, ...]:
    """Names of the numbers of the state: those of a task, and with actions of joints the joints, in tasks of several arms by arm."""
    if actions == "cartesian":
        return task.observation_names
    return (*task.observation_names, *(JOINTS if len(task.arms) == 1 else by_arm(task, JOINTS)))


def jaw_angles(task: Task, fourth: np.ndarray) -> np.ndarray:
    """Angles between the jaws [B] or [B, A], rad, that fourth numbers of actions command."""
    return np.where(task.closes(fourth), task.closed_jaw, task.open_jaw)


def tip_poses(task: Task, tips: np.ndarray) -> np.ndarray:
    """Poses of tips at places [B, 3] or [B A, 3], m, world, in their axes, [B A, 4, 4], arm after arm of each episode."""
    places = tips.reshape(-1, 3)
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = task.rotations.reshape(-1, 3, 3), places
    return poses


def arm_state(task: Task, moved: np.ndarray | None = None) -> np.ndarray:
    """What the arms measure of themselves, which tells nothing of the goal [B, 11 A], float32.

    Of each it is the pose of the tip (m, xyzw) in the frame of the endoscope (x right, y down, z forward), as the arms of a da Vinci
    measure it, the angle between the jaws (rad), and the force of the tissue on the tool (N, in the axes of the endoscope). So it agrees
    with what the endoscope sees, wherever in the world that is.

    Args:
        task: The task.
        moved: How the endoscope of each episode departs from where the task has it [B, 4, 4], see `departed`; None = none does.
    """
    endoscopes = task.endoscopes()
    poses = np.tile(task.endoscope, (task.count, 1, 1)) if endoscopes is None else endoscopes
    if moved is not None:
        poses = departed(poses, moved)
    poses = poses.repeat(len(task.arms), 0)  # [B A, 4, 4]
    axes = poses[:, :3, :3].transpose(0, 2, 1)
    local = lambda v: dot(axes, v[:, None])
    turned = Rotation.from_matrix(axes @ task.rotations.reshape(-1, 3, 3)).as_quat(canonical=True)
    jaws = jaw_angles(task, task.fourth).ravel()
    places = local(task.tips().reshape(-1, 3) - poses[:, :3, 3])
    measured = np.column_stack([places, turned, jaws, local(task.forces().reshape(-1, 3))])
    return measured.astype(np.float32).reshape(task.count, -1)


def pose_numbers(poses: np.ndarray) -> np.ndarray:
    """Poses [B, 4, 4] as numbers named `POSE_NAMES` [B, 7]: m and xyzw."""
    return np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)])


def command_names(task: Task) -> list[str]:
    """Names of the numbers of `arm_commands`."""
    return [f"ECM.{name}" for name in POSE_NAMES] if task.turns else by_arm(task, (*POSE_NAMES, "jaw"))


def arm_commands(task: Task, actions: np.ndarray, moved: np.ndarray | None = None) -> np.ndarray:
    """What actions command, as absolute numbers.

    Args:
        task: The task.
        actions: Of the tips [B, 4 or 5 A], or of the endoscopes, where the task `turns` them.
        moved: As for `arm_state`.

    Returns:
        Poses of the tips (m, xyzw, world), and angles between the jaws (rad) [B, 8 A]; or poses of the endoscopes (m, xyzw, camera to
        world) [B, 7].
    """
    if task.turns:
        poses = task.endoscopes(actions)
        assert poses is not None
        return pose_numbers(poses if moved is None else departed(poses, moved))
    turned = Rotation.from_matrix(task.orient(actions).reshape(-1, 3, 3)).as_quat(canonical=True)
    jaws = jaw_angles(task, actions.reshape(*task.fourth.shape, -1)[..., 3]).ravel()
    return np.column_stack([task.reach(actions).reshape(-1, 3), turned, jaws]).reshape(task.count, -1)
