"""Poses that were written by another convention than they are read by: told from the images."""

import functools
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera, invert_pose, matrix_to_quat, quat_to_matrix, rigid_pose
from endo_sim_ros.core.features import Features, agreeing, detect, epipolar_distance, match_pair
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.recording import spread

logger = logging.getLogger(__name__)

_PAIRS = 8  # of frames that are looked at
_FEATURES = 1000  # SIFT features of an image, at most
_LEAST_MATCHES = 30  # of a pair of frames that agree with each other; fewer may agree by accident
_NOISE = 0.25  # pixels, of a feature
_LEAST_PAIRS = 5  # of a lens at rest over tissue that breathes, four pairs fit some convention by accident
_MOST_BESIDE = 0.02  # share of the image's width by which features may lie beside their lines; tissue that breathes moves by less
_CLEARLY = 4.0  # times as far they must lie beside them as by another convention
_RATIO = 0.8  # of the distances to the best and the second best match, as Lowe (2004) has it
_WIDTH = 640  # pixels; larger images make features no better and take longer
_GAPS = 16, 4, 1  # of the views of a pair, in views: the first that shares features counts, as the camera moved most there


class Pair(NamedTuple):
    """Two posed cameras, and pixels [M, 2] of the features that they share."""

    first: Camera
    second: Camera
    uv_1: np.ndarray
    uv_2: np.ndarray


def _reordered(pose: np.ndarray) -> np.ndarray:
    """A pose whose quaternion was qw qx qy qz and was read as qx qy qz qw."""
    w, x, y, z = matrix_to_quat(pose[:3, :3])
    return rigid_pose(quat_to_matrix([x, y, z, w]), pose[:3, 3])


_HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # about the camera's x axis
_FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # x right, y down, z forward in axes of REP 103
_MIRROR_X, _MIRROR_Y, _MIRROR_Z = (np.diag(np.where(np.arange(4) == axis, -1.0, 1.0)) for axis in range(3))  # of a world and its cameras
_READINGS: dict[tuple[str, str], Callable[[np.ndarray], np.ndarray]] = {
    ("were world-to-camera", "invert each"): invert_pose,
    ("had quaternions in the order qw qx qy qz", "write them as qx qy qz qw"): _reordered,
    ("were world-to-camera, with quaternions in the order qw qx qy qz", "write these as qx qy qz qw, and invert each pose"): (
        lambda pose: invert_pose(_reordered(pose))
    ),
    ("had rotations from the world to the camera beside positions of the camera", "transpose their rotations"): (
        lambda pose: rigid_pose(pose[:3, :3].T, pose[:3, 3])
    ),
    ("were of a camera with y up that looks along -z, as in OpenGL", "turn each by half a turn about the camera's own x axis"): (
        lambda pose: pose @ _HALF_TURN
    ),
    ("were world-to-camera, of a camera with y up that looks along -z", "invert each, and turn it by half a turn about its own x axis"): (
        lambda pose: invert_pose(pose) @ _HALF_TURN
    ),
    ("were of a camera that looks along x with z up, as bodies in ROS", "take those of its optical frame, with x right and y down"): (
        lambda pose: pose @ _FORWARD
    ),
    ("were mirrored along x", "negate the tx, qy and qz of each"): lambda pose: _MIRROR_X @ pose @ _MIRROR_X,
    ("were mirrored along z", "negate the tz, qx and qy of each"): lambda pose: _MIRROR_Z @ pose @ _MIRROR_Z,
    ("were left-handed with y up, as in Unity", "negate the ty, qx and qz of each"): lambda pose: _MIRROR_Y @ pose @ _MIRROR_Y,
    (
        "were left-handed, of a camera that looks along x with z up, as in Unreal",
        "negate the ty, qx and qz of each, and take its optical frame",
    ): (lambda pose: _MIRROR_Y @ pose @ _MIRROR_Y @ _FORWARD),
}
"""What poses may have been, what is then to be done, and the pose that was meant by one."""


def misreading(pairs: Sequence[Pair]) -> tuple[str, str] | None:
    """What poses would have to be to fit, and what is then to be done, for people.

    None where they fit as they are, or by no other convention either.
    """
    if len(pairs) < _LEAST_PAIRS:
        return None
    given = _beside(pairs, lambda pose: pose)
    residuals = {reading: _beside(pairs, meant) for reading, meant in _READINGS.items()}
    best = min(residuals, key=lambda reading: residuals[reading])
    if residuals[best] - _NOISE > _MOST_BESIDE * pairs[0].first.width or given <= _CLEARLY * residuals[best]:
        return None
    told = (
        f"do not fit the images, but would if they {best[0]}: features of {counted(len(pairs), 'pair')} of images are "
        f"{given - _NOISE:.2f} px beside their epipolar lines, and {residuals[best] - _NOISE:.2f} px if poses are read so"
    )
    return told, best[1]


def _beside(pairs: Sequence[Pair], meant: Callable[[np.ndarray], np.ndarray]) -> float:
    """How far features lie beside their epipolar lines, and `_NOISE`, pixels; no pair outweighs the others."""
    beside = []
    for first, second, uv_1, uv_2 in pairs:
        distance = epipolar_distance(first.at(meant(first.pose)), second.at(meant(second.pose)), uv_1, uv_2)
        beside.append(np.median(np.minimum(distance, first.width)))
    return float(np.exp(np.log(np.array(beside) + _NOISE).mean()))


def refuse_misread(frame_of: Callable[[int], Frame], numbers: Sequence[int], pose_file: Path) -> None:
    """Raise SequenceError if images tell that poses were written by another convention; warn where they fit by none.

    Args:
        frame_of: Gives the posed frame of a number.
        numbers: Those of the frames, in order.
        pose_file: What the poses are from.
    """

    @functools.cache
    def seen(number: int) -> tuple[Camera, Features]:
        frame = frame_of(number)
        scale = min(1.0, _WIDTH / frame.camera.width)
        size = round(scale * frame.camera.width), round(scale * frame.camera.height)
        image = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        mask = None if frame.mask is None else cv2.resize(frame.mask, size, interpolation=cv2.INTER_NEAREST)
        return frame.camera.resized(*size), detect(image, mask, _FEATURES)

    found = []
    for start in spread(range(len(numbers) - 1), _PAIRS):
        for other in (start + gap for gap in _GAPS if start + gap < len(numbers)):
            (first, here), (second, there) = seen(numbers[start]), seen(numbers[other])
            uv_1, uv_2 = agreeing(*match_pair(here, there, _RATIO), _LEAST_MATCHES)
            if len(uv_1):
                found.append(Pair(first, second, uv_1, uv_2))
                break
    if told := misreading(found):
        raise SequenceError(f"{pose_file}: its poses {told[0]}; {told[1]}, or pass poses=sfm to estimate them anew")
    if len(found) >= _LEAST_PAIRS and (off := _beside(found, lambda pose: pose) - _NOISE) > _MOST_BESIDE * found[0].first.width:
        logger.warning(
            "%s: its poses do not fit the images: features of %s of images are %.1f px beside their epipolar lines; check which frame each "
            "is of, and its axes; or pass poses=sfm to estimate them anew",
            pose_file, counted(len(found), "pair"), off,
        )  # fmt: skip
