"""`endo-sim reconstruct`."""

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.presets import PRESETS, preset


def _named_preset() -> ReconstructionConfig:
    """The options of the preset that the command line names, which are the defaults of those it does not give."""
    name = "default"
    for word, following in zip(sys.argv, [*sys.argv[1:], ""]):
        if word == "--preset" or word.startswith("--preset="):
            name = following if word == "--preset" else word.removeprefix("--preset=")
    # What is wrong with another name the parser says.
    return dataclasses.replace(preset(name), preset=name) if name in PRESETS else ReconstructionConfig()


@dataclass(frozen=True)
class Command:
    """Reconstruct a Gaussian model from a bag without ROS, and measure it on the views that were held out."""

    bag: Positional[Path]
    """Bag with images, camera_info and poses."""
    out: Positional[Path]
    """Folder for model.ply, cameras.json, checkpoint.pt and held_out.png."""
    resume: bool = False
    """Go on from the checkpoint.pt that an interrupted reconstruction of the same bag with the same options left in that folder."""
    config: Annotated[ReconstructionConfig, tyro.conf.arg(name="")] = field(default_factory=_named_preset)

    def run(self) -> None:
        """Write model, cameras, checkpoint and the picture of held-out views."""
        from endo_sim_ros.evaluation.held_out import reconstruct_and_measure

        # All options are spelled out: the preset must not replace those given.
        reconstruct_and_measure(self.bag, self.out, dataclasses.replace(self.config, preset="default"), self.resume)
