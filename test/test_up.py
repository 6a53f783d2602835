"""`endo-sim up` as a user runs it, and the files for other tools: RViz, Foxglove, SROS 2."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
import yaml
from conftest import wait_until
from rich.console import Console

from endo_sim_ros import messages
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.graph import up as up_module
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.graph.up import UpError, _Supervisor, run_up
from endo_sim_ros.nodes.bag_player_node import BagPlayerNode
from endo_sim_ros.nodes.base import EndoNode
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.policy_node import PolicyNode
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNode
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.nodes.scripted_tool_node import ScriptedToolNode
from endo_sim_ros.nodes.viewer_node import ViewerNode

CONFIG = Path(__file__).parents[1] / "config"
TYPES = {topic.name.lstrip("/"): topic.type for topic in messages.all_topics()}
SMALL = """
/**/reconstruction_node:
  ros__parameters: {iterations: 30, max_gaussians: 1000, image_width: 96, output_dir: OUT}
/**/physics_node:
  ros__parameters: {node_count: 300, arms: [PSM1]}
"""


# ------------------------------------------------------------------------------------------------------ endo-sim up


class Up:
    """`endo-sim up` with its output in a file."""

    def __init__(self, folder: Path, *options: str):
        self.folder, self.output = folder, folder / "output.txt"
        params = folder / "params.yaml"
        params.write_text(SMALL.replace("OUT", str(folder / "models")))
        command = [sys.executable, "-m", "endo_sim_ros.cli", "up", "--logs", str(folder / "logs")]
        command += ["--params-file", str(params), *options]
        self.process = subprocess.Popen(command, stdout=self.output.open("w"), stderr=subprocess.STDOUT, start_new_session=True)

    def says(self, pattern: str, seconds: float = 120.0) -> re.Match:
        found = lambda: re.search(pattern, self.output.read_text())  # noqa: E731
        return wait_until(found, seconds, lambda: f"{pattern!r} in: {self.output.read_text()}")

    def processes(self) -> dict[str, int]:
        """Process number of each node."""
        listing = subprocess.run(["ps", "-ww", "-eo", "pid,args"], capture_output=True, text=True).stdout
        mine = [line.split() for line in listing.splitlines() if str(self.folder) in line and "endo_sim_ros.nodes." in line]
        return {re.search(r"endo_sim_ros\.nodes\.(\w+)", " ".join(words))[1]: int(words[0]) for words in mine}

    def end(self, number: int = signal.SIGINT) -> tuple[int, float]:
        """Exit status and the seconds that it took."""
        began = time.monotonic()
        self.process.send_signal(number)
        return self.process.wait(60), time.monotonic() - began


@pytest.fixture
def up(tmp_path):
    started = []

    def start(*options: str) -> Up:
        started.append(Up(tmp_path, *options))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.end(signal.SIGTERM)
        for number in one.processes().values():  # only when a test failed
            os.kill(number, signal.SIGKILL)


def test_up_runs_the_graph_and_ends_cleanly(up, small_bag):
    """All nodes in a namespace reach their work, and Ctrl-C, even pressed twice, ends all of them."""
    run = up("--bag", str(small_bag), "--namespace", "left", "--arms", "PSM1", "PSM2")
    run.says(rf"export ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} ")
    run.says(r"bag_player_node +ended +finished")
    run.says(r"reconstruction_node +ok +finished")
    run.says(r"physics_node +ok +running")
    run.says(r"rendering_node +ok +rendering")
    assert set(run.processes()) == {"reconstruction_node", "physics_node", "rendering_node"}
    run.process.send_signal(signal.SIGINT)
    status, seconds = run.end()
    assert status == 0 and seconds < 15, run.output.read_text()
    assert not run.processes()
    assert "Traceback" not in run.output.read_text()
    for log in (run.folder / "logs" / "left").iterdir():
        assert "Traceback" not in log.read_text(), log.read_text()


def test_up_reports_a_node_that_dies_and_starts_it_again(up):
    run = up()
    run.says(r"rendering_node +warn")
    run.says(r"physics_node +warn")
    first = run.processes()["rendering_node"]
    os.kill(first, signal.SIGKILL)
    said = run.says(r"rendering_node was ended by SIGKILL; it is started again in 1 s; its log is (\S+)")
    assert Path(said[1]).is_file()
    second = wait_until(lambda: run.processes().get("rendering_node"), 30, "a new rendering_node")
    assert second != first
    assert run.process.poll() is None and "physics_node" in run.processes(), "the others go on"
    assert run.end(signal.SIGTERM)[0] == 0


def test_a_node_that_crashes_again_and_again_stays_down_after_the_fourth_time(tmp_path, monkeypatch):
    monkeypatch.setattr(up_module, "_FIRST_PAUSE", 0.01)
    console = Console(file=io.StringIO(), width=200)
    with NodeGroup(tmp_path) as graph:
        supervisor = _Supervisor(graph, "", console, respawn=True)
        supervisor.start("no_such_node")
        with pytest.raises(UpError, match="no node is left"):
            wait_until(supervisor.check, 30, "the end")
    said = [line.split(";")[:2] for line in console.file.getvalue().splitlines()]
    ended = "no_such_node ended with status 1"
    assert said[:3] == [[ended, f" it is started again in {pause} s"] for pause in (0.01, 0.02, 0.04)]
    assert said[3:] == [[f"{ended}, 4 times in a row within 30 s of its start", " it stays down"]]


def test_up_without_respawn_leaves_a_dead_node_down(up):
    run = up("--no-respawn")
    run.says(r"rendering_node +warn")
    os.kill(run.processes()["rendering_node"], signal.SIGKILL)
    run.says(r"rendering_node was ended by SIGKILL; it stays down")
    assert run.end()[0] == 0


def test_up_refuses_what_a_node_cannot_use(up):
    """A node that cannot start would fail again: all end, with its reason."""
    run = up("--arms", "not/a name")
    assert run.process.wait(120) == 1
    assert re.search(r"endo-sim: .*'not/a name' cannot name topics.*; its log is \S+physics_node\.log", run.output.read_text())
    assert not run.processes()


@pytest.mark.parametrize("when", [r"physics_node +starting", r"rendering_node +warn"], ids=["starting", "running"])
def test_nodes_do_not_outlive_a_killed_up(up, when):
    run = up()
    run.says(when)
    assert len(run.processes()) == 3
    run.process.kill()
    run.process.wait(10)
    wait_until(lambda: not run.processes(), 40, lambda: f"the end of {run.processes()}")  # importing alone may take 10 s
    for log in (run.folder / "logs").iterdir():
        assert "Traceback" not in log.read_text(), log.read_text()


@pytest.mark.parametrize("given", ["bag", "params_file", "model"])
def test_up_refuses_missing_files_before_it_starts_anything(tmp_path, given):
    options = {"bag": None, "params_file": None, "model": ""}
    options[given] = "/does/not/exist" if given == "model" else Path("/does/not/exist")
    with pytest.raises((UpError, SequenceError), match="/does/not/exist"):
        run_up(**options, namespace="", arms=(), logs=tmp_path / "logs", respawn=True)
    assert not (tmp_path / "logs").exists()


# ------------------------------------------------------------------------------------------------------ RViz, Foxglove

# Displays of rviz_default_plugins (jazzy) with the message that each shows, and all their properties.
_DISPLAY = {"Class", "Name", "Enabled", "Value"}
RVIZ = {
    "Axes": (None, {"Length", "Radius", "Reference Frame"}),
    "Image": ("sensor_msgs/msg/Image", {"Topic", "Max Value", "Min Value", "Median window", "Normalize Range"}),
    "MarkerArray": ("visualization_msgs/msg/MarkerArray", {"Topic", "Namespaces"}),
    "PointCloud2": (
        "sensor_msgs/msg/PointCloud2",
        {"Topic", "Alpha", "Color", "Color Transformer", "Decay Time", "Position Transformer", "Selectable", "Size (Pixels)",
         "Size (m)", "Style"},
    ),
    "Pose": (
        "geometry_msgs/msg/PoseStamped",
        {"Topic", "Alpha", "Axes Length", "Axes Radius", "Color", "Head Length", "Head Radius", "Shaft Length", "Shaft Radius",
         "Shape"},
    ),
    "Wrench": (
        "geometry_msgs/msg/WrenchStamped",
        {"Topic", "Accept NaN Values", "Alpha", "Arrow Width", "Force Arrow Scale", "Force Color", "History Length",
         "Torque Arrow Scale", "Torque Color"},
    ),
}  # fmt: skip
DURABILITY = {"stream": "Volatile", "latched": "Transient Local"}


def test_rviz_configuration_shows_topics_of_the_contract():
    root = yaml.safe_load((CONFIG / "endo_sim.rviz").read_text())
    assert root.keys() == {"Panels", "Visualization Manager", "Window Geometry"}
    manager = root["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "world"
    latched = {topic.name: topic.qos for topic in messages.all_topics()}
    shown = set()
    for display in manager["Displays"]:
        package, kind = display["Class"].split("/")
        assert package == "rviz_default_plugins"
        message, properties = RVIZ[kind]
        assert display.keys() <= _DISPLAY | properties, display["Name"]
        assert display["Enabled"] == display["Value"], display["Name"]
        if message:
            name = display["Topic"]["Value"]
            assert TYPES[name] == message, name
            assert display["Topic"]["Durability Policy"] == DURABILITY[latched[name]], name
            shown.add(name)
    assert shown >= {
        "rendered/image_raw", "endoscope/left/image_raw", "gaussians", "control_nodes", "tool_markers", "PSM1/measured_cp",
        "PSM1/body/servo_cf", "PSM1/body/measured_cf",
    }  # fmt: skip
    gaussians = next(d for d in manager["Displays"] if d["Name"] == "Gaussians")
    assert gaussians["Color Transformer"] == "RGB8", "the packed field rgb"


def test_foxglove_layout_shows_topics_of_the_contract():
    layout = json.loads((CONFIG / "endo_sim.foxglove.json").read_text())
    assert layout.keys() == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    panels = layout["configById"]
    shown, kinds = {}, {"3D": set(), "Image": set(), "Plot": set(), "DiagnosticSummary": set()}
    for panel, config in panels.items():
        kind = panel.split("!")[0]
        if kind == "3D":
            topics = list(config["topics"])
            assert config["topics"]["/gaussians"]["colorField"] == "rgb" and config["followTf"] == "world"
        elif kind == "Image":
            topics = [config["imageMode"]["imageTopic"], config["imageMode"]["calibrationTopic"]]
        elif kind == "Plot":
            topics = []
            for path in config["paths"]:
                name, field = path["value"].split(".", 1)
                assert TYPES[name.lstrip("/")] == "geometry_msgs/msg/WrenchStamped"
                assert re.fullmatch(r"wrench\.force\.[xyz]", field)
                topics.append(name)
        else:
            topics = [config["topicToRender"]]
        for name in topics:
            assert name.startswith("/") and name[1:] in TYPES, name
        kinds[kind] |= set(topics)
        shown |= dict.fromkeys(topics)
    assert all(kinds.values())
    assert kinds["Plot"] == {"/PSM1/body/servo_cf", "/PSM1/body/measured_cf"}
    assert kinds["DiagnosticSummary"] == {"/diagnostics"}
    assert {"/gaussians", "/control_nodes", "/tool_markers", "/PSM1/measured_cp"} <= kinds["3D"]
    assert {"/rendered/image_raw", "/endoscope/left/image_raw"} <= kinds["Image"]

    def leaves(tree):
        return [tree] if isinstance(tree, str) else leaves(tree["first"]) + leaves(tree["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels), "each panel has its place"


# ------------------------------------------------------------------------------------------------------ SROS 2

# Each enclave's node, and the parameters that change what it hears and says; a policy allows what any of them needs.
ENCLAVES = {
    "reconstruction_node": (ReconstructionNode, [[]]),
    "physics_node": (PhysicsNode, [[], ["mode:=lockstep"], ["arm_source:=commanded"]]),
    "rendering_node": (RenderingNode, [[]]),
    "scripted_tool_node": (ScriptedToolNode, [[]]),
    "viewer_node": (ViewerNode, [[], ["arm_source:=commanded"]]),
    "policy_node": (PolicyNode, [[]]),
    "bag_player_node": (BagPlayerNode, [["bag:=/does/not/exist"]]),
}
RULES = {
    "subscribe": ("topics", "topic"), "publish": ("topics", "topic"), "reply": ("services", "service"), "request": ("services", "service"),
}  # fmt: skip


def allowed(profile: ElementTree.Element) -> dict[str, set[str]]:
    """Absolute names that a profile allows to hear, to say, to answer and to call."""
    assert profile.get("ns") == "/"
    names = {rule: set() for rule in RULES}
    for group in profile:
        (rule,) = group.attrib
        tag, item = RULES[rule]
        assert group.tag == tag and group.get(rule) == "ALLOW" and {entry.tag for entry in group} == {item}
        for entry in group:
            names[rule].add("/" + entry.text.replace("~", profile.get("node")).lstrip("/"))
    return names


def used(node_class: type[EndoNode], parameters: list[str]) -> tuple[str, dict[str, set[str]]]:
    """A node's name and the names that it hears, says, answers and calls."""
    rclpy.init(args=["--ros-args", *(word for value in parameters for word in ("-p", value))])
    node = node_class()
    try:
        me = node.get_name(), node.get_namespace()
        found = {
            "subscribe": node.get_subscriber_names_and_types_by_node(*me),
            "publish": node.get_publisher_names_and_types_by_node(*me),
            "reply": node.get_service_names_and_types_by_node(*me),
            "request": node.get_client_names_and_types_by_node(*me),
        }
        names = {rule: {name for name, _ in pairs} for rule, pairs in found.items()}
        names["subscribe"].add("/clock")  # with use_sim_time
        return node.get_name(), names
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


@pytest.mark.parametrize("enclave", ENCLAVES)
def test_policy_allows_what_the_node_uses_and_no_more(enclave):
    policy = ElementTree.parse(CONFIG / "sros2" / "endo_sim.policy.xml").getroot()
    assert policy.tag == "policy" and policy.get("version") == "0.2.0"
    paths = [found.get("path") for found in policy.findall("enclaves/enclave")]
    assert sorted(paths) == sorted(f"/endo_sim/{name}" for name in ENCLAVES)
    profile = policy.find(f"enclaves/enclave[@path='/endo_sim/{enclave}']/profiles/profile")
    node_class, variants = ENCLAVES[enclave]
    needed = {rule: set() for rule in RULES}
    for parameters in variants:
        name, names = used(node_class, parameters)
        assert profile.get("node") == name
        for rule in RULES:
            needed[rule] |= names[rule]
    if node_class is BagPlayerNode:  # says what is in the bag: a recording
        needed["publish"] |= {f"/{topic.name}" for topic in messages.RECORDING_TOPICS}
    permitted = allowed(profile)
    for rule in RULES:
        assert not needed[rule] - permitted[rule], f"{rule}: not allowed by the policy"
        assert not permitted[rule] - needed[rule], f"{rule}: allowed by the policy, not needed"
