"""The calibration file of image folders and videos."""

import contextlib
import functools
import logging
import math
import re
import reprlib
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from endo_sim_ros.core.cameras import focal_length_possible, intrinsic_matrix, principal_point_inside
from endo_sim_ros.core.frames import SequenceError

log = logging.getLogger(__name__)

_MOST_BYTES = 65_536  # of a calibration file; one takes 200
_EXPECTED = "give lines as `fx: 907.4` with fx, fy, cx, cy in pixels"
_FOREIGN = {  # what tells a calibration that another program wrote, the most telling first
    "Camera.fx": "settings of ORB-SLAM;",
    "Camera1.fx": "settings of ORB-SLAM;",
    "opencv-matrix": "matrices of OpenCV, but none by the names camera_matrix, K, K1 or M1; rename these, or",
}
LEAST_BASELINE, MOST_BASELINE = 0.5e-3, 0.05  # metres between the eyes of an endoscope
_USUAL = 2e-3, 15e-3  # metres: laparoscopes have 3 to 6 mm
_MILLIMETRES = 1e3 * LEAST_BASELINE  # metres: from here on they are millimetres, as no rig is so broad
_OTHER_SIZE = 1.4  # times the image's centre: images are made smaller by 1.5 or more, and no lens looks so far aside
_ALIKE = 1.1  # times as far across as down, at most, is the centre of images that were made smaller: lenses are off by a twentieth
_PERHAPS, _SAME = 1.15, 1.03  # the same two numbers where that is only likely, and a warning tells


def read_calibration(path: Path) -> dict[str, Any]:
    """The calibration file of image folders and videos: YAML with fx, fy, cx, cy in pixels.

    Pixel (0, 0) has its centre at (0.5, 0.5), as everywhere in this package and in COLMAP; add 0.5 to cx and cy of an
    OpenCV calibration. Optional: width, height, baseline_m (metres), fps, distortion (OpenCV order k1 k2 p1 p2 k3).
    """
    text = read_text(path, _MOST_BYTES)
    try:
        fields = yaml.safe_load(re.sub("^%YAML:.*", "", text))  # OpenCV's first line, which is no YAML
        wrong = "" if isinstance(fields, dict) else "holds no `name: value` lines"
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        fields, wrong = {}, f"not a readable YAML file ({str(error).splitlines()[0]})"
    foreign = next((what for mark, what in _FOREIGN.items() if mark in text), None)
    if foreign and (wrong or "fx" not in fields):
        raise SequenceError(f"{path}: holds {foreign} {_EXPECTED}, with 0.5 added to those cx and cy, and distortion if images have any")
    if wrong:
        raise SequenceError(f"{path}: {wrong}; {_EXPECTED}")
    for name in ("fx", "fy", "cx", "cy", *(n for n in ("width", "height", "baseline_m", "fps") if n in fields)):
        if name not in fields:
            raise SequenceError(f"{path}: {name} is missing; {_EXPECTED}")
        value = fields[name]
        if isinstance(value, str):  # PyYAML reads 1e3 as text
            with contextlib.suppress(ValueError):
                value = fields[name] = float(value)
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < 1e9:
            shown = reprlib.repr(value) if isinstance(value, int | float | str | None) else f"a {type(value).__name__}"  # lists may nest
            raise SequenceError(f"{path}: {name} must be a positive number below 1e9, got {shown}")
    try:
        fields["distortion"] = [float(k) for k in fields.get("distortion") or ()]
    except (TypeError, ValueError, OverflowError):
        raise SequenceError(f"{path}: distortion must be a list of numbers") from None
    if not all(map(math.isfinite, fields["distortion"])):
        raise SequenceError(f"{path}: distortion must be finite, got {fields['distortion']}")
    if "baseline_m" in fields:
        check_baseline(f"{path}: baseline_m", fields["baseline_m"])
    return fields


def read_text(path: Path, most: int) -> str:
    """The text of a calibration file.

    Raises:
        SequenceError: If it is missing, no text, or has more bytes than so many.
    """
    if path.is_file() and path.stat().st_size > most:
        raise SequenceError(f"{path}: it has {path.stat().st_size} bytes, far more than a calibration needs")
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise SequenceError(
            f"{path}: file is missing; it must give fx, fy, cx, cy in pixels, unless its folder holds a calibration of ROS or OpenCV; "
            "of one eye, fx (and fy, cx, cy, distortion) may be passed instead, or are estimated with poses=sfm"
        ) from None
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path}: not a readable text file ({error})") from None


def unit_of(distance: float, where: str) -> float:
    """Metres per unit, 1 or 0.001, of a distance between the eyes of an endoscope: it has but one of them.

    Raises:
        SequenceError: If it has neither.
    """
    for unit in (1.0, 1e-3):
        if LEAST_BASELINE < unit * distance < MOST_BASELINE:
            return unit
    raise SequenceError(
        f"{where}: the two eyes would be {distance:.3g} m or {distance:.3g} mm apart, as those of no endoscope; give metres or millimetres"
    )


@functools.cache  # a recording is read several times
def check_baseline(where: str, baseline: float) -> None:
    """Log a warning if the two eyes of an endoscope are never this far apart, metres; refuse what must be millimetres.

    Raises:
        SequenceError: If it is half a metre or more: in millimetres it would be that of an endoscope.
    """
    if baseline >= _MILLIMETRES:
        raise SequenceError(f"{where}: the two eyes would be {baseline:g} m apart; give metres, {baseline / 1000:g} if this is millimetres")
    if baseline == 0:
        log.warning("%s: tells no baseline, so the images of the right eye are not used; P[0, 3] is minus fx times the baseline", where)
    elif baseline < 0:
        text = "%s: the right eye would be %.3g m to the left of the left one, so its images are not used; exchange the eyes, or correct P"
        log.warning(text, where, -baseline)
    elif not _USUAL[0] <= baseline <= _USUAL[1]:
        text = "%s: the two eyes would be %.3g mm apart, those of laparoscopes are 3 to 6; check its unit"
        log.warning(text, where, 1e3 * baseline)


def check_calibrated_size(calibration: dict[str, Any], size: tuple[int, int], path: Path) -> None:
    """Raise SequenceError if a calibration file states another image size than (width, height), or is one of no camera with it."""
    stated = calibration.get("width", size[0]), calibration.get("height", size[1])
    if stated != size:
        raise SequenceError(
            f"{path}: width and height are {stated[0]}×{stated[1]}, but the images are {size[0]}×{size[1]}; "
            f"{'turn' if stated == size[::-1] else 'scale'} fx, fy, cx, cy or the images"
        )
    K = intrinsic_matrix(*(calibration[name] for name in ("fx", "fy", "cx", "cy")))
    if max(K[0, 2], K[1, 2]) <= 1:
        raise SequenceError(f"{path}: cx and cy are {K[0, 2]:g} and {K[1, 2]:g}, which are no pixels; multiply them by width and height")
    across, down = (2 * centre / side for centre, side in zip((K[0, 2], K[1, 2]), size))
    beyond = lambda times: min(across, down) > times or max(across, down) < 1 / times
    told = (
        f"{path}: cx and cy would be the centre of images of {2 * K[0, 2]:.0f}×{2 * K[1, 2]:.0f}, but the images are "
        f"{size[0]}×{size[1]}; scale fx, fy, cx, cy, or, where images are cut from larger ones, state width and height there "
        "(image_width and image_height in files of ROS and OpenCV)"
    )
    if not calibration.keys() & {"width", "height"}:
        if beyond(_OTHER_SIZE) and 1 / _ALIKE < across / down < _ALIKE:
            raise SequenceError(told)
        if beyond(_PERHAPS) and 1 / _SAME < across / down < _SAME:
            log.warning("%s; where the lens looks so far aside, leave them", told)
    refuse_impossible(K, size, path)


def refuse_impossible(K: np.ndarray, size: tuple[int, int], source: Path | str) -> None:
    """Raise SequenceError if no endoscope has intrinsics [3, 3] with pictures of (width, height), pixels."""
    if not focal_length_possible(K, *size):
        raise SequenceError(
            f"{source}: no endoscope has focal lengths of {K[0, 0]:g} and {K[1, 1]:g} pixels with images of {size[0]}×{size[1]}; "
            "give them in pixels of these images"
        )
    if not principal_point_inside(K, *size):
        raise SequenceError(
            f"{source}: the principal point ({K[0, 2]:g}, {K[1, 2]:g}) lies outside the images of {size[0]}×{size[1]}; "
            "is the calibration of another size?"
        )
