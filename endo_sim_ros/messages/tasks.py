"""How a step of a task ended, and what a policy answers."""

import numpy as np

from endo_sim_ros.messages.motion import decode_motion_command as decode_named
from endo_sim_ros.messages.tools import encode_joints
from endo_sim_ros.messages.types import Message, MessageError, MessageTypes, ros_types

__all__ = ["OUTCOME", "decode_action", "decode_outcome", "encode_outcome"]

OUTCOME = ("reward", "done", "success", "seed", "goal_x", "goal_y", "goal_z")
"""Names of the numbers of an outcome: of the step, of the episode, and the place that it is about, m, world, at rest."""


def encode_outcome(
    reward: float, done: bool, success: bool, seed: int, goal: np.ndarray, stamp_ns: int, types: MessageTypes = ros_types()
) -> Message:
    """JointState of a step that led to the state with a stamp; goal [3], m, world."""
    return encode_joints(OUTCOME, np.array([reward, done, success, seed, *goal], np.float64), np.zeros(0), np.zeros(0), stamp_ns, types)


def decode_outcome(message: Message, topic: str) -> np.ndarray:
    """The numbers of an outcome [7], in the order of `OUTCOME`.

    Raises:
        MessageError: If one is missing or not finite.
    """
    values = decode_named(message, topic)
    if missing := [name for name in OUTCOME if name not in values]:
        raise MessageError(f"{topic}: {missing[0]} is missing; expected {', '.join(OUTCOME)}")
    return np.array([values[name] for name in OUTCOME])


def decode_action(message: Message, topic: str, size: int) -> np.ndarray:
    """The numbers [size] of an action, the positions of a JointState.

    Raises:
        MessageError: If there are more or fewer, or one is not finite.
    """
    action = np.asarray(message.position, np.float64)
    if action.shape != (size,) or not np.isfinite(action).all():
        raise MessageError(f"{topic}: expected {size} finite numbers in position, got {action.tolist()!s:.200}")
    return action
