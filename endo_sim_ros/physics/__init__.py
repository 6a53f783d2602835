"""Soft tissue: sparse control nodes, MLS-MPM and skinning, on CPU and CUDA."""

from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes, build_control_nodes, sample_farthest
from endo_sim_ros.physics.materials import lame_parameters, sound_speed
from endo_sim_ros.physics.regions import TissueProperties
from endo_sim_ros.physics.simulation import NodeState, TissueBatch, TissueSimulation
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.physics.solver import MpmSolver, StabilityError, plan_substeps

__all__ = [
    "ControlNodes",
    "MpmSolver",
    "NodeState",
    "PhysicsConfig",
    "Skinning",
    "StabilityError",
    "TissueBatch",
    "TissueProperties",
    "TissueSimulation",
    "build_control_nodes",
    "lame_parameters",
    "plan_substeps",
    "sample_farthest",
    "sound_speed",
]
