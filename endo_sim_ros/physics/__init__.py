"""Soft tissue: sparse control nodes, MLS-MPM and skinning, on CPU and CUDA."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.physics.batch import TissueBatch as TissueBatch
    from endo_sim_ros.physics.config import MotionConfig as MotionConfig, PhysicsConfig as PhysicsConfig
    from endo_sim_ros.physics.control_nodes import (
        ControlNodes as ControlNodes,
        build_control_nodes as build_control_nodes,
        sample_farthest as sample_farthest,
    )
    from endo_sim_ros.physics.links import ToolLinks as ToolLinks
    from endo_sim_ros.physics.materials import lame_parameters as lame_parameters, sound_speed as sound_speed
    from endo_sim_ros.physics.regions import TissueProperties as TissueProperties
    from endo_sim_ros.physics.simulation import TissueSimulation as TissueSimulation, TissueState as TissueState
    from endo_sim_ros.physics.skinning import Skinning as Skinning
    from endo_sim_ros.physics.solver import MpmSolver as MpmSolver
    from endo_sim_ros.physics.substeps import StabilityError as StabilityError, plan_substeps as plan_substeps
    from endo_sim_ros.physics.tissues import TISSUES as TISSUES, tissue as tissue

__getattr__ = lazy_names(__name__, __file__)
