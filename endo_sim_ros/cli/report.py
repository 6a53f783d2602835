"""`endo-sim report`."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Command:
    """Show an evaluation as one HTML page: sortable tables beside the paper's, plots, pictures with a slider."""

    run_folder: Positional[Path]
    """Folder that `endo-sim evaluate` wrote; report.html goes there, too."""

    def run(self) -> None:
        """Write the page and print its path; raises ValueError if the folder holds no results."""
        from endo_sim_ros.evaluation.page import write_page

        print(write_page(self.run_folder))
