"""Frames of tissue that moves as if it were in its mean position, and what belongs to that position as it was when it was recorded."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.depth import fill_depth
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.smooth_fields import interpolated_between
from endo_sim_ros.core.tissue_motion import CELL, TissueMotion


def stilled(frame: Frame, motion: TissueMotion | None, depth: np.ndarray | None = None) -> Frame:
    """The frame as if the tissue were in its mean position.

    Each pixel of the images is moved as far as the tissue that it shows, highlights as far as the tissue below. What comes from beyond
    the picture is masked.

    Args:
        frame: As it was recorded.
        motion: Its `lens` is where the camera is then. None: the frame stays as it is.
        depth: Of the frame [H, W] (m, 0 = none). None: ways are interpolated between the points of the motion, and what stands in front of
            other tissue goes as far as that.
    """
    if motion is None:
        return frame
    if motion.lens is not None:
        frame = replace(frame, camera=frame.camera.at(frame.camera.pose @ motion.lens))
    eyes = [frame.camera] if frame.right is None else [frame.camera, frame.right_camera]
    if depth is None or not (depth > 0).any():
        moved = motion.points + motion.shares(motion.points) @ motion.paths(frame.stamp_ns)
        warps = [_warp(eye, motion.points, moved) for eye in eyes]
    else:
        warps = _dense_warp(frame.camera, depth, motion, frame.stamp_ns, None, eyes)
    if warps[0] is None:
        return frame
    x, y, farther = warps[0]
    depth, mask = None if frame.depth is None else _depth_looked_up(frame.depth, x, y, farther), frame.mask
    inside = (x > -0.5) & (x < frame.camera.width - 0.5) & (y > -0.5) & (y < frame.camera.height - 0.5)
    if mask is not None:
        mask = cv2.remap(mask, x, y, cv2.INTER_NEAREST, borderValue=0)
    elif not inside.all():
        mask = np.uint8(255) * inside
    right = frame.right
    if right is not None and warps[1] is not None:
        right = _looked_up(right, *warps[1][:2])
    return replace(frame, image=_looked_up(frame.image, x, y), right=right, depth=depth, mask=mask)


def unstilled(
    camera: Camera, depth: np.ndarray | None, mask: np.ndarray | None, stamp_ns: int, motion: TissueMotion
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Depth [H, W] (m, 0 = none) and mask [H, W] of tissue in its mean position as they were at the time of a stamp (ns)."""
    if depth is None or not (depth > 0).any():
        moved = motion.points + motion.shares(motion.points) @ motion.paths(stamp_ns)
        warp = _warp(camera, moved, motion.points)
    else:
        (warp,) = _dense_warp(camera, depth, motion, None, stamp_ns, [camera])
    if warp is None:
        return depth, mask
    x, y, _ = warp
    mask = None if mask is None else cv2.remap(mask, x, y, cv2.INTER_NEAREST, borderValue=255)
    return None if depth is None else _depth_looked_up(depth, *warp), mask


def _dense_warp(
    camera: Camera, depth: np.ndarray, motion: TissueMotion, since: int | None, until: int | None, eyes: Sequence[Camera]
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray] | None]:
    """As `_warp`, by the depth that one camera sees: where it saw what is at each pixel of others later, and how much farther.

    Args:
        camera: The one camera.
        depth: What it sees [H, W], m, 0 = none.
        motion: Of the tissue.
        since, until: When it sees that, and when the others look, ns; None: when tissue is in its mean position.
        eyes: The others. None is returned for those that see nothing of it.
    """
    depth = fill_depth(depth)[0]
    ways = motion.ways_from(camera, depth, since)(until)
    places, ways = (camera.backproject(depth) + ways).reshape(-1, 3), ways.reshape(-1, 3)
    warps = []
    for eye in eyes:
        uv, z = eye.project(places)
        shown = np.nonzero(eye.contains(uv, z))[0]
        if not len(shown):
            warps.append(None)
            continue
        shown = shown[np.argsort(-z[shown])]  # the nearest is written last
        columns, rows = uv[shown].astype(int).T
        near, source = np.zeros((eye.height, eye.width), np.float32), np.zeros((eye.height, eye.width), np.int64)
        near[rows, columns], source[rows, columns] = z[shown], shown
        near, _, nearest = fill_depth(near)
        near = cv2.medianBlur(near, 3)  # what rounding to pixels does
        there, far = eye.project((eye.backproject(near) - ways[source[nearest]]).reshape(-1, 3))
        x, y = (there.T.reshape(2, *near.shape) - 0.5).astype(np.float32)
        warps.append((x, y, far.reshape(near.shape).astype(np.float32) - near))
    return warps


def _warp(camera: Camera, points: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Where what is at each pixel has moved to: columns and rows [H, W], pixels from the centre of the first, and how much farther, m.

    None if the camera sees none of the points [N, 3], which have moved to [N, 3], m, world.
    """
    (uv, z), (there, far) = camera.project(points), camera.project(moved)
    ahead = (z > 0) & (far > 0)
    if not ahead.any():
        return None
    ahead &= np.minimum(z, far) > 0.1 * np.median(z[ahead])  # what is close to the lens was followed wrongly
    height, width = camera.height, camera.width
    columns, rows = (np.arange(-(-size // CELL)) * CELL + CELL / 2 for size in (width, height))
    cells = np.stack(np.meshgrid(columns, rows), -1)
    ways = np.concatenate([there - uv, (far - z)[:, None]], 1)[ahead]
    ways = interpolated_between(uv[ahead], ways, cells.reshape(-1, 2))[..., 0].reshape(*cells.shape[:2], 3).astype(np.float32)
    ways = cv2.resize(ways, (cells.shape[1] * CELL, cells.shape[0] * CELL), interpolation=cv2.INTER_CUBIC)[:height, :width]
    x = np.arange(width, dtype=np.float32) + ways[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + ways[..., 1]
    return x, y, ways[..., 2]


def _looked_up(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _depth_looked_up(depth: np.ndarray, x: np.ndarray, y: np.ndarray, farther: np.ndarray) -> np.ndarray:
    depth = cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderValue=0)
    return np.where(depth > 0, (depth - farther).clip(0), 0).astype(np.float32)
