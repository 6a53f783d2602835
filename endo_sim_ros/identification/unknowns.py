"""What is unknown of tissue, and what was known of it before any data.

Each unknown is a number z with a normal prior of mean 0 and standard deviation 1. A transform makes of it what physics takes: moduli
and rates are exp(mean + sd z), bounded ones a logistic function of that. A field is one number for each of its centres; the logarithm
of the modulus between them is what a Gaussian process expects there.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky
from scipy.spatial import KDTree

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.identification.ball import COUNT as BALL, PLACE, Ball, near_touches
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.forward import Copy
from endo_sim_ros.physics import ControlNodes, PhysicsConfig, sample_farthest
from endo_sim_ros.physics.batch import tissue_properties
from endo_sim_ros.physics.control_nodes import held_sets
from endo_sim_ros.physics.regions import read_regions

MODULUS = "young_modulus"
_JITTER = 1e-6  # added to the covariance of a field, whose centres may lie close together
MOST_LOG = math.log(50.0)  # of factors on moduli; the substeps grow with the root of these


@dataclass(frozen=True)
class Prior:
    """What is known of a number of physics before any data.

    Args:
        sd: Standard deviation of its transform; the mean is that of the value physics has.
        high: Upper bound of a logistic transform, whose lower one is 0; 0 = the transform is the logarithm.
        unit: Of the number.
    """

    sd: float
    high: float = 0.0
    unit: str = ""


PRIORS: dict[str, Prior] = {
    # Inflated lung 0.34 (Birzle et al. 2019) to wet tissue, which keeps its volume (Mancia et al. 2019): 0.3 to 0.49.
    "poisson_ratio": Prior(0.7, high=0.495),
    "damping": Prior(1.0, unit="1/s"),  # numerical: rates of 20 to 150/s leave the motion of tissue at steps of a video as it is
    "friction": Prior(0.6),  # wet instruments have 0.05 to 0.3 (docs/physics.md)
    "relaxation": Prior(0.8),  # lung 0.22 (Fredberg and Stamenovic 1989) to liver 1.24 (Mattei et al. 2014)
    "relaxation_time": Prior(0.8, unit="s"),  # lung and liver 0.6 to 1.1 s at these rates (Mattei et al. 2014)
    "stiffening": Prior(1.2),  # lung 0.5 (Birzle et al. 2019) to liver 9.2 (Mancia et al. 2019)
}
_HOLDS = ("hold_back", "hold_rim")
_HOLD_PRIOR = Prior(2.0, high=1.0)  # nothing is known: from a thousandth of what holds it to all of it
_HELD_AT_FIRST = 0.5  # a logit of 0, in the middle of its prior


@dataclass(frozen=True)
class Reported:
    """A number that the result tells: a transform of a·z + b.

    Args:
        name: Of it.
        unit: Of it.
        row: a [P].
        mean: b.
        high: As `Prior.high`.
    """

    name: str
    unit: str
    row: np.ndarray
    mean: float
    high: float = 0.0

    @property
    def is_modulus(self) -> bool:
        """Whether it is a stiffness, of which only ratios are known where no force was measured."""
        return self.name.startswith(MODULUS)

    def value(self, transformed: np.ndarray | float) -> np.ndarray | float:
        """The number itself."""
        return untransform(transformed, self.high)


def transform(value: float, high: float) -> float:
    """Logarithm, or logit of the part of `high` that a value is."""
    share = value / high if high else 0.0
    return math.log(share / (1 - share)) if high else math.log(value)


def untransform(transformed: np.ndarray | float, high: float) -> np.ndarray | float:
    """The inverse of `transform`."""
    return high / (1 + np.exp(-np.asarray(transformed))) if high else np.exp(transformed)


class Unknowns:
    """All unknowns of a tissue as P numbers with standard normal priors.

    Args:
        nodes: At rest.
        physics: The tissue as far as it is known: its values are the means of the priors.
        config: What is unknown.
        touched: Places where tools were [K, 3], m, world: a field reaches around them.

    Raises:
        ConfigError: If an unknown does not exist, or nothing can vary.
    """

    def __init__(self, nodes: ControlNodes, physics: PhysicsConfig, config: IdentificationConfig, touched: np.ndarray):
        self.nodes, self.physics, self.config = nodes, physics, config
        self.base = np.asarray(tissue_properties(nodes, physics).young_modulus)
        self._factor = np.zeros((0, 0))  # of the covariance of a field at its centres
        self.ball = Ball(nodes, config, touched) if config.stiffness == "inclusion" else None
        matrix, self.labels, self.centres, self.residual = self._stiffness(touched)
        self.stiffness_count = matrix.shape[1]
        names = list(dict.fromkeys(config.unknowns))
        self._others = [(name, self._prior(name)) for name in names if name]
        self.count = self.stiffness_count + len(self._others)
        self.scale = np.zeros(self.count)  # direction in which all moduli are multiplied by e
        self.scale[: self.stiffness_count if config.stiffness == "regions" else 1] = 1 / config.spread
        self.matrix = np.concatenate([matrix, np.zeros((len(nodes), len(self._others)))], 1)  # the linear part of `logs` [M, P]
        self._back, self._rim = held_sets(nodes)
        for name, pinned in (("hold_back", self._back), ("hold_rim", self._rim)):
            if name in names and not pinned.any():
                raise ConfigError(f"unknowns: {name} cannot be found, as no control node is held there; pin it, or leave it out")

    def _prior(self, name: str) -> Prior:
        if name in _HOLDS:
            return _HOLD_PRIOR
        if name not in PRIORS:
            known = ", ".join((*PRIORS, *_HOLDS))
            raise ConfigError(f"unknowns: there is no {name!r}, known are {known}; stiffness is chosen by the option stiffness")
        if not getattr(self.physics, name) > 0:
            raise ConfigError(f"unknowns: {name} of physics is 0, and what is unknown must be above; give physics a likely value")
        if name == "stiffening" and self.physics.material != "fung":
            raise ConfigError("unknowns: stiffening needs the material fung; choose a tissue, or leave it out")
        return PRIORS[name]

    def _stiffness(self, touched: np.ndarray) -> tuple[np.ndarray, list[str], np.ndarray, np.ndarray]:
        """Log factors of each node for each unknown [M, P'], names of these, centres of a field, and variance it leaves out [M]."""
        config, count = self.config, len(self.nodes)
        none = np.zeros((0, 3))
        if config.stiffness == "uniform":
            return np.full((count, 1), config.spread), [MODULUS], none, np.zeros(count)
        if config.stiffness == "regions":
            return (*self._regions(), none, np.zeros(count))
        if config.stiffness == "inclusion":
            alone, left = np.full((count, 1), config.spread), np.full(count, config.field_spread**2)
            left[self._near(touched)] = 0
            return np.concatenate([alone, np.zeros((count, BALL))], 1), [f"{MODULUS} of the rest"], none, left
        near = self._near(touched)
        centres, weights, residual, self._factor = gaussian_process(self.nodes.rest[near], config.field_spread, config.field_length)
        field = np.zeros((count, len(centres)))
        field[near] = weights
        left = np.full(count, config.field_spread**2)
        left[near] = residual
        return np.concatenate([np.full((count, 1), config.spread), field], 1), [MODULUS], centres, left

    def _regions(self) -> tuple[np.ndarray, list[str]]:
        regions = read_regions(self.physics.regions)
        rest = np.asarray(self.nodes.rest, np.float64)
        owner = np.zeros(len(rest), int)
        for number, region in enumerate(regions, 1):
            owner[region.contains(rest)] = number
        names = [f"{MODULUS} of the rest", *(f"{MODULUS} of {' '.join(region.text.split()[:5])}" for region in regions)]
        used = [number for number in range(len(names)) if (owner == number).any()]
        if len(used) < 2:
            raise ConfigError("stiffness: regions needs regions of physics that hold some control nodes and not all; give physics.regions")
        return self.config.spread * (owner[:, None] == used).astype(float), [names[number] for number in used]

    def _near(self, touched: np.ndarray) -> np.ndarray:
        """Numbers of the control nodes near places."""
        return near_touches(np.asarray(self.nodes.rest, np.float64), touched, self.config.field_reach)

    def logs(self, z: np.ndarray) -> np.ndarray:
        """Logarithms of the factors on the moduli of all control nodes [M] that unknowns [P] make."""
        told = self.matrix @ z
        return told if self.ball is None else told + self.ball.logs(z[1 : 1 + BALL])

    def beside(self, z: np.ndarray) -> np.ndarray:
        """Of a field, logarithms of how many times as stiff as the whole each control node is [M]."""
        return self.matrix[:, 1 : self.stiffness_count] @ z[1 : self.stiffness_count]

    def tangent(self, z: np.ndarray) -> np.ndarray:
        """Derivatives of `logs` [M, P]."""
        if self.ball is None:
            return self.matrix
        told, step = self.matrix.copy(), self.config.jacobian_step
        for number in range(1, 1 + BALL):
            by = step * np.eye(self.count)[number]
            told[:, number] = (self.logs(z + by) - self.logs(z - by)) / (2 * step)
        return told

    def copy(self, z: np.ndarray, shift: np.ndarray | None = None) -> Copy:
        """The tissue that these unknowns [P] make."""
        factors = np.exp(np.clip(self.logs(z), -MOST_LOG, MOST_LOG))
        holds, options = np.ones(len(self.nodes)), []
        for (name, prior), value in zip(self._others, z[self.stiffness_count :]):
            if name in _HOLDS:
                held = float(untransform(transform(_HELD_AT_FIRST, prior.high) + prior.sd * value, prior.high))
                holds[self._back if name == "hold_back" else self._rim] = held
            else:
                told = float(untransform(transform(getattr(self.physics, name), prior.high) + prior.sd * value, prior.high))
                options.append((name, min(told, 0.49) if name == "poisson_ratio" else told))
        return Copy(factors, holds, tuple(options), np.zeros(3) if shift is None else shift)

    def directions(self, touched: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions in which an experiment that touches these places [K, 3] tells anything of the unknowns.

        Of a field that is one centre after the other, of those within `field_reach`: what is farther away is not felt.

        Returns:
            The directions [D, P], each of about one standard deviation, and the matrix [D, P] that turns derivatives along them into
            derivatives by the unknowns.
        """
        if not len(self.centres):
            return np.eye(self.count), np.eye(self.count)
        reach = self.config.field_reach
        near = np.arange(len(self.centres)) if not len(touched) else KDTree(touched).query(self.centres)[0] <= reach
        spread = self.config.field_spread
        ways, back = np.zeros((len(self.centres), self.count)), np.zeros((len(self.centres), self.count))
        ways[:, 1 : self.stiffness_count] = spread * np.linalg.inv(self._factor).T  # of what is one at a centre and zero at others
        back[:, 1 : self.stiffness_count] = self._factor / spread
        others = np.delete(np.eye(self.count), np.s_[1 : self.stiffness_count], 0)
        return np.concatenate([ways[near], others]), np.concatenate([back[near], others])

    def reported(self) -> list[Reported]:
        """The numbers that the result tells. Of a field: its geometric mean over the free nodes within its reach."""
        told = []
        if self.config.stiffness == "field":
            moving = ~self.nodes.pinned & (self.residual < 0.999 * self.config.field_spread**2)
            moving = moving if moving.any() else ~self.nodes.pinned
            told.append(Reported(MODULUS, "Pa", self.matrix[moving].mean(0), float(np.log(self.base[moving]).mean())))
        else:
            for number, name in enumerate(self.labels):
                members = self.matrix[:, number] != 0
                row = np.zeros(self.count)
                row[number] = self.config.spread
                told.append(Reported(name, "Pa", row, float(np.log(self.base[members]).mean())))
        if self.ball is not None:
            for number, (name, unit, median, sd) in enumerate(self.ball.told(), 1 + PLACE):
                told.append(Reported(name, unit, sd * np.eye(self.count)[number], median))
        for number, (name, prior) in enumerate(self._others, self.stiffness_count):
            row = np.zeros(self.count)
            row[number] = prior.sd
            first = _HELD_AT_FIRST if name in _HOLDS else getattr(self.physics, name)
            told.append(Reported(name, prior.unit, row, transform(first, prior.high), prior.high))
        return told


def gaussian_process(points: np.ndarray, spread: float, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return centres [C, 3] of a field at points [N, 3] (m), the weights [N, C] that make of C standard normal numbers what a Gaussian
    process (squared exponential, Rasmussen and Williams 2006) with these values at the centres expects, the variance [N] it leaves, and
    the Cholesky factor [C, C] that makes of these numbers the values at the centres.

    Centres are as far apart as `length`: farther, and the field has places that none of them knows.
    """
    points = np.asarray(points, np.float64)
    order = sample_farthest(points, len(points))
    chosen = [int(order[0])]
    for number in order[1:]:
        if np.sqrt(((points[chosen] - points[number]) ** 2).sum(1)).min() < length:
            break
        chosen.append(int(number))
    centres = points[chosen]

    def covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return spread**2 * np.exp(-0.5 * ((a[:, None] - b[None]) ** 2).sum(2) / length**2)

    K = covariance(centres, centres) + _JITTER * spread**2 * np.eye(len(centres))
    L, factor = cholesky(K, lower=True), cho_factor(K, lower=True)
    cross = covariance(points, centres)
    left = np.maximum(spread**2 - (cross * cho_solve(factor, cross.T).T).sum(1), 0.0)
    weights = np.linalg.solve(L, cross.T).T  # cross K⁻¹ L
    return centres, weights, left, L


NOT_TOLD = "not told by these data"
Told = Literal["known", "ratio only", "not told by these data"]
