"""Data that a model of the tissue cannot explain: each check says in a sentence what was seen."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.force_checks import check_clipped
from endo_sim_ros.identification.forward import ForwardModel, closing_steps, distances_to_skin
from endo_sim_ros.identification.observations import Observations
from endo_sim_ros.identification.unknowns import Unknowns

_SIGNIFICANT = 5.0  # standard deviations
_AVERAGED = 5  # samples, before a force is said to be there
_GONE, _STILL = 0.25, 6.0  # a grasp has slipped where less than this share of the force is left, of a force this many deviations great
_SCANNED = 13  # depths
_ROUGHLY = 1.2  # times as great as by theory chi-square may be: that of 40 presses of tissue as the model has it was 1.08 ± 0.1
_LAG, _UNLIKE = 1.5, 0.3  # steps; less is within what sampling does. Share of what noise does not explain that a lag may leave
_ENOUGH = 25.0  # by which chi-square must fall before another depth or lag is believed
_TELLS = 0.1  # of the precision before any data, that an experiment must tell of a direction to be compared along it
_LEAVE_OUT = ", by more than noise and errors of the tool: leave it out, or check where its tool stood and what was touched"
_FAR = 2.0  # standard deviations of where the tool stands, beyond which that is told


class IdentificationError(ValueError):
    """Data from which nothing can be estimated; the message says what was seen."""


def check_input(experiments: list[Experiment], nodes_count: int) -> None:
    """Refuse experiments whose arrays do not fit together.

    Raises:
        IdentificationError: With what is wrong, and in which.
    """
    if not experiments:
        raise IdentificationError("there is no experiment; give at least one in which a tool touches the tissue")
    for number, each in enumerate(experiments):
        where, steps = f"experiment {number}", len(each.tips)
        shapes = {"tips": (steps, 3), "rotations": (steps, 3, 3), "present": (steps,), "closed": (steps,), "forces": (steps, 3)}
        for name, shape in shapes.items():
            if np.shape(getattr(each, name)) != shape or not steps:
                raise IdentificationError(f"{where}: {name} has shape {np.shape(getattr(each, name))}, expected {shape} for {steps} tips")
        there = np.asarray(each.present, bool)
        if not (np.isfinite(each.tips[there]).all() and np.isfinite(each.rotations[there]).all()):
            raise IdentificationError(f"{where}: a tip that is present is not finite; mark it as not present")
        if np.isinf(each.forces).any():
            raise IdentificationError(f"{where}: a force is infinite; set forces that were not measured to NaN")
        if not (each.step_duration > 0 and each.force_noise > 0 and each.displacement_noise > 0 and each.tip_noise >= 0):
            raise IdentificationError(f"{where}: step_duration and the standard deviations of noise must be above 0")
        if each.displacements is not None:
            wanted = np.asarray([] if each.nodes is None else each.nodes)
            good = wanted.ndim == 1 and len(wanted) and wanted.dtype.kind in "iu" and 0 <= wanted.min() <= wanted.max() < nodes_count
            if not good:
                raise IdentificationError(f"{where}: displacements need `nodes`, the numbers of control nodes from 0 to {nodes_count - 1}")
            if np.shape(each.displacements) != (steps, len(wanted), 3):
                raise IdentificationError(
                    f"{where}: displacements have shape {np.shape(each.displacements)}, expected {(steps, len(wanted), 3)}"
                )
        for tracks in each.tracks:
            expected = (len(tracks.steps), len(tracks.rest), 2)
            if np.shape(tracks.pixels) != expected or len(tracks.cameras) != len(tracks.steps):
                raise IdentificationError(
                    f"{where}: tracks have pixels {np.shape(tracks.pixels)} and {len(tracks.cameras)} cameras, expected {expected} and"
                    f" {len(tracks.steps)}"
                )
            if len(tracks.steps) and not 0 <= np.min(tracks.steps) <= np.max(tracks.steps) < steps:
                raise IdentificationError(f"{where}: images of tracks belong to steps from 0 to {steps - 1}")


@dataclass(frozen=True)
class Survey:
    """What a first look at the data says.

    Args:
        scale: By which forces of the model are to be multiplied.
        stands: Standard deviation, m, of where contact begins along a press, as it was thought.
        doubts: Sentences that say that the data are not what they are taken for.
        findings: Other ones.
        offset: Of all tips [3], m, world, with which contact begins where it was measured; 0 where that explains little more.
        unlikely: Whether that is farther than was thought.
    """

    scale: float
    stands: float
    doubts: list[str]
    findings: list[str]
    offset: np.ndarray
    unlikely: bool = False


def survey(
    data: list[Observations], model: ForwardModel, unknowns: Unknowns, theta: np.ndarray, covariance: np.ndarray | None = None
) -> Survey:
    """Compare what was measured with what tissue of numbers θ [P + 5], as it was thought to be, would do, its surface at several depths.

    Samples after which a grasp has slipped are marked as not used.

    Args:
        data: Of each experiment.
        model: The tissue.
        unknowns: What θ means.
        theta: What is thought before these data.
        covariance: Of θ, if other experiments told it, and with it where the tool stands [P + 5, P + 5].

    Raises:
        IdentificationError: If the tool never touches, or forces are in another frame.
    """
    config, z, offset = unknowns.config, theta[: unknowns.count], theta[unknowns.count :][:3] * unknowns.config.tip_offset
    depths = np.linspace(-config.depth_scan, config.depth_scan, _SCANNED)
    predicted: list[np.ndarray] = []
    measured = [each.experiment.forces for each in data]
    axes = [_axis(each.experiment, model) for each in data]
    for each, axis in zip(data, axes):
        replay = model.replay(each.experiment, [unknowns.copy(z, offset + depth * axis) for depth in depths], _SCANNED)
        predicted.append(replay.forces)
    middle = _SCANNED // 2
    _check_touch(data, model, predicted, middle)
    if not any(np.isfinite(each).any() for each in measured):
        told = "no force was measured: of stiffness only ratios between places are known, not how stiff the tissue is"
        return Survey(1.0, config.tip_offset, [], [told], np.zeros(3))
    _check_felt(data, [each[middle] for each in predicted])
    findings = _find_slips(data, [each[middle] for each in predicted])
    costs, scales = zip(*(_fit_scale(data, [each[d] for each in predicted]) for d in range(_SCANNED)))
    chosen = [each[int(np.argmin(costs))] for each in predicted]
    _check_direction(data, chosen, config)
    stands = config.tip_offset
    if covariance is not None:
        axis = np.mean(axes, axis=0)
        of_tip = covariance[unknowns.count :, unknowns.count :][:3, :3]
        stands *= float(np.sqrt(axis @ of_tip @ axis))
    stands = float(np.hypot(stands, config.surface_error))
    far, near = _FAR * stands, np.abs(depths) <= max(2 * _FAR * stands, depths[-1] - depths[-2])
    doubts = lag = _find_lag(data, [each[near] for each in predicted], config)
    if not lag:
        doubts = check_clipped(
            [np.where(_usable(each)[:, None], each.experiment.forces, np.nan) for each in data],
            [each[middle] for each in predicted],
            [each.experiment.force_noise for each in data],
        )
    opened = np.array([_fit_scale(data, [each[d] for each in predicted], opened=True)[0] for d in range(_SCANNED)])
    depth, gain = _lowest(depths, opened, middle, sum(int(each.of_forces().sum()) for each in data))
    elsewhere, beyond = not lag and gain > _ENOUGH, bool(abs(depth) >= config.depth_scan and gain > _ENOUGH)
    unlikely = bool(elsewhere and abs(depth) > far)
    if unlikely:
        where = "deeper than" if depth < 0 else "before"
        told = (
            f"contact begins about {1000 * abs(depth):.1f} mm {'or more ' * beyond}{where} the surface of the model: check its scale, and"
            " where the tool stands to it"
        )
        (doubts if beyond else findings).append(told)
    offset = depth * (elsewhere and not beyond) * np.mean(axes, axis=0)
    return Survey(float(np.clip(scales[int(np.argmin(costs))], 0.05, 20.0)), stands, doubts, findings, offset, unlikely and not beyond)


def _axis(experiment: Experiment, model: ForwardModel) -> np.ndarray:
    """Direction in which the tool goes into the tissue [3]."""
    distances = distances_to_skin(experiment, model.nodes)
    if not np.isfinite(distances).any():
        return np.array([0.0, 0.0, 1.0])
    deepest = int(np.argmin(distances))
    tip = experiment.tips[deepest]
    skin = model.nodes.rest[model.nodes.is_skin].astype(np.float64)
    near = skin[np.argsort(((skin - tip) ** 2).sum(1))[:6]]
    normal = np.linalg.svd(near - near.mean(0))[2][2]
    eye = np.zeros(3) if model.nodes.seen_from is None else model.nodes.seen_from
    return -normal if normal @ (eye - near.mean(0)) > 0 else normal


def _check_touch(data: list[Observations], model: ForwardModel, predicted: list[np.ndarray], middle: int) -> None:
    felt = [bool(_there(each.experiment.forces, each.experiment.force_noise).any()) for each in data]
    touched = [bool(np.abs(each).any()) for each in predicted]
    nearest = min(float(distances_to_skin(each.experiment, model.nodes).min(initial=np.inf)) for each in data)
    if any(touched) and (any(felt) or any(np.abs(each[middle]).any() for each in predicted)):
        return
    away = "is never present" if not np.isfinite(nearest) else f"stays {1000 * nearest:.1f} mm or more away from the skin's control nodes"
    if any(felt):
        most = max(float(np.linalg.norm(np.nan_to_num(each.experiment.forces), axis=1).max()) for each in data)
        raise IdentificationError(
            f"forces of up to {most:.2g} N were measured, but the tool {away}: check frames, scale and the model's contact_radius"
        )
    raise IdentificationError(f"the tool never touches the tissue: it {away}; press deeper, or check frames and scale")


def _check_felt(data: list[Observations], predicted: list[np.ndarray]) -> None:
    """Refuse forces that are noise alone, though the tool is as deep in the tissue as would be felt."""
    noise = [each.experiment.force_noise for each in data]
    if any(_there(each.experiment.forces, own).any() for each, own in zip(data, noise)):
        return
    expected = [force * np.isfinite(each.experiment.forces) for each, force in zip(data, predicted)]
    if any(_there(force, own).any() for force, own in zip(expected, noise)):
        most = max(float(np.linalg.norm(force, axis=1).max()) for force in expected)
        raise IdentificationError(
            f"the tool is in the tissue, which would exert up to {most:.2g} N on it, but no force beyond the noise of {max(noise):.2g} N"
            " was measured; set forces that were not measured to NaN, check whether their clock is that of the poses, or give softer tissue"
        )


def _there(forces: np.ndarray, noise: float) -> np.ndarray:
    """Whether there is a force at each step [T], by means over some samples."""
    mean = np.stack([_moving_mean(np.nan_to_num(forces[:, axis])) for axis in range(3)], 1)
    return np.linalg.norm(mean, axis=1) > _SIGNIFICANT * noise / np.sqrt(_AVERAGED)


def _moving_mean(values: np.ndarray) -> np.ndarray:
    return np.convolve(values, np.ones(_AVERAGED) / _AVERAGED, "same") if len(values) >= _AVERAGED else np.full_like(values, values.mean())


def _usable(each: Observations) -> np.ndarray:
    """Steps whose force is used [T], bool."""
    usable = np.asarray(np.isfinite(each.experiment.forces).all(1))
    forces = each.of_forces()
    usable[each.steps[forces & ~each.used]] = False
    return usable


def _fit_scale(data: list[Observations], predicted: list[np.ndarray], opened: bool = False) -> tuple[float, float]:
    """Chi-square of forces with the scale of the model that is best, and this scale; of those with an open jaw only, if so wanted, as a
    closed one feels how far it goes, not where it is."""
    pp = pm = mm = 0.0
    for each, force in zip(data, predicted):
        usable, noise = _usable(each), each.experiment.force_noise
        if opened:
            usable &= closing_steps(each.experiment) < 0
        measured, force = each.experiment.forces[usable] / noise, force[usable] / noise
        pp, pm, mm = pp + (force**2).sum(), pm + (force * measured).sum(), mm + (measured**2).sum()
    scale = max(pm / pp, 1e-6) if pp > 0 else 1.0
    return mm - 2 * scale * pm + scale**2 * pp, scale


def _lowest(depths: np.ndarray, costs: np.ndarray, middle: int, count: int) -> tuple[float, float]:
    """Depth of the least cost, by a parabola about it, and how much less it is there than at depth 0: of `count` residuals, as multiples of
    the greater of 1 and their mean there, so that what no depth explains speaks for none."""
    best = int(np.argmin(costs))
    depth = float(depths[best])
    if 0 < best < len(depths) - 1:
        a, b, c = costs[best - 1 : best + 2]
        bend = a - 2 * b + c
        depth += 0.5 * (a - c) / bend * (depths[1] - depths[0]) if bend > 0 else 0.0
    return depth, float(costs[middle] - costs[best]) / max(1.0, costs[best] / max(count, 1))


def _check_direction(data: list[Observations], predicted: list[np.ndarray], config: IdentificationConfig) -> None:
    """Refuse forces that point elsewhere than those of the model, and name the experiments, unless it is all of them."""
    told = [_turned([each], [force], config) for each, force in zip(data, predicted)]
    wrong, whole = [number for number, text in enumerate(told) if text], _turned(data, predicted, config)
    if wrong and (len(wrong) < len(data) or not whole):
        which = f"experiment{'s' * (len(wrong) > 1)} {', '.join(map(str, wrong))}"
        raise IdentificationError(f"{which}: {told[wrong[0]]}, as those of the others are, or leave it out")
    if whole:
        raise IdentificationError(whole)


def _turned(data: list[Observations], predicted: list[np.ndarray], config: IdentificationConfig) -> str:
    """A sentence if forces point elsewhere than those of the model, else an empty one."""
    H, weight = np.zeros((3, 3)), 0.0
    for each, force in zip(data, predicted):
        measured = np.where(_usable(each)[:, None], np.nan_to_num(each.experiment.forces), 0)
        H += measured.T @ force
        weight += (force[_usable(each)] ** 2).sum() * each.experiment.force_noise**2
    if np.sqrt((H**2).sum()) < _SIGNIFICANT * np.sqrt(weight) or not weight:
        return ""
    # Measured and predicted directions that belong together most: the first pair of singular vectors.
    u, s, vt = np.linalg.svd(H)
    a, b = u[:, 0], vt[0]
    angle = float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))
    if angle > 180 - config.most_turned:
        return (
            "measured forces point against those that the tissue would exert on the tool: they have the opposite sign; give what"
            " the tissue exerts on the tool, in the world's axes"
        )
    if angle > config.most_turned:
        return (
            f"measured forces are turned by {angle:.0f}° from those that the tissue would exert on the tool (they point along"
            f" {np.round(a * np.sign(s[0]), 2).tolist()}, expected {np.round(b, 2).tolist()}): they are in another frame; give them in the"
            " world's axes"
        )
    return ""


def _find_slips(data: list[Observations], predicted: list[np.ndarray]) -> list[str]:
    """Mark samples after which a closed jaw has lost its tissue as not used, and tell them.

    Each grasp is compared with forces of the model [T, 3] that are scaled to it up to some sample, and are gone after that.
    """
    findings = []
    for number, (each, force) in enumerate(zip(data, predicted)):
        experiment, measured = each.experiment, _usable(each)
        began = closing_steps(experiment)
        for start in np.unique(began[began >= 0]):
            at = np.flatnonzero((began == start) & measured)
            a, b = experiment.forces[at] / experiment.force_noise, force[at] / experiment.force_noise
            pm, pp = np.cumsum((a * b).sum(1)), np.cumsum((b**2).sum(1))
            explained = pm.clip(0) ** 2 / np.maximum(pp, 1e-12)
            last = int(explained.argmax()) if len(at) else 0
            rest = slice(last + 1, None)
            if len(b[rest]) < _AVERAGED:
                continue
            had = pm[last] / max(pp[last], 1e-12) * np.linalg.norm(b[rest], axis=1)
            left = (a[rest] * b[rest]).sum(1) / np.maximum(np.linalg.norm(b[rest], axis=1), 1e-12)
            unexplained = max(1.0, float((a**2).sum() - explained[last]) / a.size)
            if explained[last] - explained[-1] < _ENOUGH * unexplained or had.mean() < _STILL or left.mean() > _GONE * had.mean():
                continue
            begin, end = int(at[last]), int(np.flatnonzero(began == start)[-1]) + 1
            each.used &= (each.steps < begin) | (each.steps >= end)
            findings.append(
                f"the grasp slipped {begin * experiment.step_duration:.2f} s after the beginning of experiment {number}: the force"
                f" fell to {max(left.mean(), 0.0) * experiment.force_noise:.2f} N where the model has"
                f" {had.mean() * experiment.force_noise:.2f} N; the {end - begin} steps until the jaw opens are left out"
            )
    return findings


def _find_lag(data: list[Observations], predicted: list[np.ndarray], config: IdentificationConfig) -> list[str]:
    """Tell by how long forces come after poses, and whether that grows, where that explains most of what nothing else does: not how stiff
    each experiment is, nor a likely depth at which contact begins.

    Args:
        data: Without what slipped.
        predicted: Forces of the model at D likely depths, of each experiment [D, T, 3].
        config: How long a lag may be.
    """
    duration = min(each.experiment.step_duration for each in data)
    steps = int(config.most_lag / duration)
    lags, parts, count = np.arange(-steps, steps + 1), [], 0
    for each, force in zip(data, predicted):
        where, noise, T = np.flatnonzero(_usable(each)), each.experiment.force_noise, force.shape[1]
        padded = np.pad(force, ((0, 0), (steps, steps), (0, 0))) / noise  # before and after the tool is away, and feels nothing
        a, moved = each.experiment.forces[where] / noise, [padded[:, steps - lag : steps - lag + T][:, where] for lag in lags]
        pm, pp = np.array([[(a * y).sum((1, 2)), (y**2).sum((1, 2))] for y in moved]).transpose(1, 0, 2)
        parts.append((a**2).sum() - pm.clip(0) ** 2 / np.maximum(pp, 1e-12))  # [L, D]
        count += a.size
    costs = np.sum(parts, axis=0)
    depth = int(costs.min(0).argmin())
    lag, gain = _lowest(lags.astype(float), costs.min(1), steps, count)
    own = [_lowest(lags.astype(float), part[:, depth], steps, count)[0] for part in parts]
    apart = float(costs[:, depth].min() - sum(part[:, depth].min() for part in parts))
    drifts = abs(own[-1] - own[0]) >= _LAG and apart > _ENOUGH
    left = costs.min() - drifts * apart - count
    if left > _UNLIKE * (costs[steps].min() - count) or not (drifts or (abs(lag) >= _LAG and gain > _ENOUGH)):
        return []
    if drifts:
        return [
            f"measured forces come {_when(own[0] * duration)} the poses at first and {_when(own[-1] * duration)} them at last: their clocks"
            " run apart; record with one clock"
        ]
    return [f"measured forces come {_when(lag * duration)} the poses: record with one clock, or give force_delay {lag * duration:.2f}"]


def _when(seconds: float) -> str:
    return f"{abs(seconds):.2f} s {'after' if seconds >= 0 else 'before'}"


def is_rare(chi_square: float, count: int, probability: float) -> bool:
    """Whether noise makes a chi-square of that many degrees more rarely; the covariance is only about right."""
    return bool(chi2.sf(chi_square / _ROUGHLY, count) < probability)


def judge_residuals(chi_square: float, count: int, config: IdentificationConfig) -> tuple[float, list[str]]:
    """By what factor the variance of residuals is greater than noise explains, 1 where it may be noise; and a sentence about it.

    Args:
        chi_square: Of the residuals at the estimate.
        count: Of residuals, less the unknowns that they determine.
        config: How rare is too rare.
    """
    if count < 1 or not is_rare(chi_square, count, config.doubt):
        return 1.0, []
    factor = chi_square / count
    return factor, [
        f"the model does not explain the data: residuals are {np.sqrt(factor):.1f} times as great as their noise (chi-square"
        f" {chi_square:.0f} for {count:.0f}); intervals are as much wider, but nothing counts as known"
    ]


def find_contradictions(
    H: list[np.ndarray], g: list[np.ndarray], precision: np.ndarray, pull: np.ndarray, on: bool, config: IdentificationConfig
) -> list[str]:
    """Tell which experiments contradict the others, the worst first, in a sentence each.

    Each is left out in turn. What the others, and what was known before, say of the unknowns and of the errors that all share predicts
    what it measures. Its score along these, over its covariance, has a chi-square distribution of as many degrees as it tells of. A tool
    that stands elsewhere in one experiment alone hides in the chi-square of all residuals, of which there are hundreds, but not in these.

    Args:
        H: Of each experiment JᵀR⁻¹J [Q, Q].
        g: Of each JᵀR⁻¹r at the estimate [Q].
        precision: Before all of them [Q, Q].
        pull: Gradient of what was known before at the estimate, precision (θ - mean) [Q].
        on: Whether what was known before is of other experiments, so that one alone may contradict it.
        config: How rare is too rare.
    """
    left, told = list(range(len(H))), list[str]()
    while len(left) > 1 or (on and left):
        whole, score = precision + sum(H[k] for k in left), sum(g[k] for k in left) - pull
        rare = [_surprise(whole, score, H[k], g[k]) for k in left]
        if min(rare) > config.doubt:
            break
        worst = left.pop(int(np.argmin(rare)))
        if len(left) == 1 and not on:
            told.append(f"experiments {min(worst, *left)} and {max(worst, *left)} contradict each other" + _LEAVE_OUT)
            break
        told.append(f"experiment {worst} contradicts {'what was known before' if not left else 'the others'}" + _LEAVE_OUT)
    return told


def _surprise(whole: np.ndarray, score: np.ndarray, H: np.ndarray, g: np.ndarray) -> float:
    """How rarely noise makes an experiment differ as much from what all others say of it.

    Args:
        whole: Precision by all experiments, and before [Q, Q].
        score: Their scores, less the pull of what was known before [Q].
        H: Of this experiment [Q, Q].
        g: Its score [Q].
    """
    beside = g - H @ np.linalg.solve(whole - H, score - g)  # at the estimate without it
    by = np.linalg.solve(whole, np.column_stack([beside, H]))
    values, ways = np.linalg.eigh(H - H @ by[:, 1:])
    along, tells = ways.T @ (beside - H @ by[:, 0]), values > _TELLS
    return float(chi2.sf((along[tells] ** 2 / values[tells]).sum() / _ROUGHLY, tells.sum())) if tells.any() else 1.0
