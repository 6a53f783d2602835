"""What a camera makes of a rendered picture: its light, its exposure, its tone curve, and bytes."""

import functools
import types
from typing import Any, Protocol

import torch
from torch import Tensor

from endo_sim_ros.core import shading_kernels
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.kernels import launch_in_shares, load_kernels, vectorised
from endo_sim_ros.core.light import NEAREST, SURFACE, Light, directions, falloff, features, features_from, log_brightness, toned

_DIGITS = 9  # of the way from an eye to the lamp: a nanometre


class Shading:
    """Light and exposure of the pictures of one camera.

    What it reads of the device stays where it is as long as it lives.

    Args:
        light: The light and the exposure.
        camera: The camera that pictures are rendered for.
        device: That of the pictures.
        lamp: The camera that the lamp is at, as the other eye; None: this one.
    """

    def __init__(self, light: Light, camera: Camera, device: torch.device | str, lamp: Camera | None = None) -> None:
        device = torch.device(device)
        self.light, self.rays, self._backend = light, directions(camera, device), backend_for(device)
        self.exponents, self._levels = _constants(light, device)
        # From the camera to the lamp [3, 4]. Eyes that move together keep it, but for rounding: 0.0 makes -0 the same as 0.
        self.motion = None if lamp is None or lamp is camera else (lamp.viewmat @ camera.pose)[:3].round(_DIGITS) + 0.0

    @property
    def key(self) -> Any:
        """What tells it from others."""
        return self.light, id(self.rays), None if self.motion is None else self.motion.tobytes()

    def __call__(self, colors: Tensor, depths: Tensor, alphas: Tensor, factors: Tensor | None = None) -> Tensor:
        """Return a rendered picture [H, W, 3] as it is lit, exposed and toned, without a gradient.

        Args:
            colors: Rendered colours [H, W, 3].
            depths: Composited depths Σ w z [H, W], metres.
            alphas: Opacities Σ w [H, W].
            factors: By how much brighter than so the picture is [H, W, 1], before it is toned; None: as bright.
        """
        lit = self._backend.light(self, colors, depths, alphas)
        gains = (self._levels - self.light.response * log_brightness(lit, alphas > SURFACE)).exp()
        return self._backend.expose(lit if factors is None else lit * factors, gains, self.light.shoulder)


def shade(
    light: Light,
    colors: Tensor,
    depths: Tensor,
    alphas: Tensor,
    camera: Camera,
    lamp: Camera | None = None,
    factors: Tensor | None = None,
) -> Tensor:
    """Return one picture as `Shading` does, on its own device."""
    return Shading(light, camera, colors.device, lamp)(colors, depths, alphas, factors)


def to_bytes(colors: Tensor) -> Tensor:
    """Return colours [..., 3] from 0 to 1 as uint8, rounded; what lies beyond is clamped."""
    return backend_for(colors.device).to_bytes(colors)


class ShadingBackend(Protocol):
    """How a kind of device shades a picture."""

    modules: tuple[types.ModuleType, ...]  # of Warp kernels

    def light(self, shading: Shading, colors: Tensor, depths: Tensor, alphas: Tensor) -> Tensor:
        """Return a picture [H, W, 3] as it is lit, before the exposure; arguments are those of a `Shading`."""
        ...

    def expose(self, lit: Tensor, gains: Tensor, shoulder: float) -> Tensor:
        """Return a lit picture [H, W, 3], which it may change, times the gains of its channels [3], and `toned` with a shoulder above 0."""
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

    def light(self, shading: Shading, colors: Tensor, depths: Tensor, alphas: Tensor) -> Tensor:
        light, rays, lit = shading.light, shading.rays, torch.empty_like(colors)
        if shading.motion is None:
            arguments = [colors, depths, alphas, _fixed_falloff(light, rays), light.distance, light.reference, NEAREST, lit]
            _launch(shading_kernels.light_picture, alphas.numel(), arguments)
        else:
            motion = torch.from_numpy(shading.motion).float()
            arguments = [colors, depths, alphas, rays[1:], motion, shading.exponents, light.reference, NEAREST, lit]
            _launch(shading_kernels.light_picture_from, alphas.numel(), arguments)
        return lit

    def expose(self, lit: Tensor, gains: Tensor, shoulder: float) -> Tensor:
        _launch(shading_kernels.expose_picture, lit.numel() // 3, [gains, shoulder, lit])
        return lit

    def to_bytes(self, colors: Tensor) -> Tensor:
        out = torch.empty(colors.shape, dtype=torch.uint8)
        _launch(shading_kernels.to_bytes, colors.numel(), [colors, out])
        return out


class _Torch:
    """On any device."""

    modules = ()

    def light(self, shading: Shading, colors: Tensor, depths: Tensor, alphas: Tensor) -> Tensor:
        reference = shading.light.reference
        if shading.motion is None:
            quantities = features(depths, alphas, shading.rays, reference)
        else:
            quantities = features_from(shading.motion, shading.rays, depths, alphas, reference)
        return colors * falloff(quantities, shading.exponents)[..., None]

    def expose(self, lit: Tensor, gains: Tensor, shoulder: float) -> Tensor:
        lit = lit.mul_(gains)
        return toned(lit, shoulder) if shoulder else lit

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
