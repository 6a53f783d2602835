"""Camera poses from the images alone: OpenCV's features, COLMAP's matching and mapping."""

import dataclasses
import itertools
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from endo_sim_ros.core.cameras import intrinsic_matrix, invert_pose
from endo_sim_ros.core.device import cpu_threads
from endo_sim_ros.core.features import detect  # imports cv2, before pycolmap, whose own image library would otherwise break cv2.imwrite
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.temporary_folder import temporary_folder
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences import colmap_process
from endo_sim_ros.sequences.colmap_process import ColmapJob
from endo_sim_ros.sequences.images import image_size
from endo_sim_ros.sequences.recording import OnProgress

logger = logging.getLogger(__name__)

STRUCTURE_FROM_MOTION = "sfm"  # what the readers' option `poses` says to ask for it

_LONG_RUN = 300  # images, from which on a run takes tens of minutes and a warning says so
_MAX_FEATURES = 8192  # of an image, as COLMAP takes; matching takes time with their square
_FEWEST_POINTS = 10  # of a model; pictures that stand still have one or none
_GUESSED_FOCAL = 1.2  # focal length to start from where none is known, larger sides of the image: COLMAP's
_GUESSED_DEPTH = 0.1  # median depth of the points where no scale is known, metres: a usual working distance of a laparoscope


class View(NamedTuple):
    """What poses are estimated from: of each moment a view. All are of one size."""

    image: np.ndarray  # RGB [H, W, 3], uint8
    mask: np.ndarray | None = None  # [H, W], uint8, 0 = take no features here
    right: np.ndarray | None = None  # rectified right image with the same K, of a stereo camera
    depth: np.ndarray | None = None  # recorded [H, W], metres, 0 = unknown


@dataclass(frozen=True)
class StructureFromMotion:
    """What was recovered.

    Args:
        poses: Camera-to-world poses [4, 4] of the left images that could be placed, by position in the input; the world
            is the first one's camera frame.
        K: Intrinsics [3, 3], pixels; as given, estimated, or guessed.
        distortion: Coefficients (k1,) in OpenCV's sense, empty unless estimated.
        reprojection_error: Mean over all observations, pixels.
        metric: False when the scale is a guess.
        points: Scene points [N, 3] (m, world) and their RGB [N, 3] in [0, 1]; None where only poses were estimated.
    """

    poses: dict[int, np.ndarray]
    K: np.ndarray
    distortion: tuple[float, ...]
    reprojection_error: float
    metric: bool
    points: tuple[np.ndarray, np.ndarray] | None = None


def estimate_poses(
    views: Iterable[View],
    K: np.ndarray | None = None,
    *,
    baseline: float | None = None,
    scale: float | None = None,
    threads: int = -1,
    count: int = 0,
    names: Sequence[str] = (),
    on_progress: OnProgress | None = None,
) -> StructureFromMotion:
    """Estimate where the camera was for every image.

    Args:
        views: In order of time; read once, so a generator will do.
        K: Intrinsics [3, 3] of undistorted images, held fixed. None estimates one focal length and one radial
            distortion for all images (the camera may then converge to a wrong focal length, which no error reveals:
            pass K wherever it is known). Where that fails, a focal length is guessed, and a warning says so.
        baseline: Distance from left to right camera, metres; makes the result metric. Without it right images are not used.
        scale: Median depth of the scene points over all images, metres, where no baseline is known; None takes it from recorded depth, and
            is a guess without any.
        threads: -1 uses all cores; 1 makes a run repeatable to the last bit.
        count: How many images are expected, for the progress; 0 where unknown.
        names: What messages call the images; empty: by their position.
        on_progress: Called in this thread with features, matching and mapping; what it raises ends the work at once.

    Returns:
        The recovered poses; images that could not be placed are missing from them and logged.

    Raises:
        SequenceError: If no reconstruction comes out, or, where K is not known, one of fewer than half of the images or of no lens, and a
            guessed focal length does no better.
    """
    if baseline is not None and K is None:
        raise ValueError("estimate_poses: stereo images need K, because they are rectified with it")
    on_progress = on_progress or (lambda stage, done, total: None)
    with temporary_folder() as folder:
        root = Path(folder)
        database = root / colmap_process.DATABASE
        count, size, features = _write_features(database, views, K, baseline, threads, on_progress, count)
        if count < 2:
            alone = "; of one stereo pair, give its pose: its number and 0 0 0 0 0 0 1 in poses_left.txt" if baseline is not None else ""
            raise SequenceError(f"structure from motion needs at least 2 images, got {count}; select more frames{alone}")
        if count > _LONG_RUN:
            logger.warning("structure from motion on %d images takes long; a larger step would do as well", count)
        model = _run_colmap(root, K is not None, baseline is not None, size, count, threads, on_progress)
    named = names[:count] if names else [str(n) for n in range(count)]  # a video may end before its names do
    return _result(model, named, features, K, baseline, scale)


class _Seen(NamedTuple):
    """What an image shows at its features."""

    color: np.ndarray  # RGB [N, 3], uint8
    depth: np.ndarray | None  # recorded [N], metres


def _write_features(
    database: Path,
    views: Iterable[View],
    K: np.ndarray | None,
    baseline: float | None,
    threads: int,
    on_progress: OnProgress,
    expected: int,
) -> tuple[int, tuple[int, int], dict[str, _Seen]]:
    """Write cameras, images (`left/000000`, `right/000000`) and features into a new database.

    Returns:
        Count and size of the images, and by their names what they show at the features: COLMAP sees no image.
    """
    import pycolmap  # heavy, and needed here only

    if threading.current_thread() is threading.main_thread():  # its logging hears SIGTERM in Python's stead
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)

    def find(task: tuple[str, View]) -> tuple[str, np.ndarray, np.ndarray, _Seen]:
        eye, view = task
        uv, descriptors = detect(view.image, view.mask, _MAX_FEATURES)
        column, row = uv.astype(int).T
        at = row.clip(0, view.image.shape[0] - 1), column.clip(0, view.image.shape[1] - 1)
        seen = _Seen(view.image[at], None if view.depth is None else view.depth[at])
        return eye, uv, np.zeros((0, 128), np.float32) if descriptors is None else descriptors, seen

    workers = min(threads, cpu_threads()) if threads > 0 else cpu_threads()
    count, size, cameras, features, views = 0, None, {}, {}, iter(views)
    with pycolmap.Database.open(database) as opened, ThreadPoolExecutor(workers) as pool:
        on_progress("features", 0, expected)
        while batch := list(itertools.islice(views, workers)):  # a few at a time: there may be more images than memory
            tasks = []
            for offset, view in enumerate(batch):
                size = size or image_size(view.image)
                if image_size(view.image) != size:
                    shape = f"{view.image.shape[1]}×{view.image.shape[0]}"
                    raise SequenceError(f"image {count + offset} is {shape}, but the first one is {size[0]}×{size[1]}")
                tasks.append(("left", view))
                if baseline is not None and view.right is not None:
                    # The left mask's border serves both eyes; its tools are shifted, which matching survives.
                    tasks.append(("right", View(view.right, view.mask)))
            number = count - 1
            for eye, uv, descriptors, seen in pool.map(find, tasks):
                number += eye == "left"
                if eye not in cameras:
                    cameras[eye] = _write_camera(pycolmap, opened, K, size or (0, 0))
                name = f"{eye}/{number:06d}"
                features[name] = seen
                _write_image(pycolmap, opened, cameras[eye], name, uv, descriptors)
            count += len(batch)
            on_progress("features", count, expected)
        if baseline is not None and count:
            if "right" not in cameras:
                raise ValueError("estimate_poses: no view has a right image, which baseline is for; give some, or leave baseline out")
            level = pycolmap.logging.minloglevel
            pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value  # it prints a line for each pair
            _tie_eyes(pycolmap, opened, baseline)
            pycolmap.logging.minloglevel = level
    return count, size or (0, 0), features


def _write_camera(pycolmap: Any, database: Any, K: np.ndarray | None, size: tuple[int, int]) -> tuple[Any, int]:
    """A new camera of the database, and the number of its rig."""
    width, height = size
    camera = pycolmap.Camera(model="PINHOLE" if K is not None else "SIMPLE_RADIAL", width=width, height=height)
    if K is not None:
        camera.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        camera.has_prior_focal_length = True
    else:
        camera.params = [_GUESSED_FOCAL * max(size), width / 2, height / 2, 0.0]
    camera.camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    return camera, database.write_rig(rig)


def _write_image(pycolmap: Any, database: Any, sensor: tuple[Any, int], name: str, uv: np.ndarray, descriptors: np.ndarray) -> None:
    camera, rig = sensor
    number = database.write_image(pycolmap.Image(name=name, camera_id=camera.camera_id))
    frame = pycolmap.Frame()
    frame.rig_id = rig
    frame.add_data_id(pycolmap.data_t(camera.sensor_id, number))
    database.write_frame(frame)
    database.write_keypoints(number, uv.astype(np.float32))
    # As COLMAP keeps them: the roots of the shares (RootSIFT, Arandjelovic and Zisserman 2012) in 8 bits.
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    values = np.minimum(np.round(512 * roots), 255).astype(np.uint8)
    database.write_descriptors(number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, values))


def _tie_eyes(pycolmap: Any, database: Any, baseline: float) -> None:
    """Make each stereo pair one rigid body, which is rectified; where rows do not match, it is refined as one for all pairs.

    Pairs placed one by one would drift, because the parallax between the eyes is only a degree or two.
    """
    right_from_left = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-baseline, 0.0, 0.0]))
    rig = pycolmap.RigConfig(
        cameras=[
            pycolmap.RigConfigCamera(ref_sensor=True, image_prefix="left/"),
            pycolmap.RigConfigCamera(ref_sensor=False, image_prefix="right/", cam_from_rig=right_from_left),
        ]
    )
    pycolmap.apply_rig_config([rig], database)


def _run_colmap(root: Path, fixed: bool, stereo: bool, size: tuple[int, int], count: int, threads: int, on_progress: OnProgress) -> Any:
    """COLMAP's largest model of the features under root, made by `colmap_process` in a process of its own.

    COLMAP's calls take from seconds to minutes and hear no Ctrl-C; a process can be ended at any time.
    """
    import pycolmap

    job = ColmapJob(str(root), count, fixed, stereo, threads)
    # The package is found where this process has found it.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    process = subprocess.Popen(
        [sys.executable, "-m", colmap_process.__name__, json.dumps(dataclasses.asdict(job))],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, start_new_session=True,
    )  # fmt: skip
    models = 0
    with process:  # waits for its end and closes the pipes
        try:
            for line in process.stdout or ():
                stage, done, total = line.rsplit(" ", 2)
                if stage == "models":
                    models = int(done)
                else:
                    on_progress(stage, int(done), int(total))
            status = process.wait()
        finally:
            process.kill()
    if status:
        cause = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        raise SequenceError(f"structure from motion failed: its process {cause}; what it printed above tells more")
    if not models:
        raise SequenceError(
            "structure from motion found no pair of images with enough matches and parallax; "
            f"select frames in which the camera moves and the tissue is in focus ({size[0]}×{size[1]} images)"
        )
    model = pycolmap.Reconstruction(root / colmap_process.MODEL)
    if models > 1:
        largest = counted(sum(image.has_pose and image.name.startswith("left/") for image in model.images.values()), "image")
        logger.warning("structure from motion fell apart into %d pieces; the largest, of %s, is used", models, largest)
    return model


def _result(
    model: Any,
    names: Sequence[str],
    features: dict[str, _Seen],
    K: np.ndarray | None,
    baseline: float | None,
    scale: float | None,
) -> StructureFromMotion:
    """Scale a COLMAP model to metres, put the world into its first camera, and colour its points by the features of each."""
    eyes: dict[str, dict[int, np.ndarray]] = {"left": {}, "right": {}}
    count = len(names)
    depths, units = [], list[float]()
    points = {key: point.xyz for key, point in model.points3D.items()}
    for image in model.images.values():
        if not image.has_pose:
            continue
        view = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        eye, number = image.name.split("/")
        position = int(number.split(".")[0])
        eyes[eye][position] = invert_pose(view)
        triangulated = np.array([p.has_point3D() for p in image.points2D], bool)
        z = np.reshape([points[p.point3D_id] for p in image.points2D if p.has_point3D()], (-1, 3)) @ view[2, :3] + view[2, 3]
        depths.extend(z.tolist())
        if (recorded := features[image.name].depth) is not None:
            units += recorded_units(recorded[triangulated], z)
    left = dict(sorted(eyes["left"].items()))
    if len(left) < 2 or not depths:
        raise SequenceError("structure from motion placed fewer than 2 images; select frames with more overlap")
    if len(points) < _FEWEST_POINTS:
        raise SequenceError(
            f"structure from motion found {counted(len(points), 'point')} in {counted(len(left), 'image')}, which tell no poses: the "
            "picture stands still, or shows too little; choose frames between which the camera moves, or give poses"
        )
    camera = next(iter(model.cameras.values()))
    if K is None and camera.model_name == "PINHOLE":
        K = camera.calibration_matrix()
        logger.warning(
            "THE FOCAL LENGTH IS A GUESS, %.0f px, as it could not be estimated: tissue is too deep or too flat along the line of sight by "
            "the factor by which it is wrong, and distortion is left in; pass calibration.yaml, or fx", camera.params[0],
        )  # fmt: skip
    elif K is None:
        _refuse_poor_camera(model, len(left), count)
    if len(left) < count:
        lost = [name for n, name in enumerate(names) if n not in left]
        shown = ", ".join(lost[:10]) + (", …" if len(lost) > 10 else "")
        logger.warning("structure from motion could not place %d of %d images: %s", len(lost), count, shown)

    for rig in model.rigs.values():
        for right_from_left in rig.non_ref_sensors.values():
            if turned := np.degrees(right_from_left.rotation.angle()):
                logger.warning("rows of the eyes do not match: features placed the right eye, turned by %.2f° from its calibration", turned)
    pairs = [float(np.linalg.norm(eyes["right"][n][:3, 3] - left[n][:3, 3])) for n in left if n in eyes["right"]]
    factor, metric = scale_to_metres(pairs, baseline, scale, np.array(depths), units)

    to_first = invert_pose(next(iter(left.values())))
    poses = {}
    for number, pose in left.items():
        poses[number] = to_first @ pose
        poses[number][:3, 3] *= factor
    keys = {number: image.name for number, image in model.images.items()}
    tracks = ([(keys[e.image_id], e.point2D_idx) for e in point.track.elements] for point in model.points3D.values())
    point_colors = np.array([np.mean([features[name].color[feature] for name, feature in track], 0) for track in tracks]) / 255
    scene_points = factor * (np.array(list(points.values())) @ to_first[:3, :3].T + to_first[:3, 3])

    distortion: tuple[float, ...] = ()
    if K is None:
        f, cx, cy, k1 = camera.params
        K, distortion = intrinsic_matrix(f, f, cx, cy), (float(k1),)
        logger.warning(
            "estimated a focal length of %.1f px and k1 %.3f, which may be wrong, by half with a wide or fisheye lens, though all else "
            "looks right; pass the calibration if known", f, k1,
        )  # fmt: skip
    error = float(model.compute_mean_reprojection_error())
    logger.info("structure from motion placed %d of %d images, %d points, %.2f px", len(left), count, len(points), error)
    return StructureFromMotion(poses, np.asarray(K, np.float64), distortion, error, metric, (scene_points, point_colors))


def _refuse_poor_camera(model: Any, placed: int, count: int) -> None:
    """Raise SequenceError if few images could be placed with a camera that was estimated, or if no lens is like it."""
    f, _, _, k1 = next(iter(model.cameras.values())).params
    folds = colmap_process.folds(model)
    if folds or 2 * placed < count:
        found = f"a focal length of {f:.0f} px and k1 {k1:.3f}" + (", which no lens has" if folds else "")
        raise SequenceError(
            f"structure from motion without a calibration placed {placed} of {count} images and estimated {found}; give calibration.yaml, "
            "or fx, cx, cy and distortion, or select frames with more overlap"
        )


def recorded_units(recorded: np.ndarray, depths: np.ndarray) -> list[float]:
    """Metres per unit of the depths of an image as recorded ones tell it, which are 0 where unknown; nothing where all are."""
    known = recorded > 0
    return [float(np.median(recorded[known] / depths[known]))] if known.any() else []


def scale_to_metres(
    pairs: list[float], baseline: float | None, scale: float | None, depths: np.ndarray, units: Sequence[float] = ()
) -> tuple[float, bool]:
    """Metres per unit of a reconstruction, and whether they are more than a guess.

    Args:
        pairs: Distances between the eyes, in those units.
        baseline: The same, metres.
        scale: The median of the depths, metres, where there are no pairs; None takes what recorded depth tells, or a usual one.
        depths: Of what is seen, in those units.
        units: Metres per unit by the recorded depth of each image that has it.
    """
    if baseline is not None and len(pairs):
        logger.info("scale from the baseline of %s", counted(len(pairs), "stereo pair"))
        return float(baseline / np.median(pairs)), True
    if scale is None and units:
        logger.info("scale from the recorded depth of %s", counted(len(units), "image"))
        return float(np.median(units)), True
    if scale is None:
        logger.warning(
            "THE SCALE IS A GUESS: one eye cannot tell size, so the median depth is set to %g m; where sizes and forces matter, pass "
            "scale, the median depth in metres, or record depth or stereo images", _GUESSED_DEPTH,
        )  # fmt: skip
    return float((scale or _GUESSED_DEPTH) / np.median(depths)), scale is not None
