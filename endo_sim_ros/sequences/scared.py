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
import io
import json
import logging
import re
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import tifffile

from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.recordings import (
    DEFAULT_FPS,
    Recording,
    Video,
    check_folder,
    keep_posed,
    read_image,
    rigid,
    select,
    split_stacked,
    spread,
    stamp_ns,
)
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration
from endo_sim_ros.sequences.structure_from_motion import with_estimated_poses

logger = logging.getLogger(__name__)

CALIBRATION_FILE = "endoscope_calibration.yaml"
DEPTHS = ("scene_points", "keyframe", "none")
DIRECTIONS = ("auto", "world_to_camera", "camera_to_world")
MAX_JSON_BYTES = 1 << 20
MAX_POINTS_BYTES = 1 << 28  # 2048×1280×3 float32 is 31 MB
CHECKED_FRAMES = 400  # how far into the video the pose direction is looked for


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
    documents = _read_frame_data(archive) if archive.is_file() else {}
    published = {n: _pose_of(document, archive, n) for n, document in documents.items()}
    size = video.width, video.height // 2
    calibration = _calibration(root, documents).resized(*size)
    rectification = Rectification.stereo(calibration)

    numbers = select(range(video.frame_count), video.path, start, stop, step)
    poses = dict.fromkeys(numbers, np.eye(4))
    if published:
        numbers = keep_posed(numbers, published, archive)
        if pose_direction == "auto":
            pose_direction = _find_pose_direction(root, video, published, calibration)
        for n in numbers:
            poses[n] = published[n] if pose_direction == "camera_to_world" else invert_pose(published[n])

    points_archive = root / "data/scene_points.tar.gz"
    if depth == "scene_points" and not points_archive.is_file():
        logger.warning("%s: file is missing; only the keyframe's own depth is used", points_archive)
        depth = "keyframe"

    def frames() -> Iterator[Frame]:
        scene_points = _ScenePoints(points_archive) if depth == "scene_points" else None
        try:
            for number, image in video.frames(numbers):
                left, right = split_stacked(image, video.path)
                points = scene_points.of(number, size) if scene_points else None
                if depth == "keyframe" and number == 0:
                    points = _keyframe_points(root, size)
                yield _frame(rectification, number, fps or video.fps, left, right, points, poses[number])
        finally:
            if scene_points:
                scene_points.close()

    recording = Recording(frames, len(numbers))
    if published:
        return recording
    logger.warning("%s: file is missing, so poses come from structure from motion", archive)
    return with_estimated_poses(recording, len(numbers), root)


def _read_keyframe(root: Path, start, stop, step, depth: str, fps) -> Recording:
    left, right = root / "Left_Image.png", root / "Right_Image.png"
    if not left.is_file():
        raise SequenceError(f"{root}: holds neither data/rgb.mp4 nor Left_Image.png; pass a keyframe folder of SCARED")
    size = read_image(left).shape[1::-1]
    rectification = Rectification.stereo(_calibration(root, {}).resized(*size))
    select([0], root, start, stop, step)
    if not right.is_file():
        raise SequenceError(f"{right}: file is missing")

    def frames() -> Iterator[Frame]:
        points = None if depth == "none" else _keyframe_points(root, size)
        yield _frame(rectification, 0, fps or DEFAULT_FPS, read_image(left), read_image(right), points, np.eye(4))

    return Recording(frames, 1)


def _frame(rectification: Rectification, number: int, fps: float, left, right, points, pose) -> Frame:
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


def _calibration(root: Path, documents: dict[int, dict]) -> StereoCalibration:
    """From endoscope_calibration.yaml, or from the first frame's JSON where that file is missing."""
    path = root / CALIBRATION_FILE
    if path.is_file():
        return read_stereo_yaml(path, _image_size(root))
    if not documents:
        raise SequenceError(f"{path}: file is missing; it holds the calibration of both cameras")
    number, document = min(documents.items())
    source = f"{root / 'data/frame_data.tar.gz'}: camera-calibration of frame {number}"
    fields = document.get("camera-calibration")
    fields = fields if isinstance(fields, dict) else {}
    values = [_matrix(fields.get(name), f"{source}: {name}") for name in ("KL", "DL", "KR", "DR", "R", "T")]
    return _stereo_calibration(source, _image_size(root), values)


def read_stereo_yaml(path: Path, size: tuple[int, int]) -> StereoCalibration:
    """An OpenCV FileStorage calibration with M1 D1 M2 D2 R T, T in millimetres."""
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


def _matrix(value, source: str) -> np.ndarray:
    if value is None:
        raise SequenceError(f"{source} is missing")
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise SequenceError(f"{source} is not a matrix of numbers") from None


def _image_size(root: Path) -> tuple[int, int]:
    """Width and height that the calibration belongs to: those of the keyframe, or of one eye of the video."""
    if (root / "Left_Image.png").is_file():
        return read_image(root / "Left_Image.png").shape[1::-1]
    video = Video(root / "data/rgb.mp4")
    return video.width, video.height // 2


# --------------------------------------------------------------------------------------------------------- archives


def _member_number(member: tarfile.TarInfo, suffix: str) -> int | None:
    """The frame number of an archive's regular file, None for folders, links and other files."""
    match = re.fullmatch(r"\D*(\d+)" + re.escape(suffix), Path(member.name).name)
    return int(match[1]) if match and member.isreg() else None


@contextlib.contextmanager
def _readable(archive: Path):
    """Turns what a damaged archive raises into a SequenceError that names it."""
    try:
        yield
    except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
        raise SequenceError(f"{archive}: not a readable .tar.gz archive ({error}); copy it again") from None


def _read_frame_data(archive: Path) -> dict[int, dict]:
    """The JSON documents of frame_data.tar.gz by frame number."""
    documents = {}
    with _readable(archive), tarfile.open(archive, "r|gz") as tar:
        for member in tar:
            number = _member_number(member, ".json")
            if number is None:
                continue
            if member.size > MAX_JSON_BYTES:
                raise SequenceError(f"{archive}: {member.name} has {member.size} bytes, far more than a camera needs")
            try:
                documents[number] = json.load(tar.extractfile(member))
            except ValueError as error:
                raise SequenceError(f"{archive}: {member.name} is not valid JSON ({error})") from None
    if not documents:
        raise SequenceError(f"{archive}: holds no frame_data000000.json")
    return documents


def _pose_of(document: dict, archive: Path, number: int) -> np.ndarray:
    """The published camera-pose [4, 4] of a frame, with its translation in metres."""
    matrix = document.get("camera-pose") if isinstance(document, dict) else None
    source = f"{archive}: camera-pose of frame {number}"
    if matrix is None:
        raise SequenceError(f"{source} is missing")
    pose = rigid(matrix, source)
    pose[:3, 3] *= 1e-3
    return pose


class _ScenePoints:
    """Reads scene_points.tar.gz forwards, in step with the video; tens of gigabytes unpacked, so one map at a time.

    The archive is expected in order of frame numbers. When a frame is not where it should be, the archive is indexed
    once, which decompresses all of it.
    """

    def __init__(self, archive: Path):
        self._archive = archive
        self._index: dict[int, tarfile.TarInfo] | None = None
        with _readable(self._archive):
            self._tar = tarfile.open(archive, "r|gz")  # noqa: SIM115  (closed by close)
        self._next = (-1, None)

    def close(self):
        self._tar.close()

    def of(self, number: int, size: tuple[int, int]) -> np.ndarray | None:
        """Points [H, W, 3] in the left camera of a frame, metres, or None when it has none."""
        with _readable(self._archive):
            member = self._find(number)
            if member is None:
                return None
            if member.size > MAX_POINTS_BYTES:
                raise SequenceError(f"{self._archive}: {member.name} has {member.size} bytes, more than an image can have")
            data = self._tar.extractfile(member).read()
        return _points(io.BytesIO(data), f"{self._archive}: {member.name}", size)

    def _find(self, number: int) -> tarfile.TarInfo | None:
        if self._index is None:
            while self._next[0] < number:
                member = self._tar.next()
                if member is None:
                    break
                found = _member_number(member, ".tiff")
                if found is not None:
                    self._next = (found, member)
            if self._next[0] == number:
                return self._next[1]
            logger.warning("%s: frame %d is not in its place; indexing the archive, which is slow", self._archive, number)
            self._tar.close()
            self._tar = tarfile.open(self._archive, "r:gz")  # noqa: SIM115
            self._index = {_member_number(member, ".tiff"): member for member in self._tar}
        return self._index.get(number)


def _keyframe_points(root: Path, size: tuple[int, int]) -> np.ndarray | None:
    """Points [H, W, 3] in the keyframe's left camera, metres, or None without a depth map."""
    path = root / "left_depth_map.tiff"
    if not path.is_file():
        logger.warning("%s: file is missing; the keyframe has no depth", path)
        return None
    return _points(path, str(path), size)


def _points(file, source: str, size: tuple[int, int]) -> np.ndarray:
    """A map of points of the left eye [H, W, 3], metres, from a TIFF in millimetres with one eye or both stacked."""
    width, height = size
    try:
        with tifffile.TiffFile(file) as tiff:
            page = tiff.pages[0]
            if page.shape not in ((height, width, 3), (2 * height, width, 3)):
                raise SequenceError(f"{source}: expected points of shape [{height} or {2 * height}, {width}, 3], got {list(page.shape)}")
            points = page.asarray()
    except SequenceError:
        raise
    except Exception as error:  # tifffile raises whatever its decoders do
        raise SequenceError(f"{source}: not a readable TIFF of points ({error}); copy it again") from None
    return points[:height].astype(np.float32) * 1e-3


# --------------------------------------------------------------------------------------------------- pose direction


def _find_pose_direction(root: Path, video: Video, published: dict[int, np.ndarray], calibration) -> str:
    """Whether the published poses are world-to-camera or camera-to-world.

    The keyframe's measured points, coloured by its image, are projected into later frames under both readings; the
    right one lands on pixels that look alike (higher correlation of brightness).
    """
    default = "world_to_camera"  # what the published re-implementations found
    keyframe, depth_map = root / "Left_Image.png", root / "left_depth_map.tiff"
    if not keyframe.is_file() or not depth_map.is_file():
        logger.warning("%s: no keyframe depth to verify the pose direction with; assuming %s", root, default)
        return default
    size = video.width, video.height // 2
    points, colours = _sparse_points(_points(depth_map, str(depth_map), size), _brightness(read_image(keyframe)))
    later = [n for n in sorted(published) if 0 < n < min(video.frame_count, CHECKED_FRAMES)]
    moved = []
    for number in spread(later, 24):
        forward, backward = (_project(points, pose, calibration) for pose in _readings(published[number]))
        if np.median(np.linalg.norm(forward - backward, axis=1)) > 2.0:
            moved.append(number)
    scores = []
    for number, image in video.frames(spread(moved, 6)) if moved else ():
        brightness = _brightness(split_stacked(image, video.path)[0])
        pixels = [_project(points, pose, calibration) for pose in _readings(published[number])]
        inside = np.all([((uv >= 0) & (uv <= np.array(size) - 1)).all(1) for uv in pixels], axis=0)
        if inside.sum() < 50:
            continue
        scores.append([_correlation(colours[inside], _sample(brightness, uv[inside])) for uv in pixels])
    if not scores:
        logger.warning("%s: the camera moves too little to verify the pose direction; assuming %s", root, default)
        return default
    world_to_camera, camera_to_world = np.mean(scores, 0)
    if abs(world_to_camera - camera_to_world) < 0.01:
        logger.warning(
            "%s: both pose directions fit alike (correlation %.3f and %.3f); assuming %s, pass pose_direction if wrong",
            root, world_to_camera, camera_to_world, default,
        )  # fmt: skip
        return default
    found = "world_to_camera" if world_to_camera > camera_to_world else "camera_to_world"
    logger.info(
        "%s: camera-pose is %s (the keyframe's points correlate by %.3f as world-to-camera and %.3f as "
        "camera-to-world over %d frames)", root, found, world_to_camera, camera_to_world, len(scores),
    )  # fmt: skip
    return found


def _readings(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera transforms of a published pose, read as world-to-camera and as camera-to-world."""
    return pose, invert_pose(pose)


def _brightness(image: np.ndarray) -> np.ndarray:
    """Blurred grey image [H, W], float32; the blur forgives the kinematics' few pixels of error."""
    sigma = max(0.5, image.shape[1] / 400)
    return cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), sigma)


def _sparse_points(points: np.ndarray, brightness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some 20 000 measured points [N, 3] and their brightness [N]."""
    with np.errstate(invalid="ignore"):
        rows, columns = np.nonzero(np.isfinite(points).all(-1) & (points[..., 2] > 0))
    keep = slice(None, None, max(1, len(rows) // 20_000))
    rows, columns = rows[keep], columns[keep]
    return points[rows, columns].astype(np.float64), brightness[rows, columns]


def _project(points: np.ndarray, view: np.ndarray, calibration: StereoCalibration) -> np.ndarray:
    """Pixels [N, 2] of points [N, 3] in the raw left image of a camera with a world-to-camera transform."""
    local = points @ view[:3, :3].T + view[:3, 3]
    uv, _ = cv2.projectPoints(local, np.zeros(3), np.zeros(3), calibration.K_left, calibration.D_left)
    return np.where(local[:, 2:] > 0, uv[:, 0], -1.0)


def _sample(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear samples [N] of an image [H, W] at pixels [N, 2]."""
    columns = np.ascontiguousarray(uv.astype(np.float32).reshape(-1, 1, 2))
    # remap takes at most 32767 rows
    return np.concatenate([cv2.remap(image, part, None, cv2.INTER_LINEAR)[:, 0] for part in np.array_split(columns, 4)])


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else 0.0
