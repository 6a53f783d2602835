"""Plane sweep: depth away from scene points, by matching each view with others on plane after plane (Collins 1996).

Between scene points interpolated depth has no edges: a wall behind an organ becomes a ramp. Smooth tissue has no points at all. Here each
view is compared with what others would show if all tissue lay on a plane, for planes at one distance after the other; semi-global
aggregation (Hirschmüller 2008) chooses.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.kernels import launch, load_kernels
from endo_sim_ros.reconstruction.priors import sweep_kernels
from endo_sim_ros.reconstruction.priors.interpolation import fit_plane
from endo_sim_ros.reconstruction.priors.inverse_depth import prepare_smoothing, smooth
from endo_sim_ros.reconstruction.priors.sources import between_points
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView, pixels_of, shrink
from endo_sim_ros.reconstruction.stage_configs import InterpolationConfig, MatchingConfig, PlaneSweepConfig
from endo_sim_ros.reconstruction.triangulation import nearest_views, points_in_view

_DIRECTIONS = [(down, across) for down in (-1, 0, 1) for across in (-1, 0, 1) if (down, across) != (0, 0)]
_FAR = 1e-4  # of a distance between cameras over depth is as good as infinitely far
_COARSE = 8  # pixels of one in which the light is blurred
_STILL = 2  # planes from infinity, a pixel each, within which a picture stands still
_CENTRED = np.array([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # pixels as OpenCV counts them, from the centre of the first, to ours


class Picture(NamedTuple):
    """A view at the width of the sweep, with the means and variances over windows that every comparison needs."""

    camera: Camera
    grey: np.ndarray  # [H, W] float32, without the slow changes that the light makes
    tissue: np.ndarray  # [H, W] float32, 1 or 0
    inside: np.ndarray  # [H, W] bool, where a window shows nothing but tissue
    mean: np.ndarray  # [H, W]
    variance: np.ndarray  # [H, W]


class _Swept(NamedTuple):
    """Inverse depth of a view (1/m) at the width of the sweep, 0 where none is found."""

    sure: np.ndarray  # [H, W], where others confirm it
    likely: np.ndarray  # [H, W], wherever others show the same at that depth


class _Matched(NamedTuple):
    """What the sweep of a view found."""

    inverse: np.ndarray  # [H, W] inverse depth, 1/m
    plane: np.ndarray  # [H, W] which one is nearest to it
    step: float  # 1/m, between two planes
    alike: np.ndarray  # [H, W] bool, where others show the same at that depth


def sweep_depth(
    views: Sequence[TrainingView],
    points: np.ndarray,
    tolerance: float,
    options: PlaneSweepConfig = PlaneSweepConfig(),
    matching: MatchingConfig = MatchingConfig(),
    device: str = "cpu",
    progress: StageProgress = StageProgress(),
    interpolation: InterpolationConfig = InterpolationConfig(),
) -> list[TrainingView]:
    """The views with interpolated depth kept near scene points alone, and that of the sweep where it is sure and there is none or another.

    Points count that are as deep as what was interpolated. It is interpolated anew where the sweep finds that some are hidden in a view.
    The sweep is sure where enough other views show the same, and their own sweeps found the same surface. Views of too few points are
    matched in shrunk pictures, too. Where nothing tells of depth there is none.

    Args:
        views: Views with depth that is interpolated between scene points; None where they are too few.
        points: Scene points [N, 3] (m, world).
        tolerance: Relative difference of depth at which points, interpolation and sweep contradict each other.
        options: How to match and what to believe.
        matching: How many points a view must see.
        device: Where planes are compared.
        progress: Reported to by views.
        interpolation: How depth is interpolated anew.
    """
    load_kernels((sweep_kernels,), device)
    prepare_smoothing(device)
    blind = progress.map(lambda view: len(points_in_view(view.camera, points, matching)[0]) < matching.min_points, views)
    swept, likely = (list(found) for found in zip(*_swept(views, points, blind, options, matching, device, progress)))
    for level in range(1, options.levels if any(blind) else 1):
        # Smooth tissue shows something in large squares of little noise alone. They blur edges: where there are points, those tell more.
        coarser = dataclasses.replace(options, width=options.width >> level, noise=options.noise / 2**level)
        for index, (inverse, _) in enumerate(_swept(views, points, blind, coarser, matching, device, progress)):
            finer = swept[index]
            inverse = cv2.resize(inverse, finer.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
            swept[index] = np.where(blind[index] & (finer == 0), inverse, finer)
    if any(blind) and len(found := np.concatenate([inverse[inverse > 0] for inverse in swept])):
        # No points tell how far is too far: what all views found does.
        farthest = options.margin * np.median(found)
        swept = [np.where(lost & (inverse < farthest), 0, inverse) for lost, inverse in zip(blind, swept)]

    def with_depth(index: int) -> TrainingView:
        view, inverse, visible = views[index], swept[index], points
        if not blind[index] and (hidden := _hidden(view.camera, points, likely[index], tolerance, options)).any():
            visible = points[~hidden]
            view = between_points(view, visible, interpolation, matching, device)
        depth = np.where(_near_points(view, visible, tolerance, options), view.surface, 0)
        inverse = cv2.resize(inverse, (view.camera.width, view.camera.height), interpolation=cv2.INTER_NEAREST_EXACT)
        other = (inverse > 0) & (view.tissue > 0) & (np.abs(depth * inverse - 1) > tolerance)  # 0 is another depth, too
        depth[other] = 1 / inverse[other]
        return dataclasses.replace(view, depth_prior=depth.astype(np.float32) if depth.any() else None)

    return progress.map(with_depth, range(len(views)))


def _swept(
    views: Sequence[TrainingView],
    points: np.ndarray,
    blind: Sequence[bool],
    options: PlaneSweepConfig,
    matching: MatchingConfig,
    device: str,
    progress: StageProgress,
) -> list[_Swept]:
    """What the sweep of each view tells; blind ones see too few points."""
    pictures = progress.map(lambda view: picture_of(shrink(view, options.width), options), views)
    near = nearest_views(views, options.neighbours)

    def sweep(index: int) -> _Matched | None:
        own, others = pictures[index], [pictures[j] for j in near[index]]
        planes = None
        if blind[index] and others:
            planes = _planes_from_far(own, others, options)
        elif len(others) >= options.min_views and len((seen := points_in_view(own.camera, points, matching))[0]) >= matching.min_points:
            planes = _planes_about(own, others, *seen, options)
        return None if planes is None else _sweep(own, others, planes, options, device, progress)

    matched = progress.map(sweep, range(len(views)))

    def told(index: int) -> _Swept:
        if (own := matched[index]) is None:
            return _Swept(nothing := np.zeros(pictures[index].grey.shape, np.float32), nothing)
        others = [(pictures[j].camera, other) for j in near[index] if (other := matched[j]) is not None]
        believed = own.alike & _confirmed(pictures[index].camera, own, others, options)
        sixteenths = np.where(believed, 16 * (own.plane + 1), 0).astype(np.int16)  # what is left of wrong matches are islands
        cv2.filterSpeckles(sixteenths, 0, int(options.min_area * believed.size), 16)
        sure = np.where(sixteenths > 0, smooth(own.inverse, options.smoothing, options.edge, device), 0)
        return _Swept(sure.astype(np.float32), np.where(own.alike, own.inverse, np.float32(0)))

    return progress.map(told, range(len(views)))


def _hidden(camera: Camera, points: np.ndarray, likely: np.ndarray, tolerance: float, options: PlaneSweepConfig) -> np.ndarray:
    """Which of the points [N, 3] something hides in a view [N]: most of the picture around them is likely to be nearer.

    Between points it is guessed that tissue goes on, so that what has few points of its own would be taken for what is behind it.
    """
    height, width = likely.shape
    index, rows, columns, depth = pixels_of(camera.resized(width, height), points)
    reach = max(round(options.point_reach * width), 1)
    side = 2 * reach + 1
    windows, hidden = np.lib.stride_tricks.sliding_window_view(np.pad(likely, reach), side, 1), np.zeros(len(points), bool)
    nearer = sum((windows[rows + down, columns] * depth[:, None] > 1 + tolerance).sum(1) for down in range(side))
    hidden[index] = nearer > side**2 / 2
    return hidden


def _near_points(view: TrainingView, points: np.ndarray, tolerance: float, options: PlaneSweepConfig) -> np.ndarray:
    """Where a scene point is close in a view [H, W], the nearest one being as deep as the depth that was interpolated between all."""
    _, rows, columns, depth = pixels_of(view.camera, points)
    agrees = np.abs(view.surface[rows, columns] / depth - 1) < tolerance

    def distance(which: np.ndarray) -> np.ndarray:
        away = np.ones(view.surface.shape, np.uint8)
        away[rows[which], columns[which]] = 0
        return cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_5)

    return distance(agrees) < np.minimum(options.point_reach * view.camera.width, distance(~agrees))


def picture_of(view: TrainingView, options: PlaneSweepConfig) -> Picture:
    """What of a view is matched with others."""
    grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    tissue = (view.tissue > 0).astype(np.float32)
    size = [max(side // _COARSE, 1) for side in grey.shape[::-1]]  # of so wide a blur
    around = lambda values: cv2.GaussianBlur(cv2.resize(values, size, interpolation=cv2.INTER_AREA), (0, 0), options.shading * size[0])
    grey -= cv2.resize(around(grey * tissue) / np.maximum(around(tissue), 1e-6), grey.shape[::-1])
    return Picture(view.camera, grey, tissue, _whole(tissue, options), *_moments(grey, options))


def _mean(values: np.ndarray, options: PlaneSweepConfig) -> np.ndarray:
    return cv2.blur(values, (options.window, options.window))


def _whole(tissue: np.ndarray, options: PlaneSweepConfig) -> np.ndarray:
    return _mean(tissue, options) > 0.95  # warping blurs the edges of a mask


def _moments(grey: np.ndarray, options: PlaneSweepConfig) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance [H, W] of a picture over windows; the variance includes that of noise."""
    mean = _mean(grey, options)
    return mean, np.maximum(_mean(grey * grey, options) - mean * mean, 0) + options.noise**2


class _Planes(NamedTuple):
    """Planes one after the other, farthest first: the inverse depth (1/m) of each is slope_u × u + slope_v × v + its level."""

    slope_u: float
    slope_v: float
    levels: np.ndarray  # [L] 1/m
    farthest: float  # 1/m; what seems farther stands still in the picture: dirt on the lens, the light and its edge


def _planes_about(own: Picture, others: list[Picture], uv: np.ndarray, z: np.ndarray, options: PlaneSweepConfig) -> _Planes:
    """Planes about scene points, which a view shows at pixels uv [N, 2] with depths z [N] (m)."""
    # They are tilted as the points are on the whole: tissue that faces the camera askew stays alike within a window.
    slope_u, slope_v, level = fit_plane(uv[:, 0], uv[:, 1], 1 / z)
    apart = 1 / z - (slope_u * uv[:, 0] + slope_v * uv[:, 1] + level)
    median = float(np.median(1 / z))
    beyond = options.margin * median
    # What is thin and in front of the tissue has few points, or none.
    low, high = np.percentile(apart, 1) - beyond, max(np.percentile(apart, 99), (options.nearest - 1) * median) + beyond
    # The better half of the views counts: planes need not be a pixel apart in the farthest.
    pixels = (high - low) * np.median([_speed(own.camera, other.camera, median) for other in others])
    levels = level + np.linspace(low, high, _count(pixels, options))
    return _Planes(slope_u, slope_v, levels, min(np.percentile(1 / z, 1), beyond))


def _planes_from_far(own: Picture, others: list[Picture], options: PlaneSweepConfig) -> _Planes | None:
    """Planes from infinity on, to one so near that some other view's picture moves by `options.most_shift`.

    None if all cameras are at one place.
    """
    pixels = options.most_shift * own.camera.width
    apart = max(float(np.linalg.norm(other.camera.position - own.camera.position)) for other in others)
    if not apart:
        return None
    speed = max(_speed(own.camera, other.camera, _FAR / apart) for other in others)
    levels = np.linspace(0, pixels / speed, _count(pixels, options))
    return _Planes(0.0, 0.0, levels, float(levels[_STILL]))


def _count(pixels: float, options: PlaneSweepConfig) -> int:
    """How many planes, so that a picture moves by a pixel from one to the next."""
    return int(np.clip(np.ceil(pixels), options.min_planes, options.max_planes))


def _sweep(
    own: Picture, others: list[Picture], planes: _Planes, options: PlaneSweepConfig, device: str, progress: StageProgress
) -> _Matched:
    """Match a view with others on plane after plane."""
    slope_u, slope_v, levels, farthest = planes
    equations = np.stack(np.broadcast_arrays(slope_u, slope_v, levels), 1)
    match = costs_by_opencv if device == "cpu" else costs_by_kernels
    costs = match(own, others, equations, options, device, progress)
    totals = _aggregated(costs, options, device)
    chosen = totals.argmin(2, keepdim=True)
    middle = chosen.clamp(1, len(levels) - 2)
    at = lambda values, which: values.gather(2, which)[..., 0].cpu().numpy()
    before, there, after = (at(totals, middle + step) for step in (-1, 0, 1))
    best, inner, cost = chosen[..., 0].cpu().numpy(), middle[..., 0].cpu().numpy(), at(costs, chosen)
    bend = np.maximum(before - 2 * there + after, 1e-6)  # of a parabola through the three
    exact = best == inner
    place = best + np.where(exact, np.clip(0.5 * (before - after) / bend, -0.5, 0.5), 0)
    step = float(levels[1] - levels[0])
    rows, columns = np.mgrid[: len(best), : best.shape[1]] + 0.5
    inverse = np.maximum(slope_u * columns + slope_v * rows + levels[0] + place * step, 1e-6).astype(np.float32)
    return _Matched(inverse, best, step, exact & (own.tissue > 0) & (cost < options.max_cost) & (inverse > farthest))


def _speed(camera: Camera, other: Camera, inverse: float) -> float:
    """By how many pixels another view's picture moves for each 1/m of inverse depth, about the one given; median over the picture."""
    v, u = (np.arange(0, size, 32) + 0.5 for size in (camera.height, camera.width))
    some = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    points = lambda value: camera.unproject(some, np.full(len(some), 1 / value))
    moved = other.project(points(1.01 * inverse))[0] - other.project(points(inverse))[0]
    return float(np.median(np.hypot(*moved.T))) / (0.01 * inverse)


def costs_by_opencv(
    own: Picture, others: list[Picture], planes: np.ndarray, options: PlaneSweepConfig, device: str, progress: StageProgress
) -> Tensor:
    """1 − correlation [H, W, L] with the better half of the other views, if all tissue lies on one plane after the other.

    What one view hides others may show. 1 where there is nothing to compare with.

    Args:
        own, others: The view and those that it is matched with.
        planes: [L, 3]; the inverse depth (1/m) of a plane is its product with (u, v, 1).
        options: Window, and noise of the pictures.
        device: Where to; matched is on the CPU.
        progress: Asked whether to go on.
    """
    size, costs = own.grey.shape[::-1], np.empty((*own.grey.shape, len(planes)), np.float32)
    for index, homographies in enumerate(_homographies(own, others, planes)):
        progress.check()
        found = []
        for other, homography in zip(others, homographies):
            seen = lambda picture: cv2.warpPerspective(picture, homography, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)  # noqa: B023
            grey = seen(other.grey)
            mean, variance = _moments(grey, options)
            correlation = (_mean(own.grey * grey, options) - own.mean * mean) / np.sqrt(own.variance * variance)
            comparable = own.inside & _whole(seen(other.tissue), options)
            found.append(np.where(comparable, np.minimum(1 - correlation, 1), 1))
        costs[..., index] = _smaller_half(found)
    return torch.from_numpy(costs).to(device)


def costs_by_kernels(
    own: Picture, others: list[Picture], planes: np.ndarray, options: PlaneSweepConfig, device: str, progress: StageProgress
) -> Tensor:
    """As `costs_by_opencv`, on a device: a fraction of the time on a GPU."""
    height, width = own.grey.shape
    largest = np.max([other.grey.shape for other in others], 0)
    padded = lambda array: np.pad(array, [(0, most - size) for most, size in zip(largest, array.shape)])
    on_device = lambda array: torch.from_numpy(np.ascontiguousarray(array)).to(device)
    pictures = on_device(np.stack([np.stack([padded(other.grey), padded(other.tissue)], -1) for other in others]))
    homographies = on_device(_homographies(own, others, planes).astype(np.float32))
    view = [on_device(array) for array in (own.grey, own.inside.astype(np.uint8), own.mean, own.variance)]
    warped, scratch = (torch.empty(len(others), height, width, *more, device=device) for more in ((2,), ()))
    costs, levels = torch.empty(height, width, len(planes), device=device), torch.arange(len(planes), dtype=torch.int32, device=device)
    for homography, level in zip(homographies, levels.split(1)):
        progress.check()
        launch(sweep_kernels.warp_pictures, scratch.numel(), [pictures, homography, height, width, warped], device)
        arguments = [*view, warped, options.window, options.noise**2, level, scratch, costs]
        launch(sweep_kernels.match_costs, height * width, arguments, device)
    return costs


def _homographies(own: Picture, others: list[Picture], planes: np.ndarray) -> np.ndarray:
    """From a view's pixels to those of others [L, J, 3, 3], as OpenCV counts them, if all tissue lies on one of the planes [L, 3]."""
    rays, found = np.linalg.inv(own.camera.K), []
    for other in others:
        motion = (other.camera.viewmat @ own.camera.pose)[:3]
        moved = motion[:, :3] @ rays + motion[:, 3, None] * planes[:, None]
        found.append(np.linalg.inv(_CENTRED) @ other.camera.K @ moved @ _CENTRED)
    return np.stack(found, 1)


def _smaller_half(values: list[np.ndarray]) -> np.ndarray:
    """Mean of the smaller half (rounded up) of several values, for each pixel."""
    # Whole pictures are compared at a time, which takes a fraction of what sorting pixel by pixel does.
    values, total, count = list(values), np.zeros_like(values[0]), (len(values) + 1) // 2
    for _ in range(count):
        least = values.pop(0)
        for index, value in enumerate(values):
            least, values[index] = np.minimum(least, value), np.maximum(least, value)
        total += least
    return total / count


def _aggregated(costs: Tensor, options: PlaneSweepConfig, device: str) -> Tensor:
    """Σ of the costs [H, W, L] along paths from eight directions."""
    height, width, levels = costs.shape
    totals, scratch = torch.zeros_like(costs), torch.empty(height + width, 2, levels, device=device)
    lanes = 1 if device == "cpu" else sweep_kernels.WARP
    for down, across in _DIRECTIONS:
        arguments = [costs, down, across, options.small_penalty, options.large_penalty, lanes, scratch, totals]
        launch(sweep_kernels.aggregate, lanes * (height + width), arguments, device)
    return totals


def _confirmed(camera: Camera, own: _Matched, others: list[tuple[Camera, _Matched]], options: PlaneSweepConfig) -> np.ndarray:
    """Where so many other sweeps found the surface that a sweep found [H, W], too: `options.min_views`, or as many as look at it from less
    than `options.most_aside` beside if these are fewer, and one at least. From farther, a window does not look alike."""
    points = camera.backproject(1 / own.inverse).reshape(-1, 3)
    rays = lambda eye: (points - eye) / np.linalg.norm(points - eye, axis=1, keepdims=True)
    found, able, nearest = np.zeros(len(points), int), np.zeros(len(points), int), np.cos(np.radians(options.most_aside))
    for other_camera, other in others:
        able += (rays(camera.position) * rays(other_camera.position)).sum(1) > nearest
        there = pixels_of(other_camera, points)
        apart = np.abs(other.inverse[there.rows, there.columns] - 1 / there.depth)
        found[there.index[apart < options.same_surface * max(own.step, other.step)]] += 1
    return (found >= np.clip(able, 1, options.min_views)).reshape(own.inverse.shape)
