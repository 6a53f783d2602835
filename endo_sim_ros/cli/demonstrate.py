"""`endo-sim demonstrate`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.learning.config import DemonstrationConfig, Randomisation, SightConfig
from endo_sim_ros.physics.config import MotionConfig


@dataclass(frozen=True)
class Command:
    """Let a scripted policy solve a task many times, and write what it sees and does as a LeRobot dataset; called again, continue it."""

    task: Positional[str]
    """Name of the task, such as retraction or palpation; an unknown one is answered with the list."""
    out: Positional[Path]
    """Folder of the dataset. Finished episodes stay in it when the command is interrupted."""
    scenes: tuple[str, ...] = ("phantom:0",)
    """Synthetic patients, phantom:SEED, or PLY models with their cameras.json, which episodes take in turn."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    config: Annotated[DemonstrationConfig, tyro.conf.arg(name="")] = field(default_factory=DemonstrationConfig)
    sight: Annotated[SightConfig, tyro.conf.arg(name="")] = field(default_factory=lambda: SightConfig(image_width=128))
    vary: Randomisation = field(default_factory=Randomisation)
    motion: MotionConfig = field(default_factory=MotionConfig)

    def run(self) -> None:
        """Write the dataset; raises SequenceError if the folder has other data."""
        from endo_sim_ros.learning.demonstrations import demonstrate

        episodes, tried = demonstrate(self.task, self.scenes, self.out, self.config, self.sight, self.vary, self.motion, self.device)
        print(f"{self.out}: {episodes} solved episodes; {tried} were tried now")
