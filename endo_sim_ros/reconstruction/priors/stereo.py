"""Depth by matching the right image of a stereo pair, with what its calibration leaves wrong corrected."""

import dataclasses
import logging
from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from endo_sim_ros.core.features import agreeing, detect, match_pair
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import AnyFrame, ScenePoints, pixels_of, shrink
from endo_sim_ros.reconstruction.stage_configs import MatchingConfig, StereoConfig
from endo_sim_ros.sequences.eyes import shared_features
from endo_sim_ros.sequences.masks import lit_area
from endo_sim_ros.sequences.recording import spread

log = logging.getLogger(__name__)

_LOOKED_AT = 4  # pairs, whose features tell how near tissue is
_NEAR = 90  # percentile of their disparities: a tenth of the features may be wrong
_MARGIN = 1.5  # how many times as large disparities beside them may be
_ROWS_AT = 320  # pixels, the width of images that tell whether rows are apart
_NEAREST = 0.001  # m, the least that `StereoConfig.nearest` takes: nothing nearer is drawn


def stereo_depth(
    views: Sequence[AnyFrame],
    points: ScenePoints,
    options: StereoConfig = StereoConfig(),
    matching: MatchingConfig = MatchingConfig(),
    progress: StageProgress = StageProgress(),
    motion: TissueMotion | None = None,
) -> list[tuple[AnyFrame, np.ndarray | None]]:
    """Each view, now with the right eye's principal point as its matches tell it, and its depth [H, W] float32.

    Depth is in metres, 0 = none; None without a right image.

    Args:
        views: Best at full size: disparities are as precise as the pixels are fine.
        points: Scene points, to find a constant offset of the disparity.
        options: How to match and what to believe.
        matching: Features by which rows are aligned, and how many points tell an offset.
        progress: Reported to by views.
        motion: How the tissue moves in them; points are in their mean positions.
    """
    options = _as_near_as_features(views, options, matching)
    aligned = progress.map(lambda view: view if view.right is None else align_rows(view, options, matching), views)
    # Those of all views are held as they were matched, in half the memory.
    matched = progress.map(lambda view: None if view.right is None else _matched(view, options), aligned)
    disparity = lambda view, found: None if found is None else _in_pixels(found, view)
    offsets = disparity_offsets(aligned, map(disparity, aligned, matched), points, options, matching, motion)

    def with_depth(i: int) -> tuple[AnyFrame, np.ndarray | None]:
        view, offset, found = aligned[i], offsets[i], disparity(aligned[i], matched[i])
        matched[i] = None
        if found is None:
            return view, None
        return _with_right_K(view, column=offset), disparity_to_depth(view, found, offset, options).astype(np.float32)

    return progress.map(with_depth, range(len(views)))


def of_other_moments(
    views: Sequence[Frame],
    options: StereoConfig = StereoConfig(),
    matching: MatchingConfig = MatchingConfig(),
    progress: StageProgress = StageProgress(),
) -> list[bool]:
    """Whether each view's right image is of another moment than its left one: the lens has moved, and with it the rows.

    That is so where more than half of the features lie more than `StereoConfig.max_row_offset` from the rows that pairs have in common.
    Where that holds for more than half of the pairs, all of them are: some moments look alike. A pair that is not rectified passes for
    such a one.
    """

    def lower(view: Frame) -> np.ndarray:  # by which share of the image's height
        view = shrink(view, _ROWS_AT)
        if view.right is None:
            return np.empty(0)
        # Of smooth tissue most matches may be wrong, and on any rows; those of another moment agree with one motion.
        left, right = agreeing(*shared_features(view.image, view.right, view.mask), matching.min_points)
        return (right - left)[:, 1] / view.camera.height

    rows = {i: each for i, each in enumerate(progress.map(lower, views)) if len(each) >= matching.min_points}
    usual = np.median([np.median(each) for each in rows.values()]) if rows else 0.0
    apart = {i for i, each in rows.items() if np.median(np.abs(each - usual)) > options.max_row_offset}
    return [view.right is not None and (i in apart or 2 * len(apart) > len(rows)) for i, view in enumerate(views)]


def right_view(frame: Frame, options: StereoConfig = StereoConfig()) -> Frame:
    """The right image of a stereo frame as a view of its own, without depth."""
    assert frame.right is not None
    mask = lit_area([frame.right])
    if frame.mask is not None:
        # Tools of the left image lie farther to the left, by any of the disparities that there are.
        tools = (frame.mask == 0) & (lit_area([frame.image]) > 0)
        farthest = int(options.max_disparity * frame.camera.width)
        mask[cv2.dilate(tools.astype(np.uint8), np.ones((1, farthest + 1), np.uint8), anchor=(0, 0)) > 0] = 0
    return Frame(frame.stamp_ns, frame.right, frame.right_camera, mask=mask)


def align_rows(view: AnyFrame, options: StereoConfig = StereoConfig(), matching: MatchingConfig = MatchingConfig()) -> AnyFrame:
    """The view with the right eye's principal point on the row that matched features tell: rectification is seldom that good."""
    shifts = row_shifts(view, options, matching)
    if len(shifts) < matching.min_points:
        return view
    return _with_right_K(view, row=float(np.median(shifts)) + view.camera.K[1, 2] - view.right_intrinsics[1, 2])


def row_shifts(view: Frame, options: StereoConfig = StereoConfig(), matching: MatchingConfig = MatchingConfig()) -> np.ndarray:
    """By how many rows each feature [N] that both eyes see lies lower in the right image; smooth tissue has few of them."""
    left, right = _features(view, options, matching)
    return right[:, 1] - left[:, 1]


def _features(view: Frame, options: StereoConfig, matching: MatchingConfig) -> tuple[np.ndarray, np.ndarray]:
    """Features [N, 2] in the left image and where they are in the right one, pixels."""
    assert view.right is not None
    count = matching.max_features
    left, right = match_pair(detect(view.image, view.mask, count), detect(view.right, None, count), matching.ratio)
    kept = np.abs(right[:, 1] - left[:, 1]) < options.max_row_offset * view.camera.height
    return left[kept], right[kept]


def _as_near_as_features(views: Sequence[Frame], options: StereoConfig, matching: MatchingConfig) -> StereoConfig:
    """The options, with a smaller `nearest` where features of some pairs lie nearer."""
    nearest = options.nearest
    for view in spread([view for view in views if view.right is not None], _LOOKED_AT):
        left, right = _features(view, options, matching)
        disparity = left[:, 0] - right[:, 0] - _shift(view)
        if len(disparity) >= matching.min_points and (most := float(np.percentile(disparity, _NEAR))) > 0:
            nearest = min(nearest, view.camera.K[0, 0] * view.baseline / (_MARGIN * most))
    nearest = max(nearest, _NEAREST)
    if nearest < options.nearest:
        text = "features of stereo pairs lie nearer than %g mm: tissue is searched for from %.2g mm on"
        log.info(text, 1e3 * options.nearest, 1e3 * nearest)
    return dataclasses.replace(options, nearest=nearest)


def stereo_disparity(frame: Frame, options: StereoConfig = StereoConfig()) -> np.ndarray:
    """Disparity [H, W] float32 in pixels (0 = none) of a rectified pair by semi-global matching, checked both ways.

    A difference of the principal points of the two eyes is removed, so that disparity = fx·B/z; rows move by whole pixels.
    """
    return _in_pixels(_matched(frame, options), frame)


def _in_pixels(matched: np.ndarray, frame: Frame) -> np.ndarray:
    """Disparity [H, W] float32 in pixels of one as it was matched, without the difference of the principal points."""
    return np.where(matched > 0, np.maximum(matched / np.float32(16) - np.float32(_shift(frame)), 0), np.float32(0))


def _shift(frame: Frame) -> float:
    """Difference of the principal points of the two eyes, pixels."""
    return frame.camera.K[0, 2] - frame.right_intrinsics[0, 2]


def _matched(frame: Frame, options: StereoConfig) -> np.ndarray:
    """Disparity [H, W] int16 as it is matched, with the difference of the principal points, in sixteenths of a pixel; 0 = none."""
    assert frame.right is not None
    fx, width = frame.camera.K[0, 0], frame.camera.width
    levels = int(np.ceil((fx * frame.baseline / options.nearest + abs(_shift(frame))) / 16)) * 16  # the matcher takes multiples of 16
    levels = min(levels, max(width // 2 // 16, 1) * 16)
    # Penalties as OpenCV recommends for blocks of 5 × 5 pixels.
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=levels, blockSize=5, P1=8 * 25, P2=32 * 25, uniquenessRatio=5,
        speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    # The matcher skips as many columns on the left as it has levels: let those be padding.
    pad = lambda image: cv2.copyMakeBorder(image, 0, 0, levels, 0, cv2.BORDER_REPLICATE)
    match = lambda a, b: matcher.compute(pad(a), pad(b))[:, levels:].astype(np.float32) / 16
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (frame.image, frame.right))
    rows = round(frame.right_intrinsics[1, 2] - frame.camera.K[1, 2])
    right = right[np.clip(np.arange(len(right)) + rows, 0, len(right) - 1)] if rows else right
    disparity = match(left, right)
    # The right image's own disparity, by matching the mirrored pair, must lead back to the same pixel.
    back = match(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]))[:, ::-1]
    columns = np.arange(width) - disparity.round().astype(int)
    back = np.take_along_axis(back, columns.clip(0, width - 1), 1)
    valid = (disparity > 0) & (columns >= 0) & (np.abs(back - disparity) <= 1)
    # What is left of wrong matches are islands.
    sixteenths = np.where(valid, 16 * disparity, 0).astype(np.int16)
    cv2.filterSpeckles(sixteenths, 0, int(options.min_area * disparity.size), 16)
    return sixteenths


def disparity_offsets(
    frames: Sequence[Frame],
    disparities: Iterable[np.ndarray | None],
    points: ScenePoints,
    options: StereoConfig = StereoConfig(),
    matching: MatchingConfig = MatchingConfig(),
    motion: TissueMotion | None = None,
) -> np.ndarray:
    """Constants [V] to add to the stereo disparities (pixels) of views so that they agree with scene points.

    A wrong principal point of one eye shifts every disparity by the same amount, an error of the poses or the baseline
    those of one view. A view has an offset of its own where it sees points enough; all are zero when too few points are
    seen, when their common offset is within the scatter that explains it by chance, or so large that the poses must be
    wrong. A point that is off by that much in a view is hidden from it, or has moved, and does not count there; others
    count the less the farther a pixel's error moves them.
    """
    none, noise = np.zeros(len(frames)), options.disparity_error
    points_at = points.moved_by(motion)
    residuals, weights, some = [np.empty(0)] * len(frames), [np.empty(0)] * len(frames), [np.empty(0)]
    for i, (frame, disparity) in enumerate(zip(frames, disparities)):
        if disparity is None or not len(points.positions):
            continue
        some.append(disparity[::8, ::8].ravel())  # all of many views would take gigabytes
        index, v, u, z = pixels_of(frame.camera, points_at(frame.stamp_ns).positions)
        measured, expected = disparity[v, u], frame.camera.K[0, 0] * frame.baseline / z
        error = np.broadcast_to(points.error, len(points.positions))[index]
        residuals[i] = (expected - measured)[measured > 0]
        weights[i] = (1 / (noise**2 + (error * expected) ** 2))[measured > 0]
    residual, weight = np.concatenate(residuals), np.concatenate(weights)
    if len(residual) < matching.min_points:
        return none
    seen = np.concatenate(some)
    offset, typical = _weighted_median(residual, weight), float(np.median(seen[seen > 0]))
    if abs(offset) > options.max_offset * typical:
        text = "stereo disparity, %.1f pixels, and the poses are %.1f pixels apart: left so; check poses, their scale and the baseline"
        log.warning(text, typical, abs(offset))
        return none
    near = [np.abs(r) < options.max_offset * typical for r in residuals]
    residuals, weights = ([values[those] for values, those in zip(each, near)] for each in (residuals, weights))
    residual, weight = np.concatenate(residuals), np.concatenate(weights)
    offset = _weighted_median(residual, weight)
    spread = 1.4826 * _weighted_median(np.abs(residual - offset), weight)
    # A quarter of a pixel is as good as none.
    if abs(offset) < max(0.25, 3 * spread * np.sqrt((weight**2).sum()) / weight.sum()):
        return none
    worth = [w.sum() * noise**2 for w in weights]  # in points of no error
    offsets = [_weighted_median(r, w) if n > options.own_offset_points else offset for r, w, n in zip(residuals, weights, worth)]
    text = "stereo disparity shifted by %.2f pixels to agree with the poses (%d points, scatter %.2f; views %.2f to %.2f)"
    log.info(text, offset, len(residual), spread, min(offsets), max(offsets))
    return np.array(offsets)


def disparity_to_depth(frame: Frame, disparity: np.ndarray, offset: float = 0.0, options: StereoConfig = StereoConfig()) -> np.ndarray:
    """Depth [H, W] (m, 0 = none) of a disparity [H, W] (pixels, 0 = none) to which an offset is added."""
    corrected = np.where(disparity > 0, disparity + offset, 0)
    depth = frame.camera.K[0, 0] * frame.baseline / np.maximum(corrected, options.min_disparity)
    return np.where(corrected > options.min_disparity, depth, 0)


def _with_right_K(view: AnyFrame, column: float = 0.0, row: float = 0.0) -> AnyFrame:
    """The view with the right eye's principal point moved by so many pixels."""
    K = view.right_intrinsics.copy()
    K[:2, 2] += column, row
    return dataclasses.replace(view, right_K=K)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)])
