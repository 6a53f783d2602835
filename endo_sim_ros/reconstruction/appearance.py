"""Light, exposures and the camera's tone curve, which are learnt beside the Gaussians."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.light import SURFACE, Light, directions, falloff, features, log_brightness, toned
from endo_sim_ros.core.surroundings import fill_holes
from endo_sim_ros.reconstruction import photometry
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.device_views import DeviceView
from endo_sim_ros.reconstruction.gloss import lobes
from endo_sim_ros.reconstruction.losses import masked_mean
from endo_sim_ros.reconstruction.optimizer import Adam
from endo_sim_ros.splatting import RenderOutput

_LEAST_SHOULDER = 0.01  # differs from a camera that clips by less than a grey level


class Appearance:
    """The light at the camera and the exposure of each view, as far as the options ask for them, and the camera's tone curve.

    Args:
        light: (distance, angle, tilt_x, tilt_y) [4] at first, which the light is anchored to.
        exposures: Logarithm of each view's exposure [V, 3] at first; their mean stays.
        reference: Distance at which colours are the tissue's own, metres.
        config: Options of the reconstruction.
        device: Where to compute.
        shoulder: That of the camera's tone curve at first; 0 = it clips, and stays so.
    """

    def __init__(
        self, light: np.ndarray, exposures: np.ndarray, reference: float, config: ReconstructionConfig, device: str, shoulder: float = 0.0
    ) -> None:
        self._config, self._reference, self._device = config, reference, device
        self._prior = torch.tensor(light, dtype=torch.float32, device=device)
        first = torch.tensor(exposures, dtype=torch.float32, device=device)
        self._level = first.mean(0)
        self.set(self._prior, first, torch.tensor(shoulder, dtype=torch.float32, device=device))

    def set(self, light: Tensor, exposures: Tensor, shoulder: Tensor) -> None:
        """Start optimising the light [4] and log exposures [V, 3], each if the options ask for it, and the shoulder, if there is one."""
        config, self._tones = self._config, float(shoulder) > 0
        self.tensors = {
            "light": light.clone().requires_grad_(config.light),
            "exposures": exposures.clone().requires_grad_(config.exposure),
            "shoulder": shoulder.clone().requires_grad_(self._tones),
        }
        learnt = {name: value for name, value in self.tensors.items() if value.requires_grad}
        rates = config.rates
        self.optimizer = Adam(learnt, {"light": rates.light, "exposures": rates.exposures, "shoulder": rates.light})

    def gain(self, depth: Tensor, alpha: Tensor, rays: Tensor | None, view: Tensor) -> Tensor | None:
        """What light and exposure make of a training view's colours [H, W, 1 or 3]; None without them.

        Args:
            depth, alpha: Rendered Σ w z (m) and Σ w [H, W].
            rays: `directions` of the camera [3, H, W]; None without light.
            view: Index of the exposure [1].
        """
        gain = None
        if rays is not None:
            gain = falloff(features(depth, alpha, rays, self._reference), self.tensors["light"])[..., None]
        if self._config.exposure:
            exposure = self.tensors["exposures"].index_select(0, view).exp()[None]
            gain = exposure if gain is None else gain * exposure
        return gain

    def toned(self, colors: Tensor) -> Tensor:
        """What the camera's curve makes of lit and exposed colours [...]."""
        return toned(colors, self.tensors["shoulder"]) if self._tones else colors

    def changes(self) -> Tensor:
        """Sum of the squared changes of the light."""
        return ((self.tensors["light"] - self._prior) ** 2).sum()

    @torch.no_grad()
    def hold(self) -> None:
        """Bring the mean exposure back to where it was: all exposures up and all colours down is the same picture, except for tissue
        that no view sees. And keep the shoulder within its limits."""
        if self._tones:
            self.tensors["shoulder"].clamp_(_LEAST_SHOULDER, 1.0)
        if self._config.exposure:
            self.tensors["exposures"] += self._level - self.tensors["exposures"].mean(0)

    @torch.no_grad()
    def fitted(self, views: list[DeviceView], render: Callable[[DeviceView], RenderOutput]) -> tuple[Light | None, np.ndarray]:
        """The light with an automatic exposure like that of the views, and what it leaves of their log exposures [V, 3]."""
        light, exposures = self.tensors["light"], self.tensors["exposures"]
        unexplained = np.zeros(exposures.shape)
        if not (self._config.light or self._config.exposure or self._config.reflections or self._tones):
            return None, unexplained
        numbers = dict(zip(("distance", "angle", "tilt_x", "tilt_y"), light.tolist())) | {"reference": self._reference}
        numbers["shoulder"] = float(self.tensors["shoulder"])
        fitted = replace(lobes(self._config.gloss) if self._config.reflections else Light(), **numbers)
        allowed = self._config.extrapolated.hole_error if self._config.extrapolation else 0.0
        if not (self._config.exposure or allowed):
            return fitted, unexplained
        brightness, worse = [], 0.0
        for view, exposure in zip(views, exposures.exp()):
            output = render(view)
            image, depth, alpha = output.colors[0], output.depths[0], output.alphas[0]
            if self._config.light:
                rays = directions(view.camera, self._device)
                image = image * falloff(features(depth, alpha, rays, self._reference), light)[..., None]
            brightness.append(float(log_brightness(image, alpha > SURFACE)))  # of the whole picture, as it will be drawn
            if allowed:
                seen = self.toned(image * exposure)
                black = masked_mean((seen - view.image).abs(), view.mask)
                fill_holes(seen[None], alpha[None])
                worse = max(worse, float(masked_mean((seen - view.image).abs(), view.mask) - black))
        if worse < allowed:
            fitted = replace(fitted, filled=1.0)
        if not self._config.exposure:
            return fitted, unexplained
        exposures = exposures.cpu().numpy().astype(np.float64)
        response, levels, residuals = photometry.fit_exposure(exposures, np.array(brightness), self._config.photometry)
        levels = {f"level_{channel}": float(level) for channel, level in zip("rgb", levels)}
        return replace(fitted, response=response, **levels), residuals
