"""Wrenches, jaws, cuts, arm states, and the markers that show tools."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from endo_sim_ros.messages.headers import make_header
from endo_sim_ros.messages.types import Message, MessageError, MessageTypes, crtk_type, ros_class, ros_types

__all__ = [
    "ToolDisplay", "decode_jaw", "decode_joints", "decode_number", "decode_pedal", "decode_state_command", "decode_text", "decode_wrench",
    "encode_cut", "encode_jaw", "encode_joints", "encode_matrix", "encode_number", "encode_operating_state", "encode_report", "encode_text",
    "encode_tool_markers", "encode_twist", "encode_wrench", "joint_state_name",
]  # fmt: skip


def decode_wrench(message: Message, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Force [3] (N) and torque [3] (N·m) of a WrenchStamped, in the axes of its frame.

    Raises:
        MessageError: If a number is not finite.
    """
    f, t = message.wrench.force, message.wrench.torque
    force, torque = np.array([f.x, f.y, f.z]), np.array([t.x, t.y, t.z])
    if not (np.isfinite(force).all() and np.isfinite(torque).all()):
        raise MessageError(f"{topic}: the wrench is not finite (force {force}, torque {torque}); it was ignored")
    return force, torque


def encode_wrench(force: np.ndarray, torque: np.ndarray, stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """WrenchStamped of a force [3] (N) and a torque [3] (N·m), in the axes of the frame."""
    wrench = types.Wrench(force=_vector(types, force), torque=_vector(types, torque))
    return types.WrenchStamped(header=make_header(types, stamp_ns, frame_id), wrench=wrench)


def encode_twist(linear: np.ndarray, angular: np.ndarray, stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """TwistStamped of a velocity [3] (m/s) and an angular velocity [3] (rad/s), in the axes of the frame."""
    twist = types.Twist(linear=_vector(types, linear), angular=_vector(types, angular))
    return types.TwistStamped(header=make_header(types, stamp_ns, frame_id), twist=twist)


def _vector(types: MessageTypes, values: np.ndarray) -> Message:
    return types.Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))


def decode_jaw(message: Message, topic: str) -> float:
    """Opening angle of a jaw, radians, of a JointState with one position.

    Raises:
        MessageError: If there is not one finite position.
    """
    positions = np.asarray(message.position, np.float64)
    if positions.size != 1 or not np.isfinite(positions).all():
        raise MessageError(f"{topic}: expected one finite jaw angle in position, got {positions.tolist()}")
    return float(positions[0])


def encode_jaw(angle: float, stamp_ns: int, types: MessageTypes = ros_types()) -> Message:
    """JointState of a jaw's opening angle, radians."""
    return encode_joints(["jaw"], np.array([angle]), np.zeros(0), np.zeros(0), stamp_ns, types)


def decode_joints(message: Message, topic: str, what: str = "joint positions") -> np.ndarray:
    """Positions [n] of a JointState, rad and m, in the order of the arm's joints; whether the arm has as many is not checked.

    Args:
        message: The JointState.
        topic: Its topic, for errors.
        what: What the positions stand for, for errors.

    Raises:
        MessageError: If one is not finite.
    """
    positions = np.asarray(message.position, np.float64)
    if not np.isfinite(positions).all():
        raise MessageError(f"{topic}: expected finite {what}, rad and m, got {positions.tolist()!s:.200}")
    return positions


def encode_joints(
    names: Sequence[str],
    positions: np.ndarray,
    velocities: np.ndarray,
    efforts: np.ndarray,
    stamp_ns: int,
    types: MessageTypes = ros_types(),
) -> Message:
    """JointState of joints by name: positions [n] (rad, m), velocities [n] (rad/s, m/s) and efforts [n] (N·m, N), or [0] for none."""
    return types.JointState(
        header=make_header(types, stamp_ns, ""),
        name=list(names),
        position=types.sequence(np.asarray(positions, np.float64)),
        velocity=types.sequence(np.asarray(velocities, np.float64)),
        effort=types.sequence(np.asarray(efforts, np.float64)),
    )


def joint_state_name(arm: str, joint: str) -> str:
    """What a joint of an arm is called in `joint_states`."""
    return f"{arm.replace('/', '_')}_{joint}"


def decode_number(message: Message) -> float:
    """Number of a Float64; whether it is finite is not checked."""
    return float(message.data)


def encode_number(value: float, types: MessageTypes = ros_types()) -> Message:
    """Float64 of a number."""
    return types.Float64(data=float(value))


def encode_matrix(matrix: np.ndarray, types: MessageTypes = ros_types()) -> Message:
    """Float64MultiArray of a matrix [r, c], row by row."""
    (rows, columns), dimension = matrix.shape, types.MultiArrayDimension
    dim = [dimension(label="rows", size=rows, stride=matrix.size), dimension(label="columns", size=columns, stride=columns)]
    layout = types.MultiArrayLayout(dim=dim, data_offset=0)
    return types.Float64MultiArray(layout=layout, data=types.sequence(np.asarray(matrix, np.float64)))


def decode_pedal(message: Message, topic: str) -> bool:
    """Whether the first button of a Joy is down, as 1; the dVRK tells a short tap by 2 when it is up again.

    Raises:
        MessageError: If there is no button.
    """
    if not len(message.buttons):
        raise MessageError(f"{topic}: expected a button, 1 = down, got none")
    return int(message.buttons[0]) == 1


def encode_cut(cutting: bool, stamp_ns: int, types: MessageTypes = ros_types()) -> Message:
    """Joy with one button, pressed while the edge of a tool cuts."""
    return types.Joy(
        header=make_header(types, stamp_ns, ""),
        axes=types.sequence(np.zeros(0, np.float32)),
        buttons=types.sequence(np.array([cutting], np.int32)),
    )


def encode_operating_state(state: str, homed: bool, busy: bool, stamp_ns: int) -> Message:
    """CRTK OperatingState. Without crtk_msgs it is a String of the state, followed by `` BUSY`` during a move."""
    kind = ros_class(crtk_type("OperatingState"))
    if kind.__name__ == "String":
        return kind(data=f"{state} BUSY" if busy else state)
    return kind(header=make_header(ros_types(), stamp_ns, ""), state=state, is_homed=homed, is_busy=busy)


def encode_report(text: str, stamp_ns: int) -> Message:
    """CRTK StringStamped, without crtk_msgs a String, of a text."""
    kind = ros_class(crtk_type("StringStamped"))
    return kind(data=text) if kind.__name__ == "String" else kind(header=make_header(ros_types(), stamp_ns, ""), string=text)


def encode_text(text: str, types: MessageTypes = ros_types()) -> Message:
    """String of a text."""
    return types.String(data=text)


def decode_text(message: Message) -> str:
    """Text of a String."""
    return message.data.strip()


def decode_state_command(message: Message) -> str:
    """Command in a CRTK StringStamped or a String."""
    return (message.data if hasattr(message, "data") else message.string).strip()


@dataclass(frozen=True)
class ToolDisplay:
    """What `encode_tool_markers` shows of one tool, in world axes."""

    arm: str
    tip: np.ndarray  # [3] m
    force: np.ndarray  # [3] N, on the tissue
    reaction: np.ndarray  # [3] N, on the tool
    held: np.ndarray  # [K, 3] m, control nodes in the tool's grasp
    rods: Sequence[tuple[np.ndarray, np.ndarray, float]] = ()  # both ends [3] and the radius of what its instrument is made of, m


METRES_PER_NEWTON = 0.01  # length of the arrows
_MARKER_RADIUS = 0.0015  # m
_SPHERE, _ARROW, _POINTS, _CYLINDER = 2, 0, 8, 3  # Marker.type
_METAL = (0.55, 0.56, 0.58, 1.0)
_ADD, _DELETE = 0, 2  # Marker.action


def encode_tool_markers(tools: Iterable[ToolDisplay], stamp_ns: int, frame_id: str) -> Message:
    """MarkerArray for RViz and Foxglove. The namespace of a marker is its arm.

    Ids of each arm: 0 the tip, 1 the force on the tissue, 2 the reaction, 3 the held control nodes, from 4 on the instrument. Arrows are
    1 cm per newton. A marker with nothing to show is deleted.
    """
    types, r = ros_types(), _MARKER_RADIUS
    point = lambda p: types.Point(x=float(p[0]), y=float(p[1]), z=float(p[2]))  # noqa: E731
    markers = []

    def add(tool: ToolDisplay, kind: int, points: list, size: tuple, color: tuple, visible: bool, pose: Message | None = None) -> None:
        marker = types.Marker(
            header=make_header(types, stamp_ns, frame_id),
            ns=tool.arm,
            id=sum(marker.ns == tool.arm for marker in markers),
            type=kind,
            action=_ADD if visible else _DELETE,
            pose=pose or types.Pose(),
            scale=types.Vector3(**dict(zip("xyz", size))),
            color=types.ColorRGBA(**dict(zip("rgba", color))),
            points=[point(p) for p in points],
        )
        markers.append(marker)

    for tool in tools:
        add(tool, _SPHERE, [], (2 * r, 2 * r, 2 * r), (0.9, 0.9, 0.9, 1.0), True, types.Pose(position=point(tool.tip)))
        for vector, color in ((tool.force, (1.0, 0.55, 0.1, 1.0)), (tool.reaction, (0.2, 0.6, 1.0, 1.0))):
            end = tool.tip + METRES_PER_NEWTON * vector
            add(tool, _ARROW, [tool.tip, end], (r / 2, r, 2 * r), color, bool(np.any(vector)))
        add(tool, _POINTS, list(tool.held), (r, r, 0.0), (0.3, 1.0, 0.4, 1.0), len(tool.held) > 0)
        for start, end, radius in tool.rods:
            way = end - start
            length = float(np.linalg.norm(way))
            half = np.array([-way[1], way[0], 0.0, length + way[2]])  # xyzw: half way of the turn from z to the rod, unless it is -z
            x, y, z, w = half / np.linalg.norm(half) if half.any() else (1.0, 0.0, 0.0, 0.0)
            pose = types.Pose(position=point(0.5 * (start + end)), orientation=types.Quaternion(x=x, y=y, z=z, w=w))
            add(tool, _CYLINDER, [], (2 * radius, 2 * radius, length), _METAL, length > 0, pose)
    return types.MarkerArray(markers=markers)
