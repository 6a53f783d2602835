"""A plain video of one eye, or of both in each picture, with or without a calibration and poses.

endo.mp4, or a folder with
  endo.mp4
  calibration.yaml    optional: fx fy cx cy [pixels], distortion, or baseline_m [of both eyes]; or any files that ROS or OpenCV wrote
  poses.txt           optional: frame tx ty tz qx qy qz qw, camera-to-world
  mask.png            optional, one for all frames; or masks/%06d.png; 255 = tissue
"""

import functools
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.estimated_poses import pose_estimator, with_estimated_poses
from endo_sim_ros.sequences.eyes import Halves, find_halves, with_raw_eyes_checked
from endo_sim_ros.sequences.images import numbered_files
from endo_sim_ros.sequences.lenses import calibrated_size, read_lenses
from endo_sim_ros.sequences.masks import (
    UNMASKED,
    Borders,
    MaskFiles,
    find_borders,
    read_mask,
    tissue_mask,
    tool_is_white,
    white_of,
)
from endo_sim_ros.sequences.opencv_calibrations import find_calibration
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.recording import Recording, check_positive, keep_posed, select, spread, tell_beyond, tell_lacking
from endo_sim_ros.sequences.stereo_images import StackedVideo
from endo_sim_ros.sequences.structure_from_motion import STRUCTURE_FROM_MOTION
from endo_sim_ros.sequences.video_files import Video, find_video

logger = logging.getLogger(__name__)

_FEWEST_SFM = 12  # frames of which structure from motion takes all: with fewer it finds too few pairs that overlap
_SQUARE = 0.01  # by which sides of a square pixel may differ: sizes that are rounded to macroblocks make as much


def read_video(
    path: Path | str,
    *,
    start: int | None = None,
    stop: int | None = None,
    step: int | None = None,
    poses: Path | str | None = None,
    calibration: Path | str | None = None,
    fx: float | None = None,
    fy: float | None = None,
    cx: float | None = None,
    cy: float | None = None,
    distortion: Sequence[float] = (),
    baseline_m: float | None = None,
    scale: float | None = None,
    sfm_step: int | None = None,
    mask: Path | str | None = None,
    mask_polarity: str = "tissue",
    mask_border: bool = True,
    fps: float | None = None,
    threads: int = -1,
    frames_rectified: bool | None = None,
    eyes: str = "auto",
) -> Recording:
    """Read a video.

    Args:
        path: The video, or a folder with one video.
        start, stop: First frame number, and the one to stop before.
        step: Take every step-th frame; None: all that sfm_step takes.
        poses: File of lines `frame tx ty tz qx qy qz qw` (camera-to-world, metres unless scale is given); frames that
            it leaves out are skipped. None takes `poses.txt` beside the video if there is one, and structure from
            motion otherwise; `sfm` insists on the latter, `vggt` or `vggt:FOLDER` takes a network, see `pose_estimator`.
        calibration: YAML file with fx, fy, cx, cy, optional distortion, or a calibration of ROS or OpenCV; None takes
            `calibration.yaml` beside the video, or what ROS or OpenCV wrote there.
        fx, fy, cx, cy: Intrinsics instead of a file, pixels, pixel (0, 0) centred at (0.5, 0.5) as in COLMAP.
            fy = fx and the image centre where left out.
        distortion: With fx, coefficients k1 [k2 [p1 p2 [k3]]]; the frames are undistorted.
        baseline_m: With fx, metres between the eyes of rectified pairs, where pictures hold both.
        scale: Metres per unit of the poses: of a file (default 1), or of estimated ones, whose unit is the median depth of the tissue
            over all frames, so that 0.06 says that it is 6 cm away (default: a guess).
        sfm_step: Structure from motion uses and returns every sfm_step-th of the frames only; None: all where step is
            given, else every sixth, of a short video more.
        mask: One mask image for all frames, or a folder of numbered ones; None takes `mask.png` or `masks` beside
            the video.
        mask_polarity: What white means in the masks: `tool`, `tissue`, or `auto` to find out.
        mask_border: Ignore the black border and round vignette around the image, and writing or a logo that is burnt in.
        fps: Frames per second; None takes the times of the video's frames.
        threads: For structure from motion: -1 = all cores, 1 = repeatable to the last bit.
        frames_rectified: With a calibration of ROS or OpenCV, whether the images are rectified; None finds out from the rows of stereo
            pairs, and takes images of one eye for raw ones.
        eyes: Where pictures hold both eyes, see `EYES`; `one`: they hold one; `auto` finds out.

    Returns:
        Undistorted frames, of both eyes where pictures hold both and a calibration is of both; those without a pose are skipped.

    Raises:
        SequenceError: If a file is missing or wrong, or poses are given without intrinsics.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    if path.is_dir():
        found = find_video(path)
        if found is None:
            raise SequenceError(f"{folder}: holds no video; pass a video file or a folder with one")
        path = found
    poses = poses or _existing(folder / "poses.txt")
    files = [Path(calibration)] if calibration else find_calibration(folder) if fx is None and baseline_m is None else []
    mask = mask or _existing(folder / "mask.png") or _existing(folder / "masks")
    check_positive(path, fps=fps, scale=scale, baseline_m=baseline_m)
    if threads < 1 and threads != -1:
        raise SequenceError(f"{path}: threads must be -1 for all cores, or 1 or more, got {threads}")
    video = Video(path)
    whole = video.width, video.height
    numbers = select(range(video.frame_count), path, start, stop, 1 if step is None else step)
    video.stamp_ns(numbers[-1], fps)  # which is refused before frames are read
    halves = find_halves(eyes, whole, lambda: video.glimpses(spread(numbers, 5)), path, calibrated_size(files))
    pairs, size = (StackedVideo(path, halves), halves.size) if halves else (None, whole)
    rectification, raw, calibrated, _ = read_lenses(path, files, (fx, fy, cx, cy, baseline_m), distortion, size, pairs, frames_rectified)
    if video.turned and calibrated:
        logger.warning(
            "%s: its pictures are turned, as the file asks; calibration and poses must be those of turned ones, of %d×%d", path, *size
        )
    if not files and fy is None and abs(video.pixel_aspect - 1) > _SQUARE:
        logger.warning(
            "%s: its pixels are %.3g times as wide as high, but one focal length is taken for both directions; make them square with "
            "`ffmpeg -i IN -vf scale=trunc(iw*sar/2)*2:ih,setsar=1 -crf 15 OUT.mp4`, or pass fx and fy",
            path, video.pixel_aspect,
        )  # fmt: skip

    known = None
    way = STRUCTURE_FROM_MOTION if poses is None else str(poses)
    if pose_estimator(way) is None:
        if not calibrated:
            raise SequenceError(
                f"{path}: poses are given ({poses}), but no intrinsics; pass fx (and fy, cx, cy, distortion) or a "
                f"calibration file, or poses={STRUCTURE_FROM_MOTION!r} to estimate both"
            )
        assert poses is not None  # else structure from motion estimates
        known = read_poses(Path(poses), scale or 1.0)
        tell_beyond(known, video.frame_count - 1, Path(poses), 0.1)  # files that are cut off may state what is left
        numbers = keep_posed(numbers, known, Path(poses))
    else:
        if sfm_step is None:
            sfm_step = min(6, max(len(numbers) // _FEWEST_SFM, 1)) if step is None else 1
        if sfm_step < 1:
            raise SequenceError(f"{path}: sfm_step must be 1 or more, got {sfm_step}")
        chosen, numbers = len(numbers), numbers[::sfm_step]
        if len(numbers) < chosen:
            text = "%s: %d of %d frames are taken, the others left out by sfm_step %d; 1 takes all"
            logger.info(text, path, len(numbers), chosen, sfm_step)

    mask_of = _mask_reader(mask, mask_polarity, size, numbers, halves)

    def read(numbers: Sequence[int]) -> Iterable[tuple[int, np.ndarray, np.ndarray | None]]:
        return pairs.read(numbers) if pairs else ((number, image, None) for number, image in video.frames(numbers))

    @functools.cache  # which takes a pass over the video
    def borders() -> Borders:
        if not mask_border:
            return Borders()
        return find_borders(path, read(spread(numbers, 10)), None if known is None else [known[n] for n in numbers])

    def frames() -> Iterator[Frame]:
        lit, blacken_left, blacken_right = borders()
        views = with_raw_eyes_checked(pairs.read(numbers), raw) if pairs and raw else read(numbers)
        for number, image, other in views:
            pose = np.eye(4) if known is None else known[number]
            right = rectification.right(blacken_right(other)) if other is not None and rectification.baseline else None
            mask = rectification.mask(cv2.bitwise_and(lit(image), mask_of(number)))
            yield rectification.frame(video.stamp_ns(number, fps), rectification.left(blacken_left(image)), right, pose, mask)

    recording = Recording(frames, len(numbers), source=path)
    if known is not None:
        return recording
    names = [f"frame {n}" for n in numbers]
    return with_estimated_poses(recording, path, way, "", names, scale=scale, threads=threads, calibrated=calibrated)


def _mask_reader(
    source: Path | str | None, polarity: str, size: tuple[int, int], numbers: Sequence[int], halves: Halves | None
) -> Callable[[int], np.ndarray]:
    """What gives the mask [H, W] of one of the frame numbers, 255 = tissue; all of it is tissue where there is no mask."""
    everything = np.full(size[::-1], 255, np.uint8)
    if source is None:
        return lambda number: everything
    source = Path(source)
    if not source.is_dir():
        image = read_mask(source, size, halves)
        white = white_of([image], source)
        only = tissue_mask(image, white_is_tool=tool_is_white([image], source, polarity, white), size=size, white=white)
        return lambda number: only
    files = numbered_files(source)
    if not files:
        raise SequenceError(f"{source}: holds no masks named like 000000.png")
    if not files.keys() & set(numbers):
        raise SequenceError(
            f"{source}: holds numbers from {min(files)} to {max(files)}, but no frame from {numbers[0]} to {numbers[-1]} has one of them;"
            " number masks as frames, from 0, or leave them out"
        )
    tell_lacking(numbers, files, source, UNMASKED)
    masks = MaskFiles(files, source, polarity, halves)
    return lambda number: everything if (mask := masks.of(number, size)) is None else mask


def _existing(path: Path) -> Path | None:
    return path if path.exists() else None
