"""Skinning: Gaussians follow their nearest control nodes."""

from typing import Literal

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree
from torch import Tensor

from endo_sim_ros.device import init_warp, pick_device
from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.physics.skinning_kernels import blend_rotations, node_rotations, skin_gaussians

STRETCH_RANGE = (0.2, 4.0)  # of a Gaussian; beyond it the picture shows needles or holes, not tissue


def bind_weights(
    means: np.ndarray, node_rest: np.ndarray, neighbours: int, weighting: str
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest nodes [N, K] int32 and their weights [N, K] float32, which add up to one, of means [N, 3].

    ``compact``: (1 − (d/d_{K+1})²)², normalised; a node's weight falls smoothly to zero where it is no longer among the
    nearest. ``softmax``: exp(d)/Σ exp(d) with d in metres, as the paper prints it.
    """
    count = min(neighbours, max(len(node_rest) - 1, 1))
    distances, index = cKDTree(node_rest).query(means, k=list(range(1, count + 2)), workers=-1)
    d, beyond = distances[:, :count], distances[:, count:]
    if weighting == "softmax":
        weights = np.exp(d - d.max(1, keepdims=True)) if len(d) else d
    else:  # beyond is infinite when there is a single node; equidistant nodes share evenly
        weights = np.maximum(1 - (d / np.maximum(beyond, 1e-30)) ** 2, 1e-6) ** 2
    weights = weights / weights.sum(1, keepdims=True)
    return index[:, :count].astype(np.int32), weights.astype(np.float32)


class Skinning:
    """Carries a model's Gaussians along with control nodes.

    Args:
        model: Gaussians at rest, world.
        node_rest: Nodes at rest [M, 3], metres, world.
        neighbours: Number of nearest nodes K that move one Gaussian.
        weighting: ``compact`` (with F_k) or the paper's ``softmax`` (with R_k), see :func:`bind_weights`.
        device: Where to compute: auto, cpu, cuda or cuda:N.

    Raises:
        ValueError: If there are no nodes, or positions are not finite.
    """

    def __init__(
        self,
        model: GaussianModel,
        node_rest: np.ndarray | Tensor,
        *,
        neighbours: int = 4,
        weighting: Literal["compact", "softmax"] = "compact",
        device: str = "auto",
    ):
        init_warp()
        self.device = pick_device(device)
        self.weighting = weighting
        rest = torch.as_tensor(node_rest).detach().cpu().double().numpy()
        means = model.means.detach().cpu().double().numpy()
        if rest.ndim != 2 or rest.shape[1] != 3 or not len(rest):
            raise ValueError(f"skinning: node_rest has shape {rest.shape}, expected [M, 3] with M > 0")
        if not np.isfinite(rest).all() or not np.isfinite(means).all():
            raise ValueError("skinning: node positions and Gaussian means must be finite")
        index, weights = bind_weights(means, rest, neighbours, weighting)
        model = model.detach().to(self.device)
        self.means = model.means.float().contiguous()  # [N, 3] m, at rest
        self.covars = model.covariances.float().contiguous()  # [N, 3, 3] m², at rest
        self.neighbours = torch.from_numpy(index).to(self.device)  # [N, K]
        self.weights = torch.from_numpy(weights).to(self.device)  # [N, K]
        self.node_rest = torch.from_numpy(rest).float().to(self.device).contiguous()  # [M, 3] m

    def deform(self, positions: Tensor | np.ndarray, F: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
        """Means [N, 3] (m) and covariances [N, 3, 3] (m²) of the Gaussians.

        The nodes are at positions [M, 3] (m, world) with deformation gradients F [M, 3, 3]. The singular values of
        every Gaussian's F are clamped to ``STRETCH_RANGE``.
        """
        positions = self._nodes("positions", positions, (3,))
        F = self._nodes("F", F, (3, 3))
        A = F
        if self.weighting == "softmax":
            A = torch.empty_like(F)
            self._launch(node_rotations, len(F), [_mat33(F), _mat33(A)])
        means, covars = torch.empty_like(self.means), torch.empty_like(self.covars)
        inputs = [_vec3(self.means), _mat33(self.covars), wp.from_torch(self.neighbours), wp.from_torch(self.weights)]
        inputs += [_vec3(self.node_rest), _vec3(positions), _mat33(F), _mat33(A), *STRETCH_RANGE]
        self._launch(skin_gaussians, len(means), [*inputs, _vec3(means), _mat33(covars)])
        return means, covars

    def rotations(self, F: Tensor | np.ndarray) -> Tensor:
        """Rotation of every Gaussian [N, 3, 3] for node F [M, 3, 3]; its transpose turns view directions where the
        SH degree is above 0."""
        F = self._nodes("F", F, (3, 3))
        out = torch.empty_like(self.covars)
        inputs = [wp.from_torch(self.neighbours), wp.from_torch(self.weights), _mat33(F), _mat33(out)]
        self._launch(blend_rotations, len(out), inputs)
        return out

    def _nodes(self, name: str, values: Tensor | np.ndarray, shape: tuple[int, ...]) -> Tensor:
        values = torch.as_tensor(values).detach().to(self.device, torch.float32).contiguous()
        expected = (len(self.node_rest), *shape)
        if tuple(values.shape) != expected:
            raise ValueError(f"skinning: {name} has shape {tuple(values.shape)}, expected {expected}")
        return values

    def _launch(self, kernel, count: int, inputs: list) -> None:
        stream = None
        if self.device != "cpu":  # in order with torch's own work
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        wp.launch(kernel, count, inputs, device=self.device, stream=stream)


def _vec3(tensor: Tensor) -> wp.array:
    return wp.from_torch(tensor, dtype=wp.vec3)


def _mat33(tensor: Tensor) -> wp.array:
    return wp.from_torch(tensor, dtype=wp.mat33)
