"""The messages of a recording as streams of numbers by the time in their headers."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import matrix_to_quat
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.instruments import JOINTS
from endo_sim_ros.messages import ECM_VIEW, VIEW_IN_CAMERA, MessageError, Topic, stamp_to_ns
from endo_sim_ros.sequences.bag import BagReader

_JUMP = 500_000_000  # ns; messages that are merely late step back by less
_IN_WORLD, _IN_VIEW, _NAMELESS = 0, 1, 2  # frames of poses, as the last column of a row says them


class Stream(NamedTuple):
    """The messages of a topic by the time in their headers."""

    stamps: np.ndarray  # [N] int64, ns, not decreasing
    values: np.ndarray  # [N, D]

    @classmethod
    def constant(cls, value: Any) -> "Stream":
        """One value [D] at all times."""
        return cls(np.array([np.iinfo(np.int64).min]), np.array([value], np.float64))

    def at(self, times: np.ndarray, before: "Stream | None" = None) -> np.ndarray:
        """The last values [T, D] at times [T]; ahead of the first, those of another stream."""
        indices = np.searchsorted(self.stamps, times, "right") - 1
        values = self.values[np.maximum(indices, 0)]
        return values if before is None else np.where((indices >= 0)[:, None], values, before.at(times))


def telling_bag(bag: Path, do: Callable[[], Any], said: str = "") -> Any:
    """What a function returns; what is wrong with a message is told with the name of its bag."""
    try:
        return do()
    except MessageError as error:
        raise SequenceError(f"{bag}: {said}{error}") from error
    except SequenceError as error:
        text = str(error)
        raise SequenceError(text if text.startswith(str(bag)) else f"{bag}: {text}") from error


def read_streams(
    reader: BagReader,
    arms: tuple[str, ...],
    frames: Mapping[str, np.ndarray],
    pictures: tuple[Topic, ...],
    findings: list[str] | None = None,
) -> dict[Topic, Stream]:
    """Streams of the topics that have messages; of pictures (number, height, width), of control nodes the number.

    Frames are taken as physics_node does; what is in the view of the camera is where the camera was at its time. What is large is only
    numbered here, in the order of the bag, and read again when it is wanted.

    Args:
        reader: Of the bag.
        arms: Whose tools are read.
        frames: Poses of other frames [4, 4] in the world.
        pictures: Topics of these.
        findings: Where given, damaged messages between good ones are left out, and that is said here; else they raise.

    Raises:
        MessageError: If a message is damaged, or all of a topic are, or nothing tells where the camera was in whose view poses are.
    """
    decoders = {}
    known = {ECM_VIEW: np.eye(4), **frames}
    for arm in arms:
        for make in (messages.tool_pose, messages.tool_setpoint):
            decoders[make(arm)] = lambda m, topic, arm=arm: _placed_row(m, messages.decode_tip(m, known, arm, topic), frames)
        any_frame = {**known, "": np.eye(4)}  # without a name: that in which a commanded arm publishes its pose
        decoders[messages.tool_pose_command(arm)] = lambda m, topic, any_frame=any_frame: _placed_row(
            m, messages.decode_pose(m, any_frame, topic), frames
        )
        for make in (messages.tool_jaw, messages.tool_jaw_state, messages.tool_jaw_setpoint):
            decoders[make(arm)] = lambda m, topic: [messages.decode_jaw(m, topic)]
        for make in (messages.tool_wrench, messages.tool_reaction):
            decoders[make(arm)] = lambda m, topic, arm=arm: wrench_row(m, topic, arm, frames)
        decoders[messages.tool_joints(arm)] = _joint_row
        decoders[messages.tool_cut(arm)] = lambda m, topic: [messages.decode_pedal(m, topic)]
    decoders[messages.JOINT_STATES] = lambda m, topic: _joint_states_row(m, arms)
    decoders[messages.TASK_OUTCOME] = messages.decode_outcome
    decoders[messages.RENDERED_POSE] = lambda m, topic: pose_row(messages.decode_pose(m, frames, topic))
    fallbacks = {make(arm) for arm in arms for make in (messages.tool_setpoint, messages.tool_jaw_setpoint)}  # do without what is damaged
    rows: dict[Topic, list] = defaultdict(list)
    damaged: dict[Topic, list[MessageError]] = defaultdict(list)
    numbers, sizes = dict.fromkeys((*pictures, messages.CONTROL_NODES), -1), dict[Topic, tuple[int, ...]]()
    for topic, _, message in reader.messages((*numbers, *decoders)):
        if topic in numbers:
            numbers[topic] += 1
            if topic in pictures and topic not in sizes:  # that of the others is compared when they are read
                raw = hasattr(message, "encoding")
                sizes[topic] = (message.height, message.width) if raw else messages.decode_image(message, topic.name).shape[:2]
            row = [numbers[topic], *sizes.get(topic, ())]
        else:
            try:
                row = decoders[topic](message, topic.name)
            except MessageError as error:
                if topic in fallbacks:
                    continue
                if findings is None:
                    raise
                damaged[topic].append(error)
                continue
        if stamp := stamp_to_ns(message.header.stamp):  # zero marks an invalid message
            rows[topic].append((stamp, row))
    for topic, errors in damaged.items():
        if findings is None or not rows[topic]:
            raise errors[0]
        several = f"{len(errors)} messages are" if len(errors) > 1 else "a message is"
        findings.append(f"{several} left out: {errors[0]}")
    reactions = {stamp for arm in arms for stamp, _ in rows[messages.tool_reaction(arm)]}
    streams = {}
    for topic, pairs in rows.items():
        if not pairs:
            continue
        if topic in numbers:
            pairs = _one_run(topic, pairs, reactions)
        pairs.sort(key=lambda pair: pair[0])
        if topic in numbers:  # they are read in the order of the bag: what came late is left out
            highest = np.maximum.accumulate([row[0] for _, row in pairs])
            pairs = [pair for pair, number in zip(pairs, highest) if pair[1][0] == number]
        streams[topic] = Stream(np.array([s for s, _ in pairs], np.int64), np.array([row for _, row in pairs], np.float64))
    states = streams.pop(messages.JOINT_STATES, None)
    for arm, columns in zip(arms, np.split(states.values, len(arms), axis=1) if states else ()):
        known_rows = np.isfinite(columns).all(1)
        if messages.tool_joints(arm) not in streams and known_rows.any():  # only an arm without a robot publishes its own
            streams[messages.tool_joints(arm)] = Stream(states.stamps[known_rows], columns[known_rows])
    view = None
    for arm in arms:
        inside = [_IN_VIEW]
        for topic in (messages.tool_setpoint(arm), messages.tool_pose(arm), messages.tool_pose_command(arm)):
            if topic not in streams:
                continue
            if _IN_VIEW in streams[topic].values[:, 7]:
                view = view or _view(reader, frames)
                inside += [_NAMELESS] if topic == messages.tool_pose(arm) else []
            streams[topic] = _out_of(view, streams[topic], inside)
        tip = streams.get(messages.tool_pose(arm))
        for topic in (messages.tool_wrench(arm), messages.tool_reaction(arm)):
            if tip is not None and topic in streams:
                streams[topic] = to_world(streams[topic], tip)
    return streams


def _view(reader: BagReader, frames: Mapping[str, np.ndarray]) -> Stream:
    """Poses [N, 7] in the world of the view of the camera."""
    topic, rows = messages.CAMERA_POSE, []
    for _, _, message in reader.messages((topic,)):
        pose = messages.decode_tip(message, frames, "ECM", topic.name) @ VIEW_IN_CAMERA
        if stamp := stamp_to_ns(message.header.stamp):
            rows.append((stamp, pose_row(pose)))
    if not rows:
        raise MessageError(
            f"poses are in {ECM_VIEW}, which moves with the camera, and no {topic.name} says where that was; record it, too, or record "
            "with cartesian_frame: world"
        )
    rows.sort(key=lambda row: row[0])
    return Stream(np.array([stamp for stamp, _ in rows], np.int64), np.array([row for _, row in rows]))


def _out_of(view: Stream | None, poses: Stream, inside: list[int]) -> Stream:
    """Poses [N, 7] in the world of ones [N, 8], which are in the view where the last column is one of ``inside``."""
    chosen, values = np.isin(poses.values[:, 7], inside), poses.values[:, :7].copy()
    if view is not None and chosen.any():
        held = view.at(poses.stamps[chosen])
        turn = Rotation.from_quat(held[:, 3:])
        values[chosen, :3] = held[:, :3] + turn.apply(values[chosen, :3])
        values[chosen, 3:] = (turn * Rotation.from_quat(values[chosen, 3:])).as_quat()
    return Stream(poses.stamps, values)


def _one_run(topic: Topic, pairs: list, reactions: set[int]) -> list:
    """The observations (stamp, row) of the only run of a simulation. Lone ones, as after a reset, may lie about it in time.

    Raises:
        MessageError: If there are several runs.
    """
    stamps = np.array([stamp for stamp, _ in pairs])
    runs = np.split(np.arange(len(pairs)), np.flatnonzero(np.diff(stamps) < -_JUMP) + 1)
    if len(runs) == 1:
        return pairs
    runs = [run for run in runs if len(reactions.intersection(stamps[run].tolist())) > 1]
    if len(runs) > 1:
        raise MessageError(f"/{topic.name}: time goes back, as after a reset; record each episode into a bag of its own")
    return [pairs[index] for run in runs for index in run]


def pose_row(pose: np.ndarray) -> np.ndarray:
    """Position and quaternion xyzw, [7]."""
    w, *xyz = matrix_to_quat(pose[:3, :3])
    return np.array([*pose[:3, 3], *xyz, w])


def _placed_row(message: Any, pose: np.ndarray, frames: Mapping[str, np.ndarray]) -> np.ndarray:
    """Position and quaternion xyzw, and the frame that they are in, [8]."""
    frame = message.header.frame_id.lstrip("/")
    return np.array([*pose_row(pose), _NAMELESS if not frame else _IN_WORLD if frame in frames else _IN_VIEW])


def _joint_row(message: Any, topic: str) -> np.ndarray:
    """Joint positions [6], rad and m."""
    joints = messages.decode_joints(message, topic)
    if len(joints) != len(JOINTS):
        raise MessageError(f"{topic}: {len(joints)} positions; an arm with an instrument has {len(JOINTS)}")
    return joints


def _joint_states_row(message: Any, arms: tuple[str, ...]) -> list[float]:
    """Joint positions [6·A], rad and m, of arms in `joint_states`; NaN of what it does not tell."""
    told = dict(zip(message.name, message.position))
    return [told.get(messages.joint_state_name(arm, joint), np.nan) for arm in arms for joint in JOINTS]


def wrench_row(message: Any, topic: str, arm: str, frames: Mapping[str, np.ndarray]) -> np.ndarray:
    """Force and torque in world axes and 1 or, in those of the tip, and 0, [7]."""
    frame = messages.check_frame(message, (arm, "", *frames), topic)
    R = frames.get(frame, np.eye(4))[:3, :3]  # any other is the tool's own
    return np.array([*(vector for part in messages.decode_wrench(message, topic) for vector in R @ part), frame in frames])


def to_world(wrenches: Stream, tips: Stream) -> Stream:
    """Wrenches [N, 6] in world axes of ones [N, 7] whose last column says whether they are so already, else in the tip's."""
    x, y, z, w = tips.at(wrenches.stamps)[:, 3:].T[:, :, None]
    axis = np.hstack([x, y, z])
    rotate = lambda v: v + 2 * np.cross(axis, np.cross(axis, v) + w * v)
    vectors = wrenches.values[:, :6]
    turned = np.hstack([rotate(vectors[:, :3]), rotate(vectors[:, 3:])])
    return Stream(wrenches.stamps, np.where(wrenches.values[:, 6:] > 0, vectors, turned))


def same_sign(poses: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Poses [T, 7] whose quaternions have the sign that is nearer to the reference's."""
    sign = np.where((poses[:, 3:] * reference[:, 3:]).sum(1, keepdims=True) < 0, -1, 1)
    return np.hstack([poses[:, :3], poses[:, 3:] * sign])


def continuous(poses: np.ndarray) -> np.ndarray:
    """Poses [T, 7] whose quaternions do not change their sign from row to row."""
    flips = (poses[1:, 3:] * poses[:-1, 3:]).sum(1) < 0
    sign = np.cumprod(np.concatenate([[1], np.where(flips, -1, 1)]))[:, None]
    return np.hstack([poses[:, :3], poses[:, 3:] * sign])
