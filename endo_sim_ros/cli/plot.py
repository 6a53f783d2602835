"""`endo-sim plot`."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Command:
    """Draw results of `bench … --json` as bars; several files, such as those of two machines, side by side."""

    files: Positional[tuple[Path, ...]]
    """Files of rows; each gives its name to its bars."""
    out: Path = Path("bench.png")
    """Picture to write: .png, .svg or .pdf."""
    only: str = ""
    """Regular expression; rows whose names it is not found in are left out."""
    title: str = ""
    """Over the picture, such as the name of the machine."""

    def run(self) -> None:
        """Draw the picture; raises ValueError without files."""
        from endo_sim_ros.core.words import counted
        from endo_sim_ros.evaluation.bars import plot_rows

        if not self.files:
            raise ValueError("no files to plot; give those that `endo-sim bench … --json FILE` wrote")
        print(f"{self.out}: {counted(plot_rows(self.files, self.out, self.only, self.title), 'row')}")
