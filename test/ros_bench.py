"""Nodes in the process of a test, and what a user says to them and hears."""

import contextlib
import time
from collections import defaultdict

import numpy as np
import rclpy
import torch
from rcl_interfaces.srv import SetParameters
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from waiting import wait_until

from endo_sim_ros import messages
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.messages import ERROR
from endo_sim_ros.nodes import tissue_builder
from endo_sim_ros.nodes.base import EndoNode
from endo_sim_ros.nodes.physics_node import PhysicsNode

# In each round an executor asks every publisher and subscription for events of quality of service, which nobody waits for here: that took
# more than all else that it does.
for _kind in (PublisherEventCallbacks, SubscriptionEventCallbacks):
    _kind.create_event_handlers = lambda *_: []
# Physics waits a second for the intrinsics of training cameras, which are not sent here; their poses are sent before the model.
tissue_builder._CAMERAS_LATE = 0.2

S = 1_000_000_000
K = np.array([[90.0, 0, 48], [0, 90.0, 40], [0, 0, 1]])
WIDTH, HEIGHT = 96, 80
SMALL = {
    # Few views, and no stage that takes long: that is for the tests of reconstruction.
    "reconstruction_node": {
        "iterations": 30,
        "max_gaussians": 1500,
        "image_width": WIDTH,
        "start_after": 0.0,
        "keyframes": 3,
        "plane_sweep": False,
        "extrapolation": 0.0,
    },
    # Tests of tips put tips on the tissue, and so few nodes would make thick rods of links.
    "physics_node": {"node_count": 300, "arms": ["PSM1", "PSM2"], "step_duration": 0.02, "force_radius": 0.02, "link_contact": False},
    "rendering_node": {"rate": 20.0, "instruments": False},  # tests of tissue look at tissue
}


class Bench:
    """Nodes in this process, and a user who talks to all nodes of the graph and hears what they say."""

    def __init__(self, executor=SingleThreadedExecutor):
        self.executor = executor()
        self.user = EndoNode("user")
        self.nodes = [self.user]
        self.executor.add_node(self.user)
        self.statuses = defaultdict(list)  # (level, text, values) by node name
        self.heard = defaultdict(list)  # messages by topic name
        self._publishers = {}
        self.user.subscribe(messages.DIAGNOSTICS, self._on_diagnostics, depth=1000)

    def _on_diagnostics(self, message):
        for name, *status in messages.decode_diagnostics(message):
            self.statuses[name].append(status)

    def add(self, node_class):
        node = node_class()
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def hear(self, topic):
        self.user.subscribe(topic, self.heard[topic.name].append)
        return self.heard[topic.name]

    def publish(self, topic, message):
        publisher = self._publishers.get(topic)
        if publisher is None:
            publisher = self._publishers[topic] = self.user.publisher(topic, depth=200)
            self.until(publisher.get_subscription_count, f"a subscriber of {topic.name}")
        publisher.publish(message)

    def until(self, condition, what="a condition", seconds=20.0):
        return wait_until(condition, seconds, what, lambda: self.executor.spin_once(timeout_sec=0.02))

    def spin(self, seconds):
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.02)

    def status(self, name, text, level=None, since=0):
        """Wait until a node says something that contains a text; returns (level, text, values)."""

        def found():
            said = [s for s in self.statuses[name][since:] if text in s[1] and level in (None, s[0])]
            return said[-1] if said else None

        return self.until(found, lambda: f"{name} to say {text!r}; it said {self.statuses[name][-3:]}")

    def refused(self, name, text, *others):
        """Wait for one clear sentence about an error on /diagnostics."""
        level, sentence, _ = self.status(name, text, ERROR)
        assert "\n" not in sentence and "unexpected" not in sentence and "Traceback" not in sentence
        for other in others:
            assert other in sentence
        return sentence

    def call(self, kind, name, again=8.0, **fields):
        client = self.user.create_client(kind, name)
        self.until(client.service_is_ready, f"the service {name}")
        asked = []  # a killed node's service looks ready for 20 s more, and what is sent to it alone is lost: ask again

        def answered():
            done = next((future for _, future in asked if future.done()), None)
            if done is None and (not asked or time.monotonic() - asked[-1][0] > again):
                asked.append((time.monotonic(), client.call_async(kind.Request(**fields))))
            return done

        future = self.until(answered, f"an answer of {name}")
        self.user.destroy_client(client)
        return future.result()

    def set(self, node, **values):
        """Like `ros2 param set`: (successful, reason) of the last one."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        (*_, result) = self.call(SetParameters, f"/{node}/set_parameters", parameters=parameters).results
        return result.successful, result.reason

    def close(self):
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()


def start_ros(**parameters):
    """Start ROS with parameters of nodes in this process, by the name of the node."""
    given = [f"{node}:{name}:={value}" for node, values in parameters.items() for name, value in values.items()]
    rclpy.init(args=["--ros-args", *(word for each in given for word in ("-p", each))])


@contextlib.contextmanager
def tissue_bench(*heard, executor=SingleThreadedExecutor, **parameters):
    """A user who hears topics, and a physics node with tissue whose parameters differ from those in SMALL.

    `EventsExecutor`, which the nodes have, keeps up with many topics, but fails where others come and go.
    """

    start_ros(physics_node=SMALL["physics_node"] | parameters)
    bench = Bench(executor)
    try:
        for topic in (messages.CONTROL_NODES, *heard):
            bench.hear(topic)
        bench.add(PhysicsNode)
        send_model(bench)
        await_nodes(bench, 5 * S)
        yield bench
    finally:
        bench.close()
        rclpy.try_shutdown()


def sheet(side=30, z=0.1, half=0.05, tilt=0.0):
    """A flat piece of tissue in front of the camera, with a pattern that shows how it moves.

    With a tilt the order of the Gaussians in depth is clear; without, the least movement changes it and the picture.
    """
    x, y = torch.meshgrid(torch.linspace(-half, half, side), torch.linspace(-half, half, side), indexing="ij")
    points = torch.stack([x, y, z + tilt * (x + 0.6 * y)], -1).reshape(-1, 3)
    stripes = 0.5 + 0.4 * torch.sin(points[:, 0] * 400) * torch.cos(points[:, 1] * 300)
    colors = torch.stack([stripes, 0.6 * stripes, 0.3 + 0 * stripes], 1)
    return GaussianModel.from_points(points, colors, torch.full((len(points),), half / side), opacity=0.95)


def send_model(bench, model=None, stamp=5 * S, cameras=(np.eye(4),), frame="world"):
    if cameras is not None:
        bench.publish(messages.TRAINING_CAMERAS, messages.encode_poses(list(cameras), stamp, frame))
    bench.publish(messages.GAUSSIANS, messages.encode_gaussians(model or sheet(), stamp, frame))


def send_camera(bench, pose=None, width=WIDTH, height=HEIGHT, stamp=S):
    matrix = K * [[width / WIDTH], [height / HEIGHT], [1]]
    bench.publish(messages.LEFT_INFO, messages.encode_camera_info(matrix, width, height, stamp, "endoscope_left"))
    bench.publish(messages.CAMERA_POSE, messages.encode_pose(np.eye(4) if pose is None else pose, stamp, "world"))


def send_tip(bench, position=(0, 0, 0.1), arm="PSM1", stamp=S):
    pose = np.eye(4)
    pose[:3, 3] = position
    bench.publish(messages.tool_pose(arm), messages.encode_pose(pose, stamp, "world"))


def send_wrench(bench, force, arm="PSM1", frame="world", stamp=S):
    bench.publish(messages.tool_wrench(arm), messages.encode_wrench(np.array(force), np.zeros(3), stamp, frame))


def send_frames(bench, frames, shift_ns=0, poses=True):
    """A recording, as fast as the executor hears it."""
    for frame in frames:
        stamp, camera = frame.stamp_ns + shift_ns, frame.camera
        size = camera.width, camera.height
        info = messages.encode_camera_info(camera.K, *size, stamp, "endoscope_left")
        bench.publish(messages.LEFT_INFO, info)
        if poses:
            bench.publish(messages.CAMERA_POSE, messages.encode_pose(camera.pose, stamp, "world"))
        bench.publish(messages.LEFT_IMAGE, messages.encode_image(frame.image, stamp, "endoscope_left"))
        bench.publish(messages.DEPTH, messages.encode_image(frame.depth, stamp, "endoscope_left"))
        for _ in range(10):
            bench.executor.spin_once(timeout_sec=0)


def nodes_of(bench):
    """The newest control nodes."""
    return messages.decode_control_nodes(bench.heard["control_nodes"][-1])


def await_nodes(bench, stamp_ns):
    bench.until(
        lambda: bench.heard["control_nodes"] and nodes_of(bench).model_stamp_ns == stamp_ns,
        f"control nodes of the model {stamp_ns}",
    )
    return nodes_of(bench)


def report(message):
    """What a message of the types of CRTK says, which are strings where those are not installed."""
    if hasattr(message, "state"):
        return f"{message.state} BUSY" if message.is_busy else message.state
    return messages.decode_state_command(message)


def moved(bench):
    """Largest distance of a control node from rest, metres."""
    return np.linalg.norm(nodes_of(bench).positions - nodes_of(bench).rest, axis=1).max()


def pull(bench, condition, force=(0, 0, -1.0), position=(0, 0, 0.1), what="tissue to move"):
    """Hold a wrench until a condition is true."""

    def step():
        send_tip(bench, position)
        send_wrench(bench, force)
        for _ in range(10):
            bench.executor.spin_once(timeout_sec=0.005)

    wait_until(condition, 20, what, step)


def newest_image(bench):
    return messages.decode_image(bench.heard["rendered/image_raw"][-1]).astype(int)


def await_image(bench, condition=lambda image: True, what="an image"):
    seen = bench.heard["rendered/image_raw"]
    bench.until(lambda: seen and condition(newest_image(bench)), what)
    return newest_image(bench)
