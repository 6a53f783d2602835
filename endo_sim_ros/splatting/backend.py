"""Where splats are drawn: one backend for each kind of device."""

import types
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from endo_sim_ros.core.kernels import load_kernels, vectorised
from endo_sim_ros.splatting import cpu, cuda
from endo_sim_ros.splatting.scene import Gradients, Scene, Settings


class RasterBackend(Protocol):
    """How a kind of device draws a scene; a module is one."""

    modules: tuple[types.ModuleType, ...]  # of Warp kernels

    def forward(self, scene: Scene, tile_mask: Tensor | None, settings: Settings) -> tuple[list[Tensor], Tensor, Tensor, Any]:
        """Draw a scene.

        Args:
            scene: Gaussians and cameras.
            tile_mask: 1 for tiles that are drawn, 0 for those that show the background only, uint8 [C · tiles]; None: all are drawn.
            settings: Image size and options.

        Returns:
            Images, see `empty_images`.
            Radii of splats, int32 [C, N], pixels; 0 = not in the image.
            Owners of median depths: number of the splat, c·N + n, or −1, int32 [C, H, W]; [0] if not wanted.
            What `backward` needs.
        """
        ...

    def backward(
        self, scene: Scene, state: Any, settings: Settings, images: Sequence[Tensor], v_images: Sequence[Tensor], gradients: Gradients
    ) -> None:
        """Fill the gradients of a scene.

        Args:
            scene, settings: Those of the forward pass.
            state: What the forward pass returned for it.
            images: The images of the forward pass.
            v_images: Their gradients, float32, contiguous.
            gradients: Memory that is written; what is None is not computed.
        """
        ...


def backend_for(device: torch.device) -> RasterBackend:
    """Return the backend of a device, its kernels loaded."""
    backend = cpu if vectorised(device) else cuda
    load_kernels(backend.modules, str(device))
    return backend
