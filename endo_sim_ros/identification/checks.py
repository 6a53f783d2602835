"""Data that a model of the tissue cannot explain: each check says in a sentence what was seen."""

import math
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.forward import ForwardModel, Replay, closing_steps, distances_to_skin
from endo_sim_ros.identification.observations import Observations
from endo_sim_ros.identification.solving import LIKELIER
from endo_sim_ros.identification.unknowns import MOST_LOG, Unknowns

_SIGNIFICANT = 5.0  # standard deviations
_AVERAGED = 5  # samples, before a force is said to be there
_GONE, _STILL = 0.25, 6.0  # a grasp has slipped where less than this share of the force is left, of a force this many deviations great
_MOST = math.exp(MOST_LOG)  # times that moduli may be those of physics
_SCANNED = 13  # depths
_ROUGHLY = 1.2  # times as great as by theory chi-square may be: that of 40 presses of tissue as the model has it was 1.08 ± 0.1
_LAG, _UNLIKE = 1.5, 0.3  # steps; less is within what sampling does. Share of what noise does not explain that a lag may leave
_ENOUGH = 25.0  # by which chi-square must fall before another depth or lag is believed
_FAR = 2.0  # standard deviations of where contact begins, beyond which an estimate begins there
_WEIGHED = 2  # times that a scale is fitted, and the covariance that it makes


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
        near: By which forces of the model are to be multiplied, and how far along the line of sight the tool is from where it was thought,
            m, as is likeliest.
        anywhere: The same if it may be anywhere within the scan.
        sight: Mean direction in which the tissue was seen where the tools touch it [3].
        doubts: Sentences that say that the data are not what they are taken for.
        findings: Other ones.
    """

    near: tuple[float, float]
    anywhere: tuple[float, float]
    sight: np.ndarray
    doubts: list[str]
    findings: list[str]


def survey(
    data: list[Observations], model: ForwardModel, unknowns: Unknowns, theta: np.ndarray, covariance: np.ndarray | None = None
) -> Survey:
    """Compare what was measured with what tissue of numbers θ [P + 5], as it was thought to be, would do, its surface at several depths.

    Depth is that along the line of sight: there a wrong scale of the model moves its surface. Samples after which a grasp has slipped are
    marked as not used.

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
    measured, sights = [each.experiment.forces for each in data], [_sight(each.experiment, model) for each in data]
    replays = [
        model.replay(each.experiment, [unknowns.copy(z, offset + depth * sight) for depth in depths], _SCANNED)
        for each, sight in zip(data, sights)
    ]
    predicted = [replay.forces for replay in replays]
    middle, sight = _SCANNED // 2, np.mean(sights, axis=0)
    _check_touch(data, model, predicted, middle)
    if not any(np.isfinite(each).any() for each in measured):
        told = "no force was measured: of stiffness only ratios between places are known, not how stiff the tissue is"
        return Survey((1.0, 0.0), (1.0, 0.0), sight, [], [told])
    _check_felt(data, [each[middle] for each in predicted])
    findings = _find_slips(data, [each[middle] for each in predicted])
    fits = [_fit_scale(data, [each[d] for each in predicted]) for d in range(_SCANNED)]
    best = min(range(_SCANNED), key=lambda d: fits[d][0])
    if drift := _find_drift(data, [each[best] for each in predicted], config):
        return Survey((fits[best][1], 0.0), (fits[best][1], 0.0), sight, drift, findings)
    _check_direction(data, [each[best] for each in predicted], config)
    _check_unit(data, fits[best][1], unknowns, z, covariance is not None)
    tips = config.tip_offset**2 * (np.eye(3) if covariance is None else covariance[unknowns.count :, unknowns.count :][:3, :3])
    stands = float(np.sqrt(sight @ tips @ sight + config.surface_error**2))
    likely = np.abs(depths) <= max(2 * _FAR * stands, depths[-1] - depths[-2])
    doubts = _find_lag(data, [each[likely] for each in predicted], config)
    costs, scales = _weigh_depths(data, replays, depths, sights, config)
    near, anywhere = (_lowest(depths, costs + (depths / sd) ** 2, scales) for sd in (max(stands, 1e-6), config.tool_aside))
    if abs(near[1]) <= _FAR * stands:  # the estimate tells better, as inclusions and other tissue than was thought shift it, too
        near = (float(scales[middle]), 0.0)
    return Survey(near, anywhere, sight, doubts, findings)


def _weigh_depths(
    data: list[Observations], replays: list[Replay], depths: np.ndarray, sights: list[np.ndarray], config: IdentificationConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Minus twice the logarithm of the likelihood of each depth, by the covariance that its forces have, and the scale of forces that is
    best there. Of forces while a jaw is open, as a closed one feels how far it goes, not where it is."""
    costs, scales = np.zeros(len(depths)), np.ones(len(depths))
    told, felt = [], []
    for each, replay in zip(data, replays):
        counts = each.of_forces() & (each.closed_at < 0)
        told.append(each.predicted(replay) * counts)
        felt.append((each.values * counts)[each.used])
    steepness = [np.gradient(each, depths, axis=0) for each in told]
    for d in range(len(depths)):
        scale = _fit_scale(data, [replay.forces[d] for replay in replays])[1]
        for _ in range(_WEIGHED):
            pp = pm = mm = unlikely = 0.0
            for each, force, measured, steep, sight in zip(data, told, felt, steepness, sights):
                by = scale * steep[d]
                own = [by * config.surface_error, scale * config.model_error * force[d]]
                R = each.covariance(by[:, None] * sight, np.column_stack([*own, each.apart]))
                p = force[d][each.used]
                weighted = R.solve(np.column_stack([p, measured]))
                pp, pm, mm = pp + p @ weighted[:, 0], pm + p @ weighted[:, 1], mm + measured @ weighted[:, 1]
                unlikely += R.log_determinant
            scale = max(pm / pp, 1e-6) if pp > 0 else 1.0
        costs[d], scales[d] = mm - 2 * scale * pm + scale**2 * pp + unlikely, scale
    return costs, scales


def _sight(experiment: Experiment, model: ForwardModel) -> np.ndarray:
    """Direction in which the tissue was seen where the tool goes deepest [3]."""
    distances = distances_to_skin(experiment, model.nodes)
    if not np.isfinite(distances).any():
        return np.array([0.0, 0.0, 1.0])
    way = experiment.tips[int(np.argmin(distances))] - (0.0 if model.nodes.seen_from is None else model.nodes.seen_from)
    return way / max(float(np.linalg.norm(way)), 1e-12)


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


def _fit_scale(data: list[Observations], predicted: list[np.ndarray]) -> tuple[float, float]:
    """Chi-square of forces, by their own noise alone, with the scale of the model that is best, and this scale."""
    pp = pm = mm = 0.0
    for each, force in zip(data, predicted):
        usable, noise = _usable(each), each.experiment.force_noise
        measured, force = each.experiment.forces[usable] / noise, force[usable] / noise
        pp, pm, mm = pp + (force**2).sum(), pm + (force * measured).sum(), mm + (measured**2).sum()
    scale = max(pm / pp, 1e-6) if pp > 0 else 1.0
    return mm - 2 * scale * pm + scale**2 * pp, scale


def _lowest(depths: np.ndarray, costs: np.ndarray, scales: np.ndarray) -> tuple[float, float]:
    """Scale and depth of the least cost, by a parabola about it."""
    depth = float(_least(depths, costs))
    return float(np.exp(np.interp(depth, depths, np.log(scales)))), depth


def _least(at: np.ndarray, costs: np.ndarray) -> float:
    """Where the cost is least, by a parabola about it."""
    best = int(np.argmin(costs))
    if not 0 < best < len(at) - 1:
        return float(at[best])
    a, b, c = costs[best - 1 : best + 2]
    bend = a - 2 * b + c
    return float(at[best] + (0.5 * (a - c) / bend * (at[1] - at[0]) if bend > 0 else 0.0))


def _check_direction(data: list[Observations], predicted: list[np.ndarray], config: IdentificationConfig) -> None:
    """Refuse forces that point elsewhere than those of the model, and name the experiments, unless it is all of them."""
    told = [_turned([each], [force], config) for each, force in zip(data, predicted)]
    wrong, whole = [number for number, text in enumerate(told) if text], _turned(data, predicted, config)
    if wrong and (len(wrong) < len(data) or not whole):
        which = f"experiment{'s' * (len(wrong) > 1)} {', '.join(map(str, wrong))}"
        raise IdentificationError(f"{which}: {told[wrong[0]]}, as those of the others are, or leave it out")
    if whole:
        raise IdentificationError(whole)


def _find_drift(data: list[Observations], predicted: list[np.ndarray], config: IdentificationConfig) -> list[str]:
    """A sentence where forces that point elsewhere than those of the model do so as the sensor drifts: where those of the model and a
    straight line in time of each experiment are more probable than those of the model turned by any rotation, by the Bayesian information
    criterion (Schwarz 1978)."""
    if not any(_turned([each], [force], config) for each, force in zip(data, predicted)):
        return []
    H, left, mm, pp, count, most, straight = np.zeros((3, 3)), 0.0, 0.0, 0.0, 0, 0.0, list[Observations]()
    for each, force in zip(data, predicted):
        usable, noise = _usable(each), each.experiment.force_noise
        measured, told = each.experiment.forces[usable] / noise, force[usable] / noise
        line = np.column_stack([np.ones(len(force)), np.linspace(-0.5, 0.5, len(force))])
        basis = np.hstack([told.reshape(-1, 1), np.kron(line[usable], np.eye(3))])
        found = np.linalg.lstsq(basis, measured.ravel(), rcond=None)[0]
        if found[0] <= 0:  # of the opposite sign
            return []
        left += float(((measured.ravel() - basis @ found) ** 2).sum())
        most = max(most, noise * float(np.linalg.norm(found[4:])))
        taken = each.experiment.forces - noise * line @ found[1:].reshape(2, 3)
        straight.append(copy(each))
        straight[-1].experiment = replace(each.experiment, forces=taken)
        H, mm, pp, count = H + measured.T @ told, mm + (measured**2).sum(), pp + (told**2).sum(), count + measured.size
    u, s, vt = np.linalg.svd(H)
    s[2] *= np.sign(np.linalg.det(u @ vt))
    turned = mm - max(s.sum(), 0) ** 2 / max(pp, 1e-12)
    unexplained = max(1.0, min(left, turned) / max(count, 1))
    less = (turned - left) / unexplained - (6 * len(data) - 3) * np.log(count)
    if less <= LIKELIER or any(_turned([each], [force], config) for each, force in zip(straight, predicted)):
        return []
    return [
        f"forces drift by up to {most:.2g} N within an experiment, as those of a sensor that warms: zero it more often, or take off what it"
        " tells while the tool touches nothing"
    ]


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


def _check_unit(data: list[Observations], scale: float, unknowns: Unknowns, z: np.ndarray, on: bool) -> None:
    """Refuse forces that no tissue exerts: published moduli of one organ differ by factors of two to four (`spread`).

    Args:
        data: Of each experiment.
        scale: Times that forces of the model are measured.
        unknowns: Of the model.
        z: Of its tissue [P].
        on: Whether that was estimated before.
    """
    if 1 / _MOST < scale < _MOST:
        return
    most = max(float(np.nanmax(np.linalg.norm(each.experiment.forces, axis=1), initial=0.0)) for each in data)
    modulus = float(np.exp((np.log(unknowns.base) + unknowns.logs(z)).mean()))
    tissue = f"tissue of {modulus:.4g} Pa, as it was estimated before," if on else f"tissue of {modulus:.4g} Pa"
    advice = "begin anew without that estimate" if on else "give physics the modulus of such tissue"
    raise IdentificationError(
        f"forces of up to {most:.3g} N were measured, {scale:.3g} times what {tissue} would exert: check their unit, or {advice}"
    )


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
    best = costs.min(1)
    lag, gain = _least(lags, best), float(best[steps] - best.min()) / max(1.0, best.min() / max(count, 1))
    own = [_least(lags, part[:, depth]) for part in parts]
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
