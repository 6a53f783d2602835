"""Arms of the da Vinci and their instruments: parameter files, kinematics, shapes, pictures, and where they stand in a scene."""

from endo_sim_ros.instruments.aiming import *
from endo_sim_ros.instruments.arm_files import *
from endo_sim_ros.instruments.inverse import *
from endo_sim_ros.instruments.kinematics import *
from endo_sim_ros.instruments.placement import *
from endo_sim_ros.instruments.shapes import *
