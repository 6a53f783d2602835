"""What both ways to rasterise take, and how tensors become arguments of Warp kernels."""

from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.splatting.common_kernels import TILE


class Scene(NamedTuple):
    """N Gaussians, or as many for each camera, and C cameras: float32, contiguous, on one device. As in `rasterize`."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    sh: Tensor
    viewmats: Tensor
    Ks: Tensor
    background: Tensor

    @property
    def gaussian_count(self) -> int:
        """N."""
        return self.means.shape[-2]

    @property
    def splat_count(self) -> int:
        return len(self.viewmats) * self.gaussian_count

    @property
    def apart(self) -> int:
        """Whether each camera has means and covariances of its own."""
        return int(self.means.ndim == 3)

    def gaussian_arguments(self) -> list:
        """With these `project` and `project_backward` begin."""
        return [self.means, self.quats, self.scales, self.covars, int(self.covars is not None)]


class Settings(NamedTuple):
    """How to draw it."""

    width: int
    height: int
    near: float
    eps2d: float
    median: bool

    @property
    def tiles_x(self) -> int:
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        return -(-self.height // TILE)


class Gradients(NamedTuple):
    """Of a scene; None where there is nothing to differentiate, or nobody asked."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    sh: Tensor
    camera_shares: Tensor | None  # [C, N, 4, 4] what each Gaussian adds to the gradient of each camera's viewmat
    absolutes: Tensor | None  # [C, N, 2]

    @classmethod
    def empty(cls, scene: Scene, wants_pose: bool, wants_absolute: bool) -> "Gradients":
        """Room for them."""
        room = [None if x is None else torch.empty_like(x) for x in scene[:6]]
        size = (len(scene.viewmats), scene.gaussian_count)
        shares = scene.means.new_empty(*size, 4, 4) if wants_pose else None
        return cls(*room, shares, scene.means.new_empty(*size, 2) if wants_absolute else None)


def empty_images(scene: Scene, settings: Settings) -> tuple[list[Tensor], Tensor]:
    """Room for colours, depths, alphas and distortions, and for the owners of median depths, if those are wanted."""
    size = (len(scene.viewmats), settings.height, settings.width)
    images = [scene.means.new_empty(*size, 3)] + [scene.means.new_empty(size) for _ in range(3)]
    owners = torch.empty(size if settings.median else 0, dtype=torch.int32, device=scene.means.device)
    return images, owners


def kernel_arguments(kernel, arguments: list, offset: int = 0) -> list:
    """Arguments of a kernel from the one at an offset on, tensors among them as arrays of the kernel's types, not copied.

    None becomes an array that must not be read.
    """
    types = [argument.type for argument in kernel.adj.args[offset:]]
    return [_array(kind, x) if isinstance(x, Tensor) else x for kind, x in zip(types, arguments, strict=True)]


def _array(kind, tensor: Tensor):
    tensor = tensor.detach()
    dims = kind.ndim + len(getattr(kind.dtype, "_shape_", ()))
    if tensor.ndim > dims:  # the kernel counts through the first ones
        tensor = tensor.view(-1, *tensor.shape[tensor.ndim - dims + 1 :])
    return wp.from_torch(tensor, dtype=kind.dtype, requires_grad=False, return_ctype=True)
