"""Gaussian model and tool wrenches in, control nodes and reactions out."""

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.errors import MotionError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.messages import ERROR, OK, STATE, WARN, ControlNodeCloud, PhysicsState
from endo_sim_ros.nodes.arm_setup import CAMERA_ARM, make_arms, place_arms
from endo_sim_ros.nodes.arm_topics import ArmTopics
from endo_sim_ros.nodes.base import STREAM_DEPTH, EndoNode, run, sentence
from endo_sim_ros.nodes.camera_arm import CameraArm
from endo_sim_ros.nodes.configs import COMMAND_PARTS, PhysicsNodeConfig
from endo_sim_ros.nodes.jointed_arm import JointedArm
from endo_sim_ros.nodes.listeners import Listeners
from endo_sim_ros.nodes.pacing import MOST_WAITING, WINDOW, CommandQueue, Pacer, SpeedMeter
from endo_sim_ros.nodes.parameters import beside_parameters
from endo_sim_ros.nodes.reactions import ReactionTopics
from endo_sim_ros.nodes.tissue_builder import TissueBuilder
from endo_sim_ros.nodes.tool_actions import apply_tools, collisions, slip_sentence
from endo_sim_ros.physics import MotionConfig, PhysicsConfig, TissueSimulation
from endo_sim_ros.physics.regions import read_regions

_SLOW = 0.5  # real-time factor below which the node warns
_FAST = 1.5  # times real speed from which a clock is to blame for that
_POLLS = 4  # times per step that the timer asks whether a step is due
_LONGEST_POLL = 0.1  # seconds; models and parameters must not wait for steps that take minutes
_SAID_AGAIN = 10.0  # seconds after which the log has again that an arm misses what is measured


class PhysicsNode(EndoNode):
    """Samples control nodes from the latest model and steps them at the rate of the simulation."""

    read_at_start = frozenset(
        {"found_motion", "arms", "arm_source", "instruments", "arm_models", "link_contact", "mode", "lockstep_inputs", "reaction_rate"}
    )

    def __init__(self) -> None:
        super().__init__("physics_node")
        self._options = self.declare(PhysicsNodeConfig)
        self.config = _with_file(self.declare(PhysicsConfig))
        self._builder = TissueBuilder()
        self.simulation: TissueSimulation | None = None
        self._simulated_stamp = 0  # stamp of the simulated model, ns
        self.failure = ""  # why the newest model is not simulated
        self._paused, self.steps, self._seconds_per_step = False, 0, 0.0
        self.speed = SpeedMeter()
        self._asked = 0.0  # time of the clock when it was last asked for a step
        self._pacer = Pacer()
        self.arms = make_arms(self._options)
        self._tools = {name: arm for name, arm in self.arms.items() if name != CAMERA_ARM}
        self._view: tuple[Camera, float] | None = None  # a camera of the newest model and the depth of the tissue that it sees, m
        self._unplaced = ""  # why arms have no place
        self._collisions: list[str] = []  # of the newest step
        self._lockstep = self._options.mode == "lockstep"
        self._commands = CommandQueue(frozenset((n, kind) for n in self._tools for kind in self._options.lockstep_inputs))
        self._placing = CommandQueue(self._commands.needed)  # lockstep: what puts the arms where an episode begins
        self._held: dict[tuple[str, str], tuple[str, Callable[[], None]]] = {}  # newest parts of commands that came during a pause
        self._at_rest = False  # whether no step was taken of the simulation
        # In real time only the newest command counts, and none may queue; in lockstep none may be lost.
        depth = MOST_WAITING if self._lockstep else 1
        self._nodes_pub = self.publisher(messages.CONTROL_NODES, MOST_WAITING if self._lockstep else STREAM_DEPTH, alone=True)
        self._cut_pub = self.publisher(messages.CUT_SURFACE, depth, alone=True)
        self._published_cut = 0  # number of the newest surface that was published
        self._motion_pub = self.publisher(messages.TISSUE_MOTION, alone=True)
        self._markers_pub = self.publisher(messages.TOOL_MARKERS, alone=True)
        self._clock_pub = self.publisher(messages.CLOCK, alone=True) if self._lockstep else None
        self._found: Path | None = None  # file of the motion that was found of the newest model
        self._moved_by: set[str] = set()  # options of the motion that come from it
        self._file_cleared = False  # whether motion.file became empty since the timer ran
        self.subscribe(messages.GAUSSIANS, self._on_model)
        self.subscribe(messages.FOUND_MOTION, self._on_found_motion)
        self.subscribe(
            messages.TRAINING_CAMERAS, lambda message: self._builder.receive_training_cameras(message, self._options.world_frame)
        )
        self.subscribe(messages.TRAINING_CAMERA_INFO, self._builder.receive_training_info)
        self.subscribe(messages.CAMERA_POSE, self._on_camera_pose)
        self.subscribe(messages.TISSUE_MOTION_COMMAND, self._on_motion_command)
        self._reactions = ReactionTopics(self, self._tools, self._options.reaction_rate, self._lockstep)
        self._arm_topics = ArmTopics(self, self.arms, self._options, depth, self._on_command, self._discard)
        self._listeners = Listeners([self._nodes_pub, *self._arm_topics.joints.link_publishers])  # lockstep: of states
        self._told = 0  # how many of them the newest state at rest was published for
        self._place_arms()
        self.service(Trigger, "~/reset", self._on_reset)
        self.service(Trigger, "~/step", self._on_step)
        self.service(SetBool, "~/pause", self._on_pause)
        self._timer = self.every(_poll(self.config), self._on_timer)

    def config_changed(self, config: PhysicsConfig | PhysicsNodeConfig) -> None:
        """New options of the physics: a simulation is built for them in the background."""
        if isinstance(config, PhysicsConfig):
            config = _with_file(config)
            if config.regions != self.config.regions:
                read_regions(config.regions)  # what cannot be read is refused
            if config.motion.file not in ("", self.config.motion.file):
                TissueMotion.load(Path(config.motion.file).expanduser(), self._builder.model)  # likewise
            self._file_cleared |= bool(self.config.motion.file) and not config.motion.file
            self.config = config  # the timer builds a simulation for it
            if self.simulation is not None:
                self._move_on(self.simulation)
            self._timer.timer_period_ns = int(_poll(config) * 1e9)
        else:
            moved = config.frames != self._options.frames
            self._options = config
            self._arm_topics.change_options(config)
            if moved:
                self._place_arms()

    # ------------------------------------------------------------------ model

    def _on_model(self, message: Any) -> None:
        self._builder.receive_model(message, self._options.world_frame)
        self._move_as_found()

    def _on_found_motion(self, message: Any) -> None:
        text = messages.decode_text(message)
        self._found = Path(text) if text else None
        self._move_as_found()

    def _move_as_found(self) -> None:
        """Let the tissue of the newest model move as it was found to; where nothing was found, or it cannot be used, let it rest."""
        own = "motion.file" in self.given
        if own and self.config.motion.file or self._builder.model is None:
            return
        found = self._found_of(self._builder.model) if self._options.found_motion and not own else {}
        values = {f"motion.{name}": getattr(MotionConfig(), name) for name in self._moved_by} | found
        self._moved_by = {name.removeprefix("motion.") for name in found}
        self.choose(values)

    def _found_of(self, model: GaussianModel) -> dict[str, Any]:
        """The parameters of the motion that was found of a model; none, and a warning, where it cannot be used."""
        if self._found is None:
            return {}
        try:
            if not self._found.is_file():
                raise ValueError("this machine does not have it; copy it here and set motion.file")
            motion = TissueMotion.load(self._found, model)
            found = {f"motion.{name}": value for name, value in {"file": str(self._found), **motion.parameters}.items()}
            self.config.replaced({name: value for name, value in found.items() if name not in self.given})
        except MotionError:  # it is of a model that is still to come
            return {}
        except ValueError as error:
            self.report_warning(f"the tissue does not move by itself as it was found to: {self._found}: {error}")
            return {}
        self.get_logger().info(f"the tissue moves by itself as it was found to, by {motion.told}")
        return found

    def _on_camera_pose(self, message: Any) -> None:
        camera = self.arms.get(CAMERA_ARM)
        if camera is None or camera.pose is None:  # else it is that of our own arm
            self._arm_topics.camera_pose = self._builder.receive_camera_pose(message, self._options.frame_poses)

    def _build(self) -> None:
        """Build a simulation of the newest model in the background; the old one goes on meanwhile."""
        try:
            built = self._builder.take()
            if built is not None:
                (stamp, simulation, view), old = built, self.simulation
                same_model = stamp == self._simulated_stamp
                continued = old is not None and same_model and simulation.continue_from(old)  # only its material has changed
                self._simulated_stamp, self.simulation, self.failure = stamp, simulation, ""
                self._move_on(simulation)
                self._start_timing()
                if not continued:
                    for arm in self.arms.values():
                        arm.acting = False
                    if old is not None and same_model and len(old.cuts):
                        self.report_warning("the tissue was built anew for other options: it is at rest, and its cuts have healed")
                for name, arm in self.arms.items():
                    if isinstance(arm, JointedArm) and arm.capsules and not simulation.has_instrument(name):
                        with self.guard(f"link_contact of {name}"):
                            simulation.set_instrument(name, arm.capsules)
                if not same_model and not _same_camera(self._view, view):
                    self._view = view
                    self._place_arms(anew=True)
                elif not same_model:  # a later model may show where the others stand
                    kept = [name for name, arm in self.arms.items() if isinstance(arm, JointedArm) and arm.base is not None]
                    self._place_arms(view=view, kept=kept)
                if self._lockstep and not continued:  # the first observation, before any command
                    self._publish(self.simulation, self._simulated_stamp, at_rest=True)
        except Exception as error:
            self.failure = sentence("physics", error)
            self.report_error(self.failure)
        self._builder.want(self.config)

    def _move_on(self, simulation: TissueSimulation) -> None:
        """Let breath and heart move as the options have it."""
        old, new = simulation.config, self.config
        fits = old.travel >= new.travel and old.motion.file == new.motion.file  # else another simulation is being built
        if old.motion != new.motion and fits:
            simulation.set_motion(new.motion)

    def _on_motion_command(self, message: Any) -> None:
        values = messages.decode_motion_command(message, messages.TISSUE_MOTION_COMMAND.name)
        if "file" in values:
            raise ValueError("a motion file is no number, and so no part of a command; set the parameter motion.file")
        try:
            self.config.motion.replaced(values)  # what is wrong, in our words
        except ConfigError as error:
            raise ValueError(str(error)) from error  # whose topic is told by who called
        parameters = [Parameter(f"motion.{name}", value=value) for name, value in values.items()]
        result = self.set_parameters_atomically(parameters)
        if not result.successful:
            raise ValueError(result.reason)

    # ------------------------------------------------------------------ tools

    def _place_arms(self, anew: bool = False, view: tuple[Camera, float] | None = None, kept: Collection[str] = ()) -> None:
        """Put arms where `frames` or a camera says, those without a robot at their start.

        Args:
            anew: Also arms that stand there already.
            view: As `place_arms` has it; None = what was seen of the first model of the recording.
            kept: As `place_arms` has it.
        """
        arms = self.arms
        stood = {name: arm.pose for name, arm in arms.items() if isinstance(arm, JointedArm) and arm.commanded and arm.base is not None}
        before, self._unplaced = self._unplaced, place_arms(arms, self._options.frame_poses, view or self._view, anew, kept)
        why = "a model of another recording came" if anew else "its base has changed"
        for name, pose in stood.items():
            arm = arms[name]
            if pose is not None and arm.pose is not None and not np.array_equal(pose, arm.pose):
                self._arm_topics.warn(arm, f"{name} is at its start, as {why}; it holds nothing, and its move ended", again=True)
        self._arm_topics.joints.describe()
        if self._unplaced and self._unplaced != before and self.simulation is not None:
            self.get_logger().warning(self._unplaced)

    def _on_command(self, name: str, kind: str, message: Any, topic: str, act: Callable[[], None]) -> None:
        """Let a part of a command act now or, in lockstep, in the step that its stamp names."""
        if self._lockstep and kind in self._options.lockstep_inputs:
            stamp = messages.stamp_to_ns(message.header.stamp)
            if stamp <= 0:
                raise ValueError("a stamp of zero; in lockstep all parts of a command bear its stamp")
            placing = self._at_rest and stamp == self._simulated_stamp
            (self._placing if placing else self._commands).put(stamp, (name, kind), (topic, act))
            self._run_commands()
            return
        if self._paused:
            self._held[name, kind] = topic, act
            return
        act()
        if kind == "wrench" and not self._lockstep:
            self._pacer.note_input(self._seconds(), name)
            self._step_if_due()

    def _discard(self, name: str, kinds: Collection[str]) -> None:
        """Forget parts of commands that wait for the end of a pause."""
        for kind in kinds:
            self._held.pop((name, kind), None)

    def _run_commands(self) -> None:
        """Lockstep: one step for each complete command, but none for one with the stamp of the state at rest."""

        def give_up(stamp: int, missing: set) -> None:
            parts = ", ".join(sorted(f"{name}'s {kind}" for name, kind in missing))
            self.report_error(f"the command of {stamp * 1e-9:.6f} s is given up: a later one is complete, but {parts} never came")

        while self.simulation is not None and (command := self._placing.take(give_up) or self._commands.take(give_up)):
            stamp, parts = command
            self._run_parts(parts)
            placing = self._at_rest and stamp == self._simulated_stamp
            if not placing:
                self.step(self.simulation)
            self._publish(self.simulation, stamp, at_rest=placing)

    def _run_parts(self, parts: Mapping[tuple[str, str], tuple[str, Callable[[], None]]]) -> None:
        """Let parts of commands act."""
        for part in sorted(parts, key=lambda part: (COMMAND_PARTS.index(part[1]), part[0])):  # poses before what needs them
            topic, act = parts[part]
            with self.guard(topic):
                act()

    # ------------------------------------------------------------------ steps

    def _seconds(self) -> float:
        """The clock that steps follow in real time: the wall's, or /clock."""
        return self.now_ns() * 1e-9

    def _on_timer(self) -> None:
        with self.guard("physics"):
            if self._file_cleared:  # other parameters cannot be set while one is
                self._file_cleared = False
                self._move_as_found()
            self._build()
            if self._lockstep:
                self._run_commands()  # those that came before the model
                self._repeat_rest()
            else:
                self._step_if_due()

    def _repeat_rest(self) -> None:
        """Lockstep: publish the state at rest again when somebody new listens; it waits for a command, and is not sent again else."""
        if not self._at_rest or self.simulation is None:
            return
        settled = self._listeners.settled()  # one listener's topics are found one after another, and states need their links
        self._told = min(self._told, self._listeners.count)
        if settled and self._listeners.count > self._told:
            self._publish(self.simulation, self._simulated_stamp, at_rest=True)

    def _step_if_due(self) -> None:
        """Real time: take the next step if it is time for it; the steps of a whole leap of a simulated clock, in time for the next."""
        simulation, now = self.simulation, self._seconds()
        if simulation is None or now == 0:  # 0: no /clock yet
            return
        step, before, began = simulation.step_duration, self._asked, time.monotonic()
        self._asked = now
        leaping = self.get_parameter("use_sim_time").value and 0 < now - before < WINDOW
        moments = [*np.arange(before + step, now, step), now] if leaping else [now]
        due = False
        for moment in moments:
            if time.monotonic() - began > _LONGEST_POLL:
                moment = now  # what is left is skipped
            if self._pacer.is_due(moment, step):
                due = True
                if not self._paused:
                    self.step(simulation)
            if moment == now:
                break
        if due:
            if not self._paused:
                self.speed.note(now, simulation.time)
            self._publish(simulation, self.now_ns())

    def _start_timing(self) -> None:
        """Begin to measure and to pace anew: the time before this was not meant to be simulated."""
        self._pacer.restart()
        self.speed.restart()

    def step(self, simulation: TissueSimulation) -> None:
        """Take one step with what the arms command."""
        start, faults, tears, slips = time.monotonic(), simulation.faults, simulation.tears, simulation.slips_by_tool()
        held, self._held = self._held, {}
        self._run_parts(held)
        for arm in self.arms.values():
            turning = arm.angle_goal is not None
            missing = arm.move(simulation.step_duration, self._options.move_speed, self._options.turn_speed)
            if isinstance(arm, CameraArm):
                missing = missing or arm.in_tissue(simulation.nodes)
            self._arm_topics.warn(arm, missing)
            if turning:  # else a jaw that tissue slipped out of would close again
                arm.hold(self._options.jaw_closed, self._options.jaw_open)
        apply_tools(
            simulation, self._tools, self._options, None if self._lockstep else self._seconds(), self.report_error, self.report_warning
        )
        self._collisions = collisions(self._tools)
        for missing in self._misses():
            self.get_logger().warning(missing, throttle_duration_sec=_SAID_AGAIN)
        simulation.step()
        for name, arm in self._tools.items():
            self._arm_topics.limit_force(arm, lambda name=name: simulation.reaction(name)[0])
        for name, count in simulation.slips_by_tool().items():
            if count > slips.get(name, 0):
                self.arms[name].closed = self.arms[name].empty = simulation.is_closed(name)
                self._arm_topics.tell_slip(self.arms[name], slip_sentence(name, simulation.config, self._options.link_contact))
        self.steps += 1
        if simulation.faults > faults:
            self.report_error(simulation.last_fault)
        if simulation.tears > tears:
            self.report_warning(simulation.last_tear)
        self._seconds_per_step += 0.1 * (time.monotonic() - start - self._seconds_per_step)

    def _publish(self, simulation: TissueSimulation, stamp: int, at_rest: bool = False) -> None:
        """The state, the reactions and what belongs to them, all with one stamp; the state at rest is no moment in time."""
        world, state, self._at_rest = self._options.world_frame, simulation.state(), at_rest
        if self._lockstep and at_rest:
            self._told = self._listeners.count
        if self._clock_pub is not None and not at_rest:
            self._clock_pub.publish(messages.encode_clock(stamp))
        cut = messages.cut_number(simulation.cuts)
        if cut != self._published_cut:  # before the state that has it
            self._cut_pub.publish(messages.encode_cut_surface(simulation.cuts, self._simulated_stamp, world, torn=simulation.torn))
            self._published_cut = cut
        self._arm_topics.publish_camera(stamp)
        cloud = ControlNodeCloud(state.rest, state.positions, state.F, self._simulated_stamp, cut)
        self._nodes_pub.publish(messages.encode_control_nodes(cloud, stamp, world))
        self._arm_topics.joints.publish_links(stamp)  # found while the state, which is large, is on its way to who draws both
        self._arm_topics.publish_camera_state(stamp)
        motion = simulation.motion
        self._motion_pub.publish(messages.encode_motion(motion.displacements, motion.velocities, motion.phases, motion.rates, stamp))
        shown, reactions, marked = [], {}, self._markers_pub.get_subscription_count() > 0
        for name, arm in self._tools.items():
            if arm.pose is None:
                continue
            reaction, torque = simulation.reaction(name)
            if isinstance(arm, JointedArm):
                arm.link_reactions = simulation.link_reactions(name)
            axes = arm.pose[:3, :3].T  # those of the tool
            reactions[name] = np.concatenate([axes @ reaction, axes @ torque])
            self._arm_topics.publish(arm, arm.pose, reaction, torque, stamp)
            if marked:
                shown.append(self._arm_topics.display(arm, reaction, simulation.held(name)))
        self._reactions.publish(reactions, stamp, simulation.step_duration)
        self._arm_topics.joints.publish_joint_states(stamp)
        if shown:
            self._markers_pub.publish(messages.encode_tool_markers(shown, stamp, world))
        self._arm_topics.publish_operating_states()  # at last: who waits for the end of a move then asks where the arm is

    # --------------------------------------------------------------- services

    def _on_reset(self, _: Trigger.Request) -> tuple[bool, str]:
        if self.simulation is None:
            return False, "there is no model yet"
        self.simulation.reset()
        self._commands.clear()
        self._placing.clear()
        self._held.clear()
        self._start_timing()
        for arm in self.arms.values():
            arm.reset()
        self._publish(self.simulation, self._simulated_stamp if self._lockstep else self.now_ns(), at_rest=True)
        return True, "at rest"

    def _on_step(self, request: Trigger.Request) -> tuple[bool, str]:
        simulation = self.simulation
        if simulation is None:
            return False, "there is no model yet"
        if not (self._paused or self._lockstep):
            return False, "running; call ~/pause with true first, or use mode lockstep"
        for _ in range(self._options.step_count):
            self.step(simulation)
            if self._lockstep:
                self._commands.last_stamp += round(simulation.step_duration * 1e9)
            self._publish(simulation, self._commands.last_stamp if self._lockstep else self.now_ns())
        return True, f"time {simulation.time:.4f} s"

    def _on_pause(self, request: SetBool.Request) -> tuple[bool, str]:
        if self._lockstep:
            return False, "in lockstep time passes only with commands; there is nothing to pause"
        self._paused = request.data
        self._start_timing()
        return True, "paused" if request.data else "running"

    # ------------------------------------------------------------ diagnostics

    @property
    def _state(self) -> PhysicsState:
        if self.simulation is not None:
            return PhysicsState.PAUSED if self._paused else PhysicsState.RUNNING
        if self._builder.model is not None and self._builder.busy:
            return PhysicsState.BUILDING
        return PhysicsState.FAILED if self.failure else PhysicsState.WAITING

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: the mode, and once there is tissue how its simulation goes."""
        simulation, state = self.simulation, self._state
        values = {STATE: state, "mode": self._options.mode}
        if simulation is None:
            if state is PhysicsState.BUILDING:
                return OK, "building control nodes", values
            if state is PhysicsState.FAILED:
                return ERROR, self.failure, values
            if self._builder.model is None:
                return WARN, "waiting for a model on gaussians", values
            return WARN, "waiting for training_cameras or ECM/measured_cp to know from which side the tissue is seen", values
        values |= {
            "nodes": len(simulation.nodes.rest),
            "steps": self.steps,
            "substeps": simulation.solver.substepping.count,
            "milliseconds per step": f"{1e3 * self._seconds_per_step:.1f}",
            "real-time factor": f"{self.speed.real_time_factor:.2f}",
            "skipped steps": self._pacer.skipped,
            "simulated time": f"{simulation.time:.2f}",
            "faults": simulation.faults,
            "slips": simulation.slips,
            "tears": simulation.tears,
            "parted links": simulation.parted_links,
        }
        if self.failure:
            return ERROR, f"{self.failure}; the model before goes on", values
        if state is PhysicsState.PAUSED:
            return OK, "paused", values
        level, text = self._progress()
        if level == OK and (wrong := "; ".join(filter(None, [self._unplaced, *self._misses()]))):
            level, text = WARN, f"{text}; {wrong}"
        return level, text, values

    def _misses(self) -> list[str]:
        """What joints miss of the poses that robots measure, and which instruments run into each other, in sentences."""
        return [arm.missing for arm in self.arms.values() if isinstance(arm, JointedArm) and arm.missing] + self._collisions

    def _progress(self) -> tuple[int, str]:
        """Level and message: how the steps go."""
        if self._lockstep:
            waiting = self._commands.missing()
            if waiting is None:
                return OK, f"in lockstep, {self.steps} steps taken, waiting for a command"
            parts = ", ".join(sorted(f"{name}'s {kind}" for name, kind in waiting[1]))
            return OK, f"in lockstep, waiting for {parts} of the command of {waiting[0] * 1e-9:.6f} s"
        simulated = self.get_parameter("use_sim_time").value  # else the clock is that of the system, which no one can slow down
        if simulated and self.speed.real_time_factor < _SLOW and self.speed.clock_speed > _FAST:
            text = (
                f"slower than /clock, which runs at {self.speed.clock_speed:.1f} times real speed; let it run slower, or lower node_count"
            )
            return WARN, text
        if self.speed.real_time_factor < _SLOW:
            return WARN, "slower than real time; lower node_count or young_modulus, or use a GPU"
        return OK, "running"

    def destroy_node(self) -> None:
        """Build no more tissue, publish no more reactions, and destroy the node."""
        self._builder.stop()
        self._reactions.stop()
        super().destroy_node()


def _same_camera(view: tuple[Camera, float] | None, other: tuple[Camera, float] | None) -> bool:
    """Whether the cameras of two models are the same: then a recording goes on, as while its model is being trained."""
    if view is None or other is None:
        return False
    return np.array_equal(view[0].pose, other[0].pose) and np.array_equal(view[0].K, other[0].K)


def _with_file(config: PhysicsConfig) -> PhysicsConfig:
    """The physics with the path of the file of its motion, see `beside_parameters`."""
    file = beside_parameters("motion.file", config.motion.file)
    return replace(config, motion=replace(config.motion, file=file))


def _poll(config: PhysicsConfig) -> float:
    """Seconds from one look for something to do to the next."""
    return min(config.step_duration / _POLLS, _LONGEST_POLL)


if __name__ == "__main__":
    raise SystemExit(run(PhysicsNode))
