"""Colours of the stiffness in control nodes."""

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros.identification.picture import color_scale, modulus_colors
from endo_sim_ros.viewer.stress import StressColors


class StiffnessColors:
    """Colours of control nodes by their modulus, blue to red on a logarithmic scale: as it was identified, grey where it is not known;
    before anything was, as the options of the physics say.

    Args:
        stress: Knows these options.
    """

    def __init__(self, stress: StressColors):
        self._stress = stress
        self._rest: np.ndarray | None = None
        self._map: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._colors: np.ndarray | None = None
        self.legend = ""
        """What the colours mean."""

    def set_nodes(self, rest: np.ndarray | None) -> None:
        """Other control nodes, at these positions at rest [M, 3], m, world; what was identified was of those before."""
        same = rest is not None and self._rest is not None and np.array_equal(rest, self._rest)
        self._map = self._map if same or self._rest is None else None
        self._rest, self._colors = rest, None

    def show(self, positions: np.ndarray, young_modulus: np.ndarray, known: np.ndarray) -> None:
        """What was identified: control nodes at rest [K, 3], m, world, their moduli [K], Pa, and where these are known [K]."""
        self._map, self._colors = (positions, young_modulus, known), None

    def renew(self) -> None:
        """The options of the physics have changed."""
        self._colors = None

    def __call__(self, count: int) -> np.ndarray:
        """Return colours [M, 3] uint8 of so many nodes."""
        if self._colors is None or len(self._colors) != count:
            moduli, known, source = self._stress.tissue(count).young_modulus, np.ones(count, bool), "as the physics has it"
            if self._map is not None and self._rest is not None and len(self._rest) == count:
                nearest = KDTree(self._map[0]).query(self._rest)[1]
                moduli, known, source = self._map[1][nearest], self._map[2][nearest], "as identified, grey where not known"
            low, high = color_scale(moduli)
            self._colors = modulus_colors(moduli, known, (low, high))
            self.legend = f"blue: {low / 1e3:.2g} kPa, red: {high / 1e3:.2g} kPa, {source}"
        return self._colors
