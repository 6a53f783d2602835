"""The topics of arms with joints: where their links and joints are, and what they are."""

from collections.abc import Callable, Mapping

import numpy as np
from rclpy.publisher import Publisher

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.instruments import ArmKinematics
from endo_sim_ros.instruments.urdf import arm_capsules, robot_description
from endo_sim_ros.messages import Topic
from endo_sim_ros.nodes.base import STREAM_DEPTH, EndoNode
from endo_sim_ros.nodes.camera_arm import CameraArm
from endo_sim_ros.nodes.configs import PhysicsNodeConfig
from endo_sim_ros.nodes.jointed_arm import JointedArm
from endo_sim_ros.nodes.pacing import MOST_WAITING

_SHOWN = (
    messages.tool_joints, messages.tool_joint_setpoint, messages.tool_velocity, messages.tool_local_pose, messages.tool_local_setpoint,
    messages.tool_spatial_reaction,
)  # fmt: skip
_JACOBIANS = {messages.tool_body_jacobian: ArmKinematics.body_jacobian, messages.tool_spatial_jacobian: ArmKinematics.spatial_jacobian}


class JointTopics:
    """Publishes the states of arms with joints.

    Args:
        node: The ROS node that the topics belong to.
        arms: The arms with joints by name.
        options: Options of the node; assign `options` when they change.
    """

    def __init__(self, node: EndoNode, arms: Mapping[str, JointedArm], options: PhysicsNodeConfig) -> None:
        self.options = options
        self._arms, self._described = arms, ""
        self._capsules = {name: arm_capsules(arm.kinematics) for name, arm in arms.items()}  # takes longer than a step may be late
        instruments = {name: arm for name, arm in arms.items() if not isinstance(arm, CameraArm)}
        depth = MOST_WAITING if options.mode == "lockstep" else STREAM_DEPTH
        self._links = [(arm, node.publisher(messages.tool_links(name), depth, alone=True)) for name, arm in instruments.items()]
        self._encoded: dict[str, tuple[dict[str, np.ndarray], str, messages.Message]] = {}  # links by arm, and their frame and message
        self._tool_types = [node.publisher(messages.tool_type(name), alone=True) for name in instruments]
        for publisher, arm in zip(self._tool_types, instruments.values()):
            publisher.publish(messages.encode_text(arm.tool_type))
        self._shown: dict[str, dict[Callable[[str], Topic], messages.Message]] = {
            name: {topic: node.publisher(topic(name), alone=True) for topic in (*_SHOWN, *_JACOBIANS)}
            for name, arm in arms.items()
            if arm.commanded
        }
        for name in self._shown.keys() - instruments.keys():  # the others' are of `ReactionTopics`
            self._shown[name][messages.tool_reaction] = node.publisher(messages.tool_reaction(name), alone=True)
        if arms:
            self._joint_states = node.publisher(messages.JOINT_STATES)
            self._description = node.publisher(messages.ROBOT_DESCRIPTION)

    def describe(self) -> None:
        """Publish what the arms look like and where they stand, if that has changed."""
        placed = {name: (arm.kinematics, arm.base, self._capsules[name]) for name, arm in self._arms.items() if arm.base is not None}
        text = robot_description(placed, self.options.world_frame) if placed else ""
        if text != self._described:
            self._described = text
            self._description.publish(messages.encode_text(text))

    @property
    def link_publishers(self) -> list[Publisher]:
        """Those of where links are."""
        return [publisher for _, publisher in self._links]

    def publish_links(self, stamp: int) -> None:
        """Publish where the links of the instruments are, at the time of a state, ns; nowhere while nobody knows."""
        for arm, publisher in self._links:
            message = self._encode_links(arm)
            messages.set_stamp(message, stamp)
            publisher.publish(message)

    def _encode_links(self, arm: JointedArm) -> messages.Message:
        """The message of the links of an arm, with any stamp; the same one while they are where they were."""
        links, frame = arm.links(), self.options.world_frame
        known = self._encoded.get(arm.name)
        if known is None or known[0] is not links or known[1] != frame:
            known = self._encoded[arm.name] = links, frame, messages.encode_poses(list(links.values()), 0, frame)
        return known[2]

    def rods(self, arm: JointedArm) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Both ends [3], world, and the radius of each capsule of an arm's instrument, m; none while nobody knows where it is."""
        links = arm.links()
        place = lambda capsule, end: links[capsule.link][:3, :3] @ end + links[capsule.link][:3, 3]  # noqa: E731
        capsules = self._capsules[arm.name] if links else ()
        return [(place(capsule, capsule.start), place(capsule, capsule.end), capsule.radius) for capsule in capsules]

    def publish_joint_states(self, stamp: int) -> None:
        """Publish the joints of all arms in one message, while somebody subscribes."""
        if not self._arms or not self._joint_states.get_subscription_count():
            return
        names, positions = [], []
        for name, arm in self._arms.items():
            if arm.joints is not None:
                names += [messages.joint_state_name(name, joint.name) for joint in arm.kinematics.joints]
                positions += list(arm.joints)
                if arm.kinematics.jaw is not None:
                    names.append(messages.joint_state_name(name, "jaw"))
                    positions.append(arm.gape)
        none = np.zeros(0)
        self._joint_states.publish(messages.encode_joints(names, np.array(positions), none, none, stamp))

    def publish(self, arm: JointedArm, force: np.ndarray, torque: np.ndarray, stamp: int, frame: str, R: np.ndarray) -> None:
        """Publish what the joints of a commanded arm do.

        Args:
            arm: The arm.
            force: Force [3] of the tissue on the tip, N, world.
            torque: Torque [3] about the tip, N·m, world.
            stamp: Time of the state, ns.
            frame: Name of the frame of velocities.
            R: Axes [3, 3] of that frame in the world.
        """
        if arm.name not in self._shown or arm.base is None or arm.joints is None or arm.pose is None:
            return
        arm.settle()
        publishers, names = self._shown[arm.name], [joint.name for joint in arm.kinematics.joints]
        efforts, linear, angular = arm.dynamics(force, torque)
        speeds = np.zeros(len(names)) if arm.velocities is None else arm.velocities
        for topic in (messages.tool_joints, messages.tool_joint_setpoint):  # an arm without a robot is where it is told to be
            publishers[topic].publish(messages.encode_joints(names, arm.joints, speeds, efforts, stamp))
        publishers[messages.tool_velocity].publish(messages.encode_twist(R.T @ linear, R.T @ angular, stamp, frame))
        local = invert_pose(arm.base) @ arm.pose
        for topic in (messages.tool_local_pose, messages.tool_local_setpoint):
            publishers[topic].publish(messages.encode_pose(local, stamp, f"{arm.name}_base"))
        axes = arm.base[:3, :3].T
        about_base = axes @ (torque + np.cross(arm.pose[:3, 3] - arm.base[:3, 3], force))
        message = messages.encode_wrench(axes @ force, about_base, stamp, f"{arm.name}_base")
        publishers[messages.tool_spatial_reaction].publish(message)
        if (felt := publishers.get(messages.tool_reaction)) is not None:
            felt.publish(messages.encode_wrench(np.zeros(3), np.zeros(3), stamp, arm.name))
        for topic, jacobian in _JACOBIANS.items():
            if publishers[topic].get_subscription_count():
                publishers[topic].publish(messages.encode_matrix(jacobian(arm.kinematics, arm.joints)))
