"""The grid of the material point method: its cells, its place and its size."""

from dataclasses import dataclass

import numpy as np

from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes

MARGIN_CELLS = 2.0  # between the control nodes and the edge of the grid; a spline reaches 1.5
MIN_CELL, MAX_CELL = 1e-6, 1e3  # m; beyond these float32 no longer holds masses and stiffnesses
MAX_GRID_NODES = 64_000_000  # 28 bytes each


@dataclass(frozen=True)
class GridPlan:
    """A grid that control nodes fit into."""

    cell_size: float  # h, m
    origin: np.ndarray  # its corner [3], m, world, float64
    shape: tuple[int, int, int]  # grid nodes along each axis
    local: np.ndarray  # control nodes at rest [M, 3], m from the corner, float32

    @property
    def rest_cells(self) -> np.ndarray:
        """Control nodes at rest [M, 3], in cells from the corner, float64, rounded as kernels have them."""
        return self.local.astype(np.float64) / self.cell_size

    @property
    def count(self) -> int:
        """Number of grid nodes."""
        return int(np.prod(self.shape))


def plan_grid(nodes: ControlNodes, config: PhysicsConfig, environments: int) -> GridPlan:
    """Return the grid for control nodes in a number of environments.

    Raises:
        ValueError: If the cells or the grid would be absurdly large or small, or the tissue is too far from the world's origin.
    """
    h = config.grid_ratio * nodes.spacing
    if not MIN_CELL <= h <= MAX_CELL:
        raise ValueError(
            f"the grid cells would be {h:.3g} m wide, which is no tissue; is the model in metres, and is it the viewpoint's own?"
        )
    far = float(np.abs(nodes.rest).max())
    if not far * np.finfo(np.float32).eps < 0.01 * h:  # else control nodes of one cell fall together, and out of the grid
        raise ValueError(
            f"the tissue lies {far:.3g} m from the world's origin, too far to tell its nodes {nodes.spacing:.3g} m"
            " apart; check the poses of the cameras"
        )
    margin = MARGIN_CELLS * h + (config.travel if config.kinematics == "current" else 0.0)
    rest = nodes.rest.astype(np.float64)
    origin = rest.min(0) - margin
    cells = np.ceil((rest.max(0) + margin - origin) / h) + 1
    if not environments * cells.prod() <= MAX_GRID_NODES:  # as floats: a product of integers could wrap around
        raise ValueError(
            f"the simulation grid would have {cells[0]:.0f}×{cells[1]:.0f}×{cells[2]:.0f} nodes of {h:.3g} m"
            + f" in each of {environments} environments" * (environments > 1)
            + "; remove outlying Gaussians, lower node_count or raise grid_ratio"
        )
    shape = int(cells[0]), int(cells[1]), int(cells[2])
    return GridPlan(h, origin, shape, (rest - origin).astype(np.float32))
