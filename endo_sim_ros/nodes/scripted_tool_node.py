"""A tool that takes hold of the tissue in the middle of the picture, pulls, swings and lets go."""

from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.messages import OK, STATE, WARN, ControlNodeCloud, ScriptedToolState
from endo_sim_ros.nodes.base import EndoNode, run
from endo_sim_ros.nodes.configs import ScriptedToolConfig, arm_names

_FOLLOWED = 8  # nodes around the grasped point whose movement carries the tip


class ScriptedToolNode(EndoNode):
    """Publishes a tip pose and a wrench; begins when rendered depth and control nodes of the same scene exist."""

    read_at_start = frozenset({"arm", "rate"})

    def __init__(self) -> None:
        super().__init__("scripted_tool")
        self._config = config = self.declare(ScriptedToolConfig)
        (arm,) = arm_names([config.arm])
        self._pose_pub = self.publisher(messages.tool_pose(arm))
        self._wrench_pub = self.publisher(messages.tool_wrench(arm))
        self._camera_pose: np.ndarray | None = None
        self._info: messages.CameraInfo | None = None
        self._depth: np.ndarray | None = None
        self._nodes: ControlNodeCloud | None = None
        self._near = np.zeros(0, int)  # indices of the nodes that are followed; the stamp of their model:
        self._near_stamp = 0
        self.tip = self._towards_camera = self._across = np.zeros(3)
        self._began: float | None = None
        self._state, self._missing = ScriptedToolState.WAITING, "waiting for the rendered depth"  # and what for
        self.subscribe(messages.RENDERED_POSE, self._on_camera, depth=1)
        self.subscribe(messages.RENDERED_INFO, self._on_info, depth=1)
        self.subscribe(messages.RENDERED_DEPTH, self._on_depth, depth=1)
        self.subscribe(messages.CONTROL_NODES, self._on_nodes, depth=1)
        self.create_timer(1 / config.rate, self._on_timer)

    def config_changed(self, config: ScriptedToolConfig) -> None:
        """The next command uses the new options."""
        self._config = config

    def _on_camera(self, message: Any) -> None:
        self._camera_pose = messages.decode_pose(message, self._config.world_frame, messages.RENDERED_POSE.name)

    def _on_info(self, message: Any) -> None:
        self._info = messages.decode_camera_info(message, messages.RENDERED_INFO.name)

    def _on_depth(self, message: Any) -> None:
        self._depth = messages.decode_depth(message, messages.RENDERED_DEPTH.name)

    def _on_nodes(self, message: Any) -> None:
        self._nodes = messages.decode_control_nodes(message)

    def _on_timer(self) -> None:
        with self.guard("scripted tool"):
            now = self.now_ns() * 1e-9
            if self._began is None:
                if not self._take_hold():
                    return
                self._began = now
            if self._nodes is not None:
                self._publish(self._nodes, now - self._began)

    def _take_hold(self) -> bool:
        """Choose the tissue point under the configured pixel."""
        info, depth, nodes, pose = self._info, self._depth, self._nodes, self._camera_pose
        if info is None or depth is None or nodes is None or pose is None:
            return False
        if self._wrench_pub.get_subscription_count() < self._config.listeners:
            self._missing = "waiting for somebody to feel the tool"
            return False
        height, width = depth.shape
        camera = Camera(info.P[:, :3], width, height, pose)
        row, column = min(int(self._config.v * height), height - 1), min(int(self._config.u * width), width - 1)
        seen = np.argwhere(depth > 0)
        if not len(seen):
            self._missing = "no tissue in the picture"
            return False
        row, column = seen[((seen - [row, column]) ** 2).sum(1).argmin()]  # the nearest pixel with tissue
        self.tip = camera.backproject(depth)[row, column]
        self._follow(nodes, nodes.positions)
        self._towards_camera = camera.position - self.tip
        self._towards_camera /= np.linalg.norm(self._towards_camera)
        self._across = invert_pose(camera.pose)[0, :3]  # the image's x axis in the world
        return True

    def _follow(self, nodes: ControlNodeCloud, positions: np.ndarray) -> None:
        """Choose the control nodes at the grasped point, by their positions [M, 3], m, world."""
        self._near = np.argsort(np.linalg.norm(positions - self.tip, axis=1))[:_FOLLOWED]
        self._near_stamp = nodes.model_stamp_ns

    def _publish(self, nodes: ControlNodeCloud, elapsed: float) -> None:
        config, stamp = self._config, self.now_ns()
        if nodes.model_stamp_ns != self._near_stamp:  # a new model has control nodes of its own
            self._follow(nodes, nodes.rest)
        moved = (nodes.positions - nodes.rest)[self._near].mean(0)
        pose = np.eye(4)
        pose[:3, 3] = self.tip + moved
        force = self._force(elapsed)
        self._pose_pub.publish(messages.encode_pose(pose, stamp, config.world_frame))
        self._wrench_pub.publish(messages.encode_wrench(force, np.zeros(3), stamp, config.world_frame))

    def _force(self, elapsed: float) -> np.ndarray:
        """Force on the tissue [3], N, world."""
        config = self._config
        if elapsed < config.pull:
            self._state = ScriptedToolState.PULLING
            return config.force * elapsed / config.pull * self._direction(0.0)
        if elapsed < config.pull + config.swing:
            self._state = ScriptedToolState.SWINGING
            angle = 2 * np.pi * (elapsed - config.pull) / config.swing
            return config.force * self._direction(angle)
        released = elapsed < config.pull + config.swing + config.release
        self._state = ScriptedToolState.RELEASED if released else ScriptedToolState.DONE
        return np.zeros(3)

    def _direction(self, angle: float) -> np.ndarray:
        """Unit vector [3], world: aslant towards the camera, circling from the picture's top."""
        up = np.cross(self._towards_camera, self._across)
        direction = self._towards_camera + np.cos(angle) * up + np.sin(angle) * self._across
        return direction / np.linalg.norm(direction)

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: where the tool took hold, metres, world."""
        values = {STATE: self._state, "tip": np.round(self.tip, 4).tolist()}
        if self._state is ScriptedToolState.WAITING:
            return WARN, self._missing, values
        return OK, "finished" if self._state is ScriptedToolState.DONE else str(self._state), values


if __name__ == "__main__":
    raise SystemExit(run(ScriptedToolNode))
