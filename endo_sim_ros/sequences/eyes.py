"""Whether the images of a stereo pair are of the eyes that they are said to be of, and rectified."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from endo_sim_ros.core.features import detect, match_pair
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.rectification import StereoCalibration

logger = logging.getLogger(__name__)

APART = 0.01  # share of the image's height by which rows may differ in the median: stereo matching takes no more

_PAIRS = 5  # that are looked at until one tells
_FEATURES, _RATIO = 1000, 0.8  # as `detect` and `match_pair` take them
_LEAST_MATCHES = 30  # fewer tell nothing
_ROWS = 0.05  # share of the image's height by which rows of a feature may be apart; rectification is seldom exact
_SHARE = 0.9  # of the features that must be on the wrong side; those far away are on either
_CLEARLY = 4.0  # times as far rows must be apart as they are with the eyes exchanged, beside half a pixel of noise


def with_eyes_checked(frames: Iterable[Frame], source: Path | str) -> Iterator[Frame]:
    """The frames, of which the first pair with features enough tells whether its eyes are exchanged.

    What lies before two eyes is farther to the left in the right image. A pair whose rows do not match is warned of.

    Args:
        frames: Rectified.
        source: What the images of the eyes were read from, for messages; may be empty.

    Raises:
        SequenceError: If they are.
    """
    pairs = _PAIRS
    for frame in frames:
        if frame.right is not None and pairs:
            pairs -= 1
            left, right = match_pair(detect(frame.image, frame.mask, _FEATURES), detect(frame.right, None, _FEATURES), _RATIO)
            moved = (right - frame.right_intrinsics[:2, 2]) - (left - frame.camera.K[:2, 2])
            moved = moved[np.abs(moved[:, 1]) < _ROWS * frame.camera.height]
            if len(moved) >= _LEAST_MATCHES:
                pairs, wrong = 0, float(np.mean(moved[:, 0] > 0))
                where, lower = f"{source}: " if source else "", float(np.median(moved[:, 1]))
                if wrong > _SHARE:
                    raw = f", or they are not rectified (rows {abs(lower):.1f} px apart)" * (abs(lower) > APART * frame.camera.height)
                    raise SequenceError(
                        f"{where}left and right eye are exchanged, or their principal points wrong{raw}: {wrong:.0%} of {len(moved)} "
                        f"features of the view at {frame.stamp_ns * 1e-9:.3f} s lie farther right in the right image, which nothing before "
                        "two eyes does; exchange left and right images, or correct the calibration"
                    )
                if abs(lower) > APART * frame.camera.height:
                    logger.warning(
                        "%simages of the right eye lie %.1f px %s than those of the left one, at %.3f s: the pair is not rectified, or its "
                        "principal points are wrong; depth needs rows that match",
                        where, abs(lower), "lower" if lower > 0 else "higher", frame.stamp_ns * 1e-9,
                    )  # fmt: skip
        yield frame


def refuse_both_in_one(images: Sequence[np.ndarray], source: Path) -> None:
    """Raise SequenceError if most of these pictures hold both eyes of a stereo pair, side by side or one above the other.

    Args:
        images: RGB images [H, W, 3], uint8, of a recording of one eye.
        source: What they were read from, for messages.
    """
    for axis, how, half, other in (
        (1, "side by side", "iw/2:ih:0:0", "iw/2:ih:iw/2:0"),
        (0, "one above the other", "iw:ih/2:0:0", "iw:ih/2:0:ih/2"),
    ):
        if 2 * sum(_halves_match(image, axis) for image in images) > len(images):
            raise SequenceError(
                f"{source}: its pictures hold both eyes, {how}; cut them apart into folders left and right, by "
                f"`ffmpeg -i IN -vf crop={half} left/%06d.png` and `ffmpeg -i IN -vf crop={other} right/%06d.png`"
            )


def _halves_match(image: np.ndarray, axis: int) -> bool:
    """Whether most features that both halves of an image [H, W, 3] along an axis share are on the same rows, as in those of two eyes."""
    half = image.shape[axis] // 2
    parts = np.split(image[:, : 2 * half] if axis else image[: 2 * half], 2, axis)
    left, right = (detect(np.ascontiguousarray(part), None, _FEATURES) for part in parts)
    one, other = match_pair(left, right, _RATIO)
    same = np.abs(one - other)[:, 1] < _ROWS * parts[0].shape[0]
    return len(same) >= _LEAST_MATCHES and bool(same.mean() > 0.5)


def with_raw_eyes_checked(
    images: Iterable[tuple[int, np.ndarray, np.ndarray]], calibration: StereoCalibration
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Numbers and images of both eyes, of which the first pair with features enough tells whether the eyes are exchanged.

    Where the lenses converge, features of exchanged eyes lie on the side that `with_eyes_checked` expects; their rows are apart.

    Args:
        images: Frame numbers and raw left and right RGB images [H, W, 3], uint8.
        calibration: Of these.

    Raises:
        SequenceError: If they are.
    """
    pairs = _PAIRS
    for number, left, right in images:
        if pairs:
            pairs -= 1
            eyes = match_pair(detect(left, None, _FEATURES), detect(right, None, _FEATURES), _RATIO)
            if len(eyes[0]) >= _LEAST_MATCHES:
                pairs = 0
                straight = [calibration.rectified_points(*each) for each in (eyes, eyes[::-1])]
                rows, exchanged = (float(np.median(np.abs(one - other)[:, 1])) for one, other in straight)
                if rows > _CLEARLY * exchanged + 0.5:
                    raise SequenceError(
                        f"{calibration.source}: left and right eye are exchanged: rows of features of frame {number} are {rows:.1f} px "
                        f"apart after rectification, and {exchanged:.1f} px the other way round; exchange the images, or the cameras here"
                    )
        yield number, left, right
