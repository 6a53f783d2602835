"""From sparse posed views to a Gaussian model: `reconstruct`, or `prepare` and `Trainer`."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.reconstruction.config import ReconstructionConfig as ReconstructionConfig
    from endo_sim_ros.reconstruction.keyframes import choose_views as choose_views, select_keyframes as select_keyframes
    from endo_sim_ros.reconstruction.motion_watch import MotionWatch as MotionWatch
    from endo_sim_ros.reconstruction.pipeline import prepare as prepare, reconstruct as reconstruct
    from endo_sim_ros.reconstruction.presets import ABLATIONS as ABLATIONS, PRESETS as PRESETS, preset as preset
    from endo_sim_ros.reconstruction.progress import Cancelled as Cancelled, OnProgress as OnProgress
    from endo_sim_ros.reconstruction.scene import (
        PreparedScene as PreparedScene,
        ScenePoints as ScenePoints,
        TrainingView as TrainingView,
        shrink as shrink,
    )
    from endo_sim_ros.reconstruction.trainer import Progress as Progress, Trainer as Trainer
    from endo_sim_ros.reconstruction.triangulation import scene_points as scene_points

__getattr__ = lazy_names(__name__, __file__)
