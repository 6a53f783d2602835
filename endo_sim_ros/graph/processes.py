"""Starts the nodes of the graph as processes of their own."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from endo_sim_ros.nodes.process import PARENT
from endo_sim_ros.nodes.transport import graph_environment

_STOP_AFTER = 15.0  # seconds that a node has to end after an interrupt


class NodeProcess:
    """One node in its own process, with its output in a log file."""

    def __init__(self, name: str, parameters: dict[str, Any], environment: dict[str, str], log: Path, ros_arguments: tuple[str, ...]):
        self.name, self.log = name, log
        arguments = [sys.executable, "-m", f"endo_sim_ros.nodes.{name}", "--ros-args", *ros_arguments]
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={_yaml(value)}"]
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as output:
            mine = environment | {PARENT: str(os.getpid())}
            self.process = subprocess.Popen(arguments, env=mine, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)

    @property
    def exit_status(self) -> int | None:
        """None while the node runs."""
        return self.process.poll()

    def wait(self, seconds: float = _STOP_AFTER) -> int:
        """Exit status; a node that does not end in time is killed."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


def _yaml(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_yaml, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)


class NodeGroup:
    """Nodes that live and end together. Use as a context manager."""

    def __init__(self, log_folder: Path):
        self.environment = graph_environment()
        self._log_folder = log_folder
        self.nodes: dict[str, NodeProcess] = {}

    def __enter__(self) -> "NodeGroup":
        return self

    def __exit__(self, *_: Any) -> None:
        self.stop()

    def start(self, name: str, *ros_arguments: str, **parameters: Any) -> NodeProcess:
        """Start a node, or another one in its place, with parameters and arguments such as ``-r __ns:=/left``."""
        log = self._log_folder / f"{name}.log"
        self.nodes[name] = NodeProcess(name, parameters, self.environment, log, ros_arguments)
        return self.nodes[name]

    def dead(self) -> list[NodeProcess]:
        """Nodes that ended with an error."""
        return [node for node in self.nodes.values() if node.exit_status not in (None, 0)]

    def stop(self) -> None:
        """Interrupt all nodes, the youngest first, and wait for them."""
        nodes = list(self.nodes.values())[::-1]
        for node in nodes:
            node.process.send_signal(signal.SIGINT)
            time.sleep(0.05)
        for node in nodes:
            node.wait()
