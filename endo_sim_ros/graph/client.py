"""A client of a running graph, as a teleoperation stack is, and tissue to touch."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from rclpy.executors import SingleThreadedExecutor
from rclpy.publisher import Publisher

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, rigid_pose
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.instruments import load_arm, place_arm
from endo_sim_ros.messages import Topic
from endo_sim_ros.nodes.watcher import Watcher
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

ARM = "PSM1"
WORLD = "world"
PATIENCE = 60.0  # s that anything may take
CHANGED = 60  # grey levels by which an image must differ to show that the tissue moved; creeping tissue differs by 1-5


class Client(Watcher):
    """A teleoperation stack: sends poses and wrenches of a tool, receives images and states.

    Args:
        shown: The topic of the images that count; those of the left eye are received in any case.

    Attributes:
        axes: Rotation [3, 3] of the tool in the world.
        pose_topic: Where its pose is sent.
    """

    def __init__(self, shown: Topic = messages.RENDERED_IMAGE) -> None:
        super().__init__("bench")
        self.axes, self.pose_topic = np.eye(3), messages.tool_pose(ARM)
        self.images: list[tuple[float, int, np.ndarray]] = []  # time of arrival s, stamp ns, pixels [H, W, 3]
        self.states: list[tuple[float, int]] = []  # time of arrival s and stamp ns of control_nodes
        self._newest: Any = None  # control_nodes
        self._senders: dict[Topic, Publisher] = {}
        self.subscribe(shown, self._on_image)
        if shown != messages.RENDERED_IMAGE:
            self.subscribe(messages.RENDERED_IMAGE, lambda _: None)
        self.subscribe(messages.CONTROL_NODES, self._on_control_nodes)
        self._spinner = SingleThreadedExecutor()
        self._spinner.add_node(self)

    def _on_image(self, message: messages.Message) -> None:
        stamp = messages.stamp_to_ns(message.header.stamp)
        self.images.append((time.perf_counter(), stamp, messages.decode_image(message)))

    def _on_control_nodes(self, message: messages.Message) -> None:
        self.states.append((time.perf_counter(), messages.stamp_to_ns(message.header.stamp)))
        self._newest = message

    @property
    def model_stamp(self) -> int:
        """Stamp of the model of the newest control nodes, ns."""
        return messages.decode_control_nodes(self._newest).model_stamp_ns

    def send(self, topic: Topic, message: messages.Message) -> None:
        """Publish a message. The first on a topic waits for a subscriber.

        Raises:
            RuntimeError: If nobody subscribes.
        """
        if topic not in self._senders:
            publisher = self._senders[topic] = self.publisher(topic)
            self.until(publisher.get_subscription_count, f"a subscriber of {topic.name}")
        self._senders[topic].publish(message)

    def command(self, tip: np.ndarray, force: np.ndarray, stamp: int) -> None:
        """Send the tip's position [3] (m) and the force on the tissue [3] (N), world, with a stamp in ns.

        Raises:
            RuntimeError: If nobody subscribes.
        """
        self.send(self.pose_topic, messages.encode_pose(rigid_pose(self.axes, tip), stamp, WORLD))
        self.send(messages.tool_wrench(ARM), messages.encode_wrench(force, np.zeros(3), stamp, WORLD))

    def until(self, done: Callable[[], Any], what: str, seconds: float = PATIENCE) -> None:
        """Receive messages until a condition is true.

        Raises:
            RuntimeError: If that takes longer than some seconds; it names what was awaited.
        """
        deadline = time.monotonic() + seconds
        while not done():
            self._spinner.spin_once(timeout_sec=0.005)
            if time.monotonic() > deadline:
                raise RuntimeError(f"waited {seconds:.0f} s in vain for {what}; the nodes reported {self.statuses}")

    def spin_until(self, moment: float) -> None:
        """Receive messages until a time of ``time.perf_counter``, s."""
        while (left := moment - time.perf_counter()) > 0:
            self._spinner.spin_once(timeout_sec=left)

    def number(self, node: str, key: str) -> float:
        """A number that a node reports; not a number where it reports none."""
        return float(self.value(node, key, "nan"))


class Tissue(NamedTuple):
    """Tissue to touch, and the camera that sees it."""

    model: GaussianModel
    camera: Camera
    tip: np.ndarray  # [3] m, world: tissue in the middle of the image

    @property
    def towards_camera(self) -> np.ndarray:
        """Unit vector [3] from the tip to the camera, world."""
        offset = self.camera.position - self.tip
        return offset / np.linalg.norm(offset)

    @property
    def tool_axes(self) -> np.ndarray:
        """Rotation [3, 3] in the world of a tool whose shaft comes into the picture from the side, as arms do."""
        psm = load_arm("PSM", "LARGE_NEEDLE_DRIVER")
        place = place_arm(ARM, psm, self.camera, float(np.linalg.norm(self.tip - self.camera.position)))
        return (place.base @ psm.tip_pose(place.joints))[:3, :3]


def depth_of(frame: Frame) -> np.ndarray:
    """Depth [H, W], metres, of a frame of the synthetic patient, which has it in every frame."""
    assert frame.depth is not None
    return frame.depth


def tissue(gaussians: int, width: int, height: int) -> Tissue:
    """The synthetic patient as so many Gaussians, in an image of this size in pixels."""
    (frame,) = phantom_sequence(PhantomConfig(frames=1, width=width, height=height, stereo=False))
    depth = depth_of(frame)
    points, valid = frame.camera.backproject(depth), depth > 0
    rng = np.random.default_rng(0)
    chosen = rng.choice(np.flatnonzero(valid), gaussians, replace=gaussians > valid.sum())
    radii = depth.ravel()[chosen] / frame.camera.K[0, 0] * 0.5 * np.sqrt(valid.sum() / gaussians)
    model = GaussianModel.from_points(
        torch.from_numpy(points.reshape(-1, 3)[chosen]).float(),
        torch.from_numpy(frame.image.reshape(-1, 3)[chosen] / 255.0).float(),
        torch.from_numpy(radii).float(),
        opacity=0.9,
    )
    return Tissue(model, frame.camera, points[height // 2, width // 2])
