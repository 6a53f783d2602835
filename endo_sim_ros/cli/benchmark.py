"""`endo-sim benchmark`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.learning.config import COMPARED_IN, BenchmarkConfig, SightConfig

_NODE = "node:"


@dataclass(frozen=True)
class Command:
    """Compare policies on unseen episodes of a task: a table, a page and videos; called again, it adds to the table of its folder."""

    out: Positional[Path]
    """Folder for benchmark.json, benchmark.html and the videos."""
    policies: Positional[tuple[str, ...]] = ("scripted", "still")
    """scripted, still (does nothing), a policy.npz of `endo-sim train`, the folder of `endo-sim imitate`, your own file.py:Class, or
    node:NAME, a ROS node of your own that answers NAME/observation on NAME/action."""
    scenes: tuple[str, ...] = COMPARED_IN
    """Synthetic patients, phantom:SEED, or PLY models with their cameras.json; demonstrate and train use phantom:0 by default."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    sight: SightConfig = field(default_factory=SightConfig)
    """What a ROS node sees that subscribes to NAME/image_raw; other policies say themselves what they see."""
    config: Annotated[BenchmarkConfig, tyro.conf.arg(name="")] = field(default_factory=BenchmarkConfig)

    def run(self) -> None:
        """Play and print the table; raises ValueError if what is given cannot be used, RuntimeError if a node does not answer."""
        from endo_sim_ros.learning.benchmark import benchmark, read_results, robustness, table
        from endo_sim_ros.learning.policies import Policy, make_policy

        own = (self.sight, self.config.patience) != (SightConfig(), BenchmarkConfig().patience)
        if own and not any(policy.startswith(_NODE) for policy in self.policies):
            raise ConfigError("sight and patience are options of a ROS node; give one as node:NAME, or leave them out")
        nodes: list[Any] = []

        def make(policy: str, task: str, count: int, device: str) -> Policy:
            if not policy.startswith(_NODE):
                return make_policy(policy, task, count, device)
            from endo_sim_ros.graph.node_policy import NodePolicy

            nodes.append(NodePolicy(policy.removeprefix(_NODE), task, self.sight, self.config.patience))
            return nodes[-1]

        try:
            benchmark(self.out, self.policies, self.scenes, self.config, self.device, make)
        finally:
            for node in nodes:
                node.close()
        results = read_results(self.out)
        for rows in (table(results), robustness(results)):
            widths = [max(map(len, column)) for column in zip(*rows)]
            for row in rows:
                print("  ".join(cell.ljust(width) for cell, width in zip(row, widths)))
        print(f"{self.out / 'benchmark.html'}")
