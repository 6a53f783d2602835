"""The topics of rendered pictures: what is asked for, and how it is published."""

from dataclasses import dataclass, replace

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.messages import CameraInfo, Topic
from endo_sim_ros.nodes.base import EndoNode
from endo_sim_ros.nodes.configs import RenderingNodeConfig
from endo_sim_ros.rendering import View


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
        eye = messages.RENDERED_RIGHT_IMAGE, messages.RENDERED_RIGHT_COMPRESSED, messages.RENDERED_RIGHT_INFO
        both = right is not None and right.baseline > 0 and self._heard(*eye)
        return Wanted(self._heard(messages.RENDERED_DEPTH), self._heard(messages.RENDERED_SEGMENTATION), both)

    def publish(self, shown: Shown, stamp: int, options: RenderingNodeConfig) -> None:
        """Publish what was rendered, all with one stamp, ns."""
        (left, *others), (camera, *right), frame = shown.views, shown.cameras, options.camera_frame
        info = messages.encode_camera_info(camera.K, camera.width, camera.height, stamp, frame)
        self._publishers[messages.RENDERED_INFO].publish(info)
        self._publishers[messages.RENDERED_POSE].publish(messages.encode_pose(camera.pose, stamp, options.world_frame))
        self._image(messages.RENDERED_IMAGE, messages.RENDERED_COMPRESSED, left.image, stamp, frame, options)
        if left.depth is not None:
            self._publishers[messages.RENDERED_DEPTH].publish(messages.encode_image(left.depth, stamp, frame))
        if shown.labels is not None:
            self._publishers[messages.RENDERED_SEGMENTATION].publish(messages.encode_image(shown.labels, stamp, frame))
        for view, eye in zip(others, right):
            baseline, frame = float(np.linalg.norm(eye.position - camera.position)), options.right_frame
            info = messages.encode_camera_info(eye.K, eye.width, eye.height, stamp, frame, baseline)
            self._publishers[messages.RENDERED_RIGHT_INFO].publish(info)
            self._image(messages.RENDERED_RIGHT_IMAGE, messages.RENDERED_RIGHT_COMPRESSED, view.image, stamp, frame, options)

    def _image(self, raw: Topic, compressed: Topic, image: np.ndarray, stamp: int, frame: str, options: RenderingNodeConfig) -> None:
        if raw == messages.RENDERED_IMAGE or self._heard(raw):
            self._publishers[raw].publish(messages.encode_image(image, stamp, frame))
        if self._heard(compressed):
            self._publishers[compressed].publish(messages.encode_compressed(image, stamp, frame, options.jpeg_quality))
