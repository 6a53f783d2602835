"""Tissue goes on where no training view has seen it: large Gaussians in the holes of the depth prior and beyond the pictures.

They keep other views from looking into the void. Physics, which knows the training cameras, takes no control nodes from them.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import map_in_threads
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import features_at
from endo_sim_ros.reconstruction.priors.interpolation import inverse_distance_weighted, kept_in_range, kriged, plane_through
from endo_sim_ros.reconstruction.triangulation import points_in_view

# In widths of the image:
_FINE, _COARSE = 1 / 80, 1 / 54  # spacing in holes and close around the picture, and farther out
_RING, _CLOSE = 0.05, 3  # how much farther out at a time, and how often finely: large Gaussians would reach in and cover what was seen
_SIZE = 0.6  # standard deviation in spacings: the nearer ones of larger Gaussians hide the others where tissue is steep
_OPACITY = 0.8
_POINTS = 9  # neighbours among which a scene point's depth has to be the usual one
_LEAST_SEEN = 0.02  # share of the pixels with depth, from which on its surroundings can be told
_BRIGHTEST = 2.0


class _Guess(NamedTuple):
    """Tissue on a lattice of pixels that show none of known depth, in and around a picture."""

    positions: np.ndarray  # [N, 3] m, world
    colors: np.ndarray  # [N, 3] without light
    spacing: np.ndarray  # [N] m, between neighbours
    away: np.ndarray  # [N] from the tissue in the picture, 0 in it; widths of the picture


def with_surroundings(
    model: GaussianModel,
    frames: list[Frame],
    light: np.ndarray,
    exposures: np.ndarray,
    reference: float,
    points: np.ndarray,
    reach: float,
    limit: int,
) -> GaussianModel:
    """The model and what may be around it: inverse depth is the likeliest one, colour the mean of what is seen, by its distance.

    Args:
        model: What was seen.
        frames: Training views with their depth prior; views without one add nothing.
        light, exposures, reference: The light [4], the logarithm of each view's exposure [V, 3] and the distance (m) at which
            colours are the tissue's own.
        points: Scene points [N, 3] (m, world) that other views may have given; they tell how the surface goes on.
        reach: How far to go beyond the pictures, in their widths.
        limit: Largest number of Gaussians in all.
    """
    parts = [model.means.numpy().astype(np.float64)]
    points = np.concatenate([parts[0], points])
    colors, spacings = [], []
    told = [(f, e) for f, e in zip(frames, exposures) if f.depth is not None and (f.depth > 0).mean() >= _LEAST_SEEN and f.tissue.any()]
    around = map_in_threads(lambda view: _around(view[0], points, light, view[1], reference, reach), told)
    rings = range(math.ceil(reach / _RING))
    # Holes, then outwards around all views at a time, since what is close to one picture and far from another is told by the former.
    for ring in (-1, *rings):
        least, most = ring * _RING, np.inf if ring == rings[-1] else (ring + 1) * _RING
        for view in around:
            guess = view[_FINE if ring < _CLOSE else _COARSE]
            chosen = (guess.away > least) & (guess.away <= most)
            positions, spacing = guess.positions[chosen], guess.spacing[chosen]
            new = _unknown(positions, frames, ring in rings)
            if new.any():
                new[new] = cKDTree(np.concatenate(parts)).query(positions[new])[0] > 0.7 * spacing[new]
            parts.append(positions[new])
            colors.append(guess.colors[chosen][new])
            spacings.append(spacing[new])
    count, room = sum(map(len, spacings)), limit - len(model)
    if not count or room <= 0:
        return model
    arrays = np.concatenate(parts[1:]), np.concatenate(colors), _SIZE * np.concatenate(spacings)
    if count > room:  # fewer and larger ones
        kept = np.linspace(0, count - 1, room).astype(int)
        arrays = arrays[0][kept], arrays[1][kept], arrays[2][kept] * (count / room) ** 0.5
    added = GaussianModel.from_points(*(torch.from_numpy(a.astype(np.float32)) for a in arrays), _OPACITY, model.sh_degree)
    return GaussianModel(**{name: torch.cat([value, added.tensors()[name]]) for name, value in model.tensors().items()})


def _around(
    frame: Frame, points: np.ndarray, light: np.ndarray, exposure: np.ndarray, reference: float, reach: float
) -> dict[float, _Guess]:
    """Where the view knows no depth, what may be there; by how fine the lattice is."""
    width = frame.camera.width
    pad = int(reach * width)
    camera, depth, colors, away = _continued(frame, points, light, exposure, reference, pad)
    positions, unknown, found = camera.backproject(depth), np.pad(frame.depth, pad) <= 0, {}
    for share in (_FINE, _COARSE):
        stride = max(round(share * width), 1)
        lattice = np.zeros(away.shape, bool)
        lattice[stride // 2 :: stride, stride // 2 :: stride] = True
        lattice &= unknown
        found[share] = _Guess(positions[lattice], colors[lattice], stride * depth[lattice] / camera.K[0, 0], away[lattice] / width)
    return found


def _continued(
    frame: Frame, points: np.ndarray, light: np.ndarray, exposure: np.ndarray, reference: float, pad: int
) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """The view with a margin: its camera, depth [H', W'] (m) everywhere, colours without light [H', W', 3], and how far away the
    tissue in the picture is [H', W'] (pixels, 0 in it)."""
    K = frame.camera.K.copy()
    K[:2, 2] += pad
    camera = Camera(K, frame.camera.width + 2 * pad, frame.camera.height + 2 * pad, frame.camera.pose)
    depth, image = np.pad(frame.depth, pad), np.pad(frame.image, ((pad, pad), (pad, pad), (0, 0))) / np.float32(255)
    known = depth > 0
    v, u = np.nonzero(known)
    inverse = 1 / depth[known].astype(np.float64)
    a, b, c = plane_through(u, v, inverse)
    flat = a * np.arange(camera.width) + b * np.arange(camera.height)[:, None] + c  # what departs from it fades
    rest = np.zeros(depth.shape, np.float32)
    rest[known] = inverse - flat[known]
    uv, z = points_in_view(camera, points)
    columns, rows = np.floor(uv).astype(int).T
    beyond = ~known[rows, columns]
    columns, rows, there = columns[beyond], rows[beyond], 1 / z[beyond]
    over = there - flat[rows, columns]
    if len(over) >= _POINTS:  # one wrong point would stand like a pillar before the tissue
        over = np.median(over[cKDTree(uv[beyond]).query(uv[beyond], k=_POINTS)[1]], 1)
    rest = kriged(rest, known, uv[beyond], over, frame.camera.width)
    depth = 1 / kept_in_range(flat + rest, np.concatenate([inverse, there]))
    shading = features_at(camera.backproject(depth).reshape(-1, 3), camera, reference) * light
    near, lit = np.exp(shading[:, 0]).reshape(depth.shape), np.exp(shading[:, 1:].sum(1)[:, None] + exposure).reshape(image.shape)
    clipped = lambda colors: np.clip(colors, 0, _BRIGHTEST).astype(np.float32)
    tissue = np.pad(frame.tissue > 0, pad)
    away = cv2.distanceTransform(np.uint8(~tissue), cv2.DIST_C, cv2.DIST_MASK_3)
    # The picture goes on as bright as it is at its edges, however near or far the guess is: wrong, it would glare in other views.
    colors = clipped(inverse_distance_weighted(clipped(image / lit), tissue, frame.camera.width) / near[..., None])
    return camera, depth, colors, away


def _unknown(points: np.ndarray, frames: list[Frame], beyond: bool) -> np.ndarray:
    """Which points [N] lie where no view knows the depth, or beyond what any view sees."""
    unknown = np.ones(len(points), bool)
    for frame in frames:
        if frame.depth is None:
            continue
        uv, z = frame.camera.project(points)
        inside = np.nonzero((z > 0) & (uv >= 0).all(1) & (uv < [frame.camera.width, frame.camera.height]).all(1))[0]
        u, v = np.floor(uv[inside]).astype(int).T
        known = frame.depth[v, u] > 0
        if beyond:
            known |= True if frame.mask is None else frame.mask[v, u] > 0
        unknown[inside[known]] = False
    return unknown
