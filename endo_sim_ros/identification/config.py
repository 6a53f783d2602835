"""Options of identification."""

from dataclasses import dataclass
from typing import Annotated, Literal

from endo_sim_ros.core.config import Range, StageConfig


@dataclass(frozen=True)
class IdentificationConfig(StageConfig):
    """What is unknown of tissue, what was known before, and how it is estimated."""

    stiffness: Literal["uniform", "regions", "field", "inclusion"] = "uniform"
    """What is unknown of the stiffness: one modulus, one of each of the `regions` of physics and one of the rest, a smooth field, or one
    modulus and a ball of another one: its place, depth, radius and ratio."""
    unknowns: tuple[str, ...] = ()
    """What else is unknown: poisson_ratio, damping, friction, relaxation, relaxation_time or stiffening of physics, hold_back and
    hold_rim (how firmly the deepest layer and the rim are held)."""
    spread: Annotated[float, Range(0.05, 3.0)] = 1.0
    """Standard deviation of the logarithm of a modulus before any data; published moduli of one organ differ by factors of two to four."""
    field_spread: Annotated[float, Range(0.05, 3.0)] = 0.8
    """The same of a field, by how much one place differs from the whole: inclusions are two to ten times as stiff as tissue around."""
    field_length: Annotated[float, Range(1e-3, 0.2, "m")] = 0.01
    """Distance at which two places of a field have nearly lost each other: about the size of what is looked for."""
    field_reach: Annotated[float, Range(1e-3, 1.0, "m")] = 0.025
    """The field is unknown within this distance of the way of a tool, beyond it all tissue is alike: it is not felt from farther."""
    inclusion_radius: Annotated[float, Range(5e-4, 0.1, "m")] = 0.006
    """Radius of an inclusion before any data, its median; half of them are within a factor of 1.4."""
    inclusion_ratio: Annotated[float, Range(0.02, 50.0)] = 4.0
    """The same of how many times as stiff as the tissue around it is; its logarithm has the standard deviation `field_spread`."""
    level: Annotated[float, Range(0.5, 0.999)] = 0.9
    """Probability that an interval holds the truth."""
    known: Annotated[float, Range(0.1, 0.999)] = 0.75
    """Share of the variance before any data that the data must take away for an unknown to count as known: 0.75 halves the interval. Of a
    place in a field it is that of `field_spread`, as what is known of the whole is not known of a place."""
    tip_offset: Annotated[float, Range(0.0, 0.02, "m")] = 0.0005
    """Standard deviation of a coordinate of the error that all tips share, of the registration of the tool; the errors of single tips,
    which are independent, are the `tip_noise` of the experiment."""
    tool_aside: Annotated[float, Range(1e-4, 0.02, "m")] = 0.003
    """The same where the registration is wrong, as by a wrong scale of the model, which is compared with that it is right: 3 % of 100 mm.
    Give how far it may be off then."""
    tip_smoothing: Annotated[float, Range(0.0, 1.0, "s")] = 0.12
    """Standard deviation, at most, of the Gaussian in time that weights the parabolas by which tips are smoothed before they are replayed:
    single errors would shake the tissue, but wide ones round off where the tool turns round."""
    model_error: Annotated[float, Range(0.0, 1.0)] = 0.05
    """Standard deviation of the share by which all forces of the model are wrong together, and of that by which those of each experiment
    are: with other control nodes forces of presses differ by 3 to 25 %."""
    surface_error: Annotated[float, Range(0.0, 0.02, "m")] = 0.0005
    """Standard deviation of a coordinate of the error of the place of the skin where an experiment touches it, of the model that was
    reconstructed and of the grid, on which contact begins a part of a cell early."""
    grid_error: Annotated[float, Range(0.0, 2.0)] = 0.5
    """Where finer control nodes correct forces: standard deviation of the share of this correction that is still missing, or too much.
    Errors that fall with the distance between nodes leave as much as the correction where it is halved."""
    smooth_error: Annotated[float, Range(0.0, 2.0)] = 0.6
    """Standard deviation of the share by which a place of a field may differ more, or less, from the whole than was found, in logarithms:
    edges of what is stiff contradict a smooth field, and forces hardly grow with what is much stiffer. With 0.6 intervals of 90 %
    reach from none of that to twice as much."""
    iterations: Annotated[int, Range(1, 100)] = 12
    """Most iterations of Levenberg and Marquardt's method."""
    tolerance: Annotated[float, Range(1e-4, 1.0)] = 0.2
    """It ends when no unknown moves by more than this many of its standard deviations: forces are as rough as that, as skin sticks to a
    tool and slips."""
    jacobian_step: Annotated[float, Range(1e-3, 1.0)] = 0.15
    """Step of the differences of the Jacobian, in standard deviations before any data. With 0.01 the rounding of float32 shows, with 0.5
    the curvature."""
    other_step: Annotated[float, Range(1e-3, 1.0)] = 0.5
    """The same of what is no stiffness, to either side. Forces depend on it less, and are as rough: steps of 0.15 make a Jacobian that is
    half noise, which looks like knowledge."""
    tip_step: Annotated[float, Range(1e-5, 0.01, "m")] = 0.0005
    """Step of the differences for the place of the tip, as large as its errors."""
    doubt: Annotated[float, Range(1e-12, 0.1)] = 1e-4
    """Residuals that noise makes so rarely are told as what the model does not explain."""
    depth_scan: Annotated[float, Range(0.001, 0.03, "m")] = 0.006
    """How far the tool is moved along its press, to and fro, to see at which depth contact would begin as it was measured."""
    most_turned: Annotated[float, Range(5.0, 90.0, "deg")] = 35.0
    """Largest angle between measured forces and those of the model; friction turns them by 10°. Beyond it they are in another frame."""
    most_lag: Annotated[float, Range(0.0, 10.0, "s")] = 0.6
    """Lags of forces behind poses are looked for up to this."""
