"""From a bag to the files of a Gaussian model, with progress bars: the work of `endo-sim reconstruct`."""

import functools
import logging
import shutil
import tempfile
from pathlib import Path

from rich.progress import Progress as ProgressBar

from endo_sim_ros.core.cameras import Camera, save_cameras
from endo_sim_ros.core.config import unused_options
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.folders import make_writable
from endo_sim_ros.core.gaussians import GaussianModel, save_ply
from endo_sim_ros.core.motion import MOTION_FILE, MOTION_PARAMETERS
from endo_sim_ros.core.progress_bar import stages_in
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.core.words import counted
from endo_sim_ros.reconstruction.checkpoint import read_checkpoint
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.keyframes import choose_views
from endo_sim_ros.reconstruction.motion_watch import MotionWatch
from endo_sim_ros.reconstruction.pipeline import prepare
from endo_sim_ros.reconstruction.priors.network import find_network
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import ScenePoints, shrink
from endo_sim_ros.reconstruction.still_frames import stilled
from endo_sim_ros.reconstruction.trainer import Progress, Trainer
from endo_sim_ros.reconstruction.triangulation import POINT_VIEWS
from endo_sim_ros.sequences.bag import read_bag
from endo_sim_ros.sequences.point_files import read_points
from endo_sim_ros.sequences.recording import Recording, spread, survey

log = logging.getLogger(__name__)

_MEASURED = 300  # views held out, evenly spread: more hardly change a mean, and take minutes
_REPORTS, _CHECKPOINTS = 20, 10  # iterations between looks at the progress; checkpoints of a reconstruction


def reconstruct_bag(bag: Path, out: Path, config: ReconstructionConfig, resume: bool = False) -> tuple[Trainer, Recording]:
    """The trainer at its end, and up to 300 frames with tissue that were held out; writes model.ply, cameras.json and checkpoint.pt.

    Where the tissue moves by itself, it also writes motion.npz and motion.yaml, see `TissueMotion.save`.

    The bag is read for the poses, anew where the tissue moves, and for the keyframes, so that no more than these are held in memory; the
    frames that were held out are read when they are asked for.

    Args:
        bag: Bag with images, camera_info and poses.
        out: Folder for the files; it is made if need be.
        config: Options.
        resume: Go on from the checkpoint in the folder, to the same model; one is written every tenth of the way.

    Raises:
        SequenceError: If the bag or the checkpoint cannot be used, or `prepare` finds nothing to start from.
        ValueError: If there is no such device, or the folder takes no files.
        RuntimeError: If the folder takes no files at the end, as on a full disk; the model is then in another, which is named.
    """
    pick_device(config.device)  # what cannot be used is refused before the long work
    if config.depth_model:
        find_network(config.depth_model)
    for text in unused_options(config):
        log.warning(text)
    # As was decided then, should a trial decide otherwise now.
    without_depth = read_checkpoint(out / "checkpoint.pt", config, "cpu")["without_depth"] if resume else None
    make_writable(out)
    recording = Recording(lambda: (shrink(frame, config.widest) for frame in read_bag(bag)), 0, source=bag)
    with ProgressBar() as bar:
        task = bar.add_task(f"reading {bag.name}", total=None)
        watch, motion = MotionWatch(config.watch, config.poses, config.matching), None
        views, sample = survey(watch.watch(recording) if config.watch_motion else recording, POINT_VIEWS)
        on_stage = stages_in(bar, task)
        known = read_points(bag)
        given = ScenePoints.recorded(*known) if known else None
        if config.watch_motion:
            motion, text = watch.found(StageProgress("breath and heartbeat", on_stage))
            log.info(text)
            if motion is not None:
                watched = sum(motion.watched(view.stamp_ns) for view in views)
                views, sample = survey(recording.take(range(watched), watched), POINT_VIEWS)
                log.info("the model is of tissue in its mean position, from the %d views in which it was watched", len(views))
                sample = [stilled(frame, motion) for frame in sample]
        chosen, points = choose_views(views, sample, config, StageProgress("scene points", on_stage), given)
        del sample
        log.info("%s, training on %d", counted(len(views), "view"), len(chosen))
        prepared = prepare(recording.take(set(chosen), len(chosen)), config, points, on_stage, motion, without_depth)
        trainer = Trainer(prepared, config)
        del prepared
        bar.update(task, description=f"prepared {bag.name}", total=1, completed=1)
    if resume:
        trainer.load_checkpoint(out / "checkpoint.pt")
        log.info("going on after %s", counted(trainer.iteration, "iteration"))
    save_checkpoint = functools.partial(_save_checkpoint, trainer, out, told=set())
    iterations, kept = trainer.iterations, trainer.iteration if resume else 0
    bar = ProgressBar()
    task = bar.add_task("reconstructing", total=iterations)

    def on_progress(progress: Progress) -> None:
        nonlocal kept
        text = f"reconstructing, {progress.gaussians} Gaussians, loss {progress.loss:.4f}"
        bar.update(task, completed=progress.iteration, description=text)
        if progress.iteration % max(iterations // (_CHECKPOINTS * _REPORTS) * _REPORTS, _REPORTS) == 0 and save_checkpoint():
            kept = progress.iteration

    try:
        with bar:
            model = trainer.run(on_progress, _REPORTS)
    except (KeyboardInterrupt, SystemExit):
        if kept:
            log.info(
                "%s: holds what was reached after %d of %d iterations; --resume goes on from there", out / "checkpoint.pt", kept, iterations
            )
        raise
    if trainer.motion is not None:
        log.info("as training corrected it, the tissue moves by %s", trainer.motion.told)
    trained = [views[index] for index in chosen if views[index].stamp_ns in trainer.stamps]
    cameras = [trainer.camera_errors.corrected(view.camera, view.stamp_ns) for view in trained]
    _save(model, cameras, trainer.motion, out)
    log.info("%s: %s", out / "model.ply", counted(len(model), "Gaussian"))
    save_checkpoint()
    held_out = spread(sorted({index for index, view in enumerate(views) if view.tissue} - set(chosen)), _MEASURED)
    return trainer, recording.take(set(held_out), len(held_out))


def _save_checkpoint(trainer: Trainer, out: Path, told: set[str]) -> bool:
    """Write the checkpoint, and return whether it was; without room for it the training, and its model, still count.

    Args:
        trainer: The training.
        out: Folder of the checkpoint.
        told: Why there was none before, to which a new reason is added: each is told once.
    """
    try:
        trainer.save_checkpoint(out / "checkpoint.pt")
    except OSError as error:
        if str(error) not in told:
            log.warning("%s; --resume needs it, the model does not", error)
        told.add(str(error))
        return False
    return True


def _save(model: GaussianModel, cameras: list[Camera], motion: TissueMotion | None, out: Path) -> None:
    """Write model and cameras into a folder or, where that cannot be, into one that can."""
    try:
        _write(model, cameras, motion, out)
        return
    except OSError as error:
        reason = error.strerror or str(error)
    elsewhere = dict.fromkeys(map(Path, (tempfile.gettempdir(), Path.home(), Path.cwd())))
    for parent in elsewhere:
        try:
            folder = Path(tempfile.mkdtemp(prefix="endo_sim_", dir=parent))
        except OSError:
            continue
        try:
            _write(model, cameras, motion, folder)
        except OSError:
            shutil.rmtree(folder, ignore_errors=True)
            continue
        raise RuntimeError(f"{out}: the model cannot be saved there ({reason}); it is in {folder}")
    others = ", ".join(map(str, elsewhere))
    raise RuntimeError(f"{out}: the model cannot be saved there ({reason}), nor in {others}; make room and start again with --resume")


def _write(model: GaussianModel, cameras: list[Camera], motion: TissueMotion | None, folder: Path) -> None:
    save_ply(model, folder / "model.ply")
    save_cameras(cameras, folder / "cameras.json")
    for name in (MOTION_FILE, MOTION_PARAMETERS):  # of a model that was there before
        (folder / name).unlink(missing_ok=True)
    if motion is not None:
        motion.save(folder, model)
