"""The eyes of a stereo pair: where one picture holds both, and whether images are of the eyes that they are said to be of."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.features import detect, match_pair
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.images import same_shape
from endo_sim_ros.sequences.rectification import StereoCalibration

logger = logging.getLogger(__name__)

APART = 0.01  # share of the image's height by which rows may differ in the median: stereo matching takes no more

EYES = {"left_right": (1, False), "right_left": (1, True), "top_bottom": (0, False), "bottom_top": (0, True)}
"""Where one picture holds left and right eye: the axis, and whether the right one comes first."""

_LOOKED_AT = 1280  # pixels, the longer side of pictures that are searched for both eyes; larger ones take longer and tell no more
PAIRS = 5
"""How many pairs are looked at, at most, for what their features tell."""

LEAST_MATCHES = 30
"""Fewest features shared by two eyes that tell anything."""

_FEATURES, _RATIO = 1000, 0.8  # as `detect` and `match_pair` take them
_ROWS = 0.05  # share of the image's height by which rows of a feature may be apart; rectification is seldom exact
_SPREAD = 0.5  # share of the image's width that disparities of most features span at most; those of a mirrored half span all of it
_SMALLEST = 16  # pixels of a half that may be an eye
_SHARE = 0.9  # of the features that must be on the wrong side; those far away are on either
_CLEARLY = 4.0  # times as far rows must be apart as they are with the eyes exchanged, beside half a pixel of noise


def shared_features(
    left: np.ndarray, right: np.ndarray, mask: np.ndarray | None = None, most: int = _FEATURES
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [N, 2] of the features that the images of two eyes share, in the left and in the right one.

    Args:
        left, right: RGB images [H, W, 3], uint8.
        mask: Of the left one [H, W]; where it is 0 no features are looked for.
        most: Features of an image, at most.
    """
    return match_pair(detect(left, mask, most), detect(right, None, most), _RATIO)


def with_eyes_checked(frames: Iterable[Frame], source: Path | str) -> Iterator[Frame]:
    """The frames, of which the first pair with features enough tells whether its eyes are exchanged.

    What lies before two eyes is farther to the left in the right image. A pair whose rows do not match is warned of.

    Args:
        frames: Rectified.
        source: What the images of the eyes were read from, for messages; may be empty.

    Raises:
        SequenceError: If they are.
    """
    pairs = PAIRS
    for frame in frames:
        if frame.right is not None and pairs:
            pairs -= 1
            left, right = shared_features(frame.image, frame.right, frame.mask)
            moved = (right - frame.right_intrinsics[:2, 2]) - (left - frame.camera.K[:2, 2])
            moved = moved[np.abs(moved[:, 1]) < _ROWS * frame.camera.height]
            if len(moved) >= LEAST_MATCHES:
                pairs, wrong = 0, float(np.mean(moved[:, 0] > 0))
                where, lower = f"{source}: " if source else "", float(np.median(moved[:, 1]))
                if wrong > _SHARE:
                    raw = f", or they are not rectified (rows {abs(lower):.1f} px apart)" * (abs(lower) > APART * frame.camera.height)
                    raise SequenceError(
                        f"{where}left and right eye are exchanged, or their principal points wrong{raw}: {wrong:.0%} of {len(moved)} "
                        f"features of the view at {frame.stamp_ns * 1e-9:.3f} s lie farther right in the right image, which nothing before "
                        "two eyes does; exchange left and right images (of one picture: option eyes), or correct the calibration"
                    )
                if abs(lower) > APART * frame.camera.height:
                    logger.warning(
                        "%simages of the right eye lie %.1f px %s than those of the left one, at %.3f s: the pair is not rectified, its "
                        "principal points are wrong, or it is of two moments; depth needs rows that match",
                        where, abs(lower), "lower" if lower > 0 else "higher", frame.stamp_ns * 1e-9,
                    )  # fmt: skip
            elif not pairs:
                logger.warning(
                    "%sfewer than %d features of left and right images match in each of %d pairs, so that nothing tells whether they are "
                    "two eyes of one moment; look at a pair",
                    f"{source}: " if source else "", LEAST_MATCHES, PAIRS,
                )  # fmt: skip
        yield frame


@dataclass(frozen=True)
class Halves:
    """Where a picture holds both eyes of a stereo pair.

    Args:
        axis: 1 where they are side by side, 0 where one is above the other.
        exchanged: Whether the right eye comes first.
        whole: Width and height of the picture, pixels.
        squeezed: Whether each eye is squeezed into its half, and has the shape of the whole picture.
    """

    axis: int
    exchanged: bool
    whole: tuple[int, int]
    squeezed: bool = False

    @classmethod
    def of(cls, eyes: str, whole: tuple[int, int], source: Path) -> "Halves":
        """Those that the option says; SequenceError if the picture of a source has no halves."""
        axis, exchanged = EYES[eyes]
        if whole[1 - axis] % 2:
            side, line = (("height", "row"), ("width", "column"))[axis]
            raise SequenceError(
                f"{source}: pictures of both eyes must have an even {side}, got {whole[1 - axis]}; cut off what is no eye, or a {line}"
            )
        return cls(axis, exchanged, whole)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of an eye that is cut out, pixels."""
        width, height = self.whole
        return self.whole if self.squeezed else (width // 2, height) if self.axis else (width, height // 2)

    def cut(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Left and right eye of a picture [H, W, ...], which may be smaller; squeezed ones are stretched to `size`."""
        parts = map(np.ascontiguousarray, np.array_split(picture, 2, self.axis))
        one, other = (cv2.resize(part, self.size) for part in parts) if self.squeezed else parts
        return (other, one) if self.exchanged else (one, other)


def find_halves(
    eyes: str, whole: tuple[int, int], look: Callable[[], Sequence[np.ndarray]], source: Path, calibrated: tuple[int, int] | None
) -> Halves | None:
    """Where pictures hold both eyes; None where they hold one. What is found is logged.

    Args:
        eyes: One of EYES, or `auto` to find out.
        whole: Width and height of a picture, pixels.
        look: Returns some pictures, RGB [H, W, 3], uint8, to find out from.
        source: What they are read from, for messages.
        calibrated: Width and height of an eye as the calibration tells them: squeezed eyes have the shape of the whole picture.

    Raises:
        SequenceError: If there is no such option, or pictures have no halves.
    """
    if eyes == "auto":
        share = min(1.0, _LOOKED_AT / max(whole))
        eyes, pictures = "one", [cv2.resize(each, None, fx=share, fy=share, interpolation=cv2.INTER_AREA) for each in look()]
        for name, axis, how in (("left_right", 1, "side by side"), ("top_bottom", 0, "one above the other")):
            if 2 * sum(_halves_match(picture, axis) for picture in pictures) > len(pictures):
                logger.info("%s: its pictures are taken for those of both eyes, %s; state eyes=one if they are not", source, how)
                eyes = name
                break
    if eyes == "one":
        return None
    if eyes not in EYES:
        raise SequenceError(f"{source}: eyes must be auto, one, {', '.join(EYES)}, got {eyes!r}")
    halves = Halves.of(eyes, whole, source)
    if calibrated is None or not same_shape(calibrated, whole):
        return halves
    logger.info("%s: each eye is taken to be squeezed into its half, as its calibration is of %d×%d", source, *calibrated)
    return replace(halves, squeezed=True)


def _halves_match(image: np.ndarray, axis: int) -> bool:
    """Whether most features that both halves of an image [H, W, 3] along an axis share are on the same rows, and about as far aside, as in
    those of two eyes."""
    half = image.shape[axis] // 2
    if min(half, image.shape[1 - axis]) < _SMALLEST:
        return False
    parts = np.split(image[:, : 2 * half] if axis else image[: 2 * half], 2, axis)
    left, right = map(np.ascontiguousarray, parts)
    one, other = shared_features(left, right)
    same = np.abs(one - other)[:, 1] < _ROWS * parts[0].shape[0]
    if len(same) < LEAST_MATCHES or same.mean() <= 0.5:
        return False
    return bool(np.subtract(*np.percentile((one - other)[same, 0], (90, 10))) < _SPREAD * parts[0].shape[1])


def with_raw_eyes_checked(
    images: Iterable[tuple[int, np.ndarray, np.ndarray]], calibration: StereoCalibration
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Numbers and images of both eyes, of which the first pair with features enough tells whether the eyes are exchanged.

    Where the lenses converge, features of exchanged eyes lie on the side that `with_eyes_checked` expects; their rows are apart. Where
    sensors are shifted and lenses parallel, nothing tells.

    Args:
        images: Frame numbers and raw left and right RGB images [H, W, 3], uint8.
        calibration: Of these.

    Raises:
        SequenceError: If they are.
    """
    pairs = PAIRS
    for number, left, right in images:
        if pairs:
            pairs -= 1
            eyes = shared_features(left, right)
            if len(eyes[0]) >= LEAST_MATCHES:
                pairs = 0
                straight = [calibration.rectified_points(*each) for each in (eyes, eyes[::-1])]
                rows, exchanged = (float(np.median(np.abs(one - other)[:, 1])) for one, other in straight)
                if rows > _CLEARLY * exchanged + 0.5:
                    raise SequenceError(
                        f"{calibration.source}: left and right eye are exchanged: rows of features of frame {number} are {rows:.1f} px "
                        f"apart after rectification, and {exchanged:.1f} px the other way round; exchange the images (of one picture: "
                        "option eyes), or the cameras here"
                    )
        yield number, left, right
