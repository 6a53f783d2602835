"""What nodes report of themselves: a state of a few, and the values that msg_conventions.md names."""

import re
import threading
from pathlib import Path

import numpy as np
import pytest
import rclpy
import torch
from node_states import NODE_STATES
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from ros_bench import HEIGHT, WIDTH, K, S, sheet, start_ros
from std_srvs.srv import SetBool

from endo_sim_ros import messages
from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.graph.client import Client
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.messages import (
    ERROR,
    OK,
    SET,
    STATE,
    BagPlayerState,
    IdentificationState,
    PhysicsState,
    PolicyState,
    ReconstructionState,
    RecorderState,
    RenderingState,
    ScriptedToolState,
    ViewerState,
)
from endo_sim_ros.nodes import base
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


def documented_keys(node: str) -> set[str]:
    """The keys in the table `further keys` of msg_conventions.md, and those that every node has."""
    table = CONVENTIONS.split("| node | further keys |")[1]
    (row,) = re.findall(rf"^\| {node} \| (.+) \|$", table, re.M)
    return {STATE, SET, "errors", *re.findall(r"`([^`]+)`", row)}


class Graph:
    """Nodes in this process, each spun in a thread, and a client that hears what they report."""

    def __init__(self):
        self.client = Client()
        self.heard: dict[str, list] = {}  # states of each node, one after the other, as they changed
        self.newest: dict[str, messages.NodeStatus] = {}
        self.undocumented: list[messages.NodeStatus] = []  # with a state or a key that msg_conventions.md does not name
        self._running: list[tuple] = []
        self.client.subscribe(messages.DIAGNOSTICS, self._on_diagnostics)

    def _on_diagnostics(self, message):
        for status in messages.decode_diagnostics(message):
            states = NODE_STATES.get(status.name)
            if states is None:
                continue
            state = status.state(states)
            if state is None or status.values.keys() - documented_keys(status.name):
                self.undocumented.append(status)  # what a callback raises is caught
            self.newest[status.name] = status
            heard = self.heard.setdefault(status.name, [])
            if heard[-1:] != [state]:
                heard.append(state)

    def add(self, node_class):
        node, executor = node_class(), SingleThreadedExecutor()
        node.every(0.02, node.publish_diagnostics)  # so that no state is too short to be heard
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin)
        thread.start()
        self._running.append((node, executor, thread))
        return node

    def until(self, name, state):
        """Wait until a node reports a state."""
        self.client.until(lambda: self.heard.get(name, [None])[-1] is state, f"{name} to be {state}")

    def close(self):
        for node, executor, thread in self._running:
            executor.shutdown()
            thread.join()
            node.destroy_node()
        self.client.destroy_node()


@pytest.fixture
def start(tmp_path):
    """Starts ROS with parameters of nodes, and the client."""
    graphs = []

    def begin(**parameters):
        start_ros(**parameters)
        graphs.append(Graph())
        return graphs[-1]

    yield begin
    for graph in graphs:
        graph.close()
    rclpy.try_shutdown()
    assert not [graph.undocumented for graph in graphs if graph.undocumented]


def send_model(client, model, stamp):
    client.send(messages.TRAINING_CAMERAS, messages.encode_poses([np.eye(4)], stamp, "world"))
    client.send(messages.GAUSSIANS, messages.encode_gaussians(model, stamp, "world"))


def send_recording(client, frames, shift_ns, masked=False):
    for frame in frames:
        stamp, camera = frame.stamp_ns + shift_ns, frame.camera
        client.send(messages.LEFT_INFO, messages.encode_camera_info(camera.K, camera.width, camera.height, stamp, "endoscope_left"))
        client.send(messages.CAMERA_POSE, messages.encode_pose(camera.pose, stamp, "world"))
        client.send(messages.DEPTH, messages.encode_image(frame.depth, stamp, "endoscope_left"))
        mask = np.full(frame.depth.shape, 0 if masked else 255, np.uint8)
        client.send(messages.MASK, messages.encode_image(mask, stamp, "endoscope_left"))
        client.send(messages.LEFT_IMAGE, messages.encode_image(frame.image, stamp, "endoscope_left"))


def test_every_node_reports_a_state_of_its_own_and_only_values_that_are_documented(start, tmp_path):
    viewer_node = pytest.importorskip("endo_sim_ros.nodes.viewer_node", reason="needs viser")
    graph = start(recorder={"bag": tmp_path / "bag"}, reconstruction_node={"output_dir": tmp_path})
    nodes = {
        ReconstructionNode: ReconstructionState.WAITING,
        PhysicsNode: PhysicsState.WAITING,
        RenderingNode: RenderingState.WAITING,
        IdentificationNode: IdentificationState.WAITING,
        viewer_node.ViewerNode: ViewerState.WAITING,
        BagPlayerNode: BagPlayerState.FAILED,  # no bag is given
        RecorderNode: RecorderState.RECORDING,
        PolicyNode: PolicyState.WAITING,
        ScriptedToolNode: ScriptedToolState.WAITING,
    }
    names = {graph.add(node_class).get_name(): state for node_class, state in nodes.items()}
    assert names.keys() == NODE_STATES.keys()
    for name, state in names.items():
        graph.until(name, state)
        graph.client.until(lambda: graph.client.in_state(name, state), f"the client to hear {name}")
    assert not graph.client.in_state("physics_node", RenderingState.RENDERING)
    assert not graph.client.in_state("nobody", PhysicsState.WAITING)


def test_a_reconstruction_goes_through_its_states_in_order(start, small_frames, tmp_path):
    small = {"iterations": 10, "max_gaussians": 500, "image_width": 48, "start_after": 0.5, "output_dir": tmp_path}
    graph = start(reconstruction_node=small)
    graph.add(ReconstructionNode)
    graph.until("reconstruction_node", ReconstructionState.WAITING)
    send_recording(graph.client, small_frames[:5], S)
    graph.until("reconstruction_node", ReconstructionState.DONE)
    order, heard = ["waiting", "collecting", "preparing", "training", "done"], list(graph.heard["reconstruction_node"])
    assert heard == [state for state in order if state in heard]  # a short one may pass between two messages
    assert heard[0] == "waiting" and heard[-1] == "done"
    assert graph.newest["reconstruction_node"].values["saved"].startswith(str(tmp_path))
    send_recording(graph.client, small_frames[:5], 100 * S, masked=True)  # nothing to learn from
    graph.until("reconstruction_node", ReconstructionState.FAILED)
    assert [state for state in graph.heard["reconstruction_node"][len(heard) :] if state != "preparing"] == ["failed"]  # at once
    assert graph.newest["reconstruction_node"].level == ERROR


def test_a_model_file_that_cannot_be_read_is_told_until_there_is_a_model(start, tmp_path, monkeypatch):
    monkeypatch.setattr(base, "_ERROR_SHOWN", 0.0)  # what is told once is gone at once
    missing, good = tmp_path / "missing.ply", tmp_path / "model.ply"
    graph = start(reconstruction_node={"model_file": missing, "output_dir": tmp_path, "image_timeout": 60.0})
    node = graph.add(ReconstructionNode)

    def told(level, text):
        said = lambda: graph.newest["reconstruction_node"][1:3] == (level, text)  # noqa: E731
        graph.client.until(said, repr(text))

    graph.until("reconstruction_node", ReconstructionState.WAITING)
    told(ERROR, f"{missing}: no such file; collecting views, 0 so far")
    assert node.set_parameters([Parameter("model_file", value="")])[0].successful  # nobody wants one any more
    told(OK, "collecting views, 0 so far")
    save_ply(sheet(5), good)
    assert node.set_parameters([Parameter("model_file", value=str(good))])[0].successful
    told(OK, f"published the model of {good}; a recording that comes is reconstructed")


def test_physics_goes_through_its_states_in_order(start):
    graph = start(physics_node={"node_count": 300, "substeps": 40})
    graph.add(PhysicsNode)
    graph.until("physics_node", PhysicsState.WAITING)
    send_model(graph.client, sheet(8).select(torch.arange(2)), 5 * S)  # too few Gaussians
    graph.until("physics_node", PhysicsState.FAILED)
    send_model(graph.client, sheet(), 6 * S)
    graph.until("physics_node", PhysicsState.RUNNING)
    pause = graph.client.create_client(SetBool, "physics_node/pause")
    graph.client.until(pause.service_is_ready, "the service")
    for paused, state in ((True, PhysicsState.PAUSED), (False, PhysicsState.RUNNING)):
        answer = pause.call_async(SetBool.Request(data=paused))
        graph.client.until(answer.done, "an answer")
        graph.until("physics_node", state)
    *before, built, running, paused, resumed = graph.heard["physics_node"]
    assert [built, running, paused, resumed] == ["building", "running", "paused", "running"]
    assert before[0] == "waiting" and set(before[1:]) <= {"building", "failed"}  # building ends at once with so few
    # An error of a message is no state: the tissue goes on.
    graph.client.send(messages.tool_wrench("PSM1"), messages.encode_wrench(np.full(3, np.nan), np.zeros(3), S, "world"))
    graph.client.until(lambda: graph.newest["physics_node"].level == ERROR, "an error")
    assert graph.newest["physics_node"].state(PhysicsState) is PhysicsState.RUNNING
    assert graph.newest["physics_node"].values["mode"] == "realtime"


def test_the_renderer_waits_for_model_and_camera_then_renders(start):
    graph = start()
    graph.add(RenderingNode)
    graph.until("rendering_node", RenderingState.WAITING)
    send_model(graph.client, sheet(), 5 * S)
    graph.client.send(messages.LEFT_INFO, messages.encode_camera_info(K, WIDTH, HEIGHT, S, "endoscope_left"))
    graph.until("rendering_node", RenderingState.RENDERING)
    assert [state for state in graph.heard["rendering_node"] if state != RenderingState.BUILDING] == ["waiting", "rendering"]
    assert graph.newest["rendering_node"].values["following control nodes"] == "False"  # there are none


def test_a_bag_player_is_done_when_all_is_delivered(start, small_bag, tmp_path):
    graph = start()
    heard = []
    graph.client.subscribe(messages.LEFT_IMAGE, heard.append)
    with NodeGroup(tmp_path / "logs") as group:
        player = group.start("bag_player_node", bag=small_bag)
        graph.client.until(lambda: player.exit_status is not None, "the end of the player")
        assert player.exit_status == 0, player.log.read_text()
        graph.client.until(lambda: graph.client.in_state("bag_player", BagPlayerState.DONE), "its last word")
    order = [state.value for state in BagPlayerState]
    places = [order.index(state) for state in graph.heard["bag_player"]]
    assert places == sorted(places) and len(heard) == 12
    assert graph.client.statuses["bag_player"].level == OK
    assert graph.client.number("bag_player", "messages") == graph.client.number("bag_player", "of") > 12
