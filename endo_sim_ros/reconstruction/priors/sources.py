"""Depth priors: one depth image per training view, in metres, from whatever the recording offers."""

import dataclasses
import logging

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import map_in_threads, pick_device
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.priors.interpolation import kept_in_range, kriged, plane_through
from endo_sim_ros.reconstruction.priors.network import cached_checkpoint, load_network, network_depth
from endo_sim_ros.reconstruction.triangulation import ScenePoints, points_in_view
from endo_sim_ros.sequences.masks import lit_area

log = logging.getLogger(__name__)

_NEAREST = 0.02  # metres; closer than an endoscope works
_MIN_POINTS = 30  # points needed to trust an offset or an interpolation
_MOST_OFFSET = 0.3  # of the disparities: more is no principal point
_MANY_POINTS = 100  # needed for an offset of one view
_LEAST_DISPARITY = 2.0  # pixels; farther away half a pixel is more than a quarter of the depth
_ISLAND = 0.003  # share of the image, below which a patch of disparity that is like none around it is no surface
MATCHED = 0.5  # pixels, error of a disparity
_SPARSE = 16  # pixels between stereo matches that a network's depth is held against
_FEATURES = 3000  # matched to find by how much the right image lies too high or too low
_WIDEST_PARALLAX = 0.1  # of the image's width, between the eyes
_ROWS = 0.01  # of the image's height: the farthest that it may


def with_depth_prior(frames: list[Frame], points: ScenePoints, config: ReconstructionConfig) -> list[Frame]:
    """The frames with ``depth`` set to the configured prior, or None where there is none.

    The prior is 0 where it has no finite positive measurement and where the mask says that there is no tissue. Where the
    right eye's principal point turns out to be wrong, the frames have it right.

    Args:
        frames: Training views, best at full size: disparities are as precise as the pixels are fine.
        points: Triangulated scene points, to interpolate between, or to find a constant disparity offset of stereo matching.
        config: ``depth`` names the source; ``auto`` takes the depth topic, else stereo, else a network if there is one,
            else the points.

    Raises:
        SequenceError: If the source asked for is not in the recording.
    """
    source = depth_source(frames, config)
    if source == "topic" and not _has_topic(frames):
        raise SequenceError("depth=topic, but no view has a depth image; publish endoscope/left/depth or use auto")
    if source == "stereo" and all(frame.right is None for frame in frames):
        raise SequenceError("depth=stereo, but no view has a right image; publish endoscope/right/* or use depth=auto")
    if source == "none":
        return [dataclasses.replace(frame, depth=None) for frame in frames]
    if source == "points":
        frames = map_in_threads(lambda frame: _with_depth(frame, interpolated_depth(frame, points.positions)), frames)
        without = sum(frame.depth is None for frame in frames)
        if without:
            log.warning("%d of %d views see fewer than %d scene points that agree and go without depth", without, len(frames), _MIN_POINTS)
        return frames
    if source == "topic":
        return [_with_depth(frame, frame.depth) for frame in frames]
    if source == "network":
        network = load_network(config.depth_model, pick_device(config.device))
        frames = [_with_depth(frame, network_depth(frame, network, _known_depths(frame, points.positions))) for frame in frames]
        if all(frame.depth is None for frame in frames):
            raise SequenceError(
                "depth=network, but no view's depth fits the scene points; check the poses, give views that overlap, or use depth=points"
            )
        return frames
    frames = map_in_threads(lambda frame: frame if frame.right is None else _aligned(frame), frames)
    disparities = map_in_threads(lambda frame: None if frame.right is None else stereo_disparity(frame), frames)
    offsets = disparity_offsets(frames, disparities, points)
    frames = [_with_depth(f, None if d is None else _to_depth(f, d, offset)) for f, d, offset in zip(frames, disparities, offsets)]
    return [frame if frame.right is None else _with_right_shifted(frame, offset) for frame, offset in zip(frames, offsets)]


def right_camera(frame: Frame) -> Camera:
    """The camera of a stereo frame's right eye."""
    pose = frame.camera.pose.copy()
    pose[:3, 3] += frame.baseline * pose[:3, 0]
    return dataclasses.replace(frame.camera, K=frame.camera.K if frame.right_K is None else frame.right_K, pose=pose)


def right_view(frame: Frame) -> Frame:
    """The right image of a stereo frame as a view of its own, without depth."""
    mask = lit_area([frame.right])
    if frame.mask is not None:
        # Tools of the left image lie farther to the left, by any of the disparities that there are.
        tools = (frame.mask == 0) & (lit_area([frame.image]) > 0)
        farthest = int(_WIDEST_PARALLAX * frame.camera.width)
        mask[cv2.dilate(np.uint8(tools), np.ones((1, farthest + 1), np.uint8), anchor=(0, 0)) > 0] = 0
    return Frame(frame.stamp_ns, frame.right, right_camera(frame), mask=mask)


def depth_source(frames: list[Frame], config: ReconstructionConfig) -> str:
    """Where the depth of these views is from: the source that is configured, or what ``auto`` finds."""
    if config.depth != "auto":
        return config.depth
    network = config.depth_model or cached_checkpoint()
    return "topic" if _has_topic(frames) else "stereo" if any(f.right is not None for f in frames) else "network" if network else "points"


def _has_topic(frames: list[Frame]) -> bool:
    return any(frame.depth is not None and (frame.depth > 0).any() for frame in frames)


def _aligned(frame: Frame) -> Frame:
    """The frame with its right image moved up or down by whole pixels, and that eye's principal point by what it takes to
    put matched features on the rows where the left image has them: rectification is seldom that good."""
    sift = cv2.SIFT_create(nfeatures=_FEATURES, contrastThreshold=0.01)
    features = lambda image, mask: sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), mask)
    (left, first), (right, second) = features(frame.image, frame.mask), features(frame.right, None)
    if first is None or second is None or len(second) < 2:
        return frame
    matches = [m for m, n in cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2) if m.distance < 0.75 * n.distance]
    shifts = np.array([right[m.trainIdx].pt[1] - left[m.queryIdx].pt[1] for m in matches])
    shifts = shifts[np.abs(shifts) < _ROWS * frame.camera.height]
    if len(shifts) < _MIN_POINTS:
        return frame
    shift = float(np.median(shifts))
    K = (frame.camera.K if frame.right_K is None else frame.right_K).copy()
    rows = round(shift)
    K[1, 2] += shift - rows
    return dataclasses.replace(frame, right=_moved_up(frame.right, rows), right_K=K)


def _moved_up(image: np.ndarray, rows: int) -> np.ndarray:
    """The image moved up by a number of rows, the last one repeated."""
    return image[np.clip(np.arange(len(image)) + rows, 0, len(image) - 1)]


def _with_right_shifted(frame: Frame, offset: float) -> Frame:
    """The frame with the right eye's principal point where the poses and the disparity say that it is."""
    K = (frame.camera.K if frame.right_K is None else frame.right_K).copy()
    K[0, 2] += offset
    return dataclasses.replace(frame, right_K=K)


def _known_depths(frame: Frame, points: np.ndarray) -> np.ndarray:
    """Pixels u, v and depths z (m) [N, 3] of what is known in a view: scene points, or stereo matches where there is a right image."""
    if frame.right is not None:
        frame = _aligned(frame)
        depth = _to_depth(frame, stereo_disparity(frame), 0.0)
        v, u = np.nonzero(depth[_SPARSE // 2 :: _SPARSE, _SPARSE // 2 :: _SPARSE])
        u, v = (_SPARSE * x + _SPARSE // 2 for x in (u, v))
        return np.stack([u + 0.5, v + 0.5, depth[v, u]], 1)
    uv, z = frame.camera.project(points)
    inside = (z > _NEAREST) & (uv >= 0).all(1) & (uv < [frame.camera.width, frame.camera.height]).all(1)
    return np.column_stack([uv[inside], z[inside]])


def interpolated_depth(frame: Frame, points: np.ndarray) -> np.ndarray | None:
    """Depth [H, W] (m, 0 outside their hull) between the triangulated points seen in a view; None if few.

    Kriging of how far inverse depth is from a plane's; all points err alike.
    """
    uv, z = points_in_view(frame.camera, points)
    if len(uv) < _MIN_POINTS or np.linalg.matrix_rank(uv - uv.mean(0), tol=1.0) < 2:
        return None
    shape = frame.camera.height, frame.camera.width
    a, b, c = plane_through(*uv.T, 1 / z)
    over = kriged(np.zeros(shape), np.zeros(shape, bool), uv, 1 / z - (a * uv[:, 0] + b * uv[:, 1] + c), frame.camera.width)
    plane = a * (np.arange(shape[1]) + 0.5) + b * (np.arange(shape[0])[:, None] + 0.5) + c
    inverse = kept_in_range(plane + over, 1 / z)
    hull = cv2.fillConvexPoly(np.zeros(shape, np.uint8), cv2.convexHull(np.floor(uv).astype(np.int32)), 1)
    return np.where(hull > 0, 1 / inverse, 0).astype(np.float32)


def _with_depth(frame: Frame, depth: np.ndarray | None) -> Frame:
    if depth is None:
        return dataclasses.replace(frame, depth=None)
    valid = np.isfinite(depth) & (depth > 0) & (True if frame.mask is None else frame.mask > 0)
    return dataclasses.replace(frame, depth=np.where(valid, depth, 0).astype(np.float32))


def stereo_disparity(frame: Frame) -> np.ndarray:
    """Disparity [H, W] float32 in pixels (0 = none) of a rectified pair by semi-global matching, checked both ways.

    A difference of the principal points of the two eyes is removed, so that disparity = fx·B/z.
    """
    fx, width = frame.camera.K[0, 0], frame.camera.width
    shift = 0.0 if frame.right_K is None else frame.camera.K[0, 2] - frame.right_K[0, 2]
    levels = int(np.ceil((fx * frame.baseline / _NEAREST + abs(shift)) / 16)) * 16
    levels = min(levels, max(width // 2 // 16, 1) * 16)
    matcher = cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=levels, blockSize=5, P1=8 * 25, P2=32 * 25, uniquenessRatio=5,
        speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    # The matcher skips as many columns on the left as it has levels: let those be padding.
    pad = lambda image: cv2.copyMakeBorder(image, 0, 0, levels, 0, cv2.BORDER_REPLICATE)
    match = lambda a, b: matcher.compute(pad(a), pad(b))[:, levels:].astype(np.float32) / 16
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (frame.image, frame.right))
    disparity = match(left, right)
    # The right image's own disparity, by matching the mirrored pair, must lead back to the same pixel.
    back = match(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]))[:, ::-1]
    columns = np.arange(width) - disparity.round().astype(int)
    back = np.take_along_axis(back, columns.clip(0, width - 1), 1)
    valid = (disparity > 0) & (columns >= 0) & (np.abs(back - disparity) <= 1)
    # What is left of wrong matches are islands.
    sixteenths = np.where(valid, 16 * disparity, 0).astype(np.int16)
    cv2.filterSpeckles(sixteenths, 0, int(_ISLAND * disparity.size), 16)
    return np.where(sixteenths > 0, np.maximum(disparity - np.float32(shift), 0), np.float32(0))


def disparity_offsets(frames: list[Frame], disparities: list[np.ndarray | None], points: ScenePoints) -> np.ndarray:
    """Constants [V] to add to the stereo disparities (pixels) of views so that they agree with scene points.

    A wrong principal point of one eye shifts every disparity by the same amount, an error of the poses or the baseline
    those of one view. A view has an offset of its own where it sees points enough; all are zero when too few points are
    seen, when their common offset is within the scatter that explains it by chance, or so large that the poses must be
    wrong. A point counts the less the farther a pixel's error moves it.
    """
    residuals, weights = [np.empty(0)] * len(frames), [np.empty(0)] * len(frames)
    for i, (frame, disparity) in enumerate(zip(frames, disparities)):
        if disparity is None or not len(points.positions):
            continue
        uv, z = frame.camera.project(points.positions)
        u, v = np.floor(np.nan_to_num(uv, nan=-1.0)).astype(int).T
        inside = (z > _NEAREST) & (u >= 0) & (v >= 0) & (u < frame.camera.width) & (v < frame.camera.height)
        measured = disparity[v[inside], u[inside]]
        expected = frame.camera.K[0, 0] * frame.baseline / z[inside]
        residuals[i] = (expected - measured)[measured > 0]
        error = np.broadcast_to(points.error, z.shape)[inside][measured > 0]
        weights[i] = 1 / (MATCHED**2 + (error * expected[measured > 0]) ** 2)
    residual, weight = np.concatenate(residuals), np.concatenate(weights)
    if len(residual) < _MIN_POINTS:
        return np.zeros(len(frames))
    offset = _weighted_median(residual, weight)
    spread = 1.4826 * _weighted_median(np.abs(residual - offset), weight)
    if abs(offset) < max(0.25, 3 * spread * np.sqrt((weight**2).sum()) / weight.sum()):
        return np.zeros(len(frames))
    typical = float(np.median(np.concatenate([d[d > 0] for d in disparities if d is not None])))
    if abs(offset) > _MOST_OFFSET * typical:
        text = "stereo disparity, %.1f pixels, and the poses are %.1f pixels apart: left so; check poses, their scale and the baseline"
        log.warning(text, typical, abs(offset))
        return np.zeros(len(frames))
    worth = [w.sum() * MATCHED**2 for w in weights]  # in points of no error
    offsets = [_weighted_median(r, w) if n > _MANY_POINTS else offset for r, w, n in zip(residuals, weights, worth)]
    text = "stereo disparity shifted by %.2f pixels to agree with the poses (%d points, scatter %.2f; views %.2f to %.2f)"
    log.info(text, offset, len(residual), spread, min(offsets), max(offsets))
    return np.array(offsets)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)])


def _to_depth(frame: Frame, disparity: np.ndarray, offset: float) -> np.ndarray:
    corrected = np.where(disparity > 0, disparity + offset, 0)
    far = frame.camera.K[0, 0] * frame.baseline / np.maximum(corrected, _LEAST_DISPARITY)
    return np.where(corrected > _LEAST_DISPARITY, far, 0)
