"""Soft tissue: sparse control nodes, MLS-MPM and skinning, on CPU and CUDA."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.physics.config import PhysicsConfig
    from endo_sim_ros.physics.control_nodes import ControlNodes, build_control_nodes, sample_farthest
    from endo_sim_ros.physics.materials import lame_parameters, sound_speed
    from endo_sim_ros.physics.regions import TissueProperties
    from endo_sim_ros.physics.simulation import NodeState, TissueBatch, TissueSimulation
    from endo_sim_ros.physics.skinning import Skinning
    from endo_sim_ros.physics.solver import MpmSolver
    from endo_sim_ros.physics.substeps import StabilityError, plan_substeps

__getattr__ = lazy_names(__name__, __file__)
