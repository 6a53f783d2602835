"""The topics of rendered pictures: what is asked for, and how it is published."""

from dataclasses import dataclass, replace

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.messages import CameraInfo, Topic
from endo_sim_ros.nodes.base import EndoNode
from endo_sim_ros.nodes.configs import RenderingNodeConfig
from endo_sim_ros.rendering import View

_EYES = (
    (messages.RENDERED_IMAGE, messages.RENDERED_COMPRESSED, messages.RENDERED_INFO),
    (messages.RENDERED_RIGHT_IMAGE, messages.RENDERED_RIGHT_COMPRESSED, messages.RENDERED_RIGHT_INFO),
)


@dataclass(frozen=True)
class Wanted:
    """What somebody subscribes to beside the image."""

    depth: bool = False
    labels: bool = False
    right: bool = False

    def within(self, other: "Wanted") -> bool:
        """Whether what is wanted here is there."""
        return all(there or not here for here, there in zip(vars(self).values(), vars(other).values()))


@dataclass(frozen=True)
class Shown:
    """What was rendered: the left eye, and the right eye if it was wanted."""

    views: list[View]
    cameras: list[Camera]
    wanted: Wanted
    labels: np.ndarray | None = None


def right_camera(left: Camera, info: CameraInfo) -> Camera:
    """The right eye beside a left one, with its own intrinsics at the size of the left image."""
    pose = left.beside(info.baseline).pose
    return Camera(info.P[:, :3], info.width, info.height, pose).resized(left.width, left.height)


def beside(left: CameraInfo, baseline: float) -> CameraInfo:
    """A right eye like a left one, at a distance from it, metres."""
    P = left.P.copy()
    P[0, 3] = -P[0, 0] * baseline
    return replace(left, P=P)


class RenderedTopics:
    """Publishes pictures.

    Args:
        node: The node that publishes.
    """

    def __init__(self, node: EndoNode) -> None:
        topics = (*messages.RENDERED_TOPICS, *messages.EXTRA_RENDERED_TOPICS)
        self._publishers = {topic: node.publisher(topic, alone=True) for topic in topics}

    def _heard(self, *topics: Topic) -> bool:
        return any(self._publishers[topic].get_subscription_count() > 0 for topic in topics)

    def wanted(self, right: CameraInfo | None) -> Wanted:
        """What is asked for; a right eye needs a baseline. What nobody hears would only delay the next image."""
        both = right is not None and right.baseline > 0 and self._heard(*_EYES[1])
        return Wanted(self._heard(messages.RENDERED_DEPTH), self._heard(messages.RENDERED_SEGMENTATION), both)

    def publish(self, shown: Shown, stamp: int, options: RenderingNodeConfig) -> None:
        """Publish what was rendered, all with one stamp, ns; the images come first, as somebody may wait for them."""
        (camera, *_), frames = shown.cameras, (options.camera_frame, options.right_frame)
        eyes = list(zip(shown.views, shown.cameras, frames, _EYES))
        for view, _, frame, (raw, _, _) in eyes:
            if raw == messages.RENDERED_IMAGE or self._heard(raw):
                self._publishers[raw].publish(messages.encode_image(view.image, stamp, frame))
        for _, eye, frame, (_, _, info) in eyes:
            baseline = float(np.linalg.norm(eye.position - camera.position))
            self._publishers[info].publish(messages.encode_camera_info(eye.K, eye.width, eye.height, stamp, frame, baseline))
        self._publishers[messages.RENDERED_POSE].publish(messages.encode_pose(camera.pose, stamp, options.world_frame))
        for topic, picture in ((messages.RENDERED_DEPTH, shown.views[0].depth), (messages.RENDERED_SEGMENTATION, shown.labels)):
            if picture is not None:
                self._publishers[topic].publish(messages.encode_image(picture, stamp, options.camera_frame))
        for view, _, frame, (_, compressed, _) in eyes:
            if self._heard(compressed):
                self._publishers[compressed].publish(messages.encode_compressed(view.image, stamp, frame, options.jpeg_quality))
