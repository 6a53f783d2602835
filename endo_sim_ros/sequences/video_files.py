"""Video files as recordings have them: decoded forwards, of one eye or with the eyes stacked."""

import functools
import logging
import math
import os
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.recording import DEFAULT_FPS

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its lines name no file; errors here do. Set it to 48 to see them
logger = logging.getLogger(__name__)

_LOOKED_AT, _REORDERED = 1000, 16  # frames whose times are compared, and of these the last, between which later ones may belong
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg")


def find_video(folder: Path) -> Path | None:
    """The only video of a folder, or None when there is none."""
    videos = sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    if len(videos) > 1:
        names = ", ".join(p.name for p in videos)
        raise SequenceError(f"{folder}: more than one video ({names}); keep one or pass the file itself")
    return videos[0] if videos else None


class Video:
    """A video file, decoded forwards only, because seeking is inexact in most containers."""

    def __init__(self, path: Path):
        self.path, self._told = path, False
        if not path.is_file():
            raise SequenceError(f"{path}: file is missing")
        capture = self._open()
        self.frame_count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        fps = capture.get(cv2.CAP_PROP_FPS)
        capture.release()
        self.fps = fps if math.isfinite(fps) and 0 < fps <= 1000 else DEFAULT_FPS
        if self.frame_count < 1 or self.width < 1 or self.height < 1:
            raise SequenceError(f"{path}: holds no video frames; the file is damaged, copy it again")

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise SequenceError(f"{self.path}: not a readable video; the file is damaged or its codec is unknown")
        return capture

    def frames(self, numbers: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        """RGB images [H, W, 3] of the given frame numbers, which must increase."""
        capture, position = self._open(), 0
        try:
            for done, number in enumerate(numbers):
                while position < number and capture.grab():
                    position += 1
                ok, image = capture.read() if position == number else (False, None)
                if not ok or image is None:
                    if not done:
                        raise SequenceError(f"{self.path}: frame {number} cannot be decoded; the video is damaged")
                    self._tell_end(position)
                    return
                position += 1
                yield number, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        finally:
            capture.release()

    def _tell_end(self, position: int) -> None:
        """Warn, once, that no frame from this one on can be decoded."""
        if not self._told:
            lost, second = self.frame_count - position, position / self.fps
            logger.warning(
                "%s: the video ends before frame %d, at %.1f s, and lacks %d of its %d frames; copy it again if it is cut off",
                self.path, position, second, lost, self.frame_count,
            )  # fmt: skip
            self._told = True


@functools.cache  # a recording is opened several times
def warn_of_uneven_times(path: Path) -> None:
    """Tell of a video whose first frames are not as far apart in time as one another: frames are stamped by their numbers."""
    import av  # which opens its libraries

    try:
        with av.open(str(path)) as container:
            packets = islice(container.demux(video=0), _LOOKED_AT)
            times = sorted(float(packet.pts * packet.time_base) for packet in packets if packet.pts is not None and packet.time_base)
    except (OSError, ValueError, IndexError):  # those of this library, too; OpenCV may read what it does not
        return
    apart = np.diff(times if len(times) < _LOOKED_AT else times[:-_REORDERED])
    if len(apart) and (apart.max() > 1.5 * np.median(apart) or apart.min() < 0.5 * np.median(apart)):
        logger.warning(
            "%s: its frames are %.3f to %.3f s apart, and are stamped as if they were even; convert it to a constant frame rate where "
            "breath or forces matter",
            path, apart.min(), apart.max(),
        )  # fmt: skip
