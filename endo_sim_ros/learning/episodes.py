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
                    (pose and jaw of servo commands; where none came for half a second, or yet, of setpoints; else as measured)
joints              yaw, pitch, insertion (m), roll, wrist_pitch, wrist_yaw, where those of all arms were recorded
cut                 whether the edge is commanded to cut, 0 or 1, where that of any arm was recorded
==================  ==========================================================================================

Beside these, where they were recorded: the pose of the camera (x y z qx qy qz qw), the right eye, what is in each pixel, and of a task
what its steps led to.
"""

import contextlib
import functools
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import parse_frames
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.instruments import JOINTS
from endo_sim_ros.learning.actions import POSE_NAMES
from endo_sim_ros.learning.streams import Stream, continuous, read_streams, same_sign, telling_bag
from endo_sim_ros.messages import ControlNodeCloud, MessageError, Topic
from endo_sim_ros.sequences.bag import WORLD_FRAME, BagReader

NEAREST = 8  # control nodes around a tip; averages over them do not jump when one takes another's place
JAW_OPEN = 1.0  # rad, where no jaw was ever commanded; nothing is held then
DEFAULT_FPS = 25
_IN_FORCE = 500_000_000  # ns that a servo command counts where setpoints are recorded: clients send the next one within a tenth of that
_EVEN = 10_000  # ns; within it the steps of a policy are even, and those of a clock in real time are not

_XYZ = "x", "y", "z"
_WRENCH = tuple(f"{kind}_{axis}" for kind in ("force", "torque") for axis in _XYZ)

_FORMS = (  # of images, raw and compressed
    (messages.RENDERED_IMAGE, messages.RENDERED_COMPRESSED),
    (messages.RENDERED_RIGHT_IMAGE, messages.RENDERED_RIGHT_COMPRESSED),
)
_PICTURES = dict(zip([*_FORMS[0], *_FORMS[1], messages.RENDERED_SEGMENTATION], ["left", "left", "right", "right", "segmentation"]))

Sampling = Literal["auto", "rate", "lockstep"]


def state_names(arms: tuple[str, ...]) -> list[str]:
    """Names of the columns of `Episode.state`."""
    return [f"{arm}.{name}" for arm in arms for name in (*POSE_NAMES, "jaw", *(f"reaction_{part}" for part in _WRENCH))]


def action_names(arms: tuple[str, ...]) -> list[str]:
    """Names of the columns of `Episode.action`."""
    return [f"{arm}.{name}" for arm in arms for name in (*POSE_NAMES, "jaw", *_WRENCH)]


def environment_names(arms: tuple[str, ...]) -> list[str]:
    """Names of the columns of `Episode.environment_state`."""
    near = (f"{arm}.near_{what}_{axis}" for arm in arms for what in ("offset", "displacement") for axis in _XYZ)
    return [*(f"mean_displacement_{axis}" for axis in _XYZ), "max_displacement", *near]


def cut_names(arms: tuple[str, ...]) -> list[str]:
    """Names of the columns of `Episode.cut`, which are part of what is done, as `action` is."""
    return [f"{arm}.cut" for arm in arms]


def joint_names(arms: tuple[str, ...]) -> list[str]:
    """Names of the columns of `Episode.joints`."""
    return [f"{arm}.{name}" for arm in arms for name in JOINTS]


@dataclass(frozen=True)
class Shown:
    """The pictures of one topic, a row each.

    Args:
        topic: Where they were recorded.
        size: Height and width, pixels.
        numbers: Which of the messages of the topic each row [T] shows.
    """

    topic: Topic
    size: tuple[int, int]
    numbers: np.ndarray


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
    left: Shown  # rendered images
    right: Shown | None = None  # those of the right eye
    segmentation: Shown | None = None  # what is in each pixel
    joints: np.ndarray | None = None  # [T, 6·A] float32
    cut: np.ndarray | None = None  # [T, A] float32
    camera_pose: np.ndarray | None = None  # [T, 7] float32, world
    outcome: np.ndarray | None = None  # [T, 7] as `messages.OUTCOME` has them: what the action of each row led to

    def __len__(self) -> int:
        return len(self.state)

    @property
    def content(self) -> tuple[str, ...]:
        """What there is beside what all episodes have."""
        return tuple(
            name for name in ("right", "segmentation", "joints", "cut", "camera_pose", "outcome") if getattr(self, name) is not None
        )

    def images(self, shown: Shown | None = None) -> Iterator[np.ndarray]:
        """The T rendered images, RGB [H, W, 3] uint8, or other pictures of the episode; labels are [H, W].

        Raises:
            SequenceError: If one cannot be used or has another size than the first.
        """
        shown = shown or self.left
        decode = messages.decode_labels if shown is self.segmentation else messages.decode_image
        for message in _picked(self.bag, shown.topic, shown.numbers):
            image = telling_bag(self.bag, lambda message=message: decode(message, shown.topic.name))
            if image.shape[:2] != self.left.size:
                (h, w), (height, width) = image.shape[:2], self.left.size
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
        pictures = _picture_topics(reader.topics)
        reader.require(*((topic,) for topic in _needed(arms, pictures[:1])))
        streams = telling_bag(bag, lambda: read_streams(reader, arms, known, pictures))
    pictures = tuple(topic for topic in pictures if topic == pictures[0] or topic in streams)
    for topic in _needed(arms, pictures):
        if topic not in streams:
            raise SequenceError(f"{bag}: no message with a time on /{topic.name}; record while the graph runs")
    times, rate = _frame_times(bag, streams, arms, fps, sampling, pictures)
    now, following = times[:-1], times[1:]
    nodes = streams[messages.CONTROL_NODES].at(now)[:, 0].astype(int)
    tips, state, action = [], [], []
    for arm in arms:
        pose, opened = continuous(streams[messages.tool_pose(arm)].at(times)), Stream.constant([JAW_OPEN])
        jaw = streams.get(messages.tool_jaw_state(arm)) or streams.get(messages.tool_jaw(arm)) or opened
        told = [streams.get(topic(arm)) for topic in (messages.tool_setpoint, messages.tool_pose_command)]
        jaw_told = [streams.get(topic(arm)) for topic in (messages.tool_jaw_setpoint, messages.tool_jaw)]
        command, was_told = _told(following, pose[1:], *told)
        if measured := int((~was_told).sum()):
            text = "%s: %d of %d actions of %s are where the tip was measured next, as nothing was recorded yet on /%s or /%s"
            names = [topic(arm).name for topic in (messages.tool_pose_command, messages.tool_setpoint)]
            logging.getLogger(__name__).warning(text, bag, measured, len(now), arm, *names)
        wrench = streams.get(messages.tool_wrench(arm), Stream.constant(np.zeros(6)))
        reaction = streams[messages.tool_reaction(arm)]
        state += [pose[:-1], jaw.at(now, before=opened), reaction.at(now)]
        action += [
            same_sign(command, pose[1:]),
            _told(following, jaw.at(following, before=opened), *jaw_told)[0],
            wrench.at(following, before=Stream.constant(np.zeros(6))),
        ]
        tips.append(pose[:-1, :3])
    summaries = [
        summarize_tissue(telling_bag(bag, lambda message=message: messages.decode_control_nodes(message)), tip)
        for message, tip in zip(_picked(bag, messages.CONTROL_NODES, nodes), np.stack(tips, 1), strict=True)
    ]
    found: dict[str, Any] = {}
    for topic in pictures:
        rows = streams[topic].at(now).astype(int)
        found[_PICTURES[topic]] = Shown(topic, (int(rows[0, 1]), int(rows[0, 2])), rows[:, 0])
    if all(messages.tool_joints(arm) in streams for arm in arms):
        found["joints"] = np.hstack([streams[messages.tool_joints(arm)].at(now) for arm in arms]).astype(np.float32)
    if any(messages.tool_cut(arm) in streams for arm in arms):
        idle = Stream.constant([0.0])
        cuts = [streams.get(messages.tool_cut(arm), idle).at(following, before=idle) for arm in arms]
        found["cut"] = np.hstack(cuts).astype(np.float32)
    if messages.RENDERED_POSE in streams:
        found["camera_pose"] = continuous(streams[messages.RENDERED_POSE].at(now)).astype(np.float32)
    if messages.TASK_OUTCOME in streams:
        found["outcome"] = streams[messages.TASK_OUTCOME].at(following)
    return Episode(
        bag,
        arms,
        rate.fps,
        rate.lockstep,
        np.hstack(state).astype(np.float32),
        np.array(summaries, np.float32),
        np.hstack(action).astype(np.float32),
        **found,
    )


def _told(times: np.ndarray, measured: np.ndarray, setpoints: Stream | None, commands: Stream | None) -> tuple[np.ndarray, np.ndarray]:
    """What an arm was told at times [T]: the newest servo command, or its setpoint where that is older than `_IN_FORCE`, so that a move has
    taken over; else what was measured [T, D]. Returns that [T, D], and whether it was told anything [T]."""
    values, known = measured.copy(), np.zeros(len(times), bool)
    for stream, longest in ((setpoints, np.inf), (commands, np.inf if setpoints is None else _IN_FORCE)):
        if stream is not None:
            last = np.searchsorted(stream.stamps, times, "right") - 1
            counts = (last >= 0) & ((times - stream.stamps[np.maximum(last, 0)] <= longest) | ~known)
            values[counts], known = stream.at(times)[counts], known | counts
    return values, known


def picture_size(bag: str | Path) -> tuple[int, int] | None:
    """Height and width of the first picture of the left eye in a recording, pixels; None if there is none that can be decoded."""
    with BagReader(bag) as reader:
        topic = _picture_topics(reader.topics)[0]
        for _, _, message in reader.messages([topic]):
            with contextlib.suppress(MessageError):
                return messages.decode_image(message, topic.name).shape[:2]
    return None


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
    """Arms whose pose and reaction were recorded, but for the camera's."""
    ends = [f"/{make('').name.lstrip('/')}" for make in (messages.tool_pose, messages.tool_reaction)]
    tools = present.keys() - {f"/{messages.CAMERA_POSE.name}"}
    found = [{name[1 : -len(end)] for name in tools if name.endswith(end)} for end in ends]
    return tuple(sorted(found[0] & found[1])) or ("PSM1",)


def _picture_topics(present: dict[str, str]) -> tuple[Topic, ...]:
    """The topics of the pictures: of the left eye, and of what else was recorded. Raw ones, where they were recorded, are exact."""
    recorded = lambda topic: f"/{topic.name}" in present
    found = []
    for raw, compressed in _FORMS:
        form = compressed if recorded(compressed) and not recorded(raw) else raw
        found += [form] if recorded(form) or raw == messages.RENDERED_IMAGE else []
    return (*found, *([messages.RENDERED_SEGMENTATION] if recorded(messages.RENDERED_SEGMENTATION) else []))


def _observed(arms: tuple[str, ...], pictures: tuple[Topic, ...]) -> list[Topic]:
    """What the simulation says in each step."""
    return [*pictures, messages.CONTROL_NODES, *map(messages.tool_reaction, arms)]


def _needed(arms: tuple[str, ...], pictures: tuple[Topic, ...]) -> list[Topic]:
    return [*_observed(arms, pictures), *map(messages.tool_pose, arms)]


def _commands(arm: str) -> list[Topic]:
    return [make(arm) for make in (messages.tool_pose_command, messages.tool_pose, messages.tool_wrench, messages.tool_jaw)]


# ----------------------------------------------------------------------------------------------------------------- times


class _Rate(NamedTuple):
    fps: int
    lockstep: bool


def _frame_times(
    bag: Path, streams: dict[Topic, Stream], arms: tuple[str, ...], fps: int | None, sampling: Sampling, pictures: tuple[Topic, ...]
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
                if late := int((_steps(streams, arms, ()) > steps[-1]).sum()):
                    text = "%s: the last %d of %d steps have no picture and are left out; record until the last one is rendered"
                    logging.getLogger(__name__).warning(text, bag, late, late + len(steps))
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


def _steps(streams: dict[Topic, Stream], arms: tuple[str, ...], pictures: tuple[Topic, ...]) -> np.ndarray:
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
