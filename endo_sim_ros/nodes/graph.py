"""Starts the nodes of the graph as processes of their own."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

_STOP_AFTER = 15.0  # seconds that a node has to end after an interrupt


def graph_environment() -> dict[str, str]:
    """Environment for a graph on one machine: nothing leaves it, and large messages travel fast.

    What is set already wins.
    """
    environment = dict(os.environ)
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    environment.setdefault(
        "ROS_DOMAIN_ID", str(1 + os.getpid() % 100)
    )  # a graph of our own beside others on this machine
    try:
        limit = int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return environment
    if limit >= 4_000_000:  # with sockets larger than the limit Fast DDS receives nothing
        environment.setdefault(
            "FASTDDS_BUILTIN_TRANSPORTS",
            "LARGE_DATA?max_msg_size=1MB&sockets_size=4MB&non_blocking=true&tcp_negotiation_timeout=50",
        )
    return environment


class NodeProcess:
    """One node in its own process, with its output in a log file."""

    def __init__(
        self,
        name: str,
        parameters: dict[str, Any],
        environment: dict[str, str],
        log: Path,
        ros_arguments: tuple[str, ...] = (),
    ):
        self.name, self.log = name, log
        arguments = [sys.executable, "-m", f"endo_sim_ros.nodes.{name}"]
        if parameters or ros_arguments:
            arguments += ["--ros-args", *ros_arguments]
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            arguments += ["-p", f"{key}:={text}"]
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                arguments, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )

    @property
    def exit_status(self) -> int | None:
        """None while the node runs."""
        return self._process.poll()

    def send_signal(self, number: int) -> None:
        if self.exit_status is None:
            self._process.send_signal(number)

    def interrupt(self) -> None:
        self.send_signal(signal.SIGINT)

    def wait(self, seconds: float = _STOP_AFTER) -> int:
        """Exit status; a node that does not end in time is killed."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


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
        node = NodeProcess(name, parameters, self.environment, log, ros_arguments)
        self.nodes[name] = node
        return node

    def dead(self) -> list[NodeProcess]:
        """Nodes that ended with an error."""
        return [node for node in self.nodes.values() if node.exit_status not in (None, 0)]

    def stop(self) -> None:
        """Interrupt all nodes, the youngest first, and wait for them."""
        nodes = list(self.nodes.values())[::-1]
        for node in nodes:
            node.interrupt()
            time.sleep(0.05)
        for node in nodes:
            node.wait()
