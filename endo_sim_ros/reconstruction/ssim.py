"""Structural similarity of images, with its gradient by hand (Wang et al. 2004).

SSIM = (2 μx μy + C1)(2 σxy + C2) / ((μx² + μy² + C1)(σx² + σy² + C2)), means and variances in a Gaussian window of 11×11
pixels, σ 1.5, with zeros around the image.
"""

import types
from collections.abc import Sequence
from typing import Any, Protocol

import cv2
import torch
from torch import Tensor

from endo_sim_ros.core.kernels import launch, load_kernels, vectorised
from endo_sim_ros.reconstruction import ssim_kernels as kernels
from endo_sim_ros.reconstruction.ssim_kernels import C1, C2


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Return the map of structural similarity [H, W, 3] of images [H, W, 3] in [0, 1]; gradients flow to ``image``."""
    return _Ssim.apply(image, target)


class SsimBackend(Protocol):
    """How a kind of device computes structural similarity."""

    modules: tuple[types.ModuleType, ...]  # of Warp kernels

    def forward(self, x: Tensor, y: Tensor) -> tuple[Tensor, Sequence[Tensor]]:
        """Return the map of images x and y [H, W, C], contiguous, and what `backward` needs."""
        ...

    def backward(self, v: Tensor, *saved: Tensor) -> Tensor:
        """Return the gradient of x from that of the map [H, W, C]."""
        ...


def backend_for(device: torch.device) -> SsimBackend:
    """Return the backend of a device, its kernels loaded."""
    backend = _OpenCv() if vectorised(device) else _Kernels()
    load_kernels(backend.modules, str(device))
    return backend


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        ctx.backend = backend_for(x.device)
        values, saved = ctx.backend.forward(x.detach().contiguous(), y.detach().contiguous())
        ctx.save_for_backward(*saved)
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v: Tensor) -> tuple[Tensor, None]:
        return ctx.backend.backward(v, *ctx.saved_tensors), None


class _OpenCv:
    """On a CPU, where OpenCV's separable filter takes a tenth of a convolution's time."""

    modules = ()

    def forward(self, x: Tensor, y: Tensor) -> tuple[Tensor, Sequence[Tensor]]:
        mu_x, mu_y, xx, yy, xy = (_blur(image) for image in (x, y, x * x, y * y, x * y))  # side by side each would be strided, and slow
        product, squares = mu_x * mu_y, mu_x**2 + mu_y**2
        A, B, C, D = 2 * product + C1, 2 * (xy - product) + C2, squares + C1, xx + yy - squares + C2
        return A * B / (C * D), (x, y, mu_x, mu_y, A, B, C, D)

    def backward(self, v: Tensor, *saved: Tensor) -> Tensor:
        x, y, mu_x, mu_y, A, B, C, D = saved
        share = v / (C * D)
        v_var, v_cov = -share * A * B / D, 2 * share * A
        v_mu = 2 * mu_y * (share * B) - 2 * mu_x * (share * A * B / C + v_var) - mu_y * v_cov
        v_mu, v_var, v_cov = (_blur(each) for each in (v_mu, v_var, v_cov))
        return v_mu + 2 * x * v_var + y * v_cov


class _Kernels:
    """On any device, float32; two separable passes each way."""

    modules = (kernels,)

    def forward(self, x: Tensor, y: Tensor) -> tuple[Tensor, Sequence[Tensor]]:
        moments, slopes, values = x.new_empty(5, x.numel()), x.new_empty(3, x.numel()), torch.empty_like(x)
        launch(kernels.moments_across, x.numel(), [x, y, *x.shape[1:], moments], x.device)
        launch(kernels.similarity_down, x.numel(), [moments, x[0].numel(), values, slopes], x.device)
        return values, (x, y, slopes)

    def backward(self, v: Tensor, *saved: Tensor) -> Tensor:
        x, y, slopes = saved
        sums, v_x = torch.empty_like(slopes), torch.empty_like(x)
        launch(kernels.gradient_across, x.numel(), [v.contiguous(), slopes, *x.shape[1:], sums], x.device)
        launch(kernels.gradient_down, x.numel(), [sums, x, y, x[0].numel(), v_x], x.device)
        return v_x


def _blur(image: Tensor) -> Tensor:
    """Return the Gaussian window's sums over [H, W, C], with zeros around; symmetric, hence its own adjoint."""
    blurred = cv2.sepFilter2D(image.numpy(), -1, kernels.gaussian, kernels.gaussian, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(blurred.reshape(image.shape))
