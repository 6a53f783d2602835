"""Pictures of a recorded run in which a tool touched the tissue: video and contact sheet."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.cameras import Camera
from endo_sim_ros.evaluation import figures, metrics
from endo_sim_ros.sequences.bag import BagReader
from endo_sim_ros.sequences.frames import SequenceError

_ARROW_PIXELS = 0.3  # length of the largest force's arrow, in image widths


class TouchReport:
    """What a recorded run shows: rendered images with the tool's force at that time.

    Args:
        recording: Bag with the recording, rendered and tool topics.
        arm: Name of the tool's arm.

    Raises:
        SequenceError: If nothing was rendered while the tool acted.
    """

    def __init__(self, recording: Path, arm: str):
        tip, wrench = messages.tool_pose(arm), messages.tool_wrench(arm)
        wanted = (messages.LEFT_IMAGE, messages.CAMERA_POSE, *messages.RENDERED_TOPICS, tip, wrench)
        self._inputs: list[tuple[np.ndarray, np.ndarray]] = []  # pose and image of the recording
        self._times: list[float] = []
        self._rendered: list[tuple[np.ndarray, Camera, np.ndarray, np.ndarray]] = []  # image, camera, tip, force
        self._rest: tuple[np.ndarray, np.ndarray] | None = None  # image and depth before the tool
        pose, K, seen_from, depth, tool, force = None, None, None, None, np.zeros(3), None
        with BagReader(recording) as bag:
            for topic, stamp_ns, message in bag.messages(wanted):
                if topic == messages.CAMERA_POSE:
                    pose = messages.decode_pose(message, "world", topic.name)
                elif topic == messages.LEFT_IMAGE and pose is not None:
                    self._inputs.append((pose, messages.decode_image(message).copy()))
                elif topic == tip:
                    tool = messages.decode_pose(message, "world", topic.name)[:3, 3]
                elif topic == wrench:
                    force = messages.decode_wrench(message, topic.name)[0]
                elif topic == messages.RENDERED_INFO:
                    K = messages.decode_camera_info(message).P[:, :3]
                elif topic == messages.RENDERED_POSE:
                    seen_from = messages.decode_pose(message, "world", topic.name)
                elif topic == messages.RENDERED_DEPTH and force is None:
                    depth = messages.decode_depth(message)
                elif topic == messages.RENDERED_IMAGE:
                    image = messages.decode_image(message)
                    if force is None:
                        self._rest = (image.copy(), depth)
                    elif seen_from is not None and K is not None:
                        self._times.append(stamp_ns * 1e-9)
                        self._rendered.append((image.copy(), Camera(K, image.shape[1], image.shape[0], seen_from), tool, force))
        if not self._rendered or not self._inputs or self._rest is None or self._rest[1] is None:
            raise SequenceError(f"{recording}: no images were rendered while the tool acted; see the logs beside it")
        largest = max(np.linalg.norm(force) for *_, force in self._rendered)
        _, camera, tip, _ = self._rendered[0]
        distance = float(camera.project(tip[None])[1][0])
        # The largest force is drawn as long as a fixed share of the picture.
        self._scale = _ARROW_PIXELS * camera.width * distance / camera.K[0, 0] / max(largest, 1e-9)

    def _picture(self, index: int) -> np.ndarray:
        image, camera, tip, force = self._rendered[index]
        return figures.draw_force(image, camera, tip, force, self._scale)

    def video(self, fps: float) -> Iterator[np.ndarray]:
        """Frames at a constant rate; the newest image at each time."""
        times = np.array(self._times)
        for moment in np.arange(times[0], times[-1], 1 / fps):
            yield self._picture(int(np.searchsorted(times, moment, "right")) - 1)

    def moments(self) -> tuple[list[tuple[str, np.ndarray]], str]:
        """The labelled pictures of the contact sheet and one line on the quality of the rendering at rest."""
        image, depth = self._rest
        camera = self._rendered[0][1]
        nearest = min(self._inputs, key=lambda item: float(np.linalg.norm(item[0] - camera.pose)))[1]
        reference = cv2.resize(nearest, image.shape[1::-1], interpolation=cv2.INTER_AREA)
        quality = metrics.psnr(image, reference)
        norms = np.array([np.linalg.norm(force) for *_, force in self._rendered])
        acting = np.flatnonzero(norms > 0)
        first, last = int(acting[0]), int(acting[-1])
        moments = [first + (last - first) * share // 100 for share in (30, 55, 85)]
        times = [self._times[index] - self._times[first] for index in moments]
        near, far = np.percentile(depth[depth > 0], [1, 99])
        pictures = [
            ("input view", reference),
            (f"rendered view, {quality:.1f} dB", image),
            (f"rendered depth, {100 * near:.1f} to {100 * far:.1f} cm", figures.color_depth(depth)),
        ]
        pictures += [(f"{norms[i]:.2f} N after {t:.1f} s", self._picture(i)) for i, t in zip(moments, times)]
        return pictures, f"rendered at rest against the input view: {quality:.1f} dB PSNR"
