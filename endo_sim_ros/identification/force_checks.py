"""What is wrong with the forces of a recording: told by comparing them with how far the tool goes into the tissue."""

import numpy as np

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.identification.touches import Timeline

_CLEAR = 5.0  # standard deviations of its noise that a force must have to tell something
_DEEP = 0.001  # m that a tool must have gone into tissue, or pulled it, to know where the force points
_AGAINST, _ASKEW = 120.0, 60.0  # degrees between a force and where it should point: friction and slopes make less than 45
_FEW = 5  # steps; fewer tell nothing
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
        " scale and in one frame, are forces and poses of one clock, and is contact_radius that of the tool?"
    )
