"""Colours of the stress in control nodes."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.physics.materials import Stiffening
from endo_sim_ros.physics.regions import TissueProperties, paint_regions
from endo_sim_ros.physics.stress import von_mises

_RED = 99.7  # percentile of the stress that is shown red: single nodes at the edge of a jaw are torn at
_LEAST_SCALE = 0.05  # of Young's modulus: the smallest stress that is shown red


class StressColors:
    """Colours of control nodes by their von Mises stress: blue is none, red almost the largest of late.

    Args:
        parameters: Options of the physics by name.
        notify: Tells users that a region cannot be read.
    """

    def __init__(self, parameters: dict[str, Any], notify: Callable[[str], None]):
        self._notify = notify
        self._rest: np.ndarray | None = None
        self.scale = 0.0
        """Stress that is shown red, Pa."""
        self.set_parameters(parameters)

    def set_nodes(self, rest: np.ndarray | None) -> None:
        """Other control nodes, at these positions at rest [M, 3], m, world."""
        self._rest, self._tissue = rest, None

    def set_parameters(self, parameters: dict[str, Any]) -> None:
        """Other options of the physics."""
        self._parameters = parameters
        self._tissue: TissueProperties | None = None  # what each node is made of; None = not known yet

    def __call__(self, F: np.ndarray) -> np.ndarray:
        """Return colours [M, 3] uint8 of nodes with these deformation gradients [M, 3, 3]."""
        tissue, known = self.tissue(len(F)), self._parameters
        stiffening = Stiffening(known["stiffening"], known["stiffening_limit"])
        stress = von_mises(F, tissue.young_modulus, tissue.poisson_ratio, known["material"], stiffening)
        largest = max(float(np.percentile(stress, _RED)), _LEAST_SCALE * known["young_modulus"])
        self.scale = max(largest, 0.98 * self.scale)
        levels = (255 * np.minimum(stress / self.scale, 1)).astype(np.uint8)
        return cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]

    def tissue(self, count: int) -> TissueProperties:
        """What each of so many nodes is made of, as the options say."""
        if self._tissue is None or len(self._tissue) != count:
            self._tissue = self._properties(count)
        return self._tissue

    def _properties(self, count: int) -> TissueProperties:
        known = self._parameters  # stress does not depend on density
        uniform = TissueProperties.uniform(count, known["young_modulus"], known["poisson_ratio"], density=1.0)
        if self._rest is None:
            return uniform
        try:
            return paint_regions(uniform, self._rest, known["regions"])
        except ConfigError as error:  # a mask may lie on the physics' machine only
            self._notify(f"stress is coloured without regions: {error}")
            return uniform
