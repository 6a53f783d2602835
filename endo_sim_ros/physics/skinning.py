"""Skinning: Gaussians follow their nearest control nodes (paper eq. 9, 10)."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import pick_device, upload
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.growing import Growing
from endo_sim_ros.core.kernels import load_kernels
from endo_sim_ros.core.reflections import GRAZING, Seen
from endo_sim_ros.physics import node_map_kernels as kernels
from endo_sim_ros.physics.backends import backend_for
from endo_sim_ros.physics.backends.base import Launch, Work, viewed
from endo_sim_ros.physics.backends.structs import Skin
from endo_sim_ros.physics.cutting.gaussians import CutNeighbours, crop_to_sides
from endo_sim_ros.physics.motion import HeldMotion
from endo_sim_ros.physics.weights import compact_weights, nearest_nodes

_UNBOUNDED = (-1e18, 1e18)  # of F; infinite bounds would make numbers that are none of zeros


def bind_weights(means: np.ndarray, node_rest: np.ndarray, neighbours: int, weighting: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest control nodes [N, K] int32 of means, and their weights [N, K] float32, which add up to one.

    Args:
        means: Of the Gaussians at rest [N, 3], m.
        node_rest: Control nodes at rest [M, 3], m.
        neighbours: K; fewer where there are no more than K control nodes.
        weighting: ``compact``, see `compact_weights`, or ``softmax``, exp(d)/Σ exp(d) of distances d, m, as the paper prints it.

    Raises:
        ValueError: If the weighting is another.
    """
    if weighting not in ("compact", "softmax"):
        raise ValueError(f"skinning: weighting must be compact or softmax, not {weighting!r}")
    count = min(neighbours, max(len(node_rest) - 1, 1))
    distances, index = nearest_nodes(node_rest, means, count + 1)
    d, beyond = distances[:, :count], distances[:, count:]
    if weighting == "softmax":
        weights = np.exp(d - d.max(1, keepdims=True)) if len(d) else d
        weights = weights / weights.sum(1, keepdims=True)
    else:
        weights = compact_weights(d, beyond)
    return index[:, :count].astype(np.int32), weights.astype(np.float32)


class Skinning:
    """Moves a model's Gaussians with control nodes.

    Args:
        model: Gaussians at rest, world.
        node_rest: Control nodes at rest [M, 3], metres, world.
        neighbours: Number of nearest control nodes K that move one Gaussian.
        weighting: ``compact`` (with F_k) or the paper's ``softmax`` (with R_k), see :func:`bind_weights`.
        stretch: Bounds that the singular values of every Gaussian's F are clamped to; beyond them a picture shows needles
            or holes, not tissue. None takes F as it is, as the paper prints it.
        device: Where to compute: auto, cpu, cuda or cuda:N.

    Raises:
        ValueError: If there are no control nodes, positions are not finite, or there is no such weighting.
    """

    def __init__(
        self,
        model: GaussianModel,
        node_rest: np.ndarray | Tensor,
        *,
        neighbours: int = 4,
        weighting: Literal["compact", "softmax"] = "compact",
        stretch: tuple[float, float] | None = (0.2, 4.0),
        device: str = "auto",
    ):
        self.device = pick_device(device)
        self.backend = backend_for(self.device)
        load_kernels((kernels, *self.backend.skin_modules), self.device)
        self.weighting, self.stretch = weighting, stretch or _UNBOUNDED
        rest = torch.as_tensor(node_rest).detach().cpu().double().numpy()
        means = model.means.detach().cpu().double().numpy()
        if rest.ndim != 2 or rest.shape[1] != 3 or not len(rest):
            raise ValueError(f"skinning: node_rest has shape {rest.shape}, expected [M, 3] with M > 0")
        if not np.isfinite(rest).all() or not np.isfinite(means).all():
            raise ValueError("skinning: node positions and Gaussian means must be finite")
        model = model.detach().to(self.device)
        self.means = model.means.float().clone(memory_format=torch.contiguous_format)  # [N, 3] m, at rest; cuts move those that they crop
        self.covars = model.covariances.float().contiguous()  # [N, 3, 3] m², at rest
        self._gloss, self._lobes = _gloss(model), model.light
        self.node_rest = torch.from_numpy(rest).float().to(self.device).contiguous()  # [M, 3] m
        x, y, z = rest.mean(0).tolist()
        self._origin = x, y, z  # of the maps, m
        index, weights = bind_weights(means, rest, neighbours, weighting)
        self.rebind(index, weights)
        self._cuts = CutNeighbours(means, rest, index, weights)
        self._beside = torch.zeros(0, dtype=torch.long, device=self.device)  # numbers of those that cuts have moved or shrunk
        self._whole = means, self.covars.cpu().double().numpy()  # at rest, without cuts
        self._cropped = [Growing(each.copy()) for each in self._whole]  # as the cuts left them
        self._extents = Growing(2 * np.sqrt(np.trace(self._whole[1], axis1=1, axis2=2)))

    def cut(self, triangles: np.ndarray) -> bool:
        """Let no Gaussian follow nodes, or reach, across a cut: all of it [T, 3, 3], m, world, in the tissue at rest.

        Returns whether it goes on from the cuts so far. If not, those have healed, and the Gaussians that `append` added are gone.
        """
        cuts, known = self._cuts, len(self.cuts)
        extends = cuts.extends(triangles)
        if not extends:
            cuts.heal()
            count, known = len(self._whole[0]), 0
            for each in (*self._cropped, self._extents):
                each.shorten(count)
            for cropped, tensor, values in zip(self._cropped, (self.means, self.covars), self._whole):
                cropped.rows[:] = values
                tensor[:count] = torch.from_numpy(values)
            self.means, self.covars, self._beside = self.means[:count], self.covars[:count], self._beside[:0]
            self._gloss = None if self._gloss is None else [each[:count] for each in self._gloss]
            self.rebind(cuts.index, cuts.weights)
        rebound = cuts.cut(triangles)
        means, covars = (each.rows for each in self._cropped)
        cropped = crop_to_sides(means, covars, self._extents.rows, cuts.triangles[known:])
        for tensor, values, some in (
            (self.neighbours, cuts.index, rebound),
            (self.weights, cuts.weights, rebound),
            (self.means, means, cropped),
            (self.covars, covars, cropped),
        ):
            rows = torch.from_numpy(values[some]).to(tensor.device, tensor.dtype)
            tensor[torch.from_numpy(some).to(tensor.device)] = rows
        if len(some := np.union1d(rebound, cropped)):
            self._beside = torch.cat([self._beside, torch.from_numpy(some).to(self.device)]).unique()
        return extends

    def append(self, model: GaussianModel) -> None:
        """Move more Gaussians, on the device of this one, behind the others; they heed the cuts so far, and last until these heal."""
        means, covars = model.means.float(), model.covariances.float()
        at, spread = means.cpu().double().numpy(), covars.cpu().double().numpy()
        cuts, count = self._cuts, len(self.means)
        index, weights = bind_weights(at, cuts.node_rest, cuts.index.shape[1], self.weighting)
        cuts.append(at.copy(), index, weights)
        extents = 2 * np.sqrt(np.trace(spread, axis1=1, axis2=2))
        crop_to_sides(at, spread, extents, cuts.triangles)
        for each, new in zip((*self._cropped, self._extents), (at, spread, extents)):
            each.append(new)
        added = [torch.from_numpy(each).to(self.device) for each in (at, spread, cuts.index[count:], cuts.weights[count:])]
        added += [] if self._gloss is None else _gloss(model) or []
        if not self._grown:
            self._grown = [Growing(each) for each in (self.means, self.covars, self.neighbours, self.weights, *(self._gloss or []))]
        self.means, self.covars, self.neighbours, self.weights, *gloss = (each.append(new) for each, new in zip(self._grown, added))
        self._gloss = None if self._gloss is None else gloss
        self._bind()

    @property
    def cuts(self) -> np.ndarray:
        """The cuts that are heeded [T, 3, 3], m, world, at rest."""
        return self._cuts.triangles

    def rebind(self, index: np.ndarray, weights: np.ndarray) -> None:
        """Let Gaussians follow other control nodes from now on, e.g. those on their side of a cut.

        Args:
            index: Control nodes that move each Gaussian [N, K], 0 to M − 1; K may differ from before.
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
        self._grown: list[Growing[Tensor]] = []  # means, covars, neighbours, weights and gloss, from the next `append` on
        self._bind()

    def _bind(self) -> None:
        """Let kernels find what Gaussians there are, and what they follow."""
        self._rest = rest = Skin()  # views of these tensors
        rest.means, rest.covars = viewed(self.means, wp.vec3), viewed(self.covars, wp.mat33)
        rest.neighbours, rest.weights = viewed(self.neighbours), viewed(self.weights)
        rest.origin, (rest.low, rest.high) = wp.vec3(*self._origin), self.stretch

    def deform(self, positions: Tensor | np.ndarray, F: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
        """Return means [N, 3] (m) and covariances [N, 3, 3] (m²) of the Gaussians.

        Args:
            positions: Of the control nodes [M, 3], m, world.
            F: Their deformation gradients [M, 3, 3].
        """
        positions = self._nodes("positions", positions, (3,))
        F = self._nodes("F", F, (3, 3))
        means, covars = self._skin(positions, F)
        if self.weighting == "softmax":
            R = torch.empty_like(F)
            self.backend.over_items(kernels.node_rotations, len(F), [F, R])
            means, _ = self._skin(positions, R)
        return means, covars

    def rotations(self, F: Tensor | np.ndarray) -> Tensor:
        """Return the rotation of every Gaussian [N, 3, 3] for F of the control nodes [M, 3, 3]; its transpose turns view
        directions where the SH degree is above 0."""
        F = self._nodes("F", F, (3, 3))
        out = torch.empty_like(self.covars)
        self.backend.over_items(kernels.blend_rotations, len(out), [self.neighbours, self.weights, F, out])
        return out

    def strains(self, F: Tensor) -> Tensor:
        """Return how far tissue is strained at each Gaussian, the Frobenius norm of Green's strain (Fᵀ F − 1) / 2, [N] or [B, N].

        It is the largest of its control nodes: what covers a Gaussian may be strained, and leave it, while its own tissue is not. Beside
        cuts it is infinite, as what covers Gaussians there has been cropped.

        Args:
            F: Of the control nodes [M, 3, 3], or of each of B copies of the tissue [B, M, 3, 3].
        """
        F = torch.as_tensor(F, dtype=torch.float32, device=self.device).contiguous()
        strains, out = F.new_empty(F.shape[:-2]), F.new_empty((*F.shape[:-3], len(self.means)))
        self.backend.over_items(kernels.node_strains, strains.numel(), [F, strains])
        self.backend.over_items(kernels.largest_strains, out.numel(), [self.neighbours, self.weights, strains, len(self.node_rest), out])
        return out.index_fill_(-1, self._beside, torch.inf) if len(self._beside) else out

    def seen(self, F: Tensor | np.ndarray, means: Tensor, eyes: Tensor | Sequence[np.ndarray], sh: Tensor) -> Seen:
        """Return what eyes see of the Gaussians, as normals turn with the tissue; without gradients.

        Args:
            F: Of the control nodes [M, 3, 3], or of each of B copies of the tissue [B, M, 3, 3].
            means: Of the Gaussians [N, 3], or [B, N, 3], m, world.
            eyes: Where each is seen from [B, 3], m, world.
            sh: Coefficients [N, 1, 3], or [B, N, 1, 3], of the tissue itself.

        Raises:
            ValueError: If the model does not reflect, or shapes disagree.
        """
        if self._gloss is None or self._lobes is None:
            raise ValueError("skinning: the model has no gloss or no light, and so reflects nothing")
        copies = F.ndim == 4
        F = torch.as_tensor(F, dtype=torch.float32, device=self.device).contiguous() if copies else self._nodes("F", F, (3, 3))
        if not isinstance(eyes, Tensor):
            (eyes,) = upload(self.device, np.asarray(eyes))
        means, eyes, sh = (each.float().contiguous() for each in (means, eyes, sh))
        size = len(eyes), len(self.means)
        for name, tensor, shape in (("means", means, (3,)), ("sh", sh, (1, 3))):
            if tensor.shape not in ((size[1], *shape), (*size, *shape)):
                raise ValueError(f"skinning: {name} has shape {tuple(tensor.shape)}, expected {(size[1], *shape)} or {(*size, *shape)}")
        if copies and F.shape[:2] != (size[0], len(self.node_rest)):
            raise ValueError(f"skinning: F has shape {tuple(F.shape)}, expected {(size[0], len(self.node_rest), 3, 3)}")
        found = Seen(F.new_empty((*size, 1, 3)), F.new_empty((*size, 4)))
        lobes = [self._lobes.sheen_sharpness, self._lobes.facing, GRAZING]
        now = [F, copies * len(self.node_rest), means, eyes, sh]
        self.backend.over_items(kernels.see, size[0] * size[1], [self.neighbours, self.weights, *self._gloss, *lobes, *now, *found])
        return found

    def _nodes(self, name: str, values: Tensor | np.ndarray, shape: tuple[int, ...]) -> Tensor:
        if isinstance(values, np.ndarray) and self.device != "cpu":
            (values,) = upload(self.device, values)
        values = torch.as_tensor(values).detach().to(self.device, torch.float32).contiguous()
        expected = (len(self.node_rest), *shape)
        if tuple(values.shape) != expected:
            raise ValueError(f"skinning: {name} has shape {tuple(values.shape)}, expected {expected}")
        return values

    def _skin(self, positions: Tensor, A: Tensor) -> tuple[Tensor, Tensor]:
        """Means [N, 3] and covariances [N, 3, 3] for transforms A of the control nodes [M, 3, 3]."""
        maps = torch.empty((len(A), 4, 4), device=self.device)
        self.backend.over_items(kernels.node_maps, len(A), [self.node_rest, positions, A, self._origin, maps])
        means, covars = torch.empty_like(self.means), torch.empty_like(self.covars)
        self.backend.skin(self._rest, maps, means, covars)
        return means, covars

    def work(
        self, u: wp.array, F: wp.array, pinned: np.ndarray, motion: HeldMotion, environments: int
    ) -> tuple[list[Work], Tensor, Tensor]:
        """Return the work that computes `deform` from the state of a solver, and the means [B, N, 3] and covariances
        [B, N, 3, 3] that it overwrites.

        Args:
            u: Displacements of the control nodes in all environments [B · M].
            F: Their deformation gradients [B · M].
            pinned: Control nodes that are held [M].
            motion: Where breath and heart have these.
            environments: B.

        Raises:
            ValueError: If the weights are not compact, or the control nodes or the device are others than the solver's.
        """
        count, device = len(self.node_rest), self.device
        if self.weighting != "compact":
            raise ValueError(f"skinning: weights {self.weighting} cannot be part of the step; use compact")
        if len(pinned) != count or u.shape != (environments * count,) or str(u.device) != device:
            raise ValueError(f"skinning: {count} nodes on {device} cannot follow {environments} × {len(pinned)} nodes on {u.device}")
        means, covars = (rest.repeat(environments, *[1] * rest.ndim) for rest in (self.means, self.covars))
        maps = torch.zeros((environments, count, 4, 4), device=device)
        fixed = viewed(torch.from_numpy(pinned).to(device, torch.int32))
        inputs = [viewed(self.node_rest, wp.vec3), fixed, u, F, motion.follows, motion.held, self._origin]
        inputs.append(viewed(maps.view(-1, 4, 4), wp.mat44))
        mapping = Launch(kernels.moved_node_maps, (environments, count), inputs)
        return [mapping, *self.backend.skin_work(self._rest, maps, means, covars)], means, covars


def _gloss(model: GaussianModel) -> list[Tensor] | None:
    """Normals of the Gaussians at rest, of surface and film [N, 2, 3], and strengths of sheen and glints [N, 2], if they have a gloss."""
    if model.gloss is None:
        return None
    gloss = model.gloss.float()
    return [gloss[:, :6].unflatten(1, (2, 3)).contiguous(), torch.nn.functional.softplus(gloss[:, 6:])]
