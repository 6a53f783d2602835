"""A graph under random traffic, valid and not: does every node live, keep its memory, and still work afterwards?"""

import array
import copy
import os
import random
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rclpy
from rclpy.utilities import try_shutdown
from rich.progress import Progress

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.core.frames import LEFT_FRAME
from endo_sim_ros.evaluation.measurement import Row, report, status_kilobytes
from endo_sim_ros.graph.client import ARM, CHANGED, Client, depth_of, tissue
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.instruments.kinematics import JOINTS
from endo_sim_ros.messages import ERROR, ReconstructionState, Topic
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

_NODES = ("reconstruction_node", "physics_node", "rendering_node")
_WIDTH, _HEIGHT = 96, 80  # pixels of the images; small, for many messages
_SETTLED = 0.25  # part of the time after which memory is compared: caches and pools are full by then
_VALID = 0.5  # part of the messages that are left as they are
_FLOATS = (0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), float("-inf"), 1e-320, 1e30, -1e300)
_TEXTS = ("", "world", "rgb8", "16UC1", "32FC1", "PSM1", "nowhere", "ü" * 100, "a" * 10_000, "../../etc", "\n\t%s{}")
_BITS = {"int8": -8, "uint8": 8, "int16": -16, "uint16": 16, "int32": -32, "uint32": 32, "int64": -64, "uint64": 64}


def spoil(message: Any, rng: random.Random) -> None:
    """Set random fields of a ROS message, at any depth, to values of the right type that make little sense."""
    fields = message.get_fields_and_field_types()
    for name in rng.sample(list(fields), rng.randint(1, len(fields))):
        kind, value = fields[name], getattr(message, name)
        if hasattr(value, "get_fields_and_field_types"):
            spoil(value, rng)
        elif isinstance(value, str):
            setattr(message, name, rng.choice(_TEXTS))
        elif isinstance(value, bool):
            setattr(message, name, rng.random() < 0.5)
        elif isinstance(value, float):
            limit = 3e38 if kind == "float" else 1e308  # rclpy refuses what the field cannot hold
            setattr(message, name, float(np.clip(rng.choice(_FLOATS), -limit, limit)) if rng.random() < 0.8 else rng.gauss(0, 1))
        elif isinstance(value, int) and kind in _BITS:
            bits = _BITS[kind]
            low, high = (-(2 ** (-bits - 1)), 2 ** (-bits - 1) - 1) if bits < 0 else (0, 2**bits - 1)
            setattr(message, name, rng.choice((0, 1, low, high, rng.randint(low, high), min(high, rng.randint(0, 1000)))))
        elif isinstance(value, np.ndarray):  # of fixed length, such as K
            value = value.copy()
            value[rng.randrange(len(value))] = rng.choice(_FLOATS)
            setattr(message, name, value)
        elif isinstance(value, array.array):  # uint8[] and other sequences of numbers
            keep = rng.choice((0, 1, len(value) // 2, max(len(value) - 1, 0), len(value)))
            value = value[:keep]
            if len(value) and rng.random() < 0.5:
                data = bytearray(value.tobytes())
                for _ in range(min(len(data), 16)):
                    data[rng.randrange(len(data))] = rng.randrange(256)
                value = array.array(value.typecode, bytes(data))
            setattr(message, name, value)
        elif isinstance(value, list) and value:
            value = copy.deepcopy(value[: rng.randint(0, len(value))])  # messages share what is in them, such as the fields of clouds
            for item in value:
                if hasattr(item, "get_fields_and_field_types"):
                    spoil(item, rng)
            setattr(message, name, value)


class _Traffic:
    """What anybody might publish on the graph's topics, well made."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self.recording = list(phantom_sequence(PhantomConfig(frames=8, width=_WIDTH, height=_HEIGHT)))
        self._frame = self.recording[0]
        self.scene = tissue(2000, _WIDTH, _HEIGHT)
        self.axes = self.scene.tool_axes
        self._rest = self.scene.model.means.numpy()[:300]

    def message(self, topic: Topic, stamp: int) -> Any:
        """A valid message; ``stamp`` in ns."""
        frame, camera, rng = self._frame, self._frame.camera, self._rng
        if topic in (messages.LEFT_IMAGE, messages.RIGHT_IMAGE):
            return messages.encode_image(frame.image, stamp, LEFT_FRAME)
        if topic in (messages.LEFT_COMPRESSED, messages.RIGHT_COMPRESSED):
            jpeg, header = cv2.imencode(".jpg", frame.image)[1].tobytes(), messages.encode_pose(camera.pose, stamp, LEFT_FRAME).header
            return messages.ros_class(topic.type)(format="jpeg", data=array.array("B", jpeg), header=header)
        if topic in (messages.LEFT_INFO, messages.RIGHT_INFO, messages.TRAINING_CAMERA_INFO):
            return messages.encode_camera_info(camera.K, camera.width, camera.height, stamp, LEFT_FRAME, frame.baseline or 0.0)
        if topic == messages.DEPTH:
            return messages.encode_image(depth_of(frame), stamp, LEFT_FRAME)
        if topic == messages.MASK:
            return messages.encode_image(np.full(frame.image.shape[:2], 255, np.uint8), stamp, LEFT_FRAME)
        if topic == messages.CAMERA_POSE:
            return messages.encode_pose(camera.pose, stamp, "world")
        if topic == messages.GAUSSIANS:
            return messages.encode_gaussians(self.scene.model, stamp, "world")
        if topic == messages.TRAINING_CAMERAS:
            return messages.encode_poses([camera.pose], stamp, "world")
        if topic == messages.CONTROL_NODES:
            F = np.tile(np.eye(3, dtype=np.float32), (len(self._rest), 1, 1))
            state = messages.ControlNodeCloud(self._rest, self._rest + np.float32(1e-3), F, stamp)
            return messages.encode_control_nodes(state, stamp, "world")
        if topic in (messages.tool_pose_command(ARM), messages.tool_move(ARM)):
            tip = self.scene.tip + [rng.gauss(0, 0.01) for _ in range(3)]
            return messages.encode_pose(rigid_pose(self.axes, tip), stamp, "world")
        if topic in (messages.tool_joint_command(ARM), messages.tool_joint_move(ARM)):
            joints = np.array([rng.gauss(0, 0.1) for _ in JOINTS])
            joints[2] = rng.uniform(0.1, 0.2)  # the insertion, m
            return messages.encode_joints(list(JOINTS), joints, np.zeros(0), np.zeros(0), stamp)
        if topic == messages.tool_wrench(ARM):
            return messages.encode_wrench(np.array([rng.gauss(0, 1) for _ in range(3)]), np.zeros(3), stamp, "world")
        if topic == messages.tool_cut(ARM):
            return messages.encode_cut(rng.random() < 0.2, stamp)
        if topic == messages.CUT_SURFACE:
            triangles = self.scene.tip + np.array([rng.gauss(0, 0.01) for _ in range(9)]).reshape(1, 3, 3)
            return messages.encode_cut_surface(triangles, stamp, "world")
        assert topic in (messages.tool_jaw(ARM), messages.tool_jaw_move(ARM)), topic.name
        return messages.encode_jaw(rng.uniform(-0.2, 1.0), stamp)


_TOPICS = (
    *messages.RECORDING_TOPICS, *messages.MODEL_TOPICS, messages.CONTROL_NODES,
    messages.CUT_SURFACE, messages.tool_pose_command(ARM), messages.tool_move(ARM), messages.tool_joint_command(ARM),
    messages.tool_joint_move(ARM), messages.tool_wrench(ARM), messages.tool_jaw(ARM), messages.tool_jaw_move(ARM), messages.tool_cut(ARM),
)  # fmt: skip
_WEIGHTS = [0.02 if topic in messages.MODEL_TOPICS else 0.1 if topic == messages.CONTROL_NODES else 1.0 for topic in _TOPICS]


_HEARD = (  # what is made for those alone who hear it
    messages.RENDERED_COMPRESSED, messages.RENDERED_DEPTH, messages.RENDERED_SEGMENTATION, messages.RENDERED_RIGHT_IMAGE,
    messages.RENDERED_RIGHT_COMPRESSED, messages.tool_reaction(ARM),
)  # fmt: skip


def soak(json_file: Path | None, minutes: float, rate: float = 500.0, seed: int = 0) -> list[Row]:
    """Send random traffic to a graph, then let it do its work; print and return what was measured.

    Args:
        json_file: Where to write the rows.
        minutes: Duration of the traffic.
        rate: Messages a second, on all topics together; half of them spoilt.
        seed: Of the traffic.

    Raises:
        RuntimeError: If a node died, or the graph does not work any more.
    """
    rng, rows = random.Random(seed), []
    traffic = _Traffic(rng)
    parameters = {
        "reconstruction_node": {"iterations": 20, "max_gaussians": 1500, "keyframes": 3, "start_after": 0.5},
        "physics_node": {"node_count": 400, "arms": [ARM], "arm_source": "commanded", "contact_radius": 0.005, "reaction_rate": 500.0},
        "rendering_node": {"baseline": 0.005},
    }
    with tempfile.TemporaryDirectory() as folder, NodeGroup(Path(folder) / "logs") as group:
        parameters["reconstruction_node"]["output_dir"] = str(Path(folder) / "models")
        os.environ.update(group.environment)
        rclpy.init()
        client = Client()
        client.axes, client.pose_topic = traffic.axes, messages.tool_pose_command(ARM)
        for topic in _HEARD:
            client.subscribe(topic, lambda _: None)
        try:
            for name in _NODES:
                group.start(name, **parameters[name])
            for name in _NODES:
                client.until(lambda: name in client.statuses, name)
            rows += _send(client, group, traffic, rng, 60 * minutes, rate)
            rows += _still_works(client, group, traffic)
        finally:
            client.destroy_node()
            try_shutdown()
            report(f"{minutes:g} minutes of random traffic", rows, json_file)
    return rows


def _send(client: Client, group: NodeGroup, traffic: _Traffic, rng: random.Random, seconds: float, rate: float) -> list[Row]:
    begin, sent, spoilt = time.perf_counter(), 0, 0
    used: dict[str, list[float]] = {name: [] for name in _NODES}
    with Progress() as progress:
        task = progress.add_task("random traffic", total=seconds)
        while (now := time.perf_counter() - begin) < seconds:
            (topic,) = rng.choices(_TOPICS, _WEIGHTS)
            message = traffic.message(topic, client.now_ns() + rng.choice((0, 0, 0, -1, 1)) * rng.randint(0, 10**9))
            if rng.random() > _VALID:
                spoil(message, rng)
                spoilt += 1
            client.send(topic, message)
            sent += 1
            client.spin_until(begin + sent / rate)
            client.images, client.states = client.images[-1:], []
            if now > len(used[_NODES[0]]):
                progress.update(task, completed=now)
                for name in _NODES:
                    if group.nodes[name].exit_status is not None:
                        raise RuntimeError(f"{name} ended after {now:.0f} s:\n{group.nodes[name].log.read_text()[-3000:]}")
                    used[name].append(status_kilobytes("VmRSS", group.nodes[name].process.pid) / 1024)
    rows = [Row("messages sent", sent, ""), Row("of them spoilt", spoilt, ""), Row("messages per second", sent / seconds, "1/s")]
    for name in _NODES:
        settled, last = max(used[name][: int(_SETTLED * len(used[name])) + 1]), np.median(used[name][-3:])
        rows.append(Row(f"{name}: memory at the end", last, "MB", last / settled, "most in the first quarter"))
        rows.append(Row(f"{name}: errors told", client.number(name, "errors"), ""))
    return rows


def _still_works(client: Client, group: NodeGroup, traffic: _Traffic) -> list[Row]:
    """A good recording must become a model, and a good push must give pictures that move."""
    begin, scene = time.perf_counter(), traffic.scene
    start, before = client.now_ns(), client.value("reconstruction_node", "saved")

    def reconstructed() -> bool:
        node = "reconstruction_node"
        return client.in_state(node, ReconstructionState.DONE) and client.value(node, "saved") != before

    for frame in traffic.recording:
        stamp, camera = start + frame.stamp_ns, frame.camera
        info = messages.encode_camera_info(camera.K, camera.width, camera.height, stamp, LEFT_FRAME)
        client.send(messages.LEFT_INFO, info)
        client.send(messages.CAMERA_POSE, messages.encode_pose(camera.pose, stamp, "world"))
        client.send(messages.DEPTH, messages.encode_image(depth_of(frame), stamp, LEFT_FRAME))
        client.send(messages.LEFT_IMAGE, messages.encode_image(frame.image, stamp, LEFT_FRAME))
        client.spin_until(time.perf_counter() + 0.05)
    client.until(reconstructed, "a reconstruction")
    stamp = client.now_ns()
    for topic in (messages.LEFT_INFO, messages.CAMERA_POSE, messages.TRAINING_CAMERAS, messages.GAUSSIANS):
        client.send(topic, traffic.message(topic, stamp))
    for name in _NODES:
        # Not OK: they warn that this client publishes their topics, too.
        client.until(lambda: client.statuses[name].level != ERROR, f"{name} to be well again")
    client.until(client.renders_control_nodes, "the renderer to follow")
    client.images.clear()
    client.until(lambda: client.images, "an image")
    at_rest = client.images[-1][2].astype(int)

    def pushed() -> bool:
        client.command(scene.tip, 3 * scene.towards_camera, client.now_ns())
        client.spin_until(time.perf_counter() + 0.04)
        return np.abs(client.images[-1][2].astype(int) - at_rest).max() > CHANGED

    client.until(pushed, "pictures that move")
    return [
        Row("nodes that died", sum(group.nodes[name].exit_status is not None for name in _NODES), f"of {len(_NODES)}"),
        Row("good work again after", time.perf_counter() - begin, "s"),
    ]
