"""Tasks whose episodes end sooner, for policies that do not solve them."""

from endo_sim_ros.learning.tasks.camera import Camera
from endo_sim_ros.learning.tasks.handover import Handover
from endo_sim_ros.learning.tasks.retraction import Retraction


class ShortCamera(Camera):
    """Needs a good view for 20 steps, not for 100."""

    horizon, wanted = 50, 20


class ShortHandover(Handover):
    """See above."""

    horizon = 50


class ShortRetraction(Retraction):
    """See above."""

    horizon = 30
