"""Writing rosbag2 files (mcap, zstd chunks) that stay readable when the writer is killed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError

from endo_sim_ros.core.folders import naming
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.messages import Topic, bag_types
from endo_sim_ros.sequences import bag_private


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
        self._connections: dict[str, Connection] = {}
        self._end, self._failed = 0, False  # bytes of the file that are whole records, and whether more may follow

    def __enter__(self) -> BagWriter:
        try:
            self._writer.open()
        except (OSError, WriterError) as error:
            reason = getattr(error, "strerror", None) or error
            raise SequenceError(f"{self.path}: the bag cannot be made ({reason}); choose another place") from error
        return self

    def __exit__(self, *_: Any) -> None:
        file = bag_private.file_path(self._writer)
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
            with naming(self.path):
                yield
        except OSError:
            self._failed = True
            raise

    def flush(self) -> None:
        """Hand over what was written to the operating system, so that it outlives this process."""
        with self._storing():
            self._end = bag_private.flush(self._writer)

    def write(self, topic: Topic, message: Any, stamp_ns: int) -> None:
        """Append a message built from `messages.bag_types`.

        Args:
            topic: Its topic of the contract.
            message: The message.
            stamp_ns: Time of recording, nanoseconds.

        Raises:
            SequenceError: If a message before it could not be written.
            OSError: If the disk is full.
        """
        self.write_raw(topic, bag_types().typestore.serialize_cdr(message, topic.type), stamp_ns)

    def write_raw(self, topic: Topic, data: bytes | memoryview, stamp_ns: int) -> None:
        """Append a serialised message (CDR); see `write`."""
        name = topic.name if topic.name.startswith("/") else f"/{topic.name}"
        if name not in self._connections:
            self._connections[name] = self._writer.add_connection(
                name, topic.type, typestore=bag_types().typestore, offered_qos_profiles=[qos(topic.qos == "latched")]
            )
        with self._storing():
            self._writer.write(self._connections[name], stamp_ns, data)
        if bag_private.chunk_is_empty(self._writer):  # a chunk was full and went to the file
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


def qos(latched: bool) -> Qos:
    """The quality of service that a topic is offered with: reliable, kept for late joiners where it is latched."""
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
