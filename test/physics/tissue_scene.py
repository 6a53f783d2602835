"""The tissue of the tests of physics: curved sheets, specimens, tools."""

import numpy as np
import torch

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.physics import ControlNodes, PhysicsConfig, TissueSimulation

EYE = np.zeros(3)  # the camera of the test scene, looking along +z
TIP = np.array([0.0, 0.0, 0.12])  # on the sheet, in front of the camera


def curved_sheet(count: int = 3000, seed: int = 0, offset: tuple = (0.0, 0.0, 0.0)) -> GaussianModel:
    """A 10 × 8 cm curved sheet 12 cm in front of the origin. Coordinates are multiples of 2⁻²⁰ m, so that moving the
    scene by whole metres rounds nothing."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform([-0.05, -0.04], [0.05, 0.04], (count, 2))
    points = np.c_[xy, 0.12 + 0.5 * (xy**2).sum(1) + 0.003 * np.sin(60 * xy[:, 0])]
    points = np.round(points * 2**20) / 2**20 + offset
    colors = torch.from_numpy(rng.uniform(size=(count, 3))).float()
    return GaussianModel.from_points(torch.from_numpy(points).float(), colors, torch.full((count,), 0.001))


def simulate(model=None, viewpoint=EYE, **overrides) -> TissueSimulation:
    model = curved_sheet() if model is None else model
    return TissueSimulation(model, viewpoint, PhysicsConfig(device="cpu", **{"node_count": 1000, **overrides}))


def steps(simulation: TissueSimulation, count: int) -> None:
    for _ in range(count):
        simulation.step()


def depth_of_dent(simulation: TissueSimulation) -> float:
    state = simulation.state()
    return float(np.linalg.norm(state.positions - state.rest, axis=1).max())


def specimen(shape: tuple, spacing: float, pinned, is_skin) -> ControlNodes:
    """A block of nodes whose volumes add up to the block's; `pinned` and `is_skin` map positions [M, 3] to bool [M]."""
    axes = [np.arange(n) * spacing for n in shape]
    rest = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    on_face = (rest < spacing / 2) | (rest > rest.max(0) - spacing / 2)
    volumes = np.where(on_face, spacing / 2, spacing).prod(1)
    return ControlNodes(rest.astype(np.float32), pinned(rest), volumes.astype(np.float32), is_skin(rest), spacing)


def random_rotations(count: int, seed: int = 0) -> np.ndarray:
    Q, R = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))
    Q *= np.sign(np.diagonal(R, axis1=1, axis2=2))[:, None, :]
    Q[np.linalg.det(Q) < 0, :, 0] *= -1
    return Q


def free_block(**overrides) -> TissueSimulation:
    """A block of 4 × 3 × 2 cm that nothing holds."""
    nodes = specimen((9, 7, 5), 0.005, lambda x: np.zeros(len(x), bool), lambda x: np.ones(len(x), bool))
    config = PhysicsConfig(device="cpu", **{"damping": 0.0, "travel": 0.3, "force_radius": 0.01, **overrides})
    return TissueSimulation.from_nodes(nodes, config)


def pose_at(position) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose
