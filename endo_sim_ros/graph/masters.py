"""Masters that speak CRTK, as those of a dVRK console do, in the hands of a person who demonstrates."""

import logging
import time
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
_SILENT = 0.5  # s without a pose after which a master is gone; they publish at 100 Hz and more
_FRESH = 0.005  # s for which what was heard is new: both hands of a step see the same

_logger = logging.getLogger(__name__)


class Masters:
    """Hears masters, by the numbers of the hands that hold them: 0 = the first of the names.

    A hand holds on while the operator is present and the clutch is up, as far as the pedals have told.

    Args:
        config: Names and topics.

    Raises:
        ValueError: If nobody publishes the pose of one.
    """

    def __init__(self, config: MastersConfig):
        self._config = config
        self._poses: list[np.ndarray | None] = [None] * len(config.names)  # [4, 4] each
        self._heard = [0.0] * len(config.names)  # when, s
        self._silent = [False] * len(config.names)
        self._closed = [False] * len(config.names)
        self._clutched, self._present = False, True
        self._looked = 0.0  # when, s
        self._context = Context()
        self._context.init(args=[])
        self._node = node = EndoNode(_ME, self._context)
        self._spinner = SingleThreadedExecutor(context=self._context)
        self._spinner.add_node(node)
        poses = [messages.tool_pose(name) for name in config.names]
        for number, (name, pose) in enumerate(zip(config.names, poses)):
            gripper = messages.master_gripper(name)
            node.subscribe(pose, partial(self._on_pose, number, pose.name), 1, reliable=False)
            node.subscribe(gripper, partial(self._on_gripper, number, gripper.name), 1, reliable=False)
        pedals = {config.clutch: self._on_clutch, config.operator: self._on_operator}
        for name, callback in pedals.items():
            if name:
                node.subscribe(Topic(name, "sensor_msgs/msg/Joy"), callback)
        self._topics = 2 * len(poses) + len(pedals)
        deadline = time.monotonic() + _STARTS
        while missing := [pose.name for pose in poses if not node.count_publishers(pose.name)]:
            if time.monotonic() > deadline:
                self.close()
                raise ValueError(f"masters: nobody publishes {' and '.join(missing)}; start the console, in the same ROS_DOMAIN_ID")
            self._spinner.spin_once(timeout_sec=0.05)

    def name(self, hand: int) -> str:
        """That of the master."""
        return f"master {self._config.names[hand]}"

    def gone(self, hand: int) -> bool:
        """Whether nothing comes from it any more."""
        return self._silent[hand]

    def grip(self, hand: int) -> Grip | None:
        """How a hand is by the newest messages; None where its master was not heard for half a second."""
        if time.monotonic() - self._looked > _FRESH:
            for _ in range(self._topics):  # as many callbacks as topics, of poses and grippers with the newest
                self._spinner.spin_once(timeout_sec=0)
            self._looked = time.monotonic()
        pose = self._poses[hand]
        if pose is None:
            return None
        silent = time.monotonic() - self._heard[hand] > _SILENT
        if silent != self._silent[hand]:
            self._silent[hand] = silent
            _logger.warning("%s is %s", self.name(hand), "gone; the mouse and the keys go on" if silent else "back")
        held = self._present and not self._clutched
        return None if silent else Grip(pose[:3, 3], Rotation.from_matrix(pose[:3, :3]), held, self._closed[hand])

    def close(self) -> None:
        """Leave the graph."""
        if self._context.ok():
            self._spinner.shutdown()
            self._node.destroy_node()
            self._context.shutdown()

    def _on_pose(self, hand: int, topic: str, message: Any) -> None:
        self._poses[hand] = messages.decode_pose(message, message.header.frame_id, topic)
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
