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
from endo_sim_ros.sequences.recording import DEFAULT_FPS, FIRST_STAMP_NS, stamp_ns

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its lines name no file; errors here do. Set it to 48 to see them
logger = logging.getLogger(__name__)

_REORDERED = 16  # frames that a codec may store before or after their turn, at most
_LONGEST = 1e9  # seconds, of times that are believed
_LOOKED_AT = 25  # frames, a second: films that were made for television begin with whole pictures now and then
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg")


def find_video(folder: Path) -> Path | None:
    """The only video of a folder, or None when there is none."""
    videos = sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    if len(videos) > 1:
        names = ", ".join(p.name for p in videos)
        raise SequenceError(f"{folder}: more than one video ({names}); keep one there, or give the file and its calibration")
    return videos[0] if videos else None


class Video:
    """A video file, decoded forwards only, because seeking is inexact in most containers.

    Attributes:
        frame_count: Its frames; of a file that is cut off the number that it states.
        width, height: Pixels.
        pixel_aspect: Width of a pixel over its height, 1 where the file does not state it.
        turned: Whether the file asks for its pictures to be turned, which is done here.
        fps: Frames per second that it states; DEFAULT_FPS where that is none.
    """

    def __init__(self, path: Path):
        self.path, self._told = path, False
        if not path.is_file():
            raise SequenceError(f"{path}: file is missing")
        capture = self._open()
        stated = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        wide, high = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
        self.pixel_aspect = wide / high if wide > 0 and high > 0 else 1.0
        self.turned = capture.get(cv2.CAP_PROP_ORIENTATION_META) in (90, 180, 270)
        fps = capture.get(cv2.CAP_PROP_FPS)
        capture.release()
        self.fps = fps if math.isfinite(fps) and 0 < fps <= 1000 else DEFAULT_FPS
        if _is_interlaced(path):
            raise SequenceError(
                f"{path}: its pictures are marked as interlaced, two moments in alternate rows; make whole ones of them with "
                "`ffmpeg -i IN -vf bwdif=mode=send_frame -crf 15 OUT.mp4`"
            )
        times, packets, seconds = _packet_times(path, path.stat().st_mtime_ns)
        whole = packets >= stated or seconds * fps > stated - 1  # as the number is often a guess, from the length and the rate
        self.frame_count = len(times) if times and whole else stated
        if self.frame_count < 1 or self.width < 1 or self.height < 1:
            raise SequenceError(f"{path}: holds no video frames; the file is damaged, copy it again")
        self._stamps, self._on_times = self._uneven_stamps(times, whole)

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise SequenceError(
                f"{self.path}: not a readable video: damaged, cut off, only sound or of an unknown codec; copy it again or convert "
                "it to H.264"
            )
        return capture

    def _uneven_stamps(self, stored: Sequence[float | None], whole: bool) -> tuple[list[int] | None, tuple[int, str] | None]:
        """Times of exposure of the frames, nanoseconds, from those in the order in which they are stored; None where they are even.

        And how urgently something is to be said of them, as levels of logging have it, and what; None where nothing is.
        """
        times = np.array(stored, float)  # None becomes NaN
        order, numbers = np.argsort(times, kind="stable"), np.arange(len(times))
        after = times[order] - times[order[:1]]
        apart = np.diff(after)
        if not (len(times) and (after < _LONGEST).all() and (apart > 0).all() and (abs(order - numbers) <= _REORDERED).all()):
            said = f"{self.path}: the file has no usable times of its frames, which are stamped evenly, at {self.fps:g} Hz"
            return None, (logging.WARNING, said)
        off = abs(after - numbers / self.fps)[: None if whole else -_REORDERED]  # between the last before a cut some are missing
        if (off <= 0.5 / self.fps).all():  # the clock of a file is coarser than a constant rate
            return None, None
        said = f"{self.path}: its frames are {apart.min():.3f} to {apart.max():.3f} s apart, and stamped with the times in the file"
        return [FIRST_STAMP_NS + round(time * 1e9) for time in after], (logging.INFO, said)

    def stamp_ns(self, number: int, fps: float | None = None) -> int:
        """Time of exposure of a frame, nanoseconds, the first at one second: at a constant rate where one is given or the video has one.

        Raises:
            SequenceError: As the function of this name.
        """
        if fps is None and self._on_times:
            _log_once(*self._on_times)
        if fps is not None or self._stamps is None:
            return stamp_ns(number, fps or self.fps)
        last = len(self._stamps) - 1
        return self._stamps[min(number, last)] + round(max(number - last, 0) / self.fps * 1e9)

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
                        raise SequenceError(
                            f"{self.path}: frame {number} cannot be decoded: the video is damaged or of an unknown codec; copy it again or "
                            "convert it to H.264"
                        )
                    self._tell_end(position)
                    return
                position += 1
                yield number, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        finally:
            capture.release()

    def glimpses(self, numbers: Sequence[int]) -> list[np.ndarray]:
        """RGB images [H, W, 3] near some frames, none of a number that is exact: they are sought, not decoded up to."""
        capture, images = self._open(), []
        for number in numbers:
            capture.set(cv2.CAP_PROP_POS_FRAMES, number)
            ok, image = capture.read()
            if ok:
                images.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        capture.release()
        return images

    def _tell_end(self, position: int) -> None:
        """Warn, once, that no frame from this one on can be decoded."""
        if not self._told:
            lost, second = self.frame_count - position, 1e-9 * (self.stamp_ns(position) - FIRST_STAMP_NS)
            logger.warning(
                "%s: the video ends before frame %d, at %.1f s, and lacks %d of its %d frames; copy it again if it is cut off",
                self.path, position, second, lost, self.frame_count,
            )  # fmt: skip
            self._told = True


@functools.cache  # a recording is opened several times
def _log_once(level: int, text: str) -> None:
    logger.log(level, "%s", text)


def _is_interlaced(path: Path) -> bool:
    """Whether a picture at the beginning of a video is; OpenCV from 4.13 on gives memory as it was for such pictures, and no error."""
    import av.error  # which opens its libraries

    try:
        with av.open(str(path)) as container:
            return any(bool(frame.interlaced_frame) for frame in islice(container.decode(video=0), _LOOKED_AT))
    except (OSError, ValueError, IndexError, av.error.FFmpegError):  # OpenCV may read what it does not
        return False


@functools.cache  # a recording is opened several times, and all of a file is read
def _packet_times(path: Path, changed_ns: int) -> tuple[Sequence[float | None], int, float]:
    """Times of a video's frames in the order in which they are stored, how many are stored, and how long picture and sound are, seconds.

    Frames are not decoded. Those that a cut leaves in the file, but not in the video, are among those stored and have no time. The
    length is from the first frame where the file counts its frames, else from time 0, as guesses of their number have it.

    Args:
        path: Of the file.
        changed_ns: When it was changed last; it is read anew after a change.
    """
    import av.error  # which opens its libraries

    times, packets, end, counted = list[float | None](), 0, 0.0, False
    try:
        with av.open(str(path)) as container:
            video = container.streams.video[0]
            counted = video.frames > 0
            for packet in container.demux():
                if not packet.size:
                    continue
                tick = float(packet.time_base or 0)
                time = None if packet.pts is None else packet.pts * tick
                end = max(end, (time or 0.0) + (packet.duration or 0) * tick)
                if packet.stream.index == video.index:
                    packets += 1
                    if not packet.is_discard:
                        times.append(time)
    except (OSError, ValueError, IndexError, av.error.FFmpegError):  # OpenCV may read what it does not
        pass
    first = min((time for time in times if time is not None), default=0.0) if counted else 0.0
    return times, packets, end - first
