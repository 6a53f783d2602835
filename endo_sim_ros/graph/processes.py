"""Starts the nodes of the graph as processes of their own."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from endo_sim_ros.nodes.process import PARENT
from endo_sim_ros.nodes.transport import graph_environment

_WARNING = re.compile(r"^\[(?:WARN|WARNING|ERROR|FATAL)\] \[[\d.]+\] \[(.+?)\]: (.+)", re.M)  # as nodes write them
_STOP_AFTER = 15.0  # seconds that a node has to end after an interrupt


@dataclass(frozen=True)
class NodeProcess:
    """One node in its own process."""

    name: str
    log: Path  # what it prints
    process: subprocess.Popen

    @property
    def exit_status(self) -> int | None:
        """Exit status of the process, None while it runs."""
        return self.process.poll()

    def wait(self, seconds: float = _STOP_AFTER) -> int:
        """Exit status; a node that does not end in time is killed."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


class NodeGroup(contextlib.AbstractContextManager):
    """Nodes that live and end together. Use as a context manager."""

    def __init__(self, log_folder: Path) -> None:
        self.environment = graph_environment()
        self._log_folder = log_folder
        self.nodes: dict[str, NodeProcess] = {}

    def __exit__(self, *_: Any) -> None:
        self.stop()

    def start(self, name: str, *ros_arguments: str, **parameters: Any) -> NodeProcess:
        """Start a node, or another one in its place, with parameters and arguments such as ``-r __ns:=/left``.

        The parameters win over those of files among the arguments. They are a file, too: ``-p`` loses to what a file says of one node
        after a section for all.
        """
        environment, log = self.environment | {PARENT: str(os.getpid())}, self._log_folder / f"{name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        arguments = [sys.executable, "-m", f"endo_sim_ros.nodes.{name}", "--ros-args", *ros_arguments]
        if parameters:
            namespace = next((word.removeprefix("__ns:=").rstrip("/") for word in ros_arguments if word.startswith("__ns:=")), "")
            values = {f"{namespace}/*": {"ros__parameters": parameters}}
            file = log.with_suffix(".yaml")
            file.write_text(json.dumps(values, ensure_ascii=False, default=os.fspath), "utf-8")  # texts are quoted, as YAML needs it
            arguments += ["--params-file", str(file)]
        with log.open("wb") as output:
            self.nodes[name] = NodeProcess(name, log, self._launch(arguments, environment, output))
        return self.nodes[name]

    def _launch(self, arguments: list[str], environment: dict[str, str], output: Any) -> Any:
        """Start a process that writes to a file; what it returns has `pid`, `poll`, `wait`, `send_signal` and `kill` of one."""
        return subprocess.Popen(arguments, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)

    def dead(self) -> list[NodeProcess]:
        """Nodes that ended with an error."""
        return [node for node in self.nodes.values() if node.exit_status not in (None, 0)]

    def warnings(self) -> list[str]:
        """Warnings and errors in the logs, each after the name of its node; of those that differ in numbers alone the first."""
        said: dict[tuple[str, str], str] = {}
        for node in self.nodes.values():
            for name, text in _WARNING.findall(node.log.read_text("utf-8", errors="replace")):
                said.setdefault((name, re.sub(r"-?\d[\d.]*", "#", text)), f"{name}: {text}")
        return list(said.values())

    def stop(self) -> None:
        """Interrupt all nodes, the youngest first, and wait for them."""
        nodes = list(self.nodes.values())[::-1]
        for node in nodes:
            node.process.send_signal(signal.SIGINT)
            time.sleep(0.05)
        for node in nodes:
            node.wait()
