"""StereoMIS: da Vinci recordings with kinematic camera poses.

P1/
  *.mp4                     left eye stacked on top of right
  video_frames/             %06dl.png, %06dr.png: what the authors' preprocessing writes, rectified, at half the size, numbered
                            from 1; read where there is no video
  StereoCalibration.ini     both cameras, OpenCV; T in millimetres
  groundtruth.txt           row tx ty tz qx qy qz qw, camera-to-world, metres; not every row; some frames behind the images
  masks/%06dl.png           instruments, not of every frame; of the preprocessing's images, numbered from 1 or from 0
  train_split.csv, test_split.csv      start,end of the usable ranges; end is the frame to stop before

Copies differ in the polarity and the numbers of the masks, and in whether images and masks are rectified. These and the lag of
the poses are found from the images and logged; an option overrules each.
"""

import bisect
import configparser
import csv
import itertools
import logging
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.estimated_poses import known_estimator, with_estimated_poses
from endo_sim_ros.sequences.eyes import with_raw_eyes_checked
from endo_sim_ros.sequences.images import numbered_files
from endo_sim_ros.sequences.mask_alignment import MaskAlignment, Reading
from endo_sim_ros.sequences.masks import MaskFiles, read_mask
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.pose_lag import LagFinder
from endo_sim_ros.sequences.recording import Recording, check_folder, keep_posed, refuse_unusable, select, spread, tell_beyond
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration
from endo_sim_ros.sequences.stereo_images import StackedVideo, StereoFiles, StereoImages, rectified_already
from endo_sim_ros.sequences.video_files import find_video

logger = logging.getLogger(__name__)

CALIBRATION_FILE = "StereoCalibration.ini"
POSES_FILE = "groundtruth.txt"
USUAL_LAG = 4  # frames: what the authors' own evaluation uses; others found 2 to 6 over seven sequences

_STRAY = 20  # masks, of which one may be of no frame whatever they are numbered from
_SURVEYED = 1500  # frames that are looked at when fewer are chosen: a minute of video, in which the camera moves
_SURVEY_WIDTH = 640  # pixels; larger images make features no better and take memory


def read_stereomis(
    path: Path | str,
    *,
    start: int | None = None,
    stop: int | None = None,
    step: int = 1,
    split: str | None = None,
    poses: str | None = None,
    pose_lag: int | None = None,
    mask_polarity: str = "auto",
    max_mask_gap: int = 1,
    first_mask: int | None = None,
    masks_rectified: bool | None = None,
    frames_rectified: bool | None = None,
    fps: float | None = None,
) -> Recording:
    """Read a StereoMIS sequence.

    Args:
        path: The sequence's folder.
        start, stop: First frame number, and the one to stop before; the video's first frame is 0.
        step: Take every step-th frame.
        split: `train` or `test` keeps the frames of that split file only; None keeps all.
        poses: `sfm`, `vggt` or `vggt:FOLDER` estimates the poses, see `pose_estimator`; None takes those of the recording if there are any,
            else structure from motion.
        pose_lag: Frame n has the pose in row n − pose_lag of groundtruth.txt; None finds it from the images, and takes 4 where they
            do not tell, as of a camera at rest.
        mask_polarity: What white means in the masks: `tool`, `tissue`, or `auto` to find out.
        max_mask_gap: A frame without a mask borrows one from at most this many frames away; further off, tools stay
            visible in it.
        first_mask: The number that frame 0 has among the masks, 0 or 1; None finds out.
        masks_rectified: Whether the masks belong to rectified images; None finds out.
        frames_rectified: Whether the images in video_frames are rectified; None finds out.
        fps: Frames per second; None takes the times of the video's frames, or 25 for extracted frames.

    Returns:
        Rectified stereo frames; those without a pose are skipped.

    Raises:
        SequenceError: If a file is missing or wrong.
    """
    root = check_folder(path, fps=fps)
    if max_mask_gap < 0:
        raise SequenceError(f"{root}: max_mask_gap must be 0 or more, got {max_mask_gap}")
    if first_mask is not None and first_mask < 0:
        raise SequenceError(f"{root}: first_mask must be 0 or more, got {first_mask}")
    known_estimator(poses, root)  # what is wrong is told before the images are looked at
    estimated = poses is not None or not (root / POSES_FILE).is_file()
    if estimated and pose_lag is not None:
        logger.warning("%s: pose_lag has no effect while poses are estimated; it is that of the poses in %s", root, POSES_FILE)
    calibration = read_stereo_ini(root / CALIBRATION_FILE)
    images, calibration, is_rectified = _open_images(root, calibration, frames_rectified)
    rectification = Rectification.stereo(calibration)

    numbers = select(_of_split(root, images.numbers, split) if split else images.numbers, root, start, stop, step)
    images.stamp_ns(numbers[-1], fps)  # which is refused before the images are looked at
    rows, posed = None if estimated else read_poses(root / POSES_FILE), dict[int, np.ndarray]()
    if rows:
        tell_beyond(rows, images.numbers[-1], root / POSES_FILE)

    mask_files = numbered_files(root / "masks", ending="l") or numbered_files(root / "masks")
    readings = _mask_readings(root, mask_files, images, is_rectified, masks_rectified, first_mask)
    masks = MaskFiles(mask_files, root / "masks", mask_polarity)
    for number in spread(sorted(mask_files), 2):
        read_mask(mask_files[number], images.size)  # raises where they are of other images
    surveyed = _surveyed(images.numbers, numbers)
    alignment = MaskAlignment(mask_files, readings, surveyed, images.size)
    scale = min(1.0, _SURVEY_WIDTH / images.size[0])
    small = Camera(rectification.K, *images.size).resized(*(round(scale * side) for side in images.size))
    finder = None
    if rows is not None and pose_lag is None:
        finder = _lag_finder(root, rows, rectification, small, surveyed, numbers)
        if not finder.frames:  # no image tells it
            pose_lag, finder = _told_lag(root, finder, {}, lambda number: None), None
    if rows is not None and pose_lag is not None:  # what is wrong with them is told before the images are looked at
        numbers, posed = _posed(root, numbers, rows, pose_lag)
    views = _look(images, is_rectified, rectification, alignment, finder, (small.width, small.height), numbers[0])

    reading = _chosen_reading(root, alignment, readings, mask_files, images.numbers) if mask_files else readings[0]
    tissue = _Tissue(masks, sorted(mask_files), reading, max_mask_gap, images.size, rectification)

    if rows is not None and finder is not None:
        small_mask = lambda n: cv2.resize(tissue.of(n), (small.width, small.height), interpolation=cv2.INTER_NEAREST)
        pose_lag = _told_lag(root, finder, views, small_mask)
        numbers, posed = _posed(root, numbers, rows, pose_lag)
    del views
    bare = sum(tissue.nearest(n) is None for n in numbers)
    if bare:
        logger.warning("%s: no mask for %d of %s; tools stay visible there", root, bare, counted(len(numbers), "frame"))

    def frames() -> Iterator[Frame]:
        read = images.read(numbers)
        for number, left, right in read if is_rectified else with_raw_eyes_checked(read, calibration):
            if not is_rectified:
                left, right = rectification.left(left), rectification.right(right)
            pose = np.eye(4) if rows is None else posed[number]
            yield rectification.frame(images.stamp_ns(number, fps), left, right, pose, tissue.of(number))

    recording = Recording(frames, len(numbers), source=images.source)
    return recording if rows is not None else with_estimated_poses(recording, root, poses, POSES_FILE, [f"frame {n}" for n in numbers])


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
            value = float(parser[section][name])
            if math.isfinite(value):
                return value
        except KeyError:
            raise SequenceError(f"{path}: [{section}] {name} is missing") from None
        except ValueError:
            pass
        raise SequenceError(f"{path}: [{section}] {name} is not a number: {parser[section][name]!r}")

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
    translation = np.array([number("StereoRight", f"T_{i}") for i in range(3)])
    return StereoCalibration(str(path), size, *left, *right, rotation, translation)


# ---------------------------------------------------------------------------------------------- what copies differ in


def _open_images(root: Path, calibration: StereoCalibration, rectified: bool | None) -> tuple[StereoImages, StereoCalibration, bool]:
    """The video, or the extracted images where there is none; the calibration in their size; and whether they are rectified already."""
    video = find_video(root)
    if video is not None:
        images, (width, height) = StackedVideo(video), calibration.size
        wider = images.size[0] * height / (images.size[1] * width)  # than the eye of the calibration
        found = next((what for times, what in ((2, "one eye"), (4, "the eyes side by side")) if abs(wider / times - 1) < 0.01), None)
        if found:
            raise SequenceError(
                f"{video}: its pictures of {images.size[0]}×{2 * images.size[1]} seem to have {found}, as {CALIBRATION_FILE} is for "
                f"{width}×{height}; StereoMIS has the left eye on top of the right one: stack the eyes so"
            )
        return images, calibration.resized(*images.size), False
    folder = root / "video_frames"
    left = numbered_files(folder, ending="l")
    if not left:
        raise SequenceError(f"{root}: holds neither a video (*.mp4) nor images like video_frames/000001l.png; copy one of them in")
    first = 0 if 0 in left else 1
    images = StereoFiles(folder, left, numbered_files(folder, ending="r"), first)
    calibration = calibration.resized(*images.size)
    if rectified is None:
        # The authors' preprocessing writes rectified ones.
        numbered = f", and the number of the first frame for {first}"
        rectified = rectified_already(images, calibration, True, numbered)
    return images, calibration, rectified


class _Tissue:
    """Where the rectified frames show tissue.

    Args:
        masks: The masks, and their numbers in `files`, increasing.
        reading: Whether they are of rectified images, and the number of the first frame.
        max_gap: How many frames away a mask may be.
        size: Width and height of the images, pixels.
        rectification: That of the images.
    """

    def __init__(
        self, masks: MaskFiles, files: Sequence[int], reading: Reading, max_gap: int, size: tuple[int, int], rectification: Rectification
    ) -> None:
        self._masks, self._max_gap, self._size, self._rectification = masks, max_gap, size, rectification
        self._rectified, self._first = reading
        self.masked = np.array(files, np.int64) - self._first
        """The frames that have a mask, increasing."""

    def nearest(self, number: int) -> int | None:
        """The frame whose mask counts for a frame, if any does."""
        at = np.searchsorted(self.masked, number)
        near = min(self.masked[max(at - 1, 0) : at + 1].tolist(), key=lambda other: abs(other - number), default=None)
        return near if near is not None and abs(near - number) <= self._max_gap else None

    def of(self, number: int) -> np.ndarray:
        """The mask [H, W] of a frame, 255 where there is tissue."""
        nearest = self.nearest(number)
        mask = None if nearest is None else self._masks.of(nearest + self._first, self._size)
        if mask is None or not self._rectified:
            return self._rectification.mask(mask)
        return cv2.bitwise_and(mask, self._rectification.valid)


def _surveyed(numbers: Sequence[int], chosen: Sequence[int]) -> Sequence[int]:
    """The frame numbers from the first to the last chosen one, and some around them where these are few."""
    first, stop = bisect.bisect_left(numbers, chosen[0]), bisect.bisect_right(numbers, chosen[-1])
    first = max(0, min(first, stop - _SURVEYED))  # rather those before, which are decoded anyway
    return numbers[first : max(stop, first + _SURVEYED)]


def _look(
    images: StereoImages,
    is_rectified: bool,
    rectification: Rectification,
    alignment: MaskAlignment,
    finder: LagFinder | None,
    size: tuple[int, int],
    first: int,
) -> dict[int, np.ndarray]:
    """Show the images to who wants to see them, in one pass, with the first chosen one; the finder's are returned, rectified, at a size
    (width, height)."""
    of_lag = set(finder.frames) if finder else set()
    wanted = sorted(of_lag.union(alignment.frames))
    views = {}
    if wanted:
        logger.info("%s: looking at %d frames from %d to %d", images.source, len(wanted), wanted[0], wanted[-1])
        wanted = sorted({first, *wanted})  # of a video that ends before the others this one is read
    for number, left, _ in images.read(wanted):
        straight = left if is_rectified else rectification.left(left)
        alignment.see(number, left, straight)
        if number in of_lag:
            views[number] = cv2.resize(straight, size, interpolation=cv2.INTER_AREA)
    return views


def _mask_readings(
    root: Path, files: Mapping[int, Path], images: StereoImages, is_rectified: bool, rectified: bool | None, first: int | None
) -> list[Reading]:
    """What the masks may belong to: rectified images or raw ones, and with which number of the first frame.

    Raises:
        SequenceError: If there are masks, and none is of a frame.
    """
    kinds = [rectified] if rectified is not None else [True] if is_rectified else [True, False]
    matched = {number: len(files) - _of_no_frame(files, number, images.numbers) for number in ([1, 0] if first is None else [first])}
    most = max(matched.values())
    if files and not most:
        raise SequenceError(
            f"{root / 'masks'}: holds numbers from {min(files)} to {max(files)}, but frames go from {images.numbers[0]} to"
            f" {images.numbers[-1]}: masks of another sequence? Number them as the frames, or take the folder away"
        )
    # A few masks more or fewer than frames would decide by chance: outlines tell better.
    least = min(most, max(most - max(len(files) // _STRAY, 1), 1))
    numbers = [number for number, frames in matched.items() if frames >= least]
    if first is None and files and most < len(files) and min(files) > 1:
        numbers.append(min(files))  # as those that were copied with a part of the recording; outlines alone can tell
    return list(itertools.product(kinds, numbers))


def _of_no_frame(files: Iterable[int], first: int, frames: Sequence[int]) -> int:
    """How many masks have numbers of no frame, given that of the first frame."""
    return int(np.count_nonzero(~np.isin(np.array([*files], np.int64) - first, frames)))


def _chosen_reading(
    root: Path, alignment: MaskAlignment, readings: Sequence[Reading], files: Collection[int], frames: Sequence[int]
) -> Reading:
    """The reading of the masks that fits the images; where they do not tell, as the authors' preprocessing writes them. It is logged."""
    rectified, first = readings[0]
    of_raw, numbers = [r for r in readings if not r[0]], list(dict.fromkeys(number for _, number in readings))
    told, reasons = True, ["nothing else fits the files and options", "no other number fits the files and options"]
    if 0 < len(of_raw) < len(readings):
        found, reasons[0] = alignment.compare([r for r in readings if r[0]], of_raw)
        rectified, told = found is not False, found is not None
    beyond_by = {number: _of_no_frame(files, number, frames) for number in numbers}
    for other in numbers[1:]:
        found, reasons[1] = alignment.compare([(rectified, first)], [(rectified, other)])
        told = told and found is not None
        if found is False or found is None and other <= 1 and beyond_by[other] < beyond_by[first]:
            first = other
    beyond = beyond_by[first]
    logger.log(
        logging.INFO if told or beyond else logging.WARNING,
        "%s: masks are taken for those of %s images (%s), numbered from %d (%s)%s",
        root / "masks", "rectified" if rectified else "raw", reasons[0], first, reasons[1],
        "" if told or beyond else "; state masks_rectified and first_mask if they are not",
    )  # fmt: skip
    if beyond:
        logger.warning(
            "%s: no frame from %d to %d for %d of %s%s: masks of another sequence, or another first_mask?",
            root / "masks", frames[0], frames[-1], beyond, counted(len(files), "mask"),
            "" if told else ", and outlines do not tell what the others belong to",
        )  # fmt: skip
    return rectified, first


def _lag_finder(
    root: Path,
    rows: Mapping[int, np.ndarray],
    rectification: Rectification,
    camera: Camera,
    surveyed: Sequence[int],
    numbers: Sequence[int],
) -> LagFinder:
    """What finds the lag of the poses from images of a camera; it knows those that are finite.

    Raises:
        SequenceError: If one that the chosen frames need is not.
    """
    finite = {row: pose for row, pose in rows.items() if np.isfinite(pose).all()}
    finder, chosen = LagFinder({row: rectification.pose(pose) for row, pose in finite.items()}, camera, surveyed), set(numbers)
    refuse_unusable({row: pose for row, pose in rows.items() if row not in finite and finder.needs(row, chosen)}, root / POSES_FILE)
    return finder


def _told_lag(root: Path, finder: LagFinder, images: Mapping[int, np.ndarray], mask_of: Callable[[int], np.ndarray | None]) -> int:
    """The lag that is found, or the usual one; which of them is logged."""
    try:
        lag, basis = finder.find(images, mask_of)
    except SequenceError as error:
        raise SequenceError(f"{root / POSES_FILE}: {error}") from None
    if lag is None:
        logger.warning(
            "%s: the lag of the poses cannot be told from the images (%s); %d frames are assumed, which its authors found; "
            "pass pose_lag if it is another", root, basis, USUAL_LAG,
        )  # fmt: skip
        return USUAL_LAG
    told = "%s: poses lag the images by %s: %s"
    if finder.fits_badly:
        told += "; that is far: tissue moves, or poses are inexact or of other frames; look at the model, or pass poses=sfm for others"
    logger.log(logging.WARNING if finder.fits_badly else logging.INFO, told, root, counted(lag, "frame"), basis)
    return lag


def _posed(root: Path, numbers: list[int], rows: Mapping[int, np.ndarray], lag: int) -> tuple[list[int], dict[int, np.ndarray]]:
    """Those of the frames that have a pose with a lag, and the poses by frame."""
    posed = {row + lag: pose for row, pose in rows.items()}
    return keep_posed(numbers, posed, root / POSES_FILE, lag), posed


def _of_split(root: Path, numbers: Sequence[int], split: str) -> list[int]:
    """Those of the frames that are in a split."""
    ranges = _read_split(root, split)
    usable = [n for n in numbers if any(first <= n < end for first, end in ranges)]
    if not usable:
        raise SequenceError(f"{root}: the {split} split of {split}_split.csv holds none of the frames {numbers[0]} to {numbers[-1]}")
    return usable


def _read_split(root: Path, split: str) -> list[tuple[int, int]]:
    """Frame ranges, first and the one to stop before, of `train_split.csv` or `test_split.csv`."""
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
            if len(words) < 2 or not (words[0].isdigit() and words[1].isdigit()) or int(words[0]) >= int(words[1]):
                raise SequenceError(f"{path}: line {count} is not a range `start,end` of frames before end: {','.join(row)!r}")
            ranges.append((int(words[0]), int(words[1])))
    if not ranges:
        raise SequenceError(f"{path}: holds no ranges; expected lines `start,end`")
    return ranges
