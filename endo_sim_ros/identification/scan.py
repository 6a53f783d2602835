"""Where an inclusion may be: copies of the tissue that have one at each of many places, compared with what was measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros.identification.ball import COUNT, near_touches
from endo_sim_ros.identification.forward import Copy, ForwardModel
from endo_sim_ros.identification.observations import Covariance, Observations
from endo_sim_ros.identification.unknowns import Unknowns
from endo_sim_ros.physics import sample_farthest

_AMPLITUDE = 0.5  # sd of the share by which what a ball adds to forces may be more or less: its ratio and radius are not scanned


class Places:
    """Balls at C places, as far apart as their radius, of the median radius and ratio.

    Args:
        unknowns: With `stiffness: inclusion`.
        touched: Places where tools were or will be [K, 3], m, world.

    Attributes:
        z: Of the unknowns [C, P].
        centres: [C, 3], m, world.
    """

    def __init__(self, unknowns: Unknowns, touched: np.ndarray):
        assert unknowns.ball is not None
        config, ball, free = unknowns.config, unknowns.ball, ~unknowns.nodes.pinned
        inner = ball.rest[free]
        near = inner[near_touches(inner, touched, config.field_reach)]
        order, kept = sample_farthest(near, len(near)), np.zeros((0, 3))
        for number in order:
            if len(kept) and ((kept - near[number]) ** 2).sum(1).min() < config.inclusion_radius**2:
                break
            kept = np.concatenate([kept, near[[number]]])
        self.z = np.zeros((len(kept), unknowns.count))
        self.z[:, 1:4] = [ball.numbers(each) for each in kept]
        self.centres = kept


@dataclass
class Scan:
    """How well each of C places, and none, explain what was measured; errors that are shared are fitted to each, linearly.

    Sums over experiments of products with the inverse covariance R: of residuals r without any ball, of their Jacobian J [n, Q], and of
    what balls add d [n, C].
    """

    H: np.ndarray  # JᵀR⁻¹J + I [Q, Q]
    b: np.ndarray  # JᵀR⁻¹r [Q]
    G: np.ndarray  # JᵀR⁻¹d [Q, C]
    rr: float
    rd: np.ndarray  # [C]
    dd: np.ndarray  # [C]

    @classmethod
    def empty(cls, size: int, count: int) -> "Scan":
        """Of no data."""
        return cls(np.eye(size), np.zeros(size), np.zeros((size, count)), 0.0, np.zeros(count), np.zeros(count))

    def add(self, r: np.ndarray, J: np.ndarray, R: Covariance, d: np.ndarray) -> None:
        """Take in an experiment."""
        weighted_J, weighted_d = R.solve(J), R.solve(d)
        self.H, self.b, self.G = self.H + J.T @ weighted_J, self.b + weighted_J.T @ r, self.G + J.T @ weighted_d
        self.rr += float(r @ R.solve(r[:, None])[:, 0])
        self.rd, self.dd = self.rd + weighted_d.T @ r, self.dd + (d * weighted_d).sum(0)

    def costs(self) -> np.ndarray:
        """−2 log likelihood of each place and, last, of none [C + 1], up to a constant."""
        s, none = _AMPLITUDE, self.rr - float(self.b @ np.linalg.solve(self.H, self.b))
        left = self.b[:, None] - self.G
        solved, G = np.linalg.solve(self.H, left), np.linalg.solve(self.H, self.G)
        schur = 1 + s**2 * (self.dd - (self.G * G).sum(0))
        q = s * (self.rd - self.dd - (self.G * solved).sum(0))
        return np.append(self.rr - 2 * self.rd + self.dd - (left * solved).sum(0) - q**2 / schur + np.log(schur), none)


def added(seen: Observations, model: ForwardModel, unknowns: Unknowns, places: Places, theta: np.ndarray, at: np.ndarray) -> np.ndarray:
    """What balls at the places add to the numbers of an experiment that are used [n, C]: 0 far from where its tool was, `at` [K, 3], m."""
    P, config = unknowns.count, unknowns.config
    offset, gain = theta[P : P + 3] * config.tip_offset, 1 + config.model_error * theta[P + 3]
    numbers = np.flatnonzero(KDTree(at).query(places.centres)[0] <= config.field_reach) if len(at) else []
    base = theta[:P]
    copies: list[Copy] = [unknowns.copy(base, offset)]
    for number in numbers:
        z = places.z[number].copy()
        z[np.r_[0, 1 + COUNT : P]] = base[np.r_[0, 1 + COUNT : P]]
        copies.append(unknowns.copy(z, offset))
    told = seen.predicted(model.replay(seen.experiment, copies, 1))
    told[:, seen.of_forces()] *= gain
    found = np.zeros((int(seen.used.sum()), len(places.z)))
    found[:, numbers] = (told[1:] - told[0])[:, seen.used].T
    return found


def without_ball(jacobians: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Jacobians [n, Q] without the columns of the ball."""
    told = [each.copy() for each in jacobians]
    for each in told:
        each[:, 1 : 1 + COUNT] = 0
    return told


def weights(costs: np.ndarray, places: Places) -> np.ndarray:
    """Probability of each place and, last, of none [C + 1]: those of all places together and of none are alike before any data."""
    prior = (places.z[:, 1:4] ** 2).sum(1)
    prior = np.append(prior + 2 * np.log(np.exp(-0.5 * prior).sum()), 0.0)
    logs = -0.5 * (costs + prior)
    told = np.exp(logs - logs.max())
    return told / told.sum()
