"""The light at the camera and each view's exposure, from how bright the same points are in several views."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core import reflections
from endo_sim_ros.core.frames import interpolated
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.light import Light, directions, falloff, features, features_at, toned, untoned
from endo_sim_ros.reconstruction.device_views import inside, project
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView
from endo_sim_ros.reconstruction.stage_configs import PhotometryConfig

# Exponents (distance, angle) of any lamp at a lens: it is not brighter far away or beside its axis, and falls no faster than in pictures
# whose grey levels are proportional to light.
_LEAST, _MOST = (0.0, 0.0), (2.0, np.inf)
_LIKELY = 0.3, 6.0, 0.3, 0.3  # standard deviations of a light's four numbers from the likely ones
_VARIED = 0.7  # standard deviation of logarithms of exposures: views of one recording differ by a factor of two
_GREY_LEVEL = 1 / 255  # of white: pictures tell no smaller differences
_SHOULDERS = 0.0, 0.25  # that are tried beside the likely one; softer ones are left to training, as highlights are found less well by them
_BETTER = 0.97  # share of the likely one's error that one of them must have, at most: dark pictures tell them apart by 1 %


@dataclass(frozen=True)
class Drift:
    """The part of the exposures of the training views that the automatic exposure does not explain. It changes with time.

    Args:
        stamps_ns: Of the views [V], when they were taken.
        residuals: Logarithm of the exposure of each channel [V, 3] beyond that of the light.
    """

    stamps_ns: Sequence[int]
    residuals: np.ndarray

    def at(self, light: Light | None, stamp_ns: int) -> Light | None:
        """The light at a time of the recording: interpolated between the views, constant before the first and after the last."""
        if light is None:
            return None
        times = sorted(set(self.stamps_ns))
        then = np.array([self.residuals[np.equal(self.stamps_ns, time)].mean(0) for time in times])
        levels = zip(("level_r", "level_g", "level_b"), interpolated(times, then, stamp_ns))
        return dataclasses.replace(light, **{name: getattr(light, name) + float(beyond) for name, beyond in levels})


def find_shoulder(
    views: Sequence[TrainingView],
    points: np.ndarray,
    reference: float,
    tolerance: float,
    options: PhotometryConfig = PhotometryConfig(),
    progress: StageProgress = StageProgress(),
) -> float:
    """The shoulder of the camera's tone curve (see `Light`) that training starts from.

    It is the likely one, or a smaller one with which the views agree clearly better. For each, light and exposures are fitted; then what
    the mean brightness of a point looks like in each view is compared with what the views show. Arguments are those of `fit_light`.
    """
    likely = options.shoulder
    view, index, values, quantities = _observed(views, points[:: _every(len(points), options)], reference, tolerance, options, progress)
    if not likely or not len(view):
        return likely
    spread = np.concatenate([_LIKELY, np.full(len(views), _VARIED)])
    prior = np.concatenate([[options.distance, options.angle, 0.0, 0.0], np.zeros(len(views))])

    def error(shoulder: float) -> float:
        """Root mean square, over pictures and without outliers, of what they differ from what the points' mean brightness makes of them."""
        y = np.log(_brightness(values, shoulder))
        solution, weights = _solve(quantities, y.mean(1), view, index, prior, spread, options.noise, progress)
        lit = (quantities @ solution[:4] + solution[4:][view])[:, None]
        _, point = np.unique(index, return_inverse=True)
        own = np.stack([np.bincount(point, weights * channel) for channel in (y - lit).T], 1) / np.bincount(point, weights)[:, None]
        expected = torch.from_numpy(np.exp(own[point] + lit))
        expected = toned(expected, shoulder) if shoulder else expected.clamp(max=1)
        return float(np.sqrt(np.average(((expected.numpy() - values) ** 2).mean(1), weights=weights)))

    errors = {shoulder: error(shoulder) for shoulder in (likely, *(each for each in _SHOULDERS if each < likely))}
    best = min(errors, key=lambda shoulder: errors[shoulder])
    return best if errors[best] < _BETTER * errors[likely] else likely


class FittedLight(NamedTuple):
    """What `fit_light` finds."""

    light: np.ndarray  # (distance, angle, tilt_x, tilt_y) [4]
    exposures: np.ndarray  # logarithm of each view's [V, 3]
    fixed: bool  # whether the camera's exposure is: all are 0 then


def fit_light(
    views: Sequence[TrainingView],
    points: np.ndarray,
    reference: float,
    tolerance: float,
    options: PhotometryConfig = PhotometryConfig(),
    *,
    light: bool = True,
    exposure: bool = True,
    progress: StageProgress = StageProgress(),
) -> FittedLight:
    """The light and the logarithm of each view's exposure.

    Least squares, reweighted against outliers (glints, wrong or moving points), of log brightness = log of the point's
    own + exposure + light, over points seen in two views or more; what the views leave open is taken from the prior.
    No lamp at a lens is brighter far away or beside its axis: neither exponent is below 0, nor that of the distance above 2.
    The exposures are such that light and exposure together neither brighten nor darken on average. They are fixed if they hardly vary
    (`fixed_below`) and explain no more than chance would, beside a light that is likely and tilted as it is without them: how brightness
    changes with distance would else be taken for exposure, and be lost where no view tells it.

    Args:
        views: Training views.
        points: Points on the surface [N, 3], metres, world.
        reference: Distance at which brightness is the point's own, metres.
        tolerance: Relative difference from a view's depth from which on a point is taken to be hidden there.
        options: The prior, and which observations count.
        light, exposure: Whether to fit each; what is not fitted stays at next to zero, below 1e-6.
        progress: Reported to by views, and asked whether to go on while the light is fitted.
    """
    view, index, values, quantities = _observed(views, points[:: _every(len(points), options)], reference, tolerance, options, progress)
    count, prior = len(views), np.array([options.distance, options.angle, 0.0, 0.0]) * light
    if not len(view):
        return FittedLight(prior, np.zeros((count, 3)), False)
    colors = _brightness(values, views[0].shoulder)
    y = np.log(colors).mean(1)
    off, likely = 1e-6, np.array(_LIKELY)  # standard deviations; what is not to be fitted has next to none
    prior = np.concatenate([prior, np.zeros(count)])

    def fitted(exposure: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The solution, the spread of the exposures and the weights."""
        at, spread = prior.copy(), np.concatenate([likely if light else np.full(4, off), np.full(count, _VARIED if exposure else off)])
        while True:
            solution, weights = _solve(quantities, y, view, index, at, spread, options.noise, progress)
            within = solution[:2].clip(_LEAST, _MOST)
            beyond = (np.abs(solution[:2] - within) > 10 * off) & (spread[:2] > off)  # what is held there may be pulled beyond a little
            if not beyond.any():
                return solution, spread[4:], weights
            # Wrong depth makes it seem so. The other may go beyond its limits then.
            at[:2][beyond], spread[:2][beyond] = within[beyond], off

    solution, spread, weights = fitted(exposure)
    # The exposure of each channel by itself, with the light of all.
    channels, none = np.log(colors).T, quantities[:, :0]
    by_channel = lambda c: _solve(none, c, view, index, solution[4:], spread, options.noise, progress)[0]
    shaded = quantities @ solution[:4]
    exposures = np.stack(progress.map(by_channel, [channel - shaded for channel in channels]), 1)
    if light and exposure and count > 1:
        fixed = fitted(False)[0][:4]
        apart = lambda values: _apart(values, index, weights)
        worse = [apart(c - quantities @ fixed) - apart(c - shaded - own[view]) for c, own in zip(channels, exposures.T)]
        # Akaike's criterion: exposures have to explain more than as many numbers would by chance. Of few views a tilt does instead of them,
        # so that the light has to be a likely one, and tilted as it was.
        likely_light = (np.abs(fixed - prior[:4]) <= likely).all() and (np.abs(fixed - solution[:4]) <= likely)[2:].all()
        if likely_light and exposures.std(0).max() < options.fixed_below and max(worse) * _trust(index, options.noise) < 2 * count:
            return FittedLight(fixed, np.zeros((count, 3)), True)
    if exposure:
        exposures = exposures - np.average(shaded[:, None] + exposures[view], axis=0, weights=weights)
    return FittedLight(solution[:4], exposures, False)


class Unlit(NamedTuple):
    """What a view shows of points [N, 3]: which it sees, in which pixels, and in what colours without light and exposure."""

    view: TrainingView
    index: Tensor  # [M] of the points
    pixels: Tensor  # [M]
    colors: Tensor  # [M, 3]


def unlit_colors(
    points: Tensor,
    views: Sequence[TrainingView],
    light: np.ndarray,
    exposures: np.ndarray,
    reference: float,
    tolerance: float,
    progress: StageProgress = StageProgress(),
) -> Iterator[Unlit]:
    """View by view, the colours that points [N, 3] (m, world) have in no light [4] and exposure [V, 3], on their device.

    The other arguments are those of `fit_light`.
    """
    device, theta = points.device, torch.from_numpy(light).to(points)
    for done, (view, exposure) in enumerate(zip(views, torch.from_numpy(exposures).to(points))):
        progress(done, len(views))
        index, pixels, depth = _visible(view, points, tolerance)
        colors = torch.tensor(view.brightness, device=device).view(-1, 3)[pixels].clamp_min(_GREY_LEVEL)
        quantities = features(depth, torch.ones_like(depth), directions(view.camera, device).flatten(1)[:, pixels], reference)
        yield Unlit(view, index, pixels, colors / (falloff(quantities, theta)[:, None] * exposure.exp()))


def remove_light(model: GaussianModel, seen: Iterable[Unlit]) -> GaussianModel:
    """The model with the colours that, in the light, look like those of the views that see it: the means of its `unlit_colors`."""
    total, count = torch.zeros_like(model.sh[:, 0]), model.sh.new_zeros(len(model), 1)
    for _, index, _, colors in seen:
        index = index.to(total.device)
        total[index] += colors.to(total.device)
        count[index] += 1
    # What is dark in the corner of a picture may be this many times as bright as white in full light.
    colors = (total / count.clamp_min(1)).clamp(0, 4)
    sh = model.sh.clone()
    sh[:, 0] = torch.where(count > 0, (colors - 0.5) / SH_C0, sh[:, 0])
    return dataclasses.replace(model, sh=sh)


def turning_ratio(
    model: GaussianModel,
    views: Sequence[TrainingView],
    light: np.ndarray,
    reference: float,
    tolerance: float,
    facing: float,
    options: PhotometryConfig = PhotometryConfig(),
    progress: StageProgress = StageProgress(),
) -> float:
    """How much views would differ in how bright the same tissue is in a light if it also grew darker as it turns away from them, relative
    to how much they do if not; not a number if nothing tells.

    Both are root mean squares of logarithms, where depth is known, of what exposures leave over; less than a grey level counts as one.

    Args:
        model: Gaussians with `gloss`, which has the normals.
        light: The light [4], a lamp's or of a lens that darkens towards the edge of its pictures.
        views, reference, tolerance, options, progress: As for `fit_light`.
        facing: Exponent of the cosine by which tissue that turns away would grow darker.
    """
    model = model.select(np.arange(0, len(model), _every(len(model), options)))
    known = [dataclasses.replace(view, mask=np.uint8(255) * ((view.tissue > 0) & (view.surface > 0))) for view in views]
    points = model.means.numpy().astype(np.float64)
    view, index, values, quantities = _observed(known, points, reference, tolerance, options, progress)
    if not len(view):
        return math.nan
    eyes = torch.tensor(np.array([each.camera.position for each in views]), dtype=torch.float32)
    cosines = torch.stack([reflections.facing(model, eye).cosines for eye in eyes])[view, index]
    turned = reflections.darkening(cosines, facing).log().double().numpy()
    prior, spread, none = np.zeros(len(views)), np.full(len(views), 10.0), quantities[:, :0]  # next to no prior
    _, point = np.unique(index, return_inverse=True)
    seen = np.bincount(point)

    def unexplained(values: np.ndarray) -> np.ndarray:
        exposures, _ = _solve(none, values, view, point, prior, spread, options.noise, progress)
        rest = values - exposures[view]
        return rest - (np.bincount(point, rest) / seen)[point]

    rest = unexplained(np.log(_brightness(values, views[0].shoulder)).mean(1) - quantities @ light)
    differ = np.sqrt(np.mean([rest**2, (rest - unexplained(turned)) ** 2], 1))
    return float(differ[1] / max(differ[0], _GREY_LEVEL))


def fit_exposure(
    exposures: np.ndarray, brightness: np.ndarray, options: PhotometryConfig = PhotometryConfig()
) -> tuple[float, np.ndarray, np.ndarray]:
    """Response and levels [3] of the automatic exposure, see `Light`, and what they leave of the exposures [V, 3].

    A camera that evens out most of the brightness is the prior, as brightness may be much the same in all views; exposures
    that hardly vary speak for a fixed one. Levels and what is left are natural logarithms, as exposures are.

    Args:
        exposures: Natural logarithm of each view's exposure [V, 3], red, green and blue; `fit_light` finds them.
        brightness: Natural logarithm of each picture's brightness [V] in the light, without the exposure.
        options: The response that is the prior, from 0 of a fixed exposure to 1 of one that evens out all.
    """
    centred, mean = brightness - brightness.mean(), exposures.mean(1)
    noise = np.clip(mean.std(), 0.01, 0.04)  # what the logarithm of an exposure varies by itself, the less the less it varies at all
    trust, doubt = 1 / noise**2, 1 / 0.5**2  # the prior's deviation: any response from none to a full one is likely
    slope = (doubt * options.response - trust * centred @ mean) / (doubt + trust * centred @ centred)
    response = float(np.clip(slope, 0, 1))
    residuals = exposures - exposures.mean(0) + response * centred[:, None]
    return response, exposures.mean(0) + response * brightness.mean(), residuals


def _every(count: int, options: PhotometryConfig) -> int:
    """Of so many points one in how many is compared between views."""
    return max(-(-count // options.max_points), 1)


def _observed(
    views: Sequence[TrainingView],
    points: np.ndarray,
    reference: float,
    tolerance: float,
    options: PhotometryConfig,
    progress: StageProgress,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """View [M], point [M], values [M, 3] of the picture and light's quantities [M, 4] of points [N, 3] that are seen well in two views or
    more."""
    observed = progress.map(lambda view: _well_seen(view, points, reference, tolerance, options), views)
    view = np.concatenate([np.full(len(index), v) for v, (index, _, _) in enumerate(observed)])
    index, colors, quantities = (np.concatenate(arrays) for arrays in zip(*observed))
    seen = np.bincount(index, minlength=len(points))[index] > 1
    return view[seen], index[seen], colors[seen], quantities[seen]


def _visible(view: TrainingView, points: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Of the points [N, 3] that a view sees, those on its tissue that its depth prior does not hide: indices, pixels, depths (m) [M]."""
    camera, on_device = view.camera, lambda array: torch.tensor(array, device=points.device).flatten()
    u, v, z = project(points.new_tensor(camera.viewmat), points.new_tensor(camera.K), points)
    index = torch.nonzero(inside(u, v, z, camera.width, camera.height))[:, 0]
    pixels, z = v[index].long() * camera.width + u[index].long(), z[index]
    surface = on_device(view.surface)[pixels]
    seen = (on_device(view.tissue)[pixels] > 0) & ((surface <= 0) | ((z - surface).abs() < tolerance * surface))
    return index[seen], pixels[seen], z[seen]


def _well_seen(
    view: TrainingView, points: np.ndarray, reference: float, tolerance: float, options: PhotometryConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the points that a view sees well: their indices [M], values of the picture [M, 3] in [0, 1] and light's quantities [M, 4]."""
    index, pixels, _ = (found.numpy() for found in _visible(view, torch.from_numpy(points), tolerance))
    blurred = cv2.GaussianBlur(view.image, (0, 0), 1.5)  # over a pixel and a half, what depth is off
    colors = blurred.reshape(-1, 3)[pixels].astype(np.float64)
    good = (colors.max(1) < options.brightest) & (colors.max(1) > options.darkest)
    return index[good], colors[good] / 255, features_at(points[index[good]], view.camera, reference)


def _brightness(values: np.ndarray, shoulder: float) -> np.ndarray:
    """That of values [M, 3] of pictures, at least a grey level, float64."""
    return untoned(values, shoulder).astype(np.float64).clip(_GREY_LEVEL)


def _solve(
    quantities: np.ndarray,
    y: np.ndarray,
    view: np.ndarray,
    index: np.ndarray,
    prior: np.ndarray,
    spread: np.ndarray,
    noise: float,
    progress: StageProgress,
) -> tuple[np.ndarray, np.ndarray]:
    """x [Q + V] that minimises Σ w (y − A x − own_index)² / noise² + Σ (x − prior)² / spread², and the weights w [M].

    A x is quantities [M, Q] times the first numbers of x, plus that of the view [M] among the last. Each point's own value is
    eliminated; w falls for observations that do not fit (Cauchy).
    """
    trust = _trust(index, noise)
    points, index = np.unique(index, return_inverse=True)
    known, count, size = np.ascontiguousarray(quantities.T), len(points), len(prior)
    Q, column, weights, x = len(known), len(known) + view, np.ones(len(y)), prior
    product = lambda a, b: np.einsum("im,jm->ij", a, b)  # `@` has other last bits with other numbers of threads
    for _ in range(10):
        progress.check()
        total = np.bincount(index, weights)
        about = lambda values: (np.bincount(index, weights * values) / total)[index]  # noqa: B023
        rest = y - about(y)
        normal, right = np.diag(np.bincount(column, weights, size)), np.bincount(column, weights * rest, size)
        by_point = np.bincount(column * count + index, weights, size * count).reshape(size, count)
        weighted = weights * known
        normal[:Q, :Q], right[:Q] = product(weighted, known), (weighted * rest).sum(1)
        for i, values in enumerate(weighted):
            normal[i, Q:] = normal[Q:, i] = np.bincount(view, values, size - Q)
            by_point[i] = np.bincount(index, values)
        normal = trust * (normal - product(by_point, by_point / total)) + np.diag(1 / spread**2)
        x = np.linalg.solve(normal, trust * right + prior / spread**2)
        fitted = quantities @ x[:Q] + x[column]
        residual = rest - fitted + about(fitted)
        scale = max(1.4826 * np.median(np.abs(residual)), 1e-3)
        weights = 1 / (1 + (residual / (2 * scale)) ** 2)
    return x, weights


def _trust(index: np.ndarray, noise: float) -> float:
    """What the square of a difference of the points [M] counts, in its variances."""
    return min(300 / len(np.unique(index)), 1) / noise**2  # neighbouring points err alike: no more than this many are worth counting


def _apart(values: np.ndarray, index: np.ndarray, weights: np.ndarray) -> float:
    """How far values [M] of the same points [M] are apart: the sum of their weighted squares about each point's mean."""
    total = np.bincount(index, weights).clip(1e-12)
    return float((weights * (values - (np.bincount(index, weights * values) / total)[index]) ** 2).sum())
