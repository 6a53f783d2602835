"""Touches of tools in, a map of stiffness out: identification that refines while the graph runs."""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.estimate import Identification, identify, identify_most
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.gathering import Tool, gather, read_tools, settling_steps, settling_time, told_thickness
from endo_sim_ros.identification.recording_config import TouchConfig
from endo_sim_ros.identification.results import told
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.identification.touches import experiment, touches
from endo_sim_ros.messages import ERROR, OK, STATE, WARN, IdentificationState, StiffnessCloud
from endo_sim_ros.nodes.background import Background
from endo_sim_ros.nodes.base import EndoNode, run, sentence
from endo_sim_ros.nodes.configs import IdentificationNodeConfig, arm_names
from endo_sim_ros.nodes.tissue_builder import TissueBuilder
from endo_sim_ros.nodes.tool_log import ToolLog
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

_PERIOD = 0.5  # s between two looks at what came
_KEPT = 5.0  # s that are kept before a touch: forces in the air tell offset and noise
_DEPTH = 1000  # messages that may wait while an estimate holds up the node: a second of a robot


class IdentificationNode(EndoNode):
    """Collects touches of tools, estimates from them in the background how stiff the tissue is, and publishes the map."""

    read_at_start = frozenset({"arms", "physics_node"})

    def __init__(self) -> None:
        super().__init__("identification_node")
        self._options = self.declare(IdentificationNodeConfig)
        self._touch = self.declare(TouchConfig)
        self.config = _refinable(self.declare(IdentificationConfig))
        self.physics = self.declare(PhysicsConfig)
        self._arms = arm_names(self._options.arms)
        self._builder = TissueBuilder()
        self.nodes: ControlNodes | None = None
        self._surface: Surface | None = None
        self._model_stamp = 0
        self.experiments: list[Experiment] = []  # the newest
        self._doubted: list[Experiment] = []  # the newest of those left out, which may be right where others agree with them
        self._gathered = 0  # all so far
        self._until = dict.fromkeys(self._arms, 0)  # ns: end of the last experiment of each arm
        self._said: list[str] = []  # of what touches were collected from, and those that were left out
        self._left_out = ""  # about the newest experiment that an estimate left out
        self._logged: set[str] = set()  # what was noticed already
        self._background = Background()
        self.found: Identification | None = None
        self._known_of: Any = None  # the tissue and the options of that
        self._used = 0  # experiments that it is from, or that were of no use
        self._estimated, self._seconds, self._progress = 0, 0.0, ""
        self.failure = ""
        self._to_set: dict[str, Any] | None = None  # parameters that physics_node does not have yet
        self._log = ToolLog(self, self._arms, lambda: self._options.frame_poses, _DEPTH)
        self._map_pub = self.publisher(messages.STIFFNESS_MAP, alone=True)
        self.subscribe(messages.GAUSSIANS, lambda message: self._builder.receive_model(message, self._options.world_frame))
        self.subscribe(
            messages.TRAINING_CAMERAS, lambda message: self._builder.receive_training_cameras(message, self._options.world_frame)
        )
        self.subscribe(messages.TRAINING_CAMERA_INFO, self._builder.receive_training_info)
        self.subscribe(messages.CAMERA_POSE, self._on_camera_pose)
        name = self._options.physics_node
        self._set = self.create_client(SetParametersAtomically, f"{name}/set_parameters_atomically")
        self.service(Trigger, "~/reset", self._on_reset)
        self.every(_PERIOD, self._on_timer)

    def config_changed(self, config: Any) -> None:
        """New options count from the next estimate on, which begins at once.

        Raises:
            ConfigError: If an inclusion is to be found.
        """
        if isinstance(config, PhysicsConfig):
            self.physics = config
        elif isinstance(config, IdentificationConfig):
            self.config = _refinable(config)
        elif isinstance(config, TouchConfig):
            self._touch = config
        else:
            self._options = config

    def _on_camera_pose(self, message: Any) -> None:
        self._builder.receive_camera_pose(message, self._options.frame_poses)

    # ------------------------------------------------------------------ touches

    def _on_timer(self) -> None:
        with self.guard("physics"):
            self._build()
        with self.guard("touches"):
            self._collect()
        self._estimate()
        with self.guard("physics_node"):
            self._apply()

    def _build(self) -> None:
        """Take the control nodes of the newest model; those of a new model have felt nothing."""
        try:
            built = self._builder.take()
            if built is not None:
                stamp, simulation, _ = built
                if stamp != self._model_stamp:
                    self._begin_anew()
                self._model_stamp, self.nodes, self._surface = stamp, simulation.nodes, Surface(simulation.nodes)
        finally:
            self._builder.want(self.physics)

    def _begin_anew(self) -> None:
        self._log.clear()
        self.experiments, self._gathered, self._said, self._left_out, self.failure = [], 0, [], "", ""
        self._doubted = []
        self._logged.clear()
        self.found, self._known_of, self._used = None, None, 0
        self._until = dict.fromkeys(self._arms, 0)

    def _collect(self) -> None:
        """Take the touches that are over."""
        if self.nodes is None or self._surface is None:
            return
        if self._log.begun_anew:  # what was felt before still counts
            self._log.begun_anew, self._until = False, dict.fromkeys(self._arms, 0)
        streams = self._log.streams()
        said: list[str] = []
        try:
            tools = read_tools(self._arms, streams, self._surface, self.nodes, self.physics, self._touch, said)
        except SequenceError:
            newest = max((int(stream.stamps[-1]) for stream in streams.values()), default=0)
            self._log.forget_before(newest)  # else it would be said again and again
            raise
        tools = {arm: tool for arm, tool in tools.items() if len(tool.line.times)}
        settle = settling_steps(self.physics, self._touch)
        for arm, (start, stop) in gather(tools, streams, self.physics, self._touch, said):
            line = tools[arm].line
            if stop + settle > len(line.times) or line.times[start] <= self._until[arm]:
                continue  # it is not over, or known
            self.experiments.append(experiment(line, (start, stop), self.physics.step_duration, tools[arm].noise, self._touch))
            self._until[arm] = int(line.times[stop - 1])
            self._gathered += 1
            self._said = [*said, *told_thickness(self._surface, self.nodes, self.physics)]
        del self.experiments[: -self._options.experiments]
        self._forget(tools, settle)

    def _forget(self, tools: Mapping[str, Tool], settle: int) -> None:
        """Forget what no experiment needs any more."""
        begins = []
        for arm, tool in tools.items():
            line = tool.line
            open_ones = [start for start, stop in touches(line, settle) if stop + settle >= len(line.times)]
            begins.append(int(line.times[open_ones[0] if open_ones else -1]))
        if begins:
            self._log.forget_before(min(begins) - round((_KEPT + 2 * settling_time(self.physics, self._touch)) * 1e9))

    # ----------------------------------------------------------------- estimate

    def _estimate(self) -> None:
        """Estimate in the background, when there is news: from what was felt since the last estimate that can be relied on, which is what
        was known before."""
        nodes = self.nodes
        tissue_now = (self._model_stamp, self.config, self.physics, id(nodes))
        try:
            done = self._background.take()
            if done is not None:
                (about, count), (found, most, seconds) = done
                if about == tissue_now and count <= self._gathered:
                    self.failure, self._seconds, self._estimated = "", seconds, self._estimated + 1
                    used = count
                    if most is not None:
                        used = self._begin_with(most, count)
                    elif found.doubts and (left := self._drop(count, found)):
                        what = "an experiment is" if left == 1 else f"{left} experiments are"
                        self._left_out = f"{what} left out of the estimate: {'; '.join(found.doubts)}"
                    if not (found.doubts and self._known_of == about):
                        self.found, self._known_of = found, None if found.doubts else about
                        self._publish(found)
                    self._used = used
                    self._log_new()
        except Exception as error:
            self.failure = sentence("identification", error)
            self.report_error(self.failure)
            about, count = self._background.wish
            if about == tissue_now and count <= self._gathered:
                self._drop(count)  # nor would they tell anything later
                self._used = count
        start = self.found if self._known_of == tissue_now else None
        fresh = self._gathered - self._used if start is not None else len(self.experiments)
        if nodes is None or not fresh or (start is not None and fresh < self._options.new_touches):
            return
        experiments, config, physics = self.experiments[-fresh:], self.config, self.physics
        before, others = self.experiments[:-fresh], [*self._doubted, *experiments]
        around = nodes.rest[nodes.is_skin & ~nodes.pinned].astype(np.float64)  # where tools may touch later

        def build() -> tuple[Identification, list[Experiment] | None, float]:
            """An estimate, the experiments that it is of, if others than the new ones and those before, and how long it took, s."""
            began = time.monotonic()
            progress, device = self._note_progress, physics.device
            estimate = lambda some, start=None: identify(some, nodes, physics, config, device, progress, around=around, start=start)
            found, most = estimate(experiments, start), None
            if found.doubts and len(others) > max(len(before), 1):  # they may be right, and what came before may be wrong
                every = [*before, *others]
                told = identify_most(every, estimate)
                if told is not None:
                    found, most = told[0], [each for number, each in enumerate(every) if number not in told[1]]
            return found, most, time.monotonic() - began

        self._background.want((tissue_now, self._gathered), build)

    def _drop(self, count: int, found: Identification | None = None) -> int:
        """Forget the experiments that an estimate was made of when so many were gathered, none that came before or later; how many. Where
        they were only doubted they may yet turn out to be right."""
        of_it, later = count - self._used, self._gathered - count
        if of_it:
            left = slice(-(of_it + later), -later or None)
            if found is not None:
                self._doubted = [*self._doubted, *self.experiments[left]][-self._options.experiments :]
            del self.experiments[left]
        return of_it

    def _begin_with(self, most: list[Experiment], count: int) -> int:
        """Go on from experiments that agree with one another, in place of those that were relied on when so many were gathered; how many
        of all are then used, or forgotten as more came meanwhile than are kept."""
        later = min(self._gathered - count, len(self.experiments))
        kept = len(self.experiments) - later
        left = sum(not any(each is other for other in most) for each in [*self.experiments[:kept], *self._doubted])
        self.experiments, self._doubted = [*most, *self.experiments[kept:]], []
        what = "an experiment is" if left == 1 else f"{left} experiments are"
        why = "left out of the estimate, which begins anew: most others agree with one another, and contradict what was left out"
        self._left_out = f"{what} {why}" if left else ""
        return self._gathered - later

    def _note_progress(self, stage: str, done: int, total: int) -> None:
        self._progress = f"{stage}, {done} of at most {total}" if done else stage

    def _publish(self, found: Identification) -> None:
        cloud = StiffnessCloud(found.nodes.rest, found.young_modulus, found.low, found.high, found.known)
        self._map_pub.publish(messages.encode_stiffness(cloud, self._model_stamp, self._options.world_frame))
        for line in found.summary().splitlines()[: -len(found.findings) or None]:  # these are logged when they are new
            self.get_logger().info(line)
        if self._options.apply:
            if found.any_known:
                self._to_set = told(found, self.physics)
            else:
                self.get_logger().warning("nothing is given to physics_node, as no modulus is known")

    def _apply(self) -> None:
        """Set parameters of physics_node, as soon as that is there."""
        if self._to_set is None or not self._set.service_is_ready():
            return
        values, self._to_set = self._to_set, None
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]

        def answered(future: Any) -> None:
            with self.guard("physics_node"):
                result = future.result().result
                if not result.successful:
                    self.report_error(f"{self._options.physics_node} refuses what was estimated: {result.reason}")

        self._set.call_async(SetParametersAtomically.Request(parameters=parameters)).add_done_callback(answered)

    def _on_reset(self, _: Trigger.Request) -> tuple[bool, str]:
        count = len(self.experiments)
        self._begin_anew()
        return True, f"{count} experiments are forgotten"

    # -------------------------------------------------------------- diagnostics

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: how much was felt, and what that tells."""
        estimating = self._background.busy
        if self.nodes is None:
            state = IdentificationState.WAITING
        elif estimating:
            state = IdentificationState.ESTIMATING
        else:
            state = IdentificationState.FAILED if self.failure else IdentificationState.COLLECTING
        values: dict[str, Any] = {STATE: state, "experiments": self._gathered, "estimates": self._estimated}
        if self.nodes is None:
            return WARN, "waiting for a model on gaussians, and for where it is seen from", values
        found = self.found
        if found is not None:
            values |= {
                "young_modulus": f"{np.median(found.young_modulus):.6g}",
                "known": f"{found.known.mean():.3f}",
                "seconds per estimate": f"{self._seconds:.1f}",
            }
        if state is IdentificationState.FAILED:
            return ERROR, self.failure, values
        text = f"{self._gathered} experiments" if self._gathered else f"waiting for a touch of {' or '.join(self._arms)}, and for its end"
        if estimating:
            text += f"; estimating ({self._progress})"
        if found is None:
            return OK, text, values
        text = f"{text}; {found.summary().splitlines()[0]}"
        noticed = self._noticed()
        return (WARN, f"{text}; {'; '.join(noticed)}", values) if noticed else (OK, text, values)

    def _noticed(self) -> list[str]:
        """What was noticed, what matters most first."""
        findings, doubts = (self.found.findings, self.found.doubts) if self.found is not None else ([], [])
        others = [text for text in dict.fromkeys([*doubts, *findings, *self._said]) if text not in self._left_out]
        return [self._left_out, *others] if self._left_out else others

    def _log_new(self) -> None:
        """Log what was not noticed before."""
        new = [text for text in self._noticed() if text not in self._logged]
        for text in new:
            self.get_logger().warning(text)
        self._logged.update(new)

    def destroy_node(self) -> None:
        """Estimate nothing more."""
        self._builder.stop()
        self._background.stop()
        super().destroy_node()


def _refinable(config: IdentificationConfig) -> IdentificationConfig:
    """The configuration, if estimates with it can be refined.

    Raises:
        ConfigError: If they cannot.
    """
    if config.stiffness == "inclusion":
        raise ConfigError(
            "stiffness: inclusion needs all presses together, and this node takes one after the other; choose field, or record the presses"
            " and give them to endo-sim identify"
        )
    return config


if __name__ == "__main__":
    raise SystemExit(run(IdentificationNode))
