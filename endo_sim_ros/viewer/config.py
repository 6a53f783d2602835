"""Parameters of the viewer."""

from dataclasses import dataclass
from typing import Annotated

from endo_sim_ros.core.config import Range, StageConfig


@dataclass(frozen=True)
class ViewerConfig(StageConfig):
    """Where the page is served, and how the mouse pulls."""

    host: str = "127.0.0.1"
    """Address that the page is served on; 0.0.0.0 lets other machines in, all of them, and none has to log in."""
    port: Annotated[int, Range(1, 65535)] = 8080
    """Port of the page; the next free one if it is taken."""
    rate: Annotated[float, Range(0.5, 60, "Hz")] = 15.0
    """Pictures per second sent to each browser while something moves, and of videos. 32 bytes a Gaussian each, or a JPEG."""
    max_force: Annotated[float, Range(0.01, 100, "N")] = 5.0
    """Force that the mouse pulls with at most; tissue that resists more stays behind."""
    max_speed: Annotated[float, Range(0.001, 10, "m/s")] = 0.1
    """Speed at which held tissue follows the mouse at most."""
    videos: str = "~/.ros/endo_sim_ros/videos"
    """Folder for recorded videos."""
