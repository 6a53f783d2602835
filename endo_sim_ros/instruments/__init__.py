"""Arms of the da Vinci and their instruments: parameter files, kinematics, shapes, pictures, and where they stand in a scene."""

from endo_sim_ros.instruments.aiming import GRIP as GRIP, aimed_pose as aimed_pose, working_point as working_point
from endo_sim_ros.instruments.arm_files import (
    arm_names as arm_names,
    load_arm as load_arm,
    save_tool as save_tool,
    tool_names as tool_names,
)
from endo_sim_ros.instruments.inverse import Reach as Reach, ReachConfig as ReachConfig, solve_inverse as solve_inverse
from endo_sim_ros.instruments.kinematics import JOINTS as JOINTS, ArmKinematics as ArmKinematics, Joint as Joint
from endo_sim_ros.instruments.placement import Placement as Placement, PlacementConfig as PlacementConfig, place_arm as place_arm
from endo_sim_ros.instruments.shapes import (
    LINKS as LINKS,
    Capsule as Capsule,
    JawShape as JawShape,
    Material as Material,
    Part as Part,
    ToolShape as ToolShape,
    build_instrument as build_instrument,
    link_poses as link_poses,
)
