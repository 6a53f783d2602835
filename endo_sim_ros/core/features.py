"""Features that two images share, and how far they are from where known cameras expect them."""

from typing import Any

import cv2
import numpy as np
import torch

from endo_sim_ros.core.cameras import Camera

Features = tuple[np.ndarray, np.ndarray | None]  # pixels [N, 2] and descriptors [N, 128]
_AT_ONCE = 1000  # features that are compared with all of another image at a time: 16 MB of 4000
_LOOK: dict[str, Any] = dict(winSize=(15, 15), maxLevel=4)  # of optical flow
_REACH = _LOOK["winSize"][0] // 2 + 1  # pixels about a place that `follow` looks at: half a window, and one more for slopes
_BESIDE = 3.0  # pixels beside its epipolar line up to which a match agrees with the geometry: OpenCV's; features lie within one
_RETURN = 0.3  # pixels from where it began, within which the way back of a followed point ends


def detect(image: np.ndarray, mask: np.ndarray | None, count: int) -> Features:
    """Pixels [N, 2] and descriptors [N, 128] of the SIFT features of an RGB image [H, W, 3] where a mask [H, W] is not 0.

    Args:
        image: uint8.
        mask: uint8; None takes features everywhere.
        count: Features at most; the strongest are kept.
    """
    # A quarter of OpenCV's threshold: tissue has little contrast.
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=0.01)
    keys, descriptors = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), mask)
    return np.array([key.pt for key in keys]).reshape(-1, 2) + 0.5, descriptors  # OpenCV counts from the centre of the first pixel


def match_pair(first: Features, second: Features, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [M, 2] in the first and the second image of the features, as `detect` gives them, that pass the ratio test.

    Args:
        first, second: Features of two images.
        ratio: Largest ratio of the distances of a feature's best and second-best match.
    """
    (uv_1, descriptors_1), (uv_2, descriptors_2) = first, second
    if descriptors_1 is None or descriptors_2 is None or len(descriptors_2) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    one, other = torch.from_numpy(descriptors_1), torch.from_numpy(descriptors_2)
    parts = []
    for some in one.split(_AT_ONCE):
        # Squared distances. Descriptors of SIFT are whole numbers, so small that these sums are exact. OpenCV takes five times as long.
        squared = torch.addmm((other**2).sum(1), some, other.T, alpha=-2).add_((some**2).sum(1, keepdim=True))
        least, nearest = squared.min(1, keepdim=True)
        next_best = squared.scatter_(1, nearest, torch.inf).amin(1, keepdim=True)
        parts.append(torch.where(least < ratio**2 * next_best, nearest, -1))
    nearest = torch.cat(parts)[:, 0].numpy()
    return uv_1[nearest >= 0], uv_2[nearest[nearest >= 0]]


def agreeing(uv_1: np.ndarray, uv_2: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Those of matched pixels [M, 2] that agree with one epipolar geometry, whatever the cameras; none where they are fewer than `least`.

    Of images that share nothing some features look alike all the same. They pass the ratio test, but agree with no geometry.
    """
    if len(uv_1) >= least:
        agree = cv2.findFundamentalMat(uv_1, uv_2, cv2.FM_RANSAC, _BESIDE, 0.999)[1]
        if agree is not None and agree.sum() >= least:
            return uv_1[agree[:, 0] > 0], uv_2[agree[:, 0] > 0]
    return np.empty((0, 2)), np.empty((0, 2))


def slopes(camera: Camera, uv: np.ndarray) -> np.ndarray:
    """x/z and y/z [M, 2] of pixels [M, 2]."""
    return (uv - camera.K[:2, 2]) / camera.K.diagonal()[:2]


def epipolar_distance(
    first: Camera, second: Camera, uv_1: np.ndarray, uv_2: np.ndarray, near: float = 1e-3, far: float = 1e3
) -> np.ndarray:
    """Pixels [M] from a feature in the second view to where the first view's feature may appear there: a piece of a line.

    Where the camera only turns the piece is a point, so that turns are checked as well.

    Args:
        first, second: Cameras with poses.
        uv_1, uv_2: Pixels [M, 2] of matched features.
        near, far: Depths between which the features lie in the first view, metres; by default whatever an endoscope sees.
    """
    rays = np.column_stack([slopes(first, uv_1), np.ones(len(uv_1))]) @ first.pose[:3, :3].T
    start, rise = (first.position - second.position) @ second.pose[:3, 2], rays @ second.pose[:3, 2]
    nearest = np.maximum(near, (near / 2 - start) / np.maximum(rise, 1e-6))  # where both cameras have it in front of them
    ends = [second.project(first.position + depth * rays) for depth in (nearest[:, None], far)]
    (near_end, z_near), (far_end, z_far) = ends
    along = far_end - near_end
    t = ((uv_2 - near_end) * along).sum(1) / np.maximum((along * along).sum(1), 1e-12)
    distance = np.linalg.norm(uv_2 - near_end - t.clip(0, 1)[:, None] * along, axis=1)
    return np.where((z_near > 0) & (z_far > 0), distance, np.inf)


def follow(image: np.ndarray, other: np.ndarray, places: np.ndarray, guesses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where places [N, 2] of a grey image [H, W] are in another, and whether the way back leads there [N]: pyramids of Lucas and Kanade.

    Args:
        image, other: uint8.
        places: Pixels in the image; here (0, 0) is the centre of the first, as OpenCV has it.
        guesses: Where to look for them in the other [N, 2].
    """
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(image, other, places[:, None], guesses[:, None].copy(), flags=flags, **_LOOK)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, image, there, places[:, None].copy(), flags=flags, **_LOOK)
    good = (found[:, 0] > 0) & (returned[:, 0] > 0) & (np.abs(back[:, 0] - places).max(1) < _RETURN)
    height, width = image.shape
    return there[:, 0], good & (there[:, 0] >= 0).all(1) & (there[:, 0] < [width, height]).all(1)


def followable(tissue: np.ndarray) -> np.ndarray:
    """Where [H, W], 1 or 0, `follow` looks at nothing but tissue [H, W] once it looks at single pixels, which decide.

    The edge of a mask is strong, and takes points beside it along: with an instrument, or nowhere where it is that of a black border.
    """
    return cv2.erode(tissue.astype(np.uint8), np.ones((2 * _REACH + 1,) * 2, np.uint8))
