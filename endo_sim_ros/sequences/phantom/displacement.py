"""How tissue is displaced: pulled by something, or moved by breath and heart. Known exactly, with its gradient."""

import math
from dataclasses import dataclass

import numpy as np

from endo_sim_ros.core.motion import beat_share, breath_share
from endo_sim_ros.sequences.phantom.config import BREATH_RADIUS, HEART_RADIUS, PULL_RADIUS, PhantomConfig

_MIDDLE = 0.13  # metres, world z about which tissue lies


@dataclass(frozen=True)
class Displacement:
    """A smooth displacement of the tissue, u(q) = Σ a exp(−|q − c|² / 2 r²) at a point q at rest.

    Args:
        centres: c [T, 3], m, world.
        amplitudes: a [T, 3], m.
        radii: r [T], m.
    """

    centres: np.ndarray
    amplitudes: np.ndarray
    radii: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """u [N, 3] (m) of points [N, 3] (m, world) at rest."""
        return self._weights(points) @ self.amplitudes

    def gradients(self, points: np.ndarray) -> np.ndarray:
        """Deformation gradients I + ∂u/∂q [N, 3, 3] at points [N, 3] (m, world) at rest."""
        apart = (points[:, None] - self.centres) / self.radii[:, None] ** 2
        return np.eye(3) - np.einsum("nt,ti,ntj->nij", self._weights(points), self.amplitudes, apart)

    def _weights(self, points: np.ndarray) -> np.ndarray:
        squared = ((points[:, None] - self.centres) ** 2).sum(-1)
        return np.exp(-0.5 * squared / self.radii**2)


def displacement_at(config: PhantomConfig, seconds: float) -> Displacement | None:
    """The displacement of the tissue at a time since the first frame; None where nothing ever moves it."""
    largest = np.array([config.deformed, config.breathing, config.heartbeat])
    if not largest.any():
        return None
    rng = np.random.default_rng([config.seed, 0xB4EA])
    middles = rng.uniform(-0.015, 0.015, (2, 2))
    turns = rng.uniform(0, 2 * math.pi, 3)
    aside = np.stack([np.cos(turns), np.sin(turns)], 1)
    centres = np.array([[0, 0, _MIDDLE], [*middles[0], _MIDDLE], [*middles[1], _MIDDLE]])
    # Pulled mostly towards the endoscope; breath slides organs, and lifts them half as much; the heart knocks.
    directions = np.array([[*0.5 * aside[0], -1.0], [*aside[1], -0.5], [*0.3 * aside[2], -1.0]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    breath, heart = _breath(config, seconds), beat_share(seconds, config.heartbeat_period)
    amplitudes = (largest * [1.0, breath, heart])[:, None] * directions
    moving, radii = largest > 0, np.array([PULL_RADIUS, BREATH_RADIUS, HEART_RADIUS])
    return Displacement(centres[moving], amplitudes[moving], radii[moving])


def _breath(config: PhantomConfig, seconds: float) -> float:
    """Share, 0 to 1, of its way that the breath has gone after so many seconds; breaths may differ in length."""
    if not config.breathing_irregularity:
        return breath_share(seconds, config.breathing_period)
    rng, began = np.random.default_rng([config.seed, 0xA1B]), 0.0
    while True:
        length = config.breathing_period * (1 + config.breathing_irregularity * rng.uniform(-1, 1))
        if seconds < began + length:
            return breath_share(seconds - began, length)
        began += length
