"""The lenses that images of a folder or a video were taken with, from a calibration or from options."""

import functools
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.calibration_files import check_baseline, check_calibrated_size, read_calibration
from endo_sim_ros.sequences.opencv_calibrations import Cameras, intrinsics, read_cameras, read_one
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration
from endo_sim_ros.sequences.stereo_images import StereoImages, rectified_already

logger = logging.getLogger(__name__)


class Lenses(NamedTuple):
    """Those of one eye or of both.

    Args:
        rectification: Of their images; it has a baseline where both are known.
        raw: The calibration of raw pairs; None of others.
        known: Whether there are intrinsics; without, those of the rectification mean nothing.
        fps: Frames per second that the calibration tells, if it does.
    """

    rectification: Rectification
    raw: StereoCalibration | None
    known: bool
    fps: float | None


def read_lenses(
    source: Path,
    files: Sequence[Path],
    values: tuple[float | None, ...],
    distortion: Sequence[float],
    size: tuple[int, int],
    pairs: StereoImages | None,
    rectified: bool | None,
) -> Lenses:
    """The lenses of a recording.

    Args:
        source: The recording, for messages.
        files: Of its calibration, as of `find_calibration`; none where there are options, or nothing is known.
        values: Options fx, fy, cx, cy, baseline_m.
        distortion: Option of this name.
        size: Width and height of an eye, pixels.
        pairs: Images of both eyes; None where there is one. Of those in one picture the left eye can do without the right one's lens.
        rectified: Option `frames_rectified`.

    Raises:
        SequenceError: If something is wrong, or missing for pairs.
    """
    recording, source = source, files[0] if files else source
    cameras = read_cameras(files) if pairs else None
    if pairs and cameras and ("K2" in cameras.values or not pairs.in_one):
        raw, calibration = _of_pair(cameras, pairs, rectified)
        if raw:
            return Lenses(Rectification.stereo(raw), raw, True, None)
    else:
        calibration = read_one(source, files, rectified)
    K, distortion = intrinsics(source, calibration, values, distortion, size)
    rectification = Rectification.mono(K, distortion, size, source)
    if pairs:
        rectification.baseline = calibration.get("baseline_m", values[-1])
        if values[-1] is not None:
            check_baseline(f"{source}: baseline_m", values[-1])
        if rectification.baseline is None and pairs.in_one:
            _tell_left(recording)
        elif rectification.baseline is None:
            raise SequenceError(f"{source}: baseline_m is missing, but there are right images")
        elif any(distortion):
            raise SequenceError(
                f"{source}: stereo images must be rectified already; drop distortion, or give the calibration of ROS or OpenCV"
            )
    elif values[-1] is not None:
        raise SequenceError(f"{source}: baseline_m is given, but no pairs are found; state eyes, as left_right, if each picture holds both")
    elif "baseline_m" in calibration:
        _tell_one(recording)
    return Lenses(rectification, None, K is not None, calibration.get("fps"))


def calibrated_size(files: Sequence[Path]) -> tuple[int, int] | None:
    """Width and height of the images that a calibration is of, where it tells them."""
    if cameras := read_cameras(files):
        return cameras.size
    fields = read_calibration(files[0]) if files else {}
    return (fields["width"], fields["height"]) if {"width", "height"} <= fields.keys() else None


@functools.cache  # a recording is opened several times
def _tell_left(recording: Path) -> None:
    logger.warning(
        "%s: its pictures hold both eyes, but no calibration of both is given, so the left one alone is read; give fx and baseline_m of "
        "rectified ones, both as options or both in calibration.yaml, or files of ROS or OpenCV",
        recording,
    )


@functools.cache
def _tell_one(recording: Path) -> None:
    logger.warning(
        "%s: its calibration is of two eyes, but no pairs are found, so one is read; state eyes if each picture holds both", recording
    )


def _of_pair(cameras: Cameras, images: StereoImages, rectified: bool | None) -> tuple[StereoCalibration | None, dict[str, Any]]:
    """The calibration of raw pairs, and nothing; or None, and that of rectified ones as `read_calibration` gives it."""
    if cameras.size is None:
        check_calibrated_size(cameras.single(rectified=False), images.size, Path(cameras.source))
    raw = cameras.raw_pair(images.size).resized(*images.size)
    if rectified is None:
        rectified = rectified_already(images, raw, usual=False)
    return (None, cameras.rectified_pair(raw)) if rectified else (raw, {})
