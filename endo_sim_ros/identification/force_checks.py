"""What is wrong with the forces of a recording: told by comparing them with how far the tool goes into the tissue."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.identification.touches import Timeline

_CLEAR = 5.0  # standard deviations of its noise that a force must have to tell something
_DEEP = 0.001  # m that a tool must have gone into tissue, or pulled it, to know where the force points
_AGAINST, _ASKEW = 120.0, 60.0  # degrees between a force and where it should point: friction and slopes make less than 45
_FEW = 5  # steps; fewer tell nothing
_RISING, _LEVEL = 4, 4  # samples that must be on a line, and on a plateau
_BEYOND = 3.0  # standard deviations by which no mean of the `_LEVEL` greatest forces is beyond a plateau: noise makes it one to two
# By which chi-square is less with a plateau: of an experiment, to count, and of all, to be believed. Noise takes as much away once in 10^5
# times (23, of two numbers), at the likeliest of some 200 beginnings (2 ln 200), and the noise is only about right (1.2 times).
_KINKED, _ENOUGH = 9.0, 40.0
_FLAT, _STEEP = 0.3, 0.5  # slopes of a plateau, as shares of that before it: beyond the first forces grow, and the other must be ruled out
_ODD = 0.01  # noise makes what a clipped sensor tells, which is one force, scatter by more than it does more rarely than that
_NOISE_OF_MEDIAN = 1.4826  # standard deviations a median absolute deviation is
_FAR = 0.005  # m, beyond clearance, from tissue where forces begin


def overlap(line: Timeline, first_ns: int, last_ns: int, delay: float) -> str:
    """A sentence if forces from a first to a last stamp do not belong to the poses, else an empty one."""
    shift = round(delay * 1e9)
    first, last = first_ns - shift, last_ns - shift
    if last >= line.times[0] and first <= line.times[-1]:
        return ""
    seconds = (first - line.times[0]) * 1e-9
    return (
        f"forces begin {abs(seconds):.3g} s {'after' if seconds > 0 else 'before'} the poses and share no moment with them: their clocks"
        " differ; record with one clock, or give the difference as force_delay"
    )


def check_direction(name: str, line: Timeline, surface: Surface, noise: float) -> str:
    """A sentence if forces are askew, else an empty one.

    Args:
        name: Of the arm.
        line: The tool.
        surface: The tissue at rest.
        noise: Standard deviation of a component of the force, N.

    Raises:
        SequenceError: If they point into the tissue.
    """
    size = np.linalg.norm(line.forces, axis=1)
    pressed = ~line.closed & (line.gaps < -_DEEP)
    drawn = line.closed & (np.linalg.norm(line.pulled, axis=1) > _DEEP) & (line.gaps > 0)  # else the tool presses, too
    tells = line.present & line.measured & (size > _CLEAR * noise) & (pressed | drawn)
    if tells.sum() < _FEW:
        return ""
    expected = -line.pulled[tells]
    presses = pressed[tells]
    expected[presses] = surface.outwards(line.tips[tells][presses])
    cosines = (expected * line.forces[tells]).sum(1) / (np.linalg.norm(expected, axis=1) * size[tells])
    angle = float(np.median(np.degrees(np.arccos(cosines.clip(-1, 1)))))
    what = f"{name}/body/measured_cf: forces of up to {size[tells].max():.2g} N"
    if angle > _AGAINST:
        raise SequenceError(
            f"{what} point along the motion of a tool that presses or pulls, {angle:.0f} degrees from where tissue pushes it; the topic"
            " has what tissue exerts on the tool: turn the sign round, or check the frame in the header"
        )
    if angle > _ASKEW:
        return f"{what} are {angle:.0f} degrees from where tissue should push the tool; are they in another frame than the header says?"
    return ""


def distance_at_onset(line: Timeline, noise: float) -> tuple[float, float] | None:
    """How far the tool is from the tissue where forces begin, m, and the greatest force then, N; None where none begin."""
    size = np.linalg.norm(line.forces, axis=1)
    clear = np.nan_to_num(size) > _CLEAR * noise
    begins = np.flatnonzero(clear[1:] & ~clear[:-1]) + 1
    begins = begins[line.present[begins]]
    return (float(np.median(line.gaps[begins])), float(np.nanmax(size))) if len(begins) else None


def check_place(name: str, line: Timeline, noise: float, clearance: float) -> str:
    """A sentence if forces begin where there is no tissue, else an empty one."""
    found = distance_at_onset(line, noise)
    if found is None or abs(found[0]) <= clearance + _FAR:
        return ""
    gap, force = found
    where = f"{1e3 * gap:.0f} mm in front of" if gap > 0 else f"{-1e3 * gap:.0f} mm below"
    return (
        f"{name}: forces of up to {force:.2g} N begin where the tool is {where} the surface of the model: are model and recording of one"
        " scale and in one frame, and is contact_radius that of the tool?"
    )


def check_clipped(forces: list[np.ndarray], predicted: list[np.ndarray], noises: list[float]) -> list[str]:
    """A sentence if forces stop growing while the tool goes on into the tissue, else none.

    While the tool goes in, measured forces along those of the model are compared with these: on a line, and on a line that becomes a
    plateau. Lines have an intercept, as contact may begin elsewhere. A sensor that is clipped measures no more in any experiment.

    Args:
        forces: Of each experiment [T, 3], N; NaN where they do not count.
        predicted: Those of the model [T, 3], of any modulus.
        noises: Standard deviation of a component of each.
    """
    touches = [_in_contact(force, model) for force, model in zip(forces, predicted)]
    greatest = max((float(np.sort(measured)[-_LEVEL:].mean()) for measured, _ in touches if len(measured)), default=0.0)
    found = []
    for (measured, expected), noise in zip(touches, noises):
        kink = _kink(measured / noise, expected)
        if kink is not None and kink.gain > _KINKED and kink.even > _ODD and greatest < (kink.level + _BEYOND) * noise:
            found.append((kink, noise))
    if not found:
        return []
    xy, xx = (sum(getattr(kink, name) for kink, _ in found) for name in ("xy", "xx"))
    if sum(kink.gain for kink, _ in found) < _ENOUGH or xy > _FLAT * xx or xy + 2 * np.sqrt(xx) > _STEEP * xx:
        return []
    low, high = (find(kink.level * noise for kink, noise in found) for find in (min, max))
    level = f"{low:.2g}" if f"{low:.2g}" == f"{high:.2g}" else f"{low:.2g} to {high:.2g}"
    return [f"forces stop at {level} N while the tool goes deeper, where those of the model go on growing: is the sensor clipped?"]


def _in_contact(force: np.ndarray, model: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measured forces and those of the model [n], along these, N, while the tool is in the tissue about the greatest of these."""
    size = np.linalg.norm(model, axis=1)
    top, free = int(size.argmax()), np.flatnonzero(size == 0)
    begin, end = free[free < top].max(initial=-1) + 1, free[free > top].min(initial=len(size))
    steps = begin + np.flatnonzero(np.isfinite(force[begin:end]).all(1))
    return (force[steps] * model[steps]).sum(1) / np.maximum(size[steps], 1e-12), size[steps]


@dataclass(frozen=True)
class _Kink:
    """Forces on a line that becomes a plateau; all in standard deviations of noise, which are those of the model on that line, too."""

    gain: float  # by which chi-square is less than that of a line, over what neither explains
    level: float  # of the plateau
    even: float  # probability that noise makes forces on it scatter as much, or more
    xy: float  # sums over the plateau of products of forces of the model and measured ones, less their means
    xx: float


def _kink(measured: np.ndarray, model: np.ndarray) -> _Kink | None:
    """The likeliest plateau, if any: of the greatest forces of the model."""
    order = np.argsort(model, kind="stable")
    measured, model = measured[order], model[order]

    def line(until: int) -> tuple[float, float]:
        basis = np.column_stack([model[:until], np.ones(until)])
        best = np.linalg.lstsq(basis, measured[:until], rcond=None)[0]
        return float(best[0]), float(((measured[:until] - basis @ best) ** 2).sum())

    count, plateaus = len(measured), list[tuple[float, int, float]]()
    for until in range(_RISING, count - _LEVEL + 1):
        slope, cost = line(until)
        if slope > 0:
            plateaus.append((cost + float(((measured[until:] - measured[until:].mean()) ** 2).sum()), until, slope))
    if not plateaus:
        return None
    cost, until, slope = min(plateaus)
    level = float(measured[until:].mean())
    x = slope * (model[until:] - model[until:].mean())
    basis = np.column_stack([model[:until], np.ones(until)])
    left = measured.copy()
    left[:until] -= basis @ np.linalg.lstsq(basis, measured[:until], rcond=None)[0]
    left[until:] -= level
    left = left[np.argsort(order)]
    lasts = float((left[1:] * left[:-1]).sum() / max((left**2).sum(), 1e-12))
    lasts = (1 + lasts) / (1 - lasts) if lasts > 0 else 1.0
    gain = (line(count)[1] - cost) / max(1.0, cost / count) / lasts
    scatter = (_NOISE_OF_MEDIAN * float(np.median(np.abs(measured[until:] - np.median(measured[until:]))))) ** 2  # its beginning may be off
    even = float(chi2.sf(scatter * (count - until - 1), count - until - 1))
    return _Kink(gain, level, even, float(x @ (measured[until:] - level)), float(x @ x))
