"""`endo-sim identify`."""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.cli import chosen
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.recording_config import RecordingConfig
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.tissues import TISSUES, Tissue, tissue


@dataclass(frozen=True)
class Command:
    """Estimate how stiff tissue is, and how well that is known, from a recording of a tool that touches it."""

    bag: Positional[Path]
    """Recording of a console or of the graph: poses of tools, and forces on them, images or control nodes."""
    model: Path
    """PLY model of the tissue at rest with its cameras.json, or phantom:SEED."""
    out: Path
    """Folder for stiffness.yaml, parameters of physics_node, for the map, stiffness.npz, and for its picture, stiffness.png."""
    tissue: Tissue = "default"
    """What the tissue is thought to be made of, with published numbers (docs/physics.md). Options that are not given have the values of
    the tissue."""
    config: Annotated[IdentificationConfig, tyro.conf.arg(name="")] = field(default_factory=IdentificationConfig)
    recording: Annotated[RecordingConfig, tyro.conf.arg(name="")] = field(default_factory=RecordingConfig)
    physics: Annotated[PhysicsConfig, tyro.conf.arg(name="")] = field(default_factory=PhysicsConfig)

    def run(self) -> None:
        """Write the results; raises SequenceError or ValueError if recording, model or options cannot be used."""
        from endo_sim_ros.core.folders import leaving_none_empty
        from endo_sim_ros.identification.identify_bag import identify_bag

        if self.out.is_file():
            raise ValueError(f"{self.out} is a file; name a folder for what is found")
        if (self.out / "stiffness.yaml").exists():
            raise ValueError(f"{self.out} holds what was found before; name another folder, or remove that one first")
        try:
            with leaving_none_empty(self.out):
                identify_bag(self.bag, self.model, self.out, self.config, self.recording, self.physics)
        except KeyboardInterrupt:
            logging.getLogger(__name__).info("interrupted; nothing was written to %s", self.out)
            raise
        print(f"{self.out}: stiffness.yaml, stiffness.npz, stiffness.png")


def defaults(words: list[str]) -> Command:
    """Return the command with the options of the tissue that the words name: the values of options that they do not give."""
    return Command(tyro.MISSING, tyro.MISSING, tyro.MISSING, physics=tissue(chosen(words, "--tissue", TISSUES)))
