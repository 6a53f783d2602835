"""Tissue goes on where no training view has seen it: large Gaussians in the holes of the depth prior and beyond the pictures.

They keep other views from looking into the void. Physics, which knows the training cameras, takes no control nodes from them.
"""

import cv2
import numpy as np
import torch
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from endo_sim_ros.cameras import Camera
from endo_sim_ros.device import map_in_threads
from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.light import features_at
from endo_sim_ros.reconstruction.triangulation import points_in_view
from endo_sim_ros.sequences.frames import Frame

# In widths of the image:
_FINE, _COARSE = 1 / 80, 1 / 27  # spacing in holes and close around the picture, and farther out
_CLOSE = 0.15  # how far around it; large Gaussians there would reach into the picture and cover what was seen
_SIZE = 0.6  # standard deviation in spacings: the nearer ones of larger Gaussians hide the others where tissue is steep
_OPACITY = 0.8
_CELL = 1 / 80  # side of what depth is told for, and of what tells it
_PIXELS_ERROR, _POINTS_ERROR = 1 / 128, 1 / 8  # how far away depth differs as much as that of pixels, of points errs
_TELLING = 40  # neighbours that tell a cell's depth
_POINTS = 9  # neighbours among which a scene point's depth has to be the usual one
_LEAST_SEEN = 0.02  # share of the pixels with depth, from which on its surroundings can be told
_BRIGHTEST = 2.0


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
    """The model and what may be around it: inverse depth is the likeliest one, colour that of the nearest pixels.

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
    told = [(f, e) for f, e in zip(frames, exposures) if f.depth is not None and (f.depth > 0).mean() >= _LEAST_SEEN]
    continued = map_in_threads(lambda view: _continued(view[0], points, light, view[1], reference, int(reach * view[0].camera.width)), told)
    for (frame, _), (camera, depth, picture) in zip(told, continued):
        width, height, pad = frame.camera.width, frame.camera.height, (camera.width - frame.camera.width) // 2
        known = np.pad(frame.depth > 0, pad)
        inside = np.zeros(known.shape, bool)
        inside[pad : pad + height, pad : pad + width] = True if frame.mask is None else frame.mask > 0
        close = ~inside & (cv2.dilate(np.uint8(inside), np.ones((2 * int(_CLOSE * width) + 1,) * 2, np.uint8)) > 0)
        for where, share in ((inside, _FINE), (close, _FINE), (~inside & ~close, _COARSE)):
            stride = max(round(share * width), 1)
            chosen = np.zeros(known.shape, bool)
            chosen[stride // 2 :: stride, stride // 2 :: stride] = True
            chosen &= where & ~known
            points, spacing = camera.backproject(depth)[chosen], stride * depth[chosen] / camera.K[0, 0]
            new = _unknown(points, frames, where is not inside)
            if new.any():
                new[new] = cKDTree(np.concatenate(parts)).query(points[new])[0] > 0.7 * spacing[new]
            parts.append(points[new])
            colors.append(picture[chosen][new])
            spacings.append(spacing[new])
    count, room = sum(map(len, spacings)), limit - len(model)
    if not count or room <= 0:
        return model
    arrays = np.concatenate(parts[1:]), np.concatenate(colors), _SIZE * np.concatenate(spacings)
    if count > room:  # fewer and larger ones
        kept = np.linspace(0, count - 1, room).astype(int)
        arrays = arrays[0][kept], arrays[1][kept], arrays[2][kept] * (count / room) ** 0.5
    around = GaussianModel.from_points(*(torch.from_numpy(a.astype(np.float32)) for a in arrays), _OPACITY, model.sh_degree)
    return GaussianModel(**{name: torch.cat([value, around.tensors()[name]]) for name, value in model.tensors().items()})


def _continued(
    frame: Frame, points: np.ndarray, light: np.ndarray, exposure: np.ndarray, reference: float, pad: int
) -> tuple[Camera, np.ndarray, np.ndarray]:
    """The view with a margin: its camera, depth [H', W'] (m) everywhere, and colours without light [H', W', 3]."""
    K = frame.camera.K.copy()
    K[:2, 2] += pad
    camera = Camera(K, frame.camera.width + 2 * pad, frame.camera.height + 2 * pad, frame.camera.pose)
    depth, image = np.pad(frame.depth, pad), np.pad(frame.image, ((pad, pad), (pad, pad), (0, 0))) / np.float32(255)
    known = depth > 0
    v, u = np.nonzero(known)
    inverse = 1 / depth[known].astype(np.float64)
    # A plane has inverse depth that is linear in the picture; what departs from it fades.
    plane = np.column_stack([u, v, np.ones(len(u))])
    step = max(len(u) // 20_000, 1)
    slope = np.linalg.lstsq(plane[::step], inverse[::step], rcond=None)[0]
    flat = slope[0] * np.arange(camera.width) + slope[1] * np.arange(camera.height)[:, None] + slope[2]
    rest = np.zeros(depth.shape, np.float32)
    rest[known] = inverse - flat[known]
    uv, z = points_in_view(camera, points)
    columns, rows = np.floor(uv).astype(int).T
    beyond = ~known[rows, columns]
    columns, rows, there = columns[beyond], rows[beyond], 1 / z[beyond]
    over = there - flat[rows, columns]
    if len(over) >= _POINTS:  # one wrong point would stand like a pillar before the tissue
        over = np.median(over[cKDTree(uv[beyond]).query(uv[beyond], k=_POINTS)[1]], 1)
    low, high = np.percentile(np.concatenate([inverse, there]), [1, 99])
    rest = _continued_from(rest, known, uv[beyond], over, frame.camera.width)
    depth = 1 / np.clip(flat + rest, 0.8 * low, 1.2 * high)
    lit = np.exp((features_at(camera.backproject(depth).reshape(-1, 3), camera, reference) @ light)[:, None] + exposure)
    colors = np.clip(image.reshape(-1, 3) / lit, 0, _BRIGHTEST).reshape(image.shape).astype(np.float32)
    tissue = np.zeros(known.shape, bool)
    rows, columns = frame.depth.shape
    tissue[pad : pad + rows, pad : pad + columns] = True if frame.mask is None else frame.mask > 0
    return camera, depth, filled(colors, tissue)


def _continued_from(values: np.ndarray, known: np.ndarray, uv: np.ndarray, there: np.ndarray, width: int) -> np.ndarray:
    """Values [H, W] where known [H, W]; elsewhere the likeliest where known pixels and values at points uv [N, 2] err, and
    squared differences grow with distance (kriging, a linear variogram)."""
    side = max(round(_CELL * width), 1)
    rows, columns = (-(-size // side) for size in known.shape)
    fit = ((0, rows * side - known.shape[0]), (0, columns * side - known.shape[1]))
    cells = lambda array: np.pad(array, fit).reshape(rows, side, columns, side).sum((1, 3), dtype=np.float64)
    count = cells(known)
    means = cells(np.where(known, values, 0)) / np.maximum(count, 1)
    centres = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1) + 0.5
    sources = np.concatenate([centres[count > 0], uv / side])
    errors = np.repeat([_PIXELS_ERROR, _POINTS_ERROR], [(count > 0).sum(), len(uv)]) * width / side
    told = RBFInterpolator(
        sources, np.concatenate([means[count > 0], there]), neighbors=_TELLING, smoothing=errors, kernel="linear", degree=0
    )
    means[count == 0] = told(centres[count == 0])
    v, u = ((np.arange(size) + 0.5) / side - 0.5 for size in known.shape)
    u, v = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
    fine = cv2.remap(means.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(known, values, fine)


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


def filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values [H, W, C] where known [H, W]; elsewhere the mean over ever wider surroundings (pull-push)."""
    weight = known.astype(np.float32)
    levels = [(weight, values.astype(np.float32) * weight[..., None])]
    while min(levels[-1][0].shape) > 1:
        weight, total = (_halved(array) for array in levels[-1])
        scale = np.maximum(weight, 1)
        levels.append((weight / scale, total / scale[..., None]))
    weight, total = levels[-1]
    mean = sum(t.reshape(-1, t.shape[-1]).sum(0) for _, t in levels[-1:]) / max(float(weight.sum()), 1e-6)
    filled = total + (1 - weight)[..., None] * mean
    for weight, total in levels[-2::-1]:
        coarse = cv2.resize(filled, weight.shape[::-1], interpolation=cv2.INTER_LINEAR).reshape(total.shape)
        filled = total + (1 - weight)[..., None] * coarse
    return filled


def _halved(array: np.ndarray) -> np.ndarray:
    """Sums of 2 × 2 pixels; an odd row or column is alone."""
    rows, columns = array.shape[:2]
    padded = np.pad(array, ((0, rows % 2), (0, columns % 2), *[(0, 0)] * (array.ndim - 2)))
    return padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]
