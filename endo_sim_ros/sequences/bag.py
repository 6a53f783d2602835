"""Recordings as rosbag2 files (mcap, zstd chunks); no ROS installation is needed to read or write them."""

import contextlib
import os
import shutil
import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import ChunkInfo, McapReader

from endo_sim_ros import messages
from endo_sim_ros.core.frames import LEFT_FRAME, RIGHT_FRAME, WORLD_FRAME, Frame, SequenceError
from endo_sim_ros.messages import Topic, bag_types
from endo_sim_ros.sequences.synchronizer import Synchronizer


class RawMessage(NamedTuple):
    """A serialised message of a bag."""

    topic: str  # absolute name
    type: str
    stamp_ns: int  # time of recording
    data: bytes  # CDR


class BagWriter:
    """Writes messages of the contract, or raw ones of any type, into a new bag. Use as a context manager.

    What was written is kept, and readable, also when the block ends with an error. When the process is killed that is
    what was written before the last `flush`, or in whole chunks of a megabyte; when the disk is full, what fitted.

    Raises:
        SequenceError: If the path exists or cannot be made.
        OSError: If the disk is full; nothing can be written then.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if self.path.exists():
            raise SequenceError(f"{path} exists already; choose another name or remove it first")
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._connections: dict[str, Any] = {}
        self._end, self._failed = 0, False  # bytes of the file that are whole records, and whether more may follow

    def __enter__(self) -> "BagWriter":
        try:
            self._writer.open()
        except (OSError, WriterError) as error:
            reason = getattr(error, "strerror", None) or error
            raise SequenceError(f"{self.path}: the bag cannot be made ({reason}); choose another place") from error
        return self

    def __exit__(self, *_: Any) -> None:
        file = self._writer.storage.path
        try:
            if not self._failed:
                self.flush()  # on its own: where there is no room for the index there may be for messages
                with self._storing():
                    self._writer.close()
        finally:
            if self._failed:  # half a record would be in the way; BagReader does without the index
                with contextlib.suppress(OSError):
                    self._writer.abort()
                os.truncate(file, self._end)

    @contextlib.contextmanager
    def _storing(self) -> Iterator[None]:
        if self._failed:
            raise SequenceError(f"{self.path}: the bag takes no more messages since one could not be written")
        try:
            yield
        except OSError:
            self._failed = True
            raise

    def flush(self) -> None:
        """Hand over what was written to the operating system, so that it outlives this process."""
        storage = self._writer.storage
        with self._storing():
            if storage.chunk.bio.tell():
                storage.close_chunk()
            storage.bio.flush()
            self._end = storage.bio.tell()

    def write(self, topic: Topic, message: Any, stamp_ns: int) -> None:
        """Append a message built from `messages.bag_types`."""
        self.write_raw(topic, bag_types().typestore.serialize_cdr(message, topic.type), stamp_ns)

    def write_raw(self, topic: Topic, data: bytes, stamp_ns: int) -> None:
        """Append a serialised message."""
        name = topic.name if topic.name.startswith("/") else f"/{topic.name}"
        if name not in self._connections:
            self._connections[name] = self._writer.add_connection(
                name, topic.type, typestore=bag_types().typestore, offered_qos_profiles=[_qos(topic.qos == "latched")]
            )
        with self._storing():
            self._writer.write(self._connections[name], stamp_ns, data)
        if not self._writer.storage.chunk.bio.tell():  # a chunk was full and went to the file
            self.flush()


def canonical_cdr(data: bytes, message_type: str) -> bytes:
    """The same message, with zeros between its fields; as it is where its type is not known or its bytes are damaged.

    Senders may leave anything in these gaps, so that the bytes of equal messages differ.
    """
    typestore = bag_types().typestore
    try:
        return bytes(typestore.serialize_cdr(typestore.deserialize_cdr(data, message_type), message_type))
    except Exception:  # parsers know many
        return data


def _qos(latched: bool) -> Qos:
    forever = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else 10,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )


@contextlib.contextmanager
def _readable(path: str | Path) -> Iterator[None]:
    """Turn whatever a damaged bag raises into one sentence."""
    try:
        yield
    except SequenceError:
        raise
    except FileNotFoundError:
        raise SequenceError(_no_bag(path)) from None
    except Exception as error:  # random bytes find every one that parsers and decompressors know
        reason = " ".join(str(error).split())
        raise SequenceError(f"{path}: the bag cannot be read ({type(error).__name__}: {reason}); record or convert it again") from error


def _no_bag(path: str | Path) -> str:
    return f"{path}: no such bag; give a rosbag2 folder (with metadata.yaml) or an .mcap file"


_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _DATA_END = 0x06, 0x0F  # records of an mcap file


class _UnfinishedMcap(McapReader):
    """A file whose recorder was killed, or had no room: its whole chunks, without the index that would be at the end."""

    def _open(self) -> None:
        size = os.fstat(self.bio.fileno()).st_size
        if self.bio.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("not an mcap file")
        self.data_start = position = len(_MAGIC)
        chunks = []
        while position + 9 <= size:
            self.bio.seek(position)
            kind, length = struct.unpack("<BQ", self.bio.read(9))
            if kind in (0, _DATA_END) or position + 9 + length > size:
                break
            if kind == _CHUNK:
                start, end, raw_size, _, letters = struct.unpack("<QQQII", self.bio.read(32))
                compression = self.bio.read(letters).decode()
                (packed_size,) = struct.unpack("<Q", self.bio.read(8))
                chunks.append(ChunkInfo(start, end, position, 9 + length, {}, 0, compression, packed_size, raw_size, {}))
            position += 9 + length
        if not chunks:
            raise ValueError("nothing was written before the recording ended")
        self.data_end = position
        self.meta_scan()  # topics and counts
        for chunk in chunks:
            chunk.channel_count.update(dict.fromkeys(self.channels, 1))  # any topic may be in any chunk
        self.chunks = chunks
        found = self.statistics
        self.connections = [c._replace(msgcount=found.channel_message_counts.get(c.id, 0)) for c in self.connections]
        self.metadata = self.metadata._replace(
            start_time=found.start_time,
            end_time=found.end_time + 1,
            duration=found.end_time - found.start_time + 1,
            message_count=found.message_count,
        )


def _open_reader(path: Path) -> Reader:
    """Reader of a bag; without metadata.yaml, which is written last, that of its only file."""
    folder = path if path.is_dir() else path.parent
    files = list(folder.glob("*.mcap")) if path.is_dir() else [path]
    if (folder / "metadata.yaml").exists() or len(files) != 1:
        return Reader(path)
    (file,) = files
    reader = Reader(file)
    with file.open("rb") as data:
        whole = file.stat().st_size > len(_MAGIC) and data.seek(-len(_MAGIC), os.SEEK_END) and data.read() == _MAGIC
    if file.suffix == ".mcap" and not whole:
        reader.storage = _UnfinishedMcap(file)
    return reader


class BagReader:
    """Reads a rosbag2 folder or a single .mcap file. Use as a context manager.

    A recording that was cut short, by a killed process or a full disk, is read as far as it was written. (Where there is
    a metadata.yaml, which a recorder writes last, a file that ends early is damaged instead.)

    Raises:
        SequenceError: If there is no such bag or it is damaged.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.exists():
            raise SequenceError(_no_bag(path))
        with _readable(path):
            self._reader = _open_reader(self.path)

    def __enter__(self) -> "BagReader":
        with _readable(self.path):
            self._reader.open()
        return self

    def __exit__(self, *_: Any) -> None:
        self._reader.close()

    @property
    def topics(self) -> dict[str, str]:
        """Type of every topic by absolute name."""
        return {connection.topic: connection.msgtype for connection in self._reader.connections}

    @property
    def latched(self) -> set[str]:
        """Absolute names of the topics that were offered to late joiners."""
        return {
            connection.topic
            for connection in self._reader.connections
            if any(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in connection.ext.offered_qos_profiles)
        }

    def require_recording(self) -> None:
        """Raise SequenceError, listing what is there, unless the bag has images, camera_info and poses."""
        present = self.topics
        needed = ((messages.LEFT_IMAGE, messages.LEFT_COMPRESSED), (messages.LEFT_INFO,), (messages.CAMERA_POSE,))
        for choices in needed:
            if not any(f"/{topic.name}" in present for topic in choices):
                there = ", ".join(sorted(present)) or "no topics"
                raise SequenceError(f"{self.path}: no topic /{choices[0].name}; the bag has {there}")

    @property
    def duration(self) -> float:
        """Seconds between first and last message."""
        return self._reader.duration * 1e-9

    @property
    def message_count(self) -> int:
        return self._reader.message_count

    def raw_messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """Serialised messages in the order of recording, of all topics or of the absolute names given."""
        wanted = None if topics is None else set(topics)
        connections = [c for c in self._reader.connections if wanted is None or c.topic in wanted]
        if not connections:
            return
        with _readable(self.path):
            for connection, stamp_ns, data in self._reader.messages(connections):
                yield RawMessage(connection.topic, connection.msgtype, stamp_ns, data)

    def messages(self, topics: Iterable[Topic]) -> Iterator[tuple[Topic, int, Any]]:
        """(topic, time of recording, message) of the given topics of the contract."""
        wanted = {f"/{topic.name.lstrip('/')}": topic for topic in topics}
        for raw in self.raw_messages(wanted):
            topic = wanted[raw.topic]
            if raw.type != topic.type:
                raise SequenceError(f"{self.path}: {raw.topic} is a {raw.type}, expected a {topic.type}; remap or convert it")
            with _readable(self.path):
                message = bag_types().typestore.deserialize_cdr(raw.data, raw.type)
            yield topic, raw.stamp_ns, message


def write_bag(path: str | Path, frames: Iterable[Frame]) -> int:
    """Write frames as a bag with the recording topics of the contract and return their number.

    Raises:
        SequenceError: If the path exists or there are no frames.
    """
    count, types = 0, bag_types()
    with BagWriter(path) as bag:
        for frame in frames:
            stamp, camera = frame.stamp_ns, frame.camera
            size = (camera.width, camera.height)
            bag.write(messages.LEFT_INFO, messages.encode_camera_info(camera.K, *size, stamp, LEFT_FRAME, types=types), stamp)
            bag.write(messages.CAMERA_POSE, messages.encode_pose(camera.pose, stamp, WORLD_FRAME, types), stamp)
            bag.write(messages.LEFT_IMAGE, messages.encode_image(frame.image, stamp, LEFT_FRAME, types), stamp)
            if frame.right is not None:
                K = camera.K if frame.right_K is None else frame.right_K
                info = messages.encode_camera_info(K, *size, stamp, RIGHT_FRAME, frame.baseline, types)
                bag.write(messages.RIGHT_INFO, info, stamp)
                bag.write(messages.RIGHT_IMAGE, messages.encode_image(frame.right, stamp, RIGHT_FRAME, types), stamp)
            if frame.depth is not None:
                bag.write(
                    messages.DEPTH,
                    messages.encode_image(frame.depth.astype("float32"), stamp, LEFT_FRAME, types),
                    stamp,
                )
            if frame.mask is not None:
                bag.write(messages.MASK, messages.encode_image(frame.mask, stamp, LEFT_FRAME, types), stamp)
            count += 1
    if not count:
        shutil.rmtree(path)  # an empty bag would only be in the way of the next attempt
        raise SequenceError(f"{path}: the sequence has no frames; check its frame range and poses")
    return count


def read_bag(path: str | Path, tolerance: float = 0.01, world_frame: str = WORLD_FRAME) -> Iterator[Frame]:
    """Frames of a bag with the recording topics of the contract, in order.

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


def feed(synchronizer: Synchronizer, topic: Topic, message: Any, frames: str | Mapping[str, np.ndarray]) -> list[Frame]:
    """Decode one message of a recording topic into the synchroniser and return the frames that became complete."""
    stamp = messages.stamp_to_ns(message.header.stamp)
    if topic in (messages.LEFT_INFO, messages.RIGHT_INFO):
        info = messages.decode_camera_info(message, topic.name)
        synchronizer.add_info("left" if topic == messages.LEFT_INFO else "right", info)
        return []
    if topic == messages.CAMERA_POSE:
        return synchronizer.add("pose", stamp, messages.decode_pose(message, frames, topic.name))
    if topic == messages.DEPTH:
        return synchronizer.add("depth", stamp, messages.decode_depth(message, topic.name))
    if topic == messages.MASK:
        return synchronizer.add("mask", stamp, messages.decode_mask(message, topic.name))
    stream = "image" if topic in (messages.LEFT_IMAGE, messages.LEFT_COMPRESSED) else "right"
    return synchronizer.add(stream, stamp, messages.decode_image(message, topic.name))
