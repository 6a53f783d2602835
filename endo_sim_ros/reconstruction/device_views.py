"""Training views on the compute device."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction import losses
from endo_sim_ros.reconstruction.scene import TrainingView


@dataclass(frozen=True)
class DeviceView:
    """A training view as tensors."""

    camera: Camera
    image: Tensor  # [H, W, 3] in [0, 1]
    prior: Tensor | None  # [H, W] depth prior, m, 0 = none
    mask: Tensor | None  # [H, W] 1 = tissue; None = all of it
    exposure: int  # whose exposure it has: its own, or that of the left view of its pair
    exposure_index: Tensor  # [1] the same

    @classmethod
    def of(cls, view: Frame, exposure: int, device: str) -> "DeviceView":
        """A view, with or without depth prior, on a device."""
        tensor = lambda array: torch.tensor(array, dtype=torch.float32, device=device)
        tissue, prior = view.tissue, view.depth_prior if isinstance(view, TrainingView) else None
        return cls(
            view.camera,
            tensor(view.image) / 255,
            None if prior is None else tensor(prior),
            None if tissue.all() else tensor(tissue),
            exposure,
            torch.tensor([exposure], device=device),
        )


def matrices(cameras: Sequence[Camera], device: str) -> tuple[Tensor, Tensor]:
    """Of cameras, viewmats [C, 4, 4] and Ks [C, 3, 3]."""
    # Without waiting for what the GPU still does.
    tensor = lambda arrays: torch.from_numpy(np.stack(arrays).astype(np.float32)).to(device, non_blocking=True)
    return tensor([camera.viewmat for camera in cameras]), tensor([camera.K for camera in cameras])


def reprojected_prior(view: DeviceView, viewmat: Tensor) -> Tensor:
    """The prior of a view as another camera [4, 4] of its kind sees it [H, W], metres; 0 where nothing falls."""
    height, width = view.prior.shape
    v, u = (view.prior > 0).nonzero(as_tuple=True)
    K, pose = (torch.tensor(matrix).to(viewmat) for matrix in (view.camera.K, view.camera.pose))
    z = view.prior[v, u]
    local = torch.stack([(u + 0.5 - K[0, 2]) / K[0, 0] * z, (v + 0.5 - K[1, 2]) / K[1, 1] * z, z], 1)
    index, inside, z = losses.seen_at(local, viewmat @ pose, K, None, view.prior.shape)
    nearest = torch.full((height * width,), math.inf, device=z.device).scatter_reduce(0, index[inside], z[inside], "amin")
    return torch.where(nearest.isfinite(), nearest, 0).view(height, width)


def nearest_views(cameras: Sequence[Camera]) -> list[int]:
    """Index of each camera's nearest other one (by optical centre); its own for a single one."""
    centres = np.array([camera.position for camera in cameras])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(distance, math.inf)
    return distance.argmin(1).tolist()
