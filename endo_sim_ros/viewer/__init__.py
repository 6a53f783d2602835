"""The page on which tissue is seen in a browser and pulled with the mouse."""

from endo_sim_ros.viewer.config import ViewerConfig
from endo_sim_ros.viewer.viewer import Actions, Tool, Viewer

__all__ = ["Actions", "Tool", "Viewer", "ViewerConfig"]
