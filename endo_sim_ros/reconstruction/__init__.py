"""From sparse posed views to a Gaussian model: `reconstruct`, or `prepare` and `Trainer`."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from endo_sim_ros.reconstruction.config import ReconstructionConfig
    from endo_sim_ros.reconstruction.keyframes import select_keyframes
    from endo_sim_ros.reconstruction.pipeline import prepare, reconstruct
    from endo_sim_ros.reconstruction.presets import ABLATIONS, PRESETS, preset
    from endo_sim_ros.reconstruction.progress import Cancelled, OnProgress
    from endo_sim_ros.reconstruction.scene import PreparedScene, ScenePoints, TrainingView, shrink
    from endo_sim_ros.reconstruction.trainer import Progress, Trainer
    from endo_sim_ros.reconstruction.triangulation import scene_points

_MODULES = {
    "config": ["ReconstructionConfig"],
    "keyframes": ["select_keyframes"],
    "pipeline": ["prepare", "reconstruct"],
    "presets": ["ABLATIONS", "PRESETS", "preset"],
    "progress": ["Cancelled", "OnProgress"],
    "scene": ["PreparedScene", "ScenePoints", "TrainingView", "shrink"],
    "trainer": ["Progress", "Trainer"],
    "triangulation": ["scene_points"],
}
__all__ = [
    "ABLATIONS", "PRESETS", "Cancelled", "OnProgress", "PreparedScene", "Progress", "ReconstructionConfig", "ScenePoints", "Trainer",
    "TrainingView", "prepare", "preset", "reconstruct", "scene_points", "select_keyframes", "shrink",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import what is asked for; the options alone need no torch."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
