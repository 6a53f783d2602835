"""`endo-sim benchmark`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.learning.config import BenchmarkConfig


@dataclass(frozen=True)
class Command:
    """Compare policies on unseen episodes of a task: a table, a page and videos; called again, it adds to the table of its folder."""

    out: Positional[Path]
    """Folder for benchmark.json, benchmark.html and the videos."""
    policies: Positional[tuple[str, ...]] = ("scripted", "still")
    """scripted, still (does nothing), a policy.npz of `endo-sim train`, or the folder of `endo-sim imitate`."""
    scenes: tuple[str, ...] = ("phantom:3", "phantom:4", "phantom:5")
    """Synthetic patients, phantom:SEED, or PLY models with their cameras.json; demonstrate and train use phantom:0 by default."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    config: Annotated[BenchmarkConfig, tyro.conf.arg(name="")] = field(default_factory=BenchmarkConfig)

    def run(self) -> None:
        """Play and print the table; raises ValueError if a policy, scene or task cannot be used."""
        from endo_sim_ros.learning.benchmark import benchmark, read_results, robustness, table

        benchmark(self.out, self.policies, self.scenes, self.config, self.device)
        results = read_results(self.out)
        for rows in (table(results), robustness(results)):
            widths = [max(map(len, column)) for column in zip(*rows)]
            for row in rows:
                print("  ".join(cell.ljust(width) for cell, width in zip(row, widths)))
        print(f"{self.out / 'benchmark.html'}")
