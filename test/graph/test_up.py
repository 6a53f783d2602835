"""`endo-sim up` as a user runs it."""

import io
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from forked_nodes import ForkedNodes
from rcl_interfaces.srv import GetParameters
from rich.console import Console
from waiting import wait_until

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.graph import up as up_module
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.graph.up import Supervisor, UpError, run_up
from endo_sim_ros.nodes.watcher import Watcher

SMALL = """
/**/reconstruction_node:
  ros__parameters:
    {iterations: 30, max_gaussians: 1000, image_width: 96, keyframes: 3, plane_sweep: false, extrapolation: 0.0, start_after: 0.5,
     output_dir: OUT}
/**/physics_node:
  ros__parameters: {node_count: 300, arms: [PSM1]}
"""
# `endo-sim` with one node of the graph, where the others would only take time to start.
ALONE = """
import sys
from endo_sim_ros import cli
from endo_sim_ros.graph.up import Supervisor

start, alone = Supervisor.start, sys.argv.pop(1)
Supervisor.start = lambda self, name, *words, **values: name == alone and start(self, name, *words, **values)
sys.exit(cli.main())
"""
INCLUSION = "sphere 0 0 0.12 0.01 young_modulus=40000"


class Up:
    """`endo-sim up` with its output in a file, with all nodes or one `alone`."""

    def __init__(self, folder: Path, *options: str, alone: str = ""):
        self.folder, self.output = folder, folder / "output.txt"
        params = folder / "params.yaml"
        params.write_text(SMALL.replace("OUT", str(folder / "models")))
        command = [sys.executable, *(("-c", ALONE, alone) if alone else ("-m", "endo_sim_ros.cli"))]
        command += ["up", "--logs", str(folder / "logs"), "--params-file", str(params), *options]
        self.process = subprocess.Popen(command, stdout=self.output.open("w"), stderr=subprocess.STDOUT, start_new_session=True)

    def says(self, pattern: str, seconds: float = 120.0) -> re.Match:
        found = lambda: re.search(pattern, self.output.read_text())  # noqa: E731
        return wait_until(found, seconds, lambda: f"{pattern!r} in: {self.output.read_text()}")

    def processes(self) -> dict[str, int]:
        """Process number of each node."""
        listing = subprocess.run(["ps", "-ww", "-eo", "pid,args"], capture_output=True, text=True).stdout
        mine = [line.split() for line in listing.splitlines() if str(self.folder) in line and "endo_sim_ros.nodes." in line]
        return {re.search(r"endo_sim_ros\.nodes\.(\w+)", " ".join(words))[1]: int(words[0]) for words in mine}

    def end(self, number: int = signal.SIGINT) -> int:
        """Exit status."""
        self.process.send_signal(number)
        return self.process.wait(120)

    def kill(self, nodes: int) -> None:
        """Kill it and see that its nodes, so many, end, too, and say nothing of it."""
        assert len(self.processes()) == nodes
        self.process.kill()
        self.process.wait(60)
        wait_until(lambda: not self.processes(), 120, lambda: f"the end of {self.processes()}")  # importing alone may take 10 s
        for log in (self.folder / "logs").iterdir():
            assert "Traceback" not in log.read_text(), log.read_text()


@pytest.fixture
def up(tmp_path):
    started = []

    def start(*options: str, alone: str = "") -> Up:
        started.append(Up(tmp_path, *options, alone=alone))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.end(signal.SIGTERM)
        for number in one.processes().values():  # only when a test failed
            os.kill(number, signal.SIGKILL)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.dds
def test_up_runs_the_graph_plays_the_bag_again_to_a_new_reconstruction_and_ends_cleanly(up, small_bag):
    """All nodes in a namespace reach their work, and Ctrl-C, even pressed twice, ends all of them."""
    run = up("--bag", str(small_bag), "--namespace", "left", "--arms", "PSM1", "PSM2")
    run.says(rf"export ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} ")
    run.says(r"bag_player_node +ended +finished")
    run.says(r"reconstruction_node +ok +finished")
    run.says(r"physics_node +ok +running")
    run.says(r"rendering_node +ok +rendering")
    assert set(run.processes()) == {"reconstruction_node", "physics_node", "rendering_node"}
    os.kill(run.processes()["reconstruction_node"], signal.SIGKILL)
    run.says(r"reconstruction_node was ended by SIGKILL; it is started again(.*\n)*reconstruction_node +ok +finished")
    assert "bag_player_node plays the bag again for the new reconstruction_node" in run.output.read_text()
    run.process.send_signal(signal.SIGINT)
    assert run.end() == 0, run.output.read_text()
    assert not run.processes()
    assert "Traceback" not in run.output.read_text()
    for log in (run.folder / "logs" / "left").iterdir():
        assert "Traceback" not in log.read_text(), log.read_text()


@pytest.mark.dds
def test_up_reports_a_node_that_dies_and_starts_it_again_and_no_node_outlives_a_killed_up(up):
    run = up()
    run.says(r"rendering_node +warn")
    run.says(r"physics_node +warn")
    first = run.processes()["rendering_node"]
    os.kill(first, signal.SIGKILL)
    said = run.says(r"rendering_node was ended by SIGKILL; it is started again in 1 s; its log is (\S+)")
    assert Path(said[1]).is_file()
    second = wait_until(lambda: run.processes().get("rendering_node"), 120, "a new rendering_node")
    assert second != first
    assert run.process.poll() is None and "physics_node" in run.processes(), "the others go on"
    run.says(r"started again(.*\n)*rendering_node +warn")
    run.kill(nodes=3)


@pytest.mark.thorough
@pytest.mark.dds
def test_a_node_that_is_started_again_has_what_was_set_while_it_ran(up, bench):
    run = up("--namespace", "left", alone="physics_node")
    assert bench.set("left/physics_node", young_modulus=40000.0)[0]
    assert bench.set("left/physics_node", regions=[INCLUSION])[0]
    run.says(r"physics_node +warn")
    os.kill(run.processes()["physics_node"], signal.SIGKILL)
    run.says(r"physics_node was ended by SIGKILL; it is started again in 1 s, with what was set while it ran: young_modulus, regions; ")
    wait_until(lambda: run.processes().get("physics_node"), 120, "a new physics_node")

    def value(name):
        ask = lambda: bench.call(GetParameters, "/left/physics_node/get_parameters", again=1.0, names=[name]).values  # noqa: E731
        return wait_until(ask, 120, f"the parameter {name}")[0]

    assert value("young_modulus").double_value == 40000.0 and list(value("regions").string_array_value) == [INCLUSION]
    run.says(r"physics_node +starting\s(.*\n)*physics_node +warn")
    os.kill(run.processes()["physics_node"], signal.SIGKILL)
    run.says(r"physics_node was ended by SIGKILL; it is started again in 2 s, without what was set while it ran: young_modulus, regions; ")
    wait_until(lambda: run.processes().get("physics_node"), 120, "a new physics_node")
    assert value("young_modulus").double_value == 10000.0
    assert run.end() == 0


@pytest.mark.dds
def test_what_is_set_before_up_hears_of_a_node_and_right_before_a_crash_is_kept(bench, tmp_path):
    console = Console(file=io.StringIO(), width=200)
    with ForkedNodes(tmp_path) as graph:
        supervisor = Supervisor(graph, "", console, respawn=True)
        supervisor.start("physics_node")
        assert bench.set("physics_node", young_modulus=40000.0)[0]
        watcher = Watcher("up")  # as if DDS had connected it with the node only now
        bench.nodes.append(watcher)
        bench.executor.add_node(watcher)
        bench.until(lambda: "physics_node" in watcher.heard, "a word of the node")
        assert bench.set("physics_node", regions=[INCLUSION])[0]
        os.kill(graph.nodes["physics_node"].process.pid, signal.SIGKILL)
        wait_until(lambda: graph.nodes["physics_node"].exit_status, 60, "its end")
        bench.spin(0.2)
        supervisor.note_parameters(watcher)
        supervisor.check()
        assert "started again in 1 s, with what was set while it ran: young_modulus, regions" in console.file.getvalue()


@pytest.mark.dds
def test_a_node_that_crashes_again_and_again_stays_down_after_the_fourth_time(tmp_path, monkeypatch):
    monkeypatch.setattr(up_module, "_FIRST_PAUSE", 0.01)
    console = Console(file=io.StringIO(), width=200)
    with NodeGroup(tmp_path) as graph:
        supervisor = Supervisor(graph, "", console, respawn=True)
        supervisor.start("no_such_node")
        with pytest.raises(UpError, match="no node is left"):
            wait_until(supervisor.check, 30, "the end")
    said = [line.split(";")[:2] for line in console.file.getvalue().splitlines()]
    ended = "no_such_node ended with status 1"
    assert said[:3] == [[ended, f" it is started again in {pause} s"] for pause in (0.01, 0.02, 0.04)]
    assert said[3:] == [[f"{ended}, 4 times in a row within 30 s of its start", " it stays down"]]


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass in `up`, to be set."""
    now = [100.0]
    monkeypatch.setattr(up_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


def test_what_two_nodes_of_one_name_say_is_printed_once_and_again_when_one_is_left(clock):
    supervisor, printed = Supervisor(SimpleNamespace(nodes={}), "", Console(), respawn=True), []

    def say(label, text):
        clock[0] += 0.5
        printed.extend(line.split(maxsplit=1)[1] for line in supervisor.news([up_module._Row("physics_node", label, "", text, "")]))

    for second in range(120):  # longer than what is recent
        say("ok", f"running for {second} s")
        say("warn", "more than one node")
    assert printed == ["ok       running for 0 s", "warn     more than one node"]
    for _ in range(10):  # the other one is gone
        say("ok", "running for 120 s")
    assert printed[2:] == ["ok       running for 120 s"]
    say("error", "something new")
    assert printed[3:] == ["error    something new"]


def test_nodes_that_are_there_twice_are_named_together_and_once(clock):
    names = ["reconstruction_node", "physics_node", "rendering_node"]
    supervisor, found, told = Supervisor(SimpleNamespace(nodes=dict.fromkeys(names)), "left", Console(), respawn=True), [], []
    watcher = SimpleNamespace(get_node_names_and_namespaces=lambda: [*found, *((name, "/left") for name in names), ("rendering_node", "/")])
    for second in range(60):
        clock[0] += 1.0
        if second in (10, 12, 40):  # discovered one by one
            found.append((names[len(found)], "/left"))
        if twins := supervisor.new_twins(watcher):
            told.append((second, twins))
    assert told == [(17, ["left/reconstruction_node", "left/physics_node"]), (45, ["left/rendering_node"])]
    supervisor, supervisor.restarted = Supervisor(SimpleNamespace(nodes=dict.fromkeys(names)), "left", Console(), respawn=True), {names[0]}
    for _ in range(20):
        clock[0] += 1.0
        assert not supervisor.new_twins(watcher), "the node that crashed is still known"


@pytest.mark.thorough
@pytest.mark.dds
def test_up_without_respawn_leaves_a_dead_node_down(up):
    run = up("--no-respawn")
    run.says(r"rendering_node +starting")
    os.kill(run.processes()["rendering_node"], signal.SIGKILL)
    run.says(r"rendering_node was ended by SIGKILL; it stays down")
    assert run.end(signal.SIGTERM) == 0


@pytest.mark.dds
def test_up_refuses_what_a_node_cannot_use(up):
    """A node that cannot start would fail again: it is not started again, and its reason is told."""
    run = up("--arms", "not/a name", alone="physics_node")
    assert run.process.wait(120) == 2
    assert re.search(r"endo-sim: .*'not/a name' cannot name topics.*; its log is \S+physics_node\.log", run.output.read_text())
    assert not run.processes()


@pytest.mark.thorough
@pytest.mark.dds
def test_starting_nodes_do_not_outlive_a_killed_up(up):
    run = up(alone="physics_node")
    run.says(r"physics_node +starting")
    run.kill(nodes=1)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("physics_node: [", "params.yaml: this is no YAML: .* line 1"),
        ("hello", "there are no parameters of ROS nodes in it; it should hold 'physics_node:'"),
        (
            "/**/phisics_node: {ros__parameters: {node_count: 300}}",
            "there are no parameters of reconstruction_node, .*, but those of phisics_node",
        ),
        ("physics_node: {node_count: 300}", "there are no parameters of reconstruction_node, .* in it; it should hold"),
    ],
)
def test_a_file_without_parameters_is_refused_before_anything_starts(tmp_path, text, sentence):
    (tmp_path / "params.yaml").write_text(text)
    with pytest.raises(ConfigError, match=sentence) as caught:
        run_up(None, tmp_path / "params.yaml", "", (), "", tmp_path / "logs", True)
    assert "\n" not in str(caught.value) and not (tmp_path / "logs").exists()


@pytest.mark.parametrize("text", ["left: {physics_node: {ros__parameters: {node_count: 300}}}", "/**: {ros__parameters: {arms: [PSM1]}}"])
def test_parameters_may_be_those_of_a_namespace_or_of_all_nodes(tmp_path, text):
    (tmp_path / "params.yaml").write_text(text)
    console = Console(file=io.StringIO())
    up_module._check_parameters(tmp_path / "params.yaml", console)
    assert not console.file.getvalue()


@pytest.mark.parametrize(
    "name, meant", [("bag_player_node", "bag_player"), ("policy_node", "policy"), ("phisics_node", "physics_node"), ("my_node", "")]
)
def test_parameters_of_a_name_that_is_nearly_that_of_a_node_are_told(tmp_path, name, meant):
    (tmp_path / "params.yaml").write_text(f"physics_node: {{ros__parameters: {{}}}}\n/**/{name}: {{ros__parameters: {{rate: 5.0}}}}")
    console = Console(file=io.StringIO())
    up_module._check_parameters(tmp_path / "params.yaml", console)
    assert (
        f"no node of the graph is named {name}, so that its parameters have no effect (did you mean {meant}?)" in console.file.getvalue()
    ) == bool(meant)


@pytest.mark.parametrize("given", ["bag", "params_file", "model"])
def test_up_refuses_missing_files_before_it_starts_anything(tmp_path, given):
    options = {"bag": None, "params_file": None, "model": ""}
    options[given] = "/does/not/exist" if given == "model" else Path("/does/not/exist")
    with pytest.raises((ConfigError, SequenceError), match="/does/not/exist"):
        run_up(**options, namespace="", arms=(), logs=tmp_path / "logs", respawn=True)
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    "given, sentence",
    [
        ({"namespace": "1st"}, "namespace: '1st' cannot name topics; use letters, digits and _, and no digit first"),
        ({"namespace": "left/my arm"}, "namespace: 'left/my arm' cannot name topics"),
        ({"logs": "file"}, "file: no files can be written there .*; name another folder"),
    ],
)
def test_up_refuses_a_namespace_or_folder_that_cannot_be(tmp_path, given, sentence):
    (tmp_path / "file").write_text("")
    options = {"namespace": "", "logs": "logs"} | given
    options["logs"] = tmp_path / options["logs"]
    with pytest.raises(ValueError, match=sentence):
        run_up(bag=None, params_file=None, arms=(), model="", respawn=True, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
