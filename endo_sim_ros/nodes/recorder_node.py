"""Records topics into a rosbag2 (mcap) where `ros2 bag record` is not installed."""

import queue
import threading
from dataclasses import dataclass
from pathlib import Path

from endo_sim_ros import messages
from endo_sim_ros.config import StageConfig
from endo_sim_ros.messages import Topic
from endo_sim_ros.nodes.base import ERROR, OK, EndoNode, arm_names, quality, run, sentence
from endo_sim_ros.sequences.bag import BagWriter

_MAX_WAITING = 256_000_000  # bytes that may wait for the disk before new messages are dropped, and counted


@dataclass(frozen=True)
class RecorderConfig(StageConfig):
    """Parameters of the recorder."""

    bag: str = "recording"
    """Folder of the new bag; it must not exist."""
    arms: str = "PSM1"
    """Names of the tool arms, separated by commas."""


class RecorderNode(EndoNode):
    """Writes every topic of the contract as it comes, without decoding it."""

    read_at_start = frozenset({"bag", "arms"})

    def __init__(self):
        super().__init__("recorder")
        self._config = self.declare(RecorderConfig)
        topics = messages.all_topics(arm_names(self._config.arms))
        self._written, self._dropped, self._failure = 0, 0, ""
        self._queue: queue.SimpleQueue = queue.SimpleQueue()
        self._waiting, self._lock = 0, threading.Lock()  # bytes in the queue
        self._thread = threading.Thread(target=self._write)
        self._thread.start()
        for topic in topics:
            kind = messages.ros_class(topic.type)
            self.create_subscription(kind, topic.name, self._recorder(topic), quality(topic, 100), raw=True)

    def _recorder(self, topic: Topic):
        absolute = topic._replace(name=self.resolve_topic_name(topic.name))

        def record(data: bytes) -> None:
            if self._failure or self._waiting > _MAX_WAITING:
                self._dropped += 1
                return
            with self._lock:
                self._waiting += len(data)
            self._queue.put((absolute, data, self.now_ns()))

        return record

    def _write(self) -> None:
        """Runs in its own thread so that a slow disk delays no subscription; what was written stays readable."""
        try:
            with BagWriter(Path(self._config.bag).expanduser()) as bag:
                while (item := self._queue.get()) is not None:
                    bag.write_raw(*item)
                    self._written += 1
                    with self._lock:
                        self._waiting -= len(item[1])
        except Exception as error:  # a full disk, above all
            self._failure = f"recording stopped: {sentence(self._config.bag, error)}"
            self._queue = queue.SimpleQueue()  # let go of what can no longer be written
            self.report_error(self._failure)

    def status(self):
        values = {"bag": self._config.bag, "messages": self._written, "dropped": self._dropped}
        return (ERROR, self._failure, values) if self._failure else (OK, "recording", values)

    def destroy_node(self) -> None:
        self._queue.put(None)
        self._thread.join()  # what was heard before the end is kept, even if the disk takes its time
        super().destroy_node()


def main() -> int:
    return run(RecorderNode)


if __name__ == "__main__":
    raise SystemExit(main())
