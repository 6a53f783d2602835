"""Stamps and frames of headers, and the clock."""

from collections.abc import Iterable

from endo_sim_ros.messages.types import Message, MessageError, MessageTypes, ros_types

__all__ = ["ECM_VIEW", "check_frame", "encode_clock", "set_stamp", "stamp_to_ns"]

ECM_VIEW = "ECM_view"
"""The frame of the camera now, as the dVRK has it."""
NANOSECONDS = 1_000_000_000  # in a second


def stamp_to_ns(stamp: Message) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def make_time(types: MessageTypes, stamp_ns: int) -> Message:
    """builtin_interfaces/Time of a time in nanoseconds."""
    sec, nanosec = divmod(int(stamp_ns), NANOSECONDS)
    return types.Time(sec=sec, nanosec=nanosec)


def make_header(types: MessageTypes, stamp_ns: int, frame_id: str) -> Message:
    """std_msgs/Header of a time in nanoseconds and a frame."""
    return types.Header(stamp=make_time(types, stamp_ns), frame_id=frame_id)


def set_stamp(message: Message, stamp_ns: int) -> None:
    """Give a message that was made ready the time of its header, ns."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(stamp_ns), NANOSECONDS)


def check_frame(message: Message, allowed: Iterable[str], topic: str) -> str:
    """Return the frame of a message's header, without a leading slash.

    Args:
        message: The message.
        allowed: Names of the frames that can be used.
        topic: For the error.

    Raises:
        MessageError: If the frame is not among the allowed ones.
    """
    frame = message.header.frame_id.lstrip("/")
    allowed = [name.lstrip("/") for name in allowed]
    if frame not in allowed:
        if frame == ECM_VIEW:
            raise MessageError(f"{topic}: {frame} moves with the camera and is not known here; let it be said with cartesian_frame: world")
        names = " or ".join(repr(name) for name in allowed)
        raise MessageError(
            f"{topic}: unknown frame {frame!r}; this graph knows {names} (set the parameter world_frame, name it in the"
            " parameter frames, or republish in that frame)"
        )
    return frame


def encode_clock(stamp_ns: int, types: MessageTypes = ros_types()) -> Message:
    """Clock of a simulated time in nanoseconds."""
    return types.Clock(clock=make_time(types, stamp_ns))
