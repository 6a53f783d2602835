"""Gaussian model and tool wrenches in, control nodes and reactions out."""

import time
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
from std_srvs.srv import SetBool, Trigger

from endo_sim_ros import messages
from endo_sim_ros.config import Range, StageConfig
from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.messages import ControlNodeCloud, MessageError
from endo_sim_ros.nodes.base import ERROR, OK, WARN, Background, EndoNode, arm_names, run, sentence
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation

_SLOW = 0.5  # real-time factor below which the node warns
_CAMERAS_LATE = 1.0  # seconds after a model in which its training cameras may still be on their way


@dataclass(frozen=True)
class PhysicsNodeConfig(StageConfig):
    """Parameters of the node beside those of the physics."""

    arms: str = "PSM1"
    """Names of the tool arms, separated by commas; each has its topics under its name."""
    world_frame: str = "world"
    """Frame of tool poses, the model and the control nodes."""
    command_timeout: Annotated[float, Range(0, 3600, "s")] = 0.5
    """A wrench that is not repeated for this long is dropped; 0 = held until changed."""
    jaw_closed: Annotated[float, Range(-3.2, 3.2, "rad")] = 0.1
    """A jaw at or below this angle holds the tissue at its tip."""
    jaw_open: Annotated[float, Range(-3.2, 3.2, "rad")] = 0.2
    """A jaw at or above this angle lets go; between the two it stays as it is."""


@dataclass
class _Arm:
    """What was last heard from one arm."""

    pose: np.ndarray | None = None  # [4, 4], world
    force: np.ndarray | None = None  # [3] N, world
    torque: np.ndarray | None = None  # [3] N·m about the tip, world
    heard: float = 0.0  # time of the last wrench, monotonic seconds
    acting: bool = False
    closed: bool = False  # the jaw


class PhysicsNode(EndoNode):
    """Samples control nodes from the latest model and steps them at the rate of the simulation."""

    read_at_start = frozenset({"arms"})

    def __init__(self):
        super().__init__("physics_node")
        self._options = self.declare(PhysicsNodeConfig)
        self._config = self.declare(PhysicsConfig)
        self._simulation: TissueSimulation | None = None
        self._simulated_stamp = 0  # stamp of the simulated model
        self._model: GaussianModel | None = None  # the newest; its stamp, number, and time of arrival:
        self._model_stamp, self._model_number, self._model_came = 0, 0, 0.0
        self._views: np.ndarray | None = None  # positions [V, 3] of the newest training cameras that were any
        self._views_stamp: int | None = None  # stamp of the newest training_cameras, and whether there were any:
        self._views_given = False
        self._camera_position: np.ndarray | None = None
        self._background = Background()
        self._failure = ""  # why the newest model is not simulated
        self._paused, self._steps, self._seconds_per_step, self._last_step = False, 0, 0.0, None
        self._real_time_factor = 1.0
        self._arms = {name: _Arm() for name in arm_names(self._options.arms)}
        self._nodes_pub = self.publisher(messages.CONTROL_NODES)
        self._reaction_pubs = {name: self.publisher(messages.tool_reaction(name)) for name in self._arms}
        self.subscribe(messages.GAUSSIANS, self._on_model)
        self.subscribe(messages.TRAINING_CAMERAS, self._on_training_cameras)
        self.subscribe(messages.CAMERA_POSE, self._on_camera)
        for name in self._arms:
            self.subscribe(messages.tool_pose(name), partial(self._on_tool_pose, name))
            self.subscribe(messages.tool_wrench(name), partial(self._on_wrench, name))
            self.subscribe(messages.tool_jaw(name), partial(self._on_jaw, name))
        self.service(Trigger, "~/reset", self._on_reset)
        self.service(Trigger, "~/step", self._on_step)
        self.service(SetBool, "~/pause", self._on_pause)
        self._timer = self.create_timer(self._config.step_duration, self._on_timer)

    def config_changed(self, config: StageConfig) -> None:
        if isinstance(config, PhysicsConfig):
            self._config = config  # the timer builds a simulation for it
            self._timer.timer_period_ns = int(config.step_duration * 1e9)
        else:
            self._options = config

    # ------------------------------------------------------------------ model

    def _on_model(self, message: Any) -> None:
        messages.check_frame(message, (self._options.world_frame,), messages.GAUSSIANS.name)
        self._model = messages.decode_gaussians(message)
        self._model_stamp = messages.stamp_to_ns(message.header.stamp)
        self._model_number, self._model_came = self._model_number + 1, time.monotonic()

    def _on_training_cameras(self, message: Any) -> None:
        messages.check_frame(message, (self._options.world_frame,), messages.TRAINING_CAMERAS.name)
        poses = messages.decode_poses(message)
        self._views_stamp, self._views_given = messages.stamp_to_ns(message.header.stamp), len(poses) > 0
        if self._views_given:
            self._views = poses[:, :3, 3]

    def _on_camera(self, message: Any) -> None:
        pose = messages.decode_pose(message, self._options.world_frame, messages.CAMERA_POSE.name)
        self._camera_position = pose[:3, 3]

    def _viewpoint(self) -> tuple[str, np.ndarray | None]:
        """Where the tissue was seen from, and whose place that is: the model's own cameras, else wherever the camera is
        now, else the cameras of an earlier model."""
        if self._views_stamp == self._model_stamp and self._views_given:
            return "own cameras", self._views
        if self._views_stamp != self._model_stamp and time.monotonic() - self._model_came < _CAMERAS_LATE:
            return "", None
        if self._camera_position is not None:
            return "camera", self._camera_position
        return "earlier cameras", self._views

    def _build(self) -> None:
        """Build a simulation of the newest model in the background; the old one goes on meanwhile."""
        try:
            built = self._background.take()
            if built is not None:
                self._simulated_stamp, self._simulation = built[1]
                self._last_step, self._failure = None, ""
                for arm in self._arms.values():
                    arm.acting = False
        except Exception as error:
            self._failure = sentence("physics", error)
            self.report_error(self._failure)
        origin, viewpoint = self._viewpoint()
        if self._model is not None and viewpoint is not None:
            model, stamp, config = self._model, self._model_stamp, self._config
            self._background.want(
                (self._model_number, origin, config), lambda: (stamp, TissueSimulation(model, viewpoint, config))
            )

    # ------------------------------------------------------------------ tools

    def _on_tool_pose(self, name: str, message: Any) -> None:
        self._arms[name].pose = messages.decode_pose(message, self._options.world_frame, messages.tool_pose(name).name)

    def _on_wrench(self, name: str, message: Any) -> None:
        topic, arm = messages.tool_wrench(name).name, self._arms[name]
        force, torque = messages.decode_wrench(message, topic)
        frame = messages.check_frame(message, ("", name, self._options.world_frame), topic)
        if arm.pose is None:
            raise MessageError(
                f"{topic}: a wrench came before any pose on {messages.tool_pose(name).name}; publish the tip's pose"
            )
        if frame != self._options.world_frame:  # in the axes of the tool
            force, torque = arm.pose[:3, :3] @ force, arm.pose[:3, :3] @ torque
        arm.force, arm.torque, arm.heard = force, torque, time.monotonic()

    def _on_jaw(self, name: str, message: Any) -> None:
        angle, arm = messages.decode_jaw(message, messages.tool_jaw(name).name), self._arms[name]
        if arm.pose is None:
            raise MessageError(
                f"{name}: a jaw command came before any pose on {messages.tool_pose(name).name}; publish the tip's pose"
            )
        if angle <= self._options.jaw_closed:
            arm.closed = True
        elif angle >= self._options.jaw_open:
            arm.closed = False

    def _apply_tools(self, simulation: TissueSimulation) -> None:
        for name, arm in self._arms.items():
            if arm.pose is None:
                continue
            where = f"at {np.round(arm.pose[:3, 3], 4).tolist()}"
            if not simulation.set_grasp(name, arm.pose, arm.closed):
                self.report_error(f"{name}: the jaw closed on nothing {where}; {self._reach(simulation)}")
                arm.closed = False
            if arm.force is None:
                continue
            timeout = self._options.command_timeout
            stale = 0 < timeout < time.monotonic() - arm.heard
            force, torque = (np.zeros(3), np.zeros(3)) if stale else (arm.force, arm.torque)
            wanted = bool(force.any() or torque.any())
            if wanted or arm.acting:
                reached = simulation.set_wrench(name, arm.pose[:3, 3], force, torque)
                if wanted and not reached:
                    self.report_error(f"{name}: the wrench {where} has no effect; {self._reach(simulation)}")
            arm.acting = wanted

    @staticmethod
    def _reach(simulation: TissueSimulation) -> str:
        return f"no movable tissue lies within force_radius = {simulation.config.force_radius:g} m of the tip"

    # ------------------------------------------------------------------ steps

    def _on_timer(self) -> None:
        with self.guard("physics"):
            self._build()
            if self._simulation is not None:
                if not self._paused:
                    self._step(self._simulation)
                self._publish(self._simulation)

    def _step(self, simulation: TissueSimulation) -> None:
        start, faults, slips = time.monotonic(), simulation.faults, simulation.slips
        self._apply_tools(simulation)
        simulation.step()
        if simulation.slips > slips:
            travel = f"{simulation.config.travel:g} m"
            self.report_error(
                f"tissue slipped out of a jaw that pulled it almost {travel}; open it, come nearer, or raise travel"
            )
            for name, arm in self._arms.items():
                arm.closed = arm.closed and simulation.in_reach(name)
        self._steps += 1
        if simulation.faults > faults:
            self.report_error(simulation.last_fault)
        self._seconds_per_step += 0.1 * (time.monotonic() - start - self._seconds_per_step)
        if self._last_step is not None:
            factor = simulation.step_duration / max(start - self._last_step, 1e-6)
            self._real_time_factor += 0.1 * (factor - self._real_time_factor)
        self._last_step = start

    def _publish(self, simulation: TissueSimulation) -> None:
        stamp, state = self.now_ns(), simulation.state()
        cloud = ControlNodeCloud(state.rest, state.positions, state.F, self._simulated_stamp)
        self._nodes_pub.publish(messages.encode_control_nodes(cloud, stamp, self._options.world_frame))
        for name, arm in self._arms.items():
            if arm.pose is not None:
                axes = arm.pose[:3, :3].T  # the reaction is given in the axes of the tool
                force, torque = (axes @ vector for vector in simulation.reaction(name))
                self._reaction_pubs[name].publish(messages.encode_wrench(force, torque, stamp, name))

    # --------------------------------------------------------------- services

    def _on_reset(self, _: Trigger.Request) -> tuple[bool, str]:
        if self._simulation is None:
            return False, "there is no model yet"
        self._simulation.reset()
        for arm in self._arms.values():
            arm.force, arm.acting, arm.closed = None, False, False
        self._publish(self._simulation)
        return True, "at rest"

    def _on_step(self, _: Trigger.Request) -> tuple[bool, str]:
        if self._simulation is None:
            return False, "there is no model yet"
        if not self._paused:
            return False, "running; call ~/pause with true first"
        self._step(self._simulation)
        self._publish(self._simulation)
        return True, f"time {self._simulation.time:.4f} s"

    def _on_pause(self, request: SetBool.Request) -> tuple[bool, str]:
        self._paused, self._last_step = request.data, None
        return True, "paused" if request.data else "running"

    # ------------------------------------------------------------ diagnostics

    def status(self):
        simulation = self._simulation
        if simulation is None:
            if self._model is None:
                return WARN, "waiting for a model on gaussians", {}
            if self._background.busy:
                return OK, "building control nodes", {}
            if self._failure:
                return ERROR, self._failure, {}
            return (
                WARN,
                "waiting for training_cameras or ECM/measured_cp to know from which side the tissue is seen",
                {},
            )
        values = {
            "nodes": len(simulation.nodes.rest),
            "steps": self._steps,
            "substeps": simulation.solver.substepping.count,
            "milliseconds per step": f"{1e3 * self._seconds_per_step:.1f}",
            "real-time factor": f"{self._real_time_factor:.2f}",
            "simulated time": f"{simulation.time:.2f}",
            "faults": simulation.faults,
            "slips": simulation.slips,
        }
        if self._failure:
            return ERROR, f"{self._failure}; the model before goes on", values
        if self._paused:
            return OK, "paused", values
        if self._real_time_factor < _SLOW:
            return WARN, "slower than real time; lower node_count or young_modulus, or use a GPU", values
        return OK, "running", values

    def destroy_node(self) -> None:
        self._background.stop()
        super().destroy_node()


def main() -> int:
    return run(PhysicsNode)


if __name__ == "__main__":
    raise SystemExit(main())
