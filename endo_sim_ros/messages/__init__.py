"""numpy ⇄ ROS messages: the code twin of msg_conventions.md. Only this package encodes or decodes bytes.

Encoders take ``types``, the message classes to build: `ros_types()` for a running graph (the default), `bag_types()` for bag
files, which needs no ROS installation. Decoders accept messages of either. Images and clouds cross at memcpy speed.
"""

from endo_sim_ros.messages.cameras import *
from endo_sim_ros.messages.clouds import *
from endo_sim_ros.messages.diagnostics import *
from endo_sim_ros.messages.dye import *
from endo_sim_ros.messages.headers import *
from endo_sim_ros.messages.images import *
from endo_sim_ros.messages.motion import *
from endo_sim_ros.messages.poses import *
from endo_sim_ros.messages.tasks import *
from endo_sim_ros.messages.tools import *
from endo_sim_ros.messages.topics import *
from endo_sim_ros.messages.types import *
