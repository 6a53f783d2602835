"""Other explanations of the data than that all is as it was thought: each is fitted, and believed where it is much likelier.

They are compared by the probability of the data, which counts that one with more freedom would explain more in any case.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from endo_sim_ros.identification.checks import Survey
from endo_sim_ros.identification.forward import ForwardModel
from endo_sim_ros.identification.replayed_errors import learn_errors
from endo_sim_ros.identification.solving import (
    NUISANCES,
    Data,
    OnProgress,
    Point,
    Prior,
    evidence,
    look,
    minimise,
    misfit,
    normal,
    normals,
    unlikely,
    volume,
)
from endo_sim_ros.identification.unknowns import Unknowns

_LIKELIER = 6.0  # twice the logarithm of how many times as likely an explanation must be to be told: 20 times
_AS_LIKELY = -6.0  # the same, from which on intervals count with an explanation
_WORTH_A_LOOK = -6.0  # the same, as derivatives promise it, from which on it is fitted
_ASTRAY = 5.0  # by which a fit may have less than they promise, before it is begun elsewhere
_FAR = 2.0  # standard deviations of where the tool stands, beyond which it is fitted that it stands elsewhere
_ASIDE = 3.4  # standard deviations of where the tool stands, from which on that is told: by chance in less than one of 100 cases
_STRAY = 0.3  # standard deviation of the logarithm of the moduli of one odd experiment alone: other tissue, or another sensor
_PROMISING = -2.0  # as `_WORTH_A_LOOK`, of an odd experiment
_LOOKED_AT = 2  # experiments of those that seem odd, the likeliest ones
_LEAVE_OUT = ", by more than noise and errors of the tool: leave it out, or check where its tool stood and what was touched"
# What is compared with tissue that does not relax: organs relax by 0.22 to 1.24 in 0.6 to 1.1 s (see `unknowns.PRIORS`), and any relaxation
# looks like one that is half or twice as great, or takes half or twice as long.
_RELAXATION, _RELAXATION_TIMES = 0.5, (0.3, 1.0, 3.0)  # s


@dataclass(frozen=True)
class Fit:
    """Unknowns that were fitted by one explanation.

    Args:
        point: Where it ended.
        data: That it is of, by the numbers of the experiments.
        settled: Whether it settled.
        falls: Whether it was still getting better.
        odd: Numbers of experiments that are left out, as they contradict the others.
        aside: Minus twice the logarithm of the probability of these.
        elsewhere: Whether the tool may stand farther from where it is said to in all experiments.
        sure: Whether it does.
    """

    point: Point
    data: dict[int, Data]
    settled: bool
    falls: bool
    odd: tuple[int, ...] = ()
    aside: float = 0.0
    elsewhere: bool = False
    sure: bool = False

    def contradict(self, on: bool) -> tuple[int, ...]:
        """Numbers of experiments that contradict others, or, if an estimate goes on from what was known before, that."""
        return (*self.odd, *(self.data if on and self.sure else ()))

    @cached_property
    def evidence(self) -> float:
        """Minus twice the logarithm of the probability of all data, see `solving.evidence`."""
        return evidence(self.point) + self.aside

    @cached_property
    def unexplained(self) -> float:
        """How many times as great as by theory chi-square is, 1 or more."""
        return max(1.0, misfit(self.point.residuals, self.point.covariances) / sum(len(each) for each in self.point.residuals))


class Fitter:
    """Fits data of one tissue.

    Args:
        model: The tissue.
        unknowns: What is unknown.
        first: The first look.
        progress: Called as ``progress(stage, done, total)``.
    """

    def __init__(self, model: ForwardModel, unknowns: Unknowns, first: Survey, progress: OnProgress):
        self._model, self._unknowns, self._first, self._progress = model, unknowns, first, progress

    def begin(self, theta: np.ndarray, scale: float, depth: float) -> np.ndarray:
        """θ [Q] with moduli that are so many times those of physics, within two standard deviations, and the tool so deep, m."""
        theta, unknowns = theta.copy(), self._unknowns
        whole = np.flatnonzero(unknowns.scale)
        theta[whole] = np.clip(np.log(scale) * unknowns.scale[whole], -2, 2)
        return self.deeper(theta, depth)

    def deeper(self, theta: np.ndarray, depth: float) -> np.ndarray:
        """θ with the tool so much farther along the line of sight, m."""
        theta, P = theta.copy(), self._unknowns.count
        theta[P : P + 3] += depth * self._first.sight / self._unknowns.config.tip_offset
        return theta

    def fit(self, theta: np.ndarray, prior: Prior, data: Mapping[int, Data]) -> Fit:
        """From θ on."""
        parts = list(data.values())
        point = look(theta, prior, parts, self._model, self._unknowns)
        ended, settled, falls = minimise(point, parts, self._model, self._unknowns, self._progress)
        return Fit(ended, dict(data), settled, falls)

    def explain(self, plain: Fit, on: bool) -> tuple[Fit, list[tuple[float, Point]]]:
        """The likeliest explanation: as it was thought, or with the tool elsewhere in all experiments, or with some that are odd; another
        one than the first only if it is much likelier. And where all that are about as likely ended, with their probabilities.

        Args:
            plain: As it was thought.
            on: Whether what was known before is of other experiments, so that one alone may contradict it.
        """
        best = plain
        while True:
            others = [] if best.elsewhere or (on and len(best.data) > 1) else self._elsewhere(best, on)
            if len(best.data) > 1:
                others += self._odd(best)
            likeliest = min(others, key=lambda each: each.evidence, default=best)
            gains = [(best.evidence - each.evidence) / likeliest.unexplained for each in others]
            if max(gains, default=0.0) <= _LIKELIER:
                break
            best = replace(likeliest, sure=likeliest.elsewhere)
        maybe = [(1.0, best.point), *((float(np.exp(gain / 2)), each.point) for gain, each in zip(gains, others) if gain > _AS_LIKELY)]
        return best, [(weight / sum(each for each, _ in maybe), point) for weight, point in maybe]

    def tell(self, fit: Fit, on: bool) -> tuple[list[str], list[str]]:
        """Doubts and other findings about a fit."""
        config, P, findings = self._unknowns.config, self._unknowns.count, list[str]()
        doubts = [f"experiment {number} contradicts the others" + _LEAVE_OUT for number in fit.odd]
        if len(fit.data) == 1 and fit.odd and not on:
            doubts[-1] = f"experiments {min(fit.odd[-1], *fit.data)} and {max(fit.odd[-1], *fit.data)} contradict each other" + _LEAVE_OUT
        relaxing = self._relaxing(fit)
        if relaxing:  # of which some only seem odd
            doubts.clear()
        offset = fit.point.theta[P : P + 3]
        if fit.sure and on:
            doubts.append(f"experiment {min(fit.data)} contradicts what was known before" + _LEAVE_OUT)
        elif fit.sure or np.linalg.norm(offset) > _ASIDE:  # also where an estimate goes on from one with such a tool
            off = config.tip_offset * offset
            depth, size = float(off @ self._first.sight), float(np.linalg.norm(off))
            beyond = size >= config.depth_scan
            more, where = "or more " * beyond, "deeper than" if depth < 0 else "before"
            what = f"contact begins about {1e3 * abs(depth):.1f} mm {more}{where} the surface of the model"
            if abs(depth) < size / 2:
                what = f"the tool stands about {1e3 * size:.1f} mm {more}beside where it is said to, seen along the line of sight"
            told = (
                f"{what}: check the model's scale, and where the tool stands to it; intervals count with a tool that may stand"
                f" {1e3 * config.depth_scan / 2:.1f} mm (one standard deviation) elsewhere"
            )
            (doubts if beyond else findings).append(told)
        if not fit.settled:
            unknown = ", so that nothing counts as known" * fit.falls
            told = f"the estimate had not settled after {config.iterations} iterations{unknown}; allow more"
            (doubts if fit.falls else findings).append(told)
        return [*relaxing, *doubts], findings

    def _stray(self, alone: bool) -> np.ndarray:
        """Covariance of what is other than it was thought where a tool stands elsewhere, and of one experiment alone also of its forces."""
        P, config = self._unknowns.count, self._unknowns.config
        stray, all_moduli = np.zeros((P + NUISANCES, P + NUISANCES)), self._unknowns.scale
        stray[P : P + 3, P : P + 3] = (config.depth_scan / 2 / config.tip_offset) ** 2 * np.eye(3)
        stray[:P, :P] = alone * _STRAY**2 * np.outer(all_moduli, all_moduli)
        return stray

    def _elsewhere(self, fit: Fit, on: bool) -> list[Fit]:
        """Fits with a tool that stands anywhere, if one may be likelier."""
        unknowns, config, P = self._unknowns, self._unknowns.config, self._unknowns.count
        scale, depth = self._first.anywhere
        prior = fit.point.prior.wider(self._stray(on))
        promised = _promised(fit.point, prior)
        if promised < _WORTH_A_LOOK and abs(depth) <= _FAR * np.hypot(config.tip_offset, config.surface_error):
            return []
        theta = fit.point.theta.copy() if unknowns.ball is not None or on else prior.mean.copy()
        theta[P : P + 3] = prior.mean[P : P + 3]
        theta = self.deeper(theta, depth) if on else self.begin(theta, scale, depth)
        data = {number: replace(part, seen=copy(part.seen)) for number, part in fit.data.items()}
        for part in data.values():
            learn_errors(part.seen, self._model, unknowns, theta)
        found = [self.fit(theta, prior, data)]
        if fit.evidence - found[0].evidence < promised - _ASTRAY:  # by the scan
            found.append(self.fit(fit.point.theta, prior, fit.data))
        best = min(found, key=lambda each: each.evidence)
        return [replace(best, odd=fit.odd, aside=fit.aside, elsewhere=True)]

    def _odd(self, fit: Fit) -> list[Fit]:
        """Fits without one more experiment, of those that may be odd."""
        point, numbers = fit.point, list(fit.data)
        sums = list(zip(*normals(point), unlikely(point)))
        plain, stray, gains = _around(sums, point)[0], self._stray(True), dict[int, float]()
        for at, number in enumerate(numbers):
            rest, told = _around(sums[:at] + sums[at + 1 :], point)
            gains[number] = plain - rest - _around([sums[at]], replace(point, prior=told.wider(stray)))[0]
        likely = sorted((number for number in numbers if gains[number] > _PROMISING), key=lambda number: -gains[number])
        return [self._without(fit, number) for number in likely[:_LOOKED_AT]]

    def _without(self, fit: Fit, number: int) -> Fit:
        """A fit without an experiment, which is fitted by itself with what the others tell."""
        rest = self.fit(fit.point.theta, fit.point.prior, {key: part for key, part in fit.data.items() if key != number})
        told = Prior(rest.point.theta, normal(rest.point)[0] + rest.point.prior.precision).wider(self._stray(True))
        alone = [fit.data[number]]
        begins = [self.deeper(told.mean, depth) for depth in self._unknowns.config.depth_scan / 3 * np.arange(-1, 2)]
        looks = [look(theta, told, alone, self._model, self._unknowns, jacobian=False) for theta in begins]
        begin = min(looks, key=lambda each: told.cost(each.theta) + unlikely(each).sum())
        aside = self.fit(begin.theta, told, {number: fit.data[number]})
        return replace(rest, odd=(*fit.odd, number), aside=fit.aside + aside.evidence, elsewhere=fit.elsewhere, sure=fit.sure)

    def _relaxing(self, fit: Fit) -> list[str]:
        """A doubt where tissue that relaxes explains the data better than the estimate, else none.

        It relaxes by `_RELAXATION` in one of some times, each as likely as the others, and all unknowns are estimated again. If it does
        not, it seems N times as likely to in at most one of N recordings, however many numbers were measured. A relaxation that takes
        longer than an experiment is like a stiffness: data do not tell it, so that it is left out.
        """
        point, data, model, unknowns = fit.point, list(fit.data.values()), self._model, self._unknowns
        lasts = max(len(part.seen.experiment.tips) * part.seen.experiment.step_duration for part in data)
        times = [time for time in _RELAXATION_TIMES if time <= lasts]
        if unknowns.physics.relaxation or not times or not any(part.seen.of_forces()[part.seen.used].any() for part in data):
            return []
        others = list[Point]()
        for time in times:
            other = look(point.theta, point.prior, data, model, unknowns, False, (("relaxation", _RELAXATION), ("relaxation_time", time)))
            for old, new in zip(point.jacobians, other.jacobians):
                new[:, : unknowns.count] = old[:, : unknowns.count]
            others.append(minimise(other, data, model, unknowns, lambda *_: None, anew=False)[0])
        less = np.array([unlikely(point) - unlikely(other) for other in others]) / fit.unexplained  # [times, K]
        thought = np.array([point.prior.cost(point.theta) - point.prior.cost(other.theta) for other in others]) / fit.unexplained

        def likelier(less: np.ndarray) -> float:
            """Logarithm of how many times as likely tissue that relaxes is."""
            return float(np.logaddexp.reduce(0.5 * less) - np.log(len(times)))

        whole = less.sum(1) + thought
        # Without any one of several experiments it must be the likelier, too: else that one is what is odd.
        rest = min(likelier(whole - each) for each in less.T) if len(data) > 1 else likelier(whole)
        if likelier(whole) <= -np.log(unknowns.config.relaxing) or rest <= 0:
            return []
        best = int(whole.argmax())
        first = unknowns.reported()[0]
        softer = f"{first.name} {float(first.value(first.row @ others[best].theta[: unknowns.count] + first.mean)):.4g} {first.unit}"
        return [
            f"forces are those of tissue that relaxes, and the model's does not: a relaxation of {_RELAXATION:g} in {times[best]:g} s, and"
            f" {softer}, explain them better; give physics a likely relaxation and relaxation_time, and add relaxation to unknowns"
        ]


def _around(sums: Sequence[tuple[np.ndarray, np.ndarray, float]], point: Point) -> tuple[float, Prior]:
    """Evidence and posterior as derivatives of a point tell them, of JᵀR⁻¹J, JᵀR⁻¹r and minus twice the log likelihood of experiments."""
    H, g, prior = np.sum([each[0] for each in sums], axis=0), np.sum([each[1] for each in sums], axis=0), point.prior
    b, precision = g - prior.precision @ (point.theta - prior.mean), H + prior.precision
    step = np.linalg.solve(precision, b)
    least = prior.cost(point.theta) + sum(each[2] for each in sums) - float(b @ step) + volume(H, prior)
    return least, Prior(point.theta + step, precision)


def _promised(point: Point, prior: Prior) -> float:
    """By how much derivatives of a point say that the evidence is less with another prior."""
    sums = list(zip(*normals(point), unlikely(point)))
    return _around(sums, point)[0] - _around(sums, replace(point, prior=prior))[0]
