"""Which of what tools did are experiments: what recordings and running graphs have in common."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.identification.force_checks import check_direction, check_place, overlap
from endo_sim_ros.identification.recording_config import TouchConfig
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.identification.touches import Timeline, experiment_spans, scatter, tared, timeline, touches
from endo_sim_ros.learning.streams import Stream
from endo_sim_ros.messages import Topic
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.physics.tools import THINNEST, THINNEST_CELL

_FADED = 3.0  # relaxation times after which a twentieth of a strain is remembered, no more than models are wrong anyway (`model_error`)
_THICKER = 1.1  # times as thick as was said, which is told
_SIMULATED = 1e-4  # m, tip_noise of tips that are exact: the model of the tissue is not
_ROUGH, _EXACT = 1.5, 0.2  # of tip_noise and force_noise: beyond these tips and forces are measured otherwise than was thought

Gathered = list[tuple[str, tuple[int, int]]]
"""Experiments: the name of the arm, and the first of its steps and the one after the last."""


@dataclass(frozen=True)
class Tool:
    """A tool, with forces that are zero in the air, and the standard deviation of their components there, N."""

    line: Timeline
    noise: float


def read_tool(
    arm: str,
    streams: Mapping[Topic, Stream],
    surface: Surface,
    physics: PhysicsConfig,
    config: TouchConfig,
    radius: float,
    findings: list[str],
) -> Tool:
    """One tool on steps of the physics, with what is to be said of its forces.

    Raises:
        SequenceError: If the forces contradict the poses.
    """
    forces = streams.get(messages.tool_reaction(arm))
    jaw = streams.get(messages.tool_jaw_state(arm), streams.get(messages.tool_jaw(arm)))
    line = timeline(streams[messages.tool_pose(arm)], jaw, forces, surface, physics, config, radius)
    findings += _noise_of_tips(arm, line, config)
    if not len(line.times) or forces is None:
        return Tool(line, 0.0)
    if text := overlap(line, int(forces.stamps[0]), int(forces.stamps[-1]), config.force_delay):
        raise SequenceError(f"{arm}/body/measured_cf: {text}")
    inside = line.present & (line.depths > config.clearance + 1e-3)
    if line.measured.any() and not np.nan_to_num(line.forces).any():
        if inside.any():
            findings.append(f"{arm}: all forces are 0, also where the tool is in the tissue: nobody measured them, and they are left out")
        return Tool(replace(line, forces=np.full_like(line.forces, np.nan)), 0.0)
    line, noise, offset, drift, lasts = tared(line, _steps(config.settle, physics))
    if offset.any():
        findings.append(f"{arm}: forces of {np.linalg.norm(offset):.2g} N while the tool touches nothing were taken off all forces")
    if drift.any():
        findings.append(
            f"{arm}: forces drift by {np.linalg.norm(drift):.2g} N from first to last while the tool touches nothing: a straight line was"
            " taken off all forces; zero the sensor more often"
        )
    floor = max(noise, config.force_noise)
    if noise > _ROUGH * config.force_noise:  # less is counted all the same
        what = f"{arm}: a component of the force has a noise of {noise:.2g} N in the air, more than force_noise"
        if lasts * physics.step_duration > config.settle:
            what = (
                f"{arm}: a component of the force wanders by {noise:.2g} N in the air, more than force_noise, for about"
                f" {lasts * physics.step_duration:.1f} s at a time: the sensor drifts up and down; zero it more often"
            )
        findings.append(what)
    findings += [text for text in (check_direction(arm, line, surface, floor), check_place(arm, line, floor, config.clearance)) if text]
    return Tool(line, noise)


def _noise_of_tips(arm: str, line: Timeline, config: TouchConfig) -> list[str]:
    """What to say where tips scatter by much more, or much less, than they are thought to."""
    seen = scatter(line)
    if seen > _ROUGH * config.tip_noise:
        return [f"{arm}: tips scatter by {1e3 * seen:.2g} mm, more than tip_noise, {1e3 * config.tip_noise:.2g} mm; give that"]
    if seen < _EXACT * config.tip_noise and config.tip_noise > _SIMULATED:
        how = "if they are exact, as simulated ones, give tip_noise 1e-4"
        return [f"{arm}: tips scatter by {1e3 * seen:.2f} mm only; {how}"]
    return []


def tool_radius(surface: Surface, nodes: ControlNodes, physics: PhysicsConfig) -> float:
    """Radius of the capsule that a tool pushes with, m; 0 = it does not push."""
    if not physics.contact_radius:
        return 0.0
    return max(physics.contact_radius, THINNEST * surface.apart, THINNEST_CELL * physics.grid_ratio * nodes.spacing)


def told_thickness(surface: Surface, nodes: ControlNodes, physics: PhysicsConfig) -> list[str]:
    """What to say where tools act as thicker ones than was said."""
    radius = tool_radius(surface, nodes, physics)
    if radius <= _THICKER * physics.contact_radius:
        return []
    return [
        f"tools act as balls of {1e3 * radius:.1f} mm radius, not of {1e3 * physics.contact_radius:.1f} mm as contact_radius says,"
        f" because control nodes of the skin are {1e3 * surface.apart:.1f} mm apart: give more of them (node_count), unless a"
        " simulation of the same ones was recorded"
    ]


def read_tools(
    arms: Sequence[str],
    streams: Mapping[Topic, Stream],
    surface: Surface,
    nodes: ControlNodes,
    physics: PhysicsConfig,
    config: TouchConfig,
    findings: list[str],
) -> dict[str, Tool]:
    """The tools of those arms whose poses came, with what is to be said of their forces.

    Raises:
        SequenceError: If the forces contradict the poses.
    """
    radius = tool_radius(surface, nodes, physics)
    there = [arm for arm in arms if messages.tool_pose(arm) in streams]
    return {arm: read_tool(arm, streams, surface, physics, config, radius, findings) for arm in there}


def settling_time(physics: PhysicsConfig, config: TouchConfig) -> float:
    """Time without a touch after which tissue is at rest, s: tissue that relaxes remembers the last one for longer."""
    return max(config.settle, _FADED * physics.relaxation_time if physics.relaxation else 0.0)


def settling_steps(physics: PhysicsConfig, config: TouchConfig) -> int:
    """The same in steps."""
    return _steps(settling_time(physics, config), physics)


def _steps(seconds: float, physics: PhysicsConfig) -> int:
    return max(round(seconds / physics.step_duration), 1)


def gather(
    tools: Mapping[str, Tool], streams: Mapping[Topic, Stream], physics: PhysicsConfig, config: TouchConfig, findings: list[str]
) -> Gathered:
    """Experiments in which one tool touches tissue that was at rest, and what is to be said of those left out."""
    still, found = settling_steps(physics, config), []
    for arm, tool in tools.items():
        spans, left_out = experiment_spans(tool.line, still)
        if left_out:
            findings.append(
                f"{arm}: {left_out} of {len(touches(tool.line, still - 1))} touches are left out, as the tool was not seen away from the"
                f" tissue for {settling_time(physics, config):g} s before, so that it may not have been at rest"
            )
        found += [(arm, span) for span in _alone(arm, spans, tools, streams, findings)]
    return found


def count_touches(line: Timeline, span: tuple[int, int], physics: PhysicsConfig, config: TouchConfig) -> int:
    """How often a tool touches in a span of its steps; trembling at the surface counts once."""
    found = touches(line, _steps(config.settle, physics) // 2)
    return sum(start >= span[0] and stop <= span[1] for start, stop in found)


def _alone(
    arm: str, spans: list[tuple[int, int]], tools: Mapping[str, Tool], streams: Mapping[Topic, Stream], findings: list[str]
) -> list[tuple[int, int]]:
    """The spans in which no other tool touches, and none pulls by a commanded wrench."""
    times, kept = tools[arm].line.times, []
    for span in spans:
        begin, end = times[span[0]], times[span[1] - 1]
        during = lambda stamps, does: bool((does & (stamps >= begin) & (stamps <= end)).any())  # noqa: E731
        others = [other for other, tool in tools.items() if other != arm and during(tool.line.times, tool.line.touching)]
        wrench = streams.get(messages.tool_wrench(arm))
        if others:
            findings.append(f"{arm}: an experiment is left out, as {', '.join(others)} touched the tissue, too")
        elif wrench is not None and during(wrench.stamps, wrench.values[:, :6].any(1)):
            findings.append(f"{arm}: an experiment is left out, as the tool pulled by a wrench; that is for simulations alone")
        else:
            kept.append(span)
    return kept
