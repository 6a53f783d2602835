"""How far tissue goes with a motion, place by place, which training corrects by the colours of the views, beside the Gaussians."""

import dataclasses

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.tissue_motion import TissueMotion, displaced
from endo_sim_ros.reconstruction.optimizer import Adam
from endo_sim_ros.reconstruction.stage_configs import MotionSearchConfig


class LearntMotion:
    """Corrections of the shares that were found, which are smooth between nodes.

    Ways stay as all tracks together told them: views are fewer than the numbers of a way, and brightness lets it slide along the rays.
    The correction at x is Σ w(x) s over the nodes n, of correction s, with w = softmax(-½ |x - n|² / d²), where d is how far nodes are
    apart. Its slope is (Σ w s n - Σ w s Σ w n) / d².

    Args:
        motion: As it was found.
        means: Mean positions [N, 3] of the Gaussians, m, world.
        options: Of the search for motion.
        device: Where to compute.
    """

    def __init__(self, motion: TissueMotion, means: np.ndarray, options: MotionSearchConfig, device: str) -> None:
        tensor = lambda array: torch.tensor(array, dtype=torch.float32, device=device)
        self._found, self._options = motion, options
        self._nodes = _spread(motion.points, options.nodes)
        self._apart = float(np.median(KDTree(self._nodes).query(self._nodes, k=2)[0][:, 1]))  # infinite with one node: no slope
        self._places = tensor((self._nodes - self._nodes.mean(0)) / self._apart)  # [nodes, 3]: near 0, for single precision
        self._reach = max(part.reach for part in motion.parts)  # m
        self.found = tensor(motion.follows(means))
        """How each Gaussian follows the motion that was found [N, parts, 4]."""
        self.weights = tensor(self._weights_at(means))
        """Weights of the nodes at each Gaussian [N, nodes]: with 32 nodes 128 bytes of each."""
        self.set(self.found.new_zeros(len(self._nodes), len(motion.parts)))

    def set(self, shares: Tensor) -> None:
        """Start optimising the corrections of the shares at the nodes [nodes, parts]."""
        self.tensors = {"shares": shares.clone().requires_grad_()}
        self.optimizer = Adam(self.tensors, {"shares": 0.0})

    def begin_step(self, progress: float, step_size: float) -> None:
        """Let the next step move what goes farthest by about as much as Gaussians, m, once so much of the training is done, 0 to 1."""
        start = self._options.learn_from
        self.optimizer.set_rate("shares", step_size / self._reach if start <= progress and start < 1 else 0.0)

    @property
    def follows(self) -> Tensor:
        """How the Gaussians follow each part [N, parts, 4], as `TissueMotion.follows` has it; with gradients."""
        shares = self.tensors["shares"]
        at_nodes = torch.cat([shares, (shares[..., None] * self._places[:, None]).flatten(1), self._places], 1)
        # Steps have one thread on a CPU: with more, a matrix product may have other last bits.
        levels, moments, centers = (self.weights @ at_nodes).split([shares.shape[1], 3 * shares.shape[1], 3], 1)
        slopes = (moments.unflatten(1, (-1, 3)) - levels[..., None] * centers[:, None]) / self._apart
        return self.found + torch.cat([levels[..., None], slopes], 2)

    def displaced(self, model: GaussianModel, paths: Tensor) -> GaussianModel:
        """The model where its tissue has moved to at the time of `TissueMotion.paths` [parts, 3], m; with gradients."""
        return displaced(model, self.follows, paths)

    def refine(self, source: Tensor) -> None:
        """Go on with other Gaussians, each of which comes from one before [N]; as many as before stay where captured steps find them."""
        for name in ("found", "weights"):
            old = getattr(self, name)
            new = old[source]
            setattr(self, name, old.copy_(new) if len(new) == len(old) else new)

    @property
    def motion(self) -> TissueMotion:
        """As it was learnt."""
        corrections = self._weights_at(self._found.points) @ self.tensors["shares"].detach().cpu().double().numpy()
        pairs = zip(self._found.parts, corrections.T)
        parts = tuple(dataclasses.replace(part, shares=part.shares + correction) for part, correction in pairs)
        return dataclasses.replace(self._found, parts=parts)

    def _weights_at(self, places: np.ndarray) -> np.ndarray:
        """Weights of the nodes at places [N, 3], m, world: [N, nodes]."""
        exponents = -0.5 * cdist(places, self._nodes, "sqeuclidean") / self._apart**2
        weights = np.exp(exponents - exponents.max(1, keepdims=True))
        return weights / weights.sum(1, keepdims=True)


def _spread(points: np.ndarray, count: int) -> np.ndarray:
    """At most so many of the points [N, 3], each the farthest from those before."""
    chosen = [0]
    distances = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]
