"""What opens a cut by itself: tissue stands in a tension that its skin carries, and a cut lets go of it."""

import numpy as np


def released_forces(rest: np.ndarray, links: np.ndarray, pulls: np.ndarray, pieces: np.ndarray, pinned: np.ndarray) -> np.ndarray:
    """Forces on nodes [M, 3], N, that take away the tension of links that were cut.

    Taking a stress away from both faces of a cut is the same as to put the opposite one on them. The two ends of a link are pulled
    alike, so that the tissue as a whole is not. What has come off whole, and nothing holds, keeps no tension that would drive it away.

    Args:
        rest: Nodes at rest [M, 3], m.
        links: Ends of the links that were cut [L, 2].
        pulls: With which a node was held across a cut that lies beside it [M], N.
        pieces: Number of the piece of tissue that each node is part of [M].
        pinned: Nodes that are held in place [M], bool.
    """
    forces = np.zeros((len(rest), 3))
    if len(links):
        counts = np.bincount(links.ravel(), minlength=len(rest))
        along = rest[links[:, 0]] - rest[links[:, 1]]
        along = along / np.linalg.norm(along, axis=1, keepdims=True).clip(1e-12)
        each = pulls[links].mean(1) / counts[links].mean(1)
        apart = pieces[links[:, 0]] != pieces[links[:, 1]]
        loose = ~np.isin(pieces, pieces[pinned])[links] & apart[:, None] & pinned.any()
        for column, sign in ((0, 1), (1, -1)):
            acts = ~loose[:, column]
            np.add.at(forces, links[acts, column], sign * (each[:, None] * along)[acts])
    return forces
