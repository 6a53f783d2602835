"""numpy ⇄ ROS messages: the code twin of msg_conventions.md. Nothing else in the package encodes or decodes bytes.

Every encoder takes ``types``, the message classes to build: `ros_types()` for a running graph, `bag_types()` for bag files
(no ROS installation needed). Decoders accept messages of either. Images and clouds cross at memcpy speed: byte fields are
filled through ``array.array`` and read through ``np.frombuffer``.
"""

import array
import dataclasses
import functools
import importlib
import importlib.util
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.cameras import make_pose, matrix_to_quat
from endo_sim_ros.core.gaussians import GaussianModel, ModelError, from_columns, ply_fields, to_columns
from endo_sim_ros.core.light import Light


class MessageError(ValueError):
    """A message that cannot be used; the sentence names the topic, the field and what to do."""


# ---------------------------------------------------------------------------------------------------------------------
# Topics
# ---------------------------------------------------------------------------------------------------------------------


class Topic(NamedTuple):
    """A topic of the contract: relative name, message type, and quality of service (`stream` or `latched`)."""

    name: str
    type: str
    qos: str = "stream"


LEFT_IMAGE = Topic("endoscope/left/image_raw", "sensor_msgs/msg/Image")
LEFT_COMPRESSED = Topic("endoscope/left/image_raw/compressed", "sensor_msgs/msg/CompressedImage")
LEFT_INFO = Topic("endoscope/left/camera_info", "sensor_msgs/msg/CameraInfo")
RIGHT_IMAGE = Topic("endoscope/right/image_raw", "sensor_msgs/msg/Image")
RIGHT_COMPRESSED = Topic("endoscope/right/image_raw/compressed", "sensor_msgs/msg/CompressedImage")
RIGHT_INFO = Topic("endoscope/right/camera_info", "sensor_msgs/msg/CameraInfo")
DEPTH = Topic("endoscope/left/depth", "sensor_msgs/msg/Image")
MASK = Topic("endoscope/left/mask", "sensor_msgs/msg/Image")
CAMERA_POSE = Topic("ECM/measured_cp", "geometry_msgs/msg/PoseStamped")

GAUSSIANS = Topic("gaussians", "sensor_msgs/msg/PointCloud2", "latched")
TRAINING_CAMERAS = Topic("training_cameras", "geometry_msgs/msg/PoseArray", "latched")
TRAINING_CAMERA_INFO = Topic("training_camera_info", "sensor_msgs/msg/CameraInfo", "latched")
CONTROL_NODES = Topic("control_nodes", "sensor_msgs/msg/PointCloud2")
CUT_SURFACE = Topic("cut_surface", "sensor_msgs/msg/PointCloud2", "latched")
RENDERED_IMAGE = Topic("rendered/image_raw", "sensor_msgs/msg/Image")
RENDERED_INFO = Topic("rendered/camera_info", "sensor_msgs/msg/CameraInfo")
RENDERED_POSE = Topic("rendered/camera_pose", "geometry_msgs/msg/PoseStamped")
RENDERED_DEPTH = Topic("rendered/depth/image", "sensor_msgs/msg/Image")
TOOL_MARKERS = Topic("tool_markers", "visualization_msgs/msg/MarkerArray")
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock")


def tool_pose(arm: str) -> Topic:
    return Topic(f"{arm}/measured_cp", "geometry_msgs/msg/PoseStamped")


def tool_pose_command(arm: str) -> Topic:
    return Topic(f"{arm}/servo_cp", "geometry_msgs/msg/PoseStamped")


def tool_wrench(arm: str) -> Topic:
    return Topic(f"{arm}/body/servo_cf", "geometry_msgs/msg/WrenchStamped")


def tool_jaw(arm: str) -> Topic:
    return Topic(f"{arm}/jaw/servo_jp", "sensor_msgs/msg/JointState")


def tool_jaw_state(arm: str) -> Topic:
    return Topic(f"{arm}/jaw/measured_js", "sensor_msgs/msg/JointState")


def tool_jaw_move(arm: str) -> Topic:
    return Topic(f"{arm}/jaw/move_jp", "sensor_msgs/msg/JointState")


def tool_jaw_setpoint(arm: str) -> Topic:
    return Topic(f"{arm}/jaw/setpoint_js", "sensor_msgs/msg/JointState")


def tool_move(arm: str) -> Topic:
    return Topic(f"{arm}/move_cp", "geometry_msgs/msg/PoseStamped")


def tool_setpoint(arm: str) -> Topic:
    return Topic(f"{arm}/setpoint_cp", "geometry_msgs/msg/PoseStamped")


def tool_state(arm: str) -> Topic:
    return Topic(f"{arm}/operating_state", _crtk_type("OperatingState"), "latched")


def tool_state_command(arm: str) -> Topic:
    return Topic(f"{arm}/state_command", _crtk_type("StringStamped"))


@functools.cache
def _crtk_type(name: str) -> str:
    """A type of CRTK's own messages where they are installed, else a plain string."""
    return f"crtk_msgs/msg/{name}" if importlib.util.find_spec("crtk_msgs") else "std_msgs/msg/String"


def tool_cut(arm: str) -> Topic:
    return Topic(f"{arm}/cut", "sensor_msgs/msg/Joy")


def tool_reaction(arm: str) -> Topic:
    return Topic(f"{arm}/body/measured_cf", "geometry_msgs/msg/WrenchStamped")


RECORDING_TOPICS = (
    LEFT_IMAGE, LEFT_COMPRESSED, LEFT_INFO, RIGHT_IMAGE, RIGHT_COMPRESSED, RIGHT_INFO, DEPTH, MASK, CAMERA_POSE,
)  # fmt: skip
MODEL_TOPICS = (GAUSSIANS, TRAINING_CAMERAS, TRAINING_CAMERA_INFO)
TOOL_TOPICS = (  # of one arm; its states are not among them, as their type is not always there
    tool_pose, tool_pose_command, tool_move, tool_setpoint, tool_wrench, tool_jaw, tool_jaw_move, tool_jaw_state, tool_jaw_setpoint,
    tool_cut, tool_reaction,
)  # fmt: skip
RENDERED_TOPICS = (RENDERED_INFO, RENDERED_POSE, RENDERED_DEPTH, RENDERED_IMAGE)


def all_topics(arms: tuple[str, ...] = ("PSM1",)) -> tuple[Topic, ...]:
    """Every topic of the contract for the given arms."""
    tools = tuple(make(arm) for arm in arms for make in TOOL_TOPICS)
    return RECORDING_TOPICS + MODEL_TOPICS + (CONTROL_NODES, CUT_SURFACE) + RENDERED_TOPICS + tools + (TOOL_MARKERS, DIAGNOSTICS, CLOCK)


# ---------------------------------------------------------------------------------------------------------------------
# Message classes
# ---------------------------------------------------------------------------------------------------------------------

_PACKAGES = {
    "builtin_interfaces": ("Time", "Duration"),
    "rosgraph_msgs": ("Clock",),
    "std_msgs": ("Header", "ColorRGBA"),
    "geometry_msgs": (
        "Point", "Quaternion", "Pose", "PoseStamped", "PoseArray", "Vector3", "Wrench", "WrenchStamped",
    ),
    "sensor_msgs": ("Image", "CompressedImage", "CameraInfo", "RegionOfInterest", "PointCloud2", "PointField", "JointState", "Joy"),
    "visualization_msgs": ("Marker", "MarkerArray", "UVCoordinate", "MeshFile"),
    "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
}  # fmt: skip
_FULL_NAMES = {name: f"{package}/msg/{name}" for package, names in _PACKAGES.items() for name in names}


class _RosTypes:
    """Message classes of the ROS installation, by short name."""

    def __getattr__(self, name: str) -> type:
        return ros_class(_FULL_NAMES[name])

    @staticmethod
    def sequence(values: np.ndarray) -> array.array:
        """A primitive sequence field; assigning numpy arrays directly is checked element by element and 1000 times slower."""
        values = np.ascontiguousarray(values)
        field = array.array({"uint8": "B", "int32": "i", "float32": "f", "float64": "d"}[values.dtype.name])
        field.frombytes(values.data.cast("B") if values.size else b"")
        return field


class _BagTypes:
    """Message classes of the rosbags library, by short name."""

    def __init__(self):
        from rosbags.typesys import Stores, get_typestore

        self.typestore = get_typestore(Stores.ROS2_JAZZY)

    def __getattr__(self, name: str) -> type:
        return self.typestore.types[_FULL_NAMES[name]]

    @staticmethod
    def sequence(values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(values).reshape(-1)


@functools.cache
def ros_types() -> _RosTypes:
    """Message classes for a running graph."""
    return _RosTypes()


@functools.cache
def bag_types() -> _BagTypes:
    """Message classes for bag files; its ``typestore`` serialises them."""
    return _BagTypes()


@functools.cache
def ros_class(full_name: str) -> type:
    """The class of a message type name such as ``sensor_msgs/msg/Image``.

    Raises:
        MessageError: If the package that defines it is not installed.
    """
    package, _, name = full_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise MessageError(f"message type {full_name} is not installed; install the package {package}") from None


# ---------------------------------------------------------------------------------------------------------------------
# Headers
# ---------------------------------------------------------------------------------------------------------------------


def stamp_to_ns(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def _header(types: Any, stamp_ns: int, frame_id: str) -> Any:
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return types.Header(stamp=types.Time(sec=sec, nanosec=nanosec), frame_id=frame_id)


def check_frame(message: Any, allowed: Iterable[str], topic: str) -> str:
    """The header's frame, which must be one of the allowed ones."""
    frame = message.header.frame_id.lstrip("/")
    allowed = [name.lstrip("/") for name in allowed]
    if frame not in allowed:
        names = " or ".join(repr(name) for name in allowed)
        raise MessageError(
            f"{topic}: unknown frame {frame!r}; this graph knows {names} (set the parameter world_frame, name it in the"
            " parameter frames, or republish in that frame)"
        )
    return frame


# ---------------------------------------------------------------------------------------------------------------------
# Images
# ---------------------------------------------------------------------------------------------------------------------

_COLOR_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}


def _pixels(message: Any, dtype: np.dtype, channels: int, topic: str) -> np.ndarray:
    """View of the pixel data [H, W, channels]; honours row padding and byte order."""
    dtype = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    height, width, row = message.height, message.width, message.width * channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if height == 0 or width == 0:
        raise MessageError(f"{topic}: the image is empty ({width}×{height})")
    if message.step < row or data.size < message.step * height:
        raise MessageError(
            f"{topic}: {data.size} bytes and step {message.step} do not hold a {width}×{height} {message.encoding} image, "
            f"which needs {row} bytes a row; the publisher's size and data disagree"
        )
    rows = data[: message.step * height].reshape(height, message.step)[:, :row]
    return rows.view(dtype).reshape(height, width, channels) if rows.flags.c_contiguous else (
        np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)
    )  # fmt: skip


def decode_image(message: Any, topic: str = LEFT_IMAGE.name) -> np.ndarray:
    """RGB image [H, W, 3] uint8 of an Image or CompressedImage; a view of the message where the encoding is rgb8."""
    if not hasattr(message, "encoding"):
        data = np.frombuffer(message.data, np.uint8)
        try:
            pixels = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        except cv2.error:  # its size is beyond OPENCV_IO_MAX_IMAGE_PIXELS
            pixels = None
        if pixels is None:
            what = f"{data.size} bytes of format {message.format!r}"
            raise MessageError(f"{topic}: {what} are not a readable jpeg or png image of at most 64 megapixels")
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    if message.encoding not in _COLOR_CHANNELS:
        raise MessageError(f"{topic}: encoding {message.encoding!r} is not supported; publish rgb8, bgr8 or mono8")
    pixels = _pixels(message, np.uint8, _COLOR_CHANNELS[message.encoding], topic)
    if pixels.shape[2] == 1:
        return np.repeat(pixels, 3, 2)
    swap = message.encoding in ("bgr8", "bgra8", "8UC3")
    return np.ascontiguousarray(pixels[..., 2::-1]) if swap else pixels[..., :3]


def decode_depth(message: Any, topic: str = DEPTH.name) -> np.ndarray:
    """Depth [H, W] float32, metres, 0 = no measurement, of a 32FC1 (m) or 16UC1 (mm) Image."""
    if message.encoding == "32FC1":
        depth = _pixels(message, np.float32, 1, topic)[..., 0].astype(np.float32)
    elif message.encoding in ("16UC1", "mono16"):
        depth = _pixels(message, np.uint16, 1, topic)[..., 0].astype(np.float32) * np.float32(1e-3)
    else:
        raise MessageError(f"{topic}: encoding {message.encoding!r} is not supported; publish 32FC1 (metres) or 16UC1 (millimetres)")
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def decode_mask(message: Any, topic: str = MASK.name) -> np.ndarray:
    """Mask [H, W] uint8, 255 = tissue, 0 = ignore, of a mono8 Image."""
    if message.encoding not in ("mono8", "8UC1"):
        raise MessageError(f"{topic}: encoding {message.encoding!r} is not supported; publish mono8 with 255 = tissue")
    return np.where(_pixels(message, np.uint8, 1, topic)[..., 0] >= 128, np.uint8(255), np.uint8(0))


_IMAGE_ENCODINGS = {("uint8", 3): "rgb8", ("uint8", 1): "mono8", ("float32", 1): "32FC1"}


def encode_image(pixels: np.ndarray, stamp_ns: int, frame_id: str, types: Any = None) -> Any:
    """Image of uint8 [H, W, 3] (rgb8), uint8 [H, W] (mono8) or float32 [H, W] (32FC1, metres)."""
    types = types or ros_types()
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    encoding = _IMAGE_ENCODINGS.get((pixels.dtype.name, channels))
    if encoding is None:
        raise MessageError(f"encode_image: no encoding for dtype {pixels.dtype} with {channels} channels")
    return types.Image(
        header=_header(types, stamp_ns, frame_id),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.shape[1] * channels * pixels.itemsize,
        data=types.sequence(np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)),
    )


# ---------------------------------------------------------------------------------------------------------------------
# Cameras and poses
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CameraInfo:
    """What a sensor_msgs/CameraInfo says: intrinsics, distortion and rectification of one eye, in pixels and metres."""

    K: np.ndarray  # [3, 3] of the raw image
    D: np.ndarray  # distortion coefficients (plumb_bob / rational_polynomial), all zero when rectified
    R: np.ndarray  # [3, 3] rectifying rotation
    P: np.ndarray  # [3, 4] projection of the rectified image, P[0, 3] = −fx·B for a right eye
    width: int
    height: int

    @property
    def rectified(self) -> bool:
        """Whether images of this camera are rectified already."""
        return not self.D.any() and np.allclose(self.R, np.eye(3)) and np.allclose(self.K, self.P[:, :3])

    def same_as(self, other: "CameraInfo") -> bool:
        """Whether another one says the same."""
        mine, others = (self.width, self.height), (other.width, other.height)
        return mine == others and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in ("K", "D", "R", "P"))

    @property
    def baseline(self) -> float:
        """Distance to the left eye along +x, metres (0 for a left or single eye)."""
        return float(-self.P[0, 3] / self.P[0, 0])

    def rectify(self, image: np.ndarray, nearest: bool = False) -> np.ndarray:
        """Rectified image; labels and depths are resampled with ``nearest``."""
        if self.rectified:
            return image
        return cv2.remap(image, *self._maps, cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR)

    @functools.cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        size = (self.width, self.height)
        return cv2.initUndistortRectifyMap(self.K, self.D, self.R, self.P[:, :3], size, cv2.CV_32FC1)

    @functools.cached_property
    def seen(self) -> np.ndarray:
        """Mask [H, W] uint8 of the rectified image: 255 where the raw image reaches, 0 in the border beyond it."""
        return self.rectify(np.full((self.height, self.width), 255, np.uint8), nearest=True)


_DISTORTION_MODELS = ("", "plumb_bob", "rational_polynomial")


def decode_camera_info(message: Any, topic: str = LEFT_INFO.name) -> CameraInfo:
    K = np.asarray(message.k, np.float64).reshape(3, 3)
    D = np.asarray(message.d, np.float64)
    R = np.asarray(message.r, np.float64).reshape(3, 3)
    P = np.asarray(message.p, np.float64).reshape(3, 4)
    for name, value in (("K", K), ("D", D), ("R", R), ("P", P)):
        if not np.isfinite(value).all():
            raise MessageError(f"{topic}: {name} is not finite; calibrate the camera")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise MessageError(f"{topic}: K has focal lengths {K[0, 0]:g} and {K[1, 1]:g}; the camera is not calibrated")
    if message.width == 0 or message.height == 0:
        raise MessageError(f"{topic}: the image size is {message.width}×{message.height}")
    if message.distortion_model not in _DISTORTION_MODELS and D.any():
        raise MessageError(f"{topic}: distortion_model {message.distortion_model!r} is not supported; publish rectified images (D = 0)")
    if D.size not in (0, 4, 5, 8, 12, 14) or np.abs(D).max(initial=0) > 1e3:
        raise MessageError(f"{topic}: D = {D.tolist()} is not a set of OpenCV distortion coefficients; calibrate the camera")
    if not R.any():
        R = np.eye(3)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2:
        raise MessageError(f"{topic}: R is not a rotation; calibrate the camera, or set it to one for a single eye")
    if P[0, 0] <= 0 or P[1, 1] <= 0:
        P = np.hstack([K, np.zeros((3, 1))])
    if not np.allclose(P[2], [0, 0, 1, 0]):
        raise MessageError(f"{topic}: the last row of P is {P[2].tolist()}, not 0 0 1 0; calibrate the camera")
    return CameraInfo(K, D, R, P, message.width, message.height)


def encode_camera_info(
    K: np.ndarray, width: int, height: int, stamp_ns: int, frame_id: str, baseline: float = 0.0, types: Any = None
) -> Any:
    """CameraInfo of a rectified eye; ``baseline`` (m) is that of a right eye, whose P[0, 3] is −fx·B."""
    types = types or ros_types()
    P = np.hstack([K, np.zeros((3, 1))])
    P[0, 3] = -K[0, 0] * baseline
    flat = lambda matrix: np.asarray(matrix, np.float64).reshape(-1)  # noqa: E731
    return types.CameraInfo(
        header=_header(types, stamp_ns, frame_id),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=types.sequence(np.zeros(5)),
        k=flat(K),
        r=flat(np.eye(3)),
        p=flat(P),
        binning_x=0,
        binning_y=0,
        roi=types.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def _decode_pose(pose: Any, topic: str) -> np.ndarray:
    p, q = pose.position, pose.orientation
    position, quat = np.array([p.x, p.y, p.z]), np.array([q.w, q.x, q.y, q.z])
    if not (np.isfinite(position).all() and np.isfinite(quat).all()):
        raise MessageError(f"{topic}: the pose is not finite (position {position}, quaternion wxyz {quat})")
    norm = np.linalg.norm(quat)
    if abs(norm - 1) > 0.01:
        raise MessageError(f"{topic}: the orientation's quaternion has length {norm:.3g}, not 1; normalise it before publishing")
    return make_pose(position, quat)


def decode_pose(message: Any, frames: str | Mapping[str, np.ndarray], topic: str) -> np.ndarray:
    """Pose [4, 4] in the world of a PoseStamped; the quaternion must have unit length within 1 %.

    Args:
        message: The message.
        frames: Name of the world frame, or the poses [4, 4] of known frames in the world, by name.
        topic: For errors.
    """
    frame = check_frame(message, (frames,) if isinstance(frames, str) else frames, topic)
    pose = _decode_pose(message.pose, topic)
    return pose if isinstance(frames, str) else frames[frame] @ pose


def _encode_pose(types: Any, pose: np.ndarray) -> Any:
    w, x, y, z = (float(value) for value in matrix_to_quat(pose[:3, :3]))
    px, py, pz = (float(value) for value in pose[:3, 3])
    return types.Pose(position=types.Point(x=px, y=py, z=pz), orientation=types.Quaternion(x=x, y=y, z=z, w=w))


def encode_pose(pose: np.ndarray, stamp_ns: int, frame_id: str, types: Any = None) -> Any:
    """PoseStamped of a rigid transform [4, 4]."""
    types = types or ros_types()
    return types.PoseStamped(header=_header(types, stamp_ns, frame_id), pose=_encode_pose(types, pose))


def encode_poses(poses: list[np.ndarray], stamp_ns: int, frame_id: str, types: Any = None) -> Any:
    """PoseArray of rigid transforms [4, 4]."""
    types = types or ros_types()
    return types.PoseArray(header=_header(types, stamp_ns, frame_id), poses=[_encode_pose(types, pose) for pose in poses])


def decode_poses(message: Any, topic: str = TRAINING_CAMERAS.name) -> np.ndarray:
    """Poses [V, 4, 4] of a PoseArray."""
    return np.array([_decode_pose(pose, topic) for pose in message.poses]).reshape(-1, 4, 4)


# ---------------------------------------------------------------------------------------------------------------------
# Tools
# ---------------------------------------------------------------------------------------------------------------------


def decode_wrench(message: Any, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Force [3] (N) and torque [3] (N·m) in the axes of the header's frame."""
    f, t = message.wrench.force, message.wrench.torque
    force, torque = np.array([f.x, f.y, f.z]), np.array([t.x, t.y, t.z])
    if not (np.isfinite(force).all() and np.isfinite(torque).all()):
        raise MessageError(f"{topic}: the wrench is not finite (force {force}, torque {torque}); it was ignored")
    return force, torque


def encode_wrench(force: np.ndarray, torque: np.ndarray, stamp_ns: int, frame_id: str, types: Any = None) -> Any:
    """WrenchStamped of a force [3] (N) and a torque [3] (N·m)."""
    types = types or ros_types()
    vector = lambda v: types.Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))  # noqa: E731
    wrench = types.Wrench(force=vector(force), torque=vector(torque))
    return types.WrenchStamped(header=_header(types, stamp_ns, frame_id), wrench=wrench)


def decode_jaw(message: Any, topic: str) -> float:
    """Opening angle of the jaw, radians, of a JointState with one position."""
    positions = np.asarray(message.position, np.float64)
    if positions.size != 1 or not np.isfinite(positions).all():
        raise MessageError(f"{topic}: expected one finite jaw angle in position, got {positions.tolist()}")
    return float(positions[0])


def decode_cut(message: Any, topic: str) -> bool:
    """Whether the first button of a Joy is pressed: the edge of the tool cuts."""
    if not len(message.buttons):
        raise MessageError(f"{topic}: expected a button, 1 = cuts, got none")
    return bool(message.buttons[0])


def encode_cut(cutting: bool, stamp_ns: int, types: Any = None) -> Any:
    """Joy with one button, pressed while the edge of a tool cuts."""
    types = types or ros_types()
    return types.Joy(
        header=_header(types, stamp_ns, ""),
        axes=types.sequence(np.zeros(0, np.float32)),
        buttons=types.sequence(np.array([cutting], np.int32)),
    )


def encode_operating_state(state: str, homed: bool, busy: bool, stamp_ns: int) -> Any:
    """OperatingState of CRTK; without crtk_msgs a String of the state and, while a move is under way, BUSY."""
    kind = ros_class(_crtk_type("OperatingState"))
    if kind.__name__ == "String":
        return kind(data=f"{state} BUSY" if busy else state)
    return kind(header=_header(ros_types(), stamp_ns, ""), state=state, is_homed=homed, is_busy=busy)


def decode_state_command(message: Any) -> str:
    """Command in a StringStamped of CRTK or a String."""
    return (message.data if hasattr(message, "data") else message.string).strip()


def encode_jaw(angle: float, stamp_ns: int, types: Any = None) -> Any:
    """JointState of a jaw's opening angle, radians."""
    types = types or ros_types()
    empty = types.sequence(np.zeros(0))
    return types.JointState(
        header=_header(types, stamp_ns, ""),
        name=["jaw"],
        position=types.sequence(np.array([angle], np.float64)),
        velocity=empty,
        effort=empty,
    )


@dataclass(frozen=True)
class ToolDisplay:
    """What is shown of one tool; world axes."""

    arm: str
    tip: np.ndarray  # [3] m
    force: np.ndarray  # [3] N, on the tissue
    reaction: np.ndarray  # [3] N, on the tool
    held: np.ndarray  # [K, 3] m, nodes that the tool holds


METRES_PER_NEWTON = 0.01  # length of the arrows
_MARKER_RADIUS = 0.0015  # m
_SPHERE, _ARROW, _POINTS = 2, 0, 8  # Marker.type
_ADD, _DELETE = 0, 2  # Marker.action


def encode_tool_markers(tools: list[ToolDisplay], stamp_ns: int, frame_id: str, types: Any = None) -> Any:
    """MarkerArray for RViz and Foxglove: of each tool the tip, the force on the tissue, the reaction and the held nodes.

    The namespace of a marker is its arm; ids 0 to 3 are in that order. Arrows are 1 cm per newton. What there is nothing
    of is deleted.
    """
    types = types or ros_types()
    point = lambda p: types.Point(x=float(p[0]), y=float(p[1]), z=float(p[2]))  # noqa: E731
    markers = []

    def add(tool: ToolDisplay, kind: int, points: list, size: tuple, color: tuple, there: bool) -> None:
        position = tool.tip if kind == _SPHERE else np.zeros(3)
        orientation = types.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
        marker = types.Marker(
            header=_header(types, stamp_ns, frame_id),
            ns=tool.arm,
            id=len(markers) % 4,
            type=kind,
            action=_ADD if there else _DELETE,
            pose=types.Pose(position=point(position), orientation=orientation),
            scale=types.Vector3(**dict(zip("xyz", size))),
            color=types.ColorRGBA(**dict(zip("rgba", color))),
            lifetime=types.Duration(sec=0, nanosec=0),
            frame_locked=False,
            points=[point(p) for p in points],
            colors=[],
            texture_resource="",
            texture=types.CompressedImage(header=_header(types, 0, ""), format="", data=types.sequence(np.zeros(0, np.uint8))),
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=types.MeshFile(filename="", data=types.sequence(np.zeros(0, np.uint8))),
            mesh_use_embedded_materials=False,
        )
        markers.append(marker)

    r = _MARKER_RADIUS
    for tool in tools:
        add(tool, _SPHERE, [], (2 * r, 2 * r, 2 * r), (0.9, 0.9, 0.9, 1.0), True)
        for vector, color in ((tool.force, (1.0, 0.55, 0.1, 1.0)), (tool.reaction, (0.2, 0.6, 1.0, 1.0))):
            end = tool.tip + METRES_PER_NEWTON * vector
            add(tool, _ARROW, [tool.tip, end], (r / 2, r, 2 * r), color, bool(np.any(vector)))
        add(tool, _POINTS, list(tool.held), (r, r, 0.0), (0.3, 1.0, 0.4, 1.0), len(tool.held) > 0)
    return types.MarkerArray(markers=markers)


def encode_clock(stamp_ns: int, types: Any = None) -> Any:
    """Clock message."""
    types = types or ros_types()
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return types.Clock(clock=types.Time(sec=sec, nanosec=nanosec))


# ---------------------------------------------------------------------------------------------------------------------
# Point clouds
# ---------------------------------------------------------------------------------------------------------------------

_POINT_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField.datatype
_POINT_DATATYPES = {name: number for number, name in _POINT_FORMATS.items()}


def decode_cloud(message: Any, topic: str) -> np.ndarray:
    """Structured array [N] of a PointCloud2, by field name, whatever its offsets and byte order."""
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


def _encode_cloud(points: np.ndarray, stamp_ns: int, frame_id: str, types: Any) -> Any:
    fields = [
        types.PointField(name=name, offset=offset, datatype=_POINT_DATATYPES[dtype.str[1:]], count=1)
        for name, (dtype, offset) in ((name, points.dtype.fields[name][:2]) for name in points.dtype.names)
    ]
    return types.PointCloud2(
        header=_header(types, stamp_ns, frame_id),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.itemsize * len(points),
        data=types.sequence(points.view(np.uint8).reshape(-1)),
        is_dense=True,
    )


def encode_gaussians(model: GaussianModel, stamp_ns: int, frame_id: str, types: Any = None) -> Any:
    """PointCloud2 with INRIA's field names (float32) plus packed `rgb` and `light`, if any; the stamp identifies the model."""
    r, g, b = (model.base_colors.detach().cpu().numpy() * 255 + 0.5).astype(np.uint32).T
    columns, names = [to_columns(model), (r << 16 | g << 8 | b).view(np.float32)[:, None]], [*ply_fields(model.sh_degree), "rgb"]
    if model.light is not None:
        numbers = np.float32(dataclasses.astuple(model.light))
        if len(model) < len(numbers):
            raise MessageError(f"{GAUSSIANS.name}: a model with a light needs {len(numbers)} Gaussians, got {len(model)}")
        columns.append(np.pad(numbers, (0, len(model) - len(numbers)))[:, None])
        names.append("light")
    points = np.concatenate(columns, 1)
    return _encode_cloud(points.view([(name, "<f4") for name in names]).reshape(-1), stamp_ns, frame_id, types or ros_types())


def decode_gaussians(message: Any, topic: str = GAUSSIANS.name) -> GaussianModel:
    """Gaussian model of a PointCloud2, decoded by field name."""
    points = decode_cloud(message, topic)
    if not len(points):
        raise MessageError(f"{topic}: the model is empty; reconstruct a scene first")
    try:
        model = from_columns({name: points[name] for name in points.dtype.names}, topic)
        if "light" in points.dtype.names:
            numbers = points["light"][: len(dataclasses.fields(Light))].tolist()
            model = dataclasses.replace(model, light=Light(*numbers))
        return model
    except (ModelError, ValueError, TypeError) as error:
        raise MessageError(str(error)) from error


@dataclass(frozen=True)
class ControlNodeCloud:
    """State of the control nodes at one time, for the model whose stamp is ``model_stamp_ns``.

    ``cut`` is the number of the cut surface, see `cut_number`; 0 = whole tissue."""

    rest: np.ndarray  # [M, 3] float32, m, world
    positions: np.ndarray  # [M, 3] float32, m, world
    F: np.ndarray  # [M, 3, 3] float32, deformation gradient
    model_stamp_ns: int
    cut: int = 0


_NODE_DTYPE = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "rest_x", "rest_y", "rest_z")]
    + [(f"f_{row}{column}", "<f4") for row in range(3) for column in range(3)]
    + [("model_sec", "<u4"), ("model_nanosec", "<u4"), ("cut", "<u4")]
)


def encode_control_nodes(state: ControlNodeCloud, stamp_ns: int, frame_id: str, types: Any = None) -> Any:
    """PointCloud2 of the control nodes: position, rest position, F row by row, stamp of their model, number of their cut surface."""
    points = np.empty(len(state.rest), _NODE_DTYPE)
    floats = points.view(np.float32).reshape(len(points), -1)
    floats[:, 0:3] = state.positions
    floats[:, 3:6] = state.rest
    floats[:, 6:15] = state.F.reshape(-1, 9)
    points["model_sec"], points["model_nanosec"] = divmod(state.model_stamp_ns, 1_000_000_000)
    points["cut"] = state.cut
    return _encode_cloud(points, stamp_ns, frame_id, types or ros_types())


def decode_control_nodes(message: Any, topic: str = CONTROL_NODES.name) -> ControlNodeCloud:
    """State of the control nodes of a PointCloud2, decoded by field name."""
    points = decode_cloud(message, topic)
    names = points.dtype.names or ()
    missing = [name for name in _NODE_DTYPE.names if name not in (*names, "cut")]  # recordings without cuts are fine
    if missing:
        raise MessageError(f"{topic}: missing field {', '.join(missing[:4])}; see control_nodes in msg_conventions.md")
    if not len(points):
        raise MessageError(f"{topic}: there are no control nodes")
    stack = lambda names: np.stack([points[name].astype(np.float32) for name in names], 1)  # noqa: E731
    state = ControlNodeCloud(
        stack(["rest_x", "rest_y", "rest_z"]),
        stack(["x", "y", "z"]),
        stack(_NODE_DTYPE.names[6:15]).reshape(-1, 3, 3),
        int(points["model_sec"][0]) * 1_000_000_000 + int(points["model_nanosec"][0]),
        int(points["cut"][0]) if "cut" in names else 0,
    )
    if not (np.isfinite(state.rest).all() and np.isfinite(state.positions).all() and np.isfinite(state.F).all()):
        raise MessageError(f"{topic}: a control node is not finite; the state was ignored")
    return state


def cut_number(triangles: np.ndarray) -> int:
    """Number of a cut surface: the CRC-32 of the bytes of its corners [T, 3, 3] as little endian float32; 0 = no cut."""
    return zlib.crc32(np.ascontiguousarray(triangles, "<f4").tobytes()) if len(triangles) else 0


def encode_cut_surface(triangles: np.ndarray, model_stamp_ns: int, frame_id: str, types: Any = None) -> Any:
    """PointCloud2 of the triangles [T, 3, 3] (m, in the tissue at rest) of all cuts, three points each; stamped as the model."""
    points = np.ascontiguousarray(triangles, "<f4").reshape(-1, 3)
    return _encode_cloud(points.view([(name, "<f4") for name in "xyz"]).reshape(-1), model_stamp_ns, frame_id, types or ros_types())


def decode_cut_surface(message: Any, topic: str = CUT_SURFACE.name) -> np.ndarray:
    """Triangles [T, 3, 3] float32, m, in the tissue at rest, of all cuts."""
    points = decode_cloud(message, topic)
    missing = [name for name in "xyz" if name not in (points.dtype.names or ())]
    if missing or len(points) % 3:
        raise MessageError(f"{topic}: expected three points with x, y and z for each triangle, got {len(points)} points without {missing}")
    triangles = np.stack([points[name].astype(np.float32) for name in "xyz"], 1).reshape(-1, 3, 3)
    if not np.isfinite(triangles).all():
        raise MessageError(f"{topic}: a corner is not finite; the cut was ignored")
    return triangles


# ---------------------------------------------------------------------------------------------------------------------
# Diagnostics
# ---------------------------------------------------------------------------------------------------------------------

OK, WARN, ERROR = 0, 1, 2
_LEVELS = (b"\x00", b"\x01", b"\x02")


def encode_diagnostics(name: str, level: int, text: str, values: dict[str, Any], stamp_ns: int, types: Any = None) -> Any:
    """DiagnosticArray with one status: node name, level (OK, WARN, ERROR), one sentence, and key-value pairs."""
    types = types or ros_types()
    status = types.DiagnosticStatus(
        level=_LEVELS[level] if isinstance(types, _RosTypes) else level,
        name=name,
        message=text,
        hardware_id="endo_sim_ros",
        values=[types.KeyValue(key=str(key), value=str(value)) for key, value in values.items()],
    )
    return types.DiagnosticArray(header=_header(types, stamp_ns, ""), status=[status])


def decode_diagnostics(message: Any) -> list[tuple[str, int, str, dict[str, str]]]:
    """(name, level, text, values) of every status."""
    level = lambda value: value[0] if isinstance(value, bytes) else int(value)  # noqa: E731
    return [
        (status.name, level(status.level), status.message, {pair.key: pair.value for pair in status.values}) for status in message.status
    ]
