"""Tissue continued where no training view has seen it: large Gaussians in the holes of the depth prior and beyond the pictures.

They keep other views from looking into the void. Physics, which knows the training cameras, takes no control nodes from them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (it is public)
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import cpu_threads, one_at_a_time
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import directions, falloff, features
from endo_sim_ros.reconstruction.device_views import inside, project
from endo_sim_ros.reconstruction.priors.interpolation import clip_to_range, fit_plane, inverse_distance_weighted, krige
from endo_sim_ros.reconstruction.priors.nearness import disagreements, log_nearness
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView, shrink
from endo_sim_ros.reconstruction.stage_configs import ExtrapolationConfig, InterpolationConfig
from endo_sim_ros.reconstruction.triangulation import nearest_views, points_in_view
from endo_sim_ros.sequences.recording import spread

_FINENESS = 4  # pixels of a cell: what goes on beyond a picture is no finer than cells
_AROUND = 8  # pixels from where depth is unknown, within which points tell how it goes on
_THINNED = 2  # pixels in each of which at most one point tells it, that of the middle depth
_COMPARED_VIEWS, _COMPARED = 8, 2  # views, and with how many others each, that tell what of light is true
_FEWEST = 1000  # pixels that do
_FLATTEST = 0.3  # exponent of the falloff with distance; with a smaller one brightness does not tell it
_FROM, _HALVINGS = 8, 6  # of how many to one place a choice is made, and steps at most to find the distance between those chosen
_FULL = 0.96  # share of the places that are taken, so that the distance is right to 2 %
_TOGETHER = 1000  # positions whose neighbours are looked up together
_AT_ONCE = 2_000_000  # points in views that are looked up at a time


@dataclass(frozen=True)
class SeenTissue:
    """What was seen, and how it is continued.

    Args:
        model: What was seen.
        views: Training views with their depth prior; views without one add nothing.
        points: Scene points [N, 3] (m, world) that other views may have given; they tell how the surface goes on.
        light, exposures: The light [4] and the logarithm of each view's exposure [V, 3].
        reference: Distance (m) at which colours are the tissue's own.
        options: Size and opacity of the Gaussians.
        interpolation: How depth and colour are continued, and on how fine a lattice.
        device: Where depth is continued.
        progress: Reported to by views.
    """

    model: GaussianModel
    views: Sequence[TrainingView]
    points: np.ndarray
    light: np.ndarray
    exposures: np.ndarray
    reference: float
    options: ExtrapolationConfig = ExtrapolationConfig()
    interpolation: InterpolationConfig = InterpolationConfig()
    device: str = "cpu"
    progress: StageProgress = StageProgress()

    def cloud(self) -> Tensor:
        """The model's and all other scene points [N, 3] (m, world, float64), on the device."""
        return torch.from_numpy(np.concatenate([self.model.means.numpy().astype(np.float64), self.points])).to(self.device)

    def nearness(self, index: int, view: TrainingView) -> np.ndarray:
        """The `log_nearness` [H, W] of the view of this number, maybe shrunk."""
        return log_nearness(view, self.light, self.exposures[index], self.reference, self.options.texture)


class ContinuedView(NamedTuple):
    """A view with a margin around its picture."""

    camera: Camera  # of the picture and its margin
    depth: np.ndarray  # [H, W] m, everywhere
    colors: np.ndarray  # [H, W, 3] without light
    away: np.ndarray  # [H, W] pixels from the tissue in the picture, 0 in it


class _Guess(NamedTuple):
    """Tissue on a lattice of pixels that show none of known depth, in and around a picture."""

    positions: np.ndarray  # [N, 3] m, world
    colors: np.ndarray  # [N, 3] without light
    spacing: np.ndarray  # [N] m, between neighbours
    away: np.ndarray  # [N] from the tissue in the picture, 0 in it; widths of the picture


class _Known:
    """What all views know, on a device: a lookup by points.

    Args:
        views: Those with a depth prior.
        device: Where points are looked up.
    """

    def __init__(self, views: Sequence[TrainingView], device: str):
        to = lambda values: torch.from_numpy(np.array(values)).to(device)
        joined = lambda masks: torch.from_numpy(np.concatenate([mask.ravel() for mask in masks])).to(device)
        cameras = [view.camera for view in views]
        self._viewmats, self._K = to([camera.viewmat for camera in cameras]), to([camera.K for camera in cameras])
        self._sizes = to([(camera.width, camera.height) for camera in cameras])
        self._first = torch.cumsum(self._sizes.prod(1), 0) - self._sizes.prod(1)  # pixel of each view
        self._depth = joined([view.depth_prior > 0 for view in views if view.depth_prior is not None])
        self._tissue = joined([view.tissue > 0 for view in views])

    def without(self, guess: _Guess) -> _Guess:
        """The part of a guess where no view knows the depth, and, if beyond its own picture, beyond the tissue that any view sees."""
        to = lambda array: torch.from_numpy(array).to(self._depth.device)
        positions, beyond = to(guess.positions), to(guess.away > 0)
        unknown = torch.ones_like(beyond)
        # So many views at a time that their pixels take some ten megabytes.
        for views in torch.arange(len(self._first)).split(max(_AT_ONCE // max(len(positions), 1), 1)):
            u, v, z = project(self._viewmats[views], self._K[views], positions)
            within = inside(u, v, z, self._sizes[views, :1], self._sizes[views, 1:])
            pixel = torch.where(within, self._first[views, None] + v.long() * self._sizes[views, :1] + u.long(), 0)
            unknown &= ~(within & (self._depth[pixel] | beyond & self._tissue[pixel])).any(0)
        kept = unknown.cpu().numpy()
        return _Guess(*(values[kept] for values in guess))


def extrapolate(seen: SeenTissue, reach: float, max_gaussians: int, by_brightness: bool = False) -> GaussianModel:
    """The model, and Gaussians where no view knows the depth: inverse depth by kriging, colour as the mean of the picture by distance.

    Args:
        seen: What was seen.
        reach: How far to go beyond the pictures, in their widths; 0 adds nothing, in holes neither.
        max_gaussians: Largest number of Gaussians in all.
        by_brightness: Whether brightness tells depth where no point is near.
    """
    model, views, options, interpolation, device = seen.model, seen.views, seen.options, seen.interpolation, seen.device
    if reach <= 0:
        return model
    parts = [model.means.numpy().astype(np.float64)]
    colors, spacings = [], []
    known = [view.depth_prior is not None and (view.depth_prior > 0).mean() >= options.min_coverage for view in views]
    usable = [index for index, view in enumerate(views) if known[index] and view.tissue.any()]
    if not usable:
        return model
    threads = max(cpu_threads() // max(len(usable), 1), 1)  # for each view: few leave cores idle
    known_views, cloud = _Known([view for view in views if view.depth_prior is not None], device), seen.cloud()

    def around(index: int) -> tuple[_Guess, _Guess]:
        view = shrink(views[index], round(_FINENESS / interpolation.cell))
        near = seen.nearness(index, view) if by_brightness else None
        pad = int(reach * view.camera.width)
        continued = continue_view(view, cloud, seen.light, seen.exposures[index], seen.reference, pad, near, interpolation, threads)

        def guess(times: float) -> _Guess:
            with one_at_a_time(device):
                unknown = known_views.without(_on_lattice(view, continued, times * interpolation.cell))
            new = _beside(there, unknown.positions, unknown.spacing)
            return _Guess(*(values[new] for values in unknown))

        return guess(1.0), guess(1.5)

    there = cKDTree(parts[0])
    guesses = seen.progress.map(around, usable)
    width = 4 * interpolation.cell
    rings = range(math.ceil(reach / width))
    tree_of = lambda parts: cKDTree(np.concatenate([np.empty((0, 3)), *parts]), compact_nodes=False, balanced_tree=False)  # built sooner
    # Holes, then outwards around all views at a time, since what is close to one picture and far from another is told by the former.
    for ring in (-1, *rings):
        least, most = ring * width, np.inf if ring == rings[-1] else (ring + 1) * width
        before, of_ring = tree_of(parts[1:]), []
        for fine, coarse in guesses:
            seen.progress.check()
            guess = fine if least < options.fine_reach else coarse
            chosen = (guess.away > least) & (guess.away <= most)
            positions, spacing = guess.positions[chosen], guess.spacing[chosen]
            new = np.ones(len(positions), bool)
            for tree in (before, tree_of(of_ring)):
                new[new] = _beside(tree, positions[new], spacing[new])
            of_ring.append(positions[new])
            colors.append(guess.colors[chosen][new])
            spacings.append(spacing[new])
        parts += of_ring
    count, room = sum(map(len, spacings)), max_gaussians - len(model)
    if not count or room <= 0:
        return model
    arrays = np.concatenate(parts[1:]), np.concatenate(colors), options.size * np.concatenate(spacings)
    if count > room:  # fewer and larger ones
        kept, times = _spread_evenly(arrays[0], np.concatenate(spacings), room)
        arrays = arrays[0][kept], arrays[1][kept], times * arrays[2][kept]
    tensors = (torch.from_numpy(array.astype(np.float32)) for array in arrays)
    added = GaussianModel.from_points(*tensors, opacity=options.opacity, sh_degree=model.sh_degree).tensors()
    return replace(model, **{name: torch.cat([value, added[name]]) for name, value in model.tensors().items()})


def brightness_ratio(seen: SeenTissue) -> float:
    """How much views differ in colour in the holes of each other's depth prior if brightness tells depth there, relative to how much
    they do if it does not; infinite if there is too little to compare, or holes are few."""
    light, exposures, compared = seen.light, seen.exposures, _Compared(seen)

    def compare(index: int) -> np.ndarray:
        view = compared.shrunk(index)
        holes = (view.surface <= 0) & (view.tissue > 0)
        if not holes.any() or not (view.surface > 0).any():
            return np.empty((0, 2))
        depths = [compared.depth(view, told) for told in (None, seen.nearness(index, view))]
        return disagreements(view, depths, holes, compared.others(index, exposures), light, exposures[index], seen.reference)

    tissue = sum(np.count_nonzero(view.tissue) for view in seen.views)
    known = sum(np.count_nonzero((view.surface > 0) & (view.tissue > 0)) for view in seen.views)
    few = tissue - known < seen.options.brightness_holes * tissue
    if light[0] < _FLATTEST or not seen.options.brightness_ratio or few:
        return math.inf
    return _ratio(compare, seen.views, seen.progress)


def light_ratio(seen: SeenTissue, light: np.ndarray, exposures: np.ndarray) -> float:
    """How much views differ in colour, wherever they see the same, in the light that was seen, relative to how much they do in another
    one [4] with exposures [V, 3]; infinite if there is too little to compare. Depth is continued where it is not known."""
    compared = _Compared(seen)

    def compare(index: int) -> np.ndarray:
        view = compared.shrunk(index)
        if not (view.surface > 0).any():
            return np.empty((0, 2))
        depth = np.where(view.surface > 0, view.surface, compared.depth(view))
        differ = lambda light, exposures: disagreements(
            view, [depth], view.tissue > 0, compared.others(index, exposures), light, exposures[index], seen.reference
        )
        return np.hstack([differ(light, exposures), differ(seen.light, seen.exposures)])

    return _ratio(compare, seen.views, seen.progress)


class _Compared:
    """Views, the others that each is compared with, and depth where it is not known."""

    def __init__(self, seen: SeenTissue):
        self._views, self._near, self._interpolation = seen.views, nearest_views(seen.views, _COMPARED), seen.interpolation
        self._cloud = seen.cloud()

    def shrunk(self, index: int) -> TrainingView:
        """A view in so many pixels as are worth comparing."""
        return shrink(self._views[index], round(_FINENESS / self._interpolation.cell))

    def others(self, index: int, exposures: np.ndarray) -> list[tuple[TrainingView, np.ndarray]]:
        """Those that a view is compared with, and their exposures."""
        return [(self.shrunk(other), exposures[other]) for other in self._near[index]]

    def depth(self, view: TrainingView, near: np.ndarray | None = None) -> np.ndarray:
        """Depth [H, W] (m) everywhere."""
        return _Wide.around(view, 0).depth(self._cloud, near, self._interpolation)


def _ratio(compare: Callable[[int], np.ndarray], views: Sequence[TrainingView], progress: StageProgress) -> float:
    """Of differences [M, 2] that are found for some views, the root mean square of the second relative to that of the first."""
    differences = np.concatenate(progress.map(compare, spread(range(len(views)), _COMPARED_VIEWS)))
    first, second = np.sqrt((differences**2).sum(0))
    return float(second / first) if len(differences) > _FEWEST and first else math.inf


def continue_view(
    view: TrainingView,
    points: Tensor,
    light: np.ndarray,
    exposure: np.ndarray,
    reference: float,
    pad: int,
    near: np.ndarray | None = None,
    interpolation: InterpolationConfig = InterpolationConfig(),
    threads: int = 1,
) -> ContinuedView:
    """The view with a margin of so many pixels, and depth and colour wherever it has none.

    Args:
        view: A training view with a depth prior.
        points: Scene points [N, 3] (m, world, float64), on the device where depth is continued.
        light, exposure: The light [4] and the logarithm of the view's exposure [3].
        reference: Distance (m) at which colours are the tissue's own.
        pad: Width of the margin, pixels.
        near: The `log_nearness` [H, W], if brightness tells depth: what is continued is then how far depth is from it, which is the
            tissue's own colour.
        interpolation: How depth and colour are continued.
        threads: How many look for neighbours.
    """
    wide = _Wide.around(view, pad)
    depth = wide.depth(points, near, interpolation, threads)
    image = np.pad(view.brightness, ((pad, pad), (pad, pad), (0, 0)))
    quantities = features(torch.from_numpy(depth).float(), torch.ones(1), directions(wide.camera, "cpu"), reference)
    by_distance, lit = (
        falloff(quantities[part], quantities.new_tensor(light[part])).numpy()[..., None] for part in (slice(1), slice(1, 4))
    )
    lit = lit * np.exp(exposure, dtype=np.float32)
    clipped = lambda colors: np.clip(colors, 0, 2).astype(np.float32)  # in full light; a guess must not glare
    away = cv2.distanceTransform((~wide.tissue).astype(np.uint8), cv2.DIST_C, cv2.DIST_MASK_3)
    # The picture goes on as bright as it is at its edges, however near or far the guess is: wrong, it would glare in other views.
    continued = inverse_distance_weighted(clipped(image / lit), wide.tissue, wide.width, interpolation)
    return ContinuedView(wide.camera, depth, clipped(continued / by_distance), away)


class _Wide(NamedTuple):
    """A view's picture with a margin around it."""

    camera: Camera
    surface: np.ndarray  # [H, W] m, 0 where depth is not known
    tissue: np.ndarray  # [H, W] bool
    width: int  # of the picture without its margin, pixels

    @classmethod
    def around(cls, view: TrainingView, pad: int) -> "_Wide":
        """A view with a margin of so many pixels."""
        K = view.camera.K.copy()
        K[:2, 2] += pad
        camera = Camera(K, view.camera.width + 2 * pad, view.camera.height + 2 * pad, view.camera.pose)
        return cls(camera, np.pad(view.surface, pad), np.pad(view.tissue > 0, pad), view.camera.width)

    def depth(self, points: Tensor, near: np.ndarray | None, interpolation: InterpolationConfig, threads: int = 1) -> np.ndarray:
        """Depth [H, W] (m) everywhere; arguments are those of `continue_view`."""
        camera, known = self.camera, self.surface > 0
        v, u = np.nonzero(known)
        inverse, told = 1 / self.surface[known].astype(np.float64), np.ones(known.shape)
        if near is not None:
            pad = (camera.width - self.width) // 2
            told = np.exp(inverse_distance_weighted(np.pad(near, pad)[..., None], self.tissue, self.width, interpolation)[..., 0])
        to, back = (np.asarray, np.asarray) if near is None else (np.log, np.exp)  # what is continued: inverse depth, or this
        values = to(inverse / told[known])
        a, b, c = fit_plane(u, v, values)
        plane = a * np.arange(camera.width) + b * np.arange(camera.height)[:, None] + c  # what departs from it fades
        residual = np.zeros(known.shape, np.float32)
        residual[known] = values - plane[known]
        with one_at_a_time(points.device):
            telling = _points_about(camera, points, ~known)
        uv, z = points_in_view(camera, telling, where=~known, threads=threads)
        columns, rows = np.floor(uv).astype(int).T
        of_points = to(1 / z / told[rows, columns]) - plane[rows, columns]
        if len(of_points) > 8:  # the median of a point and those around: one wrong point would stand like a pillar before the tissue
            of_points = np.median(of_points[cKDTree(uv).query(uv, k=9)[1]], 1)
        residual = krige(residual, known, uv, of_points, self.width, interpolation, str(points.device), threads)
        usual = [inverse, 1 / z]
        if near is not None:  # what is brighter or darker than all that is known may be nearer or farther
            usual.append(told[self.tissue] * back(np.median(values)))
        return 1 / clip_to_range(told * back(plane + residual), np.concatenate(usual), interpolation)


def _on_lattice(view: TrainingView, continued: ContinuedView, spacing: float) -> _Guess:
    """Where the view knows no depth, what may be there, every so many widths of the picture."""
    camera, width = continued.camera, view.camera.width
    stride = max(round(spacing * width), 1)
    lattice = (slice(stride // 2, None, stride),) * 2
    unknown = np.pad(view.surface, (camera.width - width) // 2)[lattice] <= 0
    depth, colors, away = (values[lattice][unknown] for values in continued[1:])
    centres = np.argwhere(unknown)[:, ::-1] * stride + stride // 2 + 0.5
    return _Guess(camera.unproject(centres, depth), colors, stride * depth / camera.K[0, 0], away / width)


def _beside(tree: cKDTree, positions: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Which positions [N, 3] are not where points of a tree are already [N], given the spacing [N] of Gaussians there."""
    apart = 0.7 * spacing
    return tree.query(positions, distance_upper_bound=apart.max(initial=0.0) + 1e-9)[0] > apart  # infinite where there is none so close


def _spread_evenly(positions: np.ndarray, spacing: np.ndarray, room: int) -> tuple[np.ndarray, float]:
    """Indices of so many of the positions [N, 3], as evenly spread as these, and how many times their spacing [N] they are apart.

    Every third of a lattice, say, would be columns with gaps between them.
    """
    some = np.linspace(0, len(positions) - 1, min(len(positions), _FROM * room)).astype(int)
    least = 0.7 * (len(positions) / room) ** 0.5
    positions, spacing = positions[some], spacing[some]
    tree = cKDTree(positions)
    most, found = 4 * least, np.zeros(len(some), bool)
    times = 2 * least  # of a surface that is about right
    for _ in range(_HALVINGS):
        kept = np.ones(len(some), bool)
        for start in range(0, len(some), _TOGETHER):  # those that have gone by then are not looked about
            those = start + np.flatnonzero(kept[start : start + _TOGETHER])
            for index, near in zip(those, tree.query_ball_point(positions[those], 0.7 * times * spacing[those], workers=-1)):
                if kept[index]:  # those that come later and are as near as in `_beside` go
                    later = np.array(near)
                    kept[later[later > index]] = False
        count = kept.sum()
        if count > room:
            least = times
        else:
            most, found = times, kept
            if count >= _FULL * room:
                break
        times *= (count / (_FULL**0.5 * room)) ** 0.5  # as the number on a surface goes with its square
        if not least < times < most:
            times = (least * most) ** 0.5
    left = np.flatnonzero(~found)  # a lattice has nothing between all of it and a half
    found[left[np.linspace(0, len(left) - 1, min(room - found.sum(), len(left))).astype(int)]] = True
    return some[found], most


def _points_about(camera: Camera, points: Tensor, unknown: np.ndarray) -> np.ndarray:
    """Of the points [N, 3] those close to where depth is unknown [H, W], one for every few pixels: they tell how it goes on."""
    close = cv2.dilate(unknown.astype(np.uint8), np.ones((2 * _AROUND + 1,) * 2, np.uint8))
    u, v, z = project(points.new_tensor(camera.viewmat), points.new_tensor(camera.K), points)
    within = inside(u, v, z, camera.width, camera.height)
    index = torch.where(within, v.long() * camera.width + u.long(), 0)
    told = torch.nonzero(within & (torch.from_numpy(close).to(points.device).flatten()[index] > 0))[:, 0]
    columns = -(-camera.width // _THINNED)
    cell = (v[told] / _THINNED).long() * columns + (u[told] / _THINNED).long()
    order = torch.argsort(z[told])
    order = order[torch.argsort(cell[order], stable=True)]  # by cells, and by depth in each
    cells, sizes = torch.unique_consecutive(cell[order], return_counts=True)
    middle = (sizes - cells % 2) // 2  # of an even number in every other cell the nearer of two
    return points[told[order[torch.cumsum(sizes, 0) - sizes + middle]]].cpu().numpy()
