"""The tissue in a browser: what the graph publishes is shown, and the mouse is one more tool."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from std_srvs.srv import SetBool, Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.instruments.aiming import AHEAD
from endo_sim_ros.instruments.config import DrawingConfig
from endo_sim_ros.messages import OK, STATE, WARN, ControlNodeCloud, PhysicsState, ViewerState
from endo_sim_ros.nodes.aimed_tool import CLOSED, OPEN, AimedTool
from endo_sim_ros.nodes.base import run
from endo_sim_ros.nodes.configs import ViewerNodeConfig, arm_names
from endo_sim_ros.nodes.model_tracker import ModelTracker
from endo_sim_ros.nodes.shown_instruments import ShownInstruments
from endo_sim_ros.nodes.watcher import Watcher
from endo_sim_ros.rendering import RenderingConfig
from endo_sim_ros.viewer.config import ViewerConfig
from endo_sim_ros.viewer.tool_marks import Tool
from endo_sim_ros.viewer.viewer import PARAMETERS, Viewer, plain_camera

_PERIOD = 0.02  # s between two looks at what users did
_GONE = 1.0  # s after which a tool that says nothing is not shown any more
_SILENT = 5.0  # s after which a node that says nothing is reported
_STALE = 1.5  # s in which diagnostics may be older than the answer of a service
_ASK_EVERY = 2.0  # s between two looks at the parameters of the physics
_SHOWN = ("physics_node", "rendering_node", "reconstruction_node")  # whose diagnostics are on the page


@dataclass
class _Arm:
    """What was last heard from one arm."""

    tool: AimedTool
    pose: np.ndarray | None = None  # [4, 4], world
    reaction: np.ndarray | None = None  # [3] N on the tool, in its axes
    heard: float = 0.0  # when the reaction came


class ViewerNode(Watcher):
    """Hands what it hears to a `Viewer`, and what users do there to the graph."""

    read_at_start = frozenset({"arm", "arm_source", "arms", "physics_node", "host", "port"})

    def __init__(self) -> None:
        super().__init__("viewer_node")
        self._options = self.declare(ViewerNodeConfig)
        config, self._rendering = self.declare(ViewerConfig), self.declare(RenderingConfig)
        (arm,) = arm_names([self._options.arm])
        self._arms = {name: _Arm(AimedTool(name)) for name in dict.fromkeys((*arm_names(self._options.arms), arm))}
        self._hand = arm
        self._tissue = ModelTracker()
        self._instruments, self._moved = ShownInstruments(tuple(self._arms), lockstep=False), False
        self._cameras: np.ndarray | None = None  # [V, 4, 4], of the training views
        self._infos: dict[str, messages.CameraInfo] = {}  # by topic
        self._rendered: dict[str, tuple[int, Any]] = {}  # stamp and content of the newest rendered messages
        self._nodes: ControlNodeCloud | None = None
        self._asked, self._closed, self.lockstep = 0.0, False, False
        self._paused, self.paused_until = False, 0.0  # as a service said, which counts more than diagnostics before it
        self.viewer = Viewer(config, self)
        commanded = self._options.arm_source == "commanded"
        self.pose_publisher = self.publisher((messages.tool_pose_command if commanded else messages.tool_pose)(arm))
        self.jaw_publisher = self.publisher(messages.tool_jaw(arm))
        name = self._options.physics_node
        self._physics = self._full_name(name)
        self._set = self.create_client(SetParameters, f"{name}/set_parameters")
        self._get = self.create_client(GetParameters, f"{name}/get_parameters")
        kinds = {"reset": Trigger, "step": Trigger, "pause": SetBool}
        self._calls = {what: self.create_client(kind, f"{name}/{what}") for what, kind in kinds.items()}
        self.subscribe(messages.GAUSSIANS, lambda message: self._tissue.receive_model(message, self._options.world_frame))
        self.subscribe(messages.TRAINING_CAMERAS, self._on_training_cameras)
        on_cut = lambda message: self._tissue.receive_cut_surface(message, self._options.world_frame)
        self.subscribe(messages.CUT_SURFACE, on_cut, depth=1)
        self.subscribe(messages.DYE, lambda message: self._tissue.receive_dye(message, self._options.world_frame))
        self.subscribe(messages.STIFFNESS_MAP, self._on_stiffness)
        self.subscribe(messages.CONTROL_NODES, self._on_nodes, depth=1)
        for topic in (messages.TRAINING_CAMERA_INFO, messages.RENDERED_INFO):
            self.subscribe(topic, partial(self._on_info, topic.name), depth=1)
        self.subscribe(messages.RENDERED_POSE, self._on_rendered_pose, depth=1)
        self.subscribe(messages.RENDERED_IMAGE, self._on_rendered_image, depth=1)
        self.subscribe(messages.ROBOT_DESCRIPTION, self._on_description)
        for name in self._arms:
            self.subscribe(messages.tool_pose(name), partial(self._on_tool_pose, name), depth=1)
            self.subscribe(messages.tool_reaction(name), partial(self._on_reaction, name), depth=1)
            self.subscribe(messages.tool_type(name), partial(self._on_tool_type, name))
            self.subscribe(messages.tool_links(name), partial(self._on_links, name), depth=1)
        self.every(_PERIOD, self._on_timer)
        self.get_logger().info(f"open {self.viewer.url} in a browser")

    def config_changed(self, config: ViewerConfig | RenderingConfig | ViewerNodeConfig) -> None:
        """New options of the rendering: the model is bound anew in the background."""
        if isinstance(config, ViewerConfig):
            self.viewer.config = config
        elif isinstance(config, RenderingConfig):
            self._rendering = config  # the timer binds the model anew
        else:
            self._options = config

    # ------------------------------------------------------------------ input

    def _on_training_cameras(self, message: Any) -> None:
        messages.check_frame(message, (self._options.world_frame,), messages.TRAINING_CAMERAS.name)
        poses = messages.decode_poses(message)
        if len(poses):
            self._cameras = poses

    def _on_info(self, topic: str, message: Any) -> None:
        self._infos[topic] = messages.decode_camera_info(message, topic)

    def _on_stiffness(self, message: Any) -> None:
        messages.check_frame(message, (self._options.world_frame,), messages.STIFFNESS_MAP.name)
        found = messages.decode_stiffness(message)
        self.viewer.show_stiffness(found.positions, found.young_modulus, found.known)

    def _on_nodes(self, message: Any) -> None:
        messages.check_frame(message, (self._options.world_frame,), messages.CONTROL_NODES.name)
        self._nodes = messages.decode_control_nodes(message)
        bound = self._tissue.bound
        if bound is None or not bound.follows(self._nodes):
            return
        self._tissue.cut(bound, self._nodes)
        milliseconds = float(self.value(self._physics, "milliseconds per step", "0"))
        age = 1e-9 * (self.now_ns() - messages.stamp_to_ns(message.header.stamp)) + 1e-3 * milliseconds
        self.viewer.show_state(self._nodes.positions, self._nodes.F, age)

    def _on_rendered_pose(self, message: Any) -> None:
        pose = messages.decode_pose(message, self._options.world_frame, messages.RENDERED_POSE.name)
        self._rendered["pose"] = messages.stamp_to_ns(message.header.stamp), pose
        self._show_endoscope()

    def _on_rendered_image(self, message: Any) -> None:
        self._rendered["image"] = messages.stamp_to_ns(message.header.stamp), message
        self._show_endoscope()

    def _show_endoscope(self) -> None:
        """Show image and pose of one stamp, if anybody looks."""
        info = self._infos.get(messages.RENDERED_INFO.name)
        if info is None or len(self._rendered) < 2 or not self.viewer.wants_endoscope:
            return
        (stamp, pose), (image_stamp, message) = self._rendered["pose"], self._rendered["image"]
        if stamp == image_stamp and (message.width, message.height) == (info.width, info.height):
            image = messages.decode_image(message, messages.RENDERED_IMAGE.name)
            self.viewer.show_endoscope(image, Camera(info.P[:, :3], info.width, info.height, pose))

    def _on_tool_pose(self, name: str, message: Any) -> None:
        self._arms[name].pose = messages.decode_tip(message, self._options.frame_poses, name, messages.tool_pose(name).name)

    def _on_reaction(self, name: str, message: Any) -> None:
        self._arms[name].reaction, _ = messages.decode_wrench(message, messages.tool_reaction(name).name)
        self._arms[name].heard = time.monotonic()

    def _on_tool_type(self, name: str, message: Any) -> None:
        self._moved = True
        self._instruments.receive_type(name, message)
        self._arms[name].tool.receive_type(message)

    def _on_description(self, message: Any) -> None:
        for arm in self._arms.values():
            arm.tool.receive_description(message)

    def _on_links(self, name: str, message: Any) -> None:
        self._moved |= self._instruments.receive_links(name, message, self._options.world_frame)

    def _show_instruments(self, device: str) -> None:
        """Show the instruments where they are now, once what draws them is prepared."""
        posed = self._instruments.posed(self._instruments.newest(), DrawingConfig(), device) if self._moved else False
        if posed is not False:
            self._moved = False
            self.viewer.show_instruments(posed)

    def _on_diagnostics(self, message: Any) -> None:
        super()._on_diagnostics(message)
        if self.heard.get(self._physics, 0.0) > self.paused_until:
            self._paused = self.in_state(self._physics, PhysicsState.PAUSED)
            self.lockstep = self.value(self._physics, "mode") == "lockstep"

    def _full_name(self, name: str) -> str:
        """The name of a node on /diagnostics."""
        return name[1:] if name.startswith("/") else f"{self.get_namespace()}/{name}".lstrip("/")

    # -------------------------------------------------------------------- page

    def _on_timer(self) -> None:
        with self.guard("viewer"):
            if self._tissue.bind(self._nodes, self._rendering) and (bound := self._tissue.bound) is not None:
                self.viewer.show_model(bound.renderer, bound.node_rest, self._camera())
            if (bound := self._tissue.bound) is not None:
                with self.guard("instruments"):
                    self._show_instruments(bound.renderer.device)
            now = time.monotonic()
            tools = {
                name: Tool(arm.tool.works_at(arm.pose), -arm.pose[:3, :3] @ arm.reaction)
                for name, arm in self._arms.items()
                if arm.pose is not None and arm.reaction is not None and now - arm.heard < _GONE
            }
            self.viewer.show_tools(tools, self._hand)
            if now - self._asked > _ASK_EVERY:
                self._asked = now
                self._ask_parameters()
            self.viewer.show_text(*self._text(now), paused=self._paused)
        with self.guard("viewer"):
            self.viewer.update()

    def _camera(self) -> Camera:
        """Where pages look from first: the endoscope, else a training view, else the world's origin."""
        info = self._infos.get(messages.RENDERED_INFO.name) or self._infos.get(messages.TRAINING_CAMERA_INFO.name)
        pose = self._rendered["pose"][1] if "pose" in self._rendered else np.eye(4)
        if "pose" not in self._rendered and self._cameras is not None:
            pose = self._cameras[len(self._cameras) // 2]
        if info is None:
            return plain_camera(pose)
        return Camera(info.P[:, :3], info.width, info.height, pose)

    def _text(self, now: float) -> list[str]:
        lines = []
        if (bound := self._tissue.bound) is not None:
            count = 0 if bound.node_rest is None else len(bound.node_rest)
            lines.append(f"{len(bound.renderer.model)} Gaussians, {count} nodes")
        simulated, factor = (self.value(self._physics, key, "0") for key in ("simulated time", "real-time factor"))
        lines.append(f"{simulated} s, real time × {factor}")
        for name in dict.fromkeys((self._options.physics_node, *_SHOWN)):
            full_name = self._full_name(name)
            status = self.statuses.get(full_name)
            silent = " (silent)" if status and now - self.heard[full_name] > _SILENT else ""
            lines.append(f"{name.lstrip('/')}: {status.message if status else 'not heard yet'}{silent}")
        return lines

    def _ask_parameters(self) -> None:
        if not self._get.service_is_ready():
            return

        def show_touch(values: dict[str, Any]) -> None:
            for arm in self._arms.values():
                arm.tool.links_touch = values["link_contact"]

        def ask(*names: str, show: Callable[[dict[str, Any]], None] = self.viewer.show_parameters) -> None:
            def answered(future: Any) -> None:
                with self.guard("parameters"):
                    values = [parameter_value_to_python(value) for value in future.result().values]
                    if len(values) == len(names):  # else another node bears that name
                        show(dict(zip(names, values)))

            self._get.call_async(GetParameters.Request(names=names)).add_done_callback(answered)

        ask(*(name for name in PARAMETERS if name != "regions"))
        ask("link_contact", show=show_touch)
        ask("regions")  # a list that nobody has filled has no value, and a request that names it gets none at all

    # ----------------------------------------------------------------- actions

    def aim(self, point: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, float]:
        """As `Actions` has it: an instrument whose links touch comes straight from its remote centre."""
        tool = self._arms[self._hand].tool
        return tool.pose(point, axes), AHEAD if tool.known else 0.0

    def hold(self, pose: np.ndarray, closed: bool) -> None:
        """Publish the pose [4, 4] (m, world) of the tool that the mouse moves, and close its jaw."""
        if self.lockstep:
            self.viewer.notify("in lockstep only the policy moves the arms")
            self.viewer.release()
            return
        self.pose_publisher.publish(messages.encode_pose(pose, self.now_ns(), self._options.world_frame))
        if closed:
            self.jaw_publisher.publish(messages.encode_jaw(CLOSED, self.now_ns()))
            self._closed = True

    def let_go(self) -> None:
        """Open the jaw, if it was closed here."""
        if self._closed:  # else it may be somebody else's
            self.jaw_publisher.publish(messages.encode_jaw(OPEN, self.now_ns()))
            self._closed = False

    def set_parameters(self, values: dict[str, float]) -> None:
        """Ask the physics node to change parameters; a refusal is shown on the page."""
        parameters = [Parameter(name, value=float(value)).to_parameter_msg() for name, value in values.items()]
        self._call(self._set, SetParameters.Request(parameters=parameters), "parameters")
        self._asked = time.monotonic()  # the old values must not come back to the sliders before the answer

    def reset(self) -> None:
        """Ask the physics node to bring the tissue to rest."""
        self._call(self._calls["reset"], Trigger.Request(), "reset")

    def pause(self, paused: bool) -> None:
        """Ask the physics node to pause or to go on."""
        self._call(self._calls["pause"], SetBool.Request(data=paused), "pause")

    def step(self) -> None:
        """Ask the physics node for a step while it is paused."""
        self._call(self._calls["step"], Trigger.Request(), "step")

    def _call(self, client: Any, request: Any, what: str) -> None:
        """Call a service of the physics; users are told when it refuses."""
        if not client.service_is_ready():
            self.viewer.notify(f"{what}: {self._options.physics_node} is not there")
            return

        def answered(future: Any) -> None:
            with self.guard(what):
                response = future.result()
                for result in getattr(response, "results", [response]):
                    if not getattr(result, "successful", getattr(result, "success", True)):
                        self.viewer.notify(f"{what}: {getattr(result, 'reason', '') or getattr(result, 'message', '')}")
                if what == "parameters":
                    self._ask_parameters()
                elif what == "pause" and response.success:
                    self._paused, self.paused_until = request.data, time.monotonic() + _STALE

        client.call_async(request).add_done_callback(answered)

    # ------------------------------------------------------------- diagnostics

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: browsers, pictures per second, latency, and whether the mouse holds tissue."""
        viewer, waiting = self.viewer, self._tissue.model is None
        values = {
            STATE: ViewerState.WAITING if waiting else ViewerState.SHOWING,
            "browsers": len(viewer.browsers),
            "pictures per second": f"{viewer.pictures_per_second:.1f}",
            "milliseconds from mouse to picture": f"{1e3 * viewer.latency:.0f}",
            "holding": viewer.holding,
        }
        if waiting:
            return WARN, f"waiting for a model on gaussians; the page is at {viewer.url}", values
        return OK, f"showing the tissue at {viewer.url}", values

    def destroy_node(self) -> None:
        """Stop serving the page, then destroy the node."""
        self._tissue.stop()
        self._instruments.stop()
        self.viewer.stop()
        super().destroy_node()


if __name__ == "__main__":
    raise SystemExit(run(ViewerNode))
