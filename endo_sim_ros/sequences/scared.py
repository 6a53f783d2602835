"""SCARED: stereo keyframes with structured-light depth, and the recordings that start at them.

    dataset_1/keyframe_1/
      Left_Image.png, Right_Image.png
      left_depth_map.tiff           float32 [H, W, 3]: XYZ in the left camera, millimetres; NaN or 0 = none
      endoscope_calibration.yaml    OpenCV FileStorage: M1 D1 M2 D2 R T, millimetres
      data/rgb.mp4                  left eye stacked on top of right
      data/frame_data.tar.gz        frame_data%06d.json: camera-pose 4×4 in millimetres, camera-calibration
      data/scene_points.tar.gz      scene_points%06d.tiff: the keyframe's points moved by the kinematics, both eyes

The world is the keyframe's left camera. The archives are read as streams and never unpacked to disk.
"""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.images import image_size, read_image
from endo_sim_ros.sequences.recording import DEFAULT_FPS, Recording, check_folder, keep_posed, select, stamp_ns
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration
from endo_sim_ros.sequences.scared_archives import ScenePoints, keyframe_points, published_pose, read_frame_data, read_point_map
from endo_sim_ros.sequences.scared_pose_direction import USUAL_DIRECTION, find_pose_direction
from endo_sim_ros.sequences.structure_from_motion import with_estimated_poses
from endo_sim_ros.sequences.video_files import Video, split_stacked

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
        pose_direction: What the published camera-pose does: `world_to_camera`, `camera_to_world`, or `auto` to find
            out which one carries the keyframe onto later frames; the finding is logged.
        fps: Frames per second; None takes the video's.

    Returns:
        Rectified stereo frames; those without a pose are skipped. Without data/rgb.mp4, the keyframe alone;
        without frame_data.tar.gz (test sets), the poses are estimated.

    Raises:
        SequenceError: If a file is missing or wrong.
    """
    root = check_folder(path)
    for name, value, allowed in (("depth", depth, DEPTHS), ("pose_direction", pose_direction, DIRECTIONS)):
        if value not in allowed:
            raise SequenceError(f"{root}: {name} must be one of {', '.join(allowed)}, got {value!r}")
    keyframes = sorted(p.name for p in root.glob("keyframe_*"))
    if keyframes:
        raise SequenceError(f"{root}: is a whole dataset; pass one of its keyframes: {', '.join(keyframes)}")
    if not (root / "data/rgb.mp4").is_file():
        return _read_keyframe(root, start, stop, step, depth, fps)

    video = Video(root / "data/rgb.mp4")
    archive = root / "data/frame_data.tar.gz"
    documents = read_frame_data(archive) if archive.is_file() else {}
    published = {n: published_pose(document, archive, n) for n, document in documents.items()}
    size = video.width, video.height // 2
    calibration = _calibration(root, documents).resized(*size)
    rectification = Rectification.stereo(calibration)

    numbers = select(range(video.frame_count), video.path, start, stop, step)
    poses = dict.fromkeys(numbers, np.eye(4))
    if published:
        numbers = keep_posed(numbers, published, archive)
        if pose_direction == "auto":
            pose_direction = _pose_direction(root, video, published, calibration)
        for n in numbers:
            poses[n] = published[n] if pose_direction == "camera_to_world" else invert_pose(published[n])

    points_archive = root / "data/scene_points.tar.gz"
    if depth == "scene_points" and not points_archive.is_file():
        logger.warning("%s: file is missing; only the keyframe's own depth is used", points_archive)
        depth = "keyframe"

    def frames() -> Iterator[Frame]:
        reading = contextlib.closing(ScenePoints(points_archive)) if depth == "scene_points" else contextlib.nullcontext()
        with reading as scene_points:
            for number, image in video.frames(numbers):
                left, right = split_stacked(image, video.path)
                points = scene_points.of(number, size) if scene_points else None
                if depth == "keyframe" and number == 0:
                    points = keyframe_points(root, size)
                yield _frame(rectification, number, fps or video.fps, left, right, points, poses[number])

    recording = Recording(frames, len(numbers))
    if published:
        return recording
    logger.warning("%s: file is missing, so poses come from structure from motion", archive)
    return with_estimated_poses(recording, root)


def _read_keyframe(root: Path, start: int | None, stop: int | None, step: int, depth: str, fps: float | None) -> Recording:
    left, right = root / "Left_Image.png", root / "Right_Image.png"
    if not left.is_file():
        raise SequenceError(f"{root}: holds neither data/rgb.mp4 nor Left_Image.png; pass a keyframe folder of SCARED")
    size = image_size(read_image(left))
    rectification = Rectification.stereo(_calibration(root, {}).resized(*size))
    select([0], root, start, stop, step)
    if not right.is_file():
        raise SequenceError(f"{right}: file is missing")

    def frames() -> Iterator[Frame]:
        points = None if depth == "none" else keyframe_points(root, size)
        yield _frame(rectification, 0, fps or DEFAULT_FPS, read_image(left), read_image(right), points, np.eye(4))

    return Recording(frames, 1)


def _pose_direction(root: Path, video: Video, published: dict[int, np.ndarray], calibration: StereoCalibration) -> str:
    """The direction of the published poses, from the keyframe where it is there."""
    keyframe, depth_map = root / "Left_Image.png", root / "left_depth_map.tiff"
    if not keyframe.is_file() or not depth_map.is_file():
        logger.warning("%s: no keyframe depth to verify the pose direction with; assuming %s", root, USUAL_DIRECTION)
        return USUAL_DIRECTION
    points = read_point_map(depth_map, str(depth_map), (video.width, video.height // 2))
    return find_pose_direction(points, read_image(keyframe), video, published, calibration, root)


def _frame(
    rectification: Rectification,
    number: int,
    fps: float,
    left: np.ndarray,
    right: np.ndarray,
    points: np.ndarray | None,
    pose: np.ndarray,
) -> Frame:
    return Frame(
        stamp_ns=stamp_ns(number, fps),
        image=rectification.left(left),
        camera=Camera(rectification.K, *rectification.size, rectification.pose(pose)),
        right=rectification.right(right),
        baseline=rectification.baseline,
        depth=None if points is None else rectification.depth(points),
        mask=rectification.mask(None),
    )


# ------------------------------------------------------------------------------------------------------ calibration


def _calibration(root: Path, documents: dict[int, Any]) -> StereoCalibration:
    """From endoscope_calibration.yaml, or from the first frame's JSON where that file is missing."""
    path = root / CALIBRATION_FILE
    if path.is_file():
        return read_stereo_yaml(path, _image_size(root))
    if not documents:
        raise SequenceError(f"{path}: file is missing; it holds the calibration of both cameras")
    number, document = min(documents.items())
    source = f"{root / 'data/frame_data.tar.gz'}: camera-calibration of frame {number}"
    fields = document.get("camera-calibration") if isinstance(document, dict) else None
    fields = fields if isinstance(fields, dict) else {}
    values = [_matrix(fields.get(name), f"{source}: {name}") for name in ("KL", "DL", "KR", "DR", "R", "T")]
    return _stereo_calibration(source, _image_size(root), values)


def read_stereo_yaml(path: Path, size: tuple[int, int]) -> StereoCalibration:
    """The calibration in an OpenCV FileStorage with M1 D1 M2 D2 R T, T in millimetres, of images of a size (width, height).

    Raises:
        SequenceError: If the file cannot be read or lacks a matrix.
    """
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        if not storage.isOpened():
            raise SequenceError(f"{path}: not a readable OpenCV calibration file")
        values = []
        for name in ("M1", "D1", "M2", "D2", "R", "T"):
            node = storage.getNode(name)
            values.append(_matrix(None if node.empty() else node.mat(), f"{path}: {name}"))
        storage.release()
    except (cv2.error, SystemError) as error:
        raise SequenceError(f"{path}: not a readable OpenCV calibration file ({error})") from None
    return _stereo_calibration(str(path), size, values)


def _stereo_calibration(source: str, size: tuple[int, int], values: list[np.ndarray]) -> StereoCalibration:
    K_left, D_left, K_right, D_right, R, T = values
    return StereoCalibration(source, size, K_left, D_left.ravel(), K_right, D_right.ravel(), R, 1e-3 * T.ravel())


def _matrix(value: ArrayLike | None, source: str) -> np.ndarray:
    if value is None:
        raise SequenceError(f"{source} is missing")
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise SequenceError(f"{source} is not a matrix of numbers") from None


def _image_size(root: Path) -> tuple[int, int]:
    """Width and height that the calibration belongs to: those of the keyframe, or of one eye of the video."""
    if (root / "Left_Image.png").is_file():
        return image_size(read_image(root / "Left_Image.png"))
    video = Video(root / "data/rgb.mp4")
    return video.width, video.height // 2
