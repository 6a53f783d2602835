"""The topics of the tool arms of physics_node: commands in, states out."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.messages import Topic
from endo_sim_ros.nodes.arm import Arm
from endo_sim_ros.nodes.base import STREAM_DEPTH, EndoNode
from endo_sim_ros.nodes.configs import PhysicsNodeConfig
from endo_sim_ros.nodes.jointed_arm import JointedArm
from endo_sim_ros.nodes.pacing import MOST_WAITING

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

    def __init__(self, node: EndoNode, arms: dict[str, Arm], options: PhysicsNodeConfig, depth: int, deliver: Deliver) -> None:
        self.options = options
        self._node, self._arms, self._deliver = node, arms, deliver
        commanded = options.arm_source == "commanded"
        self._pose_topic = messages.tool_pose_command if commanded else messages.tool_pose
        self._reactions = {name: node.publisher(messages.tool_reaction(name), alone=True) for name in arms}
        shown = messages.tool_pose, messages.tool_setpoint, messages.tool_jaw_state, messages.tool_jaw_setpoint, messages.tool_state
        self._publishers = {name: {topic: node.publisher(topic(name), alone=True) for topic in shown} for name in arms if commanded}
        jointed = {name: arm for name, arm in arms.items() if isinstance(arm, JointedArm)}
        links_depth = MOST_WAITING if options.mode == "lockstep" else STREAM_DEPTH
        self._links = [(arm, node.publisher(messages.tool_links(name), links_depth, alone=True)) for name, arm in jointed.items()]
        self._tool_types = [node.publisher(messages.tool_type(name), alone=True) for name in jointed]
        for publisher, arm in zip(self._tool_types, jointed.values()):
            publisher.publish(messages.encode_text(arm.tool_type))
        self._told: dict[str, tuple[str, bool, bool]] = {}  # what was last said on operating_state
        several = max(depth, STREAM_DEPTH)  # for what comes once
        for arm in arms.values():
            self._hear(arm, self._pose_topic, self._on_pose, depth)
            self._hear(arm, messages.tool_wrench, self._on_wrench, depth)
            self._hear(arm, messages.tool_jaw, self._on_jaw, several)
            self._hear(arm, messages.tool_jaw_move, self._on_jaw_move, several)
            self._hear(arm, messages.tool_cut, self._on_cut, several)
            if commanded:
                self._hear(arm, messages.tool_move, self._on_move, several)
                self._hear(arm, messages.tool_state_command, self._on_state_command, STREAM_DEPTH)
        self.publish_operating_states()

    # ---------------------------------------------------------------- commands

    def _hear(self, arm: Arm, topic_of: Callable[[str], Topic], callback: Callable[[Arm, str, Any], None], depth: int) -> None:
        """Call back with the arm, the topic's name and each message; a ValueError is reported under that name."""
        topic = topic_of(arm.name)
        self._node.subscribe(topic, partial(callback, arm, topic.name), depth)

    def _on_pose(self, arm: Arm, topic: str, message: Any) -> None:
        pose = messages.decode_tip(message, self.options.frame_poses, arm.name, topic)

        def act() -> None:
            arm.require_enabled()
            arm.pose_goal = None
            missing = arm.reach(pose)
            self.publish_operating_states()
            if missing:
                raise ValueError(missing)

        self._deliver(arm.name, "pose", message, topic, act)

    def _on_move(self, arm: Arm, topic: str, message: Any) -> None:
        goal = messages.decode_tip(message, self.options.frame_poses, arm.name, topic)
        arm.require_enabled()
        arm.pose_goal = goal
        self.publish_operating_states(arm.name)

    def _on_wrench(self, arm: Arm, topic: str, message: Any) -> None:
        force, torque = messages.decode_wrench(message, topic)
        frames = self.options.frame_poses
        frame = messages.check_frame(message, ("", arm.name, *frames), topic)

        def act() -> None:
            pose = self._require_pose(arm, "wrench")
            R = frames.get(frame, pose)[:3, :3]  # any other is the tool's own
            arm.force, arm.torque, arm.heard = R @ force, R @ torque, self._node.now_ns() * 1e-9

        self._deliver(arm.name, "wrench", message, topic, act)

    def _on_jaw(self, arm: Arm, topic: str, message: Any) -> None:
        angle = messages.decode_jaw(message, topic)

        def act() -> None:
            self._require_pose(arm, "jaw command")
            arm.angle, arm.angle_goal = angle, None
            arm.hold(self.options.jaw_closed, self.options.jaw_open)
            self.publish_operating_states()

        self._deliver(arm.name, "jaw", message, topic, act)

    def _on_jaw_move(self, arm: Arm, topic: str, message: Any) -> None:
        goal = messages.decode_jaw(message, topic)
        self._require_pose(arm, "jaw command")
        arm.angle_goal = goal
        self.publish_operating_states(arm.name)

    def _on_cut(self, arm: Arm, topic: str, message: Any) -> None:
        cutting = messages.decode_cut(message, topic)

        def act() -> None:
            self._require_pose(arm, "cut")
            arm.cutting = cutting

        self._deliver(arm.name, "cut", message, topic, act)

    def _on_state_command(self, arm: Arm, topic: str, message: Any) -> None:
        try:
            arm.command_state(messages.decode_state_command(message))
        finally:
            self.publish_operating_states(arm.name)

    def _require_pose(self, arm: Arm, what: str) -> np.ndarray:
        """The pose of an arm that may move; ValueError if it has none or may not."""
        arm.require_enabled()
        if arm.pose is None:
            raise ValueError(f"a {what} came before any pose on {self._pose_topic(arm.name).name}; publish the tip's pose")
        arm.acts = True
        return arm.pose

    # ------------------------------------------------------------------ states

    def publish_operating_states(self, asked: str = "") -> None:
        """Publish the operating state of each commanded arm that has changed.

        Args:
            asked: Name of an arm that received a command: its state is published in any case, as clients of CRTK wait for
                a message after their command.
        """
        for name, publishers in self._publishers.items():
            arm = self._arms[name]
            state = arm.state, arm.homed, arm.busy
            if name == asked or self._told.get(name) != state:
                self._told[name] = state
                publishers[messages.tool_state].publish(messages.encode_operating_state(*state, self._node.now_ns()))

    def publish_links(self, stamp: int) -> None:
        """Publish where the links of the instruments are, at the time of a state, ns; nowhere while nobody knows."""
        for arm, publisher in self._links:
            publisher.publish(messages.encode_poses(arm.links(), stamp, self.options.world_frame))

    def publish(self, arm: Arm, pose: np.ndarray, reaction: np.ndarray, torque: np.ndarray, stamp: int) -> None:
        """Publish what an arm feels and, if it is commanded, where it is.

        Args:
            arm: The arm.
            pose: Pose [4, 4] of its tip, m, world.
            reaction: Force [3] of the tissue on the tool, N, world.
            torque: Torque [3], N·m, world, as `TissueSimulation.reaction` has it.
            stamp: Time of the state, ns.
        """
        axes = pose[:3, :3].T  # the reaction is given in the axes of the tool
        self._reactions[arm.name].publish(messages.encode_wrench(axes @ reaction, axes @ torque, stamp, arm.name))
        if arm.name in self._publishers:
            publishers = self._publishers[arm.name]
            for topic in (messages.tool_pose, messages.tool_setpoint):  # an ideal arm is where it is told to be
                publishers[topic].publish(messages.encode_pose(pose, stamp, self.options.world_frame))
            for topic in (messages.tool_jaw_state, messages.tool_jaw_setpoint):
                publishers[topic].publish(messages.encode_jaw(arm.angle, stamp))
