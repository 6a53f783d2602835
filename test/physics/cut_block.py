"""A block of nodes with cuts through it."""

import numpy as np

from endo_sim_ros.physics.cutting.geometry import sweep

SPACING = 0.005
MIDDLE = 0.0311  # m along x; no node lies there


def block(shape=(13, 9, 5), jitter=0.0, seed=0) -> np.ndarray:
    """Nodes [M, 3] of a block with a corner at the origin, moved by up to `jitter` spacings."""
    nodes = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1).reshape(-1, 3)
    return (nodes + np.random.default_rng(seed).uniform(-jitter, jitter, nodes.shape)) * SPACING


def wall(x=MIDDLE, y=(-0.02, 0.06), z=(-0.02, 0.04), pieces=10) -> np.ndarray:
    """Triangles of the plane at x between two y and two z, swept along y in pieces by a blade of four points."""
    depth = np.linspace(*z, 4)
    blades = [np.stack([np.full(4, x), np.full(4, at), depth], 1) for at in np.linspace(*y, pieces + 1)]
    return np.concatenate([sweep(start, end) for start, end in zip(blades[:-1], blades[1:])])
