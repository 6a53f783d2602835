"""What all cells of a sequence share: frames, scene points, and the depth that they are measured against."""

import contextlib
import dataclasses
import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Sized
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import Progress
from scipy.spatial import KDTree

from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.core.words import counted
from endo_sim_ros.evaluation.cells import Cell
from endo_sim_ros.evaluation.sources import open_named, split_source
from endo_sim_ros.evaluation.splits import right_views, split_views
from endo_sim_ros.reconstruction import ReconstructionConfig, ScenePoints, scene_points, shrink
from endo_sim_ros.reconstruction.motion_watch import MotionWatch
from endo_sim_ros.reconstruction.priors.sources import estimate_depth
from endo_sim_ros.reconstruction.scene import TrainingView, unusable
from endo_sim_ros.reconstruction.still_frames import stilled
from endo_sim_ros.sequences.point_files import read_points
from endo_sim_ros.sequences.recording import Recording, StoredFrame, spread, store

log = logging.getLogger(__name__)

_POINT_VIEWS = 48  # views that structure from motion is done with
_HELD = 48  # frames in memory at a time while their depth is matched, which needs three times their size
_JUDGING = 10  # one scene point in so many judges depth where none was recorded
_FEWEST_JUDGES = 50  # with fewer, none does
_SAME_POINT = 0.1  # distance between two triangulations of one point, in distances between judging points


class Prepared(NamedTuple):
    """A sequence as all its cells use it: its frames are in files until they are needed."""

    count: int  # frames that show tissue; views are numbered by these
    frames: dict[int, StoredFrame]  # left images of the views in some split; those that none trains on have the size of measuring
    right: dict[int, StoredFrame]  # the right images as views, for the split of that name
    depth_source: str  # where the reference depth of the frames is from: recorded, stereo matching, or none
    points: ScenePoints  # of structure from motion with all views, like the poses
    still_points: ScenePoints  # the same of tissue in its mean position, where it moves
    motion: TissueMotion | None  # how the tissue moves by itself
    judging: np.ndarray | None  # [N, 3] m, world: points that judge depth and are kept from the methods; None: no judges

    def carried(self) -> "Prepared":
        """The same for another machine."""
        frames, right = ({number: frame.carried() for number, frame in views.items()} for views in (self.frames, self.right))
        return self._replace(frames=frames, right=right)


def prepare_sequence(cells: Sequence[Cell], bar: Progress, folder: Path) -> Prepared:
    """Read the sequence of these cells; what is the same for all of them is done here, once.

    A long one is read twice, first to count, then for the frames that some cell uses; no more than a few dozen are held.

    Args:
        cells: Cells of one sequence.
        bar: Shows what is done.
        folder: Empty; the frames are written to it.

    Raises:
        SequenceError: If the sequence cannot be read, or no view of it shows tissue.
    """
    source, stored, count = cells[0].source, {}, 0
    opened, splits = open_named(source), {cell.split for cell in cells}
    expected = len(opened) if isinstance(opened, Sized) else 0
    at_once = 0 < expected <= cells[0].most_held_out
    configs = [ReconstructionConfig.from_mapping(cell.options) for cell in cells]
    widest = max(config.widest for config in configs)
    watch = next((MotionWatch(config.watch, config.poses, config.matching) for config in configs if config.watch_motion), None)
    frames = _tissue(opened, bar, f"reading {cells[0].sequence}", expected)
    for frame in frames if watch is None else watch.watch(frames):
        if at_once:
            stored[count] = store(shrink(frame, widest), folder / str(count))
        count += 1
    if not count:
        raise SequenceError(
            f"{cells[0].sequence}: no view shows tissue; a mask has 255 where there is some, and dark pictures are masked whole"
        )
    trained, measured, paired = set(), set(), set()  # numbers of views; paired: whose right image is measured
    for split in splits:
        with contextlib.suppress(SequenceError):  # too few views for this one: its own cells say so
            parts = split_views(split, count, cells[0].most_held_out)
            trained.update(parts.train)
            (paired if parts.right else measured).update(parts.held_out)
    pointed = spread(range(count), _POINT_VIEWS)
    wanted = trained | measured | paired | set(pointed)
    if not at_once:
        for number, frame in enumerate(_tissue(opened, bar, f"reading {cells[0].sequence} again", expected, told=True)):
            if number in wanted:
                stored[number] = store(shrink(frame, widest), folder / str(number))
    if paired and not any(stored[number].paired for number in paired):
        log.warning("%s has no right images, so all of its cells with split stereo fail; leave that split out", cells[0].sequence)
    motion = None
    if watch is not None:
        motion, text = watch.found()
        log.info("%s: %s", cells[0].sequence, text)
        last = max(frame.stamp_ns for frame in stored.values())
        if motion is not None and last > 1e9 * (motion.end + motion.parts[0].period):
            log.warning("%s: it is left as it is, as only the first %.0f s were watched", cells[0].sequence, motion.end - motion.start)
            motion = None
    task = bar.add_task(f"scene points of {cells[0].sequence}", total=None)
    known = opened.points() if isinstance(opened, Recording) else read_points(split_source(source)[0])  # else a bag
    posed = lambda motion: scene_points([stilled(stored[number].load(), motion) for number in pointed], _POINT_VIEWS)
    points = ScenePoints.recorded(*known) if known else posed(None)
    still_points = points if known or motion is None else posed(motion)
    bar.remove_task(task)
    with_depth = [frame for frame in stored.values() if frame.depth]
    # As `depth_source` has it: depth of fewer frames than there are pairs, as that of a keyframe, would leave the others unjudged.
    recorded = len(with_depth) >= max(sum(frame.paired for frame in stored.values()), 1)
    recorded = recorded and any((frame.load().depth > 0).any() for frame in with_depth)
    judging = None
    if not recorded and motion is None:  # points of moving tissue judge nothing
        points, judging = divide_points(points)
        still_points = points
    width = max(cell.options["image_width"] for cell in cells)
    small = lambda frame: shrink(dataclasses.replace(frame, right=None, baseline=None, right_K=None), width)
    numbers, right, matched = sorted(stored), {}, False
    task = bar.add_task(f"depth of {cells[0].sequence}", total=len(numbers))
    for start in range(0, len(numbers), _HELD):
        some = numbers[start : start + _HELD]
        frames = [stored[number].load() for number in some]
        if any(frame.right is not None for frame in frames) and (paired or not recorded):
            views = estimate_depth([TrainingView.of(frame) for frame in frames], points, ReconstructionConfig(depth="stereo"))
            if both := {number: view for number, view in zip(some, views) if view.right is not None and number in paired}:
                for number, view in zip(both, right_views(list(both.values()))):
                    right[number] = store(shrink(view, width), folder / f"right-{number}")
            if not recorded:
                frames = [dataclasses.replace(frame, depth=_trusted(view)) for frame, view in zip(frames, views)]
                matched |= any(frame.depth is not None for frame in frames)
        for number, frame in zip(some, frames):
            stored[number] = store(frame if number in trained else small(frame), folder / str(number))
        bar.advance(task, len(some))
    bar.remove_task(task)
    depth_source = "recorded" if recorded else "stereo matching" if matched else "none"
    return Prepared(count, stored, right, depth_source, points, still_points, motion, judging)


def _tissue(frames: Iterable[Frame], bar: Progress, text: str, expected: int, told: bool = False) -> Iterator[Frame]:
    """Those of the frames that show tissue; says how many of them do not, unless that was told."""
    task, out = bar.add_task(text, total=expected or None), Counter()
    for frame in frames:
        bar.advance(task)
        if reason := unusable(frame):
            out[reason] += 1
        else:
            yield frame
    bar.remove_task(task)
    for reason, count in () if told else out.items():
        log.warning("%s left out: %s", counted(count, "frame"), reason)


def divide_points(points: ScenePoints) -> tuple[ScenePoints, np.ndarray | None]:
    """What the methods get, and the positions [N, 3] of the scene points that their depth is judged by; None of too few.

    A point that was triangulated twice does not count as two.
    """
    judging = np.unique(points.positions, axis=0)[::_JUDGING]
    if len(judging) < _FEWEST_JUDGES:
        return points, None
    tree = KDTree(judging)
    apart = np.median(tree.query(judging, k=2)[0][:, 1])
    kept = tree.query(points.positions)[0] > _SAME_POINT * apart
    error = np.asarray(points.error)
    return ScenePoints(points.positions[kept], points.colors[kept], error[kept] if error.ndim else points.error), judging


def _trusted(view: TrainingView) -> np.ndarray | None:
    """Matched depth [H, W] (m, 0 = none) where the disparity is above 10 pixels: half a pixel is 5 % of it. None if that is nowhere."""
    if view.depth_prior is None or view.baseline is None:
        return None
    trusted = np.where(view.depth_prior < view.camera.K[0, 0] * view.baseline / 10, view.depth_prior, 0)
    return trusted if trusted.any() else None
