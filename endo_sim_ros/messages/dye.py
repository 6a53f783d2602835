"""Spots of dye on tissue."""

from collections.abc import Iterable

import numpy as np

from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.messages.headers import check_frame, make_header
from endo_sim_ros.messages.types import Message, MessageError, ros_types

__all__ = ["decode_dye", "encode_dye"]

_SPHERE, _ADD, _DELETE_ALL = 2, 0, 3  # of a Marker
_MOST = 1000  # spots


def encode_dye(spots: Iterable[DyedSpot], stamp_ns: int, frame_id: str) -> Message:
    """MarkerArray that replaces all spots, as spheres in the tissue at rest, which RViz shows, too."""
    types = ros_types()
    header = make_header(types, stamp_ns, frame_id)
    markers = [types.Marker(header=header, action=_DELETE_ALL)]
    for number, spot in enumerate(spots):
        x, y, z = map(float, spot.place)
        red, green, blue = map(float, spot.color)
        marker = types.Marker(
            header=header,
            ns="dye",
            id=number,
            type=_SPHERE,
            action=_ADD,
            pose=types.Pose(position=types.Point(x=x, y=y, z=z)),
            scale=types.Vector3(x=2 * spot.radius, y=2 * spot.radius, z=2 * spot.radius),
            color=types.ColorRGBA(r=red, g=green, b=blue, a=1.0),
        )
        markers.append(marker)
    return types.MarkerArray(markers=markers)


def decode_dye(message: Message, frame: str, topic: str) -> list[DyedSpot]:
    """The spots in a MarkerArray of spheres, which replace all others, in a frame of this name.

    Raises:
        MessageError: If a marker is no sphere or in another frame, or one of its numbers cannot be used.
    """
    shown = [marker for marker in message.markers if marker.action == _ADD]
    if len(shown) > _MOST:
        raise MessageError(f"{topic}: {len(shown)} spots; at most {_MOST} are dyed")
    return [_spot(marker, frame, topic) for marker in shown]


def _spot(marker: Message, frame: str, topic: str) -> DyedSpot:
    check_frame(marker, (frame,), topic)
    at, ink, size = marker.pose.position, marker.color, marker.scale.x
    place, color = np.array([at.x, at.y, at.z]), np.array([ink.r, ink.g, ink.b])
    usable = np.isfinite([*place, *color, size]).all() and size > 0 and (np.abs(color - 0.5) <= 0.5).all()
    if marker.type != _SPHERE or not usable:
        raise MessageError(
            f"{topic}: marker {marker.id} has type {marker.type}, position {place.tolist()}, scale {size:g} m and colour {color.tolist()}; "
            f"spots are spheres (type {_SPHERE}) with a finite position, a scale above 0 and colours from 0 to 1"
        )
    return DyedSpot(place, 0.5 * size, tuple(color.tolist()))
