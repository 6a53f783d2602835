"""How far points are from the skin of tissue at rest."""

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros.physics.control_nodes import ControlNodes, skin_normals

_BESIDE = 2.5  # distances between these, beyond which a point below the skin is beside the tissue


class Surface:
    """The skin of control nodes at rest.

    Args:
        nodes: The tissue.

    Attributes:
        skin: Control nodes of the skin [S, 3], m, world.
        normals: Unit normals there [S, 3], out of the tissue.
        apart: Distance between neighbours, m.
    """

    def __init__(self, nodes: ControlNodes):
        self.skin = nodes.rest[nodes.is_skin].astype(np.float64)
        self._tree = KDTree(self.skin)
        self.apart = float(np.median(self._tree.query(self.skin, k=2)[0][:, 1])) if len(self.skin) > 1 else nodes.spacing
        self.normals = skin_normals(nodes)

    def gaps(self, points: np.ndarray) -> np.ndarray:
        """Distances [N], m, of points [N, 3] from the skin; below zero within the tissue."""
        found = np.full(len(points), np.inf)
        finite = np.isfinite(points).all(1)
        distance, nearest = self._tree.query(points[finite])
        offset = points[finite] - self.skin[nearest]
        height = (offset * self.normals[nearest]).sum(1)
        beside = np.sqrt((distance**2 - height**2).clip(0))
        over = beside <= _BESIDE * self.apart
        found[finite] = np.where(over, height, distance)
        return found

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Distances [N], m, of points [N, 3] from the nearest control node of the skin; inf where a point is not finite."""
        found = np.full(len(points), np.inf)
        finite = np.isfinite(points).all(1)
        found[finite] = self._tree.query(points[finite])[0]
        return found

    def outwards(self, points: np.ndarray) -> np.ndarray:
        """Unit normals [N, 3] of the skin nearest to points [N, 3], out of the tissue."""
        return self.normals[self._tree.query(points)[1]]
