"""`endo-sim view`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.physics.tissues import Tissue, tissue
from endo_sim_ros.viewer.config import ViewerConfig


@dataclass(frozen=True)
class Command:
    """Show a model in the browser and pull it with the mouse; needs no ROS."""

    model: Positional[Path]
    """PLY model, in metres; seen by the cameras in the cameras.json beside it, else from the world's origin."""
    config: Annotated[ViewerConfig, tyro.conf.arg(name="")] = field(default_factory=ViewerConfig)
    instrument: str = "LARGE_NEEDLE_DRIVER"
    """Tool that the mouse moves: its name, or the path of its file; after an @ the path of a URDF that has its shape, as in
    LARGE_NEEDLE_DRIVER@psm.urdf. Empty, or where its arm does not reach = a bare tip. The views that are rendered here show it ("orbit,
    rendered here" and "endoscope"); "orbit", which the browser draws, does not."""
    tissue: Tissue = "default"
    """What the tissue is made of, with published numbers (docs/physics.md)."""
    node_count: int | None = None
    """Number of control nodes; default: that of the physics."""
    motion: bool = True
    """Let the tissue move by itself as the motion.npz beside the model has it, where there is one."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""

    def run(self) -> None:
        """Serve the page until interrupted; raises ValueError if model, cameras or options cannot be used."""
        from endo_sim_ros.viewer.standalone import view

        nodes = {} if self.node_count is None else {"node_count": self.node_count}
        view(self.model, tissue(self.tissue, device=self.device, **nodes), self.config, self.instrument, self.motion)
