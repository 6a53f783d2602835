"""`endo-sim record`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional


@dataclass(frozen=True)
class Command:
    """Record a running graph into a rosbag2, for replay or `export`, until interrupted."""

    out: Positional[Path]
    """Folder of the new bag; it must not exist."""
    arms: tuple[str, ...] = ("PSM1",)
    """Names of the tool arms."""
    topics: tuple[str, ...] = ("all",)
    """Names of the topics to record, such as rendered/image_raw; all records every topic of msg_conventions.md but what would be
    rendered for the recorder alone: depth, segmentation, the right eye, and one of the two forms of the images. Name these beside all."""
    images: Literal["compressed", "raw"] = "compressed"
    """Form of the rendered images where all topics are recorded; raw ones are exact and take fifteen times the room."""
    namespace: str = ""
    """Namespace of the graph; the bag has the names without it."""

    def run(self) -> None:
        """Record until interrupted; raises SequenceError or ConfigError if bag, topics or arms cannot be used."""
        from endo_sim_ros.nodes.recorder_node import record

        record(self.out, self.arms, self.topics, self.namespace, self.images)
