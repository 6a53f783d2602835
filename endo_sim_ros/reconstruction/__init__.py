"""From sparse posed views to a Gaussian model."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.reconstruction.config import ReconstructionConfig as ReconstructionConfig
    from endo_sim_ros.reconstruction.keyframes import select_keyframes as select_keyframes
    from endo_sim_ros.reconstruction.presets import ABLATIONS as ABLATIONS
    from endo_sim_ros.reconstruction.presets import PRESETS as PRESETS
    from endo_sim_ros.reconstruction.presets import preset as preset
    from endo_sim_ros.reconstruction.trainer import Progress as Progress
    from endo_sim_ros.reconstruction.trainer import Trainer as Trainer
    from endo_sim_ros.reconstruction.trainer import shrink as shrink
    from endo_sim_ros.reconstruction.triangulation import ScenePoints as ScenePoints
    from endo_sim_ros.reconstruction.triangulation import scene_points as scene_points

__getattr__ = lazy_names(
    __name__,
    config=("ReconstructionConfig",),
    keyframes=("select_keyframes",),
    presets=("ABLATIONS", "PRESETS", "preset"),
    trainer=("Progress", "Trainer", "shrink"),
    triangulation=("ScenePoints", "scene_points"),
)
