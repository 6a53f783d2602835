"""Pictures of a recorded run in which a tool touched the tissue: video and contact sheet."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core import drawing
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.instruments import load_arm, working_point
from endo_sim_ros.instruments.urdf_reader import load_shape
from endo_sim_ros.sequences.bag import BagReader

_ARROW_PIXELS = 0.3  # length of the largest force's arrow, in image widths
_RENDERED = (*messages.RENDERED_TOPICS, messages.RENDERED_COMPRESSED)  # of the two forms of images either will do
_AHEAD = 0.5  # seconds, ample, by which an instrument may be seen before the first stamp of its pose
_MOMENTS = (0.33, 0.6, 0.9)  # of the time in which the tool acts


class TouchReport:
    """What a recorded run shows: rendered images with the force on the tissue at that time, where the tool works.

    Args:
        recording: Bag with the recording, rendered and tool topics.
        arm: Name of the tool's arm.

    Raises:
        SequenceError: If nothing was rendered while the tool acted.
    """

    def __init__(self, recording: Path, arm: str):
        tip, reaction, kind = messages.tool_pose(arm), messages.tool_reaction(arm), messages.tool_type(arm)
        wanted = (messages.LEFT_IMAGE, messages.CAMERA_POSE, messages.MASK, *_RENDERED, tip, reaction, kind)
        self._inputs: dict[float, dict[str, np.ndarray]] = {}  # image, pose and mask of the recording by time
        self._rendered: dict[float, dict[str, np.ndarray]] = {}  # image, pose, K and depth by time
        poses: list[tuple[float, np.ndarray]] = []  # (time, [4, 4] of the tip in the world)
        felt: list[tuple[float, np.ndarray]] = []  # (time, [3] N on the tool, in the axes of the tip)
        point = np.zeros(3)  # what the tool works with, m, frame of the tip
        with BagReader(recording) as bag:
            for topic, _, message in bag.messages(wanted):
                if topic == kind:
                    name = messages.decode_text(message)
                    point = working_point(load_arm("PSM", name.partition("@")[0]), load_shape(name)[1])
                    continue
                # Times are those of the headers: the recorder may have been late.
                time = messages.stamp_to_ns(message.header.stamp) * 1e-9
                if topic == tip:
                    poses.append((time, messages.decode_pose(message, "world", topic.name)))
                elif topic == reaction:
                    felt.append((time, messages.decode_wrench(message, topic.name)[0]))
                elif topic in _RENDERED:
                    name = messages.RENDERED_IMAGE.name if topic == messages.RENDERED_COMPRESSED else topic.name
                    self._rendered.setdefault(time, {})[name] = _decode(topic, message)
                else:
                    self._inputs.setdefault(time, {})[topic.name] = _decode(topic, message)
        names = [topic.name for topic in messages.RENDERED_TOPICS]
        self._times = [time for time in sorted(self._rendered) if all(name in self._rendered[time] for name in names)]
        began = poses[0][0] if poses and felt else np.inf
        before = [time for time in self._times if time < began]
        self._times = [time for time in self._times if time >= began]
        if not self._times or not before:
            raise SequenceError(f"{recording}: no images were rendered before and while the tool {arm} acted")
        # In real time an image shows the newest links, which may be newer than the state that it is stamped by.
        alone = [time for time in before if time < began - _AHEAD]
        self._rest = alone[-1] if alone else before[0]
        track = _Track(poses)
        self._tips = _Track([(time, pose[:3, :3] @ point + pose[:3, 3]) for time, pose in poses])
        self._forces = _Track([(time, -track.at(time)[:3, :3] @ force) for time, force in felt])
        strongest, force = max(felt, key=lambda sample: float(np.linalg.norm(sample[1])))
        self._largest = float(np.linalg.norm(force))
        # The largest force is drawn as long as a fixed share of the picture.
        camera = self._camera(self._newest(strongest))
        distance = float(camera.project(self._tips.at(strongest)[None])[1][0])
        self._scale = _ARROW_PIXELS * camera.width * distance / camera.K[0, 0] / max(self._largest, 1e-9)

    def _camera(self, time: float) -> Camera:
        view = self._rendered[time]
        height, width = view[messages.RENDERED_IMAGE.name].shape[:2]
        return Camera(view[messages.RENDERED_INFO.name], width, height, view[messages.RENDERED_POSE.name])

    def _picture(self, time: float) -> np.ndarray:
        image = self._rendered[time][messages.RENDERED_IMAGE.name]
        return drawing.draw_force(image, self._camera(time), self._tips.at(time), self._forces.at(time), self._scale)

    def _newest(self, time: float) -> float:
        """Time of the newest image at a time."""
        return self._times[max(int(np.searchsorted(self._times, time, "right")) - 1, 0)]

    def video(self, fps: float) -> Iterator[np.ndarray]:
        """Frames at a constant rate; the newest image at each time."""
        for time in np.arange(self._times[0], self._times[-1], 1 / fps):
            yield self._picture(self._newest(time))

    def moments(self) -> tuple[list[tuple[str, np.ndarray]], str]:
        """The labelled pictures of the contact sheet, and one line on how well tissue at rest is rendered and on the largest force."""
        image = self._rendered[self._rest][messages.RENDERED_IMAGE.name]
        depth = self._rendered[self._rest][messages.RENDERED_DEPTH.name]
        size = image.shape[1::-1]
        pose = self._camera(self._rest).pose
        whole = [view for view in self._inputs.values() if messages.LEFT_IMAGE.name in view and messages.CAMERA_POSE.name in view]
        nearest = min(whole, key=lambda view: float(np.linalg.norm(view[messages.CAMERA_POSE.name] - pose)))
        reference = cv2.resize(nearest[messages.LEFT_IMAGE.name], size, interpolation=cv2.INTER_AREA)
        mask = nearest.get(messages.MASK.name)
        mask = None if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
        quality = metrics.psnr(image, reference, mask)
        acting = [time for time in self._times if self._forces.at(time).any()] or self._times
        first, last = acting[0], acting[-1]
        moments = [self._newest(first + share * (last - first)) for share in _MOMENTS]
        pictures = [
            ("input view", reference),
            (f"rendered view, {quality:.1f} dB", image),
            drawing.depth_panel(depth),
        ]
        for time in moments:
            text = f"{np.linalg.norm(self._forces.at(time)):.2f} N after {time - first:.1f} s"
            pictures.append((text, self._picture(time)))
        felt = f"at most {self._largest:.2f} N on the tool" if self._largest > 0 else "the tool felt no tissue"
        return pictures, f"rendered at rest against the input view: {quality:.1f} dB PSNR; {felt}"


class _Track:
    """A vector that was published over time."""

    def __init__(self, samples: list[tuple[float, np.ndarray]]):
        self._times, self._values = zip(*sorted(samples, key=lambda sample: sample[0]))

    def at(self, time: float) -> np.ndarray:
        """The newest value at a time."""
        return self._values[max(int(np.searchsorted(self._times, time, "right")) - 1, 0)]


def _decode(topic: messages.Topic, message: Any) -> np.ndarray:
    if topic in (messages.LEFT_IMAGE, messages.RENDERED_IMAGE, messages.RENDERED_COMPRESSED):
        return messages.decode_image(message, topic.name).copy()
    if topic in (messages.CAMERA_POSE, messages.RENDERED_POSE):
        return messages.decode_pose(message, "world", topic.name)
    if topic == messages.RENDERED_INFO:
        return messages.decode_camera_info(message, topic.name).P[:, :3]
    if topic == messages.MASK:
        return messages.decode_mask(message)
    return messages.decode_depth(message, topic.name)
