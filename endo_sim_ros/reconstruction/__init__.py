"""From sparse posed views to a Gaussian model: `reconstruct`, or `prepare` and `Trainer`."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.reconstruction.config import ReconstructionConfig
    from endo_sim_ros.reconstruction.keyframes import select_keyframes
    from endo_sim_ros.reconstruction.pipeline import prepare, reconstruct
    from endo_sim_ros.reconstruction.presets import ABLATIONS, PRESETS, preset
    from endo_sim_ros.reconstruction.progress import Cancelled, OnProgress
    from endo_sim_ros.reconstruction.scene import PreparedScene, ScenePoints, TrainingView, shrink
    from endo_sim_ros.reconstruction.trainer import Progress, Trainer
    from endo_sim_ros.reconstruction.triangulation import scene_points

__getattr__ = lazy_names(__name__, __file__)
