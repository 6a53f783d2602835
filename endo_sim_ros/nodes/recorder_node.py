"""Records topics into a rosbag2 (mcap) where `ros2 bag record` is not installed."""

import contextlib
import json
import queue
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.utilities import try_shutdown
from rich.live import Live
from rich.text import Text

from endo_sim_ros import messages
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.messages import ERROR, OK, STATE, RecorderState, Topic
from endo_sim_ros.nodes.base import EndoNode, quality, run, sentence, shutdown_interrupts
from endo_sim_ros.nodes.configs import ALL_TOPICS, RecorderConfig, arm_names, namespace_arguments
from endo_sim_ros.nodes.transport import prepare_transport
from endo_sim_ros.sequences.bag import BagWriter, canonical_cdr

_MAX_WAITING = 256_000_000  # bytes that may wait for the disk before new messages are dropped, and counted
_FLUSH_EVERY = 1.0  # seconds; what was heard longer ago outlives a killed recorder


class RecorderNode(EndoNode):
    """Writes every topic of the contract, or those that were chosen, as it comes."""

    read_at_start = frozenset({"bag", "arms", "topics", "images", "canonical"})

    def __init__(self) -> None:
        super().__init__("recorder")
        self._config = self.declare(RecorderConfig)
        topics = _chosen(self._config.topics, arm_names(self._config.arms), self._config.images == "compressed")
        self.failure = ""  # why nothing is recorded any more
        self.written, self.dropped = 0, 0
        self._bag = Path(self._config.bag).expanduser()
        self._heard: set[str] = set()  # topics
        self.queue: queue.SimpleQueue = queue.SimpleQueue()
        self._waiting, self._lock = 0, threading.Lock()  # bytes in the queue
        self._thread = threading.Thread(target=self._write)
        self._thread.start()
        for topic in topics:
            kind = messages.ros_class(topic.type)
            self.create_subscription(kind, topic.name, self._recorder(topic), quality(topic, 100), raw=True)

    def _recorder(self, topic: Topic) -> Callable[[bytes], None]:
        # By the name in the contract, whatever the namespace: so it is replayed into any, and exported.
        absolute = topic._replace(name="/" + topic.name.lstrip("/"))

        def record(data: bytes) -> None:
            if self.failure or self._waiting > _MAX_WAITING:
                self.dropped += 1
                return
            with self._lock:
                self._waiting += len(data)
            self.queue.put((absolute, data, self.now_ns()))

        return record

    def _write(self) -> None:
        """Runs in its own thread so that a slow disk delays no subscription; what was written stays readable."""
        try:
            with BagWriter(self._bag) as bag:
                flushed = time.monotonic()
                while (item := self._next()) is not None:
                    if item:
                        topic, data, stamp_ns = item
                        bag.write_raw(topic, canonical_cdr(data, topic.type) if self._config.canonical else data, stamp_ns)
                        self.written += 1
                        self._heard.add(topic.name)
                        with self._lock:
                            self._waiting -= len(data)
                    if time.monotonic() - flushed > _FLUSH_EVERY:
                        bag.flush()
                        flushed = time.monotonic()
        except Exception as error:  # a full disk, above all
            kept = "; what was written before can be read" if isinstance(error, OSError) else ""
            self.failure = f"recording stopped: {sentence(self._config.bag, error)}{kept}"
            self.queue = queue.SimpleQueue()  # let go of what can no longer be written
            self.report_error(self.failure)

    def _next(self) -> tuple | None:
        """What to write next, nothing in a quiet second, None at the end."""
        try:
            return self.queue.get(timeout=_FLUSH_EVERY)
        except queue.Empty:
            return ()

    @property
    def summary(self) -> str:
        """What was recorded so far, in one line, with the size on the disk, where it is compressed."""
        size = sum(file.stat().st_size for file in self._bag.glob("*"))
        dropped = f", {self.dropped} dropped" if self.dropped else ""
        written = f"{self.written} messages of {len(self._heard)} topics"
        return f"{self._config.bag}: {written}, {size / 1e6:.1f} MB{dropped}"

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: the bag, and how many messages were written and dropped."""
        state = RecorderState.FAILED if self.failure else RecorderState.RECORDING
        values = {STATE: state, "bag": self._config.bag, "messages": self.written, "dropped": self.dropped}
        return (ERROR, self.failure, values) if self.failure else (OK, "recording", values)

    def destroy_node(self) -> None:
        """Write what was received, then destroy the node."""
        self.queue.put(None)
        self._thread.join()  # what was heard before the end is kept, even if the disk takes its time
        super().destroy_node()


def _chosen(names: tuple[str, ...], arms: tuple[str, ...], compressed: bool) -> list[Topic]:
    """The topics of the contract with these names; of all, rendered images are compressed or not.

    Raises:
        ConfigError: If there is no such topic.
    """
    known = {topic.name.lstrip("/"): topic for topic in messages.all_topics(arms)}
    wanted = dict.fromkeys(name.strip().lstrip("/") for name in names if name != ALL_TOPICS)
    if ALL_TOPICS in names:
        wanted |= dict.fromkeys(topic.name.lstrip("/") for topic in messages.recorded_topics(arms, compressed))
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        what = ", ".join(map(repr, unknown)) or "topic of no name"
        raise ConfigError(f"topics: the contract has no {what} for the arms {', '.join(arms)}; see msg_conventions.md")
    return [known[name] for name in wanted]


def record(bag: Path, arms: tuple[str, ...], topics: tuple[str, ...], namespace: str = "", images: str = "compressed") -> None:
    """Record a running graph until interrupted, with a live line of counts.

    Raises:
        SequenceError: If the bag cannot be made.
        ConfigError: If a topic or arm cannot be recorded, or there can be no such namespace.
        RuntimeError: If the disk is full; what was written is kept.
    """
    if bag.exists():
        raise SequenceError(f"{bag} exists already; choose another name or remove it first")
    remapped = namespace_arguments(namespace)
    prepare_transport()
    values = {"bag": str(bag), "arms": list(arms), "topics": list(topics), "images": images}
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # rclpy hears it, and ends the recording as on Ctrl-C
    given = [word for name, value in values.items() for word in ("-p", f"{name}:={json.dumps(value, ensure_ascii=False)}")]  # texts quoted
    rclpy.init(args=["--ros-args", *remapped, *given])
    node = None
    try:
        with shutdown_interrupts(), Live(Text(), transient=True) as live:
            node, executor, shown = RecorderNode(), SingleThreadedExecutor(), 0.0
            executor.add_node(node)
            while not node.failure:
                executor.spin_once(timeout_sec=0.1)
                if time.monotonic() - shown > 0.25:
                    shown = time.monotonic()
                    live.update(Text(f"{node.summary}; Ctrl-C ends it"))
    except KeyboardInterrupt:
        pass
    finally:
        with contextlib.suppress(RuntimeError):  # ROS may be shutting itself down at the same moment
            try_shutdown()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # an impatient second one must not cut short what follows
        if node is not None:
            node.destroy_node()
    if node is not None and node.failure:
        raise RuntimeError(node.failure)
    if node is not None:
        print(node.summary)


if __name__ == "__main__":
    raise SystemExit(run(RecorderNode))
