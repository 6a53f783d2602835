"""Masters that speak CRTK, as those of a dVRK console do, in the hands of a person who demonstrates."""

import logging
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from scipy.spatial.transform import Rotation

from endo_sim_ros import messages
from endo_sim_ros.learning.devices.hands import Grip, Hand
from endo_sim_ros.learning.person_config import DIRECTIONS, MastersConfig
from endo_sim_ros.messages import Topic
from endo_sim_ros.nodes.base import EndoNode

_ME = "demonstration"
_STARTS = 10.0  # s in which a master that runs is found
_LATER = 1.0  # s in which its gripper is found when its pose has been
_SILENT = 0.5  # s without a pose after which a master is gone; they publish at 100 Hz and more
_FIRST = 3.0  # s without a first pose after which it is told: a connection may take a second
_FRESH = 0.005  # s for which what was heard is new: both hands of a step see the same

_logger = logging.getLogger(__name__)


class Masters:
    """Hears masters, by the numbers of the hands that hold them: 0 = the first of the names.

    A hand holds on while the operator is present and the clutch is up, as far as the pedals have told. It is told once where nobody
    publishes the gripper of a master, and where nothing comes from one.

    Args:
        config: Names and topics.

    Raises:
        ValueError: If nobody publishes the pose of one.
    """

    def __init__(self, config: MastersConfig):
        self._config = config
        self._poses: list[np.ndarray | None] = [None] * len(config.names)  # [4, 4] each
        self._heard = [0.0] * len(config.names)  # when a pose came that can be used, s; 0 = never
        self._refused = [""] * len(config.names)  # why the newest cannot be
        self._asked = 0.0  # when for the first time, s
        self._silent = [False] * len(config.names)
        self._closed = [False] * len(config.names)
        self._clutched, self._present = False, True
        self._looked = 0.0  # when, s
        self._context = Context()
        self._context.init(args=[])
        self._node = node = EndoNode(_ME, self._context)
        self._spinner = SingleThreadedExecutor(context=self._context)
        self._spinner.add_node(node)
        self._pose_topics = poses = [messages.tool_pose(name) for name in config.names]
        grippers = [messages.master_gripper(name) for name in config.names]
        for number, (pose, gripper) in enumerate(zip(poses, grippers)):
            node.subscribe(pose, partial(self._on_pose, number, pose.name), 1, reliable=False)
            node.subscribe(gripper, partial(self._on_gripper, number, gripper.name), 1, reliable=False)
        pedals = {config.clutch: self._on_clutch, config.operator: self._on_operator}
        for name, callback in pedals.items():
            if name:
                node.subscribe(Topic(name, "sensor_msgs/msg/Joy"), callback)
        self._topics = 2 * len(poses) + len(pedals)
        if missing := self._unpublished(poses, _STARTS):
            self.close()
            raise ValueError(f"masters: nobody publishes {missing}; start the console, in the same ROS_DOMAIN_ID")
        if missing := self._unpublished(grippers, _LATER):
            _logger.warning("nobody publishes %s: no jaw closes by it; the key space of the page closes one", missing)

    def _unpublished(self, topics: Sequence[Topic], patience: float) -> str:
        """Names of those that nobody publishes within a time, s; empty for none."""
        deadline = time.monotonic() + patience
        while missing := [topic.name for topic in topics if not self._node.count_publishers(topic.name)]:
            if time.monotonic() > deadline:
                break
            self._spinner.spin_once(timeout_sec=0.05)
        return " and ".join(missing)

    def name(self, hand: int) -> str:
        """That of the master."""
        return f"master {self._config.names[hand]}"

    def gone(self, hand: int) -> bool:
        """Whether nothing comes from it any more."""
        return self._silent[hand]

    def grip(self, hand: int) -> Grip | None:
        """How a hand is by the newest messages; None where its master was not heard for half a second, or never."""
        if time.monotonic() - self._looked > _FRESH:
            for _ in range(self._topics):  # as many callbacks as topics, of poses and grippers with the newest
                self._spinner.spin_once(timeout_sec=0)
            self._looked = time.monotonic()
        self._asked = self._asked or self._looked
        pose, quiet = self._poses[hand], self._looked - (self._heard[hand] or self._asked)
        silent = quiet > (_FIRST if pose is None else _SILENT)
        if silent != self._silent[hand]:
            self._silent[hand] = silent
            if pose is None:
                topic, why = self._pose_topics[hand].name, self._refused[hand]
                said = f"no pose on {topic} can be used ({why})." if why else f"nothing comes from {topic}; is it powered and homed?"
                _logger.warning("%s The mouse and the keys go on", said)
            else:
                _logger.warning("%s is %s", self.name(hand), "gone; the mouse and the keys go on" if silent else "heard now")
        if pose is None or silent:
            return None
        return Grip(pose[:3, 3], Rotation.from_matrix(pose[:3, :3]), self._present and not self._clutched, self._closed[hand])

    def close(self) -> None:
        """Leave the graph."""
        if self._context.ok():
            self._spinner.shutdown()
            self._node.destroy_node()
            self._context.shutdown()

    def _on_pose(self, hand: int, topic: str, message: Any) -> None:
        try:
            self._poses[hand] = messages.decode_pose(message, message.header.frame_id, topic)
        except ValueError as error:
            self._refused[hand] = str(error)
            raise
        self._heard[hand] = time.monotonic()

    def _on_gripper(self, hand: int, topic: str, message: Any) -> None:
        angle = messages.decode_jaw(message, topic)
        self._closed[hand] = angle <= self._config.closed or self._closed[hand] and angle < self._config.open

    def _on_clutch(self, message: Any) -> None:
        self._clutched = messages.decode_pedal(message, self._config.clutch)

    def _on_operator(self, message: Any) -> None:
        self._present = messages.decode_pedal(message, self._config.operator)


def find_masters(config: MastersConfig) -> tuple[Hand, ...]:
    """The hands on all masters that are named.

    Raises:
        ValueError: If nobody publishes the pose of one.
    """
    if not config.names:
        return ()
    masters, axes = Masters(config), Rotation.from_matrix(np.array([DIRECTIONS[name] for name in config.axes]).T)
    hands = range(len(config.names))
    return tuple(Hand(masters, hand, config, axes, hand if len(hands) > 1 else None) for hand in hands)
