"""Deformed-view PSNR: whether a model still looks like tissue when the tissue is moved."""

import dataclasses
import logging
from collections.abc import Sequence

import cv2
import numpy as np
import torch

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig, render_depth

log = logging.getLogger(__name__)

_STEPS = 20  # of each move of the jaw
_SHARE = 0.12  # of what is seen across: how far the jaw moves; half of it is the radius in which it holds control nodes
_FINER = 2  # pixels of the surface to one of the picture, each way
_SPREAD, _OPACITY = 0.45, 0.99  # of the Gaussian of such a pixel: standard deviation in widths of the pixel, and opacity
_CHANGED = 6  # difference from rest, grey levels of 255, above which a pixel has changed
_MARGIN = 4  # pixels around those that changed, which count too


def deformed_view_psnr(model: GaussianModel, cameras: Sequence[Camera], device: str) -> float:
    """PSNR, dB, of pictures of the model while a jaw moves the tissue, over the pixels that change; NaN without tissue in the middle.

    The reference is what the model shows at rest, laid onto the surface it has there and moved by the same control nodes: a
    model all of whose Gaussians lie on the surface and have its colours is as good deformed as at rest. The jaw takes hold
    in the middle of the middle camera's picture and moves towards the camera, to the left and upwards. Without light.

    Args:
        model: Gaussians at rest.
        cameras: Those of the training views.
        device: Compute device.
    """
    try:
        return _deformed_view_psnr(model, cameras, device)
    except (ValueError, RuntimeError) as error:  # nothing that could be touched, not in metres, or too large: the other figures stand
        log.warning("PSNR, deformed, is left out: %s", error)
        return float("nan")


def changed_pixels(image: np.ndarray, at_rest: np.ndarray) -> np.ndarray:
    """Mask [H, W] (uint8, 1 or 0) of where an image [H, W, 3] (uint8) differs from the one at rest, and a margin around."""
    changed = np.abs(image.astype(int) - at_rest).max(-1) > _CHANGED
    return cv2.dilate(changed.astype(np.uint8), np.ones((2 * _MARGIN + 1,) * 2))


def _deformed_view_psnr(model: GaussianModel, cameras: Sequence[Camera], device: str) -> float:
    camera, options = cameras[len(cameras) // 2], RenderingConfig(device=device)
    model = dataclasses.replace(model, light=None)
    surface = _surface(model, camera, options)
    _, depth = DeformableRenderer(model, None, options).render(camera)
    v, u = depth.shape[0] // 2, depth.shape[1] // 2
    if depth[v, u] <= 0 or not len(surface):
        return float("nan")
    middle, size = camera.backproject(depth)[v, u], _SHARE * float(depth[v, u]) * camera.width / camera.K[0, 0]
    try:
        config = PhysicsConfig(device=device, force_radius=size / 2, travel=2 * size)
    except ConfigError:
        text = "tissue %.3g m away cannot be moved as tissue is; poses are in metres, and these seem to be in another unit"
        raise ValueError(text % depth[v, u]) from None
    simulation = TissueSimulation(model, np.stack([each.position for each in cameras]), config, cameras, render_depth)
    ours, reference = (DeformableRenderer(each, simulation.nodes.rest, options) for each in (model, surface))
    at_rest = reference.views([camera], depth=False)[0].image.astype(int)
    right, down, ahead = camera.pose[:3, :3].T
    found = []
    for direction in (-ahead, -right - 0.3 * ahead, -down - 0.3 * ahead):
        simulation.reset()
        pose = camera.pose.copy()
        for step in range(_STEPS):
            pose[:3, 3] = middle + size * step / (_STEPS - 1) * direction
            held = simulation.set_grasp("jaw", pose, True)
            simulation.step()
        if not held:
            continue
        state = simulation.state()
        picture, expected = (each.views([camera], state.positions, state.F, depth=False)[0].image for each in (ours, reference))
        changed = changed_pixels(expected, at_rest)
        if changed.any():
            found.append(metrics.psnr(picture, expected, changed))
    return float(np.mean(found)) if found else float("nan")


def _surface(model: GaussianModel, camera: Camera, options: RenderingConfig) -> GaussianModel:
    """What a camera sees of the model as small opaque Gaussians, one for each pixel of a finer picture."""
    camera = camera.resized(camera.width * _FINER, camera.height * _FINER)
    image, depth = DeformableRenderer(model, None, options).render(camera)
    shown = depth > 0
    radii = _SPREAD / camera.K[0, 0] * depth[shown]
    tensors = (torch.from_numpy(array).float() for array in (camera.backproject(depth)[shown], image[shown] / 255.0, radii))
    return GaussianModel.from_points(*tensors, opacity=_OPACITY)
