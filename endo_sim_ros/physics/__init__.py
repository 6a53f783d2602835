"""Soft tissue: sparse control nodes, MLS-MPM and skinning, on CPU and CUDA."""

from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes, build_control_nodes, sample_farthest
from endo_sim_ros.physics.materials import lame_parameters, sound_speed
from endo_sim_ros.physics.mpm import MpmSolver, StabilityError, plan_substeps
from endo_sim_ros.physics.simulation import NodeState, TissueSimulation
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.physics.wrench import minimum_norm_forces

__all__ = [
    "ControlNodes",
    "MpmSolver",
    "NodeState",
    "PhysicsConfig",
    "Skinning",
    "StabilityError",
    "TissueSimulation",
    "build_control_nodes",
    "lame_parameters",
    "minimum_norm_forces",
    "plan_substeps",
    "sample_farthest",
    "sound_speed",
]
