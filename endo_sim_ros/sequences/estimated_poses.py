"""Recordings whose poses are estimated from the images, and the ways to do so."""

import dataclasses
import functools
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.recording import OnProgress, Recording
from endo_sim_ros.sequences.rectification import AHEAD, Rectification
from endo_sim_ros.sequences.structure_from_motion import STRUCTURE_FROM_MOTION, StructureFromMotion, View, estimate_poses

logger = logging.getLogger(__name__)

T = TypeVar("T")

VGGT = "vggt"  # what the readers' option `poses` says to ask for it


def pose_estimator(poses: str) -> Callable[..., StructureFromMotion] | None:
    """What estimates poses by a name: `estimate_poses` of sfm, that with a network of vggt or vggt:FOLDER (of its checkpoint).

    None for any other text, as the name of a file.

    Raises:
        SequenceError: If the network has no checkpoint.
    """
    name, _, folder = poses.partition(":")
    if name == VGGT:
        from endo_sim_ros.sequences.vggt import estimate_poses_with_vggt, find_checkpoint  # needs torch

        find_checkpoint(folder)
        return functools.partial(estimate_poses_with_vggt, checkpoint=folder)
    return estimate_poses if poses == STRUCTURE_FROM_MOTION else None


def known_estimator(poses: str | None, source: Path) -> Callable[..., StructureFromMotion]:
    """As `pose_estimator`, structure from motion where None is given; any other text raises SequenceError, with the recording's path."""
    estimate = pose_estimator(STRUCTURE_FROM_MOTION if poses is None else poses)
    if estimate is None:
        raise SequenceError(f"{source}: poses must be {STRUCTURE_FROM_MOTION}, {VGGT} or {VGGT}:FOLDER, got {poses!r}")
    return estimate


def found_once(find: Callable[[OnProgress | None], T]) -> Callable[..., T]:
    """What takes long to find, and is found by the first call, with or without somebody to tell its progress to."""
    results: list[T] = []

    def found(on_progress: OnProgress | None = None) -> T:
        if not results:
            results.append(find(on_progress))
        return results[0]

    return found


def with_estimated_poses(
    recording: Recording,
    source: Path,
    poses: str | None,
    lacking: str,
    names: Sequence[str],
    *,
    scale: float | None = None,
    threads: int = -1,
    calibrated: bool = True,
) -> Recording:
    """Frames with unknown poses, which are estimated on first iteration.

    Args:
        recording: Its frames have any pose; stereo frames, or depth, make the result metric.
        source: Its file or folder, for messages.
        poses: How, see `pose_estimator`; None: by structure from motion, with a warning.
        lacking: What would have had the poses, for that.
        names: What messages call its frames.
        scale: Median depth of what is seen over all frames, metres, where these have one eye; None takes it from their depth, or guesses.
        threads: Of structure from motion, see `estimate_poses`.
        calibrated: Whether frames are undistorted and have their intrinsics. Those of one eye may be raw and have any: then intrinsics and
            distortion are estimated, too.

    Raises:
        SequenceError: If there is no such way.
    """
    estimate = known_estimator(poses, source)
    if poses is None:
        logger.warning("%s: no %s, so poses come from structure from motion", source, lacking)

    @found_once
    def estimated(on_progress: OnProgress | None) -> StructureFromMotion:
        logger.info("%s: estimating the poses of %s", source, counted(len(recording), "frame"))
        first = next(iter(recording))
        try:
            return estimate(
                (View(frame.image, frame.mask, frame.right, frame.depth) for frame in recording),
                first.camera.K if calibrated else None,
                baseline=first.baseline,
                scale=scale,
                threads=threads,
                count=len(recording),
                names=names,
                on_progress=on_progress,
            )
        except SequenceError as error:
            raise SequenceError(f"{source}: {error}") from None

    def posed() -> Iterator[Frame]:
        found, lens = estimated(), None
        for position, frame in enumerate(recording):
            if (pose := found.poses.get(position)) is None:
                continue
            if not calibrated:
                lens = lens or Rectification.mono(found.K, found.distortion, (frame.camera.width, frame.camera.height), source)
                frame = _undistorted(frame, lens)
            yield dataclasses.replace(frame, camera=frame.camera.at(pose))

    return Recording(posed, len(recording), lambda: estimated().points, prepare=estimated, source=recording.source)


def _undistorted(frame: Frame, lens: Rectification) -> Frame:
    """A raw frame of one eye, undistorted."""
    depth = None if frame.depth is None else lens.depth(frame.depth[..., None] * AHEAD)
    camera = Camera(lens.K, *lens.size, frame.camera.pose)
    return dataclasses.replace(frame, image=lens.left(frame.image), mask=lens.mask(frame.mask), depth=depth, camera=camera)
