"""The laws of materials on presses of real tissue by a testing machine: `endo-sim bench presses FOLDER`.

Neither the shape of the pieces nor their modulus is known, so that shapes of curves count: how the force grows with the travel of the
press, and whether what one trial tells of that predicts the next. The tissue is a column with free sides. Its thickness is the travel
from the first contact to the greatest force, where it is squeezed flat. Of a trial the part counts before the first rupture, where the
force falls: no elastic law knows of ruptures.
"""

import math
from collections.abc import Callable, Sequence
from itertools import permutations
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.signal import lfilter

from endo_sim_ros.evaluation.measurement import Row, report
from endo_sim_ros.physics import lame_parameters, tissue
from endo_sim_ros.physics.materials import MATERIALS, Stiffening, energy_density

COLUMNS = ("trial", "time_s", "force_N", "position_mm")
LINE = "a line"
RATES = np.geomspace(0.05, 50, 13)  # of stiffening that are tried
STRETCHES = np.linspace(0.03, 1.0, 300)  # at which a law is tabulated
Curve = Callable[[np.ndarray], np.ndarray]
"""Force over its scale, of travels over the thickness of the tissue."""


class Plan(NamedTuple):
    """How the presses are read."""

    contact: float = 0.5  # N, force from which on a trial counts: there the press lies on the tissue
    rupture: float = 0.05  # share of the greatest force so far by which it falls where tissue ruptures
    pressed: float = 0.9  # share of the greatest force of all trials that a trial must reach, so that its thickness is known
    points: int = 200  # of a trial, at even distances
    poisson_ratio: float = tissue("lung").poisson_ratio


class Trial(NamedTuple):
    """The elastic part of a press."""

    travel: np.ndarray  # over the thickness of the tissue
    force: np.ndarray  # N
    speed: float  # of the press, thicknesses a second


def bench_presses(folder: Path, json_file: Path | None = None, plan: Plan = Plan()) -> None:
    """Print how well each law fits the trials in the CSV files of a folder and predicts those it was not fitted to.

    Args:
        folder: Of CSV files with the columns trial, time_s, force_N and position_mm; the trials of a file are of one organ.
        json_file: File for the rows.
        plan: How they are read.

    Raises:
        ValueError: If there are no such files, or too few trials in them.
    """
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise ValueError(f"{folder}: there are no CSV files of presses; name the folder that has them")
    trials = {file.stem: read_trials(file, plan) for file in files}
    laws = {name: tabulate(name, plan.poisson_ratio) for name in MATERIALS}
    report(f"Presses in {folder}", [row for name, each in trials.items() for row in rows_of(name, each, laws)], json_file)


def read_trials(file: Path, plan: Plan) -> list[Trial]:
    """Return the trials of a file that press the tissue flat.

    Raises:
        ValueError: If it is no table of presses, or has less than two such trials.
    """
    try:
        table = np.atleast_1d(np.genfromtxt(file, delimiter=",", names=True, encoding="utf-8"))
    except (ValueError, IndexError) as error:  # of lines that have more or less than the others, or of an empty file
        raise ValueError(f"{file}: not a table: {' '.join(str(error).split())[:200]}") from error
    missing = [column for column in COLUMNS if column not in (table.dtype.names or ())]
    if missing:
        raise ValueError(f"{file}: there is no column {missing[0]}; a table of presses has the columns {', '.join(COLUMNS)}")
    values = np.stack([table[column] for column in COLUMNS], 1)
    bad = np.flatnonzero(~np.isfinite(values).all(1))
    if len(bad):
        raise ValueError(f"{file}: row {bad[0] + 1} has no number for each of {', '.join(COLUMNS)}; correct or remove it")
    names, trials = np.unique(values[:, 0]), []
    for name in names:
        time, force, position = values[values[:, 0] == name, 1:].T[:, np.argsort(values[values[:, 0] == name, 1], kind="stable")]
        first, last = (force >= plan.contact).argmax(), force.argmax()
        thickness, seconds = position[last] - position[first], time[last] - time[first]
        if force[last] < max(plan.pressed * values[:, 2].max(), 2 * plan.contact) or not (thickness > 0 and seconds > 0):
            continue
        force, travel = force[first:], (position[first:] - position[first]) / thickness
        fallen = force < (1 - plan.rupture) * np.maximum.accumulate(force)
        end = force[: fallen.argmax()].argmax() + 1 if fallen.any() else len(force)
        even = np.linspace(0, end - 1, plan.points).round().astype(int)
        trials.append(Trial(travel[even], force[even], 1 / seconds))
    if len(trials) < 2:
        said = f"{len(trials)} of {len(names)} trials press the tissue flat"
        raise ValueError(f"{file}: {said}; two are needed, to predict one by the other")
    return trials


def tabulate(material: str, poisson_ratio: float) -> list[tuple[float, np.ndarray]]:
    """Return a law for each rate of stiffening, NaN if it has none: the force that presses a column over its section and modulus at
    `STRETCHES`. Its sides bear nothing: their stretch has the least energy, found by bisection of the stress."""
    mu, lam = lame_parameters(1.0, poisson_ratio)
    tables = []
    for rate in RATES if MATERIALS[material].tangent(Stiffening(1.0, 2.0)) > 1 else [math.nan]:
        stiffening = Stiffening() if math.isnan(rate) else Stiffening(rate, 1000.0)

        def stress(side: torch.Tensor, stiffening: Stiffening = stiffening) -> torch.Tensor:
            F = torch.stack([torch.from_numpy(STRETCHES), side, side], 1).diag_embed().requires_grad_()
            (P,) = torch.autograd.grad(energy_density(material, F, mu, lam, stiffening).sum(), F)
            return P

        low, high = torch.full((len(STRETCHES),), 0.5, dtype=torch.float64), torch.full((len(STRETCHES),), 4.0, dtype=torch.float64)
        for _ in range(40):
            middle = (low + high) / 2
            outward = stress(middle)[:, 1, 1] > 0
            low, high = torch.where(outward, low, middle), torch.where(outward, middle, high)
        tables.append((rate, -stress((low + high) / 2)[:, 0, 0].numpy()))
    return tables


def fit(trial: Trial, tables: Sequence[tuple[float, np.ndarray]], relaxing: bool = False) -> tuple[list[float], Curve]:
    """Return the rate of stiffening, and where it relaxes the ratio and the time of that (s), which fit a trial best, and the curve.

    Also free: a scale, how much of the thickness the press takes up, and how far it has pressed before the first contact counts.
    """
    best: tuple[float, list[float], Curve] | None = None
    low, high = [0.01, 0.001, 0.0, 0.0], [0.95, 1.0, 20.0, math.log(1000.0)]
    for rate, table in tables:
        for start in ([share, 0.1, 1.0, math.log(10.0)] for share in (0.3, 0.6, 0.9)):
            count = 4 if relaxing else 2

            def residual(free: np.ndarray, table: np.ndarray = table) -> np.ndarray:
                return _residual(press(table, trial.speed, *free)(trial.travel), trial.force)

            found = least_squares(residual, start[:count], bounds=(low[:count], high[:count]))
            if best is None or found.cost < best[0]:
                told = [rate, *found.x[2:3], *np.exp(found.x[3:])]
                best = found.cost, told, press(table, trial.speed, *found.x)
    assert best is not None
    return best[1:]


def press(table: np.ndarray, speed: float, share: float, lead: float, ratio: float = 0.0, log_time: float = 0.0) -> Curve:
    """Return the curve of a law with a Maxwell branch beside it, P + g (P − s q) and dq/dt = (P/s − q)/τ, as `relax` of
    physics/native/node.h has it: along a column that is pressed evenly, for its sides bear nothing."""
    travel = np.linspace(-lead, 1.0, 600)
    stretch = 1 - share * (travel + lead)
    P = np.interp(stretch, STRETCHES, table)
    if ratio:
        kept = math.exp(-(travel[1] - travel[0]) / speed / math.exp(log_time))
        P = P + ratio * (P - stretch * lfilter([1 - kept], [1, -kept], P / stretch))
    return lambda at: np.interp(at, travel, P)


def _residual(shape: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Error of a curve, scaled as fits best, over the greatest force."""
    return (shape * (shape @ force) / (shape @ shape) - force) / force.max()


def rows_of(name: str, trials: Sequence[Trial], laws: dict[str, list[tuple[float, np.ndarray]]]) -> list[Row]:
    """How well each law fits the trials of an organ and, fitted to one of them, predicts the others but for the scale: root of the mean
    square over the greatest force, beside a straight line and, of laws that stiffen, beside neo-Hookean tissue."""
    fits: dict[str, list[Curve]] = {LINE: [np.poly1d(np.polyfit(each.travel, each.force, 1)) for each in trials]}
    peers: dict[str, list[str]] = {LINE: []}
    rows = []
    for law, tables in laws.items():
        stiffens = len(tables) > 1
        for relaxing in (False, True) if stiffens else (False,):
            title = law + ", relaxing" * relaxing
            found = [fit(trial, tables, relaxing) for trial in trials]
            fits[title], peers[title] = [curve for _, curve in found], [LINE, *["neo_hookean"] * stiffens]
            medians = np.median([told for told, _ in found], axis=0) if stiffens else []
            for what, unit, value in zip(("stiffening", "relaxation", "relaxation_time"), ("", "", "s"), medians):
                rows.append(Row(f"{name}: {what} of {title}, median", float(value), unit))
    everyone = range(len(trials))
    for what, pairs in (("fitted", list(zip(everyone, everyone))), ("held out", list(permutations(everyone, 2)))):
        errors = {}
        for law, curves in fits.items():
            residuals = [_residual(curves[i](trials[j].travel), trials[j].force) for i, j in pairs]
            errors[law] = 100 * fmean(math.sqrt((each**2).mean()) for each in residuals)
        for law, error in errors.items():
            compared = [(error / errors[peer], peer) for peer in peers[law]] or [(None, None)]
            rows += [Row(f"{name}: {what}, {law}", error, "%", *each) for each in compared]
    return rows
