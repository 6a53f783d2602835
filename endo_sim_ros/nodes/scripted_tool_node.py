"""A tool that takes hold of the tissue in the middle of the picture, pulls, swings and lets go."""

from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.messages import OK, STATE, WARN, ScriptedToolState
from endo_sim_ros.nodes.aimed_tool import AimedTool
from endo_sim_ros.nodes.base import EndoNode, run
from endo_sim_ros.nodes.configs import ScriptedToolConfig, arm_names
from endo_sim_ros.nodes.scripted_motion import ScriptedMotion

_PATIENCE = 5.0  # s for what is published once; late joiners receive that within 3.5 s
_ASKED = 4096  # places of which the nearest with a free way is taken, at most


class ScriptedToolNode(EndoNode):
    """Publishes the pose of a tip and the angle of its jaw; begins when rendered depth and control nodes exist."""

    read_at_start = frozenset({"arm", "rate"})

    def __init__(self) -> None:
        super().__init__("scripted_tool")
        self._config = config = self.declare(ScriptedToolConfig)
        (arm,) = arm_names([config.arm])
        self._tool = AimedTool(arm)
        self._pose_pub = self.publisher(messages.tool_pose(arm))
        self._jaw_pub = self.publisher(messages.tool_jaw(arm))
        self._camera_pose: np.ndarray | None = None
        self._info: messages.CameraInfo | None = None
        self._depth: np.ndarray | None = None
        self._soft = False  # whether there are control nodes
        self._reaction = np.zeros(3)  # N on the tool, in its axes
        self._axes = np.eye(3)  # of the tool, world
        self.grasped = np.zeros(3)
        self._motion: ScriptedMotion | None = None  # from when the tissue is found
        self._waited: float | None = None  # since when the tool alone is missing, s
        self._before = 0.0  # time of the last command, s
        self._state, self._missing = ScriptedToolState.WAITING, "waiting for the rendered depth"  # and what for
        self.subscribe(messages.RENDERED_POSE, self._on_camera, depth=1)
        self.subscribe(messages.RENDERED_INFO, self._on_info, depth=1)
        self.subscribe(messages.RENDERED_DEPTH, self._on_depth, depth=1)
        self.subscribe(messages.CONTROL_NODES, self._on_nodes, depth=1)
        self.subscribe(messages.tool_reaction(arm), self._on_reaction, depth=1)
        self.subscribe(messages.tool_type(arm), self._tool.receive_type)
        self.subscribe(messages.ROBOT_DESCRIPTION, self._tool.receive_description)
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
        self._soft = True

    def _on_reaction(self, message: Any) -> None:
        self._reaction, _ = messages.decode_wrench(message, messages.tool_reaction(self._tool.arm).name)

    def _on_timer(self) -> None:
        with self.guard("scripted tool"):
            now = self.now_ns() * 1e-9
            if self._motion is None:
                self._motion, self._before = self._find_tissue(now), now
            if self._motion is not None:
                self._act(self._motion, now - self._before)
                self._before = now

    def _find_tissue(self, now: float) -> ScriptedMotion | None:
        """Choose the tissue point nearest to the configured pixel to which the way is free; None while something is missing."""
        info, depth, pose, arm = self._info, self._depth, self._camera_pose, self._tool.arm
        if info is None or depth is None or pose is None or not self._soft:
            return None
        if self._jaw_pub.get_subscription_count() < self._config.listeners:
            self._missing = "waiting for somebody to feel the tool"
            return None
        self._waited = now if self._waited is None else self._waited
        if self.count_publishers(messages.tool_type(arm).name) and not self._tool.known and now - self._waited < _PATIENCE:
            self._missing = f"waiting for {messages.ROBOT_DESCRIPTION.name} to say where {arm} stands"
            return None
        height, width = depth.shape
        camera = Camera(info.P[:, :3], width, height, pose)
        row, column = min(int(self._config.v * height), height - 1), min(int(self._config.u * width), width - 1)
        seen = np.argwhere(depth > 0)
        if not len(seen):
            self._missing = "no tissue in the picture"
            return None
        seen = seen[((seen - [row, column]) ** 2).sum(1).argsort(kind="stable")][:: max(1, len(seen) // _ASKED)]
        points = camera.backproject(depth)[seen[:, 0], seen[:, 1]]
        free = self._tool.has_way(points, camera, depth)
        if not free.any():
            self.report_warning(f"{arm}: tissue lies in the way of its shaft to every place in the picture; give {arm}_base in frames")
        self.grasped = points[free.argmax()]
        across = invert_pose(camera.pose)[0, :3]  # the image's x axis in the world
        tip = self._tool.pose(self.grasped, camera.pose[:3, :3])
        self._axes = tip[:3, :3]
        return ScriptedMotion(tip, camera.position - self.grasped, across)

    def _act(self, motion: ScriptedMotion, since: float) -> None:
        """Command what is due some seconds after the last command."""
        stamp = self.now_ns()
        pose, angle, self._state = motion.command(self._config, since, self._axes @ self._reaction)
        self._pose_pub.publish(messages.encode_pose(pose, stamp, self._config.world_frame))
        if angle is not None:
            self._jaw_pub.publish(messages.encode_jaw(angle, stamp))

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: where the tool took hold, metres, world."""
        values = {STATE: self._state, "tip": np.round(self.grasped, 4).tolist()}
        if self._state is ScriptedToolState.WAITING:
            return WARN, self._missing, values
        return OK, "finished" if self._state is ScriptedToolState.DONE else str(self._state), values


if __name__ == "__main__":
    raise SystemExit(run(ScriptedToolNode))
