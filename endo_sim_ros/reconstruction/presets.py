"""Named methods as options of the one trainer, and what each is made of.

A preset is the set of options in which it differs from the defaults; `default` is the best we know.
"""

from typing import Any, Literal

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.reconstruction.config import ReconstructionConfig

Preset = Literal["default", "laptop", "paper", "fsgs", "3dgs"]

_PLAIN = {  # 3DGS as Kerbl et al. 2023 have it, and what the others build upon
    "iterations": 3000, "max_gaussians": 60_000,
    "virtual_every": 1,
    "initialization": "points", "densification": "gradient", "exposure": False, "light": False,
    "learning_rate": 1.0, "lambda_flat": 0.0, "lambda_opaque": 0.0,
    "lambda_opacity": 0.0, "lambda_scale": 0.0,
    "multi_view_refinement": False, "extrapolation": 0.0, "dynamic_mask": False,
}  # fmt: skip

PRESETS: dict[Preset, dict[str, Any]] = {
    "default": {},
    # The same in a minute or two on a CPU.
    "laptop": {"image_width": 320, "iterations": 600, "learning_rate": 0.3, "max_gaussians": 15_000, "refine_every": 50},
    # As printed (Yang): triangulated points, L1 depth, distortion and total variation, virtual cameras. Its weights are not
    # printed, but adjusted to the scene: these of 19 tried have the most PSNR on average of four scenes.
    "paper": _PLAIN | {"lambda_depth": 0.3, "lambda_dist": 0.01, "lambda_tv": 0.003},
    # Zhu et al. 2024: correlation with the depth prior, in pseudo-views too, and new Gaussians between those that lie alone.
    "fsgs": _PLAIN | {"densification": "proximity", "lambda_pearson": 0.05, "lambda_depth": 0.0},
    # Colour alone.
    "3dgs": _PLAIN | {"lambda_depth": 0.0, "virtual_every": 0},
}

ABLATIONS: dict[Preset, dict[str, dict[str, Any]]] = {
    "paper": {
        "without virtual cameras": {"virtual_every": 0},
        "without frequency": {"sh_degree": 3},
        "without distortion": {"lambda_dist": 0.0},
        "without total variation": {"lambda_tv": 0.0},
        "without depth": {"lambda_depth": 0.0},
    },
    "default": {
        "with distortion": {"lambda_dist": 0.03},
        "with total variation": {"lambda_tv": 0.1},
        "with total variation, virtual cameras too": {"lambda_tv": 0.1, "virtual_every": 1},
        "without depth": {"lambda_depth": 0.0},
        "with composited depth": {"lambda_opaque": 0.0},
        "without dense initialisation": {"initialization": "points"},
        "without multi-view refinement": {"multi_view_refinement": False},
        "without flat Gaussians": {"lambda_flat": 0.0},
        "without opacity and size": {"lambda_opacity": 0.0, "lambda_scale": 0.0},
        "without light": {"light": False},
        "without light and exposure": {"light": False, "exposure": False},
        "without extrapolation": {"extrapolation": 0.0},
        "without dynamic mask": {"dynamic_mask": False},
        "without Markov chain": {"densification": "gradient"},
    },
}
"""Of each preset, the options without one of its parts at a time, by name."""


def preset(name: str, **given: Any) -> ReconstructionConfig:
    """The options of a preset: those given, else those of the preset, else the defaults.

    Args:
        name: Name of the preset, a key of `PRESETS`.
        given: Options by name, whatever their values; those of a nested stage are dotted, ``**{"stage.option": value}``.

    Raises:
        ConfigError: If there is no such preset or option, or a value is out of range.
    """
    if name not in PRESETS:
        raise ConfigError(f"preset must be one of {', '.join(PRESETS)}, got {name!r}")
    return ReconstructionConfig.from_mapping(PRESETS[name] | given)
