"""What was said of a tool, on steps of the physics, and split into experiments that begin with tissue at rest."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation

from endo_sim_ros.core.cameras import quat_to_matrix
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.recording_config import TouchConfig
from endo_sim_ros.identification.solving import LIKELIER
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.learning.streams import Stream, continuous
from endo_sim_ros.physics.config import PhysicsConfig

_SAME_PERIOD = 0.01  # of the step; forces of a simulation come with its steps, and steps are then taken where these are
_SEVERAL = 3  # forces about the end of a step are averaged; fewer are joined by straight lines
_NOISE_OF_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_FEW = 10  # tips that tell nothing of their scatter
_OUTLYING = 5.0  # standard deviations, by which single forces in the air are cut
# Noise of forces in the air that is looked at: variance of what lasts over that of white noise, and for how many steps.
_KINDS = np.array([(0.0, 1.0), *((variance, time) for variance in (0.1, 0.3, 1, 3, 10, 30, 100) for time in (2, 5, 12, 25, 60, 150, 400))])


@dataclass(frozen=True)
class Timeline:
    """One tool on T steps.

    Args:
        times: Ends of the steps [T], ns.
        tips: Where the tip is then [T, 3], m, world; NaN where it is not known.
        rotations: Its axes [T, 3, 3], world.
        closed: Whether its jaw holds tissue [T], as physics_node has it: it does not where it closed on nothing.
        forces: On the tool [T, 3], N, world; NaN where they are not known.
        gaps: Between tool and skin at rest [T], m; below zero in the tissue.
        touching: Whether it touches tissue [T].
        pulled: How far the tip is from where its jaw closed [T, 3], m; zero while it holds nothing.
    """

    times: np.ndarray
    tips: np.ndarray
    rotations: np.ndarray
    closed: np.ndarray
    forces: np.ndarray
    gaps: np.ndarray
    touching: np.ndarray
    pulled: np.ndarray

    @property
    def present(self) -> np.ndarray:
        """Where the tip is known [T]."""
        return np.isfinite(self.tips[:, 0])

    @property
    def measured(self) -> np.ndarray:
        """Where the force is known [T]."""
        return np.isfinite(self.forces[:, 0])

    @property
    def depths(self) -> np.ndarray:
        """How far the tool has gone into the tissue, or has pulled it [T], m; NaN where the tip is not known."""
        depths = np.where(self.closed, np.linalg.norm(self.pulled, axis=1), (-self.gaps).clip(0))
        return np.where(self.present, depths, np.nan)


def step_times(poses: Stream, forces: Stream | None, step_duration: float) -> np.ndarray:
    """Ends of steps [T], ns, while poses were measured; those of a simulation's own steps where its forces tell them."""
    period, stamps = round(step_duration * 1e9), poses.stamps
    begin = stamps[0]
    if forces is not None and len(forces.stamps) > 2:
        gap = np.median(np.diff(forces.stamps))
        if abs(gap / period - 1) < _SAME_PERIOD:
            begin += (forces.stamps[0] - begin) % period
    return begin + period * np.arange(max((stamps[-1] - begin) // period + 1, 0))


def poses_at(poses: Stream, times: np.ndarray, longest_gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, 3] and quaternions xyzw [T, 4] at times [T], ns, on straight lines; NaN beyond and in gaps (s) that are longer."""
    stamps, values = poses.stamps, continuous(poses.values[:, :7])
    after = np.searchsorted(stamps, times).clip(0, len(stamps) - 1)
    before = np.where(stamps[after] == times, after, (after - 1).clip(0))
    gap = stamps[after] - stamps[before]
    share = (times - stamps[before]) / np.maximum(gap, 1)
    known = (gap <= longest_gap * 1e9) & (share >= 0) & (share <= 1) & (times >= stamps[0]) & (times <= stamps[-1])
    found = values[before] + share[:, None] * (values[after] - values[before])
    found[~known] = np.nan
    return found[:, :3], found[:, 3:] / np.linalg.norm(found[:, 3:], axis=1, keepdims=True)


def forces_at(forces: Stream, times: np.ndarray, step_duration: float, longest_gap: float) -> np.ndarray:
    """Forces [T, 3] at times [T], ns: means over a step about each of them, or on straight lines where there are few; NaN in gaps (s)."""
    values, half = forces.values[:, :3], round(step_duration * 0.5e9)
    first, last = (np.searchsorted(forces.stamps, times + shift) for shift in (-half, half))
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(values, 0)])
    means = (sums[last] - sums[first]) / np.maximum(last - first, 1)[:, None]
    lines, _ = poses_at(Stream(forces.stamps, np.hstack([values, np.tile([0.0, 0, 0, 1], (len(values), 1))])), times, longest_gap)
    return np.where((last - first >= _SEVERAL)[:, None], means, lines)


def timeline(
    poses: Stream, jaw: Stream | None, forces: Stream | None, surface: Surface, physics: PhysicsConfig, config: TouchConfig, radius: float
) -> Timeline:
    """One tool on the steps of the physics.

    Args:
        poses: Of its tip [N, 7], position and quaternion xyzw, world.
        jaw: Its angles [N, 1], rad; None = open.
        forces: On it [N, 3 or more], N, world; None where they were not measured.
        surface: The tissue at rest.
        physics: Duration of a step, reach of jaws.
        config: What a touch is.
        radius: Of the tool, m.
    """
    if forces is not None:
        forces = Stream(forces.stamps - round(config.force_delay * 1e9), forces.values)
    times = step_times(poses, forces, physics.step_duration)
    tips, quats = poses_at(poses, times, config.longest_gap)
    rotations = quat_to_matrix(np.nan_to_num(np.roll(quats, 1, axis=1), nan=0.5))
    measured = np.full((len(times), 3), np.nan)
    if forces is not None:
        measured = forces_at(forces, times, physics.step_duration, config.longest_gap)
    angles = np.full(len(times), np.inf) if jaw is None else jaw.at(times, before=Stream.constant([np.inf]))[:, 0]
    near = surface.distances(tips) <= physics.force_radius
    closed, pulled = _held(angles, near, tips, config)
    gaps = surface.gaps(tips) - radius
    touching = np.isfinite(tips[:, 0]) & (closed | (gaps <= config.clearance))
    return Timeline(times, tips, rotations, closed, measured, gaps, touching, pulled)


def _held(angles: np.ndarray, near: np.ndarray, tips: np.ndarray, config: TouchConfig) -> tuple[np.ndarray, np.ndarray]:
    """While a jaw with these angles [T] holds tissue [T], and how far it has pulled that [T, 3], if tissue is near its tip [T]."""
    closed, pulled = np.zeros(len(angles), bool), np.zeros((len(angles), 3))
    shut, began = False, None
    for t, angle in enumerate(angles):
        if angle >= config.jaw_open or not np.isfinite(tips[t, 0]):
            shut, began = angle < config.jaw_open and shut, None
        elif angle <= config.jaw_closed and not shut:  # once it has closed on nothing it holds nothing until it opens
            shut, began = True, tips[t] if near[t] else None
        if began is not None:
            closed[t], pulled[t] = True, tips[t] - began
    return closed, pulled


def touches(line: Timeline, longest_pause: int = 0) -> list[tuple[int, int]]:
    """First step of each touch, and the first after it; pauses of so many steps are no end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], line.touching.astype(int), [0]])))
    found: list[tuple[int, int]] = []
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist()):
        if found and start - found[-1][1] <= longest_pause and line.present[found[-1][1] : start].all():
            start = found.pop()[0]
        found.append((start, stop))
    return found


def experiment_spans(line: Timeline, settle: int) -> tuple[list[tuple[int, int]], int]:
    """First step of each experiment, and the first after it, and the number of touches left out, as tissue may not have been at rest.

    Args:
        line: The tool.
        settle: Steps without a touch after which tissue is at rest. It is so, too, where the timeline begins with a tool in the air.
    """
    spans, left_out, lead = [], 0, max(settle // 2, 1)
    known, end = line.present, 0
    for start, stop in touches(line, settle - 1):
        if not start or not known[max(start - settle, 0) : start].all():
            left_out += 1
            continue
        end = stop
        while end < min(stop + lead, len(known)) and known[end]:
            end += 1
        spans.append((max(start - lead, 0), end))
    return spans, left_out


def scatter(line: Timeline) -> float:
    """Standard deviation of a coordinate of single tips about their steady way, m, by their second differences; NaN of too few tips."""
    bends = np.diff(line.tips, 2, axis=0)
    bends = bends[np.isfinite(bends).all(1)]
    return float(_NOISE_OF_MEDIAN * np.median(np.abs(bends)) / np.sqrt(6)) if len(bends) > _FEW else float("nan")


def tared(line: Timeline, settle: int) -> tuple[Timeline, float, np.ndarray, np.ndarray, float]:
    """The timeline with forces that are zero in the air, the standard deviation of a component there (N), what was taken off: in the
    middle of the steps in the air [3], N, and how much more at their end than at their beginning [3], N, where the sensor drifts; and for
    how many steps the part of the noise lasts that is not other at each step, 0 without such a part.

    Noise is white, and beside that there may be a process of first order. A line, or an offset, is taken off where forces are 20 times as
    likely with it, by the Bayesian information criterion (Schwarz 1978), whatever the share of what lasts and its time are. Without enough
    steps in the air forces are taken as they are, and the deviation is 0.

    Args:
        line: The tool.
        settle: Steps about a touch in which it is not sure to be in the air.
    """
    near = np.asarray(binary_dilation(line.touching, iterations=settle), bool)
    steps = np.flatnonzero(line.measured & line.present & ~near)
    if len(steps) < 5:
        return line, 0.0, np.zeros(3), np.zeros(3), 0.0
    free, along = line.forces[steps], (steps - steps.mean()) / max(float(np.ptp(steps)), 1.0)
    middle, apart = np.median(free, 0), _OUTLYING * _NOISE_OF_MEDIAN * np.median(np.abs(free - np.median(free, 0)), 0)
    white = _whitened(np.column_stack([np.clip(free, middle - apart, middle + apart), np.ones(len(steps)), along]), steps)
    best = _least(white, 0)
    for count in (1, 2):
        found = _least(white, count)
        if best.cost - found.cost > LIKELIER + 3 * np.log(len(steps)):
            best = found
    basis = np.zeros((2, 3))
    basis[: len(best.found)] = best.found
    taken = basis[0] + basis[1] * ((np.arange(len(line.forces)) - steps.mean()) / max(float(np.ptp(steps)), 1.0))[:, None]
    return replace(line, forces=line.forces - taken), best.noise, basis[0], basis[1], best.lasts


@dataclass(frozen=True)
class _Whitened:
    """Columns of values at steps, as they are without what earlier ones tell, for each kind of noise.

    Args:
        columns: [G, N, C], over the standard deviation of white noise.
        spread: Sums of logarithms of variances [G].
    """

    columns: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class _Tare:
    """What fits forces in the air.

    Args:
        cost: Minus twice the logarithm of their probability.
        found: Offset and line that are taken off, or fewer [0 to 2, 3], N.
        noise: Standard deviation of the rest, N.
        lasts: For how many steps it lasts.
    """

    cost: float
    found: np.ndarray
    noise: float
    lasts: float


def _whitened(columns: np.ndarray, steps: np.ndarray) -> _Whitened:
    """Columns [N, C] at steps [N] by Kalman's filter of white noise and a process of first order beside it, of `_KINDS`."""
    variance, time = _KINDS.T
    found, spread = np.zeros((len(_KINDS), *columns.shape)), np.zeros(len(_KINDS))
    state, left = np.zeros((len(_KINDS), columns.shape[1])), variance
    for n, row in enumerate(columns):
        whole = left + 1
        off, spread = row - state, spread + np.log(whole)
        found[:, n] = off / np.sqrt(whole)[:, None]
        kept = np.exp(-(steps[min(n + 1, len(steps) - 1)] - steps[n]) / time)
        state = (state + (left / whole)[:, None] * off) * kept[:, None]
        left = kept**2 * left / whole + (1 - kept**2) * variance
    return _Whitened(found, spread)


def _least(white: _Whitened, count: int) -> _Tare:
    """The likeliest where so many of the last two columns are taken off the three before these."""
    costs, fits = [], []
    values = white.columns[..., :3]
    for each, basis, spread in zip(values, white.columns[..., 3 : 3 + count], white.spread):
        fit = np.linalg.lstsq(basis, each, rcond=None)[0]
        squares = max(float(((each - basis @ fit) ** 2).sum()), 1e-30)
        costs.append(each.size * np.log(squares / each.size) + 3 * spread)
        fits.append((fit, np.sqrt(squares / each.size)))
    # What lasts has a share and a time more, of which none is known before.
    cost = float(-2 * np.logaddexp.reduce(-0.5 * np.array(costs)) + 2 * np.log(len(costs)))
    best = int(np.argmin(np.array(costs) + (_KINDS[:, 0] > 0) * 2 * np.log(values.shape[1])))
    (variance, time), (fit, deviation) = _KINDS[best], fits[best]
    return _Tare(cost, fit, float(deviation * np.sqrt(1 + variance)), float(time) if variance else 0.0)


def experiment(line: Timeline, span: tuple[int, int], step_duration: float, noise: float, config: TouchConfig) -> Experiment:
    """What was done to tissue in the steps from the first to before the last of a span.

    Args:
        line: The tool.
        span: Of its steps.
        step_duration: s.
        noise: Of the forces as seen in the air, N.
        config: How well tip and forces are measured.
    """
    part = slice(*span)
    return Experiment(
        step_duration,
        line.tips[part],
        line.rotations[part],
        line.present[part],
        line.closed[part],
        line.forces[part],
        force_noise=max(noise, config.force_noise),
        tip_noise=config.tip_noise,
    )
