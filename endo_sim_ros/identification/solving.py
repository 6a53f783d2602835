"""Fitting unknowns to experiments: residuals and Jacobians from copies of the tissue, and Levenberg and Marquardt's method.

Beside the unknowns five numbers are estimated that nobody asks for: the error of the place of the tool that all tips share [3], the share
by which all forces of the model are wrong, and how much still finer control nodes would change them. They have priors, too, so that
intervals know of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from endo_sim_ros.identification.forward import ForwardModel
from endo_sim_ros.identification.observations import Covariance, Observations
from endo_sim_ros.identification.unknowns import Unknowns

NUISANCES = 5
Options = tuple[tuple[str, float], ...]
"""Names of options of physics, and values."""
OnProgress = Callable[[str, int, int], None]
"""``on_progress(stage, done, total)``."""
LIKELIER = 6.0
"""By which evidence, twice the logarithm of a probability, must be greater for an explanation to be told: it is then 20 times as likely,
where evidence is called strong (Kass and Raftery 1995)."""
_FARTHEST = 1.5  # standard deviations that an unknown moves in one iteration
_DAMPED, _LOOSENED, _MOST_DAMPED = 10.0, 0.1, 1e6
_NOTHING = 0.5  # of chi-square: forces are rougher, so that a step of a fresh Jacobian that promises no more is the last, gain or not
_FEW, _LITTLE = 3, 1.0  # steps that together take less of chi-square away end it: one standard deviation of one unknown is that much
# Times their size, by which forces may grow with the logarithm of all moduli. It is 1 by theory, derivatives by differences err by up to a
# fifth, and where contact jumped it was 7.
_STEEPEST = 1.5
_AS_PROMISED = 0.3  # share of the promised gain with which a Jacobian is still good
_FALLS = 0.05  # share of chi-square that the last two iterations took away, from which on the next ones would, too


@dataclass(frozen=True)
class Prior:
    """What is known of θ before these data: normal."""

    mean: np.ndarray  # [Q]
    precision: np.ndarray  # [Q, Q]

    def wider(self, by: np.ndarray) -> "Prior":
        """One whose covariance is greater by a matrix [Q, Q]."""
        return Prior(self.mean, np.linalg.inv(np.linalg.inv(self.precision) + by))

    def cost(self, theta: np.ndarray) -> float:
        """Minus twice the logarithm of its density at θ [Q], but for a constant."""
        return float((theta - self.mean) @ self.precision @ (theta - self.mean))


@dataclass
class Point:
    """The data as seen from one set of unknowns θ [Q]."""

    theta: np.ndarray
    prior: Prior
    residuals: list[np.ndarray]  # of each experiment [n], of the numbers that are used
    jacobians: list[np.ndarray]  # of predictions [n, Q]
    covariances: list[Covariance]
    errors: list[tuple[np.ndarray, np.ndarray]]  # what these are made of, see `Observations.covariance`
    undone: int  # steps of the simulation
    also: Options = ()  # of physics that are other ones


@dataclass(frozen=True)
class Data:
    """An experiment, and the directions of the unknowns that it tells of."""

    seen: Observations
    ways: np.ndarray  # [D, P]
    back: np.ndarray  # [D, P]
    limit: float = np.inf  # N, that a sensor tells no more than
    by_axis: bool = False  # whether that bounds each component of a force, else its size

    def bounded(self, told: np.ndarray) -> np.ndarray:
        """What a limit bounds of predictions [N], 0 where they are no forces."""
        size, forces = np.zeros(len(told)), self.seen.of_forces()
        if self.by_axis:
            size[forces] = np.abs(told[forces])
        else:
            squares = np.bincount(self.seen.steps[forces], told[forces] ** 2, len(self.seen.experiment.tips))
            size[forces] = np.sqrt(squares)[self.seen.steps[forces]]
        return size

    def clipped(self, told: np.ndarray) -> np.ndarray:
        """What the sensor makes of predictions [N]."""
        return told if np.isinf(self.limit) else told * self.limit / np.maximum(self.bounded(told), self.limit)

    def at_limit(self, told: np.ndarray) -> np.ndarray:
        """Predictions [N] that the sensor made, 0 where these are below its limit."""
        return np.where(self.bounded(told) >= self.limit * (1 - 1e-6), told, 0.0)

    def passed(self, told: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """What the sensor makes of small changes [N, K] of predictions [N]: at its limit only the direction of a force can change."""
        if np.isinf(self.limit):
            return errors
        size, steps = np.maximum(self.bounded(told), self.limit), self.seen.steps
        beyond = size > self.limit
        if self.by_axis:
            return np.where(beyond[:, None], 0.0, errors)
        along = np.where(beyond, told / size, 0.0)[:, None]
        radial = np.zeros((len(self.seen.experiment.tips), errors.shape[1]))
        np.add.at(radial, steps[beyond], (along * errors)[beyond])
        return (errors - along * radial[steps]) * (self.limit / size)[:, None] if beyond.any() else errors

    def covariance(self, told: np.ndarray, by_tip: np.ndarray, own: np.ndarray) -> Covariance:
        """Of the numbers that are used, see `Observations.covariance`, where predictions [N] and errors are those before the sensor."""
        seen = self.seen
        if np.isinf(self.limit):
            return seen.covariance(by_tip, own)
        # What is other from step to step is taken to last where it is cut: what is left of it is shared by the axes.
        lasting = np.where(self.bounded(told) > self.limit, 1.0, seen.lasting)
        return seen.covariance(self.passed(told, by_tip), self.passed(told, own), self.passed(told, seen.trembling()), lasting)


def look(
    theta: np.ndarray, prior: Prior, data: Sequence[Data], model: ForwardModel, unknowns: Unknowns, jacobian: bool = True,
    also: Options = (),
) -> Point:  # fmt: skip
    """Residuals and covariance at θ, and the Jacobian, from one batch for each experiment; without it only its columns of the tip. Options
    of physics may be other ones, too (`also`)."""
    config, P = unknowns.config, unknowns.count
    feels = any(part.seen.of_forces().any() for part in data)
    z, offset, gain = theta[:P], theta[P : P + 3] * config.tip_offset, 1 + config.model_error * theta[P + 3]
    residuals, jacobians, covariances, errors, undone = [], [], [], [], 0
    for part in data:
        each, ways = part.seen, part.ways if jacobian else part.ways[:0]
        copies = [unknowns.copy(z, offset)]
        copies += [replace(unknowns.copy(z, offset), jog=config.tip_step * np.eye(3)[axis]) for axis in range(3)]
        others = ways[:, unknowns.stiffness_count :].any(1)
        step = np.where(others, config.other_step, config.jacobian_step)
        copies += [unknowns.copy(z + size * way, offset) for size, way in zip(step, ways)]
        copies += [unknowns.copy(z - config.other_step * way, offset) for way in ways[others]]
        replay = model.replay(each.experiment, [replace(copy, options=(*copy.options, *also)) for copy in copies], 4)
        told, undone = each.predicted(replay), undone + int(replay.faults[0])
        forces, by_grid = each.of_forces(), config.grid_error * each.changed(replay)
        told[:, forces] *= gain
        told = told + theta[P + 4] * by_grid
        J = np.zeros((told.shape[1], P + NUISANCES))
        less = np.broadcast_to(told[0], (len(ways), told.shape[1])).copy()
        less[others] = told[4 + len(ways) :]
        J[:, :P] = ((told[4 : 4 + len(ways)] - less) / (step * (1 + others))[:, None]).T @ part.back[: len(ways)]
        J[:, : unknowns.stiffness_count] *= _believed(J[:, :P] @ unknowns.scale, told[0], forces & each.used)
        if not feels:  # how stiff all is would be told by inertia and damping alone, which the model has only about right
            J[:, :P] -= np.outer(J[:, :P] @ unknowns.scale, unknowns.scale) / (unknowns.scale @ unknowns.scale)
        by_tip = (told[1:4] - told[0]).T / config.tip_step
        by_place = np.where(each.closed_at[:, None] >= 0, 0, by_tip)  # a place that is held moves with the tip, wherever that is
        J[:, P : P + 3] = by_place * config.tip_offset
        J[:, P + 3], J[:, P + 4] = np.where(forces, told[0] / gain * config.model_error, 0), by_grid
        own = [by_place * config.surface_error, J[:, P + 3 :], each.apart, each.followed]  # errors of this experiment alone
        residuals.append((each.values - part.clipped(told[0]))[each.used])
        jacobians.append(part.passed(told[0], J)[each.used])
        errors.append((by_tip, np.column_stack(own)))
        covariances.append(part.covariance(told[0], *errors[-1]))
    return Point(theta, prior, residuals, jacobians, covariances, errors, undone, also)


def _believed(steepness: np.ndarray, told: np.ndarray, forces: np.ndarray) -> float:
    """By how much derivatives by stiffnesses are to be taken, 1 or less.

    Forces of tissue in which a tool goes its way are proportional to all moduli together. Where they seem to grow by far more, contact has
    jumped between the two copies that are compared, and so steep forces would make a wrong modulus look sure.

    Args:
        steepness: Derivative by the logarithm of all moduli of each number [N].
        told: What the model tells [N].
        forces: Which are forces that count [N].
    """
    steep, whole = (float(np.linalg.norm(each[forces])) for each in (steepness, told))
    return whole / steep if steep > _STEEPEST * whole else 1.0


def misfit(residuals: list[np.ndarray], covariances: list[Covariance]) -> float:
    """Chi-square of residuals."""
    return sum(float(r @ R.solve(r[:, None])[:, 0]) for r, R in zip(residuals, covariances))


def normals(point: Point) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """JᵀR⁻¹J [Q, Q] and JᵀR⁻¹r [Q] of each experiment."""
    weighted = [R.solve(J) for J, R in zip(point.jacobians, point.covariances)]
    H, g = ([W.T @ each for W, each in zip(weighted, parts)] for parts in (point.jacobians, point.residuals))
    return H, g


def normal(point: Point) -> tuple[np.ndarray, np.ndarray]:
    """The same of all experiments."""
    H, g = normals(point)
    return np.sum(H, axis=0), np.sum(g, axis=0)


def minimise(
    point: Point, data: list[Data], model: ForwardModel, unknowns: Unknowns, progress: OnProgress, anew: bool = True
) -> tuple[Point, bool, bool]:
    """Levenberg and Marquardt's method from a point; returns where it ended, whether it settled, and whether it was still getting better.

    The Jacobian is kept, with Broyden's correction, while steps do about what it promises, and is fresh at the end. It is kept all along if
    it is not to be taken `anew`.

    The covariance is that of the point that a step begins at: how much is uncertain because the tip is depends on the stiffness, but is
    no reason to believe in another. Where residuals are no less by that, the likelihood counts, with the covariance of each point.
    """
    config, P, prior = unknowns.config, unknowns.count, point.prior

    def see(theta: np.ndarray, jacobian: bool = True) -> Point:
        return look(theta, prior, data, model, unknowns, jacobian, point.also)

    damping, fresh, spread = 1e-3, True, np.maximum(np.sqrt(np.diag(np.linalg.inv(prior.precision))), 1.0)
    settled, costs, taken = False, list[float](), list[float]()
    for iteration in range(config.iterations):
        progress("estimate", iteration + 1, config.iterations)
        costs.append(prior.cost(point.theta) + misfit(point.residuals, point.covariances))
        if len(taken) >= _FEW and sum(taken[-_FEW:]) < _LITTLE:
            settled = True
            break
        H, g = normal(point)
        H, g = H + prior.precision, g - prior.precision @ (point.theta - prior.mean)
        step: np.ndarray = np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
        step *= min(1.0, _FARTHEST / max(float(np.abs(step / spread).max()), 1e-12))
        moved = float(np.abs(step / np.sqrt(np.diag(np.linalg.inv(H)))).max())
        if moved < config.tolerance:
            if fresh:
                settled = True
                break
            point, fresh = see(point.theta), True
            continue
        other = see(point.theta + step, jacobian=False)
        for old, new, was, now in zip(point.jacobians, other.jacobians, point.residuals, other.residuals):
            wrong = (was - now - old @ step) * (moved > 1)  # of short steps it would be rounding
            new[:, :P] = old[:, :P] + wrong[:, None] * step[:P] / max(float(step[:P] @ step[:P]), 1e-12)
        gained = costs[-1] - prior.cost(other.theta) - misfit(other.residuals, point.covariances)
        promised = float(2 * g @ step - step @ H @ step)
        likelier = prior.cost(point.theta) + unlikely(point).sum() - prior.cost(other.theta) - unlikely(other).sum()
        gained = max(gained, float(likelier))
        taken += [gained] * (gained > 0)
        if gained > _AS_PROMISED * promised:
            point, damping, fresh = other, max(damping * _LOOSENED, 1e-6), not anew
        elif not fresh:
            point, fresh = see(other.theta if gained > 0 else point.theta), True
        elif gained > 0 or promised < _NOTHING:
            point, settled = see(other.theta) if anew else other, bool(promised < _NOTHING)
        else:
            damping *= _DAMPED if damping > 0.01 else 100 * _DAMPED
            settled = damping > _MOST_DAMPED  # no step gains anything
        if settled:
            break
    point = point if fresh else see(point.theta)
    last = prior.cost(point.theta) + misfit(point.residuals, point.covariances)
    return point, settled, not settled and last < (1 - _FALLS) * costs[-2:][0]


def unlikely(point: Point) -> np.ndarray:
    """Minus twice the logarithm of the likelihood of each experiment [K], but for a constant."""
    return np.array([float(r @ R.solve(r[:, None])[:, 0]) + R.log_determinant for r, R in zip(point.residuals, point.covariances)])


def evidence(point: Point) -> float:
    """Minus twice the logarithm of the probability of the data, by Laplace's method, but for a constant (MacKay 2003, chapter 28)."""
    return point.prior.cost(point.theta) + float(unlikely(point).sum()) + volume(normal(point)[0], point.prior)


def volume(H: np.ndarray, prior: Prior) -> float:
    """By how much the posterior is narrower than a prior: logarithm of the ratio of their determinants."""
    return float(np.linalg.slogdet(H + prior.precision)[1] - np.linalg.slogdet(prior.precision)[1])


def around(sums: Sequence[tuple[np.ndarray, np.ndarray, float]], point: Point) -> tuple[float, Prior]:
    """Evidence and posterior as derivatives of a point tell them, of JᵀR⁻¹J, JᵀR⁻¹r and minus twice the log likelihood of experiments."""
    H, g, prior = np.sum([each[0] for each in sums], axis=0), np.sum([each[1] for each in sums], axis=0), point.prior
    b, precision = g - prior.precision @ (point.theta - prior.mean), H + prior.precision
    step = np.linalg.solve(precision, b)
    least = prior.cost(point.theta) + sum(each[2] for each in sums) - float(b @ step) + volume(H, prior)
    return least, Prior(point.theta + step, precision)
