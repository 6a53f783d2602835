"""A slab of tissue that is pressed from above, for tests of identification."""

from dataclasses import replace

import numpy as np

from endo_sim_ros.identification import Experiment
from endo_sim_ros.identification.synthetic import press
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

SPACING = 0.006
PHYSICS = PhysicsConfig(young_modulus=4e3, contact_radius=0.008, friction=0.1, device="cpu")
HEAVY = replace(PHYSICS, density=4000.0)  # half as many substeps; slow presses hardly tell the difference


def slab(side: int = 9, deep: int = 4, half: float = 4 * SPACING) -> ControlNodes:
    """Control nodes of a slab 10 cm in front of the world's origin, with half its width (m), held below and at its rim; skin first."""
    across, down = np.linspace(-half, half, side), 0.1 + np.linspace(0, 3 * SPACING, deep)
    z, y, x = (each.ravel() for each in np.meshgrid(down, across, across, indexing="ij"))
    edge = across[-1] - 1e-6
    pinned = (z > down[-1] - 1e-6) | (np.maximum(np.abs(x), np.abs(y)) > edge)
    gap, below = across[1] - across[0], down[1] - down[0]
    volumes = np.full(len(x), gap**2 * below, np.float32)
    return ControlNodes(np.stack([x, y, z], 1).astype(np.float32), pinned, volumes, z < 0.1 + 1e-6, max(gap, below), np.zeros(3))


NODES = slab()
FINER = slab(13, 6)  # the same, two thirds as far apart


def pressed(x: float = 0.0, y: float = 0.0, depth: float = 0.006, steps: int = 24) -> Experiment:
    """A press at a place on the slab, m."""
    return press(NODES, PHYSICS, np.array([x, y, 0.1]), depth, steps, hold=4)
