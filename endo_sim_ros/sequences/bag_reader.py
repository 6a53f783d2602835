"""Reading rosbag2 files, finished or not."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import ConnectionExtRosbag2, QosDurability
from rosbags.rosbag2 import Reader

from endo_sim_ros import messages
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.messages import Topic, bag_types
from endo_sim_ros.sequences.bag_unfinished import UnfinishedMcap, is_finished

log = logging.getLogger(__name__)


class RawMessage(NamedTuple):
    """A serialised message of a bag."""

    topic: str  # absolute name
    type: str
    stamp_ns: int  # time of recording
    data: bytes  # CDR


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
        from endo_sim_ros.sequences.readers import is_bag  # here: who reads bags alone starts sooner without

        if not is_bag(Path(path)):
            raise SequenceError(_no_bag(path)) from None
        reason = " ".join(str(error).split())
        raise SequenceError(f"{path}: the bag cannot be read ({type(error).__name__}: {reason}); record or convert it again") from error


def _no_bag(path: str | Path) -> str:
    """What to say of a path that is no bag."""
    from endo_sim_ros.sequences.readers import find_kind  # here: who reads bags alone starts sooner without

    place = Path(path)
    if place.exists() and find_kind(place):
        return f"{path}: a recording, but not a bag; `endo-sim convert {path} BAG` makes a bag of it"
    what = "no such bag" if not place.exists() else "a folder, but no rosbag2" if place.is_dir() else "a file, but no rosbag2"
    return f"{path}: {what}; give a rosbag2 folder (with metadata.yaml) or an .mcap file"


def _open_reader(path: Path) -> Reader | UnfinishedMcap:
    """Reader of a bag, of its only file where that has no end."""
    files = list(path.glob("*.mcap")) if path.is_dir() else [path]
    if len(files) == 1 and files[0].suffix == ".mcap" and not is_finished(files[0]):
        return UnfinishedMcap(files[0])
    return Reader(path)


_TOLD: set[Path] = set()  # bags without an end that were warned of: a bag is opened several times


class BagReader:
    """Reads a rosbag2 folder or a single .mcap file. Use as a context manager.

    A recording that was cut short, by a killed process or a full disk, is read as far as it was written, and a warning says so. Where
    there is a metadata.yaml, which a recorder writes last, the file was cut later.

    Raises:
        SequenceError: If there is no such bag or it is damaged.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.exists():
            raise SequenceError(_no_bag(path))
        with _readable(path):
            self._reader = _open_reader(self.path)

    def __enter__(self) -> BagReader:
        with _readable(self.path):
            self._reader.open()
        if isinstance(self._reader, UnfinishedMcap):
            cut = (self._reader.path.parent / "metadata.yaml").exists()
            why = "the file is cut off" if cut else "the recording has no end: its recorder was killed, or still writes"
            rest = "copy or record it again for the rest" if cut else "wait for the end, if more is to come"
            if self._reader.path not in _TOLD:
                log.warning(f"{self._reader.path}: {why}; its {self.message_count} whole messages, {self.duration:.1f} s, are read; {rest}")
            _TOLD.add(self._reader.path)
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
            if isinstance(connection.ext, ConnectionExtRosbag2)
            and any(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in connection.ext.offered_qos_profiles)
        }

    def require_recording(self) -> None:
        """Raise SequenceError, listing what is there, unless the bag has images, camera_info and poses of the left eye."""
        self.require((messages.LEFT_IMAGE, messages.LEFT_COMPRESSED), (messages.LEFT_INFO,), (messages.CAMERA_POSE,))

    def require(self, *needed: tuple[Topic, ...]) -> None:
        """Raise SequenceError, listing what is there, unless the bag has one topic of each tuple."""
        present = self.topics
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
        """Messages of all topics."""
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
        """(topic, time of recording in nanoseconds, message) of the given topics of the contract.

        Raises:
            SequenceError: If the bag is damaged, or a topic has another type than the contract says.
        """
        wanted = {f"/{topic.name.lstrip('/')}": topic for topic in topics}
        for raw in self.raw_messages(wanted):
            topic = wanted[raw.topic]
            if raw.type != topic.type:
                raise SequenceError(f"{self.path}: {raw.topic} is a {raw.type}, expected a {topic.type}; remap or convert it")
            with _readable(self.path):
                message = bag_types().typestore.deserialize_cdr(raw.data, raw.type)
            yield topic, raw.stamp_ns, message
