"""Replays a rosbag2 recording where `ros2 bag play` is not installed."""

import threading
import time
from pathlib import Path
from typing import Any

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.messages import DIAGNOSTICS, ERROR, OK, STATE, BagPlayerState, MessageError, Topic
from endo_sim_ros.nodes.base import EndoNode, run, sentence
from endo_sim_ros.nodes.configs import BagPlayerConfig
from endo_sim_ros.nodes.listeners import Listeners, delivered
from endo_sim_ros.sequences.bag import BagReader

_DELIVERED_WITHIN = 10.0  # seconds that subscribers have, at the end, to ask again for what they missed
_MESSAGES = {  # for people
    BagPlayerState.WAITING: "waiting for subscribers",
    BagPlayerState.PLAYING: "playing",
    BagPlayerState.DELIVERING: "waiting until everything is received",
    BagPlayerState.DONE: "finished",
}


class BagPlayerNode(EndoNode):
    """Publishes the raw messages of a bag in real time, then exits."""

    read_at_start = frozenset({"bag", "wait_for_subscribers"})

    def __init__(self) -> None:
        super().__init__("bag_player")
        self._config = self.declare(BagPlayerConfig)
        self._sent, self._total = 0, 0
        self._state, self._failure = BagPlayerState.WAITING, ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def config_changed(self, config: BagPlayerConfig) -> None:
        """The next message uses the new options."""
        self._config = config

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: the bag, and how many of its messages were published."""
        values = {STATE: self._state, "bag": self._config.bag, "messages": self._sent, "of": self._total}
        return (ERROR, self._failure, values) if self._failure else (OK, _MESSAGES[self._state], values)

    def destroy_node(self) -> None:
        """Stop playing, then destroy the node."""
        self._stop.set()
        self._thread.join()
        super().destroy_node()

    def _play(self) -> None:
        try:
            self._open_and_publish()
        except Exception as error:
            if self._stopped:
                return
            # Stay alive and keep saying so: a launch file should show the reason, not a missing node.
            self._state, self._failure = BagPlayerState.FAILED, sentence(self._config.bag, error)
            self.report_error(self._failure)
            return
        if self._stopped:
            return
        self._state = BagPlayerState.DONE
        self.finish(f"{self._sent} messages")

    @property
    def _stopped(self) -> bool:
        return self._stop.is_set() or not self.context.ok()

    def _open_and_publish(self) -> None:
        if not self._config.bag:
            raise SequenceError("no bag given; start with --ros-args -p bag:=PATH")
        with BagReader(Path(self._config.bag).expanduser()) as bag:
            publishers = {}
            for name, kind in bag.topics.items():
                topic = Topic(name.lstrip("/"), kind, "latched" if name in bag.latched else "stream")
                if name == DIAGNOSTICS.name:
                    continue  # the states of nodes that ran then would be taken for those of nodes that run now
                try:
                    publishers[name] = self.publisher(topic)
                except MessageError as error:
                    self.get_logger().warning(f"{name} is not replayed: {error}")
            if not publishers:
                raise SequenceError(f"{self._config.bag}: the bag has no topic that can be replayed")
            self._await_subscribers(publishers)
            self._state = BagPlayerState.PLAYING
            while not self._stopped:
                self._total += bag.message_count
                self._publish(bag, publishers)
                if not self._config.loop:
                    self._await_delivery(publishers)
                    return

    def _await_subscribers(self, publishers: dict) -> None:
        deadline, listeners = time.monotonic() + self._config.wait_for_subscribers, Listeners(publishers.values())
        while not self._stopped and time.monotonic() < deadline and not listeners.settled():
            self._stop.wait(0.05)

    def _await_delivery(self, publishers: dict) -> None:
        self._state = BagPlayerState.DELIVERING
        deadline = time.monotonic() + _DELIVERED_WITHIN
        for publisher in publishers.values():
            while not self._stopped and time.monotonic() < deadline and not delivered(publisher, 0.2):
                pass

    def _publish(self, bag: BagReader, publishers: dict) -> None:
        due, last = time.monotonic(), None
        for raw in bag.raw_messages(publishers):
            if last is not None:
                due += (raw.stamp_ns - last) * 1e-9 / self._config.rate
            last = raw.stamp_ns
            self._stop.wait(max(0.0, due - time.monotonic()))
            if self._stopped:
                return
            publishers[raw.topic].publish(bytes(raw.data))
            self._sent += 1


if __name__ == "__main__":
    raise SystemExit(run(BagPlayerNode))
