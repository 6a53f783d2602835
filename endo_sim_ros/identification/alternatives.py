"""Other explanations of the data than that all is as it was thought: each is fitted, and believed where it is much likelier.

They are compared by the probability of the data, which counts that one with more freedom would explain more in any case.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import norm

from endo_sim_ros.identification.checks import Survey
from endo_sim_ros.identification.forward import ForwardModel
from endo_sim_ros.identification.replayed_errors import learn_errors
from endo_sim_ros.identification.solving import (
    LIKELIER,
    NUISANCES,
    Data,
    OnProgress,
    Point,
    Prior,
    around,
    evidence,
    look,
    minimise,
    misfit,
    normal,
    normals,
    unlikely,
)
from endo_sim_ros.identification.unknowns import Unknowns

# Differences of evidence, as `LIKELIER`, which is that by which an explanation must be likelier to be told.
_AS_LIKELY = -LIKELIER  # from which on intervals count with an explanation: less adds nothing to them
_WORTH_A_LOOK = -6.0  # as derivatives promise it, from which on it is fitted: they err by about as much, as forces are rough
_PROMISING = -2.0  # the same of an odd experiment, of which there are more, and each takes two fits
_ASTRAY = 5.0  # by which a fit may have less than derivatives promise, before it is begun elsewhere: as far as these err
_LITTLE = 1.0  # by which an estimate of the same explanation must be likelier to take the place of another: below is roughness of forces
_FAR = 2.0  # standard deviations of where the tool stands, beyond which it is fitted that it stands elsewhere: one case in 20
_ASIDE = 3.4  # the same, of its place in three axes, from which on that is told: by chance in less than one of 100 cases (chi, 3 axes)
_STRAY = 0.3  # sd of the logarithm of the moduli of one odd experiment alone: pieces of one organ differ by so much (docs, real lungs)
_HELD, _WITHIN = 0.1, 0.29  # steps of depth, standard deviations: as a tool is held there, and of depths within a step (uniform: 1/√12)
_LOOKED_AT = 2  # experiments of those that seem odd, the likeliest ones
_WHY = ", by more than noise and errors of the tool: check where its tool stood and what was touched"
_STIFFER = np.geomspace(1.0, 4.0, 10)  # times as great as its limit, that the greatest force may be that a sensor does not tell
_AGAIN = 4  # times that a limit is the mean of what is there beyond it
# What is compared with tissue that does not relax: organs relax by 0.22 to 1.24 in 0.6 to 1.1 s (see `unknowns.PRIORS`), and any relaxation
# looks like one that is half or twice as great, or takes half or twice as long.
_RELAXATION, _RELAXATION_TIMES = 0.5, (0.3, 1.0, 3.0)  # s


Explanations = list[tuple[float, Point]]
"""Where fits ended, each with twice the logarithm of how many times as likely data are by it as by the fit that was chosen."""


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
        spoilt: A sentence where tissue that relaxes, or a sensor that is clipped, is much likelier, else an empty one.
    """

    point: Point
    data: dict[int, Data]
    settled: bool
    falls: bool
    odd: tuple[int, ...] = ()
    aside: float = 0.0
    elsewhere: bool = False
    sure: bool = False
    spoilt: str = ""

    def contradict(self, on: bool) -> tuple[int, ...]:
        """Numbers of experiments that contradict others, or, if an estimate goes on from what was known before, that."""
        return (*self.odd, *(self.data if on and self.sure else ()))

    @cached_property
    def evidence(self) -> float:
        """Minus twice the logarithm of the probability of all data, see `solving.evidence`."""
        return evidence(self.point) + self.aside


@dataclass(frozen=True)
class Even:
    """A field that is the same everywhere, as one explanation.

    Args:
        gain: Twice the logarithm of how many times as likely all data are with a field that differs from place to place.
        mean: Of θ, if it is even [Q].
        precision: Of θ [Q, Q].
        settled: Whether that estimate settled.
        falls: Whether it was still getting better.
    """

    gain: float
    mean: np.ndarray
    precision: np.ndarray
    settled: bool
    falls: bool

    @property
    def differs(self) -> bool:
        """Whether a field that differs is so much likelier that its places are told."""
        return self.gain > LIKELIER


@dataclass(frozen=True)
class _Spoils:
    """What would make data other than they are taken for.

    Args:
        told: A sentence.
        found: Where fits of it ended, with minus twice the logarithm of the probability of all data and that.
    """

    told: str
    found: list[tuple[float, Point]]

    def gains(self, plain: Fit, unexplained: float) -> np.ndarray:
        """Twice the logarithms of how many times as likely data are as by a plain fit, of each [K]."""
        return (plain.evidence - plain.aside - np.array([cost for cost, _ in self.found])) / unexplained

    def gain(self, plain: Fit, unexplained: float) -> float:
        """The same of all."""
        return float(2 * np.logaddexp.reduce(0.5 * self.gains(plain, unexplained)))


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

    def explain(self, plain: Fit, on: bool) -> tuple[Fit, Explanations]:
        """The likeliest explanation: as it was thought, or with the tool elsewhere in all experiments, or with some that are odd; another
        one than the first only if it is much likelier. And all that are about as likely.

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
            spoilt = [each for each in (self._clipped(best), self._relaxing(best)) if each is not None]
            tried = [point for each in spoilt for _, point in each.found]
            unexplained = _unexplained([best.point, *(each.point for each in others), *tried])
            gains = [(best.evidence - each.evidence) / unexplained for each in others]
            spoils = max(spoilt, key=lambda each: each.gain(best, unexplained), default=None)
            gain = LIKELIER if spoils is None else max(spoils.gain(best, unexplained), LIKELIER)
            if max(gains, default=0.0) > gain:
                best = replace(likeliest, sure=likeliest.elsewhere)
                continue
            if spoils is None or gain <= LIKELIER:
                break
            # Forces are rough, so that a fit ends near where it began: what is believed must be likelier than one from where it ended, too.
            again = self.fit(min(spoils.found, key=lambda each: each[0])[1].theta, best.point.prior, best.data)
            gained = evidence(best.point) - evidence(again.point)
            if gain - max(gained, 0.0) / unexplained > LIKELIER:
                best = replace(best, spoilt=spoils.told)
                break
            if gained <= _LITTLE:
                break
            best = replace(best, point=again.point, settled=again.settled, falls=again.falls)
        also = [*zip(gains, (each.point for each in others))]
        for each in spoilt:
            also += zip(each.gains(best, unexplained), (point for _, point in each.found))
        aside = not best.spoilt and (best.sure or self._stands_aside(best.point))
        places = self._places(best, unexplained) if aside else [(0.0, best.point)]
        best = replace(best, point=replace(places[0][1], prior=best.point.prior))
        return best, [*places, *((gain, point) for gain, point in also if gain > _AS_LIKELY)]

    def even(self, fit: Fit, before: Even | None) -> tuple[Even, Explanations]:
        """How likely even tissue is beside a field that was fitted, and where that ended, if it is about as likely.

        A field has so much freedom that it always has stiffest and softest places, and explains noise by these.

        Args:
            fit: Of the field.
            before: The same of what was known before.
        """
        unknowns, theta, prior = self._unknowns, fit.point.theta.copy(), fit.point.prior
        places = slice(1, unknowns.stiffness_count)
        if before is not None:
            prior = Prior(before.mean, before.precision)
        theta[places] = 0
        alike = [replace(part, **_without(part, places)) for part in fit.data.values()]

        def fitted(*begins: np.ndarray) -> list[Fit]:
            return [self.fit(each, prior, dict(enumerate(alike))) for each in begins]

        self._model.replan()  # stiff places of a field need more substeps, which would change forces of even tissue
        best = min(fitted(theta, prior.mean), key=lambda each: each.evidence)
        if best.evidence > evidence(fit.point):  # forces are rough: a fit ends near where it began
            step = unknowns.config.tip_step
            begins = (self.deeper(best.point.theta, way * step) for way in (-1, 1))
            best = min([best, *fitted(*begins)], key=lambda each: each.evidence)
        point = best.point
        now = (evidence(point) - evidence(fit.point)) / _unexplained([point, fit.point])
        gain = now + (0.0 if before is None else before.gain)
        told = Even(gain, point.theta, normal(point)[0] + prior.precision, best.settled, best.falls)
        if told.differs:
            return told, []
        # How well places would be known is what the data say of a field.
        whole = look(point.theta, fit.point.prior, list(fit.data.values()), self._model, unknowns)
        return told, [(-told.gain, whole)]

    def tell(self, fit: Fit, theta: np.ndarray, on: bool) -> tuple[list[str], list[str]]:
        """Doubts and other findings about a fit, where the mean of all explanations that are about as likely is θ."""
        if fit.spoilt:  # what else there seems to be follows from it
            return [fit.spoilt], []
        config, P, findings = self._unknowns.config, self._unknowns.count, list[str]()
        doubts = [f"experiment {number} contradicts the others, and is left out" + _WHY for number in fit.odd]
        if len(fit.data) == 1 and fit.odd and not on:
            doubts[-1] = f"experiments {min(fit.odd[-1], *fit.data)} and {max(fit.odd[-1], *fit.data)} contradict each other" + _WHY
        offset = theta[P : P + 3]
        if fit.sure and on:
            doubts.append(f"experiment {min(fit.data)} contradicts what was known before" + _WHY)
        elif fit.sure or self._stands_aside(fit.point):
            off = config.tip_offset * offset
            depth, size = float(off @ self._first.sight), float(np.linalg.norm(off))
            beyond = size >= config.depth_scan
            more, where = "or more " * beyond, "deeper than" if depth < 0 else "before"
            what = f"contact begins about {1e3 * abs(depth):.1f} mm {more}{where} the surface of the model"
            if abs(depth) < size / 2:
                what = f"the tool stands about {1e3 * size:.1f} mm {more}beside where it is said to, seen along the line of sight"
            told = (
                f"{what}: check the model's scale, and where the tool stands to it; intervals count with a tool that may stand"
                f" {1e3 * config.tool_aside:.1f} mm (one standard deviation) elsewhere"
            )
            (doubts if beyond else findings).append(told)
        if not fit.settled:
            unknown = ", so that nothing counts as known" * fit.falls
            told = f"the estimate had not settled after {config.iterations} iterations{unknown}; allow more"
            (doubts if fit.falls else findings).append(told)
        return doubts, findings

    def _stands_aside(self, point: Point) -> bool:
        """Whether the tool stands elsewhere than by chance; also where an estimate goes on from one with such a tool."""
        P = self._unknowns.count
        return bool(np.linalg.norm(point.theta[P : P + 3]) > _ASIDE)

    def _places(self, fit: Fit, unexplained: float) -> Explanations:
        """Fits with the tool held at depths about that of a fit, the likeliest first; together they are as likely as that.

        Forces tell a tool that is deeper from tissue that is stiffer by the shape of a press alone, in a valley that is long, bent and
        rough: one fit ends where it is rough, and the posterior about it is too narrow.
        """
        P, data, prior = self._unknowns.count, list(fit.data.values()), fit.point.prior
        along = np.zeros(P + NUISANCES)
        along[P : P + 3] = self._first.sight / np.linalg.norm(self._first.sight)
        config = self._unknowns.config
        step, most = config.tip_step / config.tip_offset, max(1, round(config.depth_scan / config.tip_step))

        def held(theta: np.ndarray, within: float) -> Prior:
            """What is known if the tool is as deep as by θ, within so many steps."""
            tight = np.outer(along, along) / (within * step) ** 2
            precision = prior.precision + tight
            return Prior(np.linalg.solve(precision, prior.precision @ prior.mean + tight @ theta), precision)

        def fitted(theta: np.ndarray) -> Point:
            point = look(theta, held(theta, _HELD), data, self._model, self._unknowns)
            return minimise(point, data, self._model, self._unknowns, self._progress)[0]

        def cost(point: Point) -> float:
            known = float(np.linalg.slogdet(normal(point)[0] + point.prior.precision)[1])
            return (prior.cost(point.theta) + float(unlikely(point).sum()) + known) / unexplained

        found = {0: fitted(fit.point.theta)}
        costs = {0: cost(found[0])}
        for way in (-1, 1):
            for at in range(way, way * (most + 1), way):
                found[at] = fitted(found[at - way].theta + way * step * along)
                costs[at] = cost(found[at])
                if costs[at] > min(costs.values()) - _AS_LIKELY:
                    break
        smooth = {at: np.mean([costs[each] for each in (at - 1, at, at + 1) if each in costs]) for at in found}
        order = sorted((at for at in found if {at - 1, at + 1} <= found.keys()), key=lambda at: smooth[at])  # the ends are unlikely
        gains = np.array([smooth[order[0]] - smooth[at] for at in order])
        points = [replace(found[at], prior=held(found[at].theta, _WITHIN)) for at in order]
        return list(zip((gains - 2 * np.logaddexp.reduce(gains / 2)).tolist(), points))

    def _stray(self, alone: bool) -> np.ndarray:
        """Covariance of what is other than it was thought where a tool stands elsewhere, and of one experiment alone also of its forces."""
        P, config = self._unknowns.count, self._unknowns.config
        stray, all_moduli = np.zeros((P + NUISANCES, P + NUISANCES)), self._unknowns.scale
        stray[P : P + 3, P : P + 3] = (config.tool_aside / config.tip_offset) ** 2 * np.eye(3)
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
        plain, stray, gains = around(sums, point)[0], self._stray(True), dict[int, float]()
        for at, number in enumerate(numbers):
            rest, told = around(sums[:at] + sums[at + 1 :], point)
            gains[number] = plain - rest - around([sums[at]], replace(point, prior=told.wider(stray)))[0]
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

    def _relaxing(self, fit: Fit) -> _Spoils | None:
        """Tissue that relaxes, if it may be likelier.

        It relaxes by `_RELAXATION` in one of some times, each as likely as the others, and all unknowns are estimated again. A relaxation
        that takes longer than an experiment is like a stiffness: data do not tell it, so that it is left out.
        """
        point, data, model, unknowns = fit.point, list(fit.data.values()), self._model, self._unknowns
        lasts = max(len(part.seen.experiment.tips) * part.seen.experiment.step_duration for part in data)
        times = [time for time in _RELAXATION_TIMES if time <= lasts]
        if unknowns.physics.relaxation or not times:
            return None
        others = list[Point]()
        for time in times:
            other = look(point.theta, point.prior, data, model, unknowns, False, (("relaxation", _RELAXATION), ("relaxation_time", time)))
            for old, new in zip(point.jacobians, other.jacobians):
                new[:, : unknowns.count] = old[:, : unknowns.count]
            others.append(minimise(other, data, model, unknowns, lambda *_: None, anew=False)[0])
        costs = [evidence(other) + 2 * np.log(len(times)) for other in others]
        whole = evidence(point) - np.array(costs)
        less = np.array([unlikely(point) - unlikely(other) for other in others])  # [times, K]

        # Without any one of several experiments it must be the likelier, too: else that one is what is odd.
        if len(data) > 1 and min(np.logaddexp.reduce(0.5 * (whole - each)) for each in less.T) <= 0:
            return None
        best = int(whole.argmax())
        first = unknowns.reported()[0]
        softer = f"{first.name} {float(first.value(first.row @ others[best].theta[: unknowns.count] + first.mean)):.4g} {first.unit}"
        told = (
            f"forces are those of tissue that relaxes, and the model's does not: a relaxation of {_RELAXATION:g} in {times[best]:g} s, and"
            f" {softer}, explain them better; give physics a likely relaxation and relaxation_time, and add relaxation to unknowns"
        )
        return _Spoils(told, list(zip(costs, others)))

    def _clipped(self, fit: Fit) -> _Spoils | None:
        """A sensor that is clipped at one force in all experiments, or at one value along each axis, if it may be likelier."""
        found, limits = list[tuple[float, Point]](), list[float]()
        for by_axis in (False, True):
            theta, limit, promised = self._cut(fit, by_axis)
            if promised < _WORTH_A_LOOK:
                continue
            parts = {number: replace(part, limit=limit, by_axis=by_axis) for number, part in fit.data.items()}
            point = self.fit(theta, fit.point.prior, parts).point
            known, pull = 0.0, 0.0  # of the logarithm of the limit: 1/variance, and what residuals say
            for part, r, R in zip(parts.values(), point.residuals, point.covariances):
                grows = part.at_limit(_told(part, r))[part.seen.used]
                weighted = R.solve(grows[:, None])[:, 0]
                known, pull = known + float(grows @ weighted), pull + float(r @ weighted)
            if known > 0:
                found.append((evidence(point) + _free(known, pull) + 2 * np.log(2), point))
                limits.append(limit)
        if not found:
            return None
        limit = limits[min(range(len(found)), key=lambda at: found[at][0])]
        cause = "is the sensor clipped"
        if any(part.seen.experiment.closed.any() for part in fit.data.values()):
            cause += ", or does a grasp slip in part"
        told = f"forces stop at {limit:.2g} N while the tool goes on, where those of the model go on growing: {cause}?"
        return _Spoils(told, found)

    def _cut(self, fit: Fit, by_axis: bool) -> tuple[np.ndarray, float, float]:
        """Where to begin a fit with a sensor that is clipped: θ, its limit, N, and by how much forces of the fit, made greater and cut, say
        that the evidence is less then. Data must not exceed the limit by more than noise."""
        point, unknowns, parts = fit.point, self._unknowns, [replace(part, by_axis=by_axis) for part in fit.data.values()]
        told = [_told(part, r) for part, r in zip(parts, point.residuals)]
        sizes = [np.where(part.seen.used, part.bounded(part.seen.values), 0.0) for part in parts]
        rare = float(norm.isf(unknowns.config.doubt / max(sum(map(np.count_nonzero, sizes)), 1)))
        top = max(float(size.max()) for size in sizes)
        least = max(float(size.max()) - rare * part.seen.experiment.force_noise for part, size in zip(parts, sizes))
        costs, limits = list[float](), list[float]()
        for by in _STIFFER:
            limit, seen = top, [part.bounded(by * each) for part, each in zip(parts, told)]
            for _ in range(_AGAIN):
                there = [each > limit for each in seen]
                count = sum(int(each.sum()) for each in there)
                total = sum(float(size[each].sum()) for size, each in zip(sizes, there))
                limit = float(np.clip(total / count, least, top)) if count else top
            cost, known = 0.0, 0.0
            for part, each, (by_tip, own) in zip(parts, told, point.errors):
                part = replace(part, limit=limit)
                R, r = part.covariance(by * each, by * by_tip, by * own), (part.seen.values - part.clipped(by * each))[part.seen.used]
                grows = part.at_limit(part.clipped(by * each))[part.seen.used]
                known += float(grows @ R.solve(grows[:, None])[:, 0])
                cost += float(r @ R.solve(r[:, None])[:, 0]) + R.log_determinant
            costs.append(cost + _free(known, 0.0) + 2 * np.log(2) if known > 0 else np.inf)
            limits.append(limit)
        at, whole, theta = int(np.argmin(costs)), np.flatnonzero(unknowns.scale), point.theta.copy()
        theta[whole] += np.log(_STIFFER[at]) * unknowns.scale[whole] / max(float(unknowns.scale @ unknowns.scale), 1e-12)
        return theta, limits[at], float(unlikely(point).sum()) - costs[at]


def _free(known: float, pull: float) -> float:
    """By how much the evidence is more where a limit may be anywhere within `_STIFFER` of a force that is not told, by Laplace's method.

    Args:
        known: 1/variance of its logarithm, as data tell it.
        pull: Minus half the derivative of chi-square by that.
    """
    width = float(np.log(_STIFFER[-1]))
    return float(np.log(1 + known * width**2 / (2 * np.pi))) - pull**2 / max(known, 1e-12)


def _unexplained(points: Sequence[Point]) -> float:
    """By what evidence is to be divided: chi-square over its number by the explanation that leaves least, 1 or more."""
    return max(1.0, min(misfit(each.residuals, each.covariances) / max(sum(map(len, each.residuals)), 1) for each in points))


def _told(part: Data, residuals: np.ndarray) -> np.ndarray:
    """What the model told of an experiment [N], 0 where that is not used."""
    told = np.zeros(len(part.seen.values))
    told[part.seen.used] = part.seen.values[part.seen.used] - residuals
    return told


def _without(part: Data, places: slice) -> dict[str, np.ndarray]:
    """The directions of an experiment that change none of some unknowns."""
    kept = ~part.ways[:, places].any(1)
    return {"ways": part.ways[kept], "back": part.back[kept]}


def _promised(point: Point, prior: Prior) -> float:
    """By how much derivatives of a point say that the evidence is less with another prior."""
    sums = list(zip(*normals(point), unlikely(point)))
    return around(sums, point)[0] - around(sums, replace(point, prior=prior))[0]
