"""The files for other tools: RViz, Foxglove, SROS 2."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
import yaml

from endo_sim_ros import messages
from endo_sim_ros.nodes.bag_player_node import BagPlayerNode
from endo_sim_ros.nodes.base import EndoNode
from endo_sim_ros.nodes.identification_node import IdentificationNode
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.policy_node import PolicyNode
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNode
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.nodes.scripted_tool_node import ScriptedToolNode
from endo_sim_ros.nodes.viewer_node import ViewerNode

CONFIG = Path(__file__).parents[2] / "config"
TYPES = {topic.name.lstrip("/"): topic.type for topic in messages.all_topics()}
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


# Each enclave's node, and the parameters that change what it hears and says; a policy allows what any of them needs.
ENCLAVES = {
    "reconstruction_node": (ReconstructionNode, [[]]),
    "physics_node": (PhysicsNode, [[], ["mode:=lockstep"], ["arm_source:=commanded"]]),
    "rendering_node": (RenderingNode, [[], ["thing:=handover"]]),
    "scripted_tool_node": (ScriptedToolNode, [[]]),
    "identification_node": (IdentificationNode, [[]]),
    "viewer_node": (ViewerNode, [[], ["arm_source:=commanded"]]),
    "policy_node": (
        PolicyNode,
        [
            *([], ["policy:={joint_policy}"], ["task:=camera"], ["task:=handover"]),
            ["task:=tension", "policy:={joint_policy.parent}/two_arms.npz"],
            ["task:=tension", f"policy:={Path(__file__).parents[1] / 'learning' / 'blue_seeker.py'}:BlueSeeker"],
        ],
    ),
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


@pytest.mark.dds
@pytest.mark.parametrize("enclave", ENCLAVES)
def test_policy_allows_what_the_node_uses_and_no_more(enclave, joint_policy):
    policy = ElementTree.parse(CONFIG / "sros2" / "endo_sim.policy.xml").getroot()
    assert policy.tag == "policy" and policy.get("version") == "0.2.0"
    paths = [found.get("path") for found in policy.findall("enclaves/enclave")]
    assert sorted(paths) == sorted(f"/endo_sim/{name}" for name in ENCLAVES)
    profile = policy.find(f"enclaves/enclave[@path='/endo_sim/{enclave}']/profiles/profile")
    node_class, variants = ENCLAVES[enclave]
    needed = {rule: set() for rule in RULES}
    for parameters in variants:
        name, names = used(node_class, [parameter.format(joint_policy=joint_policy) for parameter in parameters])
        assert profile.get("node") == name
        for rule in RULES:
            needed[rule] |= names[rule]
    if node_class is BagPlayerNode:  # says what is in the bag: a recording
        needed["publish"] |= {f"/{topic.name}" for topic in messages.RECORDING_TOPICS}
    permitted = allowed(profile)
    for rule in RULES:
        assert not needed[rule] - permitted[rule], f"{rule}: not allowed by the policy"
        assert not permitted[rule] - needed[rule], f"{rule}: allowed by the policy, not needed"
