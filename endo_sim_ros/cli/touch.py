"""`endo-sim touch`."""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.cli import chosen
from endo_sim_ros.core.config import unused_options
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.tissues import TISSUES, Tissue, tissue


@dataclass(frozen=True)
class Command:
    """Poke, pull, grasp and cut a reconstructed model without ROS, and draw what it looks like."""

    model: Positional[Path]
    """PLY model, with the cameras.json that is saved beside it."""
    out: Path = Path("touch.png")
    """Picture to write."""
    tissue: Tissue = "default"
    """What the tissue is made of, with published numbers (docs/physics.md). Options that are not given have the values of the tissue."""
    config: Annotated[PhysicsConfig, tyro.conf.arg(name="")] = field(default_factory=PhysicsConfig)

    def run(self) -> None:
        """Draw the picture; raises ValueError if model, cameras or options cannot be used."""
        from endo_sim_ros.evaluation.interaction_sheet import draw_touches

        for text in filter(None, (*unused_options(self.config), self.config.motion.idle)):
            logging.getLogger(__name__).warning(text)
        draw_touches(self.model, self.out, self.config)


def defaults(words: list[str]) -> Command:
    """Return the command with the options of the tissue that the words name: the values of options that they do not give."""
    return Command(tyro.MISSING, config=tissue(chosen(words, "--tissue", TISSUES)))
