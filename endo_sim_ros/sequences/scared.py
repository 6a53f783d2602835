"""SCARED: stereo keyframes with structured-light depth, and the recordings that start at them.

    dataset_1/keyframe_1/
      Left_Image.png, Right_Image.png
      left_depth_map.tiff           float32 [H, W, 3]: XYZ in the left camera, millimetres; NaN or 0 = none
      endoscope_calibration.yaml    OpenCV FileStorage: M1 D1 M2 D2 R T, millimetres
      data/rgb.mp4                  left eye stacked on top of right
      data/frame_data.tar.gz        frame_data%06d.json: camera-pose 4×4 in millimetres, camera-calibration
      data/scene_points.tar.gz      scene_points%06d.tiff: the keyframe's points moved by the kinematics, both eyes

and, as others prepare it:

      data/frame_data/, data/scene_points/          the archives, extracted
      data/left_finalpass/, data/right_finalpass/   frame_data%06d.png: rectified images, read where there is no rgb.mp4
      data/disparity/                               frame_data%06d.tiff: of these, read where there are no points

The world is the keyframe's left camera. The archives are read as streams and never unpacked to disk.
"""

import contextlib
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.estimated_poses import with_estimated_poses
from endo_sim_ros.sequences.eyes import with_raw_eyes_checked
from endo_sim_ros.sequences.images import UNMEASURED, clean_depth, image_size, numbered_files, read_image
from endo_sim_ros.sequences.opencv_calibrations import read_cameras
from endo_sim_ros.sequences.recording import (
    DEFAULT_FPS,
    Recording,
    check_folder,
    keep_posed,
    select,
    stamp_ns,
    tell_lacking,
    tell_other_numbering,
)
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration
from endo_sim_ros.sequences.scared_archives import (
    ScenePoints,
    keyframe_points,
    numbered,
    published_pose,
    read_disparity,
    read_frame_data,
    read_point_map,
)
from endo_sim_ros.sequences.scared_pose_direction import USUAL_DIRECTION, Projection, find_pose_direction
from endo_sim_ros.sequences.stereo_images import StackedVideo, StereoFiles, StereoImages

logger = logging.getLogger(__name__)

CALIBRATION_FILE = "endoscope_calibration.yaml"
DEPTHS = ("scene_points", "keyframe", "none")
DIRECTIONS = ("auto", "world_to_camera", "camera_to_world")


def read_scared(
    path: Path | str,
    *,
    start: int | None = None,
    stop: int | None = None,
    step: int = 1,
    depth: str = "scene_points",
    poses: str | None = None,
    pose_direction: str = "auto",
    fps: float | None = None,
) -> Recording:
    """Read a SCARED keyframe folder, with its recording where there is one.

    Args:
        path: The folder keyframe_j.
        start, stop: First frame number, and the one to stop before.
        step: Take every step-th frame.
        depth: `scene_points` (every frame; follows the kinematics, so it is a few pixels off in places), `keyframe`
            (the first frame only, measured), or `none`.
        poses: `sfm`, `vggt` or `vggt:FOLDER` estimates the poses, see `pose_estimator`; None takes those of the recording if there are any,
            else structure from motion.
        pose_direction: What the published camera-pose does: `world_to_camera`, `camera_to_world`, or `auto` to find
            out which one carries the keyframe onto later frames; the finding is logged.
        fps: Frames per second; None takes the times of the video's frames, or 25 for extracted frames.

    Returns:
        Rectified stereo frames; those without a pose are skipped. Without a video or extracted frames, the keyframe alone;
        without frame data (test sets), the poses are estimated.

    Raises:
        SequenceError: If a file is missing or wrong.
    """
    root = check_folder(path, fps=fps)
    for name, value, allowed in (("depth", depth, DEPTHS), ("pose_direction", pose_direction, DIRECTIONS)):
        if value not in allowed:
            raise SequenceError(f"{root}: {name} must be one of {', '.join(allowed)}, got {value!r}")
    keyframes = sorted(p.name for p in root.glob("keyframe_*"))
    if keyframes:
        raise SequenceError(f"{root}: is a whole dataset; pass one of its keyframes: {', '.join(keyframes)}")
    _tell_defects(root)
    if (root / "data/rgb.mp4").is_file():
        images, is_rectified = StackedVideo(root / "data/rgb.mp4"), False
    elif left := numbered_files(root / "data/left_finalpass"):
        images, is_rectified = StereoFiles(root / "data/left_finalpass", left, numbered_files(root / "data/right_finalpass")), True
    else:
        logger.info("%s: holds no data/rgb.mp4 and no images in data/left_finalpass, so the keyframe alone is read", root)
        return _read_keyframe(root, start, stop, step, depth, fps)

    frame_data = _archive_or_folder(root, "frame_data")
    documents = read_frame_data(frame_data) if frame_data.exists() else {}
    calibration = _calibration(root, documents, images.size).resized(*images.size)
    # Those who prepare left_finalpass leave OpenCV's alpha at its default.
    rectification = Rectification.stereo(calibration, alpha=-1 if is_rectified else 0)

    numbers = select(images.numbers, images.source, start, stop, step)
    pose_of = dict.fromkeys(numbers, np.eye(4))
    posed = bool(documents) and poses is None
    if posed:
        tell_other_numbering(images.numbers, documents, frame_data)
        published = _published_poses(documents, frame_data, set(numbers))
        numbers = keep_posed(numbers, published, frame_data)
        if pose_direction == "auto":
            project = rectification.project_left if is_rectified else calibration.project_left
            pose_direction = _pose_direction(root, images, published, project)
        for n in numbers:
            pose_of[n] = published[n] if pose_direction == "camera_to_world" else invert_pose(published[n])

    points_source = _archive_or_folder(root, "scene_points")
    disparities, point_files = dict[int, Path](), dict[int, Path]()
    if depth == "scene_points" and not points_source.exists():
        disparities = numbered(root / "data/disparity", ".tiff") if is_rectified else {}
        logger.warning(
            "%s: file is missing; %s", points_source,
            "depth comes from data/disparity, which is made without the rotation that rectifies, and so some pixels off" if disparities
            else "only the keyframe's own depth is used",
        )  # fmt: skip
        depth = "disparity" if disparities else "keyframe"
    elif depth == "scene_points" and points_source.is_dir():
        point_files = numbered(points_source, ".tiff")
        tell_lacking(numbers, point_files, points_source, UNMEASURED)

    def depth_of(number: int, archive: ScenePoints | None) -> np.ndarray | None:
        if number in disparities:
            with np.errstate(divide="ignore"):
                return clean_depth(rectification.K[0, 0] * (rectification.baseline or 0) / read_disparity(disparities[number], images.size))
        if depth == "keyframe" and number == 0:
            found = keyframe_points(root, images.size)
        elif number in point_files:
            found = read_point_map(point_files[number], str(point_files[number]), images.size)
        else:
            found = archive.of(number, images.size) if archive else None
        return None if found is None else rectification.depth(found)

    def frames() -> Iterator[Frame]:
        opened = ScenePoints(points_source) if depth == "scene_points" and not points_source.is_dir() else None
        seen = bare = 0
        with contextlib.closing(opened) if opened else contextlib.nullcontext() as archive:
            read = images.read(numbers)
            for number, left, right in read if is_rectified else with_raw_eyes_checked(read, calibration):
                if not is_rectified:
                    left, right = rectification.left(left), rectification.right(right)
                found, stamp = depth_of(number, archive), images.stamp_ns(number, fps)
                seen, bare = seen + 1, bare + (found is None)
                yield rectification.frame(stamp, left, right, pose_of[number], rectification.valid, found)
        if archive and bare:  # of a folder it is told before
            logger.warning("%s: no depth for %d of %s", points_source, bare, counted(seen, "frame"))

    recording = Recording(frames, len(numbers), source=images.source)
    if posed:
        return recording
    return with_estimated_poses(recording, root, poses, str(frame_data.relative_to(root)), [f"frame {n}" for n in numbers])


def _tell_defects(root: Path) -> None:
    """Say what is known to be wrong with the dataset that a keyframe's folder, or the one around it, is named after."""
    dataset = re.search(r"dataset_?([45])(?!\d)", "/".join(root.resolve().parts[-2:]))
    if dataset:
        logger.warning(
            "%s: the published calibration of dataset %s is known to be wrong: rows of the rectified eyes disagree, and depth does not "
            "fit the images; results of this dataset mean little", root, dataset[1],
        )  # fmt: skip


def _archive_or_folder(root: Path, name: str) -> Path:
    """The archive of this name, or the folder that it was extracted to where there is only that."""
    archive, folder = root / f"data/{name}.tar.gz", root / "data" / name
    return folder if folder.is_dir() and not archive.is_file() else archive


def _read_keyframe(root: Path, start: int | None, stop: int | None, step: int, depth: str, fps: float | None) -> Recording:
    left, right = root / "Left_Image.png", root / "Right_Image.png"
    if not left.is_file():
        raise SequenceError(
            f"{root}: holds neither data/rgb.mp4 nor data/left_finalpass nor Left_Image.png; pass a keyframe folder of SCARED"
        )
    size = image_size(read_image(left))
    rectification = Rectification.stereo(_calibration(root, {}, size).resized(*size))
    select([0], root, start, stop, step)
    if not right.is_file():
        raise SequenceError(f"{right}: file is missing")

    def frames() -> Iterator[Frame]:
        points = None if depth == "none" else keyframe_points(root, size)
        eyes = rectification.left(read_image(left)), rectification.right(read_image(right))
        measured = None if points is None else rectification.depth(points)
        yield rectification.frame(stamp_ns(0, fps or DEFAULT_FPS), *eyes, np.eye(4), rectification.valid, measured)

    return Recording(frames, 1, source=f"{left} and {right}")


def _published_poses(documents: dict[int, Any], frame_data: Path, wanted: set[int]) -> dict[int, np.ndarray]:
    """The published poses [4, 4] by frame number; one that cannot be used is an error if its frame is wanted, and else left out."""
    published = {}
    for number, document in documents.items():
        try:
            published[number] = published_pose(document, frame_data, number)
        except SequenceError:
            if number in wanted:
                raise
    return published


def _pose_direction(root: Path, images: StereoImages, published: dict[int, np.ndarray], project: Projection) -> str:
    """The direction of the published poses, from the keyframe where it is there."""
    keyframe, depth_map = root / "Left_Image.png", root / "left_depth_map.tiff"
    if not keyframe.is_file() or not depth_map.is_file():
        logger.warning("%s: no keyframe depth to verify the pose direction with; assuming %s", root, USUAL_DIRECTION)
        return USUAL_DIRECTION
    points = read_point_map(depth_map, str(depth_map), images.size)
    return find_pose_direction(points, read_image(keyframe), images, published, project, root)


# ------------------------------------------------------------------------------------------------------ calibration


def _calibration(root: Path, documents: dict[int, Any], size: tuple[int, int]) -> StereoCalibration:
    """From endoscope_calibration.yaml, or from the first frame's JSON where that file is missing.

    It belongs to images of the keyframe's size, or of that of the recording (width, height) where there is no keyframe.
    """
    path, keyframe = root / CALIBRATION_FILE, root / "Left_Image.png"
    size = image_size(read_image(keyframe)) if keyframe.is_file() else size
    if path.is_file():
        cameras = read_cameras([path])
        if cameras is None:
            raise SequenceError(f"{path}: holds no calibration of OpenCV, with M1, D1, M2, D2, R and T; copy it again")
        return cameras.raw_pair(size)
    if not documents:
        raise SequenceError(f"{path}: file is missing; it holds the calibration of both cameras")
    number, document = min(documents.items())
    source = f"{_archive_or_folder(root, 'frame_data')}: camera-calibration of frame {number}"
    fields = document.get("camera-calibration") if isinstance(document, dict) else None
    fields = fields if isinstance(fields, dict) else {}
    values = [_matrix(fields.get(name), f"{source}: {name}") for name in ("KL", "DL", "KR", "DR", "R", "T")]
    K_left, D_left, K_right, D_right, R, T = values
    return StereoCalibration(source, size, K_left, D_left, K_right, D_right, R, T)


def _matrix(value: ArrayLike | None, source: str) -> np.ndarray:
    if value is None:
        raise SequenceError(f"{source} is missing")
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise SequenceError(f"{source} is not a matrix of numbers") from None
