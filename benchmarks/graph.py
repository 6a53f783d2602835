"""How fast the graph answers, wrench in to image out over DDS, each node in a process of its own; and how soon it does so
again when a node was killed."""

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.utilities import try_shutdown
from rich.progress import track

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import save_cameras
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.evaluation.measurement import Row, machine, report
from endo_sim_ros.graph.client import ARM, CHANGED, PATIENCE, WORLD, Client, Tissue, tissue
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.messages import PhysicsState
from endo_sim_ros.nodes.process import keep_memory

_FORCE = 2.0  # N, towards the camera
_HOLD = 0.6  # seconds between one change of the force and the next
_SOME = np.s_[::4, ::4]  # pixels that are compared: all of them would take as much time as rendering does
_APART = 0.005  # m between the eyes
_SHOWN: dict[str, dict[str, Any]] = {  # what the pictures have: options of rendering_node
    "tissue alone": {"instruments": False},
    "with an instrument": {},
    "with an instrument, both eyes": {"baseline": _APART},
}


def _parameters(mode: str, rate: float, device: str, shown: str = "tissue alone") -> dict[str, dict[str, Any]]:
    """What the nodes under test are started with; what is shown is a key of `_SHOWN`."""
    common = {"mode": mode, "device": device}
    step = {"step_duration": 1 / rate}  # as many steps per second as images
    physics = {**common, **step, "arms": [ARM], "link_contact": False}
    return {"physics_node": physics, "rendering_node": {**common, "rate": rate, **_SHOWN[shown]}}


@contextmanager
def _graph(
    mode: str, scene: Tissue, rate: float, device: str, logs: Path, shown: str = "tissue alone"
) -> Iterator[tuple[Client, NodeGroup]]:
    """Physics and rendering, each its own process, with a model and a camera, and a client that saw the first image."""
    model, camera, _ = scene
    with NodeGroup(logs) as group:
        os.environ.update(group.environment)  # this process joins the same graph
        rclpy.init()
        client = Client(messages.RENDERED_RIGHT_IMAGE if "baseline" in _SHOWN[shown] else messages.RENDERED_IMAGE)
        client.axes = scene.tool_axes
        try:
            nodes = _parameters(mode, rate, device, shown)
            for node, parameters in nodes.items():
                group.start(node, **parameters)
            for node in nodes:
                client.until(lambda: node in client.statuses, node)
            info = messages.encode_camera_info(camera.K, camera.width, camera.height, 1, "endoscope_left")
            client.send(messages.LEFT_INFO, info)
            client.send(messages.CAMERA_POSE, messages.encode_pose(camera.pose, 1, WORLD))
            client.send(messages.TRAINING_CAMERA_INFO, info)  # latched like those below, for nodes that start again
            client.send(messages.TRAINING_CAMERAS, messages.encode_poses([camera.pose], 1, WORLD))
            client.send(messages.GAUSSIANS, messages.encode_gaussians(model, 1, WORLD))
            client.until(lambda: client.images and client.renders_control_nodes(), "the first image of the deformable tissue")
            yield client, group
        finally:
            client.destroy_node()
            try_shutdown()


def _realtime(client: Client, scene: Tissue, rate: float, changes: int, shown: str) -> list[Row]:
    """Latency from a wrench that changes to the first image that shows it, while commands stream; of both eyes to the right one's."""
    client.until(lambda: client.in_state("physics_node", PhysicsState.RUNNING), "the first steps")
    client.command(scene.tip, np.zeros(3), client.now_ns())  # what comes before all are connected arrives late
    if _SHOWN[shown].get("instruments", True):  # else it would be measured how it is prepared, which compiles kernels the first time
        client.until(lambda: client.number("rendering_node", "instruments") > 0, "an instrument in the picture")
    client.spin_until(time.perf_counter() + 1.0)
    latencies, to_state, began = [], [], time.perf_counter()
    skipped, first_state = client.number("physics_node", "skipped steps"), len(client.states)
    pulling, due = False, began
    rng, times = np.random.default_rng(0), []
    for _ in track(range(changes), description=f"real time, {shown}"):
        end = due + _HOLD + rng.uniform(0, 1 / rate)
        pulling = not pulling
        client.spin_until(due)
        before, sent, sent_ns = client.images[-1][2][_SOME].astype(np.int16), time.perf_counter(), client.now_ns()
        while due < end:
            client.spin_until(due)
            client.command(scene.tip, _FORCE * pulling * scene.towards_camera, client.now_ns())
            due += 1 / rate
        seen = ((t, stamp) for t, stamp, image in client.images if t > sent and np.abs(image[_SOME] - before).max() > CHANGED)
        arrived, stamp = next(seen, (np.inf, sent_ns))
        latencies.append(1e3 * (arrived - sent))
        to_state.append(1e-6 * (stamp - sent_ns))
        times.append(_node_times(client))
        del client.images[:-1]
    client.spin_until(time.perf_counter() + 1.5)  # for the last word of the nodes
    elapsed = client.states[-1][0] - client.states[first_state][0]
    states = len(client.states) - 1 - first_state
    skipped = client.number("physics_node", "skipped steps") - skipped
    missed = sum(not np.isfinite(value) for value in latencies)
    return [
        *_latency_rows(f"wrench to image, {rate:g} Hz, {shown}", latencies, times),
        Row(f"of it until the state that is shown, {shown}, p50", float(np.median(to_state)), "ms"),
        Row(f"wrench changes never seen, {shown}", missed, "of " + str(changes)),
        Row(f"states received per second, {shown}", states / elapsed, "1/s"),
        Row(f"steps skipped, {shown}", skipped, f"of {states + skipped:.0f}"),
        Row(f"real-time factor, {shown}", client.number("physics_node", "real-time factor"), ""),
    ]


def _node_times(client: Client) -> tuple[float, float]:
    """Milliseconds of a step and of an image, as the nodes told them last."""
    return client.number("physics_node", "milliseconds per step"), client.number("rendering_node", "milliseconds per image")


def _in_lockstep(client: Client, scene: Tissue, commands: int) -> list[Row]:
    """Latency from a command to its image, each sent when the last was answered."""
    latencies, times, began = [], [], time.perf_counter()
    first = len(client.states)
    for k in track(range(1, commands + 1), description="lockstep"):
        stamp, sent = 1 + k * 40_000_000, time.perf_counter()
        client.command(scene.tip, _FORCE * np.sin(0.2 * k) * scene.towards_camera, stamp)
        client.until(lambda: client.images[-1][1] == stamp, f"the image of command {k}", 10.0)
        latencies.append(1e3 * (client.images[-1][0] - sent))
        times.append(_node_times(client))
        del client.images[:-1]
    rate = commands / (time.perf_counter() - began)
    client.spin_until(time.perf_counter() + 0.5)  # the last state may come after its image
    lost = commands - len({stamp for _, stamp in client.states[first:]})
    return [
        *_latency_rows("command to image, lockstep", latencies, times),
        Row("commands per second, lockstep", rate, "1/s"),
        Row("steps lost, lockstep", lost, f"of {commands}"),
    ]


def _recovery(client: Client, group: NodeGroup, scene: Tissue, rate: float, device: str, kills: int) -> list[Row]:
    """Time from the death of a node, which is started again at once, to pictures that move with the tissue again."""
    with tempfile.TemporaryDirectory() as folder:
        save_ply(scene.model, Path(folder) / "model.ply")
        save_cameras([scene.camera], Path(folder) / "cameras.json")
        model_file = {"reconstruction_node": {"model_file": Path(folder) / "model.ply", "output_dir": folder}}
        nodes = _parameters("realtime", rate, device) | model_file  # this last: from then on its model is the newest
        group.start("reconstruction_node", output_dir=folder)
        client.until(lambda: "reconstruction_node" in client.statuses, "reconstruction_node")
        rows = []
        for node, parameters in nodes.items():
            seconds = []
            for _ in track(range(kills), description=f"{node} killed"):
                model = client.model_stamp
                group.nodes[node].process.send_signal(signal.SIGKILL)
                group.nodes[node].wait()
                began = time.perf_counter()
                group.start(node, **parameters)
                client.spin_until(began + 0.2)  # what was on its way already does not count
                if node in model_file:
                    client.until(lambda: client.model_stamp > model, "control nodes of the model file")
                seconds.append(_until_pictures_move(client, scene, rate) - began)
            rows.append(Row(f"{node} killed: pictures move again after", float(np.median(seconds)), "s"))
            rows.append(Row(f"{node} killed: at the latest after", max(seconds), "s"))
    return rows


def _until_pictures_move(client: Client, scene: Tissue, rate: float) -> float:
    """Pull and let go in turn until two pictures differ, and return when the second came."""
    images = client.images
    images.clear()
    began = time.perf_counter()

    def moved() -> bool:
        del images[1:-1]
        return len(images) > 1 and np.abs(images[-1][2].astype(np.int16) - images[0][2]).max() > CHANGED

    while not moved():
        now = time.perf_counter()
        if now - began > PATIENCE:
            raise RuntimeError(f"bench graph: no picture moved within {PATIENCE:.0f} s; the nodes reported {client.statuses}")
        pulling = int((now - began) / _HOLD) % 2 == 0
        client.command(scene.tip, _FORCE * pulling * scene.towards_camera, client.now_ns())
        client.spin_until(now + 1 / rate)
    return images[-1][0]


def _latency_rows(name: str, milliseconds: list[float], times: list[tuple[float, float]]) -> list[Row]:
    """Latencies beside what a step and an image took in the same time [N, 2], ms; the least that they can be is the sum of these."""
    step, image = (float(value) for value in np.nanmedian(times, axis=0))
    peer, values = "a step and an image", np.percentile(milliseconds, [50, 99], method="higher")
    return [
        *(Row(f"{name}, {label}", float(v), "ms", float(v) / (step + image), peer) for label, v in zip(("p50", "p99"), values)),
        Row(f"{name}: a step", step, "ms"),
        Row(f"{name}: an image", image, "ms"),
    ]


def bench_graph(
    json_file: Path | None,
    gaussians: int = 30_000,
    width: int = 640,
    height: int = 512,
    rate: float = 25.0,
    changes: int = 60,
    commands: int = 200,
    device: str = "auto",
    kills: int = 3,
) -> None:
    """Run the graph in real time and in lockstep, print the results and write them to a file.

    Args:
        json_file: Where to write the rows.
        gaussians: Size of the model.
        width, height: Size of the images, pixels.
        rate: Commands and images per second, Hz.
        changes: Changes of the wrench in real time whose way to the image is timed, for each of what pictures show.
        commands: Commands in lockstep.
        device: Compute device.
        kills: Deaths of each node whose recovery is timed.

    Raises:
        RuntimeError: If a node does not answer.
    """
    keep_memory()  # as the nodes do: docs/graph.md tells readers of images how
    scene = tissue(gaussians, width, height)
    rows = []
    with tempfile.TemporaryDirectory() as logs:
        for shown in _SHOWN:
            with _graph("realtime", scene, rate, device, Path(logs), shown) as (client, group):
                rows += _realtime(client, scene, rate, changes, shown)
                if kills and shown == "tissue alone":
                    rows += _recovery(client, group, scene, rate, device, kills)
        with _graph("lockstep", scene, rate, device, Path(logs)) as (client, _):
            rows += _in_lockstep(client, scene, commands)
    report(f"graph, {gaussians} Gaussians, {width}×{height}, {machine(pick_device(device))}", rows, json_file)
