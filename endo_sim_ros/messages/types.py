"""What encoders and decoders share: the classes of messages, of a ROS installation or of the rosbags library, and their error.

Encoders take the classes as ``types``. Byte fields are filled through ``sequence``, so that images and clouds cross at memcpy speed.
"""

import array
import functools
import importlib
from typing import Any

import numpy as np

__all__ = ["Message", "MessageError", "MessageTypes", "bag_types", "crtk_type", "ros_class", "ros_types"]


class MessageError(ValueError):
    """A message that cannot be used. The sentence names the topic, the field and what to do."""


Message = Any  # an instance of a message class, of ROS or of rosbags: both have the same fields

MESSAGE_PACKAGES = {
    "builtin_interfaces": ("Time",),
    "rosgraph_msgs": ("Clock",),
    "std_msgs": ("Header", "ColorRGBA", "String", "Empty", "Float64", "Float64MultiArray", "MultiArrayDimension", "MultiArrayLayout"),
    "geometry_msgs": (
        "Point",
        "Quaternion",
        "Pose",
        "PoseStamped",
        "PoseArray",
        "Vector3",
        "Wrench",
        "WrenchStamped",
        "Twist",
        "TwistStamped",
    ),  # fmt: skip
    "sensor_msgs": ("Image", "CompressedImage", "CameraInfo", "RegionOfInterest", "PointCloud2", "PointField", "JointState", "Joy"),
    "visualization_msgs": ("Marker", "MarkerArray"),
    "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
}
_FULL_NAMES = {name: f"{package}/msg/{name}" for package, names in MESSAGE_PACKAGES.items() for name in names}
_TYPECODES = {"uint8": "B", "int32": "i", "float32": "f", "float64": "d"}  # of array.array


class RosTypes:
    """Message classes of the ROS installation, by short name: ``ros_types().Image``."""

    def __getattr__(self, name: str) -> type:
        return ros_class(_FULL_NAMES[name])

    @staticmethod
    def sequence(values: np.ndarray) -> array.array:
        """Content of a primitive sequence field. rclpy checks an array assigned directly element by element, a thousand times slower."""
        values = np.ascontiguousarray(values)
        field = array.array(_TYPECODES[values.dtype.name])
        field.frombytes(values.data.cast("B") if values.size else b"")
        return field


class BagTypes:
    """Message classes of the rosbags library, by short name; ``typestore`` serialises them."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.typestore = get_typestore(Stores.ROS2_JAZZY)

    def __getattr__(self, name: str) -> type:
        return self.typestore.types[_FULL_NAMES[name]]

    @staticmethod
    def sequence(values: np.ndarray) -> np.ndarray:
        """Content of a primitive sequence field [N]."""
        return np.ascontiguousarray(values).reshape(-1)


MessageTypes = RosTypes | BagTypes


@functools.cache
def ros_types() -> RosTypes:
    """Message classes for a running graph."""
    return RosTypes()


@functools.cache
def bag_types() -> BagTypes:
    """Message classes for bag files. They need no ROS installation."""
    return BagTypes()


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


@functools.cache
def crtk_type(name: str) -> str:
    """Full name of a type of ``crtk_msgs`` where that package is installed, not its sources alone, else of a plain string."""
    full_name = f"crtk_msgs/msg/{name}"
    try:
        ros_class(full_name)
    except MessageError:
        return "std_msgs/msg/String"
    return full_name
