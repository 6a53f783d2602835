"""Gaussian model, control nodes and a camera pose in, images out."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.cameras import Camera
from endo_sim_ros.config import Range, StageConfig
from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.messages import CameraInfo, ControlNodeCloud
from endo_sim_ros.nodes.base import OK, WARN, EndoNode, run
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.bag import LEFT_FRAME


@dataclass(frozen=True)
class RenderingNodeConfig(StageConfig):
    """Parameters of the node beside those of the rendering."""

    rate: Annotated[float, Range(0.1, 240, "Hz")] = 25.0
    """Images published per second; input that arrives faster is dropped, the newest is kept."""
    idle_rate: Annotated[float, Range(0.1, 240, "Hz")] = 5.0
    """Images published per second while nothing in the picture changes."""
    world_frame: str = "world"
    """Frame of the model, the control nodes and camera poses."""
    camera_frame: str = LEFT_FRAME
    """Frame written into the headers of rendered images."""


class RenderingNode(EndoNode):
    """Keeps the newest model, node state and camera, and renders them at its own rate."""

    def __init__(self):
        super().__init__("rendering_node")
        self._options = self.declare(RenderingNodeConfig)
        self._config = self.declare(RenderingConfig)
        self._model: GaussianModel | None = None
        self._model_stamp = 0
        self._nodes: ControlNodeCloud | None = None
        self._renderer: DeformableRenderer | None = None
        self._renderer_key: tuple[int, bytes] | None = None  # model stamp and rest positions that the renderer is for
        self._tried_key: tuple[int, bytes] | None = None  # the same of the last one begun, which may have failed
        self._building: Future | None = None
        self._worker = ThreadPoolExecutor(1)
        self._pose: np.ndarray | None = None
        self._training_pose: np.ndarray | None = None
        self._info: CameraInfo | None = None
        self._training_info: CameraInfo | None = None
        self._dirty, self._images, self._last_image = True, 0, 0.0
        self._output: tuple[np.ndarray, np.ndarray, Camera] | None = None
        self._seconds_per_image = 0.0
        publishers = (self.publisher(topic) for topic in messages.RENDERED_TOPICS)
        self._info_pub, self._pose_pub, self._depth_pub, self._image_pub = publishers
        self.subscribe(messages.GAUSSIANS, self._on_model)
        self.subscribe(messages.TRAINING_CAMERAS, self._on_training_cameras)
        self.subscribe(messages.TRAINING_CAMERA_INFO, self._on_training_info)
        self.subscribe(messages.CONTROL_NODES, self._on_nodes, depth=1)
        self.subscribe(messages.CAMERA_POSE, self._on_camera, depth=1)
        self.subscribe(messages.LEFT_INFO, self._on_info, depth=1)
        self._timer = self.create_timer(1.0 / self._options.rate, self._on_timer)

    def config_changed(self, config: StageConfig) -> None:
        if isinstance(config, RenderingNodeConfig):
            self._options = config
            self._timer.timer_period_ns = int(1e9 / config.rate)
        else:
            self._config, self._tried_key = config, None

    # ------------------------------------------------------------------ input

    def _on_model(self, message: Any) -> None:
        messages.check_frame(message, (self._options.world_frame,), messages.GAUSSIANS.name)
        self._model = messages.decode_gaussians(message)
        self._model_stamp = messages.stamp_to_ns(message.header.stamp)

    def _on_training_cameras(self, message: Any) -> None:
        poses = messages.decode_poses(message)
        self._training_pose = poses[len(poses) // 2] if len(poses) else None
        self._dirty = True

    def _on_training_info(self, message: Any) -> None:
        self._training_info, self._dirty = messages.decode_camera_info(message, messages.TRAINING_CAMERA_INFO.name), True

    def _on_nodes(self, message: Any) -> None:
        messages.check_frame(message, (self._options.world_frame,), messages.CONTROL_NODES.name)
        nodes, old = messages.decode_control_nodes(message), self._nodes
        same = old is not None and old.model_stamp_ns == nodes.model_stamp_ns and np.array_equal(old.positions, nodes.positions)
        self._nodes = nodes
        self._dirty |= not same

    def _on_camera(self, message: Any) -> None:
        pose = messages.decode_pose(message, self._options.world_frame, messages.CAMERA_POSE.name)
        self._dirty |= self._pose is None or not np.array_equal(pose, self._pose)
        self._pose = pose

    def _on_info(self, message: Any) -> None:
        info = messages.decode_camera_info(message)
        same = self._info is not None and np.array_equal(info.P, self._info.P) and info.width == self._info.width
        self._info, self._dirty = info, self._dirty or not same

    def _camera(self) -> Camera | None:
        """The camera asked for; until there is one, a training camera."""
        pose = self._training_pose if self._pose is None else self._pose
        info = self._info or self._training_info
        if pose is None or info is None:
            return None
        return Camera(info.P[:, :3], info.width, info.height, pose)

    # ----------------------------------------------------------------- images

    def _on_timer(self) -> None:
        with self.guard("rendering"):
            self._build()
            camera = self._camera()
            if self._renderer is None or camera is None:
                return
            now = time.monotonic()
            if self._dirty or self._output is None:
                self._dirty = False
                self._output = self._render(self._renderer, self._renderer.camera(camera))
                self._seconds_per_image += 0.1 * (time.monotonic() - now - self._seconds_per_image)
            elif now - self._last_image < 1 / self._options.idle_rate - 0.5 / self._options.rate:
                return
            self._last_image = now
            self._publish(*self._output)

    def _wanted(self) -> tuple[int, bytes]:
        """What the renderer should be for: the newest model, with its node set once that arrived."""
        nodes = self._nodes
        matching = nodes is not None and nodes.model_stamp_ns == self._model_stamp
        return self._model_stamp, nodes.rest.tobytes() if matching else b""

    def _build(self) -> None:
        """Bind Gaussians to nodes in the background; the previous picture stays meanwhile."""
        if self._building is not None and self._building.done():
            future, self._building = self._building, None
            self._renderer = future.result()
            self._renderer_key, self._dirty = self._tried_key, True
        if self._building is None and self._model is not None and self._wanted() != self._tried_key:
            self._tried_key = key = self._wanted()
            model, config = self._model, self._config
            rest = self._nodes.rest if key[1] else None
            self._building = self._worker.submit(lambda: DeformableRenderer(model, rest, config))

    def _render(self, renderer: DeformableRenderer, camera: Camera) -> tuple[np.ndarray, np.ndarray, Camera]:
        if self._renderer_key[1] and self._renderer_key == self._wanted():
            return *renderer.render(camera, self._nodes.positions, self._nodes.F), camera
        return *renderer.render(camera), camera

    def _publish(self, image: np.ndarray, depth: np.ndarray, camera: Camera) -> None:
        stamp, frame = self.now_ns(), self._options.camera_frame
        self._info_pub.publish(messages.encode_camera_info(camera.K, camera.width, camera.height, stamp, frame))
        self._pose_pub.publish(messages.encode_pose(camera.pose, stamp, self._options.world_frame))
        self._depth_pub.publish(messages.encode_image(depth, stamp, frame))
        self._image_pub.publish(messages.encode_image(image, stamp, frame))
        self._images += 1

    # ------------------------------------------------------------ diagnostics

    def status(self):
        if self._model is None:
            return WARN, "waiting for a model on gaussians", {}
        if self._camera() is None:
            return WARN, "waiting for a camera on ECM/measured_cp and endoscope/left/camera_info", {}
        values = {
            "gaussians": len(self._model),
            "images": self._images,
            "milliseconds per image": f"{1e3 * self._seconds_per_image:.1f}",
            "following control nodes": self._renderer_key is not None and self._renderer_key == self._wanted() and bool(self._renderer_key[1]),
        }
        return OK, "rendering", values

    def destroy_node(self) -> None:
        self._worker.shutdown(wait=False, cancel_futures=True)
        super().destroy_node()


def main() -> int:
    return run(RenderingNode)


if __name__ == "__main__":
    raise SystemExit(main())
