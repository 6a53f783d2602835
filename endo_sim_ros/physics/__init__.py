"""Soft tissue: sparse control nodes, MLS-MPM and skinning, on CPU and CUDA."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.physics.config import PhysicsConfig as PhysicsConfig
    from endo_sim_ros.physics.control_nodes import ControlNodes as ControlNodes
    from endo_sim_ros.physics.control_nodes import build_control_nodes as build_control_nodes
    from endo_sim_ros.physics.control_nodes import sample_farthest as sample_farthest
    from endo_sim_ros.physics.materials import lame_parameters as lame_parameters
    from endo_sim_ros.physics.materials import sound_speed as sound_speed
    from endo_sim_ros.physics.regions import TissueProperties as TissueProperties
    from endo_sim_ros.physics.simulation import NodeState as NodeState
    from endo_sim_ros.physics.simulation import TissueBatch as TissueBatch
    from endo_sim_ros.physics.simulation import TissueSimulation as TissueSimulation
    from endo_sim_ros.physics.skinning import Skinning as Skinning
    from endo_sim_ros.physics.solver import MpmSolver as MpmSolver
    from endo_sim_ros.physics.substeps import StabilityError as StabilityError
    from endo_sim_ros.physics.substeps import plan_substeps as plan_substeps

__getattr__ = lazy_names(
    __name__,
    config=("PhysicsConfig",),
    control_nodes=("ControlNodes", "build_control_nodes", "sample_farthest"),
    materials=("lame_parameters", "sound_speed"),
    regions=("TissueProperties",),
    simulation=("NodeState", "TissueBatch", "TissueSimulation"),
    skinning=("Skinning",),
    solver=("MpmSolver",),
    substeps=("StabilityError", "plan_substeps"),
)
