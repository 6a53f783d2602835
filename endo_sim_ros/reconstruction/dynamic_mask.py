"""What moved between the views, such as an instrument that is in one of them: it is left out where it stands alone."""

import dataclasses
import logging

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from endo_sim_ros.core.device import map_in_threads
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.triangulation import neighbours

log = logging.getLogger(__name__)

_WIDTH = 320  # pixels of the images that are compared
_BLUR = 1.5  # pixels
_CHROMA = 0.5  # difference of log colour ratios, which light and exposure hardly change, between tissue and a tool
_LEAST = 0.004  # of the image: smaller pieces are glints and edges of the depth
_OPENING = 1 / 50  # of the width: narrower ones are such edges
_MOST = 0.4  # of the image: when more contradicts, it is depth or pose that is wrong


def without_motion(frames: list[Frame], tolerance: float) -> list[Frame]:
    """The views with what contradicts two or more others, and most of those that see it, masked.

    Args:
        frames: Training views with their depth prior.
        tolerance: Relative difference of depth within which two views see the same surface.
    """
    near = neighbours(frames)
    small = [frame if frame.depth is None else _small(frame) for frame in frames]

    def what_moved(i: int) -> np.ndarray | None:
        others = [small[j] for j in near[i] if j != i and frames[j].depth is not None]
        if frames[i].depth is None or not (small[i].depth > 0).any() or len(others) < 2:
            return None
        verdicts = np.array([_contradiction(small[i], other, tolerance) for other in others])
        against, agreeing = (verdicts > 0).sum(0), (verdicts < 0).sum(0)
        return _large_pieces((against >= 2) & (against > agreeing))

    result = []
    for frame, moved in zip(frames, map_in_threads(what_moved, range(len(frames)))):
        if moved is None or not moved.any():
            result.append(frame)
            continue
        at = frame.stamp_ns * 1e-9
        if moved.mean() > _MOST:
            log.warning("view at %.3f s: most of it contradicts the other views; check its depth and pose", at)
            result.append(frame)
            continue
        moved = cv2.resize(moved.astype(np.uint8), (frame.camera.width, frame.camera.height), interpolation=cv2.INTER_NEAREST) > 0
        mask = np.where(moved, 0, 255 if frame.mask is None else frame.mask).astype(np.uint8)
        result.append(dataclasses.replace(frame, mask=mask, depth=np.where(moved, np.float32(0), frame.depth)))
        text = "view at %.3f s: %.0f %% of it contradicts the other views and is left out; something moved"
        log.warning(text, at, 100 * moved.mean())
    return result


def _small(frame: Frame) -> Frame:
    camera = frame.camera.resized(_WIDTH, max(round(_WIDTH * frame.camera.height / frame.camera.width), 1))
    size = (camera.width, camera.height)
    nearest = lambda array: None if array is None else cv2.resize(array, size, interpolation=cv2.INTER_NEAREST_EXACT)
    image = cv2.GaussianBlur(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), (0, 0), _BLUR)
    return Frame(frame.stamp_ns, image, camera, depth=nearest(frame.depth), mask=nearest(frame.mask))


def _contradiction(frame: Frame, other: Frame, tolerance: float) -> np.ndarray:
    """1 where another view contradicts a view [H, W], -1 where it agrees, 0 where it sees nothing of it."""
    known = frame.depth > 0
    # In a hole something may hide that has no depth: let it be as deep as what is beside it.
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    depth = frame.depth[tuple(nearest)]
    uv, z = other.camera.project(frame.camera.backproject(depth).reshape(-1, 3))
    u, v = ((uv - 0.5).T.reshape(2, *depth.shape)).astype(np.float32)  # OpenCV counts from the centre of the first pixel
    z = z.reshape(depth.shape)
    look = lambda array, how: cv2.remap(array, u, v, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    surface = look(other.depth, cv2.INTER_NEAREST)
    seen = (z > 0) & (surface > 0) & (True if frame.mask is None else frame.mask > 0)
    if other.mask is not None:
        seen &= look(other.mask, cv2.INTER_NEAREST) > 0
    floats = seen & known & (z < surface * (1 - tolerance))
    same = seen & (np.abs(z - surface) < tolerance * surface)
    image = look(other.image, cv2.INTER_LINEAR)
    chroma = np.abs(_chroma(frame.image) - _chroma(image)).max(-1) > _CHROMA
    return np.where(floats | same & chroma, 1, np.where(same, -1, 0))


def _chroma(image: np.ndarray) -> np.ndarray:
    """Logarithms of red and blue over green [H, W, 2]."""
    colors = np.log(image.astype(np.float32) + 8)
    return colors[..., ::2] - colors[..., 1:2]


def _large_pieces(where: np.ndarray) -> np.ndarray:
    """The pixels [H, W] in large, compact pieces, with a margin."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (max(round(_OPENING * _WIDTH), 1),) * 2)
    opened = cv2.morphologyEx(where.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST * where.size
    large[0] = False
    return cv2.dilate(large[labels].astype(np.uint8), kernel) > 0
