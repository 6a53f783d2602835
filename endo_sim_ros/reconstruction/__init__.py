"""From sparse posed views to a Gaussian model."""

from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.keyframes import select_keyframes
from endo_sim_ros.reconstruction.presets import ABLATIONS, PRESETS, preset
from endo_sim_ros.reconstruction.trainer import Progress, Trainer, shrink
from endo_sim_ros.reconstruction.triangulation import ScenePoints, scene_points

__all__ = [
    "ABLATIONS", "PRESETS", "Progress", "ReconstructionConfig", "ScenePoints", "Trainer", "preset", "scene_points",
    "select_keyframes", "shrink",
]  # fmt: skip
