"""Sparse scene points from matched features of posed views."""

import cv2
import numpy as np

from endo_sim_ros.sequences.frames import Frame

_RATIO = 0.8  # Lowe's ratio test
_MAX_ERROR = 2.0  # pixels, reprojection in both views
_MIN_PARALLAX = np.radians(1.0)
_NEIGHBOURS = 3  # views matched with each view: the nearest in space


def triangulate(frames: list[Frame], max_features: int = 4000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World points [N, 3] (m), their RGB [N, 3] in [0, 1], and the pair of views [N, 2] that each was seen in.

    SIFT matches between near views, kept where triangulation with the known poses reprojects within two pixels.
    """
    sift = cv2.SIFT_create(nfeatures=max_features, contrastThreshold=0.01)
    features = [sift.detectAndCompute(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), frame.mask) for frame in frames]
    points, colors, views = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty((0, 2), int)]
    for i, j in _pairs(frames):
        (keys_i, desc_i), (keys_j, desc_j) = features[i], features[j]
        if desc_i is None or desc_j is None or len(desc_j) < 2:
            continue
        matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(desc_i, desc_j, k=2)
        good = [m for m, n in matches if m.distance < _RATIO * n.distance]
        if not good:
            continue
        uv_i = np.array([keys_i[m.queryIdx].pt for m in good]) + 0.5  # OpenCV counts from the centre of the first pixel
        uv_j = np.array([keys_j[m.trainIdx].pt for m in good]) + 0.5
        found, kept = _intersect(frames[i], frames[j], uv_i, uv_j)
        points.append(found)
        views.append(np.tile([i, j], (len(found), 1)))
        u, v = (uv_i[kept] - 0.5).round().astype(int).T
        colors.append(frames[i].image[v, u] / 255.0)
    return np.concatenate(points), np.concatenate(colors), np.concatenate(views)


def _pairs(frames: list[Frame]) -> list[tuple[int, int]]:
    centres = np.array([frame.camera.position for frame in frames])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, : _NEIGHBOURS + 1]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(nearest) for j in row if j != i})


def _intersect(first: Frame, second: Frame, uv1: np.ndarray, uv2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points where the rays of two views meet, and the indices of the matches that gave one."""
    P1, P2 = (frame.camera.K @ frame.camera.viewmat[:3] for frame in (first, second))
    homogeneous = cv2.triangulatePoints(P1, P2, uv1.T, uv2.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (homogeneous[:3] / homogeneous[3]).T
    finite = np.isfinite(points).all(1)
    points = np.where(finite[:, None], points, 0.0)
    good = finite
    directions = []
    for frame, uv in ((first, uv1), (second, uv2)):
        projected, z = frame.camera.project(points)
        good = good & (z > 1e-3) & (np.linalg.norm(projected - uv, axis=1) < _MAX_ERROR)
        ray = points - frame.camera.position
        directions.append(ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12))
    good &= np.arccos(np.clip((directions[0] * directions[1]).sum(1), -1, 1)) > _MIN_PARALLAX
    return points[good], np.nonzero(good)[0]
