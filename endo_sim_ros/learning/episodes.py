"""A recording as an episode: what was observed and what was done about it, one row per time step.

Rows are either the last messages at a fixed rate, or the steps of a simulation in lockstep, whose messages bear equal stamps.
Times are those of the headers, not of their arrival. **The action of a row is what leads to the next row**: with it,
(observation k, action k) → observation k + 1 in both kinds of rows. In lockstep it thus bears the stamp of the next row;
the state before the first command is a row where a reaction was published with it.

Per arm, in world axes, metres, newtons, newton metres, radians:

==================  ==========================================================================================
state               pose of the tip (x y z qx qy qz qw), jaw, reaction (force x y z, torque x y z) on the tool
environment_state   of all control nodes: mean displacement x y z, largest displacement; then per arm, over the
                    `NEAREST` nodes nearest to its tip: mean offset from the tip x y z, mean displacement x y z
action              commanded pose of the tip (x y z qx qy qz qw), jaw, wrench (force x y z, torque x y z) on the tissue
==================  ==========================================================================================
"""

import functools
import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import matrix_to_quat, parse_frames
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.messages import ControlNodeCloud, MessageError, Topic, stamp_to_ns
from endo_sim_ros.sequences.bag import WORLD_FRAME, BagReader

NEAREST = 8  # control nodes around a tip; averages over them do not jump when one takes another's place
JAW_OPEN = 1.0  # rad, where no jaw was ever commanded; nothing is held then
DEFAULT_FPS = 25
_JUMP = 500_000_000  # ns; messages that are merely late step back by less
_EVEN = 10_000  # ns; within it the steps of a policy are even, and those of a clock in real time are not

_POSE, _XYZ = ("x", "y", "z", "qx", "qy", "qz", "qw"), ("x", "y", "z")
_WRENCH = tuple(f"{kind}_{axis}" for kind in ("force", "torque") for axis in _XYZ)

Sampling = Literal["auto", "rate", "lockstep"]


def state_names(arms: tuple[str, ...]) -> list[str]:
    """Names of the columns of `Episode.state`."""
    return [f"{arm}.{name}" for arm in arms for name in (*_POSE, "jaw", *(f"reaction_{part}" for part in _WRENCH))]


def action_names(arms: tuple[str, ...]) -> list[str]:
    """Names of the columns of `Episode.action`."""
    return [f"{arm}.{name}" for arm in arms for name in (*_POSE, "jaw", *_WRENCH)]


def environment_names(arms: tuple[str, ...]) -> list[str]:
    """Names of the columns of `Episode.environment_state`."""
    near = (f"{arm}.near_{what}_{axis}" for arm in arms for what in ("offset", "displacement") for axis in _XYZ)
    return [*(f"mean_displacement_{axis}" for axis in _XYZ), "max_displacement", *near]


@dataclass(frozen=True)
class Episode:
    """One recording with T time steps and A arms; see the top of this file."""

    bag: Path
    arms: tuple[str, ...]
    fps: int  # rows per second
    lockstep: bool
    state: np.ndarray  # [T, 14·A] float32
    environment_state: np.ndarray  # [T, 4 + 6·A] float32
    action: np.ndarray  # [T, 14·A] float32
    image_size: tuple[int, int]  # height, width
    image_numbers: np.ndarray  # [T] which of the bag's rendered images is shown
    image_topic: Topic = messages.RENDERED_IMAGE  # or that of compressed images

    def __len__(self) -> int:
        return len(self.state)

    def images(self) -> Iterator[np.ndarray]:
        """The T rendered images, RGB [H, W, 3] uint8.

        Raises:
            SequenceError: If one cannot be used or has another size than the first.
        """
        topic = self.image_topic
        for message in _picked(self.bag, topic, self.image_numbers):
            image = _usable(self.bag, lambda message=message: messages.decode_image(message, topic.name))
            if image.shape[:2] != self.image_size:
                (h, w), (height, width) = image.shape[:2], self.image_size
                raise SequenceError(f"{self.bag}: rendered images change from {width}×{height} to {w}×{h}; record them apart")
            yield image


def read_episode(
    bag: str | Path,
    fps: int | None = None,
    arms: tuple[str, ...] = (),
    sampling: Sampling = "auto",
    world_frame: str = WORLD_FRAME,
    frames: tuple[str, ...] = (),
) -> Episode:
    """Sample a recording.

    Args:
        bag: Recording with rendered images, control nodes, and the pose of and reaction on each tool.
        fps: Rows per second; default: those of the steps of a recording in lockstep, else `DEFAULT_FPS`.
        arms: Names of the tool arms; default: all in the recording.
        sampling: ``rate``, ``lockstep``, or ``auto``: lockstep where that is what was recorded, unless another fps is given.
        world_frame: Frame of the recorded poses.
        frames: Other frames in which they may be, each the name and the pose in the world: ``PSM1_base x y z qx qy qz qw``.

    Raises:
        SequenceError: If the recording is damaged, empty or too short, or lacks a topic; the sentence names it.
        ValueError: If one of the frames is not a name and a pose.
    """
    bag, known = Path(bag), parse_frames(world_frame, frames)
    if fps is not None and fps <= 0:
        raise SequenceError(f"fps must be positive, got {fps}")
    with BagReader(bag) as reader:
        if not reader.message_count:
            raise SequenceError(f"{bag}: the recording is empty; was the graph running?")
        arms = arms or _arms(reader.topics)
        pictures = _image_topic(reader.topics)
        reader.require(*((topic,) for topic in _needed(arms, pictures)))
        streams = _usable(bag, lambda: _streams(reader, arms, known, pictures))
    for topic in _needed(arms, pictures):
        if topic not in streams:
            raise SequenceError(f"{bag}: no message with a time on /{topic.name}; record while the graph runs")
    times, rate = _frame_times(bag, streams, arms, fps, sampling, pictures)
    now, following = times[:-1], times[1:]
    nodes = streams[messages.CONTROL_NODES].at(now)[:, 0].astype(int)
    tips, state, action = [], [], []
    for arm in arms:
        tip = streams[messages.tool_pose(arm)]
        jaw_state = streams.get(messages.tool_jaw_state(arm), _Stream.constant([JAW_OPEN]))
        jaw_command = streams.get(messages.tool_jaw(arm), jaw_state)
        jaw = streams.get(messages.tool_jaw_state(arm), jaw_command)
        pose = _continuous(tip.at(times))
        command = streams.get(messages.tool_pose_command(arm), tip).at(times, before=tip)
        command = _same_sign(command, pose)
        wrench = streams.get(messages.tool_wrench(arm), _Stream.constant(np.zeros(6)))
        reaction = streams[messages.tool_reaction(arm)]
        state += [pose[:-1], jaw.at(now, before=_Stream.constant([JAW_OPEN])), reaction.at(now)]
        action += [
            command[1:],
            jaw_command.at(following, before=_Stream.constant([JAW_OPEN])),
            wrench.at(following, before=_Stream.constant(np.zeros(6))),
        ]
        tips.append(pose[:-1, :3])
    summaries = [
        summarize_tissue(_usable(bag, lambda message=message: messages.decode_control_nodes(message)), tip)
        for message, tip in zip(_picked(bag, messages.CONTROL_NODES, nodes), np.stack(tips, 1), strict=True)
    ]
    numbers = streams[pictures].at(now).astype(int)
    height, width = numbers[0, 1:]
    return Episode(
        bag,
        arms,
        rate.fps,
        rate.lockstep,
        np.hstack(state).astype(np.float32),
        np.array(summaries, np.float32),
        np.hstack(action).astype(np.float32),
        (int(height), int(width)),
        numbers[:, 0],
        pictures,
    )


def summarize_tissue(nodes: ControlNodeCloud, tips: np.ndarray) -> np.ndarray:
    """The row of `Episode.environment_state`, [4 + 6·A], of control nodes and the tips [A, 3] (m, world)."""
    displacement = nodes.positions - nodes.rest
    near = KDTree(nodes.positions).query(tips, min(NEAREST, len(displacement)))[1].reshape(len(tips), -1)
    parts = [displacement.mean(0), [np.linalg.norm(displacement, axis=1).max()]]
    for tip, indices in zip(tips, near):
        parts += [(nodes.positions[indices] - tip).mean(0), displacement[indices].mean(0)]
    return np.concatenate(parts)


# ---------------------------------------------------------------------------------------------------------------- topics


def _arms(present: dict[str, str]) -> tuple[str, ...]:
    """Arms whose pose and reaction were recorded."""
    ends = [f"/{make('').name.lstrip('/')}" for make in (messages.tool_pose, messages.tool_reaction)]
    found = [{name[1 : -len(end)] for name in present if name.endswith(end)} for end in ends]
    return tuple(sorted(found[0] & found[1])) or ("PSM1",)


def _image_topic(present: dict[str, str]) -> Topic:
    """The topic of the rendered images: raw ones, where they were recorded, are exact."""
    raw, compressed = messages.RENDERED_IMAGE, messages.RENDERED_COMPRESSED
    return compressed if f"/{compressed.name}" in present and f"/{raw.name}" not in present else raw


def _observed(arms: tuple[str, ...], pictures: Topic) -> list[Topic]:
    """What the simulation says in each step."""
    return [pictures, messages.CONTROL_NODES, *map(messages.tool_reaction, arms)]


def _needed(arms: tuple[str, ...], pictures: Topic) -> list[Topic]:
    return [*_observed(arms, pictures), *map(messages.tool_pose, arms)]


def _commands(arm: str) -> list[Topic]:
    return [make(arm) for make in (messages.tool_pose_command, messages.tool_pose, messages.tool_wrench, messages.tool_jaw)]


# --------------------------------------------------------------------------------------------------------------- streams


class _Stream(NamedTuple):
    """The messages of a topic by the time in their headers."""

    stamps: np.ndarray  # [N] int64, ns, not decreasing
    values: np.ndarray  # [N, D]

    @classmethod
    def constant(cls, value: Any) -> "_Stream":
        return cls(np.array([np.iinfo(np.int64).min]), np.array([value], np.float64))

    def at(self, times: np.ndarray, before: "_Stream | None" = None) -> np.ndarray:
        """The last values [T, D] at times [T]; ahead of the first, those of another stream."""
        indices = np.searchsorted(self.stamps, times, "right") - 1
        values = self.values[np.maximum(indices, 0)]
        return values if before is None else np.where((indices >= 0)[:, None], values, before.at(times))


def _streams(reader: BagReader, arms: tuple[str, ...], frames: Mapping[str, np.ndarray], pictures: Topic) -> dict[Topic, _Stream]:
    """Streams of the topics that have messages; of images (number, height, width), of control nodes the number.

    Frames are taken as physics_node does. What is large is only numbered here, in the order of the bag, and read again when it is wanted.
    """
    decoders = {}
    for arm in arms:
        decoders[messages.tool_pose(arm)] = lambda m, topic, arm=arm: _pose_row(messages.decode_tip(m, frames, arm, topic))
        in_world = {**frames, "": np.eye(4)}  # as a commanded arm publishes its pose
        decoders[messages.tool_pose_command(arm)] = lambda m, topic, known=in_world: _pose_row(messages.decode_pose(m, known, topic))
        for make in (messages.tool_jaw, messages.tool_jaw_state):
            decoders[make(arm)] = lambda m, topic: [messages.decode_jaw(m, topic)]
        for make in (messages.tool_wrench, messages.tool_reaction):
            decoders[make(arm)] = lambda m, topic, arm=arm: _wrench_row(m, topic, arm, frames)
    rows: dict[Topic, list] = defaultdict(list)
    numbers, size = {pictures: -1, messages.CONTROL_NODES: -1}, ()
    for topic, _, message in reader.messages((*numbers, *decoders)):
        if topic in numbers:
            numbers[topic] += 1
            if topic == pictures and not size:  # that of the others is compared when they are read
                raw = topic == messages.RENDERED_IMAGE
                size = (message.height, message.width) if raw else messages.decode_image(message, topic.name).shape[:2]
            row = [numbers[topic], *(size if topic == pictures else ())]
        else:
            row = decoders[topic](message, topic.name)
        if stamp := stamp_to_ns(message.header.stamp):  # zero marks an invalid message
            rows[topic].append((stamp, row))
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
        streams[topic] = _Stream(np.array([s for s, _ in pairs], np.int64), np.array([row for _, row in pairs], np.float64))
    for arm in arms:
        tip = streams.get(messages.tool_pose(arm))
        for topic in (messages.tool_wrench(arm), messages.tool_reaction(arm)):
            if tip is not None and topic in streams:
                streams[topic] = _to_world(streams[topic], tip)
    return streams


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


def _pose_row(pose: np.ndarray) -> np.ndarray:
    """Position and quaternion xyzw, [7]."""
    w, *xyz = matrix_to_quat(pose[:3, :3])
    return np.array([*pose[:3, 3], *xyz, w])


def _wrench_row(message: Any, topic: str, arm: str, frames: Mapping[str, np.ndarray]) -> np.ndarray:
    """Force and torque in world axes and 1 or, in those of the tip, and 0, [7]."""
    frame = messages.check_frame(message, (arm, "", *frames), topic)
    R = frames.get(frame, np.eye(4))[:3, :3]  # any other is the tool's own
    return np.array([*(vector for part in messages.decode_wrench(message, topic) for vector in R @ part), frame in frames])


def _to_world(wrenches: _Stream, tips: _Stream) -> _Stream:
    """Wrenches [N, 6] in world axes of ones [N, 7] whose last column says whether they are so already, else in the tip's."""
    x, y, z, w = tips.at(wrenches.stamps)[:, 3:].T[:, :, None]
    axis = np.hstack([x, y, z])
    rotate = lambda v: v + 2 * np.cross(axis, np.cross(axis, v) + w * v)
    vectors = wrenches.values[:, :6]
    turned = np.hstack([rotate(vectors[:, :3]), rotate(vectors[:, 3:])])
    return _Stream(wrenches.stamps, np.where(wrenches.values[:, 6:] > 0, vectors, turned))


def _same_sign(poses: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Poses [T, 7] whose quaternions have the sign that is nearer to the reference's."""
    sign = np.where((poses[:, 3:] * reference[:, 3:]).sum(1, keepdims=True) < 0, -1, 1)
    return np.hstack([poses[:, :3], poses[:, 3:] * sign])


def _continuous(poses: np.ndarray) -> np.ndarray:
    """Poses [T, 7] whose quaternions do not change their sign from row to row."""
    flips = (poses[1:, 3:] * poses[:-1, 3:]).sum(1) < 0
    sign = np.cumprod(np.concatenate([[1], np.where(flips, -1, 1)]))[:, None]
    return np.hstack([poses[:, :3], poses[:, 3:] * sign])


# ----------------------------------------------------------------------------------------------------------------- times


class _Rate(NamedTuple):
    fps: int
    lockstep: bool


def _frame_times(
    bag: Path, streams: dict[Topic, _Stream], arms: tuple[str, ...], fps: int | None, sampling: Sampling, pictures: Topic
) -> tuple[np.ndarray, _Rate]:
    """Times [T + 1] (ns) of the rows and of what follows the last one."""
    if sampling != "rate":
        steps = _steps(streams, arms, pictures)
        if sampling == "auto" and len(steps) > 1 and not _even(steps):
            text = "%s: stamps that commands share with images are not even, as in real time; it is sampled at a rate"
            logging.getLogger(__name__).info(text, bag)
        elif len(steps) > 1:
            hertz = 1e9 / np.median(np.diff(steps))
            whole = max(round(hertz), 1)
            if fps in (None, whole):
                if abs(hertz / whole - 1) > 0.01:
                    raise SequenceError(
                        f"{bag}: steps of {1e3 / hertz:.4g} ms make no whole number of frames per second; sample at a rate instead"
                    )
                gaps = np.diff(steps)[1:]  # how long before the first command the first observation was made means nothing
                if missing := int((np.maximum(np.round(gaps * hertz * 1e-9), 1) - 1).sum()):
                    logging.getLogger(__name__).warning("%s: %d of %d steps are missing", bag, missing, missing + len(steps))
                return steps, _Rate(whole, True)
            if sampling == "lockstep":
                raise SequenceError(f"{bag}: its steps are {whole} per second, not {fps}; leave fps out or sample at a rate")
        elif sampling == "lockstep":
            raise SequenceError(f"{bag}: images, state and commands share no stamps; sample at a rate instead")
    fps = fps or DEFAULT_FPS
    needed = [streams[topic].stamps for topic in _needed(arms, pictures)]
    begin, end = max(stamps[0] for stamps in needed), min(stamps[-1] for stamps in needed)
    count = int((end - begin) * fps * 1e-9) + 1
    if count < 2:
        raise SequenceError(f"{bag}: images, control nodes, poses and reactions have less than {1 / fps:g} s in common; record longer")
    return begin + np.round(np.arange(count) * (1e9 / fps)).astype(np.int64), _Rate(fps, False)


def _even(steps: np.ndarray) -> bool:
    """Whether these stamps are a policy's. In real time too commands may bear the stamps of observations: an arm without a
    robot says where it is in each step, and policies answer with the stamp of what they saw."""
    gaps = np.diff(steps)[1:]  # the first observation may be of any time
    period = np.median(np.diff(steps))
    return bool((np.abs(gaps - period * np.round(gaps / period)) < _EVEN).all())


def _steps(streams: dict[Topic, _Stream], arms: tuple[str, ...], pictures: Topic) -> np.ndarray:
    """Stamps that all observations bear, and a command of each arm; of the first, which nothing led to, no command."""
    stamps = functools.reduce(np.intersect1d, (streams[topic].stamps for topic in _observed(arms, pictures)))
    commanded = stamps
    for arm in arms:
        given = [streams[topic].stamps for topic in _commands(arm) if topic in streams]
        commanded = np.intersect1d(commanded, np.concatenate(given))
    first = np.searchsorted(stamps, commanded[0]) if len(commanded) else 0
    return np.concatenate([stamps[max(first - 1, 0) : first], commanded])


# --------------------------------------------------------------------------------------------------------------- reading


def _picked(bag: Path, topic: Topic, numbers: np.ndarray) -> Iterator[Any]:
    """Messages of a topic by their numbers [T] in the bag, which do not decrease."""
    with BagReader(bag) as reader:
        numbered = enumerate(message for _, _, message in reader.messages([topic]))
        current, message = -1, None
        for number in numbers:
            while current < number:
                current, message = next(numbered)
            yield message


def _usable(bag: Path, decode: Any) -> Any:
    """What a decoder returns; what is wrong with a message is told with the name of its bag."""
    try:
        return decode()
    except MessageError as error:
        raise SequenceError(f"{bag}: {error}") from error
