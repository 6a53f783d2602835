"""msg_conventions.md against the code, and against running nodes."""

import re
from collections import defaultdict
from pathlib import Path

import pytest
import rclpy
from node_states import NODE_STATES

from endo_sim_ros import messages
from endo_sim_ros.messages import STATE
from endo_sim_ros.nodes.bag_player_node import BagPlayerNode
from endo_sim_ros.nodes.identification_node import IdentificationNode
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.policy_node import PolicyNode
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNode
from endo_sim_ros.nodes.recorder_node import RecorderNode
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.nodes.scripted_tool_node import ScriptedToolNode

pytestmark = pytest.mark.dds

CONVENTIONS = (Path(__file__).parents[2] / "msg_conventions.md").read_text()
NOT_RECORDED = tuple(
    topic("PSM1")
    for topic in (
        messages.tool_state, messages.tool_state_command, messages.tool_state_name, messages.tool_info, messages.tool_warning,
        messages.tool_error,
    )
)  # fmt: skip
OF_ROS = ("/parameter_events", "/rosout")


def rows(*header: str) -> list[list[str]]:
    """The cells of all rows of all tables that have these columns first."""
    found, inside = [], False
    for line in CONVENTIONS.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if not cells:
            inside = False
        elif inside and not set(line) <= set("|-"):
            found.append(cells)
        elif cells[: len(header)] == list(header):
            inside = True
    return found


TOPICS = {row[0].strip("`"): row[1:] for row in rows("topic", "type", "QoS", "rate", "publishers", "subscribers")}


def queues(cell: str) -> dict[str, tuple[int, int]]:
    """Depth of the queue of each node, in real time and in lockstep, of a cell such as ``physics_node 20/1000, policy 20``."""
    found = re.findall(r"([\w ]+?) (\d+)(?:/(\d+))?(?:, |$)", cell)
    return {name: (int(depth), int(lockstep or depth)) for name, depth, lockstep in found}


@pytest.fixture(scope="module")
def ends(tmp_path_factory, small_bag, joint_policy):
    """Every publisher and subscriber of every node, as (kind, node, lockstep, topic, type, profile)."""
    viewer_node = pytest.importorskip("endo_sim_ros.nodes.viewer_node", reason="needs viser")
    found = []

    def look(node_class: type, lockstep: bool = False, **parameters: str) -> None:
        rclpy.init(args=["--ros-args", *(word for name, value in parameters.items() for word in ("-p", f"{name}:={value}"))])
        node = node_class()
        try:
            for kind, several in (("publishers", node.publishers), ("subscribers", node.subscriptions)):
                for end in several:
                    topic = node.resolve_topic_name(end.topic_name if kind == "subscribers" else end.topic)
                    if topic.startswith("/ECM/") and topic != f"/{messages.CAMERA_POSE.name}":  # those of any arm
                        topic = topic.replace("ECM", "PSM1")
                    topic = topic.replace("/PSM2/", "/PSM1/")
                    package, _, name = end.msg_type.__module__.partition(".msg")[0], None, end.msg_type.__name__
                    found.append((kind, node.get_name(), lockstep, topic, f"{package}/{name}", end.qos_profile))
        finally:
            node.destroy_node()
            rclpy.try_shutdown()

    models, made = str(tmp_path_factory.mktemp("models")), tmp_path_factory.mktemp("recorded")
    for mode in ("realtime", "lockstep"):
        for source in ("measured", "commanded"):
            look(PhysicsNode, mode == "lockstep", mode=mode, arm_source=source)
        look(PhysicsNode, mode == "lockstep", mode=mode, arm_source="commanded", arms="[PSM1, ECM]")
        look(RenderingNode, mode == "lockstep", mode=mode, thing="handover")
        look(ReconstructionNode, mode == "lockstep", mode=mode, output_dir=models)
    for source in ("measured", "commanded"):
        look(viewer_node.ViewerNode, arm_source=source)
    look(ScriptedToolNode)
    look(IdentificationNode)
    seeing = f"{Path(__file__).parents[1] / 'learning' / 'blue_seeker.py'}:BlueSeeker"
    for mode in ("realtime", "lockstep"):
        for given in ({}, {"task": "camera"}, {"task": "handover"}, {"policy": str(joint_policy)}, {"policy": seeing}):
            look(PolicyNode, mode == "lockstep", mode=mode, **given)
    look(RecorderNode, bag=str(made / "bag"))
    return found


def test_every_topic_has_one_row_with_its_type_and_quality_of_service():
    known = {topic.name: topic for topic in (*messages.all_topics(), *NOT_RECORDED)}
    names = [row[0].strip("`") for row in rows("topic", "type")]
    assert sorted(names) == sorted(known)
    for name, topic in known.items():
        kind, qos = TOPICS[name][:2]
        assert topic.type.replace("/msg/", "/") in kind.split(" or "), name
        assert (topic.qos, len(kind.split(" or "))) == (qos, 2 if topic in NOT_RECORDED else 1), name


def test_publishers_and_subscribers_are_those_of_the_nodes_with_their_queues(ends):
    depths = {kind: defaultdict(dict) for kind in ("publishers", "subscribers")}  # by topic, then node: in real time, in lockstep
    nodes = {node for _, node, *_ in ends}
    for kind, node, lockstep, topic, _, profile in ends:
        if topic in OF_ROS or (node == "recorder" and kind == "subscribers"):
            continue
        at = depths[kind][topic.lstrip("/")].setdefault(node, [None, None])
        assert at[lockstep] in (None, profile.depth), (topic, node)
        at[lockstep] = profile.depth
    for name, (_, _, _, publishers, subscribers, *_) in TOPICS.items():
        for kind, cell in (("publishers", publishers), ("subscribers", subscribers)):
            told = queues(cell)
            if "every node" in told:
                told |= dict.fromkeys(nodes, told.pop("every node"))
            found = depths[kind].get(name.lstrip("/"), {})
            assert told.keys() == found.keys(), f"{kind} of {name}"
            for node, pair in found.items():
                assert all(depth in (None, there) for depth, there in zip(pair, told[node])), f"{name}, {node}: {pair}"
    assert depths["publishers"].keys() | depths["subscribers"].keys() <= {name.lstrip("/") for name in TOPICS}


def test_types_and_quality_of_service_are_those_of_the_nodes(ends):
    for _, node, _, topic, kind, profile in ends:
        if topic in OF_ROS:
            continue
        told, qos = TOPICS.get(topic, TOPICS.get(topic[1:]))[:2]
        assert kind in told.split(" or "), (node, topic)
        durability = {"stream": "VOLATILE", "latched": "TRANSIENT_LOCAL"}[qos]
        assert (profile.reliability.name, profile.durability.name) == ("RELIABLE", durability), (node, topic)


def test_the_recorder_subscribes_to_all_that_is_recorded(ends):
    (depth,) = re.findall(r"recorder\nsubscribes to every topic with a depth of (\d+)", CONVENTIONS)
    heard = {topic: profile.depth for kind, node, _, topic, _, profile in ends if (kind, node) == ("subscribers", "recorder")}
    # Recorded only where they are named.
    named = {messages.RENDERED_IMAGE, messages.RENDERED_DEPTH, *messages.EXTRA_RENDERED_TOPICS} - {messages.RENDERED_COMPRESSED}
    expected = {f"/{name.lstrip('/')}" for name in TOPICS} - {f"/{topic.name}" for topic in (*NOT_RECORDED, *named)}
    assert heard == dict.fromkeys(expected, int(depth))


def test_the_bag_player_publishes_with_the_queues_that_are_told(small_bag):
    (stream,) = re.findall(r"bag player publishes with a depth of (\d+)", CONVENTIONS)
    rclpy.init(args=["--ros-args", "-p", f"bag:={small_bag}", "-p", "wait_for_subscribers:=3600.0"])
    node = BagPlayerNode()
    listener = rclpy.create_node("listener")
    try:
        kind = messages.ros_class(messages.LEFT_IMAGE.type)
        publisher = lambda: [end for end in node.publishers if end.topic.endswith(messages.LEFT_IMAGE.name)]  # noqa: E731
        for _ in range(1000):
            if publisher():
                break
            rclpy.spin_once(listener, timeout_sec=0.02)
        assert publisher()[0].msg_type is kind and publisher()[0].qos_profile.depth == int(stream)
    finally:
        node.destroy_node()
        listener.destroy_node()
        rclpy.try_shutdown()


def test_every_state_of_every_node_has_a_row_in_order():
    told, node = defaultdict(list), ""
    for name, state, meaning in rows("node", "`state`"):
        node = name or node
        told[node].append(state.strip("`"))
        assert meaning
    assert told == {name: [state.value for state in states] for name, states in NODE_STATES.items()}


def test_a_state_that_is_missing_or_unknown_is_none_of_those_known():
    for values in ({}, {STATE: "dreaming"}, {STATE: ""}, {STATE: "PAUSED"}):
        status = messages.NodeStatus("physics_node", messages.OK, "paused", values)
        assert all(status.state(states) is None for states in NODE_STATES.values())
    for states in NODE_STATES.values():
        for state in states:
            message = messages.encode_diagnostics("node", messages.OK, "", {STATE: state}, 1)
            (status,) = messages.decode_diagnostics(message)
            assert status.state(states) is state and status.values == {STATE: state.value}
