"""`endo-sim scene`."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Command:
    """Write what starts the graph on a task to learn: model.ply, cameras.json and parameters.yaml for its nodes."""

    out: Positional[Path]
    """Folder to write; it may exist."""
    task: str = "retraction"
    """Name of the task, such as retraction or palpation; an unknown one is answered with the list."""
    model: Path | None = None
    """PLY model with its cameras.json; default: a piece of the synthetic patient."""
    seed: int = 0
    """Of the first episode."""

    def run(self) -> None:
        """Write the scene; raises ValueError if there is no such task or the model is too small."""
        from endo_sim_ros.learning.scenes import load_scene, save_scene

        save_scene(load_scene(self.model), self.out, self.task, self.seed)
        print(f"{self.out}: model.ply, cameras.json, parameters.yaml")
