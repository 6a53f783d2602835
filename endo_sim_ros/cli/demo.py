"""`endo-sim demo`."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Command:
    """Run the whole graph: replay, reconstruct, touch and render, each node its own process."""

    bag: Path | None = None
    """Bag to use; default: a synthetic patient."""
    out: Path = Path("out")
    """Folder for the results."""
    seed: int = 0
    """Synthetic patient: other seeds give other organs."""
    frames: int = 60
    """Synthetic patient: number of frames."""
    width: int = 480
    """Width of training and rendered images, pixels."""
    iterations: int = 1500
    """Training iterations."""
    force: float = 2.0
    """Force with which the scripted tool pulls, and to which it keeps within a fifth, N; less where 2 cm of pull, or a quarter of the way
    to the lens, do not reach it."""
    timeout: float = 300.0
    """Give up after this long without progress, seconds."""

    def run(self) -> None:
        """Run the demo until its results are written; raises DemoError or SequenceError if a stage fails."""
        from endo_sim_ros.graph.demo import run_demo

        run_demo(self.bag, self.out, self.seed, self.frames, self.width, self.iterations, self.force, self.timeout)
