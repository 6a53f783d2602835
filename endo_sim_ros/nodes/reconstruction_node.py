"""Images and poses in, Gaussian model out."""

import logging
import threading
import time
import weakref
from functools import partial
from pathlib import Path
from typing import Any

import torch
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, load_cameras, save_cameras
from endo_sim_ros.core.errors import MotionError
from endo_sim_ros.core.frames import LEFT_FRAME, Frame, SequenceError
from endo_sim_ros.core.gaussians import GaussianModel, load_ply, save_ply
from endo_sim_ros.core.motion import MOTION_FILE
from endo_sim_ros.core.temporary_folder import temporary_folder
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.core.words import counted
from endo_sim_ros.messages import ERROR, OK, STATE, WARN, ReconstructionState, Topic
from endo_sim_ros.nodes.base import EndoNode, run, sentence
from endo_sim_ros.nodes.configs import ReconstructionNodeConfig
from endo_sim_ros.reconstruction import (
    Cancelled,
    MotionWatch,
    Progress,
    ReconstructionConfig,
    Trainer,
    choose_views,
    prepare,
    shrink,
)
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.still_frames import stilled
from endo_sim_ros.reconstruction.triangulation import POINT_VIEWS
from endo_sim_ros.sequences.bag import feed
from endo_sim_ros.sequences.recording import StoredFrame, spread, store
from endo_sim_ros.sequences.synchronizer import Synchronizer

# Seconds by which stamps must jump to mean that another recording began; after a pause any step back means it.
_JUMP_BACK, _JUMP_AHEAD, _PAUSE = 1.0, 60.0, 1.0
_CAMERAS = "cameras.json"

log = logging.getLogger("reconstruction_node")  # for what is said after ROS shut down, when its own log would complain


class ReconstructionNode(EndoNode):
    """Collects views, trains in a worker thread, publishes the model as it grows and saves it."""

    read_at_start = frozenset({"reliable"})

    def __init__(self) -> None:
        super().__init__("reconstruction_node")
        self._options = self.declare(ReconstructionNodeConfig)
        self.config = self.declare(ReconstructionConfig)
        as_rclpy = f"[%(levelname)s] [%(created).9f] [{self.get_name()}]: %(message)s"
        logging.basicConfig(level=logging.INFO, format=as_rclpy)
        self._folder = temporary_folder()
        self._stored = 0  # frames so far, which number the files
        self.frames: list[StoredFrame] = []
        self._lost, self._why_lost = 0, ""  # views of this recording that could not be kept
        self._doubts: tuple[str, ...] = ()  # what is told of the newest reconstruction: such views, and warnings of its preparation
        self.synchronizer = Synchronizer(self._options.sync_tolerance)
        self.last_image = self.last_view = time.monotonic()  # when they arrived
        self._newest_stamp = 0  # of the images of this recording
        self._longest_gap: float | None = None  # between arriving images of this recording, seconds
        self.trained: tuple[int, int] | None = None  # first and last stamp of the recording reconstructed last
        self._recording_stamp = 0  # last stamp of the recording reconstructed last
        self._thread: threading.Thread | None = None
        self.cancel = threading.Event()
        self._lock = threading.Lock()
        self._stage = ("", 0, 0)  # what the worker does, how much of it is done, and how much there is
        self.progress: Progress | None = None
        # Newest model of the worker, to be published, with its cameras and the file of its motion, if there is one.
        self._outbox: tuple[GaussianModel, list[Camera], Path | None] | None = None
        self._published: GaussianModel | None = None
        self._trained: Trainer | None = None  # of what is published, at its end
        self._file: Path | None = None  # where the newest model that was read from a file lay
        self._model_stamp = 0
        self._unread = ""  # why the model of model_file is not published, until another one is
        self._saved, self._failure, self._finished = "", "", False  # how the last reconstruction ended
        self._motion = ""  # what it found of breath and heart
        self._cameras: list[Camera] = []  # of the newest published model
        self._model_pub, self._cameras_pub, self._info_pub = (self.publisher(topic, alone=True) for topic in messages.MODEL_TOPICS)
        self._found_pub = self.publisher(messages.FOUND_MOTION, alone=True)
        for topic in messages.RECORDING_TOPICS:
            self.subscribe(topic, partial(self._on_recording, topic), 50, self._options.reliable)
        self.service(Trigger, "~/reconstruct", self._on_reconstruct)
        self.service(Trigger, "~/save", self._on_save)
        self.every(0.2, self._on_timer)
        with self.guard("model_file"):
            try:
                self._publish_file(self._options.model_file)
            except Exception as error:
                self._unread = sentence("model_file", error)
                raise

    def config_changed(self, config: ReconstructionConfig | ReconstructionNodeConfig) -> None:
        """New options of the reconstruction count from the next one on; a new model_file is published now."""
        if isinstance(config, ReconstructionNodeConfig):
            if config.model_file != self._options.model_file:
                self._publish_file(config.model_file)
            self.synchronizer.tolerance_ns = int(config.sync_tolerance * 1e9)
            self._options = config
        else:
            self.config = config  # used by the next reconstruction

    # ------------------------------------------------------------------ views

    def _on_recording(self, topic: Topic, message: Any) -> None:
        if topic in (messages.LEFT_IMAGE, messages.LEFT_COMPRESSED):
            self._note_image(messages.stamp_to_ns(message.header.stamp))
        self._add_views(feed(self.synchronizer, topic, message, self._options.frame_poses))

    def _note_image(self, stamp: int) -> None:
        """Keep track of where one recording ends and the next begins."""
        gap = time.monotonic() - self.last_image
        paused = gap > _PAUSE
        self.last_image = time.monotonic()
        if stamp <= 0:
            return  # will be refused
        step = (stamp - self._newest_stamp) * 1e-9
        if self._newest_stamp and (step < -_JUMP_BACK or step > _JUMP_AHEAD or paused and step <= 0):
            self._end_recording()
            if paused:
                self.trained = None  # the same recording replayed on purpose, not looped, is reconstructed again
        elif self._newest_stamp:
            self._longest_gap = max(gap, self._longest_gap or 0.0)
        self._newest_stamp = max(stamp, self._newest_stamp)

    def _silence(self) -> float:
        """Seconds without an image that mean the end of the recording, which may be a slow one."""
        options = self._options
        gap = options.image_timeout if self._longest_gap is None else 3 * self._longest_gap
        return max(options.start_after, min(gap, options.image_timeout))

    def _end_recording(self) -> None:
        """Reconstruct what was collected and begin again with what comes."""
        self.flush()
        self._start_if_new()
        self.synchronizer = Synchronizer(self._options.sync_tolerance)
        self.frames, self._newest_stamp, self._longest_gap, self._lost = [], 0, None, 0

    def flush(self) -> None:
        """Take over all views that still wait for other streams."""
        while self.synchronizer.pending:
            with self.guard("synchroniser"):  # an image that cannot be used raises, and is gone
                self._add_views(self.synchronizer.flush())

    def _add_views(self, frames: list[Frame]) -> None:
        for frame in frames:
            self._stored += 1
            file = Path(self._folder.name) / str(self._stored)
            try:
                stored = store(shrink(frame, self.config.widest), file)
            except OSError as error:
                file.unlink(missing_ok=True)  # half a view
                self._lost, self._why_lost = self._lost + 1, error.strerror or str(error)
                self.report_error(f"{self._folder.name}: a view cannot be kept ({error}); lower max_views or set TMPDIR")
                continue
            # The training may still read what is dropped here.
            weakref.finalize(stored, stored.file.unlink, missing_ok=True)
            self.frames.append(stored)
            self.last_view = time.monotonic()
        if len(self.frames) > self._options.max_views:
            self.frames = self.frames[::2]
        if 0 < self._options.start_views <= len(self.frames):
            if self.trained is None or self.trained[0] != self.frames[0].stamp_ns:  # once in a recording
                self._start_if_new()

    def _on_timer(self) -> None:
        with self.guard("reconstruction"):
            if self._options.start_after > 0 and time.monotonic() - self.last_image > self._silence():
                self.flush()
                self._start_if_new()
            with self._lock:
                outbox, self._outbox = self._outbox, None
            if outbox:
                self._publish(*outbox)

    # --------------------------------------------------------------- training

    def _start_if_new(self) -> None:
        """Start training unless it runs already or these views were reconstructed before."""
        if not self.frames or self.training:
            return
        span = (self.frames[0].stamp_ns, self.frames[-1].stamp_ns)
        if span != self.trained:
            self._start()

    @property
    def training(self) -> bool:
        """Whether the worker runs."""
        return self._thread is not None and self._thread.is_alive()

    def _start(self) -> None:
        self.trained = (self.frames[0].stamp_ns, self.frames[-1].stamp_ns)
        self._recording_stamp = self.trained[1]
        self.progress, self._saved, self._failure, self._finished, self._motion = None, "", "", False, ""
        self._doubts, self._trained = self._loss, None
        self.cancel.clear()
        self._thread = threading.Thread(target=self._train, args=(list(self.frames), self.config))
        self._thread.start()
        self.get_logger().info(f"reconstructing from {len(self.frames)} views")

    def _train(self, frames: list[StoredFrame], config: ReconstructionConfig) -> None:
        try:
            motion = self._motion_in(frames, config)
            if motion is not None:
                frames = [frame for frame in frames if motion.watched(frame.stamp_ns)]
            progress = StageProgress("scene points", self._on_stage)
            still = lambda frame: stilled(frame.load(), motion)
            chosen, points = choose_views(frames, progress.map(still, spread(frames, POINT_VIEWS)), config, progress)
            log.info("training on %d of %d views", len(chosen), len(frames))
            views = (frames[index].load() for index in chosen)
            scene = prepare(views, config, points, self._on_stage, motion)
            self._doubts += scene.warnings
            trainer, lockstep = Trainer(scene, config), self._options.mode == "lockstep"
            del scene
            if not lockstep:
                self._offer(trainer)
            published = time.monotonic()

            def on_progress(progress: Progress) -> bool:
                nonlocal published
                self.progress, self._stage = progress, ("training", progress.iteration, progress.iterations)
                if not lockstep and time.monotonic() - published > self._options.publish_period:
                    published = time.monotonic()
                    self._offer(trainer)
                return not self.cancel.is_set()

            trainer.run(on_progress, every=5)
            self._trained = trainer
            try:
                self._save(trainer.model, trainer.cameras, trainer)  # also what an interrupted training has reached
            finally:
                self._offer(trainer)
            if trainer.motion is not None:
                log.info("as training corrected it, the tissue moves by %s", trainer.motion.told)
            self._finished = trainer.iteration == trainer.iterations
            reached = f"{len(trainer.model)} Gaussians after {trainer.iteration} of {trainer.iterations} iterations, saved in {self._saved}"
            if self._finished:
                self.get_logger().info(f"reconstruction finished: {reached}")
            else:
                log.info("reconstruction stopped before its end: %s", reached)
        except Cancelled:
            log.info("reconstruction stopped during its preparation, nothing saved")
        except Exception as error:
            self._failure = sentence("reconstruction", error)
            if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
                self._failure = f"out of memory: lower max_gaussians, image_width or keyframes ({error})"
            self.report_error(self._failure)

    def _motion_in(self, frames: list[StoredFrame], config: ReconstructionConfig) -> TissueMotion | None:
        """How the tissue moves by itself in these views, if it is to be looked for; says what was found."""
        if not config.watch_motion:
            return None
        watch, progress = MotionWatch(config.watch, config.poses, config.matching), StageProgress("breath and heartbeat", self._on_stage)
        for done, frame in enumerate(frames):
            progress(done, len(frames))
            if watch.complete:
                break
            watch.look(frame.load())
        motion, self._motion = watch.found(progress)
        self.get_logger().info(self._motion)
        return motion

    def _on_stage(self, stage: str, done: int, total: int) -> None:
        """Note how far the preparation is; called from several threads."""
        if self.cancel.is_set():
            raise Cancelled
        self._stage = stage, done, total

    def _offer(self, trainer: Trainer) -> None:
        with self._lock:
            motion = Path(self._saved, MOTION_FILE)
            self._outbox = trainer.model.to("cpu"), trainer.cameras, motion if self._saved and motion.is_file() else None

    def _publish(self, model: GaussianModel, cameras: list[Camera], motion: Path | None) -> None:
        """Publish a model; equal stamps tie it to the cameras it was trained on. First comes the file of its motion, if there is one."""
        self._found_pub.publish(messages.encode_text("" if motion is None else str(motion.resolve())))
        world = self._options.world_frame
        # A stamp identifies one model, also while a simulated clock stands still or jumps back.
        now = self._recording_stamp if self._options.mode == "lockstep" else self.now_ns()
        self._model_stamp = stamp = max(now, self._model_stamp + 1)
        if cameras:
            first = cameras[0]
            self._info_pub.publish(messages.encode_camera_info(first.K, first.width, first.height, stamp, LEFT_FRAME))
        self._cameras_pub.publish(messages.encode_poses([camera.pose for camera in cameras], stamp, world))
        self._model_pub.publish(messages.encode_gaussians(model, stamp, world))
        self._published, self._cameras, self._unread = model, cameras, ""

    def _publish_file(self, name: str) -> None:
        if not name:
            self._unread = ""
            return
        path = Path(name).expanduser()
        if name == "latest":
            folder = Path(self._options.output_dir).expanduser()
            path = max(folder.glob("*/model.ply"), default=None)
            if path is None:
                raise SequenceError(f"{folder}: there is no model saved yet; model_file=latest has nothing to publish")
        cameras = path.with_name(_CAMERAS)
        model, motion = load_ply(path), path.with_name(MOTION_FILE)
        moves = motion.is_file()
        if moves:
            try:
                self.get_logger().info(f"the tissue of {path} moves by itself, by {TissueMotion.load(motion, model).told}")
            except MotionError as error:
                moves = False
                self.report_warning(f"the tissue does not move by itself: {error}")
        self._publish(model, load_cameras(cameras) if cameras.exists() else [], motion if moves else None)
        self._file, self._trained = path, None

    def _save(self, model: GaussianModel, cameras: list[Camera], trainer: Trainer | None = None) -> None:
        parent = Path(self._options.output_dir).expanduser()
        name = time.strftime("%Y%m%d-%H%M%S")
        folder = next(path for n in range(1000) if not (path := parent / (f"{name}-{n}" if n else name)).exists())
        try:
            save_ply(model, folder / "model.ply")
            save_cameras(cameras, folder / _CAMERAS)
            if trainer is not None:
                trainer.save_checkpoint(folder / "checkpoint.pt")
                if trainer.motion is not None:
                    trainer.motion.save(folder, model)
        except OSError as error:
            reason = error.strerror or str(error)
            raise SequenceError(f"{folder}: the model cannot be saved ({reason}); set output_dir and call ~/save") from error
        self._saved = str(folder)

    # --------------------------------------------------------------- services

    def _on_reconstruct(self, _: Trigger.Request) -> tuple[bool, str]:
        if self.training:
            return False, f"a reconstruction is running: {self.status()[1]}"
        self.flush()
        if not self.frames:
            return False, f"no views yet: {self.status()[1]}"
        if not self.training:  # start_views may have started it
            self._start()
        return True, f"reconstructing from {len(self.frames)} views"

    def _on_save(self, _: Trigger.Request) -> tuple[bool, str]:
        if self._published is None:
            return False, "there is no model to save yet"
        trainer = None if self.training else self._trained
        model, cameras = (self._published, self._cameras) if trainer is None else (trainer.model, trainer.cameras)
        self._save(model, cameras, trainer)
        return True, self._saved

    # ------------------------------------------------------------ diagnostics

    @property
    def _loss(self) -> tuple[str, ...]:
        """What to tell of the views of this recording that could not be kept; nothing if there are none."""
        if not self._lost:
            return ()
        lost = f"{counted(self._lost, 'view')} could not be kept in {self._folder.name} ({self._why_lost})"
        return (f"{lost}; lower max_views, or start the node with TMPDIR on a disk with more room",)

    @property
    def _state(self) -> ReconstructionState:
        if self._failure:
            return ReconstructionState.FAILED
        if self._finished:
            return ReconstructionState.DONE
        if self.training:
            return ReconstructionState.PREPARING if self.progress is None else ReconstructionState.TRAINING
        return ReconstructionState.COLLECTING if self.frames else ReconstructionState.WAITING

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: counts of views and of images that were left out, and the progress of the training."""
        level, text, values = self._doing()
        collecting = values[STATE] in (ReconstructionState.WAITING, ReconstructionState.COLLECTING)
        if doubts := self._loss if collecting else self._doubts:
            level, text = max(level, WARN), "; ".join((text, *doubts))
        return level, text, values

    def _doing(self) -> tuple[int, str, dict[str, Any]]:
        dropped, state, progress = self.synchronizer.dropped, self._state, self.progress
        counts = {f"images {reason}": count for reason, count in dropped.items()}
        values = {STATE: state, "views": len(self.frames), **counts, "motion": self._motion, "saved": self._saved}
        if state is ReconstructionState.PREPARING:
            stage, done, total = self._stage
            return OK, f"preparing views: {stage}", values | {"stage": stage, "progress": f"{done / max(total, 1):.2f}"}
        if state is ReconstructionState.TRAINING and progress is not None:
            values |= {"iteration": progress.iteration, "iterations": progress.iterations}
            values |= {"loss": f"{progress.loss:.4f}", "gaussians": progress.gaussians}
            return OK, f"training, iteration {progress.iteration} of {progress.iterations}", values
        if state is ReconstructionState.FAILED:
            return ERROR, self._failure, values
        if state is ReconstructionState.DONE:
            return OK, f"finished, model saved in {self._saved}", values
        if self._file is not None and self._published is not None and not self.frames and not any(dropped.values()):
            values["gaussians"] = len(self._published)
            return OK, f"published the model of {self._file}; a recording that comes is reconstructed", values
        level, text, silent = OK, f"collecting views, {len(self.frames)} so far", time.monotonic() - self.last_view
        if silent > self._options.image_timeout and not self._lost:  # else views came, and why none is there is told
            topic = self.resolve_topic_name(messages.LEFT_IMAGE.name)
            reasons = [f"{count} {reason}" for reason, count in dropped.items() if count]
            unusable = reasons and time.monotonic() - self.last_image < silent
            if unusable or not (self.frames and self._options.start_after):  # else a slow recording may have ended, and training begins
                why = f"images arrive but none is usable ({', '.join(reasons)})" if unusable else f"no image on {topic}"
                level, text = WARN, f"{why} for {silent:.0f} s; play a bag, start the camera or remap the topics"
        if self._unread:  # at the first start nothing has been saved
            level, text = WARN if self._options.model_file == "latest" else ERROR, f"{self._unread}; {text}"
        return level, text, values

    def destroy_node(self) -> None:
        """Cancel the training, which saves what it has, then destroy the node."""
        self.cancel.set()
        if self._thread is not None:  # to the end, however slow: without it the interpreter would end the threads that the training needs
            self._thread.join()
        self._folder.cleanup()
        super().destroy_node()


if __name__ == "__main__":
    raise SystemExit(run(ReconstructionNode))
