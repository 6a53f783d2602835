"""`endo-sim record`."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Command:
    """Record a running graph into a rosbag2, for replay or `export`, until interrupted."""

    out: Positional[Path]
    """Folder of the new bag; it must not exist."""
    arms: tuple[str, ...] = ("PSM1",)
    """Names of the tool arms."""
    topics: tuple[str, ...] = ("all",)
    """Names of the topics to record, such as rendered/image_raw; all records every topic of msg_conventions.md."""
    namespace: str = ""
    """Namespace of the graph; the bag has the names without it."""

    def run(self) -> None:
        """Record until interrupted; raises SequenceError or ConfigError if bag, topics or arms cannot be used."""
        from endo_sim_ros.nodes.recorder_node import record

        record(self.out, self.arms, self.topics, self.namespace)
