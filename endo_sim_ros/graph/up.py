"""The whole graph from one terminal, where `ros2 launch` is not installed, with a live view of what each node says."""

import difflib
import json
import os
import re
import shlex
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import try_shutdown
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.folders import make_writable
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.messages import ERROR, OK, SET, WARN, NodeStatus
from endo_sim_ros.nodes.configs import NODE_CONFIGS, namespace_arguments
from endo_sim_ros.nodes.transport import prepare_transport
from endo_sim_ros.nodes.watcher import Watcher
from endo_sim_ros.sequences.bag import BagReader

_CANNOT_START = 2  # exit status of a node that was given something it cannot use; see base.run
_SILENT_AFTER = 5.0  # seconds without a word on /diagnostics after which a node counts as silent
_REFRESH = 0.2  # seconds
_FIRST_PAUSE = 1.0  # seconds before a node that crashed is started again; doubled each time it crashes soon
_MOST_CRASHES = 4  # one soon after the other, after which a node stays down
_SOON = 30.0  # seconds after its start
_RECENT, _HOLDS = 30.0, 3.0  # seconds; what a node said that recently is printed again once it says so that long
_TOGETHER = 5.0  # seconds without another node of two before these are told: they are discovered one by one
_LEVELS = {OK: ("ok", "green"), WARN: ("warn", "yellow"), ERROR: ("error", "red")}
# What a process must share with the graph to take part in it.
_SHARED = (
    "ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY", "ROS_DISCOVERY_SERVER",
    "RMW_IMPLEMENTATION", "FASTDDS_BUILTIN_TRANSPORTS", "FASTRTPS_DEFAULT_PROFILES_FILE",
)  # fmt: skip
# The values shown of each node, beside its sentence.
_VALUES = {
    "reconstruction_node": ("views", "loss", "gaussians", "errors"),
    "physics_node": ("nodes", "real-time factor", "milliseconds per step", "errors"),
    "rendering_node": ("images", "milliseconds per image", "errors"),
    "bag_player_node": ("messages", "of", "errors"),
}
_LEARNER, _PLAYER = "reconstruction_node", "bag_player_node"
_NODE_NAMES = {"bag_player_node": "bag_player"}  # where the node is not called like its module


class UpError(RuntimeError):
    """The graph cannot run; the message says which node ended and where its log is."""


class _Row(NamedTuple):
    """What is shown of one node."""

    name: str
    label: str  # of its level, or of what its process does
    color: str
    text: str
    values: str


@dataclass
class _Said:
    """What a node said, as far as it decides what is printed: its level and text without numbers."""

    printed: tuple[str, str] = ("", "")
    now: tuple[str, str] = ("", "")
    since: float = 0.0
    recent: dict[tuple[str, str], float] = field(default_factory=dict)  # when each was said last


class Supervisor:
    """Starts the nodes, notices when one ends, and knows what to show of each."""

    def __init__(self, graph: NodeGroup, namespace: str, console: Console, respawn: bool) -> None:
        self._graph, self._namespace, self._console, self._respawn = graph, namespace.strip("/"), console, respawn
        self._arguments: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {}
        self._began: dict[str, float] = {}
        self._crashes: dict[str, int] = {}  # of each node, one soon after the other
        self._due: dict[str, float] = {}  # when those that crashed are started again
        self.restarted: set[str] = set()
        self._ended: set[str] = set()
        self._said: dict[str, _Said] = {}
        self._twins: list[str] = []
        self._twins_since = 0.0
        self._twins_told: set[str] = set()
        self._set: dict[str, dict[str, Any]] = {}  # parameters of each node, by its full name, that were set while it ran
        self._to_play = False  # the bag, as soon as the one that learns from it listens

    def start(self, name: str, *ros_arguments: str, **parameters: Any) -> None:
        """Start a node, and remember its arguments for when it crashes."""
        self._arguments[name], self._began[name] = (ros_arguments, parameters), time.monotonic()
        self._said.pop(name, None)
        self._graph.start(name, *ros_arguments, **parameters)

    def full_name(self, name: str) -> str:
        """Name of a node on /diagnostics."""
        return f"{self._namespace}/{_NODE_NAMES.get(name, name)}".lstrip("/")

    def new_twins(self, watcher: Watcher) -> list[str]:
        """Names of nodes that exist more than once, because another graph runs in the same domain; each is told once."""
        if self.restarted:  # the one that crashed is still known to others for a while
            return []
        there = ["/".join((space.strip("/"), name)).lstrip("/") for name, space in watcher.get_node_names_and_namespaces()]
        twins, now = [name for name in map(self.full_name, self._graph.nodes) if there.count(name) > 1], time.monotonic()
        if twins != self._twins:
            self._twins, self._twins_since = twins, now
        if now - self._twins_since < _TOGETHER:
            return []
        new = [name for name in twins if name not in self._twins_told]
        self._twins_told.update(new)
        return new

    def note_parameters(self, watcher: Watcher) -> None:
        """Remember what was set while nodes ran, for when they crash."""
        for name in self._graph.nodes:
            full_name = self.full_name(name)
            forgotten = name in self._due and self._crashes[name] > 1  # what was set may be why it crashed
            if not forgotten and watcher.heard.get(full_name, 0.0) > self._began[name]:
                self._set.setdefault(full_name, {}).update(json.loads(watcher.value(full_name, SET, "{}")))

    def check(self) -> None:
        """Report nodes that ended; start those that crashed again after a pause, unless they crash again and again.

        Raises:
            ConfigError: If a node was given something it cannot use.
            UpError: If no node is left.
        """
        for name, node in list(self._graph.nodes.items()):
            status = node.exit_status
            if name in self._due and time.monotonic() >= self._due[name]:
                del self._due[name]
                ros_arguments, parameters = self._arguments[name]
                self._began[name] = time.monotonic()
                self._said.pop(name, None)  # the new one says the same anew
                self._graph.start(name, *ros_arguments, **parameters | self._set.get(self.full_name(name), {}))
                self._to_play |= name == _LEARNER and _PLAYER in self._arguments
                continue
            if status is None or name in self._ended or name in self._due:
                continue
            if status == 0:
                self._ended.add(name)
                continue
            if status == _CANNOT_START:
                raise ConfigError(f"{_last_line(node.log) or f'{name} cannot start'}; its log is {node.log}")
            how = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
            now = time.monotonic()
            crashes = self._crashes[name] = self._crashes.get(name, 0) + 1 if now - self._began[name] < _SOON else 1
            again = self._respawn and crashes < _MOST_CRASHES
            log = node.log
            if again:  # the new process would overwrite the log that tells what went wrong
                log = node.log.replace(node.log.with_suffix(".crashed.log"))
            pause = _FIRST_PAUSE * 2 ** (crashes - 1)
            what = f"it is started again in {pause:g} s" if again else "it stays down"
            if again and (live := self._set.get(self.full_name(name))):
                if crashes > 1:  # they may be why
                    del self._set[self.full_name(name)]
                what += f", {'without' if crashes > 1 else 'with'} what was set while it ran: {', '.join(live)}"
            if crashes == _MOST_CRASHES:
                how += f", {crashes} times in a row within {_SOON:g} s of its start"
            self._console.print(Text.assemble((f"{name} {how}", "red"), f"; {what}; its log is {log}"), soft_wrap=True)
            if again:
                self.restarted.add(name)
                self._due[name] = now + pause
            else:
                self._ended.add(name)
        if self._ended >= self._graph.nodes.keys() - {_PLAYER}:
            raise UpError("no node is left")

    def start_player(self, *ros_arguments: str, **parameters: Any) -> None:
        """Play the bag once the reconstruction_node is there: what is played before is lost to it."""
        self._arguments[_PLAYER], self._to_play = (ros_arguments, parameters), True

    def play(self, watcher: Watcher) -> None:
        """Play the bag, or play it again for a reconstruction_node that was started again: it knows nothing of what came before."""
        if not self._to_play or watcher.heard.get(self.full_name(_LEARNER), 0.0) < self._began[_LEARNER]:
            return
        self._to_play = False
        player, (ros_arguments, parameters) = self._graph.nodes.get(_PLAYER), self._arguments[_PLAYER]
        if player is not None:
            if player.exit_status is None:
                player.process.send_signal(signal.SIGINT)
                player.wait()
            self._ended.discard(_PLAYER)
            self._due.pop(_PLAYER, None)
            self._console.print(f"{_PLAYER} plays the bag again for the new {_LEARNER}", highlight=False)
        self.start(_PLAYER, *ros_arguments, **parameters)

    def rows(self, watcher: Watcher) -> list[_Row]:
        """The state of each node."""
        rows = []
        for name, node in self._graph.nodes.items():
            full_name = self.full_name(name)
            heard = watcher.heard.get(full_name, 0.0)
            _, level, text, values = watcher.statuses.get(full_name, NodeStatus(full_name, OK, "", {}))
            shown = ", ".join(f"{key} {values[key]}" for key in _VALUES.get(name, ()) if values.get(key, "0") != "0")
            if node.exit_status is not None:  # what it said last is history unless it finished
                done = node.exit_status == 0
                rows.append(_Row(name, "ended" if done else "down", "dim" if done else "red", text if done else "", shown))
            elif heard < self._began[name]:
                rows.append(_Row(name, "starting", "dim", "", ""))
            elif (silent := time.monotonic() - heard) > _SILENT_AFTER:
                text = f"said nothing for {silent:.0f} s; before: {text}"
                rows.append(_Row(name, "silent", "yellow", text, shown))
            else:
                label, color = _LEVELS.get(level, ("stale", "yellow"))
                rows.append(_Row(name, label, color, text, shown))
        return rows

    def news(self, rows: list[_Row]) -> list[str]:
        """A line for each node that says something new: for output that is not a terminal.

        What two nodes of one name say alternates: it is not printed again until one of them is gone, or both say the same.
        """
        lines, now = [], time.monotonic()
        for row in rows:
            said, text = self._said.setdefault(row.name, _Said()), (row.label, re.sub(r"\d+", "#", row.text))  # not every number on the way
            if said.now != text:
                said.now, said.since = text, now
            said.recent = {old: last for old, last in said.recent.items() if now - last < _RECENT}
            new, said.recent[text] = text not in said.recent, now
            if text != said.printed and (new or now - said.since > _HOLDS):
                said.printed = text
                lines.append(f"{row.name:<20} {row.label:<8} {row.text}")
        return lines


def run_up(
    bag: Path | None,
    params_file: Path | None,
    namespace: str,
    arms: tuple[str, ...],
    model: str,
    logs: Path,
    respawn: bool,
    view: bool = False,
) -> None:
    """Run reconstruction, physics and rendering, a bag player if there is a bag and the page if it is wanted, until interrupted.

    Raises:
        ConfigError, SequenceError: If something given cannot be used; one sentence.
        UpError: If all nodes are down.
    """
    console, logs = Console(), logs.expanduser() / namespace.strip("/")
    common = namespace_arguments(namespace)
    if bag is not None:
        with BagReader(bag.expanduser()) as reader:  # a bag that cannot do is reported before anything starts
            reader.require_recording()
    for path in (params_file, None if model in ("", "latest") else Path(model)):
        if path is not None and not path.expanduser().is_file():
            raise ConfigError(f"{path}: there is no such file")
    if params_file is not None:
        _check_parameters(params_file.expanduser(), console)
    common += ["--params-file", str(params_file.expanduser())] if params_file else []
    make_writable(logs)
    prepare_transport()
    with _asked_to_end() as asked, NodeGroup(logs) as graph:
        graph.environment = dict(os.environ)  # the user's own domain, which other terminals share
        supervisor = Supervisor(graph, namespace, console, respawn)
        supervisor.start("reconstruction_node", *common, **({"model_file": model} if model else {}))
        supervisor.start("physics_node", *common, **({"arms": list(arms)} if arms else {}))
        supervisor.start("rendering_node", *common, **({"arms": list(arms)} if arms else {}))
        if view:
            supervisor.start("viewer_node", *common, **({"arm": arms[0], "arms": list(arms)} if arms else {}))
        if bag is not None:
            supervisor.start_player(*common, bag=bag.expanduser())
        _introduce(console, logs)
        _watch(supervisor, console, asked)
        console.print("ending all nodes")


def _check_parameters(path: Path, console: Console) -> None:
    """Raise ConfigError if a file of parameters cannot be read, or gives none to a node of the graph; warn of a name that is nearly one."""
    shape = "it should hold 'physics_node:', below that 'ros__parameters:', and below that parameters, as endo-sim config prints them"
    try:
        held = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: this is no YAML: {' '.join(str(error).split())}; {shape}") from None
    if not isinstance(held, dict):
        raise ConfigError(f"{path}: there are no parameters of ROS nodes in it; {shape}")
    named = {name.rpartition("/")[2] for name in _named(held)}
    if not named & {*NODE_CONFIGS, "*", "**"}:
        others = f", but those of {', '.join(sorted(named))}" if named else ""
        raise ConfigError(f"{path}: there are no parameters of {', '.join(NODE_CONFIGS)} in it{others}; {shape}")
    stems = {node.removesuffix("_node"): node for node in NODE_CONFIGS}  # executables end in _node, and some nodes do not
    for name in sorted(named - {*NODE_CONFIGS, "*", "**"}):
        if near := difflib.get_close_matches(name.removesuffix("_node"), stems, 1, 0.8):
            text = f"{path}: no node of the graph is named {name}, so that its parameters have no effect (did you mean {stems[near[0]]}?)"
            console.print(text, style="yellow", highlight=False, soft_wrap=True)


def _named(held: dict[Any, Any]) -> Iterator[str]:
    """Names of the nodes in a file of parameters, which may lie below namespaces."""
    for name, below in held.items():
        if isinstance(below, dict):
            yield from [str(name)] if "ros__parameters" in below else _named(below)


def _watch(supervisor: Supervisor, console: Console, asked: threading.Event) -> None:
    """Show the nodes until asked to end."""
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # the signals are heard by the caller
    watcher, executor = Watcher("up"), SingleThreadedExecutor()
    executor.add_node(watcher)
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None
    try:
        if live is not None:
            live.start()
        while not asked.is_set():
            deadline = time.monotonic() + _REFRESH
            while (left := deadline - time.monotonic()) > 0 and not asked.is_set():
                executor.spin_once(timeout_sec=left)
            supervisor.note_parameters(watcher)
            supervisor.check()
            supervisor.play(watcher)
            if twins := supervisor.new_twins(watcher):
                text = f"{', '.join(twins)}: there more than once; does another graph run in this ROS domain?"
                console.print(text, style="yellow", highlight=False, soft_wrap=True)
            rows = supervisor.rows(watcher)
            if live is None:
                for line in supervisor.news(rows):
                    console.print(line, highlight=False, markup=False, soft_wrap=True)
            else:
                live.update(_table(rows), refresh=True)
    finally:
        if live is not None:
            live.stop()
        executor.shutdown()
        watcher.destroy_node()
        try_shutdown()


def _table(rows: list[_Row]) -> Table:
    table = Table(caption="Ctrl-C ends all nodes", caption_justify="left", expand=True)
    for title, width in (("node", 19), ("level", 8)):
        table.add_column(title, width=width, no_wrap=True)
    table.add_column("says", ratio=3)
    table.add_column("values", ratio=2)
    for row in rows:
        table.add_row(row.name, Text(row.label, row.color), Text(row.text), Text(row.values))
    return table


def _introduce(console: Console, logs: Path) -> None:
    """Say where the logs are and how other terminals join."""
    console.print(f"logs: {logs}", highlight=False, soft_wrap=True)
    settings = [f"{name}={shlex.quote(os.environ[name])}" for name in _SHARED if os.environ.get(name)]
    console.print("other terminals join with", highlight=False)
    console.print(f"  export {' '.join(settings)}", highlight=False, markup=False, soft_wrap=True)


@contextmanager
def _asked_to_end() -> Iterator[threading.Event]:
    """An event that is set by the signals that end a program. They interrupt nothing, so that no node is left behind
    half started or half stopped, however often Ctrl-C is pressed."""
    asked = threading.Event()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup has it ignored, to outlive its terminal
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: asked.set()) for number in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else ""
