"""Camera poses from the images alone, by COLMAP's incremental structure from motion."""

import contextlib
import itertools
import logging
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # before pycolmap, whose own image library would otherwise break cv2.imwrite
import numpy as np

from endo_sim_ros.core.cameras import intrinsic_matrix, invert_pose
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.images import image_size

logger = logging.getLogger(__name__)

STRUCTURE_FROM_MOTION = "sfm"  # what the readers' option `poses` says to ask for it

_ALL_PAIRS = 60  # images up to which all pairs are matched, whose number grows with their square; of more, neighbours in time
_LONG_RUN = 300  # images, from which on a run takes tens of minutes and a warning says so
_PEAK_THRESHOLD = 0.002  # contrast of a SIFT feature; tissue has little, and COLMAP's 0.0067 finds a third of the features
_GUESSED_DEPTH = 0.1  # median depth of the points where no scale is known, metres: a usual working distance of a laparoscope
_SEED = 0  # of random sampling


@dataclass(frozen=True)
class StructureFromMotion:
    """What was recovered.

    Args:
        poses: Camera-to-world poses [4, 4] of the left images that could be placed, by position in the input; the world
            is the first one's camera frame.
        K: Intrinsics [3, 3], pixels; as given, or estimated.
        distortion: Coefficients (k1,) in OpenCV's sense, empty when K was given.
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
    images: Iterable[np.ndarray],
    K: np.ndarray | None = None,
    *,
    masks: Iterable[np.ndarray | None] | None = None,
    right_images: Iterable[np.ndarray | None] | None = None,
    baseline: float | None = None,
    scale: float | None = None,
    threads: int = -1,
) -> StructureFromMotion:
    """Estimate where the camera was for every image.

    Args:
        images: RGB images [H, W, 3] of one size, in order of time; read once, so a generator will do.
        K: Intrinsics [3, 3] of undistorted images, held fixed. None estimates one focal length and one radial
            distortion for all images (the camera may then converge to a wrong focal length, which no error reveals:
            pass K wherever it is known).
        masks: For each image [H, W], uint8, 0 = take no features here; or None.
        right_images: Rectified right images with the same K, for a stereo camera; needs baseline.
        baseline: Distance from left to right camera, metres; makes the result metric.
        scale: Metres per unit of the reconstruction, as a last resort where no baseline is known; without either, a guess.
        threads: -1 uses all cores; 1 makes a run repeatable to the last bit.

    Returns:
        The recovered poses; images that could not be placed are missing from them and logged.

    Raises:
        SequenceError: If no reconstruction comes out.
    """
    if (right_images is None) != (baseline is None):
        raise ValueError("estimate_poses: right_images and baseline must be given together")
    if right_images is not None and K is None:
        raise ValueError("estimate_poses: stereo images need K, because they are rectified with it")
    with tempfile.TemporaryDirectory(prefix="endo_sfm_") as folder:
        root = Path(folder)
        count, size = _write_images(root, images, masks, right_images)
        if count < 2:
            raise SequenceError(f"structure from motion needs at least 2 images, got {count}; select more frames")
        if count > _LONG_RUN:
            logger.warning("structure from motion on %d images takes long; a larger step would do as well", count)
        model = _run_colmap(root, K, size, count, baseline, threads)
    return _result(model, count, K, baseline, scale)


def _write_images(
    root: Path,
    images: Iterable[np.ndarray],
    masks: Iterable[np.ndarray | None] | None,
    right_images: Iterable[np.ndarray | None] | None,
) -> tuple[int, tuple[int, int]]:
    """Lay the images out as COLMAP reads them: `left/000000.png`, its mask `masks/left/000000.png.png`."""
    for folder in ("images/left", "images/right", "masks/left", "masks/right"):
        (root / folder).mkdir(parents=True)
    count, size, masked = 0, None, False
    absent = itertools.repeat(None)
    for image, mask, right in zip(images, masks or absent, right_images or absent, strict=False):
        size = size or image_size(image)
        if image_size(image) != size:
            raise SequenceError(f"image {count} is {image.shape[1]}×{image.shape[0]}, but the first one is {size[0]}×{size[1]}")
        name = f"{count:06d}.png"
        cv2.imwrite(str(root / "images/left" / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        if right is not None:
            cv2.imwrite(str(root / "images/right" / name), cv2.cvtColor(right, cv2.COLOR_RGB2BGR))
        if mask is not None:
            # The border of the left mask serves the right eye too; its tools are shifted, which matching survives.
            masked = True
            for eye in ("left", "right") if right is not None else ("left",):
                cv2.imwrite(str(root / f"masks/{eye}" / f"{name}.png"), mask)
        count += 1
    if not masked:
        for eye in ("left", "right"):
            (root / "masks" / eye).rmdir()
        (root / "masks").rmdir()
    return count, size or (0, 0)


def _run_colmap(root: Path, K: np.ndarray | None, size: tuple[int, int], count: int, baseline: float | None, threads: int) -> Any:
    """COLMAP's largest model of the images under root; with a baseline, left and right move as one rig."""
    import pycolmap  # heavy, and needed here only

    with _quiet(pycolmap):
        pycolmap.set_random_seed(_SEED)
        database = root / "database.db"
        reader = pycolmap.ImageReaderOptions()
        if K is not None:
            reader.camera_model = "PINHOLE"
            reader.camera_params = ",".join(repr(float(v)) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        else:
            reader.camera_model = "SIMPLE_RADIAL"
        if (root / "masks").is_dir():
            reader.mask_path = root / "masks"
        extraction = pycolmap.FeatureExtractionOptions(num_threads=threads)
        extraction.sift.peak_threshold = _PEAK_THRESHOLD
        pycolmap.extract_features(
            database, root / "images", camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=reader, extraction_options=extraction, device=pycolmap.Device.cpu,
        )  # fmt: skip
        if baseline is not None:
            _tie_eyes(pycolmap, database, baseline)
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = _SEED
        verification.detect_watermark = False  # a fixed vignette or overlay is masked, and watermarks are not pairs
        match = pycolmap.match_exhaustive if count <= _ALL_PAIRS else pycolmap.match_sequential
        match(
            database, pycolmap.FeatureMatchingOptions(num_threads=threads),
            verification_options=verification, device=pycolmap.Device.cpu,
        )  # fmt: skip
        options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=_SEED, min_model_size=2)
        options.mapper.random_seed = options.triangulation.random_seed = _SEED
        options.mapper.num_threads = threads
        if K is not None:
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
        models = pycolmap.incremental_mapping(database, root / "images", root, options)
    if not models:
        raise SequenceError(
            "structure from motion found no pair of images with enough matches and parallax; "
            f"select frames in which the camera moves and the tissue is in focus ({size[0]}×{size[1]} images)"
        )
    if len(models) > 1:
        logger.warning("structure from motion fell apart into %d pieces; only the largest is used", len(models))
    return max(models.values(), key=lambda model: model.num_reg_images())


def _tie_eyes(pycolmap: Any, database: Path, baseline: float) -> None:
    """Make each stereo pair one rigid body, which starts rectified and is refined as one for all pairs.

    Pairs placed one by one would drift, because the parallax between the eyes is only a degree or two.
    """
    right_from_left = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-baseline, 0.0, 0.0]))
    rig = pycolmap.RigConfig(
        cameras=[
            pycolmap.RigConfigCamera(ref_sensor=True, image_prefix="left/"),
            pycolmap.RigConfigCamera(ref_sensor=False, image_prefix="right/", cam_from_rig=right_from_left),
        ]
    )
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([rig], opened)


@contextlib.contextmanager
def _quiet(pycolmap: Any) -> Iterator[None]:
    """Keep COLMAP's progress off the terminal; its errors still show."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def _result(model: Any, count: int, K: np.ndarray | None, baseline: float | None, scale: float | None) -> StructureFromMotion:
    """Scale a COLMAP model to metres and put the world into its first camera."""
    eyes: dict[str, dict[int, np.ndarray]] = {"left": {}, "right": {}}
    depths = []
    points = {key: point.xyz for key, point in model.points3D.items()}
    for image in model.images.values():
        if not image.has_pose:
            continue
        view = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        eye, number = image.name.split("/")
        eyes[eye][int(number.split(".")[0])] = invert_pose(view)
        seen = [points[p.point3D_id] for p in image.points2D if p.has_point3D()]
        depths.extend((np.reshape(seen, (-1, 3)) @ view[2, :3] + view[2, 3]).tolist())
    left = dict(sorted(eyes["left"].items()))
    if len(left) < 2 or not depths:
        raise SequenceError("structure from motion placed fewer than 2 images; select frames with more overlap")
    if len(left) < count:
        lost = [n for n in range(count) if n not in left]
        shown = ", ".join(map(str, lost[:10])) + (", …" if len(lost) > 10 else "")
        logger.warning("structure from motion could not place %d of %d images: %s", len(lost), count, shown)

    pairs = [float(np.linalg.norm(eyes["right"][n][:3, 3] - left[n][:3, 3])) for n in left if n in eyes["right"]]
    factor, metric = scale_to_metres(pairs, baseline, scale, np.array(depths))

    to_first = invert_pose(next(iter(left.values())))
    poses = {}
    for number, pose in left.items():
        poses[number] = to_first @ pose
        poses[number][:3, 3] *= factor
    colors = np.array([point.color for point in model.points3D.values()]) / 255
    scene_points = factor * (np.array(list(points.values())) @ to_first[:3, :3].T + to_first[:3, 3])

    distortion: tuple[float, ...] = ()
    if K is None:
        f, cx, cy, k1 = next(iter(model.cameras.values())).params
        K, distortion = intrinsic_matrix(f, f, cx, cy), (float(k1),)
        logger.warning("estimated a focal length of %.1f px and k1 %.3f, which may be wrong; pass the calibration if known", f, k1)
    error = float(model.compute_mean_reprojection_error())
    logger.info("structure from motion placed %d of %d images, %d points, %.2f px", len(left), count, len(points), error)
    return StructureFromMotion(poses, np.asarray(K, np.float64), distortion, error, metric, (scene_points, colors))


def scale_to_metres(pairs: list[float], baseline: float | None, scale: float | None, depths: np.ndarray) -> tuple[float, bool]:
    """Metres per unit of a reconstruction, and whether they are more than a guess.

    Args:
        pairs: Distances between the eyes, in those units.
        baseline: The same, metres.
        scale: Metres per unit where there are no pairs.
        depths: Of what is seen, in those units; without any of the above their median is taken for a usual one.
    """
    if baseline is not None and len(pairs):
        logger.info("scale from the baseline of %d stereo pairs", len(pairs))
        return float(baseline / np.median(pairs)), True
    if scale is not None:
        return scale, True
    logger.warning(
        "THE SCALE IS A GUESS: one eye cannot tell size, so the median depth is set to %g m; "
        "pass scale, or a stereo recording, where sizes and forces matter", _GUESSED_DEPTH,
    )  # fmt: skip
    return float(_GUESSED_DEPTH / np.median(depths)), False
