"""Records topics into a rosbag2 (mcap) where `ros2 bag record` is not installed."""

import queue
import threading
from dataclasses import dataclass
from pathlib import Path

from endo_sim_ros import messages
from endo_sim_ros.config import StageConfig
from endo_sim_ros.messages import Topic
from endo_sim_ros.nodes.base import ERROR, OK, EndoNode, quality, run
from endo_sim_ros.sequences.bag import BagWriter

_MAX_WAITING = 2000  # messages that may wait for the disk before new ones are dropped, and counted


@dataclass(frozen=True)
class RecorderConfig(StageConfig):
    """Parameters of the recorder."""

    bag: str = "recording"
    """Folder of the new bag; it must not exist."""
    arms: str = "PSM1"
    """Names of the tool arms, separated by commas."""


class RecorderNode(EndoNode):
    """Writes every topic of the contract as it comes, without decoding it."""

    def __init__(self):
        super().__init__("recorder")
        self._config = self.declare(RecorderConfig)
        self._written, self._dropped, self._failure = 0, 0, ""
        self._queue: queue.Queue = queue.Queue(_MAX_WAITING)
        self._thread = threading.Thread(target=self._write)
        self._thread.start()
        arms = tuple(name.strip() for name in self._config.arms.split(",") if name.strip())
        for topic in messages.all_topics(arms):
            kind = messages.ros_class(topic.type)
            self.create_subscription(kind, topic.name, self._recorder(topic), quality(topic, 100), raw=True)

    def _recorder(self, topic: Topic):
        absolute = topic._replace(name=self.resolve_topic_name(topic.name))

        def record(data: bytes) -> None:
            try:
                self._queue.put_nowait((absolute, data, self.now_ns()))
            except queue.Full:
                self._dropped += 1

        return record

    def _write(self) -> None:
        """Runs in its own thread so that a slow disk delays no subscription; what was written stays readable."""
        try:
            with BagWriter(Path(self._config.bag).expanduser()) as bag:
                while (item := self._queue.get()) is not None:
                    bag.write_raw(*item)
                    self._written += 1
        except (OSError, ValueError) as error:
            self._failure = f"recording stopped: {error}"
            self.report_error(self._failure)

    def status(self):
        values = {"bag": self._config.bag, "messages": self._written, "dropped": self._dropped}
        return (ERROR, self._failure, values) if self._failure else (OK, "recording", values)

    def destroy_node(self) -> None:
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join(timeout=30)
        super().destroy_node()


def main() -> int:
    return run(RecorderNode)


if __name__ == "__main__":
    raise SystemExit(main())
