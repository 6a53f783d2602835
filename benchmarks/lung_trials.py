"""Presses of real lungs: what one trial tells of the next, as a share of the peak force."""

from itertools import permutations
from pathlib import Path

import numpy as np

from benchmarks.presses import Curve, Plan, Trial, fit, read_trials, tabulate
from endo_sim_ros.evaluation.measurement import Row

WITHIN = 0.1  # of the greatest force


def lung_rows(folder: Path, plan: Plan = Plan()) -> list[Row]:
    """How many held-out trials are predicted within 10 % of their greatest force, all along, by `fung` fitted to one other trial.

    With the scale of that trial, N over thickness; and with one that is fitted to the trial, as no trial tells how wide the next piece is.

    Raises:
        ValueError: If there are no files, or too few trials in them.
    """
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise ValueError(f"{folder}: there are no CSV files of presses; name the folder that has them")
    tables, rows = tabulate("fung", plan.poisson_ratio), []
    for file in files:
        trials = read_trials(file, plan)
        curves = [fit(trial, tables)[1] for trial in trials]
        for title, scaled in (("scale of the one trial", False), ("scale fitted", True)):
            worst = np.array([_worst(curves[i], trials[i], trials[j], scaled) for i, j in permutations(range(len(trials)), 2)])
            name = f"{file.stem}: held-out trials"
            rows.append(Row(f"{name} within 10 % of their peak, {title}", 100 * float(np.mean(worst <= WITHIN)), "%"))
            rows.append(Row(f"{name}, greatest error over the peak, {title}, median", 100 * float(np.median(worst)), "%"))
    return rows


def _worst(curve: Curve, told: Trial, other: Trial, scaled: bool) -> float:
    """Greatest error of a curve that was fitted to one trial, in another one, over the greatest force of that."""
    by = other if scaled else told
    shape = curve(by.travel)
    scale = (shape @ by.force) / (shape @ shape)
    return float(np.abs(scale * curve(other.travel) - other.force).max() / other.force.max())
