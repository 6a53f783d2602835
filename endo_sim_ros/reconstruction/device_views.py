"""Training views on the compute device."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.reconstruction.scene import TrainingView


@dataclass(frozen=True)
class DeviceView:
    """A training view as tensors."""

    camera: Camera
    image: Tensor  # [H, W, 3] in [0, 1]
    prior: Tensor | None  # [H, W] depth prior, m, 0 = none
    mask: Tensor | None  # [H, W] 1 = tissue; None = all of it
    paths: Tensor | None  # [parts, 3] m
    index: int  # among the training views
    index_tensor: Tensor  # [1] the same
    viewmats: Tensor  # [1, 4, 4], as `matrices` gives it
    Ks: Tensor  # [1, 3, 3]

    @classmethod
    def of(cls, view: TrainingView, index: int, device: str) -> "DeviceView":
        """A view on a device."""
        tensor = lambda array: torch.tensor(array, dtype=torch.float32, device=device)
        tissue, prior, paths = view.tissue, view.depth_prior, view.paths
        return cls(
            view.camera,
            tensor(view.image) / 255,
            None if prior is None else tensor(prior),
            None if tissue.all() else tensor(tissue),
            None if paths is None else tensor(paths),
            index,
            torch.tensor([index], device=device),
            *matrices([view.camera], device),
        )


def matrices(cameras: Sequence[Camera], device: str) -> tuple[Tensor, Tensor]:
    """Of cameras, viewmats [C, 4, 4] and Ks [C, 3, 3]."""
    # Without waiting for what the GPU still does.
    tensor = lambda arrays: torch.from_numpy(np.stack(arrays).astype(np.float32)).to(device, non_blocking=True)
    return tensor([camera.viewmat for camera in cameras]), tensor([camera.K for camera in cameras])


def project(viewmats: Tensor, K: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Columns, rows (pixels) and depths (m) [..., N] of points [N, 3] (m, world) in cameras: world to camera [..., 4, 4], K [..., 3, 3].

    What is not ahead of a camera is anywhere.
    """
    # Without a matrix product: libraries give other last bits with other numbers of threads.
    x, y, z = (sum(viewmats[..., r, i, None] * points[:, i] for i in range(3)) + viewmats[..., r, 3, None] for r in range(3))
    ahead = z.clamp_min(1e-6)
    u, v = (part / ahead * K[..., axis, axis, None] + K[..., axis, 2, None] for axis, part in enumerate((x, y)))
    return u, v, z


def inside(u: Tensor, v: Tensor, z: Tensor, width: int | Tensor, height: int | Tensor) -> Tensor:
    """Which of what `project` returns is in pictures of a size, pixels, and ahead of the camera."""
    return (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)


def shown(view: DeviceView, points: Tensor) -> Tensor:
    """Which points [N, 3] (m, world) lie in the picture of a view, on its tissue, hidden or not [N]."""
    camera = view.camera
    u, v, z = project(view.viewmats[0], view.Ks[0], points)
    within = inside(u, v, z, camera.width, camera.height)
    if view.mask is None:
        return within
    pixels = torch.where(within, v.long() * camera.width + u.long(), 0)
    return within & (view.mask.reshape(-1)[pixels] > 0)


def reprojected_prior(prior: Tensor, camera: Camera, viewmat: Tensor) -> Tensor:
    """The depth prior [H, W] of a camera as another one [4, 4] of its kind sees it [H, W], metres; 0 where nothing falls."""
    height, width = prior.shape
    v, u = (prior > 0).nonzero(as_tuple=True)
    K, pose = (torch.tensor(matrix).to(viewmat) for matrix in (camera.K, camera.pose))
    z = prior[v, u]
    points = torch.stack([(u + 0.5 - K[0, 2]) / K[0, 0] * z, (v + 0.5 - K[1, 2]) / K[1, 1] * z, z], 1)
    u, v, z = project(viewmat @ pose, K, points)
    within = inside(u, v, z, width, height)
    pixels = v[within].long() * width + u[within].long()
    nearest = torch.full((height * width,), math.inf, device=z.device).scatter_reduce(0, pixels, z[within], "amin")
    return torch.where(nearest.isfinite(), nearest, 0).view(height, width)


def carried(images: Tensor, K: Tensor, turn: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """The values of a camera's images where another camera of its kind sees the same tissue, and how far that is from the first one.

    Args:
        images: [C, H, W] of the first camera.
        K: Of both [3, 3], pixels.
        turn: From the frame of the second camera to that of the first [4, 4].
        depth: What the second one sees [H, W], m.

    Returns:
        Values [C, H, W], 0 beyond the picture, and depths [H, W], m.
    """
    height, width = depth.shape
    count = lambda size: torch.arange(size, device=depth.device) + 0.5
    x, y = (count(width) - K[0, 2]) / K[0, 0], ((count(height) - K[1, 2]) / K[1, 1])[:, None]
    u, v, z = project(turn, K, torch.stack([x * depth, y * depth, depth], -1).view(-1, 3))
    where = torch.stack([u * (2 / width) - 1, v * (2 / height) - 1], -1).view(1, height, width, 2)
    return grid_sample(images[None], where, align_corners=False)[0], z.view(height, width)
