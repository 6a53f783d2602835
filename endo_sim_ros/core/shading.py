"""What a camera makes of a rendered picture: its light, its exposure, and bytes."""

import functools

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core import shading_kernels as kernels
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import init_warp, run_in_threads, shares
from endo_sim_ros.core.light import NEAREST, SURFACE, Light, directions, falloff, features, log_brightness


def shade(light: Light, colors: Tensor, depths: Tensor, alphas: Tensor, camera: Camera) -> Tensor:
    """A rendered picture [H, W, 3] as it is lit and exposed. No gradient.

    Args:
        light: The light and the exposure.
        colors: Rendered colours [H, W, 3].
        depths: Σ w z [H, W], metres.
        alphas: Σ w [H, W].
        camera: The camera.
    """
    rays = directions(camera, colors.device)
    if colors.device.type == "cpu":
        lit = torch.empty_like(colors)
        arguments = colors, depths, alphas, _around(light, rays), light.distance, light.reference, NEAREST, lit
        _launch(kernels.light_picture, alphas.numel(), *arguments)
    else:
        lit = colors * falloff(features(depths, alphas, rays, light.reference), _slopes(light, rays))[..., None]
    level = lit.new_tensor([light.level_r, light.level_g, light.level_b])
    return lit.mul_((level - light.response * log_brightness(lit, alphas > SURFACE)).exp())


def to_bytes(colors: Tensor) -> Tensor:
    """Colours [..., 3] from 0 to 1 as uint8; what lies beyond is clamped."""
    if colors.device.type != "cpu":
        return (colors.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    out = torch.empty(colors.shape, dtype=torch.uint8)
    _launch(kernels.to_bytes, colors.numel(), colors, out)
    return out


def _slopes(light: Light, like: Tensor) -> Tensor:
    """What `falloff` multiplies the four quantities with [4]."""
    return like.new_tensor([light.distance, light.angle, light.tilt_x, light.tilt_y])


@functools.lru_cache(maxsize=8)
def _around(light: Light, rays: Tensor) -> Tensor:
    """What brightness [H, W] depends on beside distance along the axis, of a camera's `directions` [3, H, W]."""
    here = rays.new_full(rays.shape[1:], light.reference)
    return falloff(features(here, torch.ones_like(here), rays, light.reference), _slopes(light, rays))


def _launch(kernel: wp.Kernel, count: int, *arguments: Tensor | float) -> None:
    """Launch a kernel of the CPU's on count items, 16 at a time."""
    _load_kernels()
    arrays = [wp.from_torch(x.contiguous().view(-1), requires_grad=False) if isinstance(x, Tensor) else x for x in arguments]

    def share(first: int, size: int) -> None:
        wp.launch(kernel, size, [first, *arrays], device="cpu")

    run_in_threads([functools.partial(share, *own) for own in shares(-(-count // 16), 1024)])


@functools.cache
def _load_kernels() -> None:
    """Compile the kernels before several threads ask for them."""
    init_warp()
    wp.load_module(kernels, "cpu")
