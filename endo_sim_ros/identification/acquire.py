"""Where to press next: where the answer is expected to tell most."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from endo_sim_ros.identification.ball import COUNT
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.estimate import Identification, predict_as_measured, predicted_at, touched_places
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.forward import ForwardModel
from endo_sim_ros.identification.scan import Places, Scan, added, weights, without_ball
from endo_sim_ros.identification.solving import NUISANCES
from endo_sim_ros.identification.unknowns import Unknowns


def expected_information(found: Identification, candidates: Sequence[Experiment], model: ForwardModel) -> np.ndarray:
    """How much each of K experiments that could be done is expected to tell of the unknowns, beyond what is known, in nats [K].

    It is the mutual information of unknowns and measurements (Lindley 1956) where predictions are linear within what is likely: half the
    logarithm by which the determinant of the covariance of the unknowns falls. What else is estimated, such as where the tool stands, is
    no news. Forces will be measured.

    Args:
        found: What is known.
        candidates: Experiments, of which only what the tool does is read.
        model: Of the tissue that was estimated.
    """
    asked, precision = slice(0, found.parameters.count), np.linalg.inv(found.covariance)

    def volume(covariance: np.ndarray) -> float:
        return float(np.linalg.slogdet(covariance[asked, asked])[1])

    before = volume(found.covariance)
    return np.array(
        [0.5 * (before - volume(np.linalg.inv(precision + J.T @ R.solve(J)))) for J, R in predict_as_measured(found, candidates, model)]
    )


class Search:
    """A search for an inclusion by K presses that could be done: what each tells of where it is.

    What a press would feel with an inclusion at each of many places is simulated once, before the first press; what is expected of the
    next, and what was learnt from the last, takes no simulation. The modulus around it need not be known: forces grow with it.

    Args:
        candidates: The presses.
        model: Of the tissue; its modulus is the median of the prior.
        config: Of the inclusion; `stiffness` is taken to be ``inclusion``.

    Attributes:
        places: Where it may be.
        probable: Probability of each place and, last, of none [C + 1].
    """

    def __init__(self, candidates: Sequence[Experiment], model: ForwardModel, config: IdentificationConfig = IdentificationConfig()):
        config = replace(config, stiffness="inclusion")
        touched = [touched_places([each], model.nodes, model.physics) for each in candidates]
        self.unknowns = unknowns = Unknowns(model.nodes, model.physics, config, np.concatenate(touched))
        assert unknowns.ball is not None
        self.places = Places(unknowns, np.concatenate(touched))
        theta = np.zeros(unknowns.count + NUISANCES)
        theta[COUNT] = unknowns.ball.absent()
        data, point = predicted_at(theta, candidates, model, unknowns)
        self._jacobians, self._covariances = without_ball(point.jacobians), point.covariances
        self._plain = [-each for each in point.residuals]  # forces that are felt without any inclusion, as all measured ones are 0
        self._added = [added(seen, model, unknowns, self.places, theta, at) for seen, at in zip(data, touched)]
        self._learn([])

    def anew(self) -> "Search":
        """The same search before anything was felt."""
        other = copy(self)
        other._learn([])
        return other

    def expected(self) -> np.ndarray:
        """How much each press is expected to tell of where the inclusion is, and whether there is one, in nats [K]: the mutual information
        of both as if measurements were normal."""
        w, told = self.probable, []
        known = np.linalg.inv(self._scan.H)
        for J, R, d in zip(self._jacobians, self._covariances, self._added):
            d = self._scale * np.column_stack([d, np.zeros(len(d))])
            D = (d - d @ w[:, None]) * np.sqrt(w)
            J = self._scale * J
            weighted_D, weighted_J = R.solve(D), R.solve(J)
            inner = np.linalg.inv(np.linalg.inv(known) + J.T @ weighted_J)
            M = D.T @ weighted_D - (D.T @ weighted_J) @ inner @ (weighted_J.T @ D)  # Dᵀ (R + J Σ Jᵀ)⁻¹ D
            told.append(0.5 * np.linalg.slogdet(np.eye(len(M)) + M)[1])
        return np.array(told)

    def feel(self, press: int, forces: np.ndarray) -> None:
        """Learn from the forces [T, 3], N, that were measured at the steps of the press of this number."""
        self._learn([*self._felt, (press, np.asarray(forces, float).ravel())])

    def _learn(self, felt: list[tuple[int, np.ndarray]]) -> None:
        """Know what presses tell, of their numbers and forces [3 T], and no others."""
        self._felt, self._scale = felt, 1.0
        if felt:
            plain, forces = (np.concatenate(each) for each in zip(*((self._plain[k], y) for k, y in felt)))
            self._scale = max(float(plain @ forces) / max(float(plain @ plain), 1e-30), 1e-3)
        self._scan, s = Scan.empty(self._jacobians[0].shape[1], len(self.places.z)), self._scale
        for k, y in felt:
            self._scan.add(y - s * self._plain[k], s * self._jacobians[k], self._covariances[k], s * self._added[k])
        self.probable = weights(self._scan.costs(), self.places)

    @property
    def centre(self) -> np.ndarray:
        """Where the inclusion is [3], m, world: the mean over the places near the likeliest, by how likely they are."""
        best = int(self.probable[:-1].argmax())
        near = ((self.places.centres - self.places.centres[best]) ** 2).sum(1) <= (2 * self.unknowns.config.inclusion_radius) ** 2
        w = self.probable[:-1] * near
        return (w[:, None] * self.places.centres).sum(0) / w.sum()

    @property
    def deviation(self) -> float:
        """How far it may be from there, m: root of the mean square over all places, and within half the distance between them."""
        w, half = self.probable[:-1] / self.probable[:-1].sum(), self.unknowns.config.inclusion_radius / 2
        return float(np.sqrt((w * ((self.places.centres - self.centre) ** 2).sum(1)).sum() + half**2))
