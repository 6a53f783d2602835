"""What can be read of an .mcap file whose recorder was killed, or had no room: its whole chunks, without the index."""

import heapq
import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import yaml
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, DataEnd, Message, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from endo_sim_ros.sequences.bag_writer import qos

_MAGIC = b"\x89MCAP0\r\n"  # of the format, at both ends of a finished file


def is_finished(path: Path) -> bool:
    """Whether an .mcap file has the mark that is written last."""
    with path.open("rb") as file:
        return path.stat().st_size > MAGIC_SIZE and file.seek(-MAGIC_SIZE, os.SEEK_END) > 0 and file.read() == _MAGIC


class _Place(NamedTuple):
    """Where a chunk is."""

    start_ns: int  # time of recording of its first message
    position: int  # in the file, bytes


class UnfinishedMcap:
    """Reads an .mcap file that has no index; what BagReader uses of it is as in the Reader of rosbags.

    Args:
        path: The file.
    """

    def __init__(self, path: Path):
        self.path = path
        self.connections: list[Connection] = []
        """The topics that a whole chunk has."""
        self.message_count = 0
        """Messages in whole chunks."""
        self.duration = 0
        """From the first message to the last, nanoseconds."""
        self._places: list[_Place] = []
        self._file: BinaryIO | None = None

    def open(self) -> None:
        """Find the whole chunks and what is in them.

        Raises:
            ValueError: If there is none, or one is damaged.
        """
        self._file = self.path.open("rb")
        types, channels, counts, stamps = {}, {}, Counter(), []
        for position, chunk in _whole_chunks(self._file):
            self._places.append(_Place(chunk.message_start_time, position))
            for record in breakup_chunk(chunk, validate_crc=True):
                if isinstance(record, Schema):
                    types[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    counts[record.channel_id] += 1
                    stamps.append(record.log_time)
        if not stamps:
            raise ValueError("nothing was written before the recording ended")
        self.message_count, self.duration = len(stamps), max(stamps) - min(stamps) + 1
        self.connections = [_connection(channel, types[channel.schema_id], counts[number]) for number, channel in channels.items()]

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """(topic, time of recording in nanoseconds, CDR) of the messages of some topics, in the order of recording."""
        wanted = {connection.id: connection for connection in connections}
        for stamp, connection, data in heapq.merge(*(self._unpack(place, wanted) for place in self._places), key=lambda item: item[0]):
            if connection is not None:
                yield connection, stamp, data

    def _unpack(self, place: _Place, wanted: dict[int, Connection]) -> Iterator[tuple[int, Connection | None, bytes]]:
        yield place.start_ns, None, b""  # its place in the order; it is unpacked when its turn comes
        assert self._file is not None
        self._file.seek(place.position)
        records = StreamReader(self._file, skip_magic=True, emit_chunks=True).records
        chunk = next(record for record in records if isinstance(record, Chunk))
        found = [
            (record.log_time, wanted[record.channel_id], record.data)
            for record in breakup_chunk(chunk, validate_crc=True)
            if isinstance(record, Message) and record.channel_id in wanted
        ]
        yield from sorted(found, key=lambda item: item[0])


def _whole_chunks(file: BinaryIO) -> Iterator[tuple[int, Chunk]]:
    """Each chunk that was written whole, and a position in the file from which it is the next one."""
    if file.read(MAGIC_SIZE) != _MAGIC:
        raise ValueError("not an mcap file")
    records = StreamReader(file, skip_magic=True, emit_chunks=True).records
    while True:
        position = file.tell()
        try:
            record = next(records, None)
        except (EndOfFile, RecordLengthLimitExceeded, struct.error):  # within a record
            return
        if record is None or isinstance(record, DataEnd):
            return
        if isinstance(record, Chunk):
            yield position, record


def _connection(channel: Channel, kind: str, count: int) -> Connection:
    profiles = yaml.safe_load(channel.metadata.get("offered_qos_profiles", "")) or []
    latched = any(str(profile.get("durability")) in ("1", "transient_local") for profile in profiles)
    extra = ConnectionExtRosbag2("cdr", [qos(latched)])
    return Connection(channel.id, channel.topic, kind, MessageDefinition(MessageDefinitionFormat.NONE, ""), "", count, extra, None)
