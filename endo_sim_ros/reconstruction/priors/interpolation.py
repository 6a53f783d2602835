"""Values of some pixels and points of a picture continued to all its pixels."""

from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (it is public)

from endo_sim_ros.core.device import one_at_a_time
from endo_sim_ros.reconstruction.stage_configs import InterpolationConfig

_SYSTEMS = {"cpu": 512, "cuda": 8192}  # of equations that are solved at a time: 7 and 110 megabytes


def krige(
    values: np.ndarray,
    known: np.ndarray,
    uv: np.ndarray,
    point_values: np.ndarray,
    width: int,
    options: InterpolationConfig = InterpolationConfig(),
    device: str = "cpu",
    threads: int = 1,
) -> np.ndarray:
    """Values [H, W] where known [H, W]; elsewhere the likeliest, by kriging with a linear variogram.

    Squared differences between true values grow in proportion to the distance; those given err.

    Args:
        values, known: Values of pixels, and which of them count.
        uv, point_values: Pixels [N, 2] of points and their values [N]. There must be one known pixel or point.
        width: Of the picture, pixels; the options' lengths are in units of it.
        options: Size of the cells, errors, and number of neighbours that tell a value.
        device: Where the systems of equations are solved.
        threads: How many look for neighbours.
    """
    side = max(round(options.cell * width), 1)
    count, means = _in_cells(values[..., None], known, side)
    occupied, means = count > 0, means[..., 0]
    rows, columns = count.shape
    centres = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1) + 0.5
    sources = np.concatenate([centres[occupied], uv / side])
    errors: Any = np.repeat([options.pixel_error, options.point_error], [occupied.sum(), len(uv)]) * width / side
    source_values = np.concatenate([means[occupied], point_values])
    means[~occupied] = _kriged(sources, source_values, errors, centres[~occupied], options.neighbours, device, threads)
    return np.where(known, values, _in_pixels(means, side, known.shape))


def _kriged(
    sources: np.ndarray, values: np.ndarray, errors: np.ndarray, targets: np.ndarray, count: int, device: str, threads: int
) -> np.ndarray:
    """Values at targets [M, 2] from the nearest of sources [N, 2], whose values [N] and errors [N] are given."""
    nearest = cKDTree(sources).query(targets, k=range(1, min(count, len(sources)) + 1), workers=threads)[1]
    with one_at_a_time(device):
        return _solved(sources, values, errors, targets, np.sort(nearest, 1), device)


def _solved(
    sources: np.ndarray, values: np.ndarray, errors: np.ndarray, targets: np.ndarray, nearest: np.ndarray, device: str
) -> np.ndarray:
    """As `_kriged`, with the increasing indices [M, count] of the sources that tell each target."""
    sets = torch.from_numpy(nearest).to(device)
    chosen, group = torch.unique(sets, dim=0, return_inverse=True)  # targets side by side mostly have the same
    at, given, variances, wanted = (torch.from_numpy(array).to(device, torch.float64) for array in (sources, values, errors, targets))
    count, solved = chosen.shape[1], []
    for chunk in chosen.split(_SYSTEMS[torch.device(device).type]):
        system, right = at.new_ones(len(chunk), count + 1, count + 1), at.new_zeros(len(chunk), count + 1)
        between = torch.linalg.vector_norm(at[chunk][:, :, None] - at[chunk][:, None], dim=-1)
        system[:, :count, :count] = torch.diag_embed(variances[chunk]) - between
        system[:, count, count] = 0
        right[:, :count] = given[chunk]
        solved.append(torch.linalg.solve(system, right))
    weights, away = torch.cat(solved)[group], torch.linalg.vector_norm(wanted[:, None] - at[chosen[group]], dim=-1)
    return (weights[:, count] - (weights[:, :count] * away).sum(1)).cpu().numpy()


def fit_plane(u: np.ndarray, v: np.ndarray, values: np.ndarray) -> tuple[float, float, float]:
    """a, b, c of a u + b v + c, the nearest to values [N] at pixels u, v [N]: as inverse depth, a plane in space."""
    # Sums instead of a library's least squares, whose last bits may hang on what its other threads do.
    step = max(len(u) // 20_000, 1)
    terms = np.stack([u, v, np.ones(len(u))])[:, ::step]
    level = np.diag([1.0, 1.0, 0.0])  # next to nothing, but makes slopes that nothing tells none
    a, b, c = np.linalg.solve((terms[:, None] * terms).sum(2) + level, (terms * values[::step]).sum(1))
    return a, b, c


def clip_to_range(values: np.ndarray, sources: np.ndarray, options: InterpolationConfig) -> np.ndarray:
    """The values, none far from the range of most of the positive values that they come from.

    Kriging overshoots where slopes meet a gap.
    """
    low, high = np.percentile(sources, [1, 99])
    return np.clip(values, (1 - options.margin) * low, (1 + options.margin) * high)


def inverse_distance_weighted(
    values: np.ndarray, known: np.ndarray, width: int, options: InterpolationConfig = InterpolationConfig()
) -> np.ndarray:
    """Values [H, W, C] where known [H, W]; elsewhere the mean of those known, each weighing by its distance to the power −4.

    Shepard 1968. For colour, which unlike depth does not go on the way it goes. The width is that of the picture, pixels.
    """
    side = max(round(options.cell * width), 1)
    count, means = _in_cells(values, known, side)
    period = tuple(2 * size for size in count.shape)  # so wide that nothing is reached the other way round
    rows, columns = (np.fft.fftfreq(size, 1 / size) for size in period)  # 0, 1, ... and from the other end -1, -2, ...
    within = 0.5  # of a cell: how far away pixels of the same cell count
    weights = np.fft.rfft2(1 / (rows[:, None] ** 2 + columns**2 + within**2) ** 2)
    about = lambda sums: np.fft.irfft2(np.fft.rfft2(sums, period) * weights, period)[: count.shape[0], : count.shape[1]]
    total = about(count)
    means = np.stack([about(count * means[..., c]) / total for c in range(values.shape[2])], -1)
    return np.where(known[..., None], values, _in_pixels(means, side, known.shape))


def _in_cells(values: np.ndarray, known: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Of square cells, the number of known pixels [R, Q] and the mean of their values [H, W, C], [R, Q, C]; 0 for none."""
    rows, columns = (-(-size // side) for size in known.shape)
    fit = ((0, rows * side - known.shape[0]), (0, columns * side - known.shape[1]), (0, 0))
    # One axis after the other takes a third of the time of both.
    sums = lambda array: np.pad(array, fit).reshape(rows, side, columns, side, -1).sum(1, dtype=np.float64).sum(2)
    count = sums(known[..., None])
    return count[..., 0], sums(np.where(known[..., None], values, 0)) / np.maximum(count, 1)


def _in_pixels(cells: np.ndarray, side: int, shape: tuple[int, int]) -> np.ndarray:
    """Values of cells [R, Q, ...] in between their centres, of pixels [H, W, ...]."""
    size = cells.shape[1] * side, cells.shape[0] * side
    enlarged = cv2.resize(cells.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return enlarged[: shape[0], : shape[1]].reshape(*shape, *cells.shape[2:])  # OpenCV drops an axis of one channel
