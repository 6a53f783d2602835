"""The topics of the tool arms of physics_node: commands in, states out."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.messages import MessageError, Topic
from endo_sim_ros.nodes.arm import Arm
from endo_sim_ros.nodes.base import STREAM_DEPTH, EndoNode
from endo_sim_ros.nodes.configs import PhysicsNodeConfig

Deliver = Callable[[str, str, Any, str, Callable[[], None]], None]


class ArmTopics:
    """Subscribes to the commands of all arms and publishes their states.

    Args:
        node: The ROS node that the topics belong to.
        arms: The arms by name.
        options: Options of the node; assign `options` when they change.
        depth: Length of the queues of commands.
        deliver: Called with the name of an arm, the part of a command ("pose", "wrench", "jaw", "cut"), its message, its
            topic, and a function that lets the part act on the arm; decides when that is called.
    """

    def __init__(self, node: EndoNode, arms: dict[str, Arm], options: PhysicsNodeConfig, depth: int, deliver: Deliver):
        self.options = options
        self._node, self._arms, self._deliver = node, arms, deliver
        commanded = options.arm_source == "commanded"
        self._pose_topic: Callable[[str], Topic] = messages.tool_pose_command if commanded else messages.tool_pose
        self._reactions = {name: node.publisher(messages.tool_reaction(name)) for name in arms}
        shown = messages.tool_pose, messages.tool_setpoint, messages.tool_jaw_state, messages.tool_jaw_setpoint, messages.tool_state
        self._publishers = {name: [node.publisher(topic(name)) for topic in shown] for name in arms if commanded}
        self._told: dict[str, tuple[str, bool, bool]] = {}  # what was last said on operating_state
        for name in arms:
            node.subscribe(self._pose_topic(name), partial(self._on_pose, name), depth)
            node.subscribe(messages.tool_wrench(name), partial(self._on_wrench, name), depth)
            several = max(depth, STREAM_DEPTH)  # some come once
            node.subscribe(messages.tool_jaw(name), partial(self._on_jaw, name), several)
            node.subscribe(messages.tool_jaw_move(name), partial(self._on_jaw_move, name), several)
            node.subscribe(messages.tool_cut(name), partial(self._on_cut, name), several)
            if commanded:
                node.subscribe(messages.tool_move(name), partial(self._on_move, name), several)
                node.subscribe(messages.tool_state_command(name), partial(self._on_state_command, name))
        self.publish_operating_states()

    # ---------------------------------------------------------------- commands

    def _decode_tip(self, name: str, message: Any, topic: str) -> np.ndarray:
        """Pose [4, 4] of a tool tip in the world."""
        frames = self.options.frame_poses
        unnamed = frames.get(f"{name}_base", np.eye(4))  # clients of CRTK leave the frame empty
        return messages.decode_pose(message, frames | {"": unnamed}, topic)

    def _on_pose(self, name: str, message: Any) -> None:
        arm, topic = self._arms[name], self._pose_topic(name).name
        pose = self._decode_tip(name, message, topic)

        def act() -> None:
            _require_enabled(arm, topic)
            arm.pose, arm.pose_goal = pose, None
            self.publish_operating_states()

        self._deliver(name, "pose", message, topic, act)

    def _on_move(self, name: str, message: Any) -> None:
        arm, topic = self._arms[name], messages.tool_move(name).name
        goal = self._decode_tip(name, message, topic)
        _require_enabled(arm, topic)
        arm.pose_goal = goal
        self.publish_operating_states(name)

    def _on_wrench(self, name: str, message: Any) -> None:
        topic, arm = messages.tool_wrench(name).name, self._arms[name]
        force, torque = messages.decode_wrench(message, topic)
        frames = self.options.frame_poses
        frame = messages.check_frame(message, ("", name, *frames), topic)

        def act() -> None:
            pose = self._require_pose(name, topic, "wrench")
            R = frames.get(frame, pose)[:3, :3]  # any other is the tool's own
            arm.force, arm.torque, arm.heard = R @ force, R @ torque, self._node.now_ns() * 1e-9

        self._deliver(name, "wrench", message, topic, act)

    def _on_jaw(self, name: str, message: Any) -> None:
        topic, arm = messages.tool_jaw(name).name, self._arms[name]
        angle = messages.decode_jaw(message, topic)

        def act() -> None:
            self._require_pose(name, topic, "jaw command")
            arm.angle, arm.angle_goal = angle, None
            arm.hold(self.options.jaw_closed, self.options.jaw_open)
            self.publish_operating_states()

        self._deliver(name, "jaw", message, topic, act)

    def _on_jaw_move(self, name: str, message: Any) -> None:
        arm, topic = self._arms[name], messages.tool_jaw_move(name).name
        goal = messages.decode_jaw(message, topic)
        self._require_pose(name, topic, "jaw command")
        arm.angle_goal = goal
        self.publish_operating_states(name)

    def _on_cut(self, name: str, message: Any) -> None:
        topic, arm = messages.tool_cut(name).name, self._arms[name]
        cutting = messages.decode_cut(message, topic)

        def act() -> None:
            self._require_pose(name, topic, "cut")
            arm.cutting = cutting

        self._deliver(name, "cut", message, topic, act)

    def _on_state_command(self, name: str, message: Any) -> None:
        try:
            self._arms[name].command_state(messages.decode_state_command(message))
        except ValueError as error:
            raise MessageError(f"{messages.tool_state_command(name).name}: {error}") from error
        finally:
            self.publish_operating_states(name)

    def _require_pose(self, name: str, topic: str, what: str) -> np.ndarray:
        """The pose of an arm that may move; MessageError if it has none or may not."""
        arm = self._arms[name]
        _require_enabled(arm, topic)
        if arm.pose is None:
            pose_topic = self._pose_topic(name).name
            raise MessageError(f"{topic}: a {what} came before any pose on {pose_topic}; publish the tip's pose")
        return arm.pose

    # ------------------------------------------------------------------ states

    def publish_operating_states(self, asked: str = "") -> None:
        """Publish the operating state of each commanded arm that has changed.

        Args:
            asked: Name of an arm that received a command: its state is published in any case, as clients of CRTK wait for
                a message after their command.
        """
        for name, (*_, publisher) in self._publishers.items():
            arm = self._arms[name]
            state = arm.state, arm.homed, arm.busy
            if name == asked or self._told.get(name) != state:
                self._told[name] = state
                publisher.publish(messages.encode_operating_state(*state, self._node.now_ns()))

    def publish(self, arm: Arm, pose: np.ndarray, reaction: np.ndarray, torque: np.ndarray, stamp: int) -> None:
        """Publish what an arm feels and, if it is commanded, where it is.

        Args:
            arm: The arm.
            pose: Pose [4, 4] of its tip, m, world.
            reaction: Force [3] of the tissue on the tool, N, world.
            torque: Torque [3] about the tip, N·m, world.
            stamp: Time of the state, ns.
        """
        axes = pose[:3, :3].T  # the reaction is given in the axes of the tool
        self._reactions[arm.name].publish(messages.encode_wrench(axes @ reaction, axes @ torque, stamp, arm.name))
        if arm.name in self._publishers:
            *poses, jaw_state, jaw_setpoint, _ = self._publishers[arm.name]
            for publisher in poses:  # an ideal arm is where it is told to be
                publisher.publish(messages.encode_pose(pose, stamp, self.options.world_frame))
            for publisher in (jaw_state, jaw_setpoint):
                publisher.publish(messages.encode_jaw(arm.angle, stamp))


def _require_enabled(arm: Arm, topic: str) -> None:
    try:
        arm.require_enabled()
    except ValueError as error:
        raise MessageError(f"{topic}: {error}") from error
