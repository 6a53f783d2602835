"""Where to press next: where the answer is expected to tell most."""

from collections.abc import Sequence

import numpy as np

from endo_sim_ros.identification.estimate import Identification, predict_as_measured
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.forward import ForwardModel


def expected_information(found: Identification, candidates: Sequence[Experiment], model: ForwardModel) -> np.ndarray:
    """How much each of K experiments that could be done is expected to tell, beyond what is known, in nats [K].

    It is ½ log det(1 + J Σ Jᵀ R⁻¹): the mutual information of unknowns and measurements (Lindley 1956) where predictions are linear
    within what is likely, with J at the estimate, Σ its covariance, and R the noise, with that of tips. Forces will be measured.

    Args:
        found: What is known.
        candidates: Experiments, of which only what the tool does is read.
        model: Of the tissue that was estimated.
    """
    told = []
    for J, R in predict_as_measured(found, candidates, model):
        information = J.T @ R.solve(J)
        told.append(0.5 * np.linalg.slogdet(np.eye(len(information)) + found.covariance @ information)[1])
    return np.array(told)


def best_press(found: Identification, candidates: Sequence[Experiment], model: ForwardModel) -> int:
    """Number of the experiment that is expected to tell most, the first of equals."""
    return int(np.argmax(expected_information(found, candidates, model)))
