"""From sparse posed views to a Gaussian model: `reconstruct`, or `prepare` and `Trainer`."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.reconstruction.config import ReconstructionConfig as ReconstructionConfig
    from endo_sim_ros.reconstruction.keyframes import select_keyframes as select_keyframes
    from endo_sim_ros.reconstruction.pipeline import prepare as prepare
    from endo_sim_ros.reconstruction.pipeline import reconstruct as reconstruct
    from endo_sim_ros.reconstruction.presets import ABLATIONS as ABLATIONS
    from endo_sim_ros.reconstruction.presets import PRESETS as PRESETS
    from endo_sim_ros.reconstruction.presets import preset as preset
    from endo_sim_ros.reconstruction.progress import Cancelled as Cancelled
    from endo_sim_ros.reconstruction.progress import OnProgress as OnProgress
    from endo_sim_ros.reconstruction.scene import PreparedScene as PreparedScene
    from endo_sim_ros.reconstruction.scene import ScenePoints as ScenePoints
    from endo_sim_ros.reconstruction.scene import TrainingView as TrainingView
    from endo_sim_ros.reconstruction.scene import shrink as shrink
    from endo_sim_ros.reconstruction.trainer import Progress as Progress
    from endo_sim_ros.reconstruction.trainer import Trainer as Trainer
    from endo_sim_ros.reconstruction.triangulation import scene_points as scene_points

__getattr__ = lazy_names(
    __name__,
    config=("ReconstructionConfig",),
    keyframes=("select_keyframes",),
    pipeline=("prepare", "reconstruct"),
    presets=("ABLATIONS", "PRESETS", "preset"),
    progress=("Cancelled", "OnProgress"),
    scene=("PreparedScene", "ScenePoints", "TrainingView", "shrink"),
    trainer=("Progress", "Trainer"),
    triangulation=("scene_points",),
)
