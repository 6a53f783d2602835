"""Whether SCARED's published poses are world-to-camera or camera-to-world."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.sequences.recording import spread
from endo_sim_ros.sequences.stereo_images import StereoImages

logger = logging.getLogger(__name__)

Projection = Callable[[np.ndarray], np.ndarray]

USUAL_DIRECTION = "world_to_camera"  # what the published re-implementations found
_CHECKED_FRAMES = 400  # how far into the video is looked: later, tissue has moved and the keyframe's points are wrong
_LEAST_MOTION = 2.0  # pixels, median distance of the two readings from which on a frame tells them apart: the kinematics' own error
_LEAST_DIFFERENCE = 0.01  # of the two mean correlations, below which they count as alike

_LEAST_FIT = 0.2  # correlation of the better reading, below which both are noise


def find_pose_direction(
    points: np.ndarray,
    image: np.ndarray,
    images: StereoImages,
    published: Mapping[int, np.ndarray],
    project: Projection,
    source: Path,
) -> str:
    """`world_to_camera` or `camera_to_world`, whichever fits the images; the usual one where neither fits better.

    The keyframe's measured points, coloured by its image, are projected into later frames under both readings; the
    right one lands on pixels that look alike (higher correlation of brightness).

    Args:
        points: Points of the keyframe [H, W, 3], metres, in its raw left camera.
        image: Its left RGB image [H, W, 3], uint8.
        images: Those of the recording.
        published: Poses [4, 4] by frame number, translation in metres.
        project: Where points [N, 3] in the raw left camera, metres, are in its images: pixels [N, 2], OpenCV convention.
        source: The recording's folder, for messages.
    """
    points, colours = _sparse_points(points, _brightness(image))
    if not len(points):
        logger.warning("%s: the keyframe's depth map is empty and cannot verify the pose direction; assuming %s", source, USUAL_DIRECTION)
        return USUAL_DIRECTION
    later = [n for n in images.numbers if 0 < n < _CHECKED_FRAMES and n in published]
    moved = []
    for number in spread(later, 24):
        forward, backward = (_seen(points, pose, project) for pose in _readings(published[number]))
        if np.median(np.linalg.norm(forward - backward, axis=1)) > _LEAST_MOTION:
            moved.append(number)
    scores = []
    for number, left, _ in images.read(spread(moved, 6)):
        brightness = _brightness(left)
        pixels = [_seen(points, pose, project) for pose in _readings(published[number])]
        inside = np.all([((uv >= 0) & (uv <= np.array(images.size) - 1)).all(1) for uv in pixels], axis=0)
        if inside.sum() < 50:
            continue
        score = [_correlation(colours[inside], _sample(brightness, uv[inside])) for uv in pixels]
        if np.isfinite(score).all():  # what is not a number decides nothing
            scores.append(score)
    if not scores:
        cause = "too few of the keyframe's points fall into pictures with contrast" if moved else "the camera moves too little"
        logger.warning(
            "%s: the pose direction cannot be verified, as %s; assuming %s, pass pose_direction if wrong", source, cause, USUAL_DIRECTION
        )
        return USUAL_DIRECTION
    world_to_camera, camera_to_world = np.mean(scores, 0)
    if max(world_to_camera, camera_to_world) < _LEAST_FIT:
        logger.warning(
            "%s: neither pose direction fits the images (correlation %.3f and %.3f): poses of other frames, or not in millimetres? "
            "Assuming %s; correct camera-pose, or pass pose_direction or poses=sfm",
            source, world_to_camera, camera_to_world, USUAL_DIRECTION,
        )  # fmt: skip
        return USUAL_DIRECTION
    if abs(world_to_camera - camera_to_world) < _LEAST_DIFFERENCE:
        logger.warning(
            "%s: both pose directions fit alike (correlation %.3f and %.3f); assuming %s, pass pose_direction if wrong",
            source, world_to_camera, camera_to_world, USUAL_DIRECTION,
        )  # fmt: skip
        return USUAL_DIRECTION
    found = "world_to_camera" if world_to_camera > camera_to_world else "camera_to_world"
    logger.info(
        "%s: camera-pose is %s (the keyframe's points correlate by %.3f as world-to-camera and %.3f as "
        "camera-to-world over %d frames)", source, found, world_to_camera, camera_to_world, len(scores),
    )  # fmt: skip
    return found


def _readings(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera transforms of a published pose, read as world-to-camera and as camera-to-world."""
    return pose, invert_pose(pose)


def _brightness(image: np.ndarray) -> np.ndarray:
    """Blurred grey image [H, W], float32; the blur forgives the kinematics' few pixels of error."""
    sigma = max(0.5, image.shape[1] / 400)
    return cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), sigma)


def _sparse_points(points: np.ndarray, brightness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some 20 000 measured points [N, 3] and their brightness [N]."""
    with np.errstate(invalid="ignore"):
        rows, columns = np.nonzero(np.isfinite(points).all(-1) & (points[..., 2] > 0))
    keep = slice(None, None, max(1, len(rows) // 20_000))
    rows, columns = rows[keep], columns[keep]
    return points[rows, columns].astype(np.float64), brightness[rows, columns]


def _seen(points: np.ndarray, view: np.ndarray, project: Projection) -> np.ndarray:
    """Pixels [N, 2] of points [N, 3] in the left image of a camera with a world-to-camera transform; −1 of those behind it."""
    local = points @ view[:3, :3].T + view[:3, 3]
    return np.where(local[:, 2:] > 0, project(local), -1.0)


def _sample(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear samples [N] of an image [H, W] at pixels [N, 2]."""
    parts = np.array_split(uv.astype(np.float32), 4)  # remap takes at most 32767 rows
    return np.concatenate([cv2.remap(image, part[:, :1], part[:, 1:], cv2.INTER_LINEAR)[:, 0] for part in parts])


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else 0.0
