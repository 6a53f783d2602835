"""From sparse posed views to a Gaussian model."""

from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.keyframes import select_keyframes
from endo_sim_ros.reconstruction.trainer import Progress, Trainer, shrink

__all__ = ["Progress", "ReconstructionConfig", "Trainer", "select_keyframes", "shrink"]
