"""Values of some pixels and points of a picture carried to all its pixels."""

import cv2
import numpy as np
from scipy.interpolate import RBFInterpolator

_CELL = 1 / 80  # of the picture's width, side of what values are told for, and of what tells them
# Widths of the picture, how far apart two places are whose values differ by as much as those of a pixel, of a point err.
_PIXELS_ERR_AS, _POINTS_ERR_AS = 1 / 128, 1 / 8
_ROOM = 0.2  # by how much of it kriged values may leave the range of most of those that tell
_TELLING = 40  # neighbours that tell a cell's value
_WITHIN = 0.25  # cells², how far away pixels of the same cell count


def kriged(values: np.ndarray, known: np.ndarray, uv: np.ndarray, there: np.ndarray, width: int) -> np.ndarray:
    """Values [H, W] where known [H, W]; elsewhere the likeliest where known pixels and values at points uv [N, 2] err, and
    squared differences grow with distance (kriging, a linear variogram). Pixels or points there must be."""
    side = max(round(_CELL * width), 1)
    count, means = _in_cells(values[..., None], known, side)
    given, means = count > 0, means[..., 0]
    rows, columns = count.shape
    centres = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1) + 0.5
    sources = np.concatenate([centres[given], uv / side])
    errors = np.repeat([_PIXELS_ERR_AS, _POINTS_ERR_AS], [given.sum(), len(uv)]) * width / side
    values_there = np.concatenate([means[given], there])
    told = RBFInterpolator(sources, values_there, neighbors=_TELLING, smoothing=errors, kernel="linear", degree=0)
    means[~given] = told(centres[~given])
    return np.where(known, values, _in_pixels(means, side, known.shape))


def plane_through(u: np.ndarray, v: np.ndarray, values: np.ndarray) -> tuple[float, float, float]:
    """a, b, c of a u + b v + c, the nearest to values [N] at pixels u, v [N]: as inverse depth, a plane in space."""
    # Sums instead of a library's least squares, whose last bits may hang on what its other threads do.
    step = max(len(u) // 20_000, 1)
    terms = np.stack([u, v, np.ones(len(u))])[:, ::step]
    level = np.diag([1.0, 1.0, 0.0])  # next to nothing, but makes slopes that nothing tells none
    a, b, c = np.linalg.solve((terms[:, None] * terms).sum(2) + level, (terms * values[::step]).sum(1))
    return a, b, c


def kept_in_range(values: np.ndarray, telling: np.ndarray) -> np.ndarray:
    """The values, none far from the range of most of those (positive) that told them: kriging overshoots where slopes meet a gap."""
    low, high = np.percentile(telling, [1, 99])
    return np.clip(values, (1 - _ROOM) * low, (1 + _ROOM) * high)


def inverse_distance_weighted(values: np.ndarray, known: np.ndarray, width: int) -> np.ndarray:
    """Values [H, W, C] where known [H, W]; elsewhere the mean of those known, each weighing by its distance to the power −4
    (Shepard 1968): colour, unlike depth, does not go on the way it goes."""
    side = max(round(_CELL * width), 1)
    count, means = _in_cells(values, known, side)
    period = tuple(2 * size for size in count.shape)  # so wide that nothing is reached the other way round
    rows, columns = (np.fft.fftfreq(size, 1 / size) for size in period)  # 0, 1, ... and from the other end -1, -2, ...
    weights = np.fft.rfft2(1 / (rows[:, None] ** 2 + columns**2 + _WITHIN) ** 2)
    about = lambda sums: np.fft.irfft2(np.fft.rfft2(sums, period) * weights, period)[: count.shape[0], : count.shape[1]]
    total = about(count)
    means = np.stack([about(count * means[..., c]) / total for c in range(values.shape[2])], -1)
    return np.where(known[..., None], values, _in_pixels(means, side, known.shape))


def _in_cells(values: np.ndarray, known: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Of square cells, the number of known pixels [R, Q] and the mean of their values [H, W, C], [R, Q, C]; 0 for none."""
    rows, columns = (-(-size // side) for size in known.shape)
    fit = ((0, rows * side - known.shape[0]), (0, columns * side - known.shape[1]), (0, 0))
    sums = lambda array: np.pad(array, fit).reshape(rows, side, columns, side, -1).sum((1, 3), dtype=np.float64)
    count = sums(known[..., None])
    return count[..., 0], sums(np.where(known[..., None], values, 0)) / np.maximum(count, 1)


def _in_pixels(cells: np.ndarray, side: int, shape: tuple[int, int]) -> np.ndarray:
    """Values of cells [R, Q, ...] in between their centres, of pixels [H, W, ...]."""
    size = cells.shape[1] * side, cells.shape[0] * side
    return cv2.resize(cells.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]]
