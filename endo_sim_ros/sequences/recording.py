"""A recording, read lazily: which of its frames are taken, and when each was exposed."""

import itertools
import logging
import pickle
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.eyes import with_eyes_checked

logger = logging.getLogger(__name__)

DEFAULT_FPS = 25.0  # of the datasets whose files do not state it
FIRST_STAMP_NS = 1_000_000_000  # a ROS stamp of 0 means "unset", so recordings begin at one second
_LARGEST = 1e9  # of options that are above 0: two frames of a higher rate would have one stamp
_FARTHEST = 1e5  # m from the origin, or units; positions in millimetres reach some thousands
_STAMPS_END_NS = 2**31 * 10**9  # a ROS stamp counts seconds in 32 bits

T = TypeVar("T")

OnProgress = Callable[[str, int, int], None]
"""``on_progress(stage, done, total)``; total is 0 where it is unknown."""


@dataclass(frozen=True)
class Recording:
    """A sequence of frames read lazily: every `iter()` reads the files again from the beginning, and checks which eye is which.

    Args:
        frames: Begins to read.
        count: Number of frames expected, for progress bars; a damaged video or a frame that structure from motion could
            not place makes the iteration shorter. 0 = unknown.
        points: Returns scene points [N, 3] (m, world of the frames) and their RGB [N, 3] in [0, 1], of structure from motion, or None.
        prepare: Does what takes long before the first frame, telling its progress, unless it is done; otherwise the first
            iteration does it silently. None where nothing takes long.
        source: What left and right images are read from, for messages.
    """

    frames: Callable[[], Iterator[Frame]]
    count: int
    points: Callable[[], tuple[np.ndarray, np.ndarray] | None] = lambda: None
    prepare: Callable[[OnProgress], object] | None = None
    source: Path | str = ""

    def __iter__(self) -> Iterator[Frame]:
        return with_eyes_checked(self.frames(), self.source)

    def __len__(self) -> int:
        return self.count

    def take(self, positions: Container[int], count: int) -> "Recording":
        """The frames at these positions alone, so many; the others are read again, but not held."""
        chosen = lambda: (frame for position, frame in enumerate(self.frames()) if position in positions)
        return Recording(lambda: itertools.islice(chosen(), count), count, source=self.source)


class Glance(NamedTuple):
    """What is kept of a frame whose images are not: there may be ten thousand."""

    stamp_ns: int
    camera: Camera
    tissue: bool  # whether the mask leaves any

    @classmethod
    def at(cls, frame: Frame) -> "Glance":
        """Of a frame."""
        return cls(frame.stamp_ns, frame.camera, frame.mask is None or bool(frame.mask.any()))


def survey(frames: Iterable[Frame], sample: int) -> tuple[list[Glance], list[Frame]]:
    """A glance at every frame, and some of those with tissue, evenly spread: `sample` to twice as many where there are enough.

    No more than these are held.
    """
    glances, held, step, shown = [], [], 1, 0
    for frame in frames:
        glances.append(Glance.at(frame))
        if not glances[-1].tissue:
            continue
        if shown % step == 0:
            held.append(frame)
        if len(held) > 2 * sample:
            held, step = held[::2], 2 * step
        shown += 1
    return glances, held


@dataclass(frozen=True, eq=False)
class StoredFrame:
    """A frame in a file of this machine."""

    stamp_ns: int
    camera: Camera
    depth: bool  # whether it has any
    paired: bool  # whether it has a right image
    file: Path
    content: bytes = b""  # of the file, where there is none

    def load(self) -> Frame:
        """The frame."""
        return pickle.loads(self.content or self.file.read_bytes())

    def carried(self) -> "StoredFrame":
        """The same for another machine."""
        return replace(self, content=self.file.read_bytes())


def store(frame: Frame, file: Path) -> StoredFrame:
    """Write a frame to a file, from which it is read again when it is needed."""
    with file.open("wb") as out:
        pickle.dump(frame, out, pickle.HIGHEST_PROTOCOL)
    return StoredFrame(frame.stamp_ns, frame.camera, frame.depth is not None, frame.right is not None, file)


def stamp_ns(number: int, fps: float) -> int:
    """Time of exposure of a frame number, nanoseconds; frame 0 is at one second.

    Raises:
        SequenceError: If it is later than a ROS stamp can be.
    """
    after = number / fps * 1e9
    if not after < _STAMPS_END_NS - FIRST_STAMP_NS:  # as round() knows no infinity
        raise SequenceError(f"frame {number} at {fps:g} Hz comes after 68 years, which no ROS stamp can say; number frames from 0")
    return round(after) + FIRST_STAMP_NS


def check_positive(source: Path | str, **values: float | None) -> None:
    """Raise SequenceError if one of the options that are given is not above 0, or larger than any recording has."""
    for name, value in values.items():
        if value is not None and not 0 < value <= _LARGEST:
            raise SequenceError(f"{source}: {name} must be above 0 and at most {_LARGEST:g}, got {value:g}")


def check_folder(path: Path | str, **positive: float | None) -> Path:
    """The path of a folder.

    Raises:
        SequenceError: If there is none, or it is a file, or one of the options that are given is not a positive number.
    """
    path = Path(path)
    if path.is_file():
        raise SequenceError(f"{path}: a file, but recordings of this kind are folders; pass the folder, or let --kind be auto")
    if not path.is_dir():
        raise SequenceError(f"{path}: no such folder; pass the folder of the recording")
    check_positive(path, **positive)
    return path


def select(numbers: Iterable[int], source: Path, start: int | None, stop: int | None, step: int) -> list[int]:
    """Every step-th of the frame numbers in [start, stop), in increasing order."""
    if step < 1:
        raise SequenceError(f"{source}: step must be 1 or more, got {step}")
    inside = sorted(n for n in numbers if (start is None or n >= start) and (stop is None or n < stop))
    if not inside:
        raise SequenceError(f"{source}: no frame between start={start} and stop={stop}; widen the range")
    return inside[::step]


def keep_posed(numbers: list[int], poses: Mapping[int, np.ndarray], pose_file: Path, lag: int = 0) -> list[int]:
    """The frame numbers that have a pose; the others are counted in the log, in a warning if they are more than half.

    Args:
        numbers: Frames that are asked for.
        poses: Poses, or what they are made from, by frame number.
        pose_file: Where they are from.
        lag: The file has that of frame n under the number n − lag.

    Raises:
        SequenceError: If there are none, or the pose of one is not finite.
    """
    posed = [n for n in numbers if n in poses]
    if not posed:
        held = f"; it holds those of {min(poses) - lag} to {max(poses) - lag}" if poses else ""
        chosen = f"{counted(len(numbers), 'chosen frame')}, {numbers[0]} to {numbers[-1]}" + (f" with a lag of {lag}" if lag else "")
        raise SequenceError(f"{pose_file}: holds no pose for any of the {chosen}{held}")
    refuse_unusable({n - lag: poses[n] for n in posed}, pose_file)
    if len(posed) < len(numbers):
        level = logging.INFO if 2 * len(posed) >= len(numbers) else logging.WARNING  # some are usual, most a wrong file or numbering
        logger.log(level, "%s: skipped, without a pose: %d of %s", pose_file, len(numbers) - len(posed), counted(len(numbers), "frame"))
        if not lag:
            tell_other_numbering(numbers, poses, pose_file)
    return posed


def tell_other_numbering(numbers: Sequence[int], poses: Collection[int], pose_file: Path) -> None:
    """Warn where images lack poses because they seem to be counted from 0 and poses from 1, or the other way round."""
    shift = min(poses) - numbers[0]
    lacking = any(number not in poses for number in numbers)
    if lacking and abs(shift) == 1 and all(number + shift in poses for number in numbers):
        logger.warning(
            "%s: its numbers begin with %d, those of the images with %d: if the first pose is that of the first image, each frame has the "
            "pose of another one; number both alike",
            pose_file, min(poses), numbers[0],
        )  # fmt: skip


def refuse_unusable(poses: Mapping[int, np.ndarray], pose_file: Path) -> None:
    """Raise SequenceError if one of the poses, by their numbers in a file, is not finite, or too far from the origin to compute with."""
    wrong = next((number for number, pose in poses.items() if not np.isfinite(pose).all()), None)
    if wrong is not None:
        raise SequenceError(f"{pose_file}: number {wrong} is not a pose; expected a finite position and a rotation; correct or remove it")
    matrices = {number: pose for number, pose in poses.items() if pose.shape == (4, 4)}
    far = {number: float(np.linalg.norm(pose[:3, 3])) for number, pose in matrices.items()}
    if far and (most := max(far.values())) > _FARTHEST:
        raise SequenceError(
            f"{pose_file}: number {max(far, key=far.__getitem__)} is {most:g} m from the origin, where single precision tells no "
            "centimetres; subtract a place near the tissue from all positions, check their unit, or correct or remove it"
        )


def tell_beyond(rows: Collection[int], last: int, pose_file: Path, usual: float = 0.5) -> None:
    """Log how many rows of poses are after the last frame, in a warning if they are a larger share than is usual."""
    if beyond := sum(row > last for row in rows):
        many = beyond > usual * len(rows)
        logger.log(
            logging.WARNING if many else logging.INFO,
            "%s: %d of %s are after the last frame, %d%s",
            pose_file, beyond, counted(len(rows), "row"), last, ": poses of another sequence, or a part of the images?" if many else "",
        )  # fmt: skip


def tell_lacking(numbers: Sequence[int], files: Container[int], folder: Path, so: str) -> None:
    """Log how many of the frames have no file in a folder of masks or depth, and which; nothing where there is no such folder.

    Args:
        numbers: Of the frames.
        files: Numbers of the files.
        folder: Where they are.
        so: What comes of it.
    """
    lacking = [number for number in numbers if number not in files]
    if lacking and folder.is_dir():
        named = ", ".join(map(str, lacking[:3])) + (" and others" if len(lacking) > 3 else "")
        text = "%s: no image there for %d of %s (%s): %s"
        logger.warning(text, folder, len(lacking), counted(len(numbers), "frame"), named, so)


def spread(items: Sequence[T], count: int) -> list[T]:
    """At most count items, evenly spread from the first to the last."""
    if len(items) <= count:
        return list(items)
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, count)]
