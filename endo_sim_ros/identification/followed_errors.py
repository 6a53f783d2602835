"""How points that are followed in images err, as the residuals of a fit tell: more than noise, and lastingly.

Where tissue moves, its picture changes, too, by light, by what hides what, and by how it is stretched, and takes followed points along.
Such an error lasts as long as the tissue stays there: it is taken to be a share of how far points move in each image. Residuals tell the
part that is each point's own. Of what points share they tell nothing, where it looks like what tissue does: features slide along slopes as
other tissue would. What is known to be there (`Tracks.lasting`) may lie along any one change of the tissue: its variance is as many times
greater as there are numbers that move, so that all of them tell no more of that change than one.
"""

from collections.abc import Sequence

import numpy as np

from endo_sim_ros.identification.observations import PIXEL, Observations
from endo_sim_ros.identification.solving import Data, Point, around

_TIMES = (0.0, *np.geomspace(1 / 16, 4, 13))  # shares of the motion
_WHITE = tuple(np.geomspace(1, 16, 9))  # times the noise that was told
_GRIDS = (_WHITE, _TIMES)
_BEGIN = (0, 3)  # places on these grids


def learn_followed(point: Point, data: Sequence[Data]) -> bool:
    """Set `noise` and `followed` of what was measured as is likeliest by the evidence of a fit, the same shares for all experiments; return
    whether there are points that were followed. A fit counts with these from the next look on.

    Args:
        point: Where the fit ended.
        data: All experiments.
    """
    tracked = [bool((part.seen.kinds == PIXEL).any()) for part in data]
    own = [_own(part.seen, r) if there else None for part, r, there in zip(data, point.residuals, tracked)]
    told, costs = [part.seen.noise for part in data], dict[tuple[int, ...], float]()
    if not any(tracked):
        return False

    def choose(at: tuple[int, ...]) -> None:
        white, share = (grid[i] for grid, i in zip(_GRIDS, at))
        for part, noise, columns in zip(data, told, own):
            if columns is not None:
                moves = np.linalg.norm(columns, axis=1)  # one number a row
                lasting = max(each.lasting for each in part.seen.experiment.tracks) / max(float(moves.max()), 1e-9)
                shared = lasting * float(np.linalg.norm(moves)) / max(float(moves.max()), 1e-9)
                part.seen.noise = np.where(part.seen.kinds == PIXEL, np.hypot(white * noise, shared * moves), noise)
                part.seen.followed = share * columns

    def cost(at: tuple[int, ...]) -> float:
        if at not in costs:
            choose(at)
            sums = list[tuple[np.ndarray, np.ndarray, float]]()
            for part, r, J, R, (by_tip, errors), there in zip(
                data, point.residuals, point.jacobians, point.covariances, point.errors, tracked
            ):
                R = part.seen.covariance(by_tip, np.concatenate([errors, part.seen.followed], 1)) if there else R
                weighted = R.solve(np.column_stack([J, r]))
                sums.append((J.T @ weighted[:, :-1], J.T @ weighted[:, -1], float(r @ weighted[:, -1]) + R.log_determinant))
            costs[at] = around(sums, point)[0]
        return costs[at]

    at = _BEGIN
    while True:
        near = [(*at[:k], at[k] + way, *at[k + 1 :]) for k in range(len(_GRIDS)) for way in (-1, 1)]
        best = min([at, *(each for each in near if all(0 <= i < len(grid) for i, grid in zip(each, _GRIDS)))], key=cost)
        if best == at:
            choose(at)
            return True
        at = best


def _own(seen: Observations, residuals: np.ndarray) -> np.ndarray:
    """What errors of each point make of each number, if they are as great as points have moved in its image by the model since they were
    first seen, by the root of the mean of squares [N, 2 K], pixels.

    Args:
        seen: What was measured.
        residuals: Of the numbers that are used.
    """
    told = seen.values.copy()
    told[seen.used] -= residuals
    pixels = np.flatnonzero(seen.kinds == PIXEL)
    points, axes = seen.points[pixels], seen.axes[pixels]
    first = np.zeros((points.max() + 1, 2))
    first[points[::-1], axes[::-1]] = told[pixels[::-1]]
    squares = (told[pixels] - first[points, axes]) ** 2
    sums, numbers = (np.bincount(seen.steps[pixels], each, len(seen.experiment.tips)) for each in (squares, np.ones(len(pixels))))
    columns = np.zeros((len(told), first.size))
    columns[pixels, 2 * points + axes] = np.sqrt(sums / np.maximum(numbers, 1))[seen.steps[pixels]]
    return columns
