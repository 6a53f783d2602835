"""Nodes as processes: wrong parameters, ends, namespaces, and the loss of each node."""

import signal

import numpy as np
import pytest
from forked_nodes import ForkedNodes
from rclpy.context import Context
from rclpy.node import Node
from ros_bench import SMALL, S, await_image, await_nodes, moved, newest_image, nodes_of, pull, sheet
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.graph.processes import NodeGroup, NodeProcess
from endo_sim_ros.messages import OK, WARN
from endo_sim_ros.sequences.bag import BagReader

pytestmark = pytest.mark.dds


@pytest.fixture
def graph(tmp_path):
    with NodeGroup(tmp_path / "logs") as group:
        yield group


@pytest.fixture
def forked_graph(tmp_path):
    with ForkedNodes(tmp_path / "logs") as group:
        yield group


def log_of(node):
    return node.log.read_text()


def test_warnings_of_logs_are_told_once(tmp_path):
    graph = NodeGroup(tmp_path)
    logs = {
        "physics_node": "[INFO] [17.4] [physics_node]: ready\n[WARN] [17.5] [physics_node]: PSM1: the jaw missed [0.2, -0.1]\n"
        "[ERROR] [17.6] [physics_node]: it ran away\n[WARN] [18.5] [physics_node]: PSM1: the jaw missed [-0.3, 12]\n",
        "scripted_tool_node": "/lark/utils.py: DeprecationWarning: sre\n[WARN] [17.7] [scripted_tool]: no way for über 2 mm\n",
        "recorder_node": "",
        "reconstruction_node": "[WARNING] [17.8] [reconstruction_node]: the tissue is 3 m away\n[INFO] [17.9] [reconstruction_node]: 2\n",
    }
    for name, text in logs.items():
        log = tmp_path / f"{name}.log"
        log.write_text(text, "utf-8")
        graph.nodes[name] = NodeProcess(name, log, None)
    assert graph.warnings() == [
        "physics_node: PSM1: the jaw missed [0.2, -0.1]",
        "physics_node: it ran away",
        "scripted_tool: no way for über 2 mm",
        "reconstruction_node: the tissue is 3 m away",
    ]


def test_wrong_parameters_at_start_end_the_node_with_one_line(forked_graph):
    wrong = {
        "physics_node": (("-p", "young_modulus:=5000"), "young_modulus must be a float, with a decimal point"),
        "rendering_node": (("-p", "device:=tpu"), "unknown device 'tpu'"),
        "recorder_node": (("-p", "arms:=['PSM 1']"), "'PSM 1' cannot name topics"),
        "bag_player_node": (("-p", "nonsense"), "nonsense"),
    }
    nodes = {forked_graph.start(name, *arguments): sentence for name, (arguments, sentence) in wrong.items()}
    for node, sentence in nodes.items():
        assert node.wait(120) == 2
        assert sentence in log_of(node) and "Traceback" not in log_of(node)


def test_unknown_parameters_are_told_with_the_nearest_name_and_the_node_lives(bench, forked_graph, tmp_path):
    params = tmp_path / "params.yaml"
    general = "/**: {ros__parameters: {idle_rate: 2.0, plugh: 1}}"  # the first is rendering_node's
    params.write_text(f"{general}\n/**/physics_node: {{ros__parameters: {{node_count: 200, xyzzy: 1}}}}")
    rclpys = {"use_sim_time": "false", "start_type_description_service": "true", "qos_overrides./clock.subscription.depth": 5}
    known = [word for name, value in rclpys.items() for word in ("-p", f"{name}:={value}")]
    node = forked_graph.start("physics_node", "--params-file", str(params), *known, yuong_modulus=5000.0)
    sentence = "unknown parameters plugh, xyzzy, yuong_modulus (did you mean young_modulus?)"
    _, text, _ = bench.status("physics_node", sentence, WARN)
    assert text == f"waiting for a model on gaussians; {sentence}"
    assert log_of(node).count(sentence) == 1 and "[WARN]" in log_of(node)
    assert bench.set("physics_node", young_modulus=6000.0)[0]


@pytest.mark.parametrize("own", ["/left/player", "/**/player"])
def test_values_reach_a_node_whatever_is_in_them_and_in_files(tmp_path, own):
    class Group(NodeGroup):
        def _launch(self, arguments, environment, output):
            self.words = arguments[3:]  # after python -m MODULE

    given = {"bag": tmp_path / 'run #2: "ü"', "text": "2026", "arms": ["no", "PSM1"], "rate": 1e-05, "loop": True, "count": 5}
    params = tmp_path / "params.yaml"
    params.write_text(f"/**: {{ros__parameters: {{count: 7}}}}\n{own}: {{ros__parameters: {{count: 6, rate: 2.0}}}}")
    group, context = Group(tmp_path), Context()
    group.start("bag_player_node", "-r", "__ns:=/left", "--params-file", str(params), **given)
    context.init(args=group.words)
    node = Node("player", context=context, automatically_declare_parameters_from_overrides=True)
    found = {name: node.get_parameter(name).value for name in given}
    node.destroy_node()
    context.shutdown()
    assert found == given | {"bag": str(given["bag"])}


@pytest.mark.thorough
def test_every_node_ends_by_sigterm_and_without_a_traceback(bench, graph, tmp_path):
    names = ("reconstruction_node", "physics_node", "rendering_node", "recorder_node", "bag_player_node")
    parameters = {"recorder_node": {"bag": tmp_path / "bag"}, "bag_player_node": {"bag": tmp_path / "none"}}
    for name in (*names, "scripted_tool_node"):
        graph.start(name, **parameters.get(name, {}))
    for name in (*names[:3], "recorder", "bag_player", "scripted_tool"):
        bench.until(lambda: bench.statuses[name], f"a word of {name}", 40)
    for node in graph.nodes.values():
        node.process.send_signal(signal.SIGTERM)
    assert [node.wait(60) for node in graph.nodes.values()] == [0] * 6
    for node in graph.nodes.values():
        assert "Traceback" not in log_of(node)
    with BagReader(tmp_path / "bag") as bag:  # what was heard before the end is there
        assert "/diagnostics" in bag.topics


def test_unreadable_bags_are_told_by_players_that_live_on_each_in_its_namespace(bench, small_bag, tmp_path):
    (tmp_path / "truncated.mcap").write_bytes(next(small_bag.glob("*.mcap")).read_bytes()[:5000])
    (tmp_path / "foreign.mcap").write_text("not a bag")
    sentences = {"missing": "no such bag", "truncated": "the bag cannot be read", "foreign": "the bag cannot be read"}
    with ForkedNodes(tmp_path / "a") as a, ForkedNodes(tmp_path / "b") as b, ForkedNodes(tmp_path / "c") as c:
        players = {
            name: group.start("bag_player_node", "-r", f"__ns:=/{name}", bag=tmp_path / f"{name}.mcap")
            for group, name in zip((a, b, c), sentences)
        }
        for name, sentence in sentences.items():
            bench.refused(f"{name}/bag_player", sentence, f"{name}.mcap")
            assert players[name].exit_status is None


def test_two_graphs_in_two_namespaces_do_not_hear_each_other(bench, tmp_path):
    with ForkedNodes(tmp_path / "a") as a, ForkedNodes(tmp_path / "b") as b:
        for group, name in ((a, "a"), (b, "b")):
            group.start("physics_node", "-r", f"__ns:=/{name}", **SMALL["physics_node"])
            bench.status(f"{name}/physics_node", "waiting for a model", WARN)
        heard = [bench.hear(messages.CONTROL_NODES._replace(name=f"{name}/control_nodes")) for name in "ab"]
        in_a = lambda topic: topic._replace(name=f"a/{topic.name}")  # noqa: E731
        bench.publish(in_a(messages.TRAINING_CAMERAS), messages.encode_poses([np.eye(4)], 5 * S, "world"))
        bench.publish(in_a(messages.GAUSSIANS), messages.encode_gaussians(sheet(), 5 * S, "world"))
        bench.until(lambda: heard[0], "control nodes of the first graph")
        said = len(bench.statuses["b/physics_node"])
        bench.status("b/physics_node", "waiting for a model", WARN, since=said)
        assert not heard[1]


def test_whole_graph_starts_in_the_wrong_order_and_survives_the_loss_of_each_node(bench, forked_graph, small_bag, tmp_path):
    options = {name: dict(values) for name, values in SMALL.items()}
    options["reconstruction_node"] |= {"start_after": 0.5, "output_dir": tmp_path / "models"}
    start = lambda name, **more: forked_graph.start(name, **options[name], **more)  # noqa: E731

    def kill(name):
        forked_graph.nodes[name].process.send_signal(signal.SIGKILL)
        assert forked_graph.nodes[name].wait(60) == -signal.SIGKILL
        bench.statuses[name].clear()

    def replay():
        player = forked_graph.start("bag_player_node", bag=small_bag)
        bench.until(lambda: player.exit_status is not None, "the bag to be played", 40)
        assert player.exit_status == 0, log_of(player)

    def followed():
        bench.until(
            lambda: (
                bench.statuses["rendering_node"][-1:] and bench.statuses["rendering_node"][-1][2].get("following control nodes") == "True"
            ),
            lambda: f"the renderer to follow control nodes; it said {bench.statuses['rendering_node'][-1:]}",
            40,
        )

    def pushed():
        """Push the middle of the tissue and see the picture change."""
        followed()
        skin = nodes_of(bench).rest[:60]
        tip = skin[np.linalg.norm(skin - skin.mean(0), axis=1).argmin()]
        bench.heard["rendered/image_raw"].clear()
        at_rest = await_image(bench, lambda image: image.max() > 50, "the tissue")
        pull(
            bench,
            lambda: moved(bench) > 3e-3 and np.abs(newest_image(bench) - at_rest).max() > 8,  # at rest exactly 0
            (1.5, 0, -3.0),
            tip,
            lambda: f"pixels to change; {moved(bench)} m, {bench.statuses['physics_node'][-1:]}",
        )
        far = moved(bench)  # so few nodes creep back the last millimetre for minutes after a long pull
        bench.until(lambda: moved(bench) < 0.5 * far, lambda: f"the tissue to be released; {moved(bench)} of {far} m", 60)
        bench.until(lambda: bench.call(Trigger, "/physics_node/reset").success, "a reset")
        bench.until(lambda: moved(bench) < 1e-4, "the tissue at rest")

    for topic in (messages.CONTROL_NODES, messages.RENDERED_IMAGE, messages.GAUSSIANS):
        bench.hear(topic)
    for name, waiting in (("rendering_node", "waiting for a model"), ("physics_node", "waiting for a model")):
        start(name)
        bench.status(name, waiting, WARN)
    start("reconstruction_node")
    bench.status("reconstruction_node", "collecting views", OK)
    replay()
    bench.status("reconstruction_node", "finished, model saved in", OK)
    pushed()
    first = nodes_of(bench).model_stamp_ns

    kill("physics_node")
    bench.heard["control_nodes"].clear()
    start("physics_node")
    await_nodes(bench, first)  # of the latched model
    pushed()

    kill("rendering_node")
    start("rendering_node")
    pushed()

    kill("reconstruction_node")
    start("reconstruction_node", model_file=next((tmp_path / "models").glob("*/model.ply")))
    bench.until(lambda: nodes_of(bench).model_stamp_ns > first, "control nodes of the model file", 30)
    pushed()
    second = nodes_of(bench).model_stamp_ns

    assert bench.set("reconstruction_node", iterations=100_000, publish_period=0.5)[0]
    replay()
    bench.until(lambda: nodes_of(bench).model_stamp_ns > second, "control nodes of the new replay", 30)
    bench.status("reconstruction_node", "training, iteration", OK)

    forked_graph.stop()  # in the middle of it all; what does not end by itself is killed
    for name, node in forked_graph.nodes.items():
        assert node.exit_status == 0, name
        assert "Traceback" not in log_of(node), log_of(node)
