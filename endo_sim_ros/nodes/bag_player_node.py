"""Replays a rosbag2 recording where `ros2 bag play` is not installed."""

import threading
import time
from dataclasses import dataclass
from typing import Annotated

import rclpy

from endo_sim_ros.config import Range, StageConfig
from endo_sim_ros.messages import MessageError, Topic
from endo_sim_ros.nodes.base import ERROR, OK, EndoNode, run
from endo_sim_ros.sequences.bag import BagReader
from endo_sim_ros.sequences.frames import SequenceError


@dataclass(frozen=True)
class BagPlayerConfig(StageConfig):
    """Parameters of the bag player."""

    bag: str = ""
    """Path of a rosbag2 folder or an .mcap file."""
    rate: Annotated[float, Range(0.01, 100)] = 1.0
    """Playback speed relative to the recording."""
    loop: bool = False
    """Start again at the end."""
    wait_for_subscribers: Annotated[float, Range(0, 3600, "s")] = 10.0
    """Longest wait for somebody to listen before playing."""


class BagPlayerNode(EndoNode):
    """Publishes the raw messages of a bag in real time, then exits."""

    def __init__(self):
        super().__init__("bag_player")
        self._config = self.declare(BagPlayerConfig)
        self._sent, self._total, self._state = 0, 0, "starting"
        self._failed = False
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def status(self):
        values = {"bag": self._config.bag, "messages": self._sent, "of": self._total}
        return (ERROR if self._failed else OK), self._state, values

    def _play(self) -> None:
        try:
            self._open_and_publish()
        except (SequenceError, MessageError) as error:
            # Stay alive and keep saying so: a launch file should show the reason, not a missing node.
            self._failed, self._state = True, str(error)
            self.report_error(str(error))
            return
        self._state = "finished"
        self.publish_diagnostics()
        self.get_logger().info(f"finished: {self._sent} messages")
        time.sleep(0.5)  # lets reliable delivery complete
        rclpy.try_shutdown()

    def _open_and_publish(self) -> None:
        if not self._config.bag:
            raise SequenceError("no bag given; start with --ros-args -p bag:=PATH")
        with BagReader(self._config.bag) as bag:
            publishers = {}
            for name, kind in bag.topics.items():
                try:
                    publishers[name] = self.publisher(Topic(name.lstrip("/"), kind, "latched" if name in bag.latched else "stream"))
                except MessageError as error:
                    self.get_logger().warning(f"{name} is not replayed: {error}")
            if not publishers:
                raise SequenceError(f"{self._config.bag}: the bag has no topic that can be replayed")
            self._await_subscribers(publishers)
            self._state = "playing"
            while rclpy.ok():
                self._total += bag.message_count
                self._publish(bag, publishers)
                if not self._config.loop:
                    return

    def _await_subscribers(self, publishers: dict) -> None:
        self._state = "waiting for subscribers"
        deadline = time.monotonic() + self._config.wait_for_subscribers
        while rclpy.ok() and time.monotonic() < deadline:
            if any(publisher.get_subscription_count() for publisher in publishers.values()):
                time.sleep(0.5)  # the other topics of the same listener are found a little later
                return
            time.sleep(0.05)

    def _publish(self, bag: BagReader, publishers: dict) -> None:
        start_wall, start_bag = time.monotonic(), None
        for raw in bag.raw_messages(publishers):
            start_bag = raw.stamp_ns if start_bag is None else start_bag
            due = start_wall + (raw.stamp_ns - start_bag) * 1e-9 / self._config.rate
            time.sleep(max(0.0, due - time.monotonic()))
            if not rclpy.ok():
                return
            publishers[raw.topic].publish(bytes(raw.data))
            self._sent += 1


def main() -> int:
    return run(BagPlayerNode)


if __name__ == "__main__":
    raise SystemExit(main())
