"""`endo-sim reconstruct`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.cli import chosen
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.presets import PRESETS, Preset, preset


@dataclass(frozen=True)
class Command:
    """Reconstruct a Gaussian model from a bag without ROS, and measure it on the views that were held out."""

    bag: Positional[Path]
    """Bag with images, camera_info and poses."""
    out: Positional[Path]
    """Folder for model.ply, cameras.json, checkpoint.pt, held_out.png and, of tissue that moves by itself, motion.npz and motion.yaml."""
    resume: bool = False
    """Go on from the checkpoint.pt that an interrupted reconstruction of the same bag with the same options left in that folder."""
    preset: Preset = "default"
    """Method: ours, ours sized for a CPU, that of the paper as printed, FSGS or 3DGS as published, or these two with one colour for
    all directions of view (sh0). Options that are not given have the values of the preset."""
    config: Annotated[ReconstructionConfig, tyro.conf.arg(name="")] = field(default_factory=ReconstructionConfig)

    def run(self) -> None:
        """Write model, cameras, checkpoint and picture; raises SequenceError if bag or checkpoint cannot be used."""
        from endo_sim_ros.core.folders import claimed, leaving_none_empty
        from endo_sim_ros.core.frames import SequenceError
        from endo_sim_ros.evaluation.held_out import measure_held_out
        from endo_sim_ros.reconstruction.from_bag import reconstruct_bag

        if (self.out / "metadata.yaml").exists():  # before any work
            raise SequenceError(f"{self.out} is a bag; name another folder for the result")
        with leaving_none_empty(self.out), claimed(self.out):
            trainer, held_out = reconstruct_bag(self.bag, self.out, self.config, self.resume)
            measure_held_out(trainer, held_out, self.out)


def defaults(words: list[str]) -> Command:
    """Return the command with the options of the preset that the words name: the values of options that they do not give."""
    return Command(tyro.MISSING, tyro.MISSING, config=preset(chosen(words, "--preset", PRESETS)))
