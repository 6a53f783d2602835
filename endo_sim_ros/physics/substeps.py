"""Division of a step into substeps that the material and the grid allow."""

import math
from dataclasses import dataclass

import numpy as np

from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.materials import MATERIALS, Stiffening, sound_speed
from endo_sim_ros.physics.regions import TissueProperties

CFL_LIMIT = 0.7  # c Δt / h; measured: 0.7 runs, 0.9 blows up
MAX_SUBSTEPS = 100_000  # beyond it a step of the default tissue takes a minute


class StabilityError(ValueError):
    """Substeps that are too long for the material; the message names the numbers and what would work."""


@dataclass(frozen=True)
class Substepping:
    """How one step is divided."""

    count: int
    dt: float  # s
    cfl: float  # c Δt / h


def plan_substeps(config: PhysicsConfig, cell_size: float, properties: TissueProperties | None = None, factor: float = 1.0) -> Substepping:
    """Divide a step of ``step_duration`` into ``substeps``, or with 0 into as few as keep the Courant number c Δt/h safe.

    Args:
        config: Material, duration of a step and number of substeps.
        cell_size: Grid cell size h, metres.
        properties: Of each control node; default: those of the config everywhere.
        factor: Largest factor on all moduli.

    Raises:
        StabilityError: If the substeps asked for are too long, or there would have to be too many of them.
    """
    if properties is None:
        properties = TissueProperties.uniform(1, config.young_modulus, config.poisson_ratio, config.density)
    # A wave faster than the relaxation meets the elastic law and the Maxwell branch.
    young = factor * (1 + config.relaxation) * properties.young_modulus
    stiffened = MATERIALS[config.material].tangent(Stiffening(config.stiffening, config.stiffening_limit))
    limits = np.array([sound_speed(*each, stiffened) for each in zip(young, properties.poisson_ratio, properties.density)])
    worst = int(limits.argmax())
    limit = float(limits[worst])
    count = config.substeps or max(math.ceil(config.step_duration * limit / (config.courant_number * cell_size)), 1)
    dt = config.step_duration / count
    cfl = limit * dt / cell_size
    if cfl > CFL_LIMIT or count > MAX_SUBSTEPS:
        fitting = math.ceil(count * cfl / CFL_LIMIT)
        fit = f"set substeps to {fitting}{' or to 0, as few as are safe' * bool(config.substeps)}, or use a softer material"
        if fitting > MAX_SUBSTEPS:
            largest = young[worst] / (1 + config.relaxation) * (MAX_SUBSTEPS * config.courant_number / (count * cfl)) ** 2
            fit = f"use young_modulus {0.99 * largest:.3g} Pa or less with substeps 0, or a shorter step_duration"
        raise StabilityError(
            f"young_modulus {young[worst] / (1 + config.relaxation):g} Pa, poisson_ratio {properties.poisson_ratio[worst]:g}"
            + f", relaxation {config.relaxation:g}" * (config.relaxation > 0)
            + f", stiffening_limit {config.stiffening_limit:g}" * (stiffened > 1)
            + f" and density {properties.density[worst]:g} kg/m³ on a grid of {cell_size:.3g} m give a Courant number of"
            f" {cfl:.2f} with {count} substeps of {dt:.3g} s (limits {CFL_LIMIT} and {MAX_SUBSTEPS}); {fit}"
        )
    return Substepping(count, dt, cfl)
