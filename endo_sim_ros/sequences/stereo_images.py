"""The images of both eyes of a recording: in halves of pictures of a video or of files, or in two sets of files."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.eyes import APART, LEAST_MATCHES, PAIRS, Halves, shared_features
from endo_sim_ros.sequences.images import check_size, image_size, read_image
from endo_sim_ros.sequences.recording import DEFAULT_FPS, spread, stamp_ns
from endo_sim_ros.sequences.rectification import StereoCalibration
from endo_sim_ros.sequences.video_files import Video

logger = logging.getLogger(__name__)

_FEATURES = 2000  # of an image, at most: medians of all pairs are compared to half a pixel
_SURE_ROWS = 0.5  # pixels by which one of two readings of the images must have the rows of the eyes closer together


class StereoImages(ABC):
    """Numbered images of both eyes, read forwards.

    Attributes:
        source: Their file or folder, for messages.
        numbers: The frame numbers that there are, increasing.
        size: Width and height of an eye, pixels.
        in_one: Whether each picture holds both eyes.
    """

    source: Path
    numbers: Sequence[int]
    size: tuple[int, int]
    in_one = True

    @abstractmethod
    def read(self, numbers: Sequence[int]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Number, left and right RGB image [H, W, 3], uint8, of given frames, whose numbers increase."""

    @abstractmethod
    def stamp_ns(self, number: int, fps: float | None) -> int:
        """Time of exposure of a frame, nanoseconds, at frames per second, or at those of the images where these are None."""


class StackedVideo(StereoImages):
    """A video whose pictures hold both eyes, the left one on top unless `halves` says otherwise; see `StereoImages`."""

    def __init__(self, path: Path, halves: Halves | None = None):
        self.source = path
        self._video = Video(path)
        if self._video.turned:
            raise SequenceError(
                f"{path}: the file asks for its pictures to be turned, which would move the eyes from their places; take its rotation out, "
                "as `ffmpeg -display_rotation 0 -i IN -c copy OUT` does"
            )
        self._halves = halves or Halves.of("top_bottom", (self._video.width, self._video.height), path)
        self.numbers: Sequence[int] = range(self._video.frame_count)
        self.size = self._halves.size

    def read(self, numbers: Sequence[int]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:  # noqa: D102
        for number, image in self._video.frames(numbers):
            yield number, *self._halves.cut(image)

    def stamp_ns(self, number: int, fps: float | None) -> int:  # noqa: D102
        return self._video.stamp_ns(number, fps)


class StereoFiles(StereoImages):
    """Image files of both eyes; see `StereoImages`.

    Args:
        source: Their folder, for messages.
        left, right: Files by the number in their name.
        first: The number that frame 0 has in the files' names.
        halves: Where the left files hold both eyes; None where they do not.
    """

    def __init__(self, source: Path, left: Mapping[int, Path], right: Mapping[int, Path], first: int = 0, halves: Halves | None = None):
        self.source, self._halves, self.in_one = source, halves, halves is not None
        self._left, self._right = ({number - first: file for number, file in eye.items()} for eye in (left, right))
        self.numbers: Sequence[int] = sorted(self._left)
        self.size = halves.size if halves else image_size(read_image(self._left[self.numbers[0]]))

    def read(self, numbers: Sequence[int]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:  # noqa: D102
        if self._halves:
            for number in numbers:
                yield number, *self._halves.cut(check_size(read_image(self._left[number]), self._halves.whole, self._left[number]))
            return
        alone = next((number for number in numbers if number not in self._right), None)
        if alone is not None:
            raise SequenceError(f"{self.source}: the right image of {self._left[alone].name} is missing; add it, or take that image away")
        for number in numbers:
            left, right = (check_size(read_image(file), self.size, file) for file in (self._left[number], self._right[number]))
            yield number, left, right

    def stamp_ns(self, number: int, fps: float | None) -> int:  # noqa: D102
        return stamp_ns(number, fps or DEFAULT_FPS)


def rectified_already(images: StereoImages, calibration: StereoCalibration, usual: bool, besides: str = "") -> bool:
    """Whether the images are rectified, by the rows of the features that both eyes share. It is logged.

    Args:
        images: Raw, or rectified already.
        calibration: Of the raw cameras, for images of this size.
        usual: What they are where features do not tell.
        besides: What else the sentence says.
    """
    offsets = row_offsets(images, calibration)
    # Where the eyes are exchanged, rows match in neither case.
    sure = offsets is not None and abs(offsets[0] - offsets[1]) > _SURE_ROWS and min(offsets) <= APART * images.size[1]
    rectified = offsets[0] < offsets[1] if offsets and sure else usual
    logger.log(
        logging.INFO if sure else logging.WARNING,
        "%s: images are taken for %s (%s)%s%s",
        images.source, "rectified ones" if rectified else "raw ones",
        "their eyes share too few features to tell" if offsets is None else
        f"rows of the eyes are {offsets[0]:.2f} px apart as they are, {offsets[1]:.2f} px after rectification", besides,
        "" if sure else "; state frames_rectified if they are not",
    )  # fmt: skip
    return rectified


def row_offsets(images: StereoImages, calibration: StereoCalibration) -> tuple[float, float] | None:
    """How many pixels apart the rows of matched features of both eyes are: as the images are, and after rectification.

    Args:
        images: Raw, or rectified already: the smaller number tells.
        calibration: Of the raw cameras, for images of this size.

    Returns:
        Medians over all matches, or None where there are too few.
    """
    found = [shared_features(left, right, most=_FEATURES) for _, left, right in images.read(spread(images.numbers, PAIRS))]
    left, right = (np.concatenate(eye) for eye in zip(*found, strict=True))
    if len(left) < LEAST_MATCHES:
        return None
    straight = calibration.rectified_points(left, right)
    return tuple(float(np.median(np.abs(one[:, 1] - other[:, 1]))) for one, other in ((left, right), straight))  # pyright: ignore
