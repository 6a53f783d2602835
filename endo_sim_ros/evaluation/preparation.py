"""What all cells of a sequence share: frames, scene points, and the depth that they are measured against."""

import contextlib
import dataclasses
from collections.abc import Sequence, Sized
from typing import NamedTuple

import numpy as np
from rich.progress import Progress
from scipy.spatial import KDTree

from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.evaluation.cells import Cell
from endo_sim_ros.evaluation.sources import open_named, split_source
from endo_sim_ros.evaluation.splits import STEREO, right_views, split_views
from endo_sim_ros.reconstruction import ReconstructionConfig, ScenePoints, scene_points, shrink
from endo_sim_ros.reconstruction.priors.sources import estimate_depth
from endo_sim_ros.reconstruction.scene import TrainingView
from endo_sim_ros.sequences.folder import read_points
from endo_sim_ros.sequences.recording import Recording

_POINT_VIEWS = 48  # views that structure from motion is done with
_JUDGING = 10  # one scene point in so many judges depth where none was recorded
_FEWEST_JUDGES = 50  # with fewer, none does
_SAME_POINT = 0.1  # distance between two triangulations of one point, in distances between judging points


class Prepared(NamedTuple):
    """A sequence as all its cells use it."""

    frames: list[Frame]  # left images; those that no split trains on have the size at which they are measured
    right: list[Frame]  # the right images as views, for the split of that name
    depth_source: str  # where the reference depth of the frames is from: recorded, stereo matching, or none
    points: ScenePoints  # of structure from motion with all views, like the poses
    judging: np.ndarray | None  # [N, 3] m, world: points that judge depth and are kept from the methods; None: no judges


def prepare_sequence(cells: Sequence[Cell], bar: Progress) -> Prepared:
    """Read the sequence of these cells; what is the same for all of them is done here, once."""
    source = cells[0].source
    frames, opened = [], open_named(source)
    task = bar.add_task(f"reading {cells[0].sequence}", total=len(opened) if isinstance(opened, Sized) else None)
    for frame in opened:
        frames.append(frame)
        bar.advance(task)
    bar.remove_task(task)
    frames = [frame for frame in frames if frame.mask is None or frame.mask.any()]
    splits = {cell.split for cell in cells}
    trained: set[int] = set()
    for split in splits:
        with contextlib.suppress(SequenceError):  # too few views for this one: its own cells say so
            trained.update(split_views(split, len(frames)).train)
    task = bar.add_task(f"scene points of {cells[0].sequence}", total=None)
    known = opened.points() if isinstance(opened, Recording) else read_points(split_source(source)[0])  # else a bag
    points = ScenePoints.recorded(*known) if known else scene_points(frames, _POINT_VIEWS)
    bar.remove_task(task)
    depth_source, matched, judging = "none", frames, None
    recorded = any(frame.depth is not None and (frame.depth > 0).any() for frame in frames)
    if not recorded:
        points, judging = divide_points(points)
    if any(frame.right is not None for frame in frames) and (STEREO in splits or not recorded):
        task = bar.add_task(f"stereo matching of {cells[0].sequence}", total=None)
        views = estimate_depth([TrainingView.of(frame) for frame in frames], points, ReconstructionConfig(depth="stereo"))
        matched = [dataclasses.replace(view, depth=view.depth_prior) for view in views]
        bar.remove_task(task)
    if recorded:
        depth_source = "recorded"
    elif matched is not frames:
        frames = [dataclasses.replace(frame, depth=_trusted(match)) for frame, match in zip(frames, matched)]
        if any(frame.depth is not None for frame in frames):
            depth_source = "stereo matching"
    width = max(cell.options["image_width"] for cell in cells)
    paired = STEREO in splits and any(frame.right is not None for frame in frames)
    right = [shrink(frame, width) for frame in right_views(matched)] if paired else []
    small = lambda frame: shrink(dataclasses.replace(frame, right=None, baseline=None, right_K=None), width)
    return Prepared([f if i in trained else small(f) for i, f in enumerate(frames)], right, depth_source, points, judging)


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


def _trusted(frame: Frame) -> np.ndarray | None:
    """Matched depth [H, W] (m, 0 = none) where the disparity is above 10 pixels: half a pixel is 5 % of it. None if that is nowhere."""
    if frame.depth is None or frame.baseline is None:
        return None
    trusted = np.where(frame.depth < frame.camera.K[0, 0] * frame.baseline / 10, frame.depth, 0)
    return trusted if trusted.any() else None
