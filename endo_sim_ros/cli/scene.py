"""`endo-sim scene`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.learning.config import Randomisation, SightConfig, without_instrument
from endo_sim_ros.physics.config import MotionConfig


@dataclass(frozen=True)
class Command:
    """Write what starts the graph on a task to learn: model.ply, cameras.json, the tools' files and parameters.yaml for its nodes."""

    out: Positional[Path]
    """Folder to write; it may exist."""
    task: str = "retraction"
    """Name of the task, such as retraction or palpation; an unknown one is answered with the list."""
    model: Path | None = None
    """PLY model with its cameras.json, or phantom:SEED, a piece of a synthetic patient; default: phantom:0."""
    seed: int = 0
    """Of the first episode."""
    image_width: int = SightConfig.image_width
    """Width of the pictures, pixels."""
    instrument: bool = SightConfig.instrument
    """Show the tool; without it an arm is a tip that reaches every pose."""
    tool: str = ""
    """Name or file of the tool; default: that of the task."""
    dye: bool = SightConfig.dye
    """Mark the target with a spot of dye on the tissue."""
    baseline: float = SightConfig.baseline
    """Distance between the eyes, m."""
    mode: Literal["realtime", "lockstep"] = "lockstep"
    """lockstep: time goes on with each action of policy_node, as in the environments. realtime: it goes on by itself."""
    contact: Literal["point", "links"] = "point"
    """What touches the tissue: the tip as the task describes it, or the links of the instrument, whose jaws hold what lies between them."""
    motion: MotionConfig = field(default_factory=MotionConfig)

    def run(self) -> None:
        """Write the scene; raises ValueError if there is no such task or tool, or the model is too small or out of reach."""
        from endo_sim_ros.learning.graph_files import save_scene
        from endo_sim_ros.learning.scenes import load_scene

        names = ("image_width", "instrument", "tool", "dye", "baseline")
        sight = SightConfig(**{name: getattr(self, name) for name in names})
        for text in without_instrument(sight, Randomisation()):
            raise ConfigError(text)
        save_scene(load_scene(self.model), self.out, self.task, self.seed, sight, self.motion, self.mode, self.contact)
        print(f"{self.out}: model.ply, cameras.json, parameters.yaml")
