"""Skinning: Gaussians follow their nearest control nodes."""

import functools
from typing import Literal

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree
from torch import Tensor

from endo_sim_ros.core.device import init_warp, on_torch_stream, pick_device, run_in_threads, shares
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.physics import skinning_cpu_kernels as simd_kernels
from endo_sim_ros.physics import skinning_kernels as kernels
from endo_sim_ros.physics.cutting import CutNeighbours, clip_to_sides
from endo_sim_ros.physics.solver import Launch

STRETCH_RANGE = (0.2, 4.0)  # of a Gaussian; beyond it the picture shows needles or holes, not tissue
SHARED_FROM = 4096  # Gaussians; fewer are done before a second thread has begun


def bind_weights(means: np.ndarray, node_rest: np.ndarray, neighbours: int, weighting: str) -> tuple[np.ndarray, np.ndarray]:
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
        vectorised: Use the CPU's own kernel; False runs that of the GPU on it, to compare.

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
        vectorised: bool = True,
    ):
        init_warp()
        self.device = pick_device(device)
        self.weighting = weighting
        self._vectorised = vectorised and self.device == "cpu"
        rest = torch.as_tensor(node_rest).detach().cpu().double().numpy()
        means = model.means.detach().cpu().double().numpy()
        if rest.ndim != 2 or rest.shape[1] != 3 or not len(rest):
            raise ValueError(f"skinning: node_rest has shape {rest.shape}, expected [M, 3] with M > 0")
        if not np.isfinite(rest).all() or not np.isfinite(means).all():
            raise ValueError("skinning: node positions and Gaussian means must be finite")
        _load_kernels(self.device)
        model = model.detach().to(self.device)
        self.means = model.means.float().contiguous()  # [N, 3] m, at rest
        self.covars = model.covariances.float().contiguous()  # [N, 3, 3] m², at rest
        self.node_rest = torch.from_numpy(rest).float().to(self.device).contiguous()  # [M, 3] m
        self._origin = wp.vec3(*rest.mean(0))  # of the maps
        index, weights = bind_weights(means, rest, neighbours, weighting)
        self.rebind(index, weights)
        self._cuts = CutNeighbours(means, rest, index, weights)
        self._covars = self.covars.cpu().double().numpy()
        self._clipped = self._covars.copy()  # where the cuts left them
        self._reach = 2 * np.sqrt(np.trace(self._covars, axis1=1, axis2=2))

    def cut(self, triangles: np.ndarray) -> None:
        """Let no Gaussian follow nodes, or reach, across a cut: all of it [T, 3, 3], m, world, in the tissue at rest."""
        cuts, known = self._cuts, len(self.cuts)
        if not cuts.extends(triangles):
            cuts.heal()
            self._clipped, known = self._covars.copy(), 0
            self.rebind(cuts.index, cuts.weights)
            self.covars.copy_(torch.from_numpy(self._clipped))
        rebound = cuts.cut(triangles)
        clipped = clip_to_sides(cuts.means, self._clipped, self._reach, cuts.triangles[known:])
        for tensor, values, some in (
            (self.neighbours, cuts.index, rebound),
            (self.weights, cuts.weights, rebound),
            (self.covars, self._clipped, clipped),
        ):
            rows = torch.from_numpy(values[some]).to(tensor.device, tensor.dtype)
            tensor[torch.from_numpy(some).to(tensor.device)] = rows

    @property
    def cuts(self) -> np.ndarray:
        """The cuts that are heeded [T, 3, 3], m, world, at rest."""
        return self._cuts.triangles

    def rebind(self, index: np.ndarray, weights: np.ndarray) -> None:
        """Let Gaussians follow other nodes from now on, e.g. those on their side of a cut.

        Args:
            index: Nodes that move each Gaussian [N, K], 0 to M − 1; K may differ from before.
            weights: Their weights [N, K], which add up to one; a node with weight zero moves nothing.

        Raises:
            ValueError: If shapes disagree, a node does not exist, or weights do not add up to one; nothing changes then.
        """
        index, weights = np.asarray(index), np.asarray(weights)
        count = len(self.means)
        if index.ndim != 2 or len(index) != count or not index.shape[1] or index.shape != weights.shape:
            raise ValueError(f"skinning: index has shape {index.shape} and weights {weights.shape}, expected both [{count}, K] with K > 0")
        if index.dtype.kind not in "iu" or (index.size and not 0 <= index.min() <= index.max() < len(self.node_rest)):
            raise ValueError(f"skinning: index must hold whole numbers from 0 to {len(self.node_rest) - 1}, the nodes there are")
        if not (weights >= 0).all() or not (np.abs(weights.sum(1) - 1) < 1e-4).all():
            raise ValueError("skinning: the weights of a Gaussian must not be negative and must add up to one")
        self.neighbours = torch.tensor(index, dtype=torch.int32, device=self.device)  # [N, K]
        self.weights = torch.tensor(weights, dtype=torch.float32, device=self.device)  # [N, K]

    def deform(self, positions: Tensor | np.ndarray, F: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
        """Means [N, 3] (m) and covariances [N, 3, 3] (m²) of the Gaussians.

        The nodes are at positions [M, 3] (m, world) with deformation gradients F [M, 3, 3]. The singular values of
        every Gaussian's F are clamped to ``STRETCH_RANGE``.
        """
        positions = self._nodes("positions", positions, (3,))
        F = self._nodes("F", F, (3, 3))
        means, covars = self._skin(positions, F)
        if self.weighting == "softmax":
            R = torch.empty_like(F)
            self._launch(kernels.node_rotations, len(F), [_array(F, wp.mat33), _array(R, wp.mat33)])
            means, _ = self._skin(positions, R)
        return means, covars

    def rotations(self, F: Tensor | np.ndarray) -> Tensor:
        """Rotation of every Gaussian [N, 3, 3] for node F [M, 3, 3]; its transpose turns view directions where the
        SH degree is above 0."""
        F = self._nodes("F", F, (3, 3))
        out = torch.empty_like(self.covars)
        inputs = [_array(self.neighbours), _array(self.weights), _array(F, wp.mat33), _array(out, wp.mat33)]
        self._launch_shares(kernels.blend_rotations, len(out), inputs)
        return out

    def _nodes(self, name: str, values: Tensor | np.ndarray, shape: tuple[int, ...]) -> Tensor:
        values = torch.as_tensor(values).detach().to(self.device, torch.float32).contiguous()
        expected = (len(self.node_rest), *shape)
        if tuple(values.shape) != expected:
            raise ValueError(f"skinning: {name} has shape {tuple(values.shape)}, expected {expected}")
        return values

    def _skin(self, positions: Tensor, A: Tensor) -> tuple[Tensor, Tensor]:
        """Means [N, 3] and covariances [N, 3, 3] for node transforms A [M, 3, 3]."""
        maps = torch.empty((len(A), 4, 4), device=self.device)
        inputs = [_array(self.node_rest, wp.vec3), _array(positions, wp.vec3), _array(A, wp.mat33), self._origin, _array(maps, wp.mat44)]
        self._launch(kernels.node_maps, len(A), inputs)
        if self.device == "cpu" and not maps.any():  # nothing has moved yet
            return self.means.clone(), self.covars.clone()
        means, covars = torch.empty_like(self.means), torch.empty_like(self.covars)
        inputs = [_array(self.means, wp.vec3), _array(self.covars, wp.mat33), _array(self.neighbours), _array(self.weights)]
        inputs += [_array(maps, wp.mat44), self._origin, *STRETCH_RANGE, _array(means, wp.vec3), _array(covars, wp.mat33)]
        self._launch_shares(self._kernel(), len(means), inputs)
        return means, covars

    def launches(
        self, u: wp.array, F: wp.array, pinned: np.ndarray, environments: int
    ) -> tuple[list[Launch | list[Launch]], Tensor, Tensor]:
        """What computes `deform` from the state of a solver, as launches (those in a list may run at the same time), and the
        means [B, N, 3] and covariances [B, N, 3, 3] that they overwrite.

        Args:
            u: Displacements of the nodes in all environments [B · M].
            F: Their deformation gradients [B · M].
            pinned: Nodes that never move [M].
            environments: B.

        Raises:
            ValueError: If the weights are not compact, or the nodes or the device are others than the solver's.
        """
        count, device = len(self.node_rest), self.device
        if self.weighting != "compact":
            raise ValueError(f"skinning: weights {self.weighting} cannot be part of the step; use compact")
        if len(pinned) != count or u.shape != (environments * count,) or str(u.device) != device:
            raise ValueError(f"skinning: {count} nodes on {device} cannot follow {environments} × {len(pinned)} nodes on {u.device}")
        means, covars = (rest.repeat(environments, *[1] * rest.ndim) for rest in (self.means, self.covars))
        maps = torch.zeros((environments, count, 4, 4), device=device)
        array = functools.partial(wp.from_torch, requires_grad=False)  # which keeps the tensor
        held = array(torch.from_numpy(pinned).to(device, torch.int32))
        inputs = [array(self.node_rest, wp.vec3), held, u, F, self._origin, array(maps.view(-1, 4, 4), wp.mat44)]
        done: list[Launch | list[Launch]] = [Launch(kernels.moved_node_maps, (environments, count), inputs)]
        at_rest = [array(self.means, wp.vec3), array(self.covars, wp.mat33), array(self.neighbours), array(self.weights)]
        limits = [self._origin, *STRETCH_RANGE]
        if not self._vectorised:
            outputs = [array(means.view(-1, 3), wp.vec3), array(covars.view(-1, 3, 3), wp.mat33)]
            inputs = [count, *at_rest, array(maps.view(-1, 4, 4), wp.mat44), *limits, *outputs]
            done.append(Launch(kernels.skin_environments, (environments, len(self.means)), inputs))
        else:
            for b in range(environments):
                outputs = [array(means[b], wp.vec3), array(covars[b], wp.mat33)]
                inputs = [*at_rest, array(maps[b], wp.mat44), *limits, *outputs]
                own = self._shares(len(self.means))
                done.append([Launch(simd_kernels.skin_gaussians, size, [first, *inputs]) for first, size in own])
        return done, means, covars

    def _kernel(self) -> wp.Kernel:
        return simd_kernels.skin_gaussians if self._vectorised else kernels.skin_gaussians

    def _launch(self, kernel, count: int, inputs: list) -> None:
        with on_torch_stream(self.device):
            wp.launch(kernel, count, inputs, device=self.device)

    def _launch_shares(self, kernel, count: int, inputs: list) -> None:
        """Launch a kernel whose first argument is an offset: at once on CUDA, in shares on the CPU."""
        jobs = [functools.partial(self._launch, kernel, size, [first, *inputs]) for first, size in self._shares(count)]
        run_in_threads(jobs)

    def _shares(self, count: int) -> list[tuple[int, int]]:
        """First and number of the Gaussians of each thread."""
        return shares(count, SHARED_FROM) if self.device == "cpu" else [(0, count)]


@functools.cache
def _load_kernels(device: str) -> None:
    """Compile the kernels before several threads ask for them."""
    for module in (kernels, simd_kernels) if device == "cpu" else (kernels,):
        wp.load_module(module, device)


def _array(tensor: Tensor, dtype=None):
    """A tensor as a kernel argument, without copying."""
    return wp.from_torch(tensor, dtype, requires_grad=False, return_ctype=True)
