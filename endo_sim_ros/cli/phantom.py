"""`endo-sim phantom`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import track
from tyro.conf import Positional

from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.phantom import PhantomConfig


@dataclass(frozen=True)
class Command:
    """Write a bag of a synthetic patient with exact poses, depth, stereo pair and mask."""

    bag: Positional[Path]
    """Folder of the new bag; it must not exist."""
    config: Annotated[PhantomConfig, tyro.conf.arg(name="")] = field(default_factory=PhantomConfig)

    def run(self) -> None:
        """Render the patient into the bag."""
        from endo_sim_ros.sequences.bag import write_bag
        from endo_sim_ros.sequences.phantom import phantom_sequence

        frames = track(phantom_sequence(self.config), "rendering the patient", total=self.config.frames)
        print(f"{self.bag}: {counted(write_bag(self.bag, frames), 'frame')}")
