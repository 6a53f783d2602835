"""`endo-sim up`."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Command:
    """Start the graph, each node its own process, and show what each says, until Ctrl-C; `ros2 launch` without ROS installed."""

    bag: Path | None = None
    """Recording to replay; default: none, for a live endoscope."""
    params_file: Path | None = None
    """ROS parameter file for the nodes; `endo-sim config` prints one with all defaults."""
    namespace: str = ""
    """Namespace of all nodes and topics."""
    arms: tuple[str, ...] = ()
    """Names of the tool arms; default: as in the parameter file, else PSM1."""
    model: str = ""
    """PLY model to start with; latest = the newest one that was saved. Its tissue moves by itself as motion.npz beside it says."""
    logs: Path = Path("~/.ros/endo_sim_ros/logs")
    """Folder for what each node prints."""
    respawn: bool = True
    """Start a node that crashes again, after a pause that grows, until it has crashed four times in a row soon after its start."""
    view: bool = False
    """Serve the page as well, on which tissue is seen and pulled with the mouse: http://localhost:8080."""

    def run(self) -> None:
        """Run the graph until interrupted; raises a ValueError if something given cannot be used, UpError if all are down."""
        from endo_sim_ros.graph.up import run_up

        run_up(self.bag, self.params_file, self.namespace, self.arms, self.model, self.logs, self.respawn, self.view)
