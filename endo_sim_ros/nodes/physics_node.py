"""Gaussian model and tool wrenches in, control nodes and reactions out."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
from std_srvs.srv import SetBool, Trigger

from endo_sim_ros import messages
from endo_sim_ros.config import Range, StageConfig
from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.messages import ControlNodeCloud, MessageError
from endo_sim_ros.nodes.base import OK, WARN, EndoNode, run
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation


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

    def __init__(self):
        super().__init__("physics_node")
        self._options = self.declare(PhysicsNodeConfig)
        self._config = self.declare(PhysicsConfig)
        self._simulation: TissueSimulation | None = None
        self._model_stamp = 0  # of the simulated model
        self._arrived: tuple[int, GaussianModel] | None = None  # newest model, and its stamp
        self._views: tuple[int, np.ndarray] | None = None  # camera positions of the newest model, and its stamp
        self._camera_position: np.ndarray | None = None
        self._building: Future | None = None
        self._worker = ThreadPoolExecutor(1)
        self._paused, self._steps, self._seconds_per_step, self._last_step = False, 0, 0.0, None
        self._real_time_factor = 1.0
        self._arms = {name.strip(): _Arm() for name in self._options.arms.split(",") if name.strip()}
        self._nodes_pub = self.publisher(messages.CONTROL_NODES)
        self._reaction_pubs = {name: self.publisher(messages.tool_reaction(name)) for name in self._arms}
        self.subscribe(messages.GAUSSIANS, self._on_model)
        self.subscribe(messages.TRAINING_CAMERAS, self._on_training_cameras)
        self.subscribe(messages.CAMERA_POSE, self._on_camera)
        for name in self._arms:
            self.subscribe(messages.tool_pose(name), partial(self._on_tool_pose, name))
            self.subscribe(messages.tool_wrench(name), partial(self._on_wrench, name))
            self.subscribe(messages.tool_jaw(name), partial(self._on_jaw, name))
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/step", self._on_step)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self._timer = self.create_timer(self._config.step_duration, self._on_timer)

    def config_changed(self, config: StageConfig) -> None:
        if isinstance(config, PhysicsConfig):
            self._config = config
            self._timer.timer_period_ns = int(config.step_duration * 1e9)
            self._rebuild()
        else:
            raise ValueError("this parameter is read at start only; restart the node with the new value")

    # ------------------------------------------------------------------ model

    def _on_model(self, message: Any) -> None:
        model = messages.decode_gaussians(message)
        messages.check_frame(message, (self._options.world_frame,), messages.GAUSSIANS.name)
        self._arrived = (messages.stamp_to_ns(message.header.stamp), model)
        self._rebuild()

    def _on_training_cameras(self, message: Any) -> None:
        poses = messages.decode_poses(message)
        self._views = (messages.stamp_to_ns(message.header.stamp), poses[:, :3, 3])
        self._rebuild()

    def _on_camera(self, message: Any) -> None:
        pose = messages.decode_pose(message, self._options.world_frame, messages.CAMERA_POSE.name)
        first = self._camera_position is None
        self._camera_position = pose[:3, 3]
        if first:
            self._rebuild()

    def _viewpoint(self) -> np.ndarray | None:
        """Where the tissue was seen from: the model's own cameras, else wherever the camera is now."""
        if self._arrived and self._views and self._views[0] == self._arrived[0] and len(self._views[1]):
            return self._views[1]
        if self._views and self._arrived and self._views[0] != self._arrived[0]:
            return None  # the cameras of this model are still on their way
        return self._camera_position

    def _rebuild(self) -> None:
        """Build a simulation of the newest model in the background; the old one goes on meanwhile."""
        if self._building is None and self._arrived is not None and (viewpoint := self._viewpoint()) is not None:
            stamp, model = self._arrived
            self._arrived_built = self._arrived, self._config
            self._building = self._worker.submit(lambda: (stamp, TissueSimulation(model, viewpoint, self._config)))

    def _take_built(self) -> None:
        if self._building is None or not self._building.done():
            return
        future, self._building = self._building, None
        if (self._arrived, self._config) != self._arrived_built:
            self._rebuild()  # a newer model or configuration came meanwhile
        with self.guard("physics"):
            self._model_stamp, self._simulation = future.result()
            self._last_step = None
            for arm in self._arms.values():
                arm.acting = False

    # ------------------------------------------------------------------ tools

    def _on_tool_pose(self, name: str, message: Any) -> None:
        self._arms[name].pose = messages.decode_pose(message, self._options.world_frame, messages.tool_pose(name).name)

    def _on_wrench(self, name: str, message: Any) -> None:
        topic, arm = messages.tool_wrench(name).name, self._arms[name]
        force, torque = messages.decode_wrench(message, topic)
        frame = messages.check_frame(message, ("", name, self._options.world_frame), topic)
        if arm.pose is None:
            raise MessageError(f"{topic}: a wrench came before any pose on {messages.tool_pose(name).name}; publish the tip's pose")
        if frame != self._options.world_frame:  # in the axes of the tool
            force, torque = arm.pose[:3, :3] @ force, arm.pose[:3, :3] @ torque
        arm.force, arm.torque, arm.heard = force, torque, time.monotonic()

    def _on_jaw(self, name: str, message: Any) -> None:
        angle, arm = messages.decode_jaw(message, messages.tool_jaw(name).name), self._arms[name]
        if arm.pose is None:
            raise MessageError(f"{name}: a jaw command came before any pose on {messages.tool_pose(name).name}; publish the tip's pose")
        if angle <= self._options.jaw_closed:
            arm.closed = True
        elif angle >= self._options.jaw_open:
            arm.closed = False

    def _apply_tools(self, simulation: TissueSimulation) -> None:
        for name, arm in self._arms.items():
            if arm.pose is None:
                continue
            if not simulation.set_grasp(name, arm.pose, arm.closed):
                self.report_error(f"{name}: the jaw closed on nothing at {np.round(arm.pose[:3, 3], 4).tolist()}; {self._reach(simulation)}")
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
                    self.report_error(
                        f"{name}: the wrench at {np.round(arm.pose[:3, 3], 4).tolist()} has no effect; {self._reach(simulation)}"
                    )
            arm.acting = wanted

    @staticmethod
    def _reach(simulation: TissueSimulation) -> str:
        return f"no movable tissue lies within force_radius = {simulation.config.force_radius:g} m of the tip"

    # ------------------------------------------------------------------ steps

    def _on_timer(self) -> None:
        with self.guard("physics"):
            self._take_built()
            if self._simulation is not None:
                if not self._paused:
                    self._step(self._simulation)
                self._publish(self._simulation)

    def _step(self, simulation: TissueSimulation) -> None:
        start, faults, slips = time.monotonic(), simulation.faults, simulation.slips
        self._apply_tools(simulation)
        simulation.step()
        if simulation.slips > slips:
            self.report_error(
                f"tissue slipped out of a jaw that pulled it almost {simulation.config.travel:g} m; open it, come nearer, or raise travel"
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
        cloud = ControlNodeCloud(state.rest, state.positions, state.F, self._model_stamp)
        self._nodes_pub.publish(messages.encode_control_nodes(cloud, stamp, self._options.world_frame))
        for name, arm in self._arms.items():
            if arm.pose is not None:
                axes = arm.pose[:3, :3].T  # the reaction is given in the axes of the tool
                force, torque = (axes @ vector for vector in simulation.reaction(name))
                self._reaction_pubs[name].publish(messages.encode_wrench(force, torque, stamp, name))

    # --------------------------------------------------------------- services

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._simulation is not None
        response.message = "at rest" if response.success else "there is no model yet"
        if self._simulation is not None:
            self._simulation.reset()
            for arm in self._arms.values():
                arm.force, arm.acting, arm.closed = None, False, False
            self._publish(self._simulation)
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._simulation is None or not self._paused:
            response.success = False
            response.message = "there is no model yet" if self._simulation is None else "running; call ~/pause with true first"
            return response
        with self.guard("~/step"):
            self._step(self._simulation)
            self._publish(self._simulation)
            response.success, response.message = True, f"time {self._simulation.time:.4f} s"
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused, self._last_step = request.data, None
        response.success, response.message = True, "paused" if request.data else "running"
        return response

    # ------------------------------------------------------------ diagnostics

    def status(self):
        simulation = self._simulation
        if simulation is None:
            if self._arrived is None:
                return WARN, "waiting for a model on gaussians", {}
            if self._building is not None:
                return OK, "building control nodes", {}
            return WARN, "waiting for training_cameras or ECM/measured_cp to know from which side the tissue is seen", {}
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
        return OK, "paused" if self._paused else "running", values

    def destroy_node(self) -> None:
        self._worker.shutdown(wait=False, cancel_futures=True)
        super().destroy_node()


def main() -> int:
    return run(PhysicsNode)


if __name__ == "__main__":
    raise SystemExit(main())
