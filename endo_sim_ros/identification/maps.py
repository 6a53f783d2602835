"""Maps of stiffness: as regions of physics, and the inclusion in them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.identification.ball import COUNT as BALL
from endo_sim_ros.physics import ControlNodes

if TYPE_CHECKING:
    from endo_sim_ros.identification.estimate import Identification

AGREED = 0.5  # probability from which on a place is told
_ALIKE = np.log(1.5)  # of ratios: what differs by less is as all tissue does
_BEYOND = 0.5  # spacings by which the box of all tissue is larger than the control nodes


def paint_as_regions(nodes: ControlNodes, young_modulus: np.ndarray, step: float = 0.2, most: int = 300) -> tuple[str, ...]:
    """Return texts for the option `regions` of physics that paint moduli of control nodes.

    A box paints all tissue with the modulus of most of it; spheres paint the rest. Moduli are rounded to levels of their logarithm,
    `step` apart. Each sphere is as large as it can be without other levels in it, so that their order does not matter.

    Args:
        nodes: At rest.
        young_modulus: Of each [M], Pa.
        step: Between the levels; where there would be more than `most` regions, it is made wider.
        most: Regions.
    """
    rest, logs = nodes.rest.astype(np.float64), np.log(young_modulus)
    corners = np.concatenate([rest.min(0) - _BEYOND * nodes.spacing, rest.max(0) + _BEYOND * nodes.spacing])
    while True:
        levels = np.round((logs - np.median(logs)) / step).astype(int)
        spheres = _spheres(rest, levels, nodes.spacing, most)
        if spheres is not None:
            break
        step *= 1.25

    def modulus(level: int) -> str:
        return f"young_modulus={np.exp(logs[levels == level].mean() if (levels == level).any() else np.median(logs)):.6g}"

    box = f"box {' '.join(f'{x:.6g}' for x in corners)} {modulus(0)}"
    return (box, *(f"sphere {' '.join(f'{x:.6g}' for x in centre)} {radius:.6g} {modulus(level)}" for centre, radius, level in spheres))


def _spheres(rest: np.ndarray, levels: np.ndarray, spacing: float, most: int) -> list[tuple[np.ndarray, float, int]] | None:
    """Spheres about control nodes that cover all whose level is not 0, none of another level; None if there are too many."""
    left, found = levels != 0, []
    radii = np.zeros(len(rest))
    for level in np.unique(levels[left]):
        members = np.flatnonzero(levels == level)
        others = rest[levels != level]
        nearest = KDTree(others).query(rest[members])[0] if len(others) else np.full(len(members), np.inf)
        radii[members] = np.minimum(0.5 * nearest + 0.5 * np.minimum(nearest, spacing), 0.95 * nearest)
        radii[members] = np.minimum(radii[members], np.linalg.norm(np.ptp(rest, axis=0)))
    tree = KDTree(rest)
    covered = {int(node): tree.query_ball_point(rest[node], radii[node]) for node in np.flatnonzero(left)}
    while left.any():
        if len(found) >= most - 1:
            return None
        node = max(covered, key=lambda each: int(left[covered[each]].sum()))
        left[covered[node]] = False
        found.append((rest[node], float(radii[node]), int(levels[node])))
    return found


@dataclass(frozen=True)
class Inclusion:
    """A place that is stiffer, or softer, than what surrounds it.

    Args:
        centre: Where its middle is [3], m, world.
        deviation: Standard deviation of its coordinates [3], m, if the stiffest place is this one.
        sure: Probability that it is: share of draws from the posterior whose stiffest place is within two lengths of the field of it.
        ratio: Of its greatest modulus, or least, to that of the tissue around; median.
        low: Lower end of the interval of that.
        high: Upper end.
        radius: Of a ball as large as what is more than half as stiff, in logarithms, m.
    """

    centre: np.ndarray
    deviation: np.ndarray
    sure: float
    ratio: float
    low: float
    high: float
    radius: float


def find_inclusion(found: "Identification", samples: int = 200, seed: int = 0, softer: bool = False) -> Inclusion:
    """The stiffest place of an estimated field, and how well it is known: by draws of fields from the posterior.

    Of each field the middle of what exceeds half of its greatest excess over the median, in logarithms, near where that is. How great the
    excess is is uncertain by `smooth_error` as well.

    Args:
        found: The estimate, of a field.
        samples: Draws.
        seed: Of these.
        softer: The softest place of a field instead.

    Raises:
        ValueError: If no field was estimated.
    """
    unknowns = found.parameters
    if unknowns.ball is None and not len(unknowns.centres):
        raise ValueError("an inclusion is looked for in a field, or as one; estimate with stiffness = inclusion, or field")
    rng = np.random.default_rng(seed)
    fields = slice(0, unknowns.count)
    factor = np.linalg.cholesky(found.covariance[fields, fields] + 1e-12 * np.eye(unknowns.count))
    draws = found.mean[fields] + rng.standard_normal((samples, unknowns.count)) @ factor.T
    if unknowns.ball is not None:
        (centre, radius, ratio), *others = (unknowns.ball.shape(each[1 : 1 + BALL]) for each in (found.mean[fields], *draws))
        tail = (1 - found.level) / 2
        low, high = np.exp(np.quantile([each[2] for each in others], [tail, 1 - tail]))
        deviation = np.sqrt(((np.array([each[0] for each in others]) - centre) ** 2).mean(0))
        return Inclusion(centre, deviation, 1.0 if found.sure is None else found.sure, np.exp(ratio), float(low), float(high), radius)
    within = ~unknowns.nodes.pinned & (unknowns.residual < 0.5 * unknowns.config.field_spread**2)
    rest, volumes = unknowns.nodes.rest[within].astype(np.float64), unknowns.nodes.volumes[within].astype(np.float64)
    logs = (np.log(unknowns.base) + np.concatenate([found.mean[fields][None], draws]) @ unknowns.matrix.T)[:, within]
    length, sign = 2 * unknowns.config.field_length, -1 if softer else 1
    centres, excesses, radii = zip(*(_middle(sign * each, rest, volumes, length) for each in logs))
    share = 1 + unknowns.config.smooth_error * np.append(0, rng.standard_normal(samples))
    ratios = np.exp(sign * np.maximum(share, 0) * excesses)
    off = np.array(centres[1:]) - centres[0]
    here = (off**2).sum(1) <= length**2
    tail = (1 - found.level) / 2
    low, high = np.quantile(np.array(ratios[1:])[here] if here.any() else ratios[1:], [tail, 1 - tail])
    deviation = np.sqrt((off[here] ** 2).mean(0)) if here.any() else np.full(3, np.inf)
    return Inclusion(centres[0], deviation, float(here.mean()), float(ratios[0]), float(low), float(high), radii[0])


def different_places(found: "Identification") -> list[str]:
    """Where a field is stiffest and where it is softest, in a sentence each, what differs most first; places that draws from the posterior
    do not agree on are left out."""
    told: list[str] = []
    skin = KDTree(found.nodes.rest[found.nodes.is_skin].astype(np.float64))
    for name, place in _places(found):
        (x, y, z), depth, off = place.centre, float(skin.query(place.centre)[0]), float(np.linalg.norm(place.deviation))
        text = (
            f"{name} is at {x:.4f} {y:.4f} {z:.4f} m, {1e3 * depth:.0f} mm below the skin, give or take {1e3 * off:.0f} mm, with a"
            f" probability of {place.sure:.2f}; it is about {2e3 * place.radius:.0f} mm wide and {place.ratio:.3g} times as stiff as most"
            f" tissue ({100 * found.level:.0f} %: {place.low:.3g} to {place.high:.3g})"
        )
        told.append(f"{text}; a smooth field draws such a place also beside one that differs more" if told else text)
    return told


def seen_from(found: "Identification", camera: Camera) -> list[str]:
    """Where a camera sees these places, or the inclusion, in a sentence each."""
    told = []
    for name, place in _places(found):
        x, y, z = camera.viewmat[:3] @ np.append(place.centre, 1.0)
        across, along = f"{1e3 * abs(x):.0f} mm {'right' if x >= 0 else 'left'}", f"{1e3 * abs(y):.0f} mm {'down' if y >= 0 else 'up'}"
        told.append(f"{name} is {across}, {along} and {1e3 * z:.0f} mm ahead of the camera of the picture")
    return told


def _places(found: "Identification") -> list[tuple[str, Inclusion]]:
    """What is likely to be there and differs from most tissue, what differs most first."""
    if found.parameters.ball is not None:
        places = [("the middle of the inclusion", find_inclusion(found))] * found.tells_inclusion
    elif found.even is not None and found.even.differs and not found.doubts:
        places = [(f"the {('stiffest', 'softest')[softer]} place", find_inclusion(found, softer=softer)) for softer in (False, True)]
    else:
        places = []
    likely = [each for each in places if each[1].sure >= AGREED and abs(np.log(each[1].ratio)) >= _ALIKE]
    return sorted(likely, key=lambda each: -abs(np.log(each[1].ratio)))


def _middle(logs: np.ndarray, rest: np.ndarray, volumes: np.ndarray, length: float) -> tuple[np.ndarray, float, float]:
    """Middle of the stiffest place [3], the logarithm of its ratio, and its radius."""
    excess = logs - np.median(logs)
    peak = int(np.argmax(excess))
    near = ((rest - rest[peak]) ** 2).sum(1) <= length**2
    weight = np.where(near, np.maximum(excess - excess[peak] / 2, 0), 0) * volumes
    volume = volumes[near & (excess > excess[peak] / 2)].sum()
    return (weight[:, None] * rest).sum(0) / weight.sum(), float(excess[peak]), float((0.75 * volume / np.pi) ** (1 / 3))
