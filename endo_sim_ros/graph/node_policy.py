"""A policy that is a ROS node of somebody else: it hears observations, and answers each with an action."""

import re
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.utilities import ok

from endo_sim_ros import messages
from endo_sim_ros.learning.actions import ARM_NAMES, Actions, by_arm
from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.pictures import IMAGE, IMAGE_RIGHT
from endo_sim_ros.learning.task_batch import ARM_STATE
from endo_sim_ros.learning.tasks import find_task
from endo_sim_ros.nodes.base import EndoNode
from endo_sim_ros.nodes.listeners import Listeners

_ME = "benchmark"
_STARTS = 30.0  # s that the node has to start, at least
_FRAME = "endoscope_left", "endoscope_right"
_NAME = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)  # of a node, in namespaces or not


class NodePolicy:
    """Asks a ROS node, which only subscribes and publishes; see "A policy of your own" in msg_conventions.md.

    Args:
        name: Of the node, which runs already, or starts soon.
        task: Name of the task.
        sight: What pictures show, if the node subscribes to some.
        patience: Longest wait for each of its answers, s.

    Raises:
        ValueError: If no node can have this name.
        RuntimeError: If there is no such node.
    """

    actions: Actions = "cartesian"
    alone = True
    """It plays one episode after the other."""

    def __init__(self, name: str, task: str, sight: SightConfig = SightConfig(), patience: float = 10.0):
        kind = find_task(task)
        self._name, self._patience = name.strip("/"), patience
        if not _NAME.fullmatch(self._name):
            raise ValueError(f"node:{name} names no ROS node; give letters, digits and _ after the colon, as in node:lifter")
        self._size, self._step_ns = kind.action_size() * len(kind.arms), round(kind.physics("cpu").step_duration * 1e9)
        self._stamp, self._answer = 0, None
        if not ok():
            rclpy.init()
        self._node = node = EndoNode(_ME)
        self._spinner = SingleThreadedExecutor()
        self._spinner.add_node(node)
        topic = lambda make: make(self._name)
        self._topic = topic(messages.policy_action)
        self._numbers = node.publisher(topic(messages.policy_observation))
        makers = {IMAGE: messages.policy_image, IMAGE_RIGHT: messages.policy_right_image}
        self._pictures = {picture: node.publisher(topic(make)) for picture, make in makers.items()}
        node.create_subscription(messages.ros_class(self._topic.type), self._topic.name, self._on_action, 20)
        everything = Listeners([self._numbers, *self._pictures.values()])
        ready = lambda: everything.settled() and self._numbers.get_subscription_count() and node.count_publishers(self._topic.name)
        heard = f"subscribes to {self._numbers.topic_name.lstrip('/')} and publishes {self._topic.name}"
        self._await(ready, f"there is no node {self._name} that {heard}; start it before", max(patience, _STARTS))
        seen = [publisher.get_subscription_count() > 0 for publisher in self._pictures.values()]
        self.sight = sight if any(seen) else None
        names = kind.observation_names if self.sight is None else ARM_NAMES if len(kind.arms) == 1 else by_arm(kind, ARM_NAMES)
        self._encode = partial(messages.encode_joints, names, velocities=np.zeros(0), efforts=np.zeros(0))

    def reset(self, episodes: Sequence[int]) -> None:
        """The next observation is the first of an episode: stamps begin anew."""
        self._stamp = 0

    def act(self, observations: np.ndarray | dict[str, np.ndarray]) -> np.ndarray:
        """Actions [1, 4 A] for the state [1, n], or what arms measure with pictures.

        Raises:
            RuntimeError: If the node does not answer in time.
            ValueError: If it answers with another number of numbers, or with some that are not finite.
        """
        self._stamp, self._answer = self._stamp + self._step_ns, None
        seen = observations if isinstance(observations, dict) else {ARM_STATE: observations}
        for (picture, publisher), frame in zip(self._pictures.items(), _FRAME):
            if picture in seen:
                publisher.publish(messages.encode_image(seen[picture][0], self._stamp, frame))
        self._numbers.publish(self._encode(seen[ARM_STATE][0].astype(np.float64), stamp_ns=self._stamp))
        when = f"the observation of {self._stamp * 1e-9:.2f} s"
        self._await(lambda: self._answer is not None, f"{self._name} did not answer {when} on {self._topic.name}", self._patience)
        return messages.decode_action(self._answer, self._topic.name, self._size)[None]

    def _on_action(self, message: Any) -> None:
        if messages.stamp_to_ns(message.header.stamp) == self._stamp:
            self._answer = message

    def _await(self, done: Callable[[], Any], missing: str, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not done():
            self._spinner.spin_once(timeout_sec=0.01)
            if time.monotonic() > deadline:
                raise RuntimeError(f"{missing} (waited {seconds:g} s)")

    def close(self) -> None:
        """Leave the graph."""
        self._spinner.shutdown()
        self._node.destroy_node()
