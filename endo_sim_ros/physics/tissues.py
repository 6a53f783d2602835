"""Tissues as options of the physics, each with published numbers; docs/physics.md tells their sources.

A tissue is the set of options in which it differs from the defaults. `young_modulus` is that of tissue that has relaxed. Where a source
tells the shear modulus G of fast motion, it is 2 (1 + ν) G / (1 + relaxation).
"""

from typing import Any, Literal

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.physics.config import PhysicsConfig

Tissue = Literal["default", "liver", "gall_bladder", "lung", "fat"]

# Wet tissue keeps its volume: Poisson's ratio is almost 0.5. At 0.45 the grid does not lock.
_WET = {"material": "fung", "poisson_ratio": 0.45}

TISSUES: dict[Tissue, dict[str, Any]] = {
    "default": {},
    # G of fast motion 1.8 kPa, 0.27 MPa at a true strain of 0.38. Relaxes from 2.04 to 0.91 kPa.
    "liver": _WET | {
        "young_modulus": 2.3e3, "density": 1060.0, "stiffening": 9.2, "relaxation": 1.24, "relaxation_time": 1.1,
        "tear_strain": 0.38,
    },
    # The wall: G 85 kPa, 2.5 MPa at a true strain of 0.43.
    "gall_bladder": _WET | {"young_modulus": 250e3, "density": 1060.0, "stiffening": 4.3, "tear_strain": 0.43},
    # Inflated. Stiffening fits the published law for stretches of 0.7 to 1.5; relaxation loses as much of the energy as is published.
    "lung": {
        "material": "fung", "young_modulus": 1.9e3, "poisson_ratio": 0.34, "density": 394.0, "stiffening": 0.5,
        "relaxation": 0.22, "relaxation_time": 0.6,
    },
    # G 750 Pa, which grows as the stretch to the power of -2.36 where fat is pressed.
    "fat": _WET | {"young_modulus": 2.2e3, "density": 911.0, "stiffening": 2.8},
}  # fmt: skip


def tissue(name: str, **given: Any) -> PhysicsConfig:
    """The options of a tissue: those given, else those of the tissue, else the defaults.

    Args:
        name: Name of the tissue, a key of `TISSUES`.
        given: Options by name, whatever their values.

    Raises:
        ConfigError: If there is no such tissue or option, or a value is out of range.
    """
    if name not in TISSUES:
        raise ConfigError(f"tissue must be one of {', '.join(TISSUES)}, got {name!r}")
    return PhysicsConfig.from_mapping(TISSUES[name] | given)
