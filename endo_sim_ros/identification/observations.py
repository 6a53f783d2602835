"""What was measured in an experiment as one vector, with its noise."""

from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import binary_dilation

from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.forward import Replay, closing_steps

FORCE, DISPLACEMENT, PIXEL = range(3)
_ROUNDED = 3.0  # standard deviations that smoothing takes away, beyond which it rounds off how the tool moves
_NARROWER, _LEAST_WIDTH = 0.7, 0.5  # what is tried next; steps, below which nothing is smoothed
_SPANS = 2.0  # widths about a step to which it matters
_TINY = 1e-6  # m that rounding may take away
_LONGEST = 250  # steps whose errors of tips are taken for correlated; more would only cost time
_ROUNDING = 1e-13  # of a variance, without which that of noise beside a million times greater errors could be lost, and a factor not exist
_NEGLIGIBLE = 1e-3  # of the greatest singular value of a smoother: what it leaves of such errors is lost in the noise


class Observations:
    """The N numbers that were measured in an experiment.

    Args:
        experiment: What was measured; what is NaN was not.
        smoothing: As `IdentificationConfig.tip_smoothing`; less where that would round off how the tool moves.

    Attributes:
        experiment: The same with smooth tips, which are replayed.
        values: [N].
        noise: Standard deviation of each [N].
        kinds: FORCE, DISPLACEMENT or PIXEL [N].
        steps: At the end of which it was measured [N].
        axes: Which component of a vector each is [N].
        used: Which count [N]; all at first.
        uneven: Variance of each [N] that errors of single tips make beyond what derivatives tell; 0 at first.
        lasting: Share of that which lasts as smoothed errors of tips do; 0 at first.
        rounded: By how much smoothing of half the width takes less away from the tips [T, 3], m.
        points: Number of the followed point that each is of, -1 where of none [N].
        apart: What errors that are this experiment's alone make of each [N, K], one standard deviation of each of K errors; none at first.
        followed: The same of how points that are followed err; none at first.
    """

    def __init__(self, experiment: Experiment, smoothing: float):
        self.smoother, narrower = fitting_smoother(experiment, smoothing / experiment.step_duration)
        given = np.nan_to_num(experiment.tips)
        tips = self.smoother @ given
        self.experiment = replace(experiment, tips=tips)
        steps = np.arange(len(tips))
        parts = [(np.asarray(experiment.forces, float), FORCE, experiment.force_noise, steps)]
        if experiment.displacements is not None:
            parts.append((np.asarray(experiment.displacements, float), DISPLACEMENT, experiment.displacement_noise, steps))
        parts += [(np.asarray(tracks.pixels, float), PIXEL, tracks.noise, np.asarray(tracks.steps)) for tracks in experiment.tracks]
        self._given = [np.isfinite(values).ravel() for values, *_ in parts]
        self.values = np.concatenate([values.ravel()[given] for (values, *_), given in zip(parts, self._given)])

        def spread(of_parts: list) -> np.ndarray:
            """Numbers of each part, one for all of it or one a row, for each that was measured."""
            full = [
                np.broadcast_to(np.reshape(of, (-1, *[1] * (values.ndim - 1))), values.shape) for of, (values, *_) in zip(of_parts, parts)
            ]
            return np.concatenate([each.ravel()[given] for each, given in zip(full, self._given)])

        counts = np.cumsum([0, *(len(tracks.rest) for tracks in experiment.tracks)])
        points = [np.broadcast_to(-1, values.shape) for values, *_ in parts[: len(parts) - len(experiment.tracks)]]
        points += [
            np.broadcast_to((first + np.arange(len(tracks.rest)))[:, None], np.shape(tracks.pixels))
            for first, tracks in zip(counts, experiment.tracks)
        ]
        self.points = np.concatenate([each.ravel()[given] for each, given in zip(points, self._given)])
        axes = [np.broadcast_to(np.arange(values.shape[-1]), values.shape).ravel() for values, *_ in parts]
        self.axes = np.concatenate([each[given] for each, given in zip(axes, self._given)])
        kinds, noises, ends = ([part[number] for part in parts] for number in (1, 2, 3))
        self.kinds, self.noise, self.steps = spread(kinds).astype(int), spread(noises), spread(ends).astype(int)
        self.closed_at = closing_steps(experiment)[self.steps]  # step at which the jaw closed, -1 = open [N]
        self.used, self.uneven, self.lasting = np.ones(len(self.values), bool), np.zeros(len(self.values)), 0.0
        self.apart, self.followed = np.zeros((len(self.values), 0)), np.zeros((len(self.values), 0))
        self.rounded = narrower @ given - tips
        self._smoothed = [(begin, _factor(self.smoother[:, begin : begin + _LONGEST])) for begin in range(0, len(tips), _LONGEST)]

    def predicted(self, replay: Replay) -> np.ndarray:
        """The same numbers as each copy of a replay predicts them [C, N]."""
        count = len(replay.forces)
        parts = [replay.forces, *([] if replay.displacements is None else [replay.displacements]), *replay.pixels]
        return np.concatenate([part.reshape(count, -1)[:, given] for part, given in zip(parts, self._given)], 1)

    def changed(self, replay: Replay) -> np.ndarray:
        """By how much finer control nodes change what the first copy of a replay predicts [N]."""
        told = np.zeros(len(self.values))
        told[self.of_forces()] = replay.change.ravel()[self._given[0]]
        return told

    def of_forces(self) -> np.ndarray:
        """Which of the numbers are forces [N]."""
        return self.kinds == FORCE

    def trembling(self) -> np.ndarray:
        """What errors of single tips make beyond what derivatives tell, one standard deviation along each axis [N, 3]."""
        return np.sqrt(self.uneven)[:, None] * (self.axes[:, None] == np.arange(3))

    def covariance(
        self, tip_sensitivity: np.ndarray, shared: np.ndarray, trembling: np.ndarray | None = None, lasting: np.ndarray | None = None
    ) -> "Covariance":
        """Of the numbers that are used: their own noise, and what independent errors of the tips make of predictions.

        Args:
            tip_sensitivity: Derivative of each number by the place of the tip [N, 3], per m, while a jaw is closed by how far it has gone
                since. Tissue is taken to follow the tip at once.
            shared: What errors that the whole experiment shares make of them, one standard deviation of each [N, K].
            trembling: Another one than `trembling()` [N, 3].
            lasting: Shares of that which last [N]; default: `lasting`.
        """
        trembling = self.trembling() if trembling is None else trembling
        lasting = np.full(len(self.values), self.lasting) if lasting is None else lasting
        rows, blocks = np.flatnonzero(self.used), []
        for begin, smoothed in self._smoothed:
            at = rows[(self.steps[rows] >= begin) & (self.steps[rows] < begin + _LONGEST)]
            # A number depends on the smoothed tip of its step, and that on the errors of those around it.
            along = smoothed[self.steps[at]] - np.where(self.closed_at[at, None] >= 0, smoothed[self.closed_at[at]], 0)
            lasts = np.sqrt(lasting[at]) / np.maximum(np.linalg.norm(along, axis=1), 1e-12)
            by = [self.experiment.tip_noise * tip_sensitivity[at], lasts[:, None] * trembling[at]]
            A = (along[:, :, None] * np.concatenate(by, 1)[:, None]).reshape(len(at), 6 * along.shape[1])
            D = (self.noise**2 + (1 - lasting) * (trembling**2).sum(1))[at]
            blocks.append(_Block(np.searchsorted(rows, at), D, A[:, np.abs(A).max(0, initial=0) > 0]))
        return Covariance(blocks, shared[rows])


def _factor(smoother: np.ndarray) -> np.ndarray:
    """The numbers [T, k] of which smooth errors are made, S with S Sᵀ = smoother smootherᵀ: fewer than steps, the more it smooths."""
    U, s, _ = np.linalg.svd(smoother, full_matrices=False)
    return (U * s)[:, s > _NEGLIGIBLE * s.max(initial=0)]


class _Factored:
    """A symmetric matrix above 0, as Cholesky's factor."""

    def __init__(self, matrix: np.ndarray):
        matrix = matrix + _ROUNDING * np.diag(np.diag(matrix))
        self._factor = cho_factor(matrix, lower=True, check_finite=False)
        self.log_determinant = 2 * float(np.log(np.diag(self._factor[0])).sum())

    def solve(self, x: np.ndarray) -> np.ndarray:
        return cho_solve(self._factor, x, check_finite=False)


class _Block:
    """D + A Aᵀ of some rows; by Woodbury's identity where A has fewer columns than rows."""

    def __init__(self, rows: np.ndarray, D: np.ndarray, A: np.ndarray):
        self.rows, self._D, self._scaled = rows, D, None
        if A.shape[1] < len(rows):
            self._scaled = A / D[:, None]
            self._inner = _Factored(np.eye(A.shape[1]) + A.T @ self._scaled)
            self.log_determinant = float(np.log(D).sum()) + self._inner.log_determinant
        else:
            self._inner = _Factored(np.diag(D) + A @ A.T)
            self.log_determinant = self._inner.log_determinant

    def solve(self, x: np.ndarray) -> np.ndarray:
        if self._scaled is None:
            return self._inner.solve(x)
        return x / self._D[:, None] - self._scaled @ self._inner.solve(self._scaled.T @ x)


class Covariance:
    """A covariance R of n numbers that are used: blocks along the diagonal, and S Sᵀ of errors that all of them share, by Woodbury."""

    def __init__(self, blocks: list[_Block], shared: np.ndarray):
        self._blocks = blocks
        self._scaled = self._solve_blocks(shared)
        self._inner = _Factored(np.eye(shared.shape[1]) + shared.T @ self._scaled)
        self.log_determinant = sum(block.log_determinant for block in blocks) + self._inner.log_determinant

    def solve(self, x: np.ndarray) -> np.ndarray:
        """R⁻¹ x for x [n, k]."""
        return self._solve_blocks(x) - self._scaled @ self._inner.solve(self._scaled.T @ x)

    def _solve_blocks(self, x: np.ndarray) -> np.ndarray:
        out = np.zeros_like(x, dtype=float)
        for block in self._blocks:
            if len(block.rows):
                out[block.rows] = block.solve(x[block.rows])
        return out


def fitting_smoother(experiment: Experiment, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return weights [T, T] that smooth tips by at most so many steps (standard deviation), each by less as long as what they take away
    about it is more than errors of the tips explain, by means over as many steps: that is how the tool moves; and weights of half their
    width."""
    present, tips = np.asarray(experiment.present, bool), np.nan_to_num(experiment.tips)
    noise = min(experiment.tip_noise, _scatter(experiment.tips[present]))
    chosen, half, left = np.eye(len(tips)), np.eye(len(tips)), np.ones(len(tips), bool)
    while width > _LEAST_WIDTH and left.any():
        weights = smoothing_matrix(present, width)
        span = np.abs(np.subtract.outer(*[np.arange(len(tips))] * 2)) <= width
        means = (span / span.sum(1, keepdims=True)) @ (np.eye(len(tips)) - weights)
        fits = (np.abs(means @ tips) <= _ROUNDED * noise * np.linalg.norm(means, axis=1, keepdims=True) + _TINY).all(1)
        fits = ~np.asarray(binary_dilation(~fits, iterations=round(_SPANS * width)), bool)
        now, left = left & fits, left & ~fits
        chosen[now], half[now] = weights[now], smoothing_matrix(present, width / 2)[now]
        width *= _NARROWER
    return chosen, half


def _scatter(tips: np.ndarray) -> float:
    """Standard deviation of a coordinate of single tips [T, 3] about a smooth way, m, by their third differences."""
    bends = np.abs(np.diff(tips, 3, axis=0))
    return float(1.4826 * np.median(bends) / np.sqrt(20)) if len(bends) else 0.0


def smoothing_matrix(present: np.ndarray, width: float) -> np.ndarray:
    """Return weights [T, T] that smooth by a parabola through what is near, weighted by a Gaussian (Cleveland 1979) of a standard
    deviation of `width` steps, not across steps where nothing is there. A parabola rounds off less where a tool turns round than a mean.
    """
    weights = np.eye(len(present))
    run = np.cumsum(np.append(True, present[1:] != present[:-1])) if len(present) else np.zeros(0)
    for step in np.flatnonzero(present & (width > 0)):
        members = np.flatnonzero(run == run[step])
        around = members[np.abs(members - step) <= np.ceil(3 * width)]
        if len(around) <= 3:
            continue
        basis = ((around - step) / width)[:, None] ** np.arange(3)
        weighted = basis * np.exp(-0.5 * ((around - step) / width) ** 2)[:, None]
        weights[step] = 0
        weights[step, around] = np.linalg.solve(weighted.T @ basis, weighted.T)[0]
    return weights
