"""Sparse scene points from matched features of posed views, and views whose pose contradicts what they see."""

import logging
from itertools import combinations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import map_in_threads
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.scene import Matches, ScenePoints
from endo_sim_ros.sequences.recording import spread

log = logging.getLogger(__name__)

_RATIO = 0.8  # Lowe's ratio test
_MAX_ERROR = 2.0  # pixels, reprojection in both views
_MIN_PARALLAX = np.radians(1.0)
_NEIGHBOURS = 3  # views matched with each view: the nearest in space
_LEAST_MATCHES = 25  # consistent with some motion of the camera, to judge the given one by
_LEAST_SHARE = 0.5  # of all matches, for that motion to be no accident
_FARTHEST_OFF = 0.02  # of the image's width, median distance from where the poses expect these; tissue moves by less
_CLOSE = 0.007  # of the width, within which poses are right
_USUAL, _TIMES_USUAL = 0.2, 5.0  # the share of all groups of views that is taken to be right, and how many times as far off others may be
_MOST_NAMED = 5
_AROUND = 8  # points around a point that it is compared with
_DISAGREEMENT = 0.1  # largest relative difference from them
_NO_BASELINE = 1e-6  # metres
_NEAR, _FAR = 0.02, 1e3  # metres, between which a match may lie


def triangulate(frames: list[Frame], matches: list[Matches] | None = None) -> ScenePoints:
    """Points where rays of features meet that near views share.

    SIFT matches between near views (those of `match_features`), kept where triangulation with the known poses reprojects
    within two pixels, at a depth like that of the neighbours.
    """
    parts = [ScenePoints.none()]
    for (i, j), uv_i, uv_j in match_features(frames) if matches is None else matches:
        points, kept, parallax = _intersect(frames[i], frames[j], uv_i, uv_j)
        alike = _like_those_around(uv_i[kept], frames[i].camera.project(points)[1])
        points, kept, parallax = points[alike], kept[alike], parallax[alike]
        u, v = (uv_i[kept] - 0.5).round().astype(int).T
        parts.append(ScenePoints(points, frames[i].image[v, u] / 255.0, 1 / (frames[i].camera.K[0, 0] * np.tan(parallax))))
    return ScenePoints(*(np.concatenate(arrays) for arrays in zip(*parts)))


def scene_points(frames: list[Frame], views: int = 24) -> ScenePoints:
    """Points of a whole recording, triangulated from so many of its views: more of the scene than those one trains on show."""
    shown = spread([frame for frame in frames if frame.mask is None or frame.mask.any()], views)
    return triangulate(shown) if len(shown) > 1 else ScenePoints.none()


def points_in_view(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [M, 2] and depths [M] (m) of those of the points [N, 3] that lie in a view.

    A point whose depth disagrees with that of its neighbours in the image is a wrong match or hidden, and left out.
    """
    uv, z = camera.project(points)
    inside = (z > _NEAR) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
    uv, first = np.unique(uv[inside], axis=0, return_index=True)
    z = z[inside][first]
    agrees = _like_those_around(uv, z)
    return uv[agrees], z[agrees]


def _like_those_around(uv: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Which of the points at pixels [N, 2] have a depth [N] like that of their neighbours; none of too few."""
    if len(uv) <= _AROUND:
        return np.zeros(len(uv), bool)
    return np.abs(np.median(z[cKDTree(uv).query(uv, k=_AROUND + 1)[1][:, 1:]], axis=1) / z - 1) < _DISAGREEMENT


def misposed(frames: list[Frame], matches: list[Matches]) -> list[int]:
    """Indices of the views whose poses contradict most of the views that they share features with.

    Matches of two views that fit one motion of the camera, whichever, must fit the given one, with the depth of the views
    if there is any; and what three views share must be one point each, which a pose wrong along the line of sight fails.
    Where views contradict each other and nobody can tell which is wrong, that is logged, and none is named.
    """
    moving = [m._replace(first=m.first[fits], second=m.second[fits]) for m in matches if (fits := _judged(frames, m)).any()]
    wrong = _outvoted([(m.views, _off_in_two(frames, m)) for m in moving])
    moving = [m for m in moving if not set(m.views) & set(wrong)]
    return sorted(wrong + _outvoted([(views, _off_in_three(frames, views, uv)) for views, uv in _tracks(moving)]))


def _outvoted(errors: list[tuple[tuple[int, ...], float]]) -> list[int]:
    """The views that most of their groups contradict, of groups of views and how far off (widths of the image) each group is.

    None if no more than as many others agree with each other.
    """
    if not errors:
        return []
    usual = np.quantile([off for _, off in errors], _USUAL, method="lower")
    limit = min(max(_CLOSE, _TIMES_USUAL * usual), _FARTHEST_OFF)
    count, wrong = 1 + max(max(views) for views, _ in errors), []
    while True:  # the worst first: what contradicts it may be right without it
        left = [(views, off) for views, off in errors if not set(views) & set(wrong)]
        bad, all_of, total = np.zeros((3, count))
        for views, off in left:
            bad[list(views)] += off > limit
            all_of[list(views)] += 1
            total[list(views)] += min(off, 1.0)
        share = bad / np.maximum(all_of, 1)
        worst = max(range(count), key=lambda view: (share[view], bad[view], total[view]))
        if not bad[worst] or all_of[worst] < 2 or share[worst] <= 0.5:
            break
        wrong.append(worst)
    agreeing = {view for views, off in left if off <= limit for view in views}
    wrong = wrong if len(agreeing) > len(wrong) else []
    unsettled = {tuple(sorted(views)) for views, off in errors if off > limit and not set(views) & set(wrong)}
    if unsettled:
        groups = ", ".join(" and ".join(map(str, views)) for views in sorted(unsettled)[:_MOST_NAMED])
        log.warning("the poses of views %s contradict what they see; check them", groups)
    return wrong


def match_features(frames: list[Frame], max_features: int = 4000) -> list[Matches]:
    """SIFT features matched between each view and the nearest others."""

    def detect(frame: Frame):
        sift = cv2.SIFT_create(nfeatures=max_features, contrastThreshold=0.01)
        return sift.detectAndCompute(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), frame.mask)

    features = map_in_threads(detect, frames)

    def match(pair: tuple[int, int]) -> Matches | None:
        (keys_i, desc_i), (keys_j, desc_j) = (features[i] for i in pair)
        if desc_i is None or desc_j is None or len(desc_j) < 2:
            return None
        matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(desc_i, desc_j, k=2)
        good = [m for m, n in matches if m.distance < _RATIO * n.distance]
        uv_i = np.array([keys_i[m.queryIdx].pt for m in good]) + 0.5  # OpenCV counts from the centre of the first pixel
        uv_j = np.array([keys_j[m.trainIdx].pt for m in good]) + 0.5
        return Matches(pair, uv_i, uv_j) if good else None

    return [found for found in map_in_threads(match, _pairs(frames)) if found is not None]


def _of_one_motion(first: Frame, second: Frame, uv1: np.ndarray, uv2: np.ndarray) -> np.ndarray:
    """Which matches [M] fit the motion of the camera that most of them fit."""
    if len(uv1) < _LEAST_MATCHES:
        return np.zeros(len(uv1), bool)
    sight = [(uv - f.camera.K[:2, 2]) / f.camera.K.diagonal()[:2] for f, uv in ((first, uv1), (second, uv2))]
    _, inliers = cv2.findEssentialMat(*sight, np.eye(3), cv2.RANSAC, 0.999, _MAX_ERROR / second.camera.K[0, 0])
    return np.zeros(len(uv1), bool) if inliers is None else inliers[:, 0] > 0


def _judged(frames: list[Frame], matches: Matches) -> np.ndarray:
    """Which matches [M] poses can be judged by: those of one motion of the camera, if it is no accident."""
    inliers = _of_one_motion(*(frames[view] for view in matches.views), matches.first, matches.second)
    return inliers & (inliers.sum() >= max(_LEAST_MATCHES, _LEAST_SHARE * len(inliers)))


def _off_in_two(frames: list[Frame], matches: Matches) -> float:
    """How far matches are from where the poses expect them, median in widths of the image."""
    first, second = (frames[view] for view in matches.views)
    off = [np.median(_distance_from_epipolar(first, second, matches.first, matches.second))]
    for one, other, here, there in ((first, second, matches.first, matches.second), (second, first, matches.second, matches.first)):
        if one.depth is None:
            continue
        u, v = np.floor(here).astype(int).T
        known = one.depth[v, u] > 0
        if known.sum() >= _LEAST_MATCHES:
            points = one.camera.backproject(one.depth)[v, u][known]
            off.append(np.median(np.linalg.norm(other.camera.project(points)[0] - there[known], axis=1)))
    return float(max(off)) / second.camera.width


def _tracks(matches: list[Matches]) -> list[tuple[tuple[int, int, int], list[np.ndarray]]]:
    """Three views each, with their pixels [M, 2] of the features that the first shares with both others."""
    ends: dict[int, list[tuple[int, np.ndarray, np.ndarray]]] = {}
    for (i, j), first, second in matches:
        ends.setdefault(i, []).append((j, first, second))
        ends.setdefault(j, []).append((i, second, first))
    found = []
    for view, others in ends.items():
        for (j, here_j, there_j), (k, here_k, there_k) in combinations(others, 2):
            _, of_j, of_k = np.intersect1d(here_j @ [1, 1j], here_k @ [1, 1j], return_indices=True)
            if len(of_j) >= _LEAST_MATCHES:
                found.append(((view, j, k), [here_j[of_j], there_j[of_j], there_k[of_k]]))
    return found


def _off_in_three(frames: list[Frame], views: tuple[int, ...], pixels: list[np.ndarray]) -> float:
    """How far features [M, 2] of several views are from one point each, median of the worst view's in widths of the image."""
    cameras = [frames[view].camera for view in views]
    if np.ptp([camera.position for camera in cameras], 0).max() < _NO_BASELINE:
        return 0.0  # any point on a ray would do
    rows = []
    for camera, uv in zip(cameras, pixels):
        x, y = ((uv - camera.K[:2, 2]) / camera.K.diagonal()[:2]).T[..., None]
        rows += [x * camera.viewmat[2] - camera.viewmat[0], y * camera.viewmat[2] - camera.viewmat[1]]
    homogeneous = np.linalg.svd(np.stack(rows, 1))[2][:, -1]
    points = homogeneous[:, :3] / np.where(np.abs(homogeneous[:, 3:]) < 1e-9, 1e-9, homogeneous[:, 3:])
    off = np.zeros(len(points))
    for camera, uv in zip(cameras, pixels):
        expected, z = camera.project(points)
        off = np.maximum(off, np.where(z > 0, np.linalg.norm(expected - uv, axis=1) / camera.width, np.inf))
    return float(np.median(off))


def _distance_from_epipolar(first: Frame, second: Frame, uv1: np.ndarray, uv2: np.ndarray) -> np.ndarray:
    """Pixels [M] from a feature in the second view to where the first view's feature may appear there: a piece of a line."""
    K, pose = first.camera.K, first.camera.pose
    rays = np.column_stack([(uv1 - K[:2, 2]) / K.diagonal()[:2], np.ones(len(uv1))]) @ pose[:3, :3].T
    start, rise = (first.camera.position - second.camera.position) @ second.camera.pose[:3, 2], rays @ second.camera.pose[:3, 2]
    nearest = np.maximum(_NEAR, (_NEAR / 2 - start) / np.maximum(rise, 1e-6))  # where both cameras have it in front of them
    ends = [second.camera.project(first.camera.position + depth * rays) for depth in (nearest[:, None], _FAR)]
    (near, z_near), (far, z_far) = ends
    along = far - near
    t = ((uv2 - near) * along).sum(1) / np.maximum((along * along).sum(1), 1e-12)
    distance = np.linalg.norm(uv2 - near - t.clip(0, 1)[:, None] * along, axis=1)
    return np.where((z_near > 0) & (z_far > 0), distance, np.inf)


def neighbours(frames: list[Frame], count: int = _NEIGHBOURS) -> np.ndarray:
    """Indices [V, up to count + 1] of the views nearest to each in space, mostly itself among them."""
    centres = np.array([frame.camera.position for frame in frames])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    return np.argsort(distance, axis=1, kind="stable")[:, : count + 1]


def _pairs(frames: list[Frame]) -> list[tuple[int, int]]:
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(neighbours(frames)) for j in row if j != i})


def _intersect(first: Frame, second: Frame, uv1: np.ndarray, uv2: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points where the rays of two views meet, the indices of the matches that gave one, and the angles between the rays."""
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
    parallax = np.arccos(np.clip((directions[0] * directions[1]).sum(1), -1, 1))
    good &= parallax > _MIN_PARALLAX
    return points[good], np.nonzero(good)[0], np.minimum(parallax[good], np.pi / 4)
