"""Frames as rosbag2 files, and the public names of bags; no ROS installation is needed to read or write them."""

import contextlib
import logging
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.folders import leaving_none_empty
from endo_sim_ros.core.frames import LEFT_FRAME, RIGHT_FRAME, WORLD_FRAME, Frame, SequenceError
from endo_sim_ros.messages import Topic, bag_types
from endo_sim_ros.sequences.bag_reader import BagReader, RawMessage
from endo_sim_ros.sequences.bag_writer import BagWriter, canonical_cdr
from endo_sim_ros.sequences.point_files import write_points
from endo_sim_ros.sequences.synchronizer import Synchronizer

__all__ = [
    "LEFT_FRAME", "RIGHT_FRAME", "WORLD_FRAME", "BagReader", "BagWriter", "RawMessage",
    "canonical_cdr", "feed", "read_bag", "write_bag",
]  # fmt: skip

log = logging.getLogger(__name__)


def write_bag(path: str | Path, frames: Iterable[Frame], points: tuple[np.ndarray, np.ndarray] | None = None) -> int:
    """The number of frames written as a bag with the recording topics of the contract; it is removed if that ends with an error.

    Args:
        path: Folder of the new bag.
        frames: What to write.
        points: Scene points and colours as in `Recording`, for its points.txt.

    Raises:
        SequenceError: If the path exists or there are no frames.
    """
    bag = BagWriter(path)
    with leaving_none_empty(bag.path.parent):
        try:
            with bag:
                count = _write_frames(bag, frames)
            if not count:
                raise SequenceError(f"{path}: the sequence has no frames; check its frame range and poses")
            if points is not None:
                write_points(path, *points)
        except BaseException:  # it would only be in the way of the next attempt
            shutil.rmtree(path, ignore_errors=True)
            raise
    return count


def _write_frames(bag: BagWriter, frames: Iterable[Frame]) -> int:
    count, masked, types = 0, 0, bag_types()
    for frame in frames:
        stamp, camera = frame.stamp_ns, frame.camera
        size = (camera.width, camera.height)
        bag.write(messages.LEFT_INFO, messages.encode_camera_info(camera.K, *size, stamp, LEFT_FRAME, types=types), stamp)
        bag.write(messages.CAMERA_POSE, messages.encode_pose(camera.pose, stamp, WORLD_FRAME, types), stamp)
        bag.write(messages.LEFT_IMAGE, messages.encode_image(frame.image, stamp, LEFT_FRAME, types), stamp)
        if frame.right is not None and frame.baseline is not None:
            info = messages.encode_camera_info(frame.right_intrinsics, *size, stamp, RIGHT_FRAME, frame.baseline, types)
            bag.write(messages.RIGHT_INFO, info, stamp)
            bag.write(messages.RIGHT_IMAGE, messages.encode_image(frame.right, stamp, RIGHT_FRAME, types), stamp)
        if frame.depth is not None:
            bag.write(messages.DEPTH, messages.encode_image(frame.depth.astype("float32"), stamp, LEFT_FRAME, types), stamp)
        if frame.mask is not None:
            bag.write(messages.MASK, messages.encode_image(frame.mask, stamp, LEFT_FRAME, types), stamp)
            masked += not frame.mask.any()
        count += 1
    if count and masked == count:
        log.warning(
            "%s: every pixel of every view is masked, so nothing can be reconstructed; a mask has 255 where there is tissue, and dark "
            "pictures are masked whole",
            bag.path,
        )
    return count


def read_bag(path: str | Path, tolerance: float = 0.01, world_frame: str = WORLD_FRAME) -> Iterator[Frame]:
    """Frames of a bag with the recording topics of the contract, in order.

    Args:
        path: A rosbag2 folder or an .mcap file.
        tolerance: Largest difference between matched stamps, seconds.
        world_frame: The coordinate frame in which poses must be given.

    Raises:
        SequenceError: If the bag is damaged, lacks images, camera_info or poses (the message lists what it has), holds
            a message that cannot be used, or gives no frame at all.
    """
    synchronizer, count = Synchronizer(tolerance), 0
    with BagReader(path) as bag:
        bag.require_recording()
        for topic, _, message in bag.messages(messages.RECORDING_TOPICS):
            with _located(path):
                frames = feed(synchronizer, topic, message, world_frame)
            count += len(frames)
            yield from frames
    with _located(path):
        frames = synchronizer.flush()
    if not count + len(frames):
        reasons = ", ".join(f"{number} {reason}" for reason, number in synchronizer.dropped.items() if number)
        raise SequenceError(f"{path}: no view in the bag ({reasons or 'no images'}); are image and pose stamps within {tolerance} s?")
    yield from frames


@contextlib.contextmanager
def _located(path: str | Path) -> Iterator[None]:
    """Put the name of the bag before what is wrong with a message in it."""
    try:
        yield
    except (messages.MessageError, SequenceError) as error:
        raise SequenceError(f"{path}: {error}") from error


def feed(synchronizer: Synchronizer, topic: Topic, message: Any, frame_poses: str | Mapping[str, np.ndarray]) -> list[Frame]:
    """The frames that become complete with one message of a recording topic.

    Args:
        synchronizer: What collects the streams; the message is added to it.
        topic: One of messages.RECORDING_TOPICS.
        message: Of ROS or of a bag.
        frame_poses: The name of the world frame, or the poses [4, 4] of known coordinate frames in it, by name.

    Raises:
        MessageError: If the message cannot be decoded.
        SequenceError: As `Synchronizer.add`.
    """
    stamp = messages.stamp_to_ns(message.header.stamp)
    if topic in (messages.LEFT_INFO, messages.RIGHT_INFO):
        info = messages.decode_camera_info(message, topic.name)
        synchronizer.add_info("left" if topic == messages.LEFT_INFO else "right", info)
        return []
    if topic == messages.CAMERA_POSE:
        return synchronizer.add("pose", stamp, messages.decode_pose(message, frame_poses, topic.name))
    if topic == messages.DEPTH:
        return synchronizer.add("depth", stamp, messages.decode_depth(message, topic.name))
    if topic == messages.MASK:
        return synchronizer.add("mask", stamp, messages.decode_mask(message, topic.name))
    stream = "image" if topic in (messages.LEFT_IMAGE, messages.LEFT_COMPRESSED) else "right"
    return synchronizer.add(stream, stamp, messages.decode_image(message, topic.name))
