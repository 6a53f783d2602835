"""Gaussian model, control nodes and a camera pose in, images out."""

import time
from collections import deque
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, Literal

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import Capsule, Part
from endo_sim_ros.instruments.drawing import PosedInstruments
from endo_sim_ros.messages import ERROR, OK, STATE, WARN, CameraInfo, ControlNodeCloud, MessageError, RenderingState, Topic
from endo_sim_ros.nodes.base import STREAM_DEPTH, EndoNode, run, sentence
from endo_sim_ros.nodes.configs import RenderingNodeConfig, arm_names
from endo_sim_ros.nodes.episode_queue import EpisodeQueue
from endo_sim_ros.nodes.model_tracker import BoundModel, ModelTracker
from endo_sim_ros.nodes.pacing import MOST_WAITING, Pacer
from endo_sim_ros.nodes.rendered_topics import RenderedTopics, Shown, beside, right_camera
from endo_sim_ros.nodes.shown_instruments import THING, ShownInstruments
from endo_sim_ros.rendering import RenderingConfig

_MAX_SIDE = 8192  # pixels; a damaged camera_info must not make the node ask for all memory
_POLLS = 4  # times per image that the timer asks whether one is due
_IN_TRANSIT = 0.5  # seconds after a reset in which poses of the episode before may still come


class RenderingNode(EndoNode):
    """Keeps the newest model, node state and camera, and renders them at its own rate, or state by state in lockstep."""

    read_at_start = frozenset({"mode", "lockstep_camera", "arms", "thing"})

    def __init__(self) -> None:
        super().__init__("rendering_node")
        self.options = self.declare(RenderingNodeConfig)
        self._config = self.declare(RenderingConfig)
        self._lockstep = self.options.mode == "lockstep"
        depth = MOST_WAITING if self._lockstep else 1
        self.tissue = ModelTracker(max(depth, STREAM_DEPTH))
        self._nodes: ControlNodeCloud | None = None
        self._nodes_stamp = self._stamp_before = 0  # of that state and of the one before, ns
        self._waits_since: float | None = None  # real time: since when links or a state are awaited that belong together
        self._last_stamp = 0  # of the newest image in real time, ns
        self._failure = ""  # why the newest model is not shown
        self._pose: np.ndarray | None = None
        self._thing_poses: np.ndarray | None = None
        self._rest_poses: dict[str, np.ndarray] = {}  # lockstep, by topic: the newest with the stamp of the state at rest
        self._training_pose: np.ndarray | None = None
        self._infos: dict[Topic, CameraInfo] = {}  # the newest of each topic
        self._states: deque[tuple[int, ControlNodeCloud]] = deque()  # lockstep: stamps and states still to be shown
        # Lockstep, by topic: poses that wait for their state.
        self._poses = {topic.name: EpisodeQueue[np.ndarray]() for topic in (messages.CAMERA_POSE, messages.THING_POSES)}
        self._reset_heard = 0.0  # lockstep: when the newest state at rest came
        self._pacer = Pacer()
        self._dirty, self.images, self._last_image = True, 0, 0.0
        self._output: Shown | None = None
        self._seconds_per_image, self._instruments_shown = 0.0, 0
        self._blind: np.ndarray | None = None  # position [3], m, world, of the newest camera, if it sees no tissue
        self._topics = RenderedTopics(self)
        thing = find_thing(self.options.thing) if self.options.thing else None
        self.instruments = ShownInstruments(arm_names(self.options.arms), self._lockstep, thing)
        self._awaited = ""  # lockstep: what the first state waits for
        self.subscribe(messages.GAUSSIANS, self._on_model)
        self.subscribe(messages.TRAINING_CAMERAS, self._on_training_cameras)
        self.subscribe(messages.CONTROL_NODES, self._on_nodes, depth)
        self.subscribe(messages.CUT_SURFACE, self._on_cut_surface, depth)
        self.subscribe(messages.DYE, self._on_dye)
        self.subscribe(messages.CAMERA_POSE, self._on_camera, depth)
        if thing is not None:
            self.subscribe(messages.THING_POSES, self._on_thing, depth)
        for topic in (messages.LEFT_INFO, messages.RIGHT_INFO, messages.TRAINING_CAMERA_INFO):
            self.subscribe(topic, partial(self._on_info, topic), depth=1)
        for arm in self.instruments.arms:
            self.subscribe(messages.tool_type(arm), partial(self._on_tool_type, arm))
            self.subscribe(messages.tool_links(arm), partial(self._on_links, arm), depth)
        self._timer = self.every(1.0 / self.options.rate / _POLLS, self._on_timer)

    def config_changed(self, config: RenderingConfig | RenderingNodeConfig) -> None:
        """New options of the rendering: the model is bound anew in the background."""
        if isinstance(config, RenderingNodeConfig):
            self.options = config
            self._timer.timer_period_ns = int(1e9 / config.rate / _POLLS)
            self._change()
        else:
            self._config = config  # the timer binds the model anew

    # ------------------------------------------------------------------ input

    def _on_model(self, message: Any) -> None:
        self.tissue.receive_model(message, self.options.world_frame)

    def _on_training_cameras(self, message: Any) -> None:
        messages.check_frame(message, (self.options.world_frame,), messages.TRAINING_CAMERAS.name)
        poses = messages.decode_poses(message)
        if len(poses):  # a model from a file has none; then those before are better than nothing
            self._training_pose = poses[len(poses) // 2]
            self._change()

    def _on_nodes(self, message: Any) -> None:
        messages.check_frame(message, (self.options.world_frame,), messages.CONTROL_NODES.name)
        nodes, old = messages.decode_control_nodes(message), self._nodes
        same = (
            old is not None
            and old.model_stamp_ns == nodes.model_stamp_ns
            and np.array_equal(old.positions, nodes.positions)
            and np.array_equal(old.F, nodes.F)
            and old.cut == nodes.cut
        )
        self._stamp_before, self._nodes_stamp = self._nodes_stamp, messages.stamp_to_ns(message.header.stamp)
        self._nodes = nodes
        if self._lockstep:
            if self._nodes_stamp == nodes.model_stamp_ns:
                self._reset_heard = time.monotonic()
            self._states.append((self._nodes_stamp, nodes))
            if len(self._states) > MOST_WAITING:
                dropped = self._states.popleft()[0]
                self._forget(dropped)
                raise MessageError(f"{messages.CONTROL_NODES.name}: over {MOST_WAITING} states wait to be shown; one is left out")
            self.show_states()
        elif not same:
            self._change()
            self._show_if_due()

    def _on_cut_surface(self, message: Any) -> None:
        self.tissue.receive_cut_surface(message, self.options.world_frame)
        if self._lockstep:
            self.show_states()
        else:
            self._change()

    def _on_dye(self, message: Any) -> None:
        self.tissue.receive_dye(message, self.options.world_frame)
        self._change()

    def _change(self) -> None:
        """Mark what is shown as out of date."""
        if not self._dirty:
            self._dirty = True
            self._pacer.note_input(time.monotonic())

    def _on_camera(self, message: Any) -> None:
        pose = messages.decode_pose(message, self.options.frame_poses, messages.CAMERA_POSE.name)
        same = self._pose is not None and np.array_equal(pose, self._pose)
        self._pose = pose
        if self._lockstep and self.options.lockstep_camera:
            self._follow(messages.CAMERA_POSE.name, message, pose)
        elif not same:
            self._change()

    def _on_thing(self, message: Any) -> None:
        messages.check_frame(message, (self.options.world_frame,), messages.THING_POSES.name)
        poses = messages.decode_thing_poses(message)
        self.instruments.check_thing(poses)
        same = self._thing_poses is not None and np.array_equal(poses, self._thing_poses)
        self._thing_poses = poses
        if self._lockstep:
            self._follow(messages.THING_POSES.name, message, poses)
        elif not same:
            self._change()

    def _follow(self, topic: str, message: Any, pose: np.ndarray) -> None:
        """Lockstep: keep a pose for the state with its stamp."""
        stamp = messages.stamp_to_ns(message.header.stamp)
        if stamp == self.tissue.model_stamp:  # that of the state at rest, which comes before or after those of all steps
            self._rest_poses[topic] = pose
        else:
            self._poses[topic].put(stamp, pose, replace=True)
        self.show_states()

    def _on_info(self, topic: Topic, message: Any) -> None:
        info, old = _decode_info(message, topic.name), self._infos.get(topic)
        self._infos[topic] = info
        if old is None or not info.same_as(old):
            self._change()

    def _on_tool_type(self, arm: str, message: Any) -> None:
        try:
            self.instruments.receive_type(arm, message)
        finally:
            self._change()

    def _on_links(self, arm: str, message: Any) -> None:
        moved = self.instruments.receive_links(arm, message, self.options.world_frame)
        if self._lockstep:
            self.show_states()
            return
        if moved:
            self._change()
        self._show_if_due()  # the state of this moment waits for them

    def _camera(self) -> Camera | None:
        """The camera asked for; until there is one, a training camera."""
        pose = self._training_pose if self._pose is None else self._pose
        info = self._left()
        if pose is None or info is None:
            return None
        return Camera(info.P[:, :3], info.width, info.height, pose)

    def _left(self) -> CameraInfo | None:
        """The left eye asked for; until there is one, that of the training cameras."""
        return self._infos.get(messages.LEFT_INFO) or self._infos.get(messages.TRAINING_CAMERA_INFO)

    def _right(self) -> CameraInfo | None:
        """The right eye asked for, if there is one."""
        left, right = self._left(), self._infos.get(messages.RIGHT_INFO)
        if right is not None or not self.options.baseline or left is None:
            return right
        return beside(left, self.options.baseline)

    # ----------------------------------------------------------------- images

    def _on_timer(self) -> None:
        with self.guard("rendering"):
            self._build()
            if self._lockstep:
                self.show_states()
            else:
                self._show_if_due()

    def _show_if_due(self) -> None:
        """Real time: show the newest state, or what was shown once more, if it is time for it."""
        camera, now = self._camera(), time.monotonic()
        if self.tissue.bound is None or camera is None or self.now_ns() == 0:  # with use_sim_time, before /clock
            return
        if self._dirty or self._output is None or not self._topics.wanted(self._right()).within(self._output.wanted):
            if self._links_to_come(now) or not self._pacer.is_due(now, 1 / self.options.rate):
                return
            self._dirty = False
            instruments = self._posed(self.tissue.bound, self.instruments.newest(), self._thing_poses)
            self._output = self._render(self.tissue.bound, self._nodes, camera, instruments or None)
            if instruments is False:  # the tissue alone meanwhile
                self._change()
        elif now - self._last_image < idle_period(self.options):
            return
        else:
            self.tissue.bound.renderer.prepare()
        self._last_image = now
        self._last_stamp = self._stamp(self.tissue.bound)
        self._publish(self._output, self._last_stamp)

    def _links_to_come(self, now: float) -> bool:
        """Real time: whether links of the newest state are on their way, which come right after it, or the state of newer links is."""
        if not self.options.instruments or not self.instruments.behind(self._nodes_stamp, self._stamp_before):
            self._waits_since = None
            return False
        if self._waits_since is None:
            self._waits_since = now
        return now < self._waits_since + 1 / self.options.rate  # then they are lost, or not those of states

    def _stamp(self, bound: BoundModel) -> int:
        """Real time: the stamp of an image, ns. It is that of the state that is shown, or now if an earlier image has that already."""
        now = self.now_ns()
        return self._nodes_stamp if bound.follows(self._nodes) and self._last_stamp < self._nodes_stamp <= now else now

    def show_states(self) -> None:
        """Lockstep: one image for each state, in order, as soon as its model and its camera are there."""
        while self._states and self.tissue.bound is not None:
            self._awaited = ""
            (stamp, nodes), later = self._states[0], [later for later, _ in islice(self._states, 1, None)]
            if nodes.model_stamp_ns not in (self.tissue.bound.model_stamp, self.tissue.model_stamp):
                self._leave_out("belongs to a model that is gone")
                continue
            camera, at_rest = self._camera(), stamp == nodes.model_stamp_ns  # the first observation
            if at_rest and later and later[0] == stamp:  # a reset after a reset
                if not self._skip_rest(stamp):
                    return
                continue
            poses = self._rest_poses if at_rest else {topic: self._poses[topic].find(stamp, later) for topic in self._followed}
            if missing := next((topic for topic, pose in poses.items() if pose is None), ""):
                ended = nodes.model_stamp_ns in later and time.monotonic() - self._reset_heard > _IN_TRANSIT
                if not self._poses[missing].passed(later) and not ended:
                    self._awaited = f"a pose on {missing}"
                    return
                self._leave_out(f"has no pose with its stamp on {missing}")
                continue
            if (pose := poses.get(messages.CAMERA_POSE.name)) is not None:
                camera = camera and replace(camera, pose=pose)
            if not self.tissue.bound.follows(nodes) or not camera or not self.tissue.has_cut(nodes):
                return
            instruments = self._await_instruments(stamp, self.tissue.bound, poses.get(messages.THING_POSES.name))
            if instruments is False:
                return
            self._states.popleft()
            self._forget(stamp)
            self._publish(self._render(self.tissue.bound, nodes, camera, instruments), stamp)

    def _skip_rest(self, stamp: int) -> bool:
        """Lockstep: leave out the first of two states at rest, the picture of which nobody waits for; False while links are on their way.

        Links that came before this node was found are lost, and the first state's must not be taken for the second's.
        """
        lost = self.options.instruments and self.instruments.not_repeated(stamp, self._arms_published())
        if lost and time.monotonic() - self._reset_heard < _IN_TRANSIT:
            self._awaited = messages.tool_links(lost).name
            return False
        self._states.popleft()
        self.instruments.forget_repeated(stamp)
        for queue in self._poses.values():
            queue.forget(stamp)
        return True

    def _arms_published(self) -> list[str]:
        """Arms whose links somebody publishes."""
        return [arm for arm in self.instruments.arms if self.count_publishers(messages.tool_links(arm).name)]

    @property
    def _followed(self) -> list[str]:
        """Lockstep: topics whose poses belong to one state each, but for that at rest, for which nobody may send one."""
        wanted = {messages.CAMERA_POSE: self.options.lockstep_camera, messages.THING_POSES: bool(self.options.thing)}
        return [topic.name for topic, follows in wanted.items() if follows]

    def _await_instruments(self, stamp: int, bound: BoundModel, thing: np.ndarray | None) -> PosedInstruments | None | Literal[False]:
        """Lockstep: the instruments at the time of the first state that waits; False while links or their drawing are awaited."""
        if not self.options.instruments:
            return None
        later = [later for later, _ in self._states if later != stamp]
        links = self.instruments.at(stamp, later, self._arms_published())
        if isinstance(links, str):
            self._awaited = messages.tool_links(links).name
            return False
        return self._posed(bound, links, thing)

    def _posed(self, bound: BoundModel, links: dict[str, np.ndarray], thing: np.ndarray | None) -> PosedInstruments | None | Literal[False]:
        """What draws the instruments, False while it is prepared; without it the tissue is shown alone, and an error says so."""
        if not self.options.instruments:
            return None
        if thing is not None:
            links = links | {THING: thing}
        try:
            return self.instruments.posed(links, self.options.drawing, bound.renderer.device)
        except Exception as error:
            self.report_error(sentence("instruments", error))
            return None

    def _forget(self, stamp: int) -> None:
        """Lockstep: what belongs to a state is not needed any more."""
        self.instruments.forget(stamp)
        for queue in self._poses.values():
            queue.forget(stamp)

    def _leave_out(self, why: str) -> None:
        stamp = self._states.popleft()[0]
        self._forget(stamp)
        self.report_error(f"the state of {stamp * 1e-9:.6f} s is not shown: it {why}")

    def _build(self) -> None:
        """Bind the newest model to its control nodes in the background; the picture before stays meanwhile."""
        if self._lockstep and self.tissue.bound is not None:
            if self._states and self.tissue.bound.follows(self._states[0][1]):
                return  # states of the model before come first
            if self._nodes is None or self._nodes.model_stamp_ns != self.tissue.model_stamp:
                return  # pictures of states are wanted, not of a model at rest
        try:
            if self.tissue.bind(self._nodes, self._config):
                self._failure = ""
                self._change()
        except Exception as error:
            self._failure = sentence("rendering", error)
            self.report_error(self._failure)

    def _render(self, bound: BoundModel, nodes: ControlNodeCloud | None, camera: Camera, instruments: PosedInstruments | None) -> Shown:
        start, camera = time.monotonic(), bound.renderer.camera(camera)
        if max(camera.width, camera.height) > _MAX_SIDE:
            raise MessageError(f"images of {camera.width}×{camera.height} are too large; set image_width")
        state = ()
        if nodes is not None and bound.follows(nodes):
            state = (nodes.positions, nodes.F)
            self.tissue.cut(bound, nodes)
        right = self._right()
        wanted, cameras = self._topics.wanted(right), [camera]
        if wanted.right and right is not None:
            cameras.append(right_camera(camera, right))
        views = bound.renderer.views(cameras, *state, depth=wanted.depth, labels=wanted.labels, instruments=instruments)
        labels = views[0].labels
        shown = Shown(views, cameras, wanted, None if labels is None else self.instruments.labels(instruments, labels))
        self._seconds_per_image += 0.1 * (time.monotonic() - start - self._seconds_per_image)
        self._instruments_shown = 0 if instruments is None else len(instruments.poses)
        self._blind = None if bound.renderer.sees_tissue else camera.position
        return shown

    def _publish(self, shown: Shown, stamp: int) -> None:
        self._topics.publish(shown, stamp, self.options)
        self.images += 1

    # ------------------------------------------------------------ diagnostics

    @property
    def _state(self) -> RenderingState:
        if self.tissue.model is None or self._camera() is None:
            return RenderingState.WAITING
        if self.tissue.bound is not None:
            return RenderingState.RENDERING
        return RenderingState.FAILED if self._failure else RenderingState.BUILDING

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: the mode, and once there is something to show how the rendering goes."""
        state = self._state
        values = {STATE: state, "mode": self.options.mode}
        if self.tissue.model is None:
            return WARN, "waiting for a model on gaussians", values
        if state is RenderingState.WAITING:
            return WARN, "waiting for a camera on ECM/measured_cp and endoscope/left/camera_info", values
        values |= {
            "gaussians": len(self.tissue.model),
            "images": self.images,
            "milliseconds per image": f"{1e3 * self._seconds_per_image:.1f}",
            "instruments": self._instruments_shown,
            "following control nodes": self.tissue.bound is not None and self.tissue.bound.follows(self._nodes),
        }
        if self._failure:
            return ERROR, self._failure, values
        if state is RenderingState.BUILDING:
            return OK, "preparing the model", values
        if self._blind is not None:
            camera, tissue = (np.round(each, 4).tolist() for each in (self._blind, self.tissue.model.means.mean(0).double().numpy()))
            what = f"the camera at {camera} sees next to no tissue, the middle of which is at {tissue}, metres"
            return WARN, f"{what}; check the poses on {messages.CAMERA_POSE.name}, their unit is metres", values
        if self.options.instruments and self.instruments.undrawn:
            return WARN, "; ".join(self.instruments.undrawn.values()), values
        if self._lockstep:
            waiting = f", {len(self._states)} states wait" if self._states else ""
            if self._states and self._awaited:
                waiting += f" for {self._awaited} of {self._states[0][0] * 1e-9:.6f} s"
            return OK, f"in lockstep, {self.images} images rendered{waiting}", values
        return OK, "rendering", values

    def destroy_node(self) -> None:
        """Bind no more models, and destroy the node."""
        self.tissue.stop()
        self.instruments.stop()
        super().destroy_node()


def idle_period(options: RenderingNodeConfig) -> float:
    """Seconds from one image to the next while nothing changes, no shorter than at `rate`; half a poll less, so as not to miss a poll."""
    return 1 / min(options.idle_rate, options.rate) - 0.5 / options.rate / _POLLS


def find_thing(task: str) -> tuple[list[Part], list[Capsule]]:
    """Parts and capsules of the thing of a task.

    Raises:
        ConfigError: If there is no such task, or it has none.
    """
    from endo_sim_ros.learning.tasks import find_task  # which other graphs do without

    try:
        kind = find_task(task)
        thing = kind.thing()
    except ValueError as error:
        raise ConfigError(f"thing: {error}") from error
    if thing is None:
        raise ConfigError(f"thing: {task} has no thing beside the tools; leave it out")
    return thing


def _decode_info(message: Any, topic: str) -> CameraInfo:
    info = messages.decode_camera_info(message, topic)
    if max(info.width, info.height) > _MAX_SIDE:
        raise MessageError(f"{topic}: images of {info.width}×{info.height} are too large to render; the limit is {_MAX_SIDE} a side")
    return info


if __name__ == "__main__":
    raise SystemExit(run(RenderingNode))
