"""What a camera makes of a rendered picture: its light, its exposure, and bytes."""

import functools
import types
from typing import Any, Protocol

import torch
from torch import Tensor

from endo_sim_ros.core import shading_kernels
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.kernels import launch_in_shares, load_kernels, vectorised
from endo_sim_ros.core.light import NEAREST, SURFACE, Light, directions, falloff, features, features_from, log_brightness


def shade(light: Light, colors: Tensor, depths: Tensor, alphas: Tensor, camera: Camera, lamp: Camera | None = None) -> Tensor:
    """Return a rendered picture [H, W, 3] as it is lit and exposed, without a gradient.

    Args:
        light: The light and the exposure.
        colors: Rendered colours [H, W, 3].
        depths: Composited depths Σ w z [H, W], metres.
        alphas: Opacities Σ w [H, W].
        camera: The camera that the picture was rendered for.
        lamp: The camera that the lamp is at, as the other eye; None: this one.
    """
    level = _constants(light, colors.device)[1]
    lit = backend_for(colors.device).light(light, colors, depths, alphas, camera, lamp or camera)
    return lit.mul_((level - light.response * log_brightness(lit, alphas > SURFACE)).exp())


def to_bytes(colors: Tensor) -> Tensor:
    """Return colours [..., 3] from 0 to 1 as uint8, rounded; what lies beyond is clamped."""
    return backend_for(colors.device).to_bytes(colors)


class ShadingBackend(Protocol):
    """How a kind of device shades a picture."""

    modules: tuple[types.ModuleType, ...]  # of Warp kernels

    def light(self, light: Light, colors: Tensor, depths: Tensor, alphas: Tensor, camera: Camera, lamp: Camera) -> Tensor:
        """Return a picture [H, W, 3] as it is lit, before the exposure; arguments are those of `shade`."""
        ...

    def to_bytes(self, colors: Tensor) -> Tensor:
        """Return what the function of this name does."""
        ...


def backend_for(device: torch.device) -> ShadingBackend:
    """Return the backend of a device, its kernels loaded."""
    backend = _Vectorised() if vectorised(device) else _Torch()
    load_kernels(backend.modules, str(device))
    return backend


class _Vectorised:
    """On a CPU, where kernels take a fifth of torch's time."""

    modules = (shading_kernels,)

    def light(self, light: Light, colors: Tensor, depths: Tensor, alphas: Tensor, camera: Camera, lamp: Camera) -> Tensor:
        lit, rays = torch.empty_like(colors), directions(camera, "cpu")
        if lamp is camera:
            arguments = [colors, depths, alphas, _fixed_falloff(light, rays), light.distance, light.reference, NEAREST, lit]
            _launch(shading_kernels.light_picture, alphas.numel(), arguments)
        else:
            motion = torch.from_numpy((lamp.viewmat @ camera.pose)[:3]).float()
            arguments = [colors, depths, alphas, rays[1:], motion, _constants(light, rays.device)[0], light.reference, NEAREST, lit]
            _launch(shading_kernels.light_picture_from, alphas.numel(), arguments)
        return lit

    def to_bytes(self, colors: Tensor) -> Tensor:
        out = torch.empty(colors.shape, dtype=torch.uint8)
        _launch(shading_kernels.to_bytes, colors.numel(), [colors, out])
        return out


class _Torch:
    """On any device."""

    modules = ()

    def light(self, light: Light, colors: Tensor, depths: Tensor, alphas: Tensor, camera: Camera, lamp: Camera) -> Tensor:
        if lamp is camera:
            quantities = features(depths, alphas, directions(camera, colors.device), light.reference)
        else:
            quantities = features_from(lamp, camera, depths, alphas, light.reference)
        return colors * falloff(quantities, _constants(light, colors.device)[0])[..., None]

    def to_bytes(self, colors: Tensor) -> Tensor:
        return (colors.clamp(0, 1) * 255 + 0.5).to(torch.uint8)


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _constants(light: Light, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return what `falloff` multiplies the four features with [4], and the levels of the exposure [3]; kept, as a copy takes the host to
    wait for a GPU."""
    exponents = torch.tensor([light.distance, light.angle, light.tilt_x, light.tilt_y], dtype=torch.float32, device=device)
    return exponents, torch.tensor([light.level_r, light.level_g, light.level_b], dtype=torch.float32, device=device)


@functools.lru_cache(maxsize=8)
def _fixed_falloff(light: Light, rays: Tensor) -> Tensor:
    """Return the factor of brightness [H, W] that does not depend on depth along the axis, for `directions` [3, H, W]."""
    here = rays.new_full(rays.shape[1:], light.reference)
    return falloff(features(here, torch.ones_like(here), rays, light.reference), _constants(light, rays.device)[0])


def _launch(kernel: Any, count: int, arguments: list) -> None:
    """Launch a kernel that takes 16 of count items at a time."""
    arguments = [x.contiguous().view(-1) if isinstance(x, Tensor) else x for x in arguments]
    launch_in_shares(kernel, -(-count // 16), arguments)
