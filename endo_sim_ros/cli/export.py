"""`endo-sim export`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.words import counted


@dataclass(frozen=True)
class Command:
    """Turn recordings of the graph into a dataset to learn from, each one episode; or a dataset into an older layout."""

    paths: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="BAG [BAG ...] OUT")]
    """Recordings with rendered images, control nodes, and poses and reactions of tools; then the folder of the new dataset. For
    lerobot-2.1 a dataset v3.0 in their place."""
    format: Literal["lerobot", "lerobot-2.1"] = "lerobot"
    """lerobot: a LeRobotDataset v3.0. lerobot-2.1: a copy of one in layout v2.1, which Open-H asks for."""
    fps: int | None = None
    """Frames per second; default: those of the steps of a recording in lockstep, else 25."""
    arms: tuple[str, ...] = ()
    """Names of the tool arms; default: all in the recording."""
    task: str = "manipulate the tissue"
    """What was done, in words."""
    sampling: Literal["auto", "rate", "lockstep"] = "auto"
    """rate: the last message of each topic, at a fixed rate; lockstep: messages with equal stamps; auto: lockstep where there
    are such messages and no other fps is asked for."""
    images: Literal["video", "png"] = "video"
    """video: small (H.264); png: exact."""
    world_frame: str = "world"
    """Frame of the poses in the recording."""
    frames: tuple[str, ...] = ()
    """Other frames of poses and wrenches in the recording, as the nodes' parameter: 'PSM1_base x y z qx qy qz qw' each."""

    def run(self) -> None:
        """Write the dataset; raises SequenceError if a recording cannot be used."""
        if len(self.paths) < 2:
            raise SequenceError("give one recording or more, then the folder of the dataset")
        *given, out = self.paths
        if self.format == "lerobot":
            from endo_sim_ros.learning.lerobot import export_lerobot

            options = self.task, self.fps, self.arms, self.sampling, self.images, self.world_frame, self.frames
            episodes, frames = export_lerobot(given, out, *options)
        else:
            from endo_sim_ros.learning.lerobot_v21 import to_v21

            if self != Command(self.paths, self.format) or len(given) > 1:
                raise ConfigError("lerobot-2.1 takes one dataset, then the folder of the new one, and no other options")
            episodes, frames = to_v21(given[0], out)
        print(f"{out}: {counted(episodes, 'episode')}, {counted(frames, 'frame')}")
