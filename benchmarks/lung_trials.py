"""Presses of real lungs: what one trial tells of the next, as a share of the peak force."""

from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from benchmarks.presses import Curve, Plan, Trial, fit, read_trials, tabulate
from endo_sim_ros.evaluation.measurement import Row

WITHIN = 0.1  # of the greatest force
SEEN = 0.5  # share of the travel of the held-out trial that tells its scale and contact, where the rest is predicted
_EARLIER = 1.0  # thicknesses by which contact may have begun earlier, or later, than in the trial that was fitted


def press_files(folder: Path) -> list[Path]:
    """CSV files of presses in a folder.

    Raises:
        ValueError: If there are none.
    """
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise ValueError(f"{folder}: there are no CSV files of presses; name the folder that has them")
    return files


def lung_rows(folder: Path, plan: Plan = Plan()) -> list[Row]:
    """How many held-out trials are predicted within 10 % of their greatest force, all along, by `fung` fitted to one other trial; and the
    root of the mean square, as `endo-sim bench presses` has it.

    With the scale of that trial, N over thickness; with one that is fitted to the held-out trial, as no trial tells how wide the next piece
    is; and with where its contact begins fitted as well, as the first force that counts is 0.5 N wherever the press stood then. Then
    both by the first half of the travel alone, the other half being predicted. At last the forces of the other trial themselves, as far as
    that goes, and scaled: how much two pieces differ, which no law can better. The thickness of each piece is known to all.

    Raises:
        ValueError: If there are no files, or too few trials in them.
    """
    files = press_files(folder)
    tables, rows = tabulate("fung", plan.poisson_ratio), []
    for file in files:
        trials = read_trials(file, plan)
        curves = [fit(trial, tables)[1] for trial in trials]
        pairs = list(permutations(range(len(trials)), 2))
        told = {
            "scale of the one trial": [_errors(_scaled(curves[i], trials[i]), trials[j]) for i, j in pairs],
            "scale fitted": [_errors(_scaled(curves[i], trials[j]), trials[j]) for i, j in pairs],
            "scale and contact fitted": [_errors(_placed(curves[i], trials[j]), trials[j]) for i, j in pairs],
            "scale and contact of its first half": [_rest(curves[i], trials[j]) for i, j in pairs],
            "no law": [_without_law(trials[i], trials[j]) for i, j in pairs],
            "no law and scale fitted": [_without_law(trials[i], trials[j], _scaled) for i, j in pairs],
        }
        for title, errors in told.items():
            worst, square = np.array([[np.abs(each).max(), np.sqrt((each**2).mean())] for each in errors]).T
            name = f"{file.stem}: held-out trials"
            rows.append(Row(f"{name} within 10 % of their peak, {title}", 100 * float(np.mean(worst <= WITHIN)), "%"))
            rows.append(Row(f"{name}, greatest error over the peak, {title}, median", 100 * float(np.median(worst)), "%"))
            rows.append(Row(f"{name}, root of the mean square over the peak, {title}, median", 100 * float(np.median(square)), "%"))
    return rows


def _errors(curve: Curve, trial: Trial) -> np.ndarray:
    """Errors of a curve in a trial, over the greatest force of that."""
    return (curve(trial.travel) - trial.force) / trial.force.max()


def _scaled(curve: Curve, trial: Trial) -> Curve:
    """The curve with the scale that fits a trial best."""
    shape = curve(trial.travel)
    scale = (shape @ trial.force) / (shape @ shape)
    return lambda at: scale * curve(at)


def _placed(curve: Curve, trial: Trial) -> Curve:
    """The curve with the scale and the place of contact that fit a trial best."""

    def moved(by: float) -> Curve:
        return _scaled(lambda at: curve(at + by), trial)

    found = least_squares(lambda by: _errors(moved(by[0]), trial), [0.0], bounds=([-_EARLIER], [_EARLIER]))
    return moved(found.x[0])


def _rest(curve: Curve, trial: Trial) -> np.ndarray:
    """Errors in the rest of a trial of a curve that is placed by the first part of its travel."""
    early = trial.travel <= trial.travel[0] + SEEN * np.ptp(trial.travel)
    first, rest = (Trial(trial.travel[part], trial.force[part], trial.speed) for part in (early, ~early))
    return (_placed(curve, first)(rest.travel) - rest.force) / trial.force.max()


def _without_law(one: Trial, other: Trial, fitted: Callable[[Curve, Trial], Curve] = lambda curve, trial: curve) -> np.ndarray:
    """Errors of the forces of one trial in another, over the greatest force of that, at the travels that both have."""
    both = other.travel <= one.travel[-1]
    part = Trial(other.travel[both], other.force[both], other.speed)
    return (fitted(lambda at: np.interp(at, one.travel, one.force), part)(part.travel) - part.force) / other.force.max()
