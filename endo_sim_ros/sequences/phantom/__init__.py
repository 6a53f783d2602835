"""A procedural patient: wet, vessel-covered organs in front of a peritoneal wall, filmed by an endoscope.

Everything is a deterministic function of the seed and known exactly: poses, depth, stereo, calibration. `anatomy` makes
the surface, `paint` its texture, `rendering` the images and `path` the endoscope's way.

World frame: the wall is around z = 0.14 m and faces the endoscope, whose tip moves about the origin and looks along +z.
"""

from endo_sim_ros.sequences.phantom.config import PhantomConfig as PhantomConfig
from endo_sim_ros.sequences.phantom.displacement import Displacement as Displacement, displacement_at as displacement_at
from endo_sim_ros.sequences.phantom.path import phantom_camera as phantom_camera, phantom_poses as phantom_poses
from endo_sim_ros.sequences.phantom.rendering import Phantom as Phantom, build_phantom as build_phantom, render_phantom as render_phantom
from endo_sim_ros.sequences.phantom.sequence import phantom_sequence as phantom_sequence
