"""What ROS nodes report on /diagnostics: a level, a state, a message and values.

Programs read the level, the state and the values. The message is a sentence for people: no program parses it.
"""

from collections.abc import Mapping
from enum import Enum
from typing import Any, NamedTuple, TypeVar

from endo_sim_ros.messages.headers import make_header
from endo_sim_ros.messages.types import Message, MessageTypes, RosTypes, ros_types

__all__ = [
    "ERROR", "OK", "SET", "STATE", "WARN", "BagPlayerState", "ClientState", "IdentificationState", "NodeState", "NodeStatus",
    "PhysicsState", "PolicyState", "ReconstructionState", "RecorderState", "RenderingState", "ScriptedToolState", "ViewerState",
    "decode_diagnostics", "encode_diagnostics",
]  # fmt: skip

OK, WARN, ERROR = 0, 1, 2  # levels
STATE = "state"  # key of a node's state
SET = "set"  # key of the parameters that were set since the node started, with their values, as JSON; missing where none were
_LEVELS = (b"\x00", b"\x01", b"\x02")  # the same in messages of ROS


class NodeState(str, Enum):
    """What a ROS node does now: the value of its key `state`. Each kind of node has states of its own."""

    def __str__(self) -> str:
        return self.value


class ReconstructionState(NodeState):
    """States of reconstruction_node."""

    WAITING = "waiting"  # no view has come; a model read from a file may be published
    COLLECTING = "collecting"  # views come
    PREPARING = "preparing"  # of a reconstruction: everything before the first iteration
    TRAINING = "training"
    DONE = "done"  # the last reconstruction is saved; it stays so until the next one begins
    FAILED = "failed"  # the last reconstruction ended with an error; it stays so until the next one begins


class PhysicsState(NodeState):
    """States of physics_node."""

    WAITING = "waiting"  # for a model, or for the place from where its tissue is seen
    BUILDING = "building"  # the first tissue
    RUNNING = "running"  # steps are taken: with the clock, or in lockstep with each command
    PAUSED = "paused"
    FAILED = "failed"  # the model cannot be simulated, and there is none before it


class RenderingState(NodeState):
    """States of rendering_node."""

    WAITING = "waiting"  # for a model or a camera
    BUILDING = "building"  # the first model is prepared
    RENDERING = "rendering"
    FAILED = "failed"  # the model cannot be rendered, and there is none before it


class IdentificationState(NodeState):
    """States of identification_node."""

    WAITING = "waiting"  # for a model, or for the place from where its tissue is seen
    COLLECTING = "collecting"  # touches
    ESTIMATING = "estimating"  # what the tissue is made of; touches are collected meanwhile
    FAILED = "failed"  # nothing could be estimated from the touches so far


class ViewerState(NodeState):
    """States of viewer_node."""

    WAITING = "waiting"  # for a model
    SHOWING = "showing"


class BagPlayerState(NodeState):
    """States of the bag player."""

    WAITING = "waiting"  # for subscribers
    PLAYING = "playing"
    DELIVERING = "delivering"  # all is published; subscribers may still ask for lost messages
    DONE = "done"
    FAILED = "failed"


class RecorderState(NodeState):
    """States of the recorder."""

    RECORDING = "recording"
    FAILED = "failed"  # nothing is recorded any more; what was written can be read


class PolicyState(NodeState):
    """States of the policy."""

    WAITING = "waiting"  # for physics_node, or for the tissue at rest
    WORKING = "working"  # on an episode
    DONE = "done"  # with all episodes


class ScriptedToolState(NodeState):
    """States of the scripted tool."""

    WAITING = "waiting"  # for rendered depth, control nodes, tissue in the image, or subscribers of the jaw
    PULLING = "pulling"
    SWINGING = "swinging"
    RELEASED = "released"
    DONE = "done"


class ClientState(NodeState):
    """States of programs that only listen and command, such as `endo-sim up`."""

    RUNNING = "running"


_State = TypeVar("_State", bound=NodeState)


class NodeStatus(NamedTuple):
    """One status of a DiagnosticArray."""

    name: str  # of the node, with its namespace, without a leading slash
    level: int  # OK, WARN or ERROR
    message: str  # one sentence, for people
    values: dict[str, str]

    def state(self, states: type[_State]) -> _State | None:
        """State of the node, or None where it is missing or not one of these states."""
        value = self.values.get(STATE)
        return next((state for state in states if state.value == value), None)


def encode_diagnostics(
    name: str, level: int, message: str, values: Mapping[str, Any], stamp_ns: int, types: MessageTypes = ros_types()
) -> Message:
    """DiagnosticArray with one status.

    Args:
        name: Of the node, with its namespace, without a leading slash.
        level: OK, WARN or ERROR.
        message: One sentence, for people.
        values: For programs, with the node's state under the key `state`.
        stamp_ns: Time, nanoseconds.
        types: Message classes to build; those of ROS by default.
    """
    status = types.DiagnosticStatus(
        level=_LEVELS[level] if isinstance(types, RosTypes) else level,
        name=name,
        message=message,
        hardware_id="endo_sim_ros",
        values=[types.KeyValue(key=str(key), value=str(value)) for key, value in values.items()],
    )
    return types.DiagnosticArray(header=make_header(types, stamp_ns, ""), status=[status])


def decode_diagnostics(message: Message) -> list[NodeStatus]:
    """Every status of a DiagnosticArray."""
    level = lambda value: value[0] if isinstance(value, bytes) else int(value)  # noqa: E731
    return [
        NodeStatus(status.name, level(status.level), status.message, {pair.key: pair.value for pair in status.values})
        for status in message.status
    ]
