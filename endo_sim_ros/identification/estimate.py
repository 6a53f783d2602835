"""Estimation of what tissue is made of, and the posterior by Laplace's method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.identification.alternatives import Even, Explanations, Fitter
from endo_sim_ros.identification.ball import COUNT as BALL
from endo_sim_ros.identification.checks import (
    IdentificationError,
    Survey,
    check_input,
    judge_residuals,
    survey,
)
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.followed_errors import learn_followed
from endo_sim_ros.identification.forward import ForwardModel, distances_to_skin, reach_of
from endo_sim_ros.identification.maps import AGREED, different_places, paint_as_regions
from endo_sim_ros.identification.observations import Covariance, Observations
from endo_sim_ros.identification.replayed_errors import learn_errors
from endo_sim_ros.identification.scan import Places, Scan, added, weights, without_ball
from endo_sim_ros.identification.solving import LIKELIER, NUISANCES, Data, OnProgress, Point, Prior, look, misfit, normal
from endo_sim_ros.identification.unknowns import MODULUS, MOST_LOG, NOT_TOLD, Reported, Told, Unknowns
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

_FAR = 2.0  # standard deviations from what was thought, which is told
_LEAST_OFFSET = 1e-5  # m, as a unit of where the tool stands
_DOUBTFUL_START = (
    "it goes on from an estimate whose data are not what they were taken for, so that nothing counts as known; begin anew without that one"
)
_DRAWS = 200  # from the posterior, for places at the edge of an inclusion


@dataclass(frozen=True)
class Estimate:
    """One number and how well it is known.

    Args:
        name: Of it.
        unit: Of it.
        estimate: Median.
        low: Lower end of its interval.
        high: Upper end.
        told: ``known``, ``ratio only``, or ``not told by these data``.
        removed: Share of the variance before any data that the data took away; of the logarithm, or logit.
    """

    name: str
    unit: str
    estimate: float
    low: float
    high: float
    told: Told
    removed: float


@dataclass(frozen=True)
class Identification:
    """What is known of the tissue.

    Args:
        unknowns: The numbers that were asked for.
        findings: What was noticed in the data, a sentence each.
        young_modulus: Of each control node [M], Pa; median.
        low: Lower end of its interval [M].
        high: Upper end [M].
        known: Whether it is known [M], bool.
        removed: Share of its variance that the data took away [M]; of a field, of the variance that places have beside the whole.
        mean: Of the unknowns and the five others [P + 5], standard normal before any data.
        covariance: Of these [P + 5, P + 5].
        parameters: What the numbers mean.
        nodes: Of the tissue.
        level: Probability that an interval holds the truth.
        chi_square: Of the residuals, over their number: about 1 where the model explains them.
        steps: That were simulated, of all copies together.
        felt: Whether any force was measured, here or in what it goes on from.
        sure: Probability that there is an inclusion, and about where it was found; None where none was looked for.
        doubts: Those of the findings that say that the data are not what they are taken for; where there are any, nothing is known.
        odd: Numbers of the experiments that contradict the others, or what was known before.
        even: Of a field, how likely tissue is that is alike everywhere; places are told only where it is far less likely.
    """

    unknowns: list[Estimate]
    findings: list[str]
    young_modulus: np.ndarray
    low: np.ndarray
    high: np.ndarray
    known: np.ndarray
    removed: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    parameters: Unknowns = field(repr=False)
    nodes: ControlNodes = field(repr=False)
    level: float
    chi_square: float
    steps: int
    felt: bool
    sure: float | None = None
    doubts: list[str] = field(default_factory=list)
    odd: tuple[int, ...] = ()
    even: Even | None = field(default=None, repr=False)

    def __getitem__(self, name: str) -> Estimate:
        """The estimate of this name."""
        for each in self.unknowns:
            if each.name == name:
                return each
        raise KeyError(f"there is no unknown {name!r}, but {', '.join(each.name for each in self.unknowns)}")

    @property
    def tip_offset(self) -> np.ndarray:
        """How far the tool stands from where it is said to [3], m, world."""
        return self.mean[-NUISANCES : 3 - NUISANCES] * self.parameters.config.tip_offset

    @property
    def tells_inclusion(self) -> bool:
        """Whether an inclusion is likely, and its radius or its ratio is known; else the map has none."""
        return _tells_inclusion(self.unknowns, self.sure)

    @property
    def any_known(self) -> bool:
        """Whether any modulus is known, of a place or of the whole; else only ratios are."""
        return bool(self.known.any()) or any(each.name.startswith(MODULUS) and each.told == "known" for each in self.unknowns)

    def regions(self, step: float = 0.2, most: int = 300) -> tuple[str, ...]:
        """The map as `regions` of physics, see `paint_as_regions`."""
        return paint_as_regions(self.nodes, self.young_modulus, step, most)

    def summary(self) -> str:
        """What is known, in lines that people read."""
        lines = []
        for each in self.unknowns:
            unit = f" {each.unit}" if each.unit else ""
            lines.append(
                f"{each.name}: {each.estimate:.4g}{unit} ({100 * self.level:.0f} %: {each.low:.4g} to {each.high:.4g}{unit}), {each.told}"
            )
        if len(np.unique(self.young_modulus)) > 1:
            lines.append(
                f"young_modulus of {len(self.known)} control nodes: {self.young_modulus.min():.4g} to {self.young_modulus.max():.4g} Pa,"
                f" known of {int(self.known.sum())}"
            )
        return "\n".join([*lines, *self.findings])


def identify(
    experiments: Sequence[Experiment],
    nodes: ControlNodes,
    physics: PhysicsConfig,
    config: IdentificationConfig = IdentificationConfig(),
    device: str = "auto",
    progress: OnProgress | None = None,
    *,
    around: np.ndarray | None = None,
    start: Identification | None = None,
    finer: ControlNodes | None = None,
) -> Identification:
    """Estimate what tissue is made of from how it answered a tool.

    Args:
        experiments: What was done and measured, each beginning with tissue at rest.
        nodes: The tissue at rest.
        physics: What it is as far as it is known; its values are the medians of the priors.
        config: What is unknown.
        device: Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N.
        progress: Called as ``progress(stage, done, total)``.
        around: Places [K, 3], m, world, near which a field is unknown; default: where tools of the experiments touch.
        start: An estimate from other experiments that this one goes on from: what they told is the prior, with the unknowns and the
            configuration that they had. Give that one `around` where tools will touch later. Nothing is known by an estimate that goes on
            from one with `doubts`.
        finer: The same tissue of more control nodes, if any: forces are those of this one, how they change with the unknowns is told by
            `nodes`, and how far both differ tells how wrong the finer one still is.

    Raises:
        IdentificationError: If nothing can be estimated from the data; the sentence says what was seen.
        ConfigError: If an unknown does not exist, `start` is of other tissue, or an inclusion is to be found with `start`.
    """
    progress = progress or (lambda stage, done, total: None)
    experiments = list(experiments)
    config = replace(config, tip_offset=max(config.tip_offset, _LEAST_OFFSET))
    check_input(experiments, len(nodes))
    data = [Observations(each, config.tip_smoothing) for each in experiments]
    if start is not None:
        unknowns, config = start.parameters, start.parameters.config
        if replace(unknowns.physics, device=physics.device) != physics or len(unknowns.nodes) != len(nodes):
            raise ConfigError("start is an estimate of other tissue: give it the nodes and the physics that it was made with")
        if unknowns.ball is not None:
            raise ConfigError("stiffness: inclusion needs all experiments together: give them at once, without start")
    else:
        unknowns = Unknowns(nodes, physics, config, touched_places(experiments, nodes, physics) if around is None else around)
    model = ForwardModel(nodes, physics, device, finer)
    progress("look at the data", 0, config.iterations)
    size = unknowns.count + NUISANCES
    prior = Prior(np.zeros(size), np.eye(size)) if start is None else Prior(start.mean, np.linalg.inv(start.covariance))
    plain = prior.mean.copy()
    if unknowns.ball is not None:
        plain[BALL] = unknowns.ball.absent()
    first = survey(data, model, unknowns, plain, None if start is None else start.covariance)
    if not any(each.used.any() for each in data):
        raise IdentificationError("nothing was measured: forces, displacements and tracks are all missing; give one of them")
    fitter = Fitter(model, unknowns, first, progress)
    theta = fitter.begin(prior.mean, *first.near) if start is None else prior.mean.copy()
    parts = [Data(each, *unknowns.directions(touched_places([each.experiment], nodes, physics))) for each in data]
    for part in parts:
        learn_errors(part.seen, model, unknowns, theta)
    sure, rests = None, []
    if unknowns.ball is not None:
        progress("look for the inclusion", 0, config.iterations)
        theta, sure, rests = _locate(theta, prior, parts, model, unknowns)
    model.replan()
    fit, feels = fitter.fit(theta, prior, dict(enumerate(parts))), any(each.of_forces()[each.used].any() for each in data)
    if learn_followed(fit.point, parts):
        fit = fitter.fit(fit.point.theta, prior, dict(enumerate(parts)))
    maybe: Explanations = [(0.0, fit.point)]
    if not first.doubts and feels:  # else what follows from these would be told as well
        fit, maybe = fitter.explain(fit, start is not None)
    even = None
    if len(unknowns.centres):
        even, alike = fitter.even(fit, None if start is None else start.even)
        maybe += alike
        if even.gain < -LIKELIER:  # a field that does not settle matters no more
            fit = replace(fit, settled=even.settled, falls=even.falls)
    if not first.doubts:
        doubts, findings = fitter.tell(fit, _mixed(maybe)[0], start is not None)
        first.doubts.extend(doubts)
        first.findings.extend(findings)
    if start is not None and start.doubts:
        first.doubts.append(_DOUBTFUL_START)
    felt = feels or (start is not None and start.felt)
    found = replace(_conclude(maybe, unknowns, first, felt, sure, model.steps), odd=fit.contradict(start is not None), even=even)
    if unknowns.ball is None:
        return replace(found, findings=[*different_places(found), *found.findings]) if even is not None and even.differs else found
    if not found.tells_inclusion:
        sizes = ", ".join(f"its {name} is {found[f'inclusion_{name}'].told}" for name in ("radius", "ratio"))
        why = f"the likeliest one has a probability of {sure or 0.0:.2f}, {sizes}"
        whole = identify(experiments, nodes, physics, replace(config, stiffness="uniform"), device, progress, finer=finer)
        rest = replace(whole.unknowns[0], name=found.unknowns[0].name)
        shown = ("young_modulus", "low", "high", "known", "removed", "chi_square", "doubts")
        return replace(
            found,
            unknowns=[rest, *(replace(each, told=NOT_TOLD) if whole.doubts else each for each in found.unknowns[1:])],
            findings=[f"no inclusion is told, so that the map is that of tissue without one: {why}", *whole.findings],
            steps=found.steps + whole.steps,
            **{name: getattr(whole, name) for name in shown},
        )
    x, y, z = centre = unknowns.ball.shape(found.mean[1 : 1 + BALL])[0]
    there = f"the middle of the inclusion is at {x:.4f} {y:.4f} {z:.4f} m, with a probability of {sure:.2f}"
    aside = unknowns.ball.aside(centre, touched_places(experiments, nodes, physics))
    if aside > (physics.contact_radius or physics.force_radius):
        rests = [f"all presses are to one side of it, the nearest {1e3 * aside:.0f} mm away: it is less sure; press around it", *rests]
    return replace(found, findings=[there, *rests, *found.findings])


def identify_most(
    experiments: Sequence[Experiment], estimate: Callable[[Sequence[Experiment]], Identification]
) -> tuple[Identification, tuple[int, ...]] | None:
    """An estimate, without doubts, from the most experiments that agree with one another, and the numbers of the others, which contradict
    these; None where there is no such one.

    Args:
        experiments: All that there are.
        estimate: `identify` of some of them.
    """
    whole = estimate(experiments)
    if not whole.doubts:
        return whole, ()
    if not whole.odd or 2 * len(whole.odd) >= len(experiments):
        return None
    found = estimate([each for number, each in enumerate(experiments) if number not in whole.odd])
    return None if found.doubts else (found, whole.odd)


def touched_places(experiments: Sequence[Experiment], nodes: ControlNodes, physics: PhysicsConfig) -> np.ndarray:
    """Places of the tip while it may touch tissue [K, 3], m, world."""
    reach, places = reach_of(physics, nodes), [np.zeros((0, 3))]
    for each in experiments:
        places.append(each.tips[distances_to_skin(each, nodes) <= reach])
    return np.concatenate(places)


def _locate(
    theta: np.ndarray, prior: Prior, data: list[Data], model: ForwardModel, unknowns: Unknowns
) -> tuple[np.ndarray, float, list[str]]:
    """θ with the ball at the place that explains the data best, the probability that there is one thereabouts, and a sentence where that
    place rests on how wrong the skin may be."""
    assert unknowns.ball is not None
    theta = theta.copy()
    theta[BALL] = unknowns.ball.absent()
    point = look(theta, prior, data, model, unknowns)
    touched = [touched_places([part.seen.experiment], model.nodes, model.physics) for part in data]
    places = Places(unknowns, np.concatenate(touched))
    scan, exact = (Scan.empty(len(theta), len(places.z)) for _ in range(2))
    jacobians = without_ball(point.jacobians)
    for part, at, r, J, R, (by_tip, own) in zip(data, touched, point.residuals, jacobians, point.covariances, point.errors):
        adds = added(part.seen, model, unknowns, places, theta, at)
        scan.add(r, J, R, adds)
        exact.add(r, J, part.seen.covariance(by_tip, own[:, 3:]), adds)  # the first three are the place of the skin
    probable, otherwise = (weights(each.costs(), places) for each in (scan, exact))
    best, other = (int(each[:-1].argmax()) for each in (probable, otherwise))
    apart = np.sqrt(((places.centres - places.centres[best]) ** 2).sum(1))
    here = apart <= 2 * unknowns.config.inclusion_radius
    theta[1 : 1 + BALL] = places.z[best, 1 : 1 + BALL]
    return theta, float(probable[:-1][here].sum()), _elsewhere(places.centres[other]) if apart[other] > 0 and otherwise[-1] < 0.5 else []


def _elsewhere(centre: np.ndarray) -> list[str]:
    x, y, z = centre
    return [
        f"if the skin is where the model has it, with surface_error 0, the inclusion would rather be at {x:.4f} {y:.4f} {z:.4f} m: these"
        " presses do not tell the two apart; press closer together than the tool is wide"
    ]


def _conclude(maybe: Explanations, unknowns: Unknowns, first: Survey, felt: bool, sure: float | None, steps: int) -> Identification:
    """What is known at the end by explanations that are about as likely: numbers, the map, and findings beside those of the first look."""
    config, (_, point) = unknowns.config, max(maybe, key=lambda each: each[0])
    H, _ = normal(point)
    chi_square, precision = misfit(point.residuals, point.covariances), point.prior.precision
    determined = float(np.trace(np.linalg.solve(H + precision, H)))
    count = sum(len(r) for r in point.residuals)
    factor, unexplained = judge_residuals(chi_square, round(count - determined), config)
    theta, covariance = _mixed(maybe, factor)
    quantile = float(norm.ppf(0.5 + config.level / 2))
    told = [_estimate(each, theta, covariance, quantile, felt, unknowns) for each in unknowns.reported()]
    unsure = [each.name for each in told if each.told == NOT_TOLD]
    doubts = first.doubts or unexplained
    if doubts:
        told = [replace(each, told=NOT_TOLD) for each in told]
    painted = _paint(theta, covariance, unknowns, _tells_inclusion(told, sure))
    middle, spread = np.log(unknowns.base) + np.clip(painted.logs, -MOST_LOG, MOST_LOG), quantile * np.sqrt(painted.variance)
    findings = [*doubts, *first.findings]
    if unsure:
        findings.append(f"these data do not tell {', '.join(unsure)}: the interval rests on what was thought before")
    if point.undone:
        findings.append(f"the simulation had to undo {point.undone} steps: the tool takes tissue farther than it bears")
    findings += _far(theta, unknowns)
    if np.abs(painted.logs).max() > MOST_LOG:
        findings.append(
            "moduli of more than 50 times that of physics, or less than a fiftieth, are not simulated: give physics a nearer one"
        )
    known = (painted.removed >= config.known) & (felt and not doubts)
    return Identification(
        told, findings, np.exp(middle), np.exp(middle - spread), np.exp(middle + spread), known, painted.removed, theta, covariance,
        unknowns, unknowns.nodes, config.level, chi_square / max(count - determined, 1), steps, felt, sure, doubts,
    )  # fmt: skip


def _mixed(maybe: Explanations, factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Mean [Q] and covariance [Q, Q] of θ by explanations of some probabilities, where variances of residuals are a factor greater."""
    gains = np.array([gain for gain, _ in maybe])
    weights = np.exp((gains - gains.max()) / 2)
    weights /= weights.sum()
    mean = np.sum([weight * each.theta for weight, (_, each) in zip(weights, maybe)], axis=0)
    covariance = np.zeros((len(mean), len(mean)))
    for weight, (_, each) in zip(weights, maybe):
        own = np.linalg.inv(normal(each)[0] / factor + each.prior.precision)
        covariance += weight * (own + np.outer(each.theta - mean, each.theta - mean))
    return mean, covariance


class _Painted(NamedTuple):
    """The factor on the modulus of each control node, all [M]."""

    logs: np.ndarray  # its logarithm
    variance: np.ndarray  # of that
    removed: np.ndarray  # as in `Identification`


def _paint(theta: np.ndarray, covariance: np.ndarray, unknowns: Unknowns, inclusion: bool) -> _Painted:
    """The map that θ [Q] and its covariance make, with the ball, if any, only where an inclusion is told."""
    config, z = unknowns.config, theta[: unknowns.count]
    matrix = np.concatenate([unknowns.tangent(z), np.zeros((len(unknowns.nodes), NUISANCES))], 1)
    logs = unknowns.logs(z)
    if unknowns.ball is not None and not inclusion:
        matrix[:, 1 : 1 + BALL] = 0
        logs = matrix @ theta
    prior = (matrix**2).sum(1) + unknowns.residual
    left = np.einsum("mi,ij,mj->m", matrix, covariance, matrix) + unknowns.residual
    if len(unknowns.centres):
        prior -= config.spread**2
        left += (config.smooth_error * unknowns.beside(z)) ** 2
    elif unknowns.ball is not None and inclusion:
        prior[:] = config.field_spread**2  # by which a place may differ from the rest
        draws = np.random.default_rng(0).multivariate_normal(theta, covariance, _DRAWS)[:, : unknowns.count]
        left = np.mean([(unknowns.logs(each) - logs) ** 2 for each in draws], axis=0)  # its edge is too sharp for derivatives
        ball = theta[1 : 1 + BALL]
        left += unknowns.ball.logs(ball) * (unknowns.ball.shape(ball)[2] - unknowns.ball.logs(ball))  # there a node is in it or not
        left += unknowns.residual  # no tool felt that
    return _Painted(logs, left, np.maximum(1 - left / prior, 0))


def _tells_inclusion(told: Sequence[Estimate], sure: float | None) -> bool:
    """Whether an inclusion is likelier than none, and its radius or its ratio is known."""
    sizes = [each for each in told if each.name in ("inclusion_radius", "inclusion_ratio")]
    return sure is not None and sure >= AGREED and any(each.told == "known" for each in sizes)


def _far(theta: np.ndarray, unknowns: Unknowns) -> list[str]:
    """Which numbers are far from what was thought of them, in a sentence each."""
    told = []
    for each in unknowns.reported():
        off = float(each.row @ theta[: len(each.row)]) / max(float(np.linalg.norm(each.row)), 1e-12)
        if abs(off) > _FAR:
            told.append(
                f"{each.name} lies {abs(off):.1f} standard deviations {'above' if off > 0 else 'below'} what was thought: check the"
                " units of forces and lengths, or give physics a likelier value"
            )
    return told


def _estimate(reported: Reported, theta: np.ndarray, covariance: np.ndarray, quantile: float, feels: bool, unknowns: Unknowns) -> Estimate:
    config = unknowns.config
    row = np.concatenate([reported.row, np.zeros(NUISANCES)])
    middle, variance, prior = row @ theta + reported.mean, row @ covariance @ row, row @ row
    removed = 1 - variance / prior
    told: Told = "known" if removed >= config.known else NOT_TOLD
    if reported.is_modulus and not feels:
        # How it differs from the mean of all moduli.
        stiffness = unknowns.tangent(theta[: unknowns.count])[:, : unknowns.stiffness_count].mean(0)
        ratio = row.copy()
        ratio[: unknowns.stiffness_count] -= stiffness
        alone = ratio @ ratio
        share = 1 - ratio @ covariance @ ratio / alone if alone > 1e-12 else 0.0
        told = "ratio only" if share >= config.known else NOT_TOLD
    spread = quantile * np.sqrt(variance)
    estimate, low, high = (float(reported.value(middle + side * spread)) for side in (0, -1, 1))
    return Estimate(reported.name, reported.unit, estimate, low, high, told, float(removed))


def predicted_at(
    theta: np.ndarray, candidates: Sequence[Experiment], model: ForwardModel, unknowns: Unknowns
) -> tuple[list[Observations], Point]:
    """Experiments as if forces of zero had been measured in them, and what these look like from θ [Q]."""
    seen = [Observations(replace(each, forces=np.zeros(each.tips.shape)), unknowns.config.tip_smoothing) for each in candidates]
    parts = [Data(each, *unknowns.directions(touched_places([each.experiment], model.nodes, model.physics))) for each in seen]
    return seen, look(theta, Prior(np.zeros(len(theta)), np.eye(len(theta))), parts, model, unknowns)


def predict_as_measured(
    found: Identification, candidates: Sequence[Experiment], model: ForwardModel
) -> list[tuple[np.ndarray, Covariance]]:
    """Jacobian [n, P + 5] and covariance of the forces that each experiment would measure of tissue as it was estimated."""
    _, point = predicted_at(found.mean, candidates, model, found.parameters)
    return list(zip(point.jacobians, point.covariances))


def excess_force(found: Identification, experiments: Sequence[Experiment], finer: ControlNodes) -> float:
    """By what share forces of the tissue as it was estimated are greater than those of the same tissue of more control nodes, in the
    experiment with the greatest forces; 0 where none was measured.

    Args:
        found: The estimate.
        experiments: That it was made from.
        finer: The same tissue of more control nodes.
    """
    parameters, config = found.parameters, found.parameters.config
    sizes = [float(np.nanmax(np.linalg.norm(each.forces, axis=1), initial=0.0)) for each in experiments]
    deepest = Observations(experiments[int(np.argmax(sizes))], config.tip_smoothing).experiment
    model = ForwardModel(found.nodes, parameters.physics, parameters.physics.device, finer)
    replay = model.replay(deepest, [parameters.copy(found.mean[: parameters.count], found.tip_offset)], 1)
    fine = replay.forces[0]
    squares = float((fine**2).sum())
    return -float((replay.change * fine).sum()) / squares if max(sizes) and squares else 0.0
