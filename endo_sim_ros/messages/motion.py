"""Breath and heart, as they move the tissue."""

from collections.abc import Sequence

import numpy as np

from endo_sim_ros.core.motion import MOTIONS
from endo_sim_ros.messages.tools import encode_joints
from endo_sim_ros.messages.types import Message, MessageError, MessageTypes, ros_types

__all__ = ["MOTIONS", "decode_motion_command", "encode_motion", "encode_motion_command"]


def encode_motion(
    displacements: Sequence[float] | np.ndarray,
    velocities: Sequence[float] | np.ndarray,
    phases: Sequence[float] | np.ndarray,
    rates: Sequence[float] | np.ndarray,
    stamp_ns: int,
    types: MessageTypes = ros_types(),
) -> Message:
    """JointState of breath and heart: displacements [2], m, with velocities [2], m/s, and phases [2], 0 to 1, with rates [2], 1/s."""
    names = [*MOTIONS, *(f"{motion}_phase" for motion in MOTIONS)]
    return encode_joints(names, np.array([*displacements, *phases]), np.array([*velocities, *rates]), np.zeros(0), stamp_ns, types)


def decode_motion_command(message: Message, topic: str) -> dict[str, float]:
    """The numbers of a JointState by their names, which are options of the motion; whether there are such options is not checked.

    Raises:
        MessageError: If there is not one finite position for each name, and each name once.
    """
    names, positions = list(message.name), np.asarray(message.position, np.float64)
    if len({*names}) < len(names) or not names or positions.shape != (len(names),) or not np.isfinite(positions).all():
        raise MessageError(
            f"{topic}: expected a finite position for each name, each once, got {names!s:.100} and {positions.tolist()!s:.100}"
        )
    return dict(zip(names, positions.tolist()))


def encode_motion_command(values: dict[str, float], stamp_ns: int, types: MessageTypes = ros_types()) -> Message:
    """JointState of options of the motion by their names, such as breathing and breathing_period."""
    return encode_joints(list(values), np.array(list(values.values())), np.zeros(0), np.zeros(0), stamp_ns, types)
