"""From a recording to experiments: what tools did to tissue, and what was measured of it."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import parse_frames
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.following import follow_points, looked_at, near_way
from endo_sim_ros.identification.force_checks import distance_at_onset
from endo_sim_ros.identification.gathering import Gathered, Tool, count_touches, gather, read_tools, told_thickness
from endo_sim_ros.identification.recording_config import RecordingConfig
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.identification.touches import experiment
from endo_sim_ros.learning.streams import read_streams, telling_bag
from endo_sim_ros.messages import MessageError, Topic
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.sequences.bag import BagReader, feed
from endo_sim_ros.sequences.synchronizer import Synchronizer

_SAME_PLACE = 0.25  # spacings between a recorded control node and one of the model's that are taken for one
_SAME_SCALE = 1.5  # times by which the recorded tissue may be larger or smaller than the model's: other options make it thicker
_ENOUGH = 0.1  # share of the control nodes of the skin that must be in the places of recorded ones
# What shows the tissue: camera_info, pose, image, raw or compressed, and mask; pictures that were rendered, else those of an endoscope.
_PICTURES = (
    (messages.RENDERED_INFO, messages.RENDERED_POSE, messages.RENDERED_IMAGE, messages.RENDERED_COMPRESSED, messages.RENDERED_SEGMENTATION),
    (messages.LEFT_INFO, messages.CAMERA_POSE, messages.LEFT_IMAGE, messages.LEFT_COMPRESSED, messages.MASK),
)
_WHOLE = 1  # label of tissue in rendered/segmentation/image
_KNOWN = 0.5  # share of the steps, below which poses are too rare
_BREATH = 2e-4  # m; less of it does not matter

OnProgress = Callable[[str], None]
"""Called with what is being done."""


@dataclass(frozen=True)
class Recorded:
    """What a recording tells.

    Args:
        experiments: Each begins with tissue at rest.
        findings: Sentences about what was found, and what is missing or looks wrong.
        seconds: Length of the recording of poses.
        touches: In the experiments.
        forces: Whether forces were measured.
        simulated: Whether the tissue was a simulation's, which has control nodes.
    """

    experiments: list[Experiment]
    findings: list[str]
    seconds: float
    touches: int
    forces: bool
    simulated: bool


def read_experiments(
    bag: str | Path,
    model: GaussianModel,
    nodes: ControlNodes,
    physics: PhysicsConfig,
    config: RecordingConfig = RecordingConfig(),
    on_progress: OnProgress = lambda text: None,
) -> Recorded:
    """Experiments in a recording of a simulation, or of a console: poses of tools, jaws, forces, and how the tissue moved.

    Args:
        bag: Recording with poses of tools.
        model: The tissue at rest, world.
        nodes: Its control nodes.
        physics: Of the model that is fitted.
        config: What is taken from the recording.
        on_progress: Called with what is being done.

    Raises:
        SequenceError: If the recording cannot be used: it is damaged, lacks poses, never shows a touch, or contradicts itself. The sentence
            says what was seen.
        ConfigError: If tools press, but are nothing that presses.
        ValueError: If one of the frames is not a name and a pose.
    """
    bag, frames = Path(bag), parse_frames(config.world_frame, config.frames)
    on_progress(f"reading {bag.name}")
    with BagReader(bag) as reader:
        topics = reader.topics
        arms = config.arms or _arms(topics)
        if not arms:
            reader.require((messages.tool_pose("PSM1"),))
        reader.require(*((messages.tool_pose(arm),) for arm in arms))
        pictures = _picture(topics)
        findings = list[str]()
        streams = telling_bag(bag, lambda: read_streams(reader, arms, frames, (), findings), "no message of a topic can be used: ")
        motion = _motion(reader)
    surface = Surface(nodes)
    tools = telling_bag(bag, lambda: read_tools(arms, streams, surface, nodes, physics, config, findings))
    if not tools:
        raise SequenceError(f"{bag}: no pose with a time on /{messages.tool_pose(arms[0]).name}; record while the tool moves")
    links = _links(topics, tools, physics)
    if not physics.contact_radius and not any(tool.line.closed.any() for tool in tools.values()):
        text = f"{bag}: contact_radius is 0, so that tools press nothing, and no jaw holds tissue; give the radius of the tip"
        raise ConfigError("; ".join([text, *links]))
    of_tools, gathered = list(findings), gather(tools, streams, physics, config, findings)
    if not gathered:
        raise SequenceError("; ".join([_no_touch(bag, tools, physics, config, findings), *links]))
    experiments = [experiment(tools[arm].line, span, physics.step_duration, tools[arm].noise, config) for arm, span in gathered]
    seconds = max(float(np.ptp(tool.line.times)) * 1e-9 for tool in tools.values())
    count = sum(count_touches(tools[arm].line, span, physics, config) for arm, span in gathered)
    length = sum(stop - start for _, (start, stop) in gathered) * physics.step_duration
    several = f"{count} touch{'es' * (count != 1)} in {len(experiments)} experiment{'s' * (len(experiments) != 1)} of {length:.1f} s in all"
    findings.insert(0, f"{seconds:.1f} s of {' and '.join(tools)}: {several}")
    measured = any(np.isfinite(each.forces[each.present]).any() for each in experiments)
    findings += told_thickness(surface, nodes, physics)
    findings += links
    if motion > _BREATH:
        findings.append(
            f"the tissue moves by itself, by up to {1e3 * motion:.1f} mm; that is not part of the model, give its motion as well"
        )
    if config.observed in ("auto", "control_nodes") and messages.CONTROL_NODES in streams:
        on_progress("reading control nodes")
        experiments = telling_bag(bag, lambda: _with_nodes(bag, experiments, gathered, tools, nodes, config, findings))
    elif config.observed in ("auto", "images") and pictures:
        on_progress("following points")
        experiments = _with_tracks(bag, experiments, gathered, tools, model, frames, pictures, config, findings)
    elif config.observed in ("images", "control_nodes"):
        raise SequenceError(f"{bag}: observed is {config.observed}, but there are none in the recording")
    elif not measured:
        raise SequenceError(
            f"{bag}: neither forces nor images with camera_info and pose, nor control nodes: nothing tells how the tissue answers"
            + "".join(f"; {text}" for text in of_tools)
        )
    return Recorded(experiments, findings, seconds, count, measured, messages.CONTROL_NODES in streams)


# ------------------------------------------------------------------------------------------------------------------ tools


def _arms(topics: Mapping[str, str]) -> tuple[str, ...]:
    """Arms with the pose of a tool, but for the camera's."""
    end, pose = f"/{messages.tool_pose('').name.lstrip('/')}", f"/{messages.CAMERA_POSE.name}"
    found = {name[1 : -len(end)] for name in topics if name.endswith(end) and name != pose}
    return tuple(sorted(name for name in found if not name.endswith(("/local", "local"))))


def _no_touch(bag: Path, tools: Mapping[str, Tool], physics: PhysicsConfig, config: RecordingConfig, findings: list[str]) -> str:
    """What to say of a recording without an experiment."""
    arm, tool = min(tools.items(), key=lambda pair: float(np.min(pair[1].line.gaps, initial=np.inf)))
    if tool.line.present.mean() < _KNOWN:
        return f"{bag}: poses of {arm} are more than longest_gap, {config.longest_gap:g} s, apart; record them at 25 Hz or more"
    if any(each.line.touching.any() for each in tools.values()):
        return f"{bag}: no experiment can be used: {'; '.join(findings)}"
    step = int(tool.line.gaps.argmin())
    at = (tool.line.times[step] - tool.line.times[0]) * 1e-9
    text = f"{bag}: the tool never touches the tissue: {arm} came nearest after {at:.1f} s, to {1e3 * tool.line.gaps[step]:.3g} mm"
    onset = distance_at_onset(tool.line, max(tool.noise, config.force_noise))
    if onset is not None:
        text += f", yet forces of up to {onset[1]:.2g} N were measured where it was {1e3 * onset[0]:.3g} mm away"
    return f"{text}; are model and recording of one scale (metres) and in one frame?"


def _links(topics: Mapping[str, str], tools: Mapping[str, Tool], physics: PhysicsConfig) -> list[str]:
    """What to say where the links of instruments may have touched: no topic tells."""
    arms = [arm for arm in tools if f"/{messages.tool_links(arm).name}" in topics and f"/{messages.tool_type(arm).name}" in topics]
    if not arms:
        return []
    what = f"a ball of {1e3 * physics.contact_radius:.1f} mm" if physics.contact_radius else "a jaw"
    return [
        f"{' and '.join(arms)}: the links of an instrument touched, too, unless link_contact of physics_node was false; here {what} at the"
        " tip is all that touches, and what is found may come from the links, be it a relaxation: record with link_contact:=false"
    ]


# ----------------------------------------------------------------------------------------------------------------- motion


def _motion(reader: BagReader) -> float:
    """How far breath and heart move held tissue in the recording, m."""
    most = 0.0
    for topic, _, message in reader.messages([messages.TISSUE_MOTION]):
        most = max(most, float(np.abs(np.asarray(message.position, np.float64)[: len(messages.MOTIONS)]).max(initial=0.0)))
    return most


def _with_nodes(
    bag: Path,
    experiments: list[Experiment],
    gathered: Gathered,
    tools: Mapping[str, Tool],
    nodes: ControlNodes,
    config: RecordingConfig,
    findings: list[str],
) -> list[Experiment]:
    """The experiments with how control nodes of the skin moved, where these were recorded."""
    rest, chosen, found = None, list[np.ndarray](), list[np.ndarray]()
    theirs = np.zeros(len(nodes), int)
    half = round(experiments[0].step_duration * 0.5e9)
    times = [tools[arm].line.times[slice(*span)] for arm, span in gathered]
    wanted = [looked_at(each, config) for each in times]
    with BagReader(bag) as reader:
        for _, _, message in reader.messages([messages.CONTROL_NODES]):
            stamp = messages.stamp_to_ns(message.header.stamp)
            steps = {
                number: int(np.abs(each - stamp).argmin())
                for number, each in enumerate(times)
                if each[0] - half <= stamp <= each[-1] + half
            }
            steps = {number: step for number, step in steps.items() if wanted[number][step]}
            if rest is not None and not steps:
                continue
            state = messages.decode_control_nodes(message)
            if rest is None:
                rest = state.rest
                mine, theirs[mine] = _matched(bag, rest, nodes, findings)
                for (arm, span), each in zip(gathered, experiments):
                    chosen.append(mine[near_way(nodes.rest[mine], tools[arm].line, span, config)])
                    found.append(np.full((len(each.tips), len(chosen[-1]), 3), np.nan, np.float32))
            elif not np.array_equal(state.rest, rest):
                raise MessageError("control_nodes: the tissue changes within the recording; record each model into a bag of its own")
            for number, step in steps.items():
                found[number][step] = (state.positions - state.rest)[theirs[chosen[number]]]
    if not any(len(each) for each in chosen):
        return experiments
    known = sum(int(np.isfinite(each[:, :1, 0]).sum()) for each in found)
    findings.append(f"control nodes were recorded: the motion of up to {max(map(len, chosen))} of the skin counts, in {known} steps")
    noise = config.displacement_noise
    return [replace(each, displacements=found[n], nodes=chosen[n], displacement_noise=noise) for n, each in enumerate(experiments)]


def _matched(bag: Path, recorded: np.ndarray, nodes: ControlNodes, findings: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of control nodes of the skin that move, and of those recorded [R, 3] that are in the same places.

    Raises:
        SequenceError: If the recorded tissue has another size, or is elsewhere.
    """
    ratio = float(np.linalg.norm(recorded.std(0)) / max(np.linalg.norm(nodes.rest.std(0)), 1e-12))
    away = float(np.linalg.norm(recorded.mean(0) - nodes.rest.mean(0)))
    size = float(np.linalg.norm(np.ptp(recorded, axis=0)))
    skin = np.flatnonzero(nodes.is_skin & ~nodes.pinned)
    distance, nearest = KDTree(recorded).query(nodes.rest[skin])
    near = distance <= _SAME_PLACE * nodes.spacing
    told = f"its control nodes span {1e3 * size:.4g} mm, those of the model {1e3 * np.linalg.norm(np.ptp(nodes.rest, axis=0)):.4g} mm"
    if max(ratio, 1 / max(ratio, 1e-12)) > _SAME_SCALE or away > 0.5 * size:
        raise SequenceError(f"{bag}: the recording is of other tissue than the model: {told}, {1e3 * away:.0f} mm away from these")
    if near.mean() < _ENOUGH:
        findings.append(f"recorded control nodes are in other places than those of the model, and not used: {told}; do options agree?")
        near[:] = False
    elif not near.all():
        findings.append(f"{near.sum()} of {len(skin)} control nodes of the skin are where some were recorded; options of the tissue differ")
    return skin[near], np.asarray(nearest)[near]


# ----------------------------------------------------------------------------------------------------------------- images


def _picture(topics: Mapping[str, str]) -> dict[Topic, str]:
    """The topics of images that show the tissue, with the names of what they are to a `Synchronizer`; empty where something is missing."""
    there = lambda topic: f"/{topic.name}" in topics  # noqa: E731
    for info, pose, raw, compressed, mask in _PICTURES:
        image = raw if there(raw) else compressed
        if there(info) and there(pose) and there(image):
            return {info: "info", pose: "pose", image: "image"} | ({mask: "mask"} if there(mask) else {})
    return {}


def read_frames(bag: Path, topics: Mapping[Topic, str], frames: Mapping[str, np.ndarray]) -> Iterator[Frame]:
    """Images of the tissue with their cameras, and masks where there are any; as `_picture` names the topics.

    Raises:
        SequenceError: If a message cannot be used.
    """
    synchronizer = Synchronizer()
    with BagReader(bag) as reader:
        for topic, _, message in reader.messages(topics):
            yield from telling_bag(bag, lambda topic=topic, message=message: _fed(synchronizer, topic, message, topics[topic], frames))
    yield from telling_bag(bag, synchronizer.flush)


def _fed(synchronizer: Synchronizer, topic: Topic, message: Any, name: str, frames: Mapping[str, np.ndarray]) -> list[Frame]:
    """The frames that become complete with a message."""
    if topic in messages.RECORDING_TOPICS:
        return feed(synchronizer, topic, message, frames)
    stamp = messages.stamp_to_ns(message.header.stamp)
    if name == "info":
        synchronizer.add_info("left", messages.decode_camera_info(message, topic.name))
        return []
    if name == "pose":
        return synchronizer.add(name, stamp, messages.decode_pose(message, frames, topic.name))
    if name == "mask":
        labels = messages.decode_labels(message, topic.name)
        return synchronizer.add(name, stamp, np.where(labels == _WHOLE, 255, 0).astype(np.uint8))
    return synchronizer.add(name, stamp, messages.decode_image(message, topic.name))


def _with_tracks(
    bag: Path,
    experiments: list[Experiment],
    gathered: Gathered,
    tools: Mapping[str, Tool],
    model: GaussianModel,
    frames: Mapping[str, np.ndarray],
    topics: Mapping[Topic, str],
    config: RecordingConfig,
    findings: list[str],
) -> list[Experiment]:
    """The experiments with points that were followed in images."""
    found, images, shown = dict[int, Any](), 0, True
    for arm, tool in tools.items():
        numbers = [number for number, (name, _) in enumerate(gathered) if name == arm]
        spans = [gathered[number][1] for number in numbers]
        if not spans:
            continue
        tracks, count, sees = follow_points(model, read_frames(bag, topics, frames), tool.line, spans, config)
        found |= {numbers[number]: each for number, each in tracks.items()}
        images, shown = images + count, shown and sees
    points = sum(len(each.rest) for each in found.values())
    if points:
        count = sum(len(each.steps) for each in found.values())
        findings.append(f"{points} points were followed in {images} images, of which {count} count (motion_rate {config.motion_rate:g})")
    elif not shown:
        findings.append("images do not show the model, so that nothing is taken from them: check the pose of the camera and its frame")
    else:
        findings.append(f"no point could be followed in {images} images of the experiments")
    return [replace(each, tracks=[found[number]]) if number in found else each for number, each in enumerate(experiments)]
