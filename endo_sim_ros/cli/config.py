"""`endo-sim config`."""

from dataclasses import dataclass

from tyro.conf import Positional

from endo_sim_ros.core.config import ConfigError


@dataclass(frozen=True)
class Command:
    """Print the parameters of all nodes, or of some, with their defaults as a ROS parameter file."""

    nodes: Positional[tuple[str, ...]] = ()
    """Names of nodes; default: all."""

    def run(self) -> None:
        """Print the parameter file; raises ConfigError if a ROS node is unknown."""
        from endo_sim_ros.nodes.configs import NODE_CONFIGS
        from endo_sim_ros.nodes.parameter_file import parameter_file

        nodes = [name if name in NODE_CONFIGS else name.removesuffix("_node") for name in self.nodes]  # executables end in _node
        unknown = [given for given, name in zip(self.nodes, nodes) if name not in NODE_CONFIGS]
        if unknown:
            raise ConfigError(f"no node is called {', '.join(unknown)}; there are {', '.join(NODE_CONFIGS)}")
        print(parameter_file(nodes or tuple(NODE_CONFIGS)), end="")
