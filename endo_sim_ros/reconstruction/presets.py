"""Named methods as options of the one trainer, and what each is made of.

A preset is the set of options in which it differs from the defaults; `default` is the best we know.
"""

from typing import Any, Literal

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.reconstruction.config import ReconstructionConfig

Preset = Literal["default", "laptop", "paper", "fsgs", "3dgs", "fsgs-sh0", "3dgs-sh0"]

_PLAIN = {  # points, colours and nothing else, with the densification of AbsGS: what the others build upon
    "keyframes": 8, "iterations": 3000, "max_gaussians": 60_000,
    "virtual_every": 1,
    "initialization": "points", "densification": "gradient", "exposure": False, "light": False,
    "learning_rate": 1.0, "lambda_opaque": 0.0,
    "lambda_opacity": 0.0, "lambda_scale": 0.0, "dropout": 0.0, "hidden_below": 0.0,
    "watch_motion": False, "plane_sweep": False, "multi_view_refinement": False, "extrapolation": 0.0, "dynamic_mask": False,
    "reflections": False, "tilted.every": 0, "lens.correct": False, "poses.correct": False,
}  # fmt: skip

_PUBLISHED = _PLAIN | {  # what the code of 3DGS and that of FSGS, which builds upon it, have alike. Opacities learn by 0.05, as in both;
    # 3DGS halved that later. Neither limits the size of Gaussians, nor their number: a million only guards the memory. Their cameras stand
    # around the scene, so that the extent of those is its depth; an endoscope's move by little, and `unit` is the depth here.
    "sh_degree": 3, "max_gaussians": 1_000_000, "largest": 100.0, "refine_from": 500, "initial.opacity": 0.1,
    "rates.log_scales": 5e-3, "rates.sh_base": 2.5e-3, "lambda_depth": 0.0,
}  # fmt: skip

PRESETS: dict[Preset, dict[str, Any]] = {
    "default": {},
    # The same in a minute or two on a CPU.
    "laptop": {
        "keyframes": 8, "image_width": 320, "iterations": 600, "learning_rate": 0.3, "max_gaussians": 15_000, "refine_every": 50,
        "dropout": 0.0,  # so short a training memorises nothing
        "rates.gloss": 8e-2, "rates.gloss_decay": 1.0,  # nor does it find films if they learn more slowly than those of `default`
    },  # fmt: skip
    # As printed (Yang): points of structure from motion, L1 depth of a network, distortion and total variation, virtual cameras.
    # Its weights are not printed, but adjusted to the scene: these of 19 tried have the most PSNR on average of four scenes.
    "paper": _PLAIN | {"depth": "network_first", "lambda_depth": 0.3, "unmeasured_depth": 1.0, "lambda_dist": 0.01, "lambda_tv": 0.003},
    # Zhu et al. 2024: correlation with the depth prior, in pseudo-views too, and new Gaussians between those that lie alone. With
    # pseudo-views as often as it has them for three views (LLFF).
    "fsgs": _PUBLISHED | {
        "iterations": 10_000, "schedule": 10_000, "refine_until": 0.999, "sh_every": 500,
        "depth": "network_first", "lambda_pearson": 0.05, "virtual_every": 1, "virtual_from": 2000, "virtual_weight": 10.0,
        "densification": "proximity", "proximity.absolute": False, "proximity.threshold": 5e-4, "proximity.unpool_until": 2000,
        "proximity.reset_every": 3000, "proximity.reset_first": 2001, "proximity.reset_to": 0.05,
    },
    # Kerbl et al. 2023: colour alone. Trained as long as "3DGS-7K" of their paper, by the plan for their 30 000 iterations: new
    # Gaussians come before the 15 000th.
    "3dgs": _PUBLISHED | {
        "iterations": 7000, "schedule": 30_000, "refine_until": 0.499, "sh_every": 1000, "virtual_every": 0,
        "gradient.absolute": False, "gradient.threshold": 2e-4, "gradient.reset_every": 3000, "gradient.oversize": 0.1,
    },
    # Their ideas in the paper's frame, one colour for all directions and 3000 iterations: what the paper adds to them.
    "fsgs-sh0": _PLAIN | {"densification": "proximity", "lambda_pearson": 0.05, "lambda_depth": 0.0},
    "3dgs-sh0": _PLAIN | {"lambda_depth": 0.0, "virtual_every": 0},
}  # fmt: skip

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
        "with total variation, virtual cameras too": {"lambda_tv": 0.1, "virtual_every": 1, "tilted.every": 0},
        "without depth": {"lambda_depth": 0.0},
        "with composited depth": {"lambda_opaque": 0.0},
        "without dense initialisation": {"initialization": "points"},
        "without reflections": {"reflections": False},
        "without calibrating the lens": {"lens.correct": False},
        "without corrected poses": {"poses.correct": False},
        "without plane sweep": {"plane_sweep": False},
        "without multi-view refinement": {"multi_view_refinement": False},
        "without opacity and size": {"lambda_opacity": 0.0, "lambda_scale": 0.0},
        "without tilted cameras": {"tilted.every": 0},
        "without dropout": {"dropout": 0.0},
        "without tone curve": {"photometry.shoulder": 0.0},
        "without light": {"light": False},
        "without light and exposure": {"light": False, "exposure": False},
        "without extrapolation": {"extrapolation": 0.0},
        "without depth from brightness": {"extrapolated.brightness_ratio": 0.0},
        "without capacity trial": {"capacity.iterations": 0},
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
