"""Data that a model of the tissue cannot explain: each check says in a sentence what was seen."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.forward import ForwardModel, distances_to_skin
from endo_sim_ros.identification.observations import Observations
from endo_sim_ros.identification.unknowns import Unknowns

_SIGNIFICANT = 5.0  # standard deviations
_AVERAGED = 5  # samples, before a force is said to be there
_GONE, _STILL = 0.25, 6.0  # a grasp has slipped where less than this share of the force is left, of a force this many deviations great
_SCANNED = 13  # depths
_ROUGHLY = 1.2  # times as great as by theory chi-square may be: that of 40 presses of tissue as the model has it was 1.08 ± 0.1
_LAG = 1.5  # steps; less is within what sampling does
_ENOUGH = 25.0  # by which chi-square must fall before another depth or lag is believed


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
        findings: Sentences.
    """

    scale: float
    findings: list[str]


def survey(data: list[Observations], model: ForwardModel, unknowns: Unknowns, config: IdentificationConfig, z: np.ndarray) -> Survey:
    """Compare what was measured with what tissue of unknowns z [P], as it was thought to be, would do, its surface at several depths.

    Samples after which a grasp has slipped are marked as not used.

    Raises:
        IdentificationError: If the tool never touches, or forces are in another frame.
    """
    depths = np.linspace(-config.depth_scan, config.depth_scan, _SCANNED)
    predicted: list[np.ndarray] = []
    measured = [each.experiment.forces for each in data]
    axes = [_axis(each.experiment, model) for each in data]
    for each, axis in zip(data, axes):
        replay = model.replay(each.experiment, [unknowns.copy(z, depth * axis) for depth in depths], _SCANNED)
        predicted.append(replay.forces)
    middle = _SCANNED // 2
    _check_touch(data, model, predicted, middle)
    if not any(np.isfinite(each).any() for each in measured):
        return Survey(1.0, ["no force was measured: of stiffness only ratios between places are known, not how stiff the tissue is"])
    _check_felt(data, [each[middle] for each in predicted])
    costs, scales = zip(*(_fit_scale(data, [each[d] for each in predicted]) for d in range(_SCANNED)))
    best = int(np.argmin(costs))
    chosen = [each[best] for each in predicted]
    _check_direction(data, chosen, config)
    for number, (each, force) in enumerate(zip(data, chosen)):
        _check_direction([each], [force], config, f"experiment {number}: ", by_sign=True)
    findings = [*_find_slips(data, chosen, scales[best]), *_find_lag(data, chosen, config)]
    costs, scales = zip(*(_fit_scale(data, [each[d] for each in predicted]) for d in range(_SCANNED)))
    depth, gain = _lowest(depths, np.array(costs), middle, sum(int(each.of_forces().sum()) for each in data))
    if abs(depth) > 4 * np.hypot(config.tip_offset, np.mean([each.experiment.tip_noise for each in data]) / 2) and gain > _ENOUGH:
        where = "deeper than" if depth < 0 else "before"
        findings.append(
            f"contact begins about {1000 * abs(depth):.1f} mm {where} the surface of the model: check its scale, and where the tool stands"
            " to it"
        )
    return Survey(float(np.clip(scales[int(np.argmin(costs))], 0.05, 20.0)), findings)


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
            " was measured; set forces that were not measured to NaN, or give softer tissue"
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
    """Chi-square of forces with the scale of the model that is best, and this scale."""
    pp = pm = mm = 0.0
    for each, force in zip(data, predicted):
        usable, noise = _usable(each), each.experiment.force_noise
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


def _check_direction(
    data: list[Observations], predicted: list[np.ndarray], config: IdentificationConfig, where: str = "", by_sign: bool = False
) -> None:
    """Refuse forces that point elsewhere than those of the model, or, where one press may turn them, only those of the opposite sign."""
    H, weight = np.zeros((3, 3)), 0.0
    for each, force in zip(data, predicted):
        measured = np.where(_usable(each)[:, None], np.nan_to_num(each.experiment.forces), 0)
        H += measured.T @ force
        weight += (force[_usable(each)] ** 2).sum() * each.experiment.force_noise**2
    if np.sqrt((H**2).sum()) < _SIGNIFICANT * np.sqrt(weight) or not weight:
        return
    # Measured and predicted directions that belong together most: the first pair of singular vectors.
    u, s, vt = np.linalg.svd(H)
    a, b = u[:, 0], vt[0]
    angle = float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))
    if angle > 180 - config.most_turned:
        raise IdentificationError(
            f"{where}measured forces point against those that the tissue would exert on the tool: they have the opposite sign; give what"
            " the tissue exerts on the tool, in the world's axes"
        )
    if angle > config.most_turned and not by_sign:
        raise IdentificationError(
            f"measured forces are turned by {angle:.0f}° from those that the tissue would exert on the tool (they point along"
            f" {np.round(a * np.sign(s[0]), 2).tolist()}, expected {np.round(b, 2).tolist()}): they are in another frame; give them in the"
            " world's axes"
        )


def _find_slips(data: list[Observations], predicted: list[np.ndarray], scale: float) -> list[str]:
    """Mark samples after which a closed jaw has lost its tissue as not used, and tell them."""
    findings = []
    for number, (each, force) in enumerate(zip(data, predicted)):
        experiment = each.experiment
        closed = np.asarray(experiment.closed, bool) & np.asarray(experiment.present, bool)
        if not closed.any() or not np.isfinite(experiment.forces).any():
            continue
        expected = scale * np.linalg.norm(force, axis=1)
        unit = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
        measured = np.asarray(np.isfinite(experiment.forces).all(1))
        along = _moving_mean(np.where(measured, np.einsum("ni,ni->n", experiment.forces, unit), 0.0))
        along /= np.maximum(_moving_mean(measured.astype(float)), 1 / _AVERAGED)
        strong = closed & measured & (expected > _STILL * experiment.force_noise)
        held = strong & (along > 0.5 * expected)
        gone = strong & (along < _GONE * expected)
        if not held.any():
            continue
        for begin in np.flatnonzero(gone):
            opens = np.flatnonzero(~closed[begin:])
            end = begin + int(opens[0]) if len(opens) else len(closed)
            rest = strong[begin:end]
            if held[:begin].any() and rest.sum() >= _AVERAGED and (gone[begin:end] & rest).sum() > 0.8 * rest.sum():
                left, had = float(along[begin:end][rest].mean()), float(expected[begin:end][rest].mean())
                begin = max(begin - _AVERAGED // 2, 0)
                left_out = (each.steps >= begin) & (each.steps < end)
                each.used &= ~left_out
                findings.append(
                    f"the grasp slipped {begin * experiment.step_duration:.2f} s after the beginning of experiment {number}: the force"
                    f" fell to {max(left, 0.0):.2f} N where the model has {had:.2f} N; the {end - begin} steps until the jaw opens are"
                    " left out"
                )
                break
    return findings


def _find_lag(data: list[Observations], predicted: list[np.ndarray], config: IdentificationConfig) -> list[str]:
    """Tell by how long forces come after poses, where a shift explains them much better; and whether that grows."""
    steps = int(config.most_lag / min(each.experiment.step_duration for each in data))
    if steps < 1:
        return []
    lags = np.arange(-steps, steps + 1)

    def best(begin: float, end: float) -> tuple[float, float]:
        costs, count = np.zeros(len(lags)), 0
        for number, lag in enumerate(lags):
            pp = pm = mm = 0.0
            for each, force in zip(data, predicted):
                usable = _usable(each)
                moved = np.zeros_like(force)  # before and after the tool is away, and feels nothing
                source = np.arange(len(force)) - lag
                inside = (source >= 0) & (source < len(force))
                moved[inside] = force[source[inside]]
                chosen = np.zeros(len(force), bool)
                where = np.flatnonzero(usable)
                chosen[where[int(begin * len(where)) : int(end * len(where))]] = True
                noise = each.experiment.force_noise
                a, b = each.experiment.forces[chosen] / noise, moved[chosen] / noise
                pp, pm, mm = pp + (b**2).sum(), pm + (a * b).sum(), mm + (a**2).sum()
                count = count + a.size if lag == 0 else count
            scale = max(pm / pp, 0) if pp > 0 else 0.0
            costs[number] = mm - 2 * scale * pm + scale**2 * pp
        return _lowest(lags.astype(float), costs, steps, count)

    duration = data[0].experiment.step_duration
    lag, gain = best(0, 1)
    (early, gain_early), (late, gain_late) = best(0, 0.5), best(0.5, 1)
    # A drift moves both halves of every experiment apart; one that only one of them tells may be what tissue does.
    if abs(lag) >= _LAG and gain > _ENOUGH:
        after = "after" if lag > 0 else "before"
        drift = ""
        if len(data) == 1 and min(gain_early, gain_late) > _ENOUGH and abs(late - early) >= _LAG:
            drift = f", {early * duration:.2f} s in its first half and {late * duration:.2f} s in its second: a clock drifts"
        return [f"measured forces come about {abs(lag) * duration:.2f} s {after} the poses{drift}; align the clocks and estimate again"]
    return []


def judge_residuals(chi_square: float, count: int, config: IdentificationConfig) -> tuple[float, list[str]]:
    """By what factor the variance of residuals is greater than noise explains, 1 where it may be noise; and a sentence about it.

    Args:
        chi_square: Of the residuals at the estimate.
        count: Of residuals, less the unknowns that they determine.
        config: How rare is too rare.
    """
    if count < 1 or chi2.sf(chi_square / _ROUGHLY, count) > config.doubt:
        return 1.0, []
    factor = chi_square / count
    return factor, [
        f"the model does not explain the data: residuals are {np.sqrt(factor):.1f} times as great as their noise (chi-square"
        f" {chi_square:.0f} for {count:.0f}); intervals are as much wider, and may still not hold the truth"
    ]
