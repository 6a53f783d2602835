"""A tool that takes hold of the tissue in the middle of the picture, pulls, swings and lets go."""

from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.instruments.aiming import AHEAD
from endo_sim_ros.messages import OK, STATE, WARN, ScriptedToolState
from endo_sim_ros.nodes.aimed_tool import CLOSED, OPEN, AimedTool
from endo_sim_ros.nodes.base import EndoNode, run
from endo_sim_ros.nodes.configs import ScriptedToolConfig, arm_names

_APPROACH, _SETTLE = 1.0, 0.2  # s: the way to the tissue, and how long the jaw stands there before and after it closes
_LEAVE = 1.0  # s: the way back
_PATIENCE = 5.0  # s for what is published once; late joiners receive that within 3.5 s
_LONGEST = 0.02  # m: how far it pulls where the force stays small
_NEAR = 0.2  # share of the force; nearer to it the pull grows ever more slowly, as the reaction is that of a while ago


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
        self.grasped = self._towards_camera = self._across = np.zeros(3)
        self._pose = np.eye(4)  # of the tip where it takes hold
        self._length = 0.0  # m: how far it pulls now
        self._waited: float | None = None  # since when the tool alone is missing, s
        self._began: float | None = None
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
            if self._began is None:
                if not self._find_tissue(now):
                    return
                self._began = self._before = now
            self._act(now - self._began, now - self._before)
            self._before = now

    def _find_tissue(self, now: float) -> bool:
        """Choose the tissue point under the configured pixel."""
        info, depth, pose, arm = self._info, self._depth, self._camera_pose, self._tool.arm
        if info is None or depth is None or pose is None or not self._soft:
            return False
        if self._jaw_pub.get_subscription_count() < self._config.listeners:
            self._missing = "waiting for somebody to feel the tool"
            return False
        self._waited = now if self._waited is None else self._waited
        if self.count_publishers(messages.tool_type(arm).name) and not self._tool.known and now - self._waited < _PATIENCE:
            self._missing = f"waiting for {messages.ROBOT_DESCRIPTION.name} to say where {arm} stands"
            return False
        height, width = depth.shape
        camera = Camera(info.P[:, :3], width, height, pose)
        row, column = min(int(self._config.v * height), height - 1), min(int(self._config.u * width), width - 1)
        seen = np.argwhere(depth > 0)
        if not len(seen):
            self._missing = "no tissue in the picture"
            return False
        row, column = seen[((seen - [row, column]) ** 2).sum(1).argmin()]  # the nearest pixel with tissue
        self.grasped = camera.backproject(depth)[row, column]
        self._towards_camera = camera.position - self.grasped
        self._towards_camera /= np.linalg.norm(self._towards_camera)
        self._across = invert_pose(camera.pose)[0, :3]  # the image's x axis in the world
        self._pose = self._tool.pose(self.grasped, camera.pose[:3, :3])
        return True

    def _act(self, elapsed: float, since: float) -> None:
        """Command what is due some seconds after the start, and after the last command."""
        config, pose, stamp = self._config, self._pose.copy(), self.now_ns()
        at_tissue = _APPROACH + 2 * _SETTLE  # from then on it pulls
        swings, lets_go = at_tissue + config.pull, at_tissue + config.pull + config.swing
        angle = 2 * np.pi * (min(elapsed, lets_go) - swings) / max(config.swing, 1e-9)
        direction = self._direction(max(angle, 0.0))
        if at_tissue <= elapsed < lets_go:
            self._state = ScriptedToolState.PULLING if elapsed < swings else ScriptedToolState.SWINGING
            resistance = -float(pose[:3, :3] @ self._reaction @ direction)  # N
            room = (config.force - resistance) / max(_NEAR * config.force, 1e-9)
            self._length += since * _LONGEST / max(config.pull, 0.1) * float(np.clip(room, -1, 1))
            self._length = min(max(self._length, 0.0), _LONGEST)
        elif elapsed >= lets_go:
            self._state = ScriptedToolState.RELEASED if elapsed < lets_go + config.release else ScriptedToolState.DONE
        else:
            self._state = ScriptedToolState.PULLING
        pose[:3, 3] += self._length * direction
        back = max(1 - elapsed / _APPROACH, 0.0) + min(max(elapsed - lets_go - _SETTLE, 0.0) / _LEAVE, 1.0)
        pose[:3, 3] -= back * AHEAD * pose[:3, 2]
        self._pose_pub.publish(messages.encode_pose(pose, stamp, config.world_frame))
        if elapsed >= _APPROACH + _SETTLE:  # by now the pose is known
            closed = elapsed < lets_go
            self._jaw_pub.publish(messages.encode_jaw(CLOSED if closed else OPEN, stamp))

    def _direction(self, angle: float) -> np.ndarray:
        """Unit vector [3], world: aslant towards the camera, circling from the picture's top."""
        up = np.cross(self._towards_camera, self._across)
        direction = self._towards_camera + np.cos(angle) * up + np.sin(angle) * self._across
        return direction / np.linalg.norm(direction)

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: where the tool took hold, metres, world."""
        values = {STATE: self._state, "tip": np.round(self.grasped, 4).tolist()}
        if self._state is ScriptedToolState.WAITING:
            return WARN, self._missing, values
        return OK, "finished" if self._state is ScriptedToolState.DONE else str(self._state), values


if __name__ == "__main__":
    raise SystemExit(run(ScriptedToolNode))
