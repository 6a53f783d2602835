"""The topics of the arms of physics_node: commands in, states out."""

import contextlib
from collections.abc import Callable, Collection, Iterator
from typing import Any, TypeVar

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.messages import Topic
from endo_sim_ros.nodes.arm import DISABLED, ENABLED, Arm
from endo_sim_ros.nodes.base import STREAM_DEPTH, EndoNode, sentence
from endo_sim_ros.nodes.camera_arm import CameraArm
from endo_sim_ros.nodes.configs import COMMAND_PARTS, PhysicsNodeConfig
from endo_sim_ros.nodes.joint_topics import JointTopics
from endo_sim_ros.nodes.jointed_arm import JointedArm
from endo_sim_ros.nodes.pacing import MOST_WAITING

_CHANGES = "changes of joint positions"

AnArm = TypeVar("AnArm", bound=Arm)
Act = Callable[[], None]
Deliver = Callable[[str, str, Any, str, Act], None]
Discard = Callable[[str, Collection[str]], None]


class _Told(messages.MessageError):
    """A sentence that has been published on the topic of its arm."""


def _refuse(error: ValueError) -> Act:
    """What a refused part of a command does: it raises why."""

    def act() -> None:
        raise error

    return act


class ArmTopics:
    """Subscribes to the commands of all arms and publishes their states.

    Args:
        node: The ROS node that the topics belong to.
        arms: The arms by name.
        options: Options of the node; tell `change_options` when they change.
        depth: Length of the queues of commands.
        deliver: Called with the name of an arm, the part of a command ("pose", "wrench", "jaw", "cut"), its message, its
            topic, and a function that lets the part act on the arm; decides when that is called.
        discard: Called with the name of an arm and the parts of commands that a newer command replaces; those that wait never act.

    Attributes:
        joints: Topics of the arms with joints.
        camera_pose: Newest pose [4, 4] of a camera that is no arm of this node, world, or None.
    """

    def __init__(
        self, node: EndoNode, arms: dict[str, Arm], options: PhysicsNodeConfig, depth: int, deliver: Deliver, discard: Discard
    ) -> None:
        self._node, self._arms, self._deliver, self._discard = node, arms, deliver, discard
        self.camera_pose: np.ndarray | None = None
        commanded = options.arm_source == "commanded"
        self._pose_topic = messages.tool_pose_command if commanded else messages.tool_pose
        self._camera = next((arm for arm in arms.values() if isinstance(arm, CameraArm)), None)
        tools = [arm for arm in arms.values() if arm is not self._camera]
        self._publishers = {arm.name: self._make_publishers(arm, options) for arm in arms.values() if commanded}
        self._told: dict[str, tuple[str, bool, bool]] = {}  # what was last said on operating_state
        self._short: set[str] = set()  # arms that have said that they do not reach their pose
        several = max(depth, STREAM_DEPTH)  # for what comes once
        for arm in arms.values():
            self._hear_part(arm, "pose", self._pose_topic, self._on_pose, depth)
            if commanded:
                self._hear(arm, messages.tool_move, self._on_move, several)
                self._hear(arm, messages.tool_state_command, self._on_state_command, STREAM_DEPTH)
                self._hear(arm, messages.tool_hold, self._on_hold, several)
                self._hear(arm, messages.tool_free, self._on_hold, several)  # joints that nothing moves stay where they are
                if isinstance(arm, JointedArm):
                    self._hear_part(arm, "pose", messages.tool_joint_command, self._on_joints, depth)
                    self._hear_part(arm, "pose", messages.tool_joint_change, self._on_joint_change, MOST_WAITING)  # none replaces another
                    for make in (messages.tool_joint_effort, messages.tool_wrench_axes, messages.tool_gravity, messages.tool_present):
                        self._hear(arm, make, self._on_what_arms_lack, STREAM_DEPTH)
                    if arm is self._camera:
                        for make in (messages.tool_wrench, messages.tool_spatial_wrench):
                            self._hear(arm, make, self._on_what_arms_lack, depth)
                    self._hear(arm, messages.tool_joint_move, self._on_joint_move, several)
                    self._hear(arm, messages.tool_joint_move_change, self._on_joint_move_change, several)
                    self._hear(arm, messages.tool_ratio_command, self._on_ratio, several)
                    self._publishers[arm.name][messages.tool_ratio].publish(messages.encode_number(arm.speed_ratio))
        for arm in tools:
            self._hear_part(arm, "wrench", messages.tool_wrench, self._on_wrench, depth)
            if commanded and isinstance(arm, JointedArm):
                self._hear_part(arm, "wrench", messages.tool_spatial_wrench, self._on_spatial_wrench, depth)
                self._hear(arm, messages.tool_jaw_effort, self._on_what_arms_lack, STREAM_DEPTH)
            self._hear_part(arm, "jaw", messages.tool_jaw, self._on_jaw, several)
            self._hear(arm, messages.tool_jaw_move, self._on_jaw_move, several)
            self._hear_part(arm, "cut", messages.tool_cut, self._on_cut, several)
        self.joints = JointTopics(node, {name: arm for name, arm in arms.items() if isinstance(arm, JointedArm)}, options)
        self.change_options(options)
        self.publish_operating_states()

    def change_options(self, options: PhysicsNodeConfig) -> None:
        """Use new options of the node."""
        self.options = self.joints.options = options
        for arm in self._arms.values():
            if isinstance(arm, JointedArm):
                arm.joint_speed, arm.slide_speed = options.joint_speed, options.slide_speed

    def _make_publishers(self, arm: Arm, options: PhysicsNodeConfig) -> dict[Callable[[str], Topic], Any]:
        shown = [messages.tool_setpoint, messages.tool_state, messages.tool_state_name]
        shown += [messages.tool_info, messages.tool_warning, messages.tool_error]
        if arm is not self._camera and not (isinstance(arm, JointedArm) and arm.kinematics.jaw is None):
            shown += [messages.tool_jaw_state, messages.tool_jaw_setpoint]
        if isinstance(arm, JointedArm):
            shown += [messages.tool_ratio]
        # A renderer in lockstep waits for each pose of the camera.
        depth = MOST_WAITING if arm is self._camera and options.mode == "lockstep" else STREAM_DEPTH
        publishers = {topic: self._node.publisher(topic(arm.name), alone=True) for topic in shown}
        return publishers | {messages.tool_pose: self._node.publisher(messages.tool_pose(arm.name), depth, alone=True)}

    # ------------------------------------------------------------------ frames

    def _view(self) -> np.ndarray | None:
        """Pose [4, 4] of ECM_view in the world, or None while nobody has told the camera's."""
        pose = self._camera.pose if self._camera is not None else self.camera_pose
        return None if pose is None else pose @ messages.VIEW_IN_CAMERA

    def _frames(self, arm: Arm) -> dict[str, np.ndarray]:
        """Poses [4, 4] in the world of the frames that a command to an arm may be in, by name; one without a name is in ``""``."""
        given, view = self.options.frame_poses, self._view()
        found = dict(given)
        for name, other in self._arms.items():
            if isinstance(other, JointedArm) and other.base is not None:
                found.setdefault(f"{name}_base", other.base)
        if view is not None:
            found.setdefault(messages.ECM_VIEW, view)
        frame, origin = self._shown_in(arm)
        if frame != self.options.world_frame:
            found[""] = origin
        elif self.options.cartesian_frame != messages.ECM_VIEW or arm is self._camera:
            # A commanded arm is told its pose in the frame in which it publishes it, and that is the world; a robot's is in its base.
            found[""] = np.eye(4) if arm.name in self._publishers else given.get(f"{arm.name}_base", np.eye(4))
        return found

    def _shown_in(self, arm: Arm) -> tuple[str, np.ndarray]:
        """Name and pose [4, 4] of the frame in which the pose of an arm is published."""
        frame, poses = self.options.cartesian_frame, {messages.ECM_VIEW: self._view(), **self.options.frame_poses}
        origin = None if arm is self._camera else poses.get(frame)
        return (self.options.world_frame, np.eye(4)) if origin is None else (frame, origin)

    # ---------------------------------------------------------------- commands

    def _hear(self, arm: AnArm, topic_of: Callable[[str], Topic], callback: Callable[[AnArm, str, Any], None], depth: int) -> None:
        """Call back with the arm, the topic's name and each message; a ValueError is reported under that name."""
        topic = topic_of(arm.name)

        def heard(message: Any) -> None:
            with self._telling(arm, topic.name):
                callback(arm, topic.name, message)

        self._node.subscribe(topic, heard, depth)

    def _hear_part(
        self, arm: AnArm, kind: str, topic_of: Callable[[str], Topic], prepare: Callable[[AnArm, str, Any], Act], depth: int
    ) -> None:
        """Deliver what each message makes the arm do; in lockstep also that a message is refused, as its command waits for its parts."""

        def heard(arm: AnArm, topic: str, message: Any) -> None:
            try:
                act = prepare(arm, topic, message)
            except ValueError as error:
                if self.options.mode != "lockstep":
                    raise
                act = _refuse(error)
            self._deliver_part(arm, kind, message, topic, act)

        self._hear(arm, topic_of, heard, depth)

    @contextlib.contextmanager
    def _telling(self, arm: Arm, topic: str) -> Iterator[None]:
        """Context that also tells the errors of its block on the topic of the arm."""
        try:
            yield
        except _Told:
            raise
        except ValueError as error:
            text = sentence(topic, error)
            self._tell(arm, messages.tool_error, text)
            raise _Told(text) from error

    def _tell(self, arm: Arm, topic: Callable[[str], Topic], text: str) -> None:
        if arm.name in self._publishers:
            self._publishers[arm.name][topic].publish(messages.encode_report(text, self._node.now_ns()))

    def tell_slip(self, arm: Arm, text: str) -> None:
        """Warn that tissue slipped out of the jaw of an arm, which pulling it hard may have been meant to do."""
        self._tell(arm, messages.tool_warning, text)
        self._node.report_warning(text)

    def warn(self, arm: Arm, text: str, again: bool = False) -> None:
        """Report what an arm misses of its pose, if anything; on its own topic once until it reaches one.

        Args:
            arm: The arm.
            text: The sentence, or nothing.
            again: Tell it on that topic, too, if it has been told.
        """
        if not text:
            self._short.discard(arm.name)
            return
        if again or arm.name not in self._short:
            self._tell(arm, messages.tool_warning, text)
        self._short.add(arm.name)
        self._node.report_error(text)

    def _deliver_part(self, arm: Arm, kind: str, message: Any, topic: str, act: Act) -> None:
        """Let a part of a command act on an arm when it is time; in lockstep on the camera's, which is no part of a command, now."""

        def telling() -> None:
            with self._telling(arm, topic):
                act()

        if arm is self._camera and self.options.mode == "lockstep":
            telling()
        else:
            self._deliver(arm.name, kind, message, topic, telling)

    def _decode_pose(self, arm: Arm, topic: str, message: Any) -> np.ndarray:
        frames = self._frames(arm)
        if "" not in frames and not message.header.frame_id:
            raise ValueError(f"a pose in {messages.ECM_VIEW}, but no pose of a camera came on {messages.CAMERA_POSE.name}; add ECM to arms")
        return messages.decode_pose(message, frames, topic)

    def _servo(self, arm: Arm, take: Act) -> Act:
        """What a command does that an arm takes at once, if it is enabled."""

        def act() -> None:
            arm.require_enabled()
            take()
            self.publish_operating_states()

        return act

    def _begin(self, arm: Arm, take: Act, *replaced: str) -> None:
        """Let a command act from now on, if the arm is enabled: parts of others that wait are forgotten, and its state is told."""
        arm.require_enabled()
        take()
        self._discard(arm.name, replaced)
        self.publish_operating_states(arm.name)

    def _on_pose(self, arm: Arm, topic: str, message: Any) -> Act:
        pose = self._decode_pose(arm, topic, message)
        return self._servo(arm, lambda: arm.servo(pose))

    def _on_move(self, arm: Arm, topic: str, message: Any) -> None:
        goal = self._decode_pose(arm, topic, message)
        self._begin(arm, lambda: self.warn(arm, arm.move_to(goal), again=True), "pose")

    def _on_joints(self, arm: JointedArm, topic: str, message: Any) -> Act:
        joints = arm.check_joints(messages.decode_joints(message, topic), message.name)
        return self._servo(arm, lambda: arm.servo_joints(joints))

    def _on_joint_move(self, arm: JointedArm, topic: str, message: Any) -> None:
        goal = arm.check_joints(messages.decode_joints(message, topic), message.name)
        self._begin(arm, lambda: arm.move_joints(goal), "pose")

    def _on_joint_change(self, arm: JointedArm, topic: str, message: Any) -> Act:
        change = arm.check_numbers(messages.decode_joints(message, topic, _CHANGES), message.name)
        return self._servo(arm, lambda: arm.servo_joints(arm.joints_after(change)))

    def _on_joint_move_change(self, arm: JointedArm, topic: str, message: Any) -> None:
        change = arm.check_numbers(messages.decode_joints(message, topic, _CHANGES), message.name)
        self._begin(arm, lambda: arm.move_joints(arm.joints_after(change, of_goal=True)), "pose")

    def _on_hold(self, arm: Arm, topic: str, message: Any) -> None:
        self._begin(arm, arm.stop, "pose", "jaw")

    def _on_ratio(self, arm: JointedArm, topic: str, message: Any) -> None:
        arm.set_speed_ratio(messages.decode_number(message))
        self._publishers[arm.name][messages.tool_ratio].publish(messages.encode_number(arm.speed_ratio))

    def _on_wrench(self, arm: Arm, topic: str, message: Any) -> Act:
        force, torque = messages.decode_wrench(message, topic)
        frames = {name: pose for name, pose in self._frames(arm).items() if name}
        frame = messages.check_frame(message, ("", arm.name, *frames), topic)

        def act() -> None:
            pose = self._require_pose(arm, "wrench")
            R = frames.get(frame, pose)[:3, :3]  # any other is the tool's own
            arm.exert(R @ force, R @ torque, self._node.now_ns() * 1e-9)

        return act

    def _on_spatial_wrench(self, arm: JointedArm, topic: str, message: Any) -> Act:
        force, torque = messages.decode_wrench(message, topic)
        messages.check_frame(message, ("", f"{arm.name}_base"), topic)

        def act() -> None:
            if arm.base is None:
                raise ValueError("a wrench about the base came before anybody knew where that is; see frames")
            self._require_pose(arm, "wrench")
            turned, about_base = arm.base[:3, :3] @ force, arm.base[:3, :3] @ torque
            about_tip = about_base - np.cross(arm.works_at - arm.base[:3, 3], turned)
            arm.exert(turned, about_tip, self._node.now_ns() * 1e-9)

        return act

    def _on_jaw(self, arm: Arm, topic: str, message: Any) -> Act:
        angle = arm.check_jaw(messages.decode_jaw(message, topic))

        def act() -> None:
            self._require_pose(arm, "jaw command")
            arm.angle, arm.angle_goal = angle, None
            arm.hold(self.options.jaw_closed, self.options.jaw_open)
            self.publish_operating_states()

        return act

    def _on_jaw_move(self, arm: Arm, topic: str, message: Any) -> None:
        goal = arm.check_jaw(messages.decode_jaw(message, topic))
        self._require_pose(arm, "jaw command")
        self._begin(arm, lambda: setattr(arm, "angle_goal", goal), "jaw")

    def _on_what_arms_lack(self, arm: Arm, topic: str, message: Any) -> None:
        """Refuse what asks for more than an ideal arm has: clients of the dVRK wait for who hears it."""
        is_one = lambda *topics: topic in [make(arm.name).name for make in topics]  # noqa: E731
        if is_one(messages.tool_joint_effort, messages.tool_jaw_effort):
            told = messages.tool_joint_command if is_one(messages.tool_joint_effort) else messages.tool_jaw
            raise ValueError(f"the joints are ideal and take no efforts; send positions on {told(arm.name).name}")
        if is_one(messages.tool_wrench, messages.tool_spatial_wrench):
            if np.any(messages.decode_wrench(message, topic)):
                raise ValueError("the endoscope touches nothing, and exerts no wrench")
        elif is_one(messages.tool_wrench_axes):
            if message.data:
                spatial = messages.tool_spatial_wrench(arm.name).name
                raise ValueError(f"wrenches are in the axes of the tip here; send those of the base on {spatial}")
        elif not message.data:
            raise ValueError(
                "the joints are ideal and bear the arm's weight" if is_one(messages.tool_gravity) else "the tool stays on the arm"
            )

    def _on_cut(self, arm: Arm, topic: str, message: Any) -> Act:
        cutting = messages.decode_pedal(message, topic)

        def act() -> None:
            self._require_pose(arm, "cut")
            arm.cutting = cutting

        return act

    def _on_state_command(self, arm: Arm, topic: str, message: Any) -> None:
        try:
            command = messages.decode_state_command(message)
            arm.command_state(command)
            if arm.state != ENABLED:  # a pause leaves what tissue the arm pulls and cuts
                self._discard(arm.name, COMMAND_PARTS if arm.state == DISABLED else ("pose", "jaw"))
            self._tell(arm, messages.tool_info, f"{arm.name} is {arm.state} after {command}")
        finally:
            self.publish_operating_states(arm.name)

    def _require_pose(self, arm: Arm, what: str) -> np.ndarray:
        """The pose of an arm that may move; ValueError if it has none or may not."""
        arm.require_enabled()
        if arm.pose is None:
            raise ValueError(f"a {what} came before any pose on {self._pose_topic(arm.name).name}; publish the tip's pose")
        arm.acts = True
        return arm.pose

    def limit_force(self, arm: Arm, reaction: Callable[[], np.ndarray]) -> None:
        """End the move of an arm with joints that the tissue pushes back, more than in the step before and than the limit allows, and
        let it take that step back: many small moves would else press on one by one.

        Warn where the force grows by more than the limit in one step.

        Args:
            arm: The arm.
            reaction: Gives the force [3] of the tissue on its tip, N.
        """
        if not isinstance(arm, JointedArm):
            return
        before, arm.felt = arm.felt, float(np.linalg.norm(reaction()))  # also while it waits: a retreat begins with what it feels
        limit = self.options.force_limit
        if limit and arm.advancing and arm.felt > max(limit, before):
            arm.turn_back()
            text = (
                f"{arm.name}: the move ended at {arm.felt:.1f} N, above force_limit = {limit:g} N; move or servo back, or raise the limit"
            )
            self._tell(arm, messages.tool_error, text)
            self._node.report_error(text)
        elif limit and arm.felt > before + limit:
            text = f"{arm.name} presses with {arm.felt:.0f} N at once: it was put into the tissue; put it beside, and servo in small steps"
            self._tell(arm, messages.tool_warning, text)
            self._node.report_warning(text)

    # ------------------------------------------------------------------ states

    def publish_operating_states(self, asked: str = "") -> None:
        """Publish the operating state of each commanded arm that has changed.

        Args:
            asked: Name of an arm that received a command: its state is published in any case, as clients of CRTK wait for
                a message after their command.
        """
        for name, publishers in self._publishers.items():
            arm, before = self._arms[name], self._told.get(name)
            state = arm.state, arm.homed, arm.busy
            if name == asked or before != state:
                self._told[name] = state
                publishers[messages.tool_state].publish(messages.encode_operating_state(*state, self._node.now_ns()))
            if before is None or before[0] != arm.state:
                publishers[messages.tool_state_name].publish(messages.encode_report(arm.state, self._node.now_ns()))

    def publish_camera(self, stamp: int) -> None:
        """Publish the pose of the camera if it has an arm here, at the time of a state, ns: before the state, as pictures of it need it."""
        if self._camera is not None and self._camera.pose is not None:
            self._publish_pose(self._camera, self._camera.pose, stamp, messages.tool_pose)

    def publish_camera_state(self, stamp: int) -> None:
        """Publish what else its arm says, after the state."""
        if self._camera is not None and self._camera.pose is not None:
            self._publish_pose(self._camera, self._camera.pose, stamp, messages.tool_setpoint)
            self._publish_joints(self._camera, np.zeros(3), np.zeros(3), stamp)

    def display(self, arm: Arm, reaction: np.ndarray, held: np.ndarray) -> messages.ToolDisplay:
        """What `tool_markers` shows of an arm with a pose, the reaction [3] on it, N, and control nodes [K, 3] that it holds, world."""
        assert arm.pose is not None
        force = arm.force if arm.acting and arm.force is not None else np.zeros(3)
        rods = self.joints.rods(arm) if isinstance(arm, JointedArm) else ()
        return messages.ToolDisplay(arm.name, arm.pose[:3, 3], force, reaction, held, rods)

    def publish(self, arm: Arm, pose: np.ndarray, reaction: np.ndarray, torque: np.ndarray, stamp: int) -> None:
        """Publish where a tool arm is, if it is commanded, and what its joints feel.

        Args:
            arm: The arm.
            pose: Pose [4, 4] of its tip, m, world.
            reaction: Force [3] of the tissue on the tool, N, world.
            torque: Torque [3], N·m, world, as `TissueSimulation.reaction` has it.
            stamp: Time of the state, ns.
        """
        if arm.name in self._publishers:
            self._publish_pose(arm, pose, stamp, messages.tool_pose, messages.tool_setpoint)  # without a robot it is where it is told to be
            self._publish_joints(arm, reaction, torque, stamp)
            for topic in (messages.tool_jaw_state, messages.tool_jaw_setpoint):
                if publisher := self._publishers[arm.name].get(topic):
                    publisher.publish(messages.encode_jaw(arm.angle, stamp))

    def _publish_pose(self, arm: Arm, pose: np.ndarray, stamp: int, *topics: Callable[[str], Topic]) -> None:
        frame, origin = self._shown_in(arm)
        message = messages.encode_pose(pose if frame == self.options.world_frame else invert_pose(origin) @ pose, stamp, frame)
        for topic in topics:
            self._publishers[arm.name][topic].publish(message)

    def _publish_joints(self, arm: Arm, force: np.ndarray, torque: np.ndarray, stamp: int) -> None:
        if isinstance(arm, JointedArm):
            frame, origin = self._shown_in(arm)
            self.joints.publish(arm, force, torque, stamp, frame, origin[:3, :3])
