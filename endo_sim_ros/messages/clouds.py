"""Point clouds: Gaussian models, control nodes, cut surfaces, maps of stiffness and where links of a thing are."""

import dataclasses
import functools
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from endo_sim_ros.messages.headers import NANOSECONDS, make_header
from endo_sim_ros.messages.topics import CONTROL_NODES, CUT_SURFACE, GAUSSIANS, STIFFNESS_MAP, THING_POSES
from endo_sim_ros.messages.types import Message, MessageError, MessageTypes, ros_types

if TYPE_CHECKING:  # it takes torch, which most users of this package do not need
    from endo_sim_ros.core.gaussians import GaussianModel

__all__ = [
    "ControlNodeCloud", "StiffnessCloud", "cut_number", "decode_cloud", "decode_control_nodes", "decode_cut_surface", "decode_gaussians",
    "decode_stiffness", "decode_thing_poses", "decode_torn", "encode_control_nodes", "encode_cut_surface", "encode_gaussians",
    "encode_stiffness", "encode_thing_poses",
]  # fmt: skip

_POINT_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField.datatype
_POINT_DATATYPES = {name: number for number, name in _POINT_FORMATS.items()}


def decode_cloud(message: Message, topic: str) -> np.ndarray:
    """Structured array [N] of a PointCloud2, by field name, whatever its offsets and byte order.

    Raises:
        MessageError: If rows are padded, or the layout and the data disagree.
    """
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.datatype in _POINT_FORMATS]
    count, data = message.width * message.height, np.frombuffer(message.data, np.uint8)
    if any(field.offset + np.dtype(_POINT_FORMATS[field.datatype]).itemsize > message.point_step for field in fields):
        raise MessageError(f"{topic}: a field's offset lies beyond the point step of {message.point_step} bytes")
    if message.height > 1 and message.row_step != message.width * message.point_step:
        raise MessageError(f"{topic}: clouds with padded rows are not supported (row step {message.row_step})")
    if data.size < count * message.point_step:
        raise MessageError(f"{topic}: the cloud is truncated: {data.size} bytes for {count} points of {message.point_step} bytes")
    dtype = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [order + _POINT_FORMATS[field.datatype] for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": max(message.point_step, 1),
        }
    )
    return data[: count * message.point_step].view(dtype)


def _names(points: np.ndarray) -> tuple[str, ...]:
    """Names of the fields of a structured array."""
    return points.dtype.names or ()


def _columns(points: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Fields of a structured array [N] as columns [N, len(names)] float32."""
    columns = np.empty((len(points), len(names)), np.float32)
    for i, name in enumerate(names):
        columns[:, i] = points[name]
    return columns


@functools.lru_cache(16)
def _fields(layout: np.dtype, types: MessageTypes) -> tuple[Message, ...]:
    """PointFields of a structured array. They are kept, as to make those of a state takes longer than to copy its numbers."""
    return tuple(
        types.PointField(name=name, offset=offset, datatype=_POINT_DATATYPES[dtype.str[1:]], count=1)
        for name, (dtype, offset, *_) in (layout.fields or {}).items()
    )


def _encode_cloud(points: np.ndarray, stamp_ns: int, frame_id: str, types: MessageTypes) -> Message:
    """PointCloud2 of a structured array [N]."""
    return types.PointCloud2(
        header=make_header(types, stamp_ns, frame_id),
        height=1,
        width=len(points),
        fields=list(_fields(points.dtype, types)),
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.itemsize * len(points),
        data=types.sequence(points.view(np.uint8).reshape(-1)),
        is_dense=True,
    )


def encode_gaussians(model: "GaussianModel", stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """PointCloud2 of a model: INRIA's field names (float32), packed `rgb`, and `light` where the model has one.

    Args:
        model: The model, metres, world.
        stamp_ns: Time, nanoseconds. It identifies the model.
        frame_id: The world frame.
        types: Message classes to build; those of ROS by default.

    Raises:
        MessageError: If a model with a light has fewer Gaussians than the light has values.
    """
    from endo_sim_ros.core.gaussians import BARED_FIELDS, GLOSS_FIELDS, ply_fields, to_columns

    r, g, b = (model.base_colors.detach().cpu().numpy() * 255 + 0.5).astype(np.uint32).T
    columns, names = [to_columns(model), (r << 16 | g << 8 | b).view(np.float32)[:, None]], [*ply_fields(model.sh_degree), "rgb"]
    for layer, fields in ((model.gloss, GLOSS_FIELDS), (model.bared, BARED_FIELDS)):
        if layer is not None:
            columns.append(layer.detach().cpu().float().numpy())
            names += fields
    if model.light is not None:
        numbers = np.array(dataclasses.astuple(model.light), np.float32)
        if len(model) < len(numbers):
            raise MessageError(f"{GAUSSIANS.name}: a model with a light needs {len(numbers)} Gaussians, got {len(model)}")
        columns.append(np.pad(numbers, (0, len(model) - len(numbers)))[:, None])
        names.append("light")
    points = np.concatenate(columns, 1)
    return _encode_cloud(points.view([(name, "<f4") for name in names]).reshape(-1), stamp_ns, frame_id, types)


def decode_gaussians(message: Message, topic: str = GAUSSIANS.name) -> "GaussianModel":
    """Gaussian model of a PointCloud2, decoded by field name.

    Raises:
        MessageError: If the cloud is damaged or empty, a field is missing, or a value cannot be used.
    """
    from endo_sim_ros.core.gaussians import ModelError, from_columns
    from endo_sim_ros.core.light import Light

    points = decode_cloud(message, topic)
    if not len(points):
        raise MessageError(f"{topic}: the model is empty; reconstruct a scene first")
    try:
        model = from_columns({name: points[name] for name in _names(points)}, topic)
        if "light" in _names(points):
            numbers = points["light"][: len(dataclasses.fields(Light))].tolist()
            model = dataclasses.replace(model, light=Light(*numbers))
        return model
    except (ModelError, ValueError, TypeError) as error:
        raise MessageError(str(error)) from error


@dataclass(frozen=True)
class ControlNodeCloud:
    """State of the control nodes at one time."""

    rest: np.ndarray  # [M, 3] float32, m, world
    positions: np.ndarray  # [M, 3] float32, m, world
    F: np.ndarray  # [M, 3, 3] float32, deformation gradient
    model_stamp_ns: int  # stamp of the model that the nodes were sampled from
    cut: int = 0  # number of the cut surface of this state, see `cut_number`; 0 = whole tissue


_POSITION, _REST = ("x", "y", "z"), ("rest_x", "rest_y", "rest_z")
_F = tuple(f"f_{row}{column}" for row in range(3) for column in range(3))
_NUMBERS = ("model_sec", "model_nanosec", "cut")
_NODE_DTYPE = np.dtype([(name, "<f4") for name in (*_POSITION, *_REST, *_F)] + [(name, "<u4") for name in _NUMBERS])


def encode_control_nodes(state: ControlNodeCloud, stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """PointCloud2 of a state: position, rest position, F row by row, stamp of the model, number of the cut surface.

    Args:
        state: The state.
        stamp_ns: Its time, nanoseconds.
        frame_id: The world frame.
        types: Message classes to build; those of ROS by default.
    """
    points = np.empty(len(state.rest), _NODE_DTYPE)
    floats = points.view(np.float32).reshape(len(points), -1)
    floats[:, 0:3] = state.positions
    floats[:, 3:6] = state.rest
    floats[:, 6:15] = state.F.reshape(-1, 9)
    points["model_sec"], points["model_nanosec"] = divmod(state.model_stamp_ns, NANOSECONDS)
    points["cut"] = state.cut
    return _encode_cloud(points, stamp_ns, frame_id, types)


def decode_control_nodes(message: Message, topic: str = CONTROL_NODES.name) -> ControlNodeCloud:
    """State of the control nodes of a PointCloud2, decoded by field name. Without the field `cut` the tissue is whole.

    Raises:
        MessageError: If the cloud is damaged or empty, a field is missing, or a number is not finite.
    """
    points = decode_cloud(message, topic)
    names = _names(points)
    missing = [name for name in (*_POSITION, *_REST, *_F, *_NUMBERS) if name not in (*names, "cut")]
    if missing:
        raise MessageError(f"{topic}: missing field {', '.join(missing[:4])}; see control_nodes in msg_conventions.md")
    if not len(points):
        raise MessageError(f"{topic}: there are no control nodes")
    state = ControlNodeCloud(
        _columns(points, _REST),
        _columns(points, _POSITION),
        _columns(points, _F).reshape(-1, 3, 3),
        int(points["model_sec"][0]) * NANOSECONDS + int(points["model_nanosec"][0]),
        int(points["cut"][0]) if "cut" in names else 0,
    )
    if not (np.isfinite(state.rest).all() and np.isfinite(state.positions).all() and np.isfinite(state.F).all()):
        raise MessageError(f"{topic}: a control node is not finite; the state was ignored")
    return state


def cut_number(triangles: np.ndarray) -> int:
    """Number of a cut surface: the CRC-32 of its corners [T, 3, 3] as little-endian float32. 0 = no cut."""
    return zlib.crc32(np.ascontiguousarray(triangles, "<f4").tobytes()) if len(triangles) else 0


_CUT_DTYPE = np.dtype([*((name, "<f4") for name in _POSITION), ("torn", "<u4")])


def encode_cut_surface(
    triangles: np.ndarray, model_stamp_ns: int, frame_id: str, types: MessageTypes = ros_types(), *, torn: np.ndarray | None = None
) -> Message:
    """PointCloud2 of the triangles of all cuts and tears, three points each.

    Args:
        triangles: Corners [T, 3, 3], metres, world, in the tissue at rest.
        model_stamp_ns: Stamp of the model, nanoseconds.
        frame_id: The world frame.
        types: Message classes to build; those of ROS by default.
        torn: Which of them tore [T], bool; tools cut the others. None: no tears.
    """
    points = np.empty(3 * len(triangles), _CUT_DTYPE)
    for number, name in enumerate(_POSITION):
        points[name] = triangles[..., number].reshape(-1)
    points["torn"] = 0 if torn is None else np.repeat(torn, 3)
    return _encode_cloud(points, model_stamp_ns, frame_id, types)


def decode_cut_surface(message: Message, topic: str = CUT_SURFACE.name) -> np.ndarray:
    """Triangles [T, 3, 3] float32 of all cuts and tears, metres, world, in the tissue at rest.

    Raises:
        MessageError: If the points are not triangles, or a number is not finite.
    """
    points = decode_cloud(message, topic)
    missing = [name for name in _POSITION if name not in _names(points)]
    if missing or len(points) % 3:
        lacking = f" without {', '.join(missing)}" if missing else ""
        raise MessageError(f"{topic}: expected three points with x, y and z for each triangle, got {len(points)} points{lacking}")
    triangles = _columns(points, _POSITION).reshape(-1, 3, 3)
    if not np.isfinite(triangles).all():
        raise MessageError(f"{topic}: a corner is not finite; the cut was ignored")
    return triangles


def decode_torn(message: Message, topic: str = CUT_SURFACE.name) -> np.ndarray:
    """Which triangles of a cut surface tore [T], bool; tools cut the others. Older recordings do not tell, and have none.

    Raises:
        MessageError: If the cloud is damaged.
    """
    points = decode_cloud(message, topic)
    return points["torn"][::3] > 0 if "torn" in _names(points) else np.zeros(len(points) // 3, bool)


@dataclass(frozen=True)
class StiffnessCloud:
    """What is known of the stiffness of the tissue, at control nodes at rest."""

    positions: np.ndarray  # [M, 3] float32, m, world
    young_modulus: np.ndarray  # [M] float32, Pa; median
    low: np.ndarray  # [M] float32, Pa, lower end of its interval
    high: np.ndarray  # [M] float32, Pa, upper end
    known: np.ndarray  # [M] bool


_STIFFNESS = (*_POSITION, "young_modulus", "low", "high")
_STIFFNESS_DTYPE = np.dtype([*((name, "<f4") for name in _STIFFNESS), ("known", "<u4")])


def encode_stiffness(stiffness: StiffnessCloud, model_stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """PointCloud2 of a map of stiffness.

    Args:
        stiffness: The map.
        model_stamp_ns: Stamp of the model, nanoseconds.
        frame_id: The world frame.
        types: Message classes to build; those of ROS by default.
    """
    points = np.empty(len(stiffness.positions), _STIFFNESS_DTYPE)
    for number, name in enumerate(_POSITION):
        points[name] = stiffness.positions[:, number]
    for name in ("young_modulus", "low", "high", "known"):
        points[name] = getattr(stiffness, name)
    return _encode_cloud(points, model_stamp_ns, frame_id, types)


def decode_stiffness(message: Message, topic: str = STIFFNESS_MAP.name) -> StiffnessCloud:
    """Map of stiffness of a PointCloud2, decoded by field name.

    Raises:
        MessageError: If the cloud is damaged or empty, a field is missing, or a modulus is not a finite number above zero.
    """
    points = decode_cloud(message, topic)
    missing = [name for name in (*_STIFFNESS, "known") if name not in _names(points)]
    if missing:
        raise MessageError(f"{topic}: missing field {', '.join(missing)}; see stiffness_map in msg_conventions.md")
    if not len(points):
        raise MessageError(f"{topic}: there are no points")
    positions, moduli = _columns(points, _POSITION), _columns(points, _STIFFNESS[3:])
    if not (np.isfinite(positions).all() and np.isfinite(moduli).all() and (moduli > 0).all()):
        raise MessageError(f"{topic}: a position is not finite, or a modulus is not a finite number above zero; the map was ignored")
    return StiffnessCloud(positions, moduli[:, 0], moduli[:, 1], moduli[:, 2], points["known"].astype(bool))


_THING = (*_POSITION, *_F)


def encode_thing_poses(poses: np.ndarray, stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """PointCloud2 of affine transforms [n, 4, 4] of links, metres, float64: where each is, and what it turns and scales by, row by row."""
    points = np.concatenate([poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9)], 1)
    return _encode_cloud(points.view([(name, "<f8") for name in _THING]).reshape(-1), stamp_ns, frame_id, types)


def decode_thing_poses(message: Message, topic: str = THING_POSES.name) -> np.ndarray:
    """Affine transforms [n, 4, 4] of the links of a thing, metres, in the frame of the header.

    Raises:
        MessageError: If the cloud is damaged, a field is missing, or a number is not finite.
    """
    points = decode_cloud(message, topic)
    if missing := [name for name in _THING if name not in _names(points)]:
        raise MessageError(f"{topic}: missing field {', '.join(missing[:4])}; see thing_poses in msg_conventions.md")
    numbers = np.stack([points[name].astype(np.float64) for name in _THING], 1)
    if not np.isfinite(numbers).all():
        raise MessageError(f"{topic}: a pose is not finite; all were ignored")
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = numbers[:, :3], numbers[:, 3:].reshape(-1, 3, 3)
    return poses
