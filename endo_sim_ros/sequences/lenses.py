"""The lenses that images of a folder or a video were taken with, from a calibration or from options."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.calibration_files import check_calibrated_size
from endo_sim_ros.sequences.opencv_calibrations import Cameras, intrinsics, read_cameras, read_one
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration
from endo_sim_ros.sequences.stereo_images import StereoImages, rectified_already


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
        values: Options fx, fy, cx, cy.
        distortion: Option of this name.
        size: Width and height of an eye, pixels.
        pairs: Images of both eyes; None where there is one.
        rectified: Option `frames_rectified`.

    Raises:
        SequenceError: If something is wrong, or missing for pairs.
    """
    source = files[0] if files else source
    cameras = read_cameras(files) if pairs else None
    if pairs and cameras:
        raw, calibration = _of_pair(cameras, pairs, rectified)
        if raw:
            return Lenses(Rectification.stereo(raw), raw, True, None)
    else:
        calibration = read_one(source, files, rectified)
    K, distortion = intrinsics(source, calibration, values, distortion, size)
    rectification = Rectification.mono(K, distortion, size, source)
    if pairs:
        rectification.baseline = calibration.get("baseline_m")
        if rectification.baseline is None:
            raise SequenceError(f"{source}: baseline_m is missing, but there are right images")
        if any(distortion):
            raise SequenceError(
                f"{source}: stereo images must be rectified already; drop distortion or right/, or give the calibration of ROS or OpenCV"
            )
    return Lenses(rectification, None, K is not None, calibration.get("fps"))


def _of_pair(cameras: Cameras, images: StereoImages, rectified: bool | None) -> tuple[StereoCalibration | None, dict[str, Any]]:
    """The calibration of raw pairs, and nothing; or None, and that of rectified ones as `read_calibration` gives it."""
    if cameras.size is None:
        check_calibrated_size(cameras.single(rectified=False), images.size, Path(cameras.source))
    raw = cameras.raw_pair(images.size).resized(*images.size)
    if rectified is None:
        rectified = rectified_already(images, raw, usual=False)
    return (None, cameras.rectified_pair(raw)) if rectified else (raw, {})
