"""What nodes say about themselves on /diagnostics."""

from collections.abc import Mapping
from typing import Any

from endo_sim_ros.messages.headers import make_header
from endo_sim_ros.messages.types import Message, MessageTypes, RosTypes, ros_types

OK, WARN, ERROR = 0, 1, 2  # levels
_LEVELS = (b"\x00", b"\x01", b"\x02")  # the same in messages of ROS


def encode_diagnostics(
    name: str, level: int, text: str, values: Mapping[str, Any], stamp_ns: int, types: MessageTypes | None = None
) -> Message:
    """DiagnosticArray with one status: node name, level (OK, WARN, ERROR), one sentence, and key-value pairs."""
    types = types or ros_types()
    status = types.DiagnosticStatus(
        level=_LEVELS[level] if isinstance(types, RosTypes) else level,
        name=name,
        message=text,
        hardware_id="endo_sim_ros",
        values=[types.KeyValue(key=str(key), value=str(value)) for key, value in values.items()],
    )
    return types.DiagnosticArray(header=make_header(types, stamp_ns, ""), status=[status])


def decode_diagnostics(message: Message) -> list[tuple[str, int, str, dict[str, str]]]:
    """(name, level, text, values) of every status."""
    level = lambda value: value[0] if isinstance(value, bytes) else int(value)  # noqa: E731
    return [
        (status.name, level(status.level), status.message, {pair.key: pair.value for pair in status.values}) for status in message.status
    ]
