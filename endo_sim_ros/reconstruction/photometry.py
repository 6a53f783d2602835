"""The light at the camera and each view's exposure, from how bright the same points are in several views."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.light import Light, features_at

PRIOR = np.array([0.9, 3.0, 0.0, 0.0])  # distance, angle, tilt: the inverse-square law at a gamma of 2.2, a usual spot
_PRIOR_SPREAD = np.array([0.3, 6.0, 0.3, 0.3])
_GAIN_SPREAD = 0.7  # of the logarithm of a view's exposure
_OFF = 1e-6  # spread of what is not to be fitted
_NOISE = 0.05  # of the logarithm of a brightness
_INDEPENDENT = 300  # neighbouring points err alike: no more than this many are worth counting
_MOST_POINTS = 4000
_DARK, _BRIGHT = 12, 235  # grey levels between which a camera is not far from its curve
_BLUR = 1.5  # pixels
_BRIGHTEST = 4.0  # colour that tissue in the corner of a picture may have in full light
_RESPONSE, _RESPONSE_SPREAD = 0.9, 0.5  # of the automatic exposure: cameras even out most of the brightness
_WHITE, _BRIGHTER = 250, 60  # grey levels of all channels, or so much above those around, from which on light is reflected
_GLOW, _AROUND = 3.0, 15.0  # around a reflection, and standard deviation of what is around one: pixels of an image 640 wide
_EXPOSURE_NOISE = 0.01, 0.04  # the least and the most that the logarithm of an exposure varies by itself


@dataclass(frozen=True)
class Drift:
    """What of the exposures of the training views their brightness does not explain, which comes and goes with time.

    Args:
        stamps_ns: Of the views [V], when they were taken.
        residuals: Logarithm of the exposure of each channel [V, 3] beyond that of the light.
    """

    stamps_ns: Sequence[int]
    residuals: np.ndarray

    def at(self, light: Light | None, stamp_ns: int) -> Light | None:
        """The light at another time of the recording: in between views as time has it, before and after as in the nearest."""
        if light is None:
            return None
        times = sorted(set(self.stamps_ns))
        then = [self.residuals[np.equal(self.stamps_ns, time)].mean(0) for time in times]
        ahead = [float(time - stamp_ns) for time in times]
        levels = {f"level_{c}": np.interp(0.0, ahead, [residual[i] for residual in then]) for i, c in enumerate("rgb")}
        return dataclasses.replace(light, **{name: getattr(light, name) + float(beyond) for name, beyond in levels.items()})


def fit_light(
    frames: list[Frame], points: np.ndarray, reference: float, tolerance: float, *, light: bool = True, exposure: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """The light (distance, angle, tilt_x, tilt_y) [4] and the logarithm of each view's exposure [V, 3].

    Least squares, reweighted against outliers (glints, wrong or moving points), of log brightness = log of the point's
    own + exposure + light, over points seen in two views or more; what the views leave open is taken from the prior.
    The exposures are such that light and exposure together neither brighten nor darken on average.

    Args:
        frames: Training views.
        points: Points on the surface [N, 3], metres, world.
        reference: Distance at which brightness is the point's own, metres.
        tolerance: Relative difference from a view's depth from which on a point is taken to be hidden there.
        light, exposure: Whether there is such a thing; zero without.
    """
    points = points[:: max(-(-len(points) // _MOST_POINTS), 1)]
    observed = [_observations(frame, points, reference, tolerance) for frame in frames]
    view = np.concatenate([np.full(len(index), v) for v, (index, _, _) in enumerate(observed)])
    index, colors, quantities = (np.concatenate(arrays) for arrays in zip(*observed))
    seen = np.bincount(index, minlength=len(points))[index] > 1
    view, index, colors, quantities = view[seen], index[seen], colors[seen], quantities[seen]
    count = len(frames)
    if not len(view):
        return PRIOR * light, np.zeros((count, 3))
    gains = np.eye(count)[view]
    A = np.concatenate([quantities, gains], 1)
    spread = np.concatenate([_PRIOR_SPREAD if light else np.full(4, _OFF), np.full(count, _GAIN_SPREAD if exposure else _OFF)])
    prior = np.concatenate([PRIOR * light, np.zeros(count)])
    y = np.log(colors).mean(1)
    solution, weights = _solve(A, y, index, len(points), prior, spread)
    # The exposure of each channel by itself, with the light of all.
    shaded = quantities @ solution[:4]
    exposures = [_solve(gains, np.log(c) - shaded, index, len(points), solution[4:], spread[4:])[0] for c in colors.T]
    exposures = np.stack(exposures, 1)
    if exposure:
        exposures = exposures - np.average(shaded[:, None] + exposures[view], axis=0, weights=weights)
    return solution[:4], exposures


def unlit(
    model: GaussianModel, frames: list[Frame], light: np.ndarray, exposures: np.ndarray, reference: float, tolerance: float
) -> GaussianModel:
    """The model with the colours that, in the light [4] and exposures [V, 3], look like those of the views that see it."""
    points = model.means.numpy().astype(np.float64)
    total, count = np.zeros((len(points), 3)), np.zeros((len(points), 1))
    for frame, exposure in zip(frames, exposures):
        index, colors, quantities = _observations(frame, points, reference, tolerance, raw=True)
        total[index] += colors / np.exp((quantities @ light)[:, None] + exposure)
        count[index] += 1
    colors = torch.from_numpy((total / count.clip(1)).clip(0, _BRIGHTEST).astype(np.float32))
    sh = model.sh.clone()
    sh[:, 0] = torch.where(torch.from_numpy(count) > 0, (colors - 0.5) / SH_C0, sh[:, 0])
    return dataclasses.replace(model, sh=sh)


def reflections(image: np.ndarray, tissue: np.ndarray) -> np.ndarray:
    """Where an image [H, W, 3] shows reflections of the light [H, W], which lie deeper than the tissue [H, W] and move with the camera."""
    unit = image.shape[1] / 640
    least = image.min(2).astype(np.float32)
    blur = lambda values: cv2.GaussianBlur(values, (0, 0), _AROUND * unit)
    around = blur(least * tissue) / np.maximum(blur(tissue), 1e-3)
    bright = np.uint8(((least > _WHITE) | (least > around + _BRIGHTER)) & (tissue > 0))
    return cv2.dilate(bright, np.ones((2 * round(_GLOW * unit) + 1,) * 2, np.uint8)) > 0


def fit_exposure(exposures: np.ndarray, brightness: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Response and levels [3] of the automatic exposure from each view's log exposure [V, 3] and log brightness [V] without it,
    and what they leave of the exposures [V, 3].

    See `Light`. A camera that evens out most of the brightness is the prior, as brightness may be much the same in all views; exposures
    that hardly vary speak for a fixed one.
    """
    centred, mean = brightness - brightness.mean(), exposures.mean(1)
    trust, doubt = 1 / np.clip(mean.std(), *_EXPOSURE_NOISE) ** 2, 1 / _RESPONSE_SPREAD**2
    slope = (doubt * _RESPONSE - trust * centred @ mean) / (doubt + trust * centred @ centred)
    response = float(np.clip(slope, 0, 1))
    residuals = exposures - exposures.mean(0) + response * centred[:, None]
    return response, exposures.mean(0) + response * brightness.mean(), residuals


def _observations(frame: Frame, points: np.ndarray, reference: float, tolerance: float, raw: bool = False):
    """Of the points that a view sees, without ``raw`` well: their indices [M], colours [M, 3] in [0, 1] and light's quantities [M, 4]."""
    camera = frame.camera
    uv, z = camera.project(points)
    index = np.nonzero((z > 1e-3) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1))[0]
    u, v = np.floor(uv[index]).astype(int).T
    good = np.ones(len(index), bool) if frame.mask is None else frame.mask[v, u] > 0
    if frame.depth is not None:
        surface = frame.depth[v, u]
        good &= (surface <= 0) | (np.abs(z[index] - surface) < tolerance * surface)
    image = frame.image if raw else cv2.GaussianBlur(frame.image, (0, 0), _BLUR)
    colors = image[v, u].astype(np.float64)
    if not raw:
        good &= (colors.max(1) < _BRIGHT) & (colors.max(1) > _DARK)
    return index[good], colors[good].clip(1) / 255, features_at(points[index[good]], camera, reference)


def _solve(A: np.ndarray, y: np.ndarray, index: np.ndarray, count: int, prior: np.ndarray, spread: np.ndarray):
    """x [P] that minimises Σ w (y − A x − own_index)² / noise² + Σ (x − prior)² / spread², and the weights w [M].

    Each point's own value is eliminated; w falls for observations that do not fit (Cauchy).
    """
    points = max(len(np.unique(index)), 1)
    trust = min(_INDEPENDENT / points, 1) / _NOISE**2
    weights, x = np.ones(len(y)), prior
    for _ in range(10):
        total = np.bincount(index, weights, count).clip(1e-9)
        mean = lambda values: (np.bincount(index, weights * values, count) / total)[index]  # noqa: B023
        centred = A - np.stack([mean(column) for column in A.T], 1)
        rest = y - mean(y)
        normal = trust * (centred * weights[:, None]).T @ centred + np.diag(1 / spread**2)
        x = np.linalg.solve(normal, trust * centred.T @ (weights * rest) + prior / spread**2)
        residual = rest - centred @ x
        scale = max(1.4826 * np.median(np.abs(residual)), 1e-3)
        weights = 1 / (1 + (residual / (2 * scale)) ** 2)
    return x, weights
