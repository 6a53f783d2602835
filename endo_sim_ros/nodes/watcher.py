"""What the nodes of a graph report on /diagnostics, for those that listen."""

import time

from endo_sim_ros import messages
from endo_sim_ros.messages import NodeState, NodeStatus
from endo_sim_ros.nodes.base import EndoNode


class Watcher(EndoNode):
    """Hears what the nodes report on /diagnostics.

    Attributes:
        statuses: The newest status of each node, by its full name.
        heard: When that came, seconds of ``time.monotonic``.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.statuses: dict[str, NodeStatus] = {}
        self.heard: dict[str, float] = {}
        self.subscribe(messages.DIAGNOSTICS, self._on_diagnostics)

    def _on_diagnostics(self, message: messages.Message) -> None:
        for status in messages.decode_diagnostics(message):
            self.statuses[status.name], self.heard[status.name] = status, time.monotonic()

    def in_state(self, node: str, state: NodeState) -> bool:
        """Whether a node reports this state. A state that is missing or unknown is none."""
        return node in self.statuses and self.statuses[node].state(type(state)) is state

    def value(self, node: str, key: str, default: str = "") -> str:
        """A value that a node reports, or a default."""
        return self.statuses[node].values.get(key, default) if node in self.statuses else default

    def renders_control_nodes(self) -> bool:
        """Whether the renderer shows the tissue as the control nodes deform it."""
        return self.value("rendering_node", "following control nodes") == "True"
