"""StereoMIS: da Vinci recordings with kinematic camera poses.

P1/
  *.mp4                     left eye stacked on top of right; or video_frames/%06dl.png, %06dr.png
  StereoCalibration.ini     both cameras, OpenCV; T in millimetres
  groundtruth.txt           frame tx ty tz qx qy qz qw, camera-to-world, metres; not every frame
  masks/%06dl.png           instruments; not every frame, sometimes at half resolution
  train_split.csv, test_split.csv      start,end of the usable ranges, both inclusive
"""

import configparser
import csv
import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.images import check_size, image_size, numbered_files, read_image
from endo_sim_ros.sequences.masks import MaskFiles
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.recording import DEFAULT_FPS, Recording, check_folder, keep_posed, select, stamp_ns
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration
from endo_sim_ros.sequences.structure_from_motion import with_estimated_poses
from endo_sim_ros.sequences.video_files import Video, find_video, split_stacked

logger = logging.getLogger(__name__)

CALIBRATION_FILE = "StereoCalibration.ini"


def read_stereomis(
    path: Path | str,
    *,
    start: int | None = None,
    stop: int | None = None,
    step: int = 1,
    split: str | None = None,
    mask_polarity: str = "auto",
    max_mask_gap: int = 1,
    fps: float | None = None,
) -> Recording:
    """Read a StereoMIS sequence.

    Args:
        path: The sequence's folder.
        start, stop: First frame number, and the one to stop before.
        step: Take every step-th frame.
        split: `train` or `test` keeps the frames of that split file only; None keeps all.
        mask_polarity: What white means in the masks: `tool`, `tissue`, or `auto` to find out.
        max_mask_gap: A frame without a mask borrows one from at most this many frames away; further off, tools stay
            visible in it.
        fps: Frames per second; None takes the video's, or 25 for extracted frames.

    Returns:
        Rectified stereo frames; those without a pose are skipped. Without groundtruth.txt the poses are estimated.

    Raises:
        SequenceError: If a file is missing or wrong.
    """
    root = check_folder(path)
    calibration = read_stereo_ini(root / CALIBRATION_FILE)
    images = _StackedVideo(root) if not (root / "video_frames").is_dir() else _ExtractedFrames(root / "video_frames")
    rectification = Rectification.stereo(calibration.resized(*images.size))
    fps = fps or images.fps

    usable = images.numbers
    if split:
        ranges = _read_split(root, split)
        usable = [n for n in usable if any(first <= n <= last for first, last in ranges)]
    numbers = select(usable, root, start, stop, step)
    poses = None
    if (root / "groundtruth.txt").is_file():
        poses = read_poses(root / "groundtruth.txt")
        numbers = keep_posed(numbers, poses, root / "groundtruth.txt")
    else:
        logger.warning("%s: no groundtruth.txt, so poses come from structure from motion", root)

    mask_files = numbered_files(root / "masks", ending="l") or numbered_files(root / "masks")
    masks = MaskFiles(mask_files, root / "masks", mask_polarity)
    mask_of = _nearest_masks(numbers, mask_files, max_mask_gap)
    bare = sum(n not in mask_of for n in numbers)
    if mask_files and bare:
        logger.warning("%s: %d of %d frames have no mask; tools stay visible in them", root, bare, len(numbers))

    def frames() -> Iterator[Frame]:
        for number, left, right in images.read(numbers):
            mask = masks.of(mask_of[number], images.size) if number in mask_of else None
            pose = np.eye(4) if poses is None else rectification.pose(poses[number])
            yield Frame(
                stamp_ns=stamp_ns(number, fps),
                image=rectification.left(left),
                camera=Camera(rectification.K, *images.size, pose),
                right=rectification.right(right),
                baseline=rectification.baseline,
                mask=rectification.mask(mask),
            )

    recording = Recording(frames, len(numbers))
    return recording if poses is not None else with_estimated_poses(recording, root)


def read_stereo_ini(path: Path) -> StereoCalibration:
    """The calibration of a da Vinci endoscope as StereoMIS writes it.

    Raises:
        SequenceError: If the file cannot be read or lacks a number.
    """
    if not path.is_file():
        raise SequenceError(f"{path}: file is missing; it holds the calibration of both cameras")
    parser = configparser.ConfigParser()
    try:
        parser.read(path, encoding="utf-8")
    except (configparser.Error, UnicodeDecodeError) as error:
        raise SequenceError(f"{path}: not a readable ini file ({str(error).splitlines()[0]})") from None

    def number(section: str, name: str) -> float:
        try:
            return float(parser[section][name])
        except KeyError:
            raise SequenceError(f"{path}: [{section}] {name} is missing") from None
        except ValueError:
            raise SequenceError(f"{path}: [{section}] {name} is not a number: {parser[section][name]!r}") from None

    def camera(section: str) -> tuple[np.ndarray, np.ndarray]:
        fx, fy, cx, cy = (number(section, name) for name in ("fc_x", "fc_y", "cc_x", "cc_y"))
        count = 8 if parser.has_option(section, "kc_7") else 5  # the rational model, where it is used
        distortion = np.array([number(section, f"kc_{i}") for i in range(count)])
        return intrinsic_matrix(fx, fy, cx, cy), distortion

    size = int(number("StereoLeft", "res_x")), int(number("StereoLeft", "res_y"))
    if min(size) < 1:
        raise SequenceError(f"{path}: [StereoLeft] res_x and res_y must be positive, got {size[0]}×{size[1]}")
    left, right = camera("StereoLeft"), camera("StereoRight")
    rotation = np.reshape([number("StereoRight", f"R_{i}") for i in range(9)], (3, 3))
    translation = 1e-3 * np.array([number("StereoRight", f"T_{i}") for i in range(3)])  # the file has millimetres
    return StereoCalibration(str(path), size, *left, *right, rotation, translation)


class _StackedVideo:
    """The images as published: one video with the eyes stacked."""

    def __init__(self, root: Path):
        path = find_video(root)
        if path is None:
            raise SequenceError(f"{root}: holds neither a video (*.mp4) nor a folder video_frames; copy one of them in")
        self._video = Video(path)
        self.fps = self._video.fps
        self.numbers = list(range(self._video.frame_count))
        self.size = self._video.width, self._video.height // 2

    def read(self, numbers: Sequence[int]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        for number, image in self._video.frames(numbers):
            yield number, *split_stacked(image, self._video.path)


class _ExtractedFrames:
    """The images as extracted: `%06dl.png` and `%06dr.png`."""

    fps = DEFAULT_FPS

    def __init__(self, folder: Path):
        self._left = numbered_files(folder, ending="l")
        self._right = numbered_files(folder, ending="r")
        self.numbers = sorted(self._left)
        if not self.numbers:
            raise SequenceError(f"{folder}: holds no left images named like 000000l.png")
        missing = sorted(set(self._left) - set(self._right))
        if missing:
            raise SequenceError(f"{folder}: the right image of {self._left[missing[0]].name} is missing")
        self.size = image_size(read_image(self._left[self.numbers[0]]))

    def read(self, numbers: Sequence[int]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        for number in numbers:
            left, right = (check_size(read_image(files[number]), self.size, files[number]) for files in (self._left, self._right))
            yield number, left, right


def _read_split(root: Path, split: str) -> list[tuple[int, int]]:
    """Inclusive frame ranges of `train_split.csv` or `test_split.csv`."""
    if split not in ("train", "test"):
        raise SequenceError(f"{root}: split must be train, test or None, got {split!r}")
    path = root / f"{split}_split.csv"
    if not path.is_file():
        raise SequenceError(f"{path}: file is missing; use split=None to take all frames")
    ranges = []
    with path.open(newline="", encoding="utf-8") as file:
        for count, row in enumerate(csv.reader(file), 1):
            words = [word.strip() for word in row if word.strip()]
            if not words or (count == 1 and not words[0].lstrip("-").isdigit()):
                continue  # an empty line or the heading
            if len(words) < 2 or not (words[0].isdigit() and words[1].isdigit()) or int(words[0]) > int(words[1]):
                raise SequenceError(f"{path}: line {count} is not a range `start,end`: {','.join(row)!r}")
            ranges.append((int(words[0]), int(words[1])))
    if not ranges:
        raise SequenceError(f"{path}: holds no ranges; expected lines `start,end`")
    return ranges


def _nearest_masks(numbers: list[int], masks: Iterable[int], max_gap: int) -> dict[int, int]:
    """Number of the mask of each frame: its own, or the nearest within max_gap frames."""
    available = np.array(sorted(masks), np.int64)
    nearest = {}
    for number in numbers if len(available) else ():
        closest = int(available[np.argmin(np.abs(available - number))])
        if abs(closest - number) <= max_gap:
            nearest[number] = closest
    return nearest
