"""Features that near views share, and scene points where their rays meet."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (it is public)

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.features import detect, match_pair
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import Matches, ScenePoints
from endo_sim_ros.reconstruction.stage_configs import MatchingConfig
from endo_sim_ros.sequences.recording import spread

POINT_VIEWS = 24
"""Views of a recording from which its scene points are triangulated."""
_LEAST_PAIRS = 3  # of views that tell the scale of recorded depth; fewer may have a wrong pose
_UNIT = 5.0  # times: a scale beyond this is another unit, also where fewer pairs tell it
_OFF = 0.1  # part by which it must differ from that of the poses: those of robots are off by less
# Times what half of the pairs differ by, all in logarithms, that the scale must differ by beyond that. Of depth that is right it is 4.3 at
# most where tissue breathes (patients 0 and 1), in a wrong unit besides 7 at least.
_SURE = 6.0


def match_features(
    frames: Sequence[Frame], options: MatchingConfig = MatchingConfig(), progress: StageProgress = StageProgress()
) -> list[Matches]:
    """SIFT features matched between each view and the nearest others; pairs of views that share none are left out."""
    features = progress.map(lambda frame: detect(frame.image, frame.mask, options.max_features), frames)

    def match(pair: tuple[int, int]) -> Matches:
        return Matches(pair, *match_pair(features[pair[0]], features[pair[1]], options.ratio))

    pairs = sorted({(min(i, j), max(i, j)) for i, near in enumerate(nearest_views(frames, options.neighbours)) for j in near})
    return [found for found in progress.map(match, pairs) if len(found.first)]


def nearest_views(frames: Sequence[Frame], count: int) -> list[list[int]]:
    """For each view, the indices of so many others nearest in space, the nearest first; one more where many are in one place."""
    centres = np.array([frame.camera.position for frame in frames])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    order = np.argsort(distance, axis=1, kind="stable")[:, : count + 1].tolist()
    return [[other for other in row if other != view] for view, row in enumerate(order)]


def triangulate(
    frames: Sequence[Frame],
    matches: Sequence[Matches] | None = None,
    options: MatchingConfig = MatchingConfig(),
    progress: StageProgress = StageProgress(),
) -> ScenePoints:
    """Points where rays of matched features meet, with the error of their depth.

    Args:
        frames: Posed views.
        matches: Features that they share; None has `match_features` find them.
        options: What a match must satisfy: reprojection, parallax, and a depth like that of its neighbours.
        progress: Reported to while features are matched.
    """
    parts = [ScenePoints.none()]
    for (i, j), uv_i, uv_j in match_features(frames, options, progress) if matches is None else matches:
        progress.check()
        points, kept, parallax = _intersect(frames[i].camera, frames[j].camera, uv_i, uv_j, options)
        alike = _like_those_around(uv_i[kept], frames[i].camera.project(points)[1], options)
        points, kept, parallax = points[alike], kept[alike], parallax[alike]
        u, v = (uv_i[kept] - 0.5).round().astype(int).T
        parts.append(ScenePoints(points, frames[i].image[v, u] / 255.0, 1 / (frames[i].camera.K[0, 0] * np.tan(parallax))))
    return ScenePoints(*(np.concatenate(arrays) for arrays in zip(*parts)))


def recorded_scale(frames: Sequence[Frame], matches: Sequence[Matches], options: MatchingConfig) -> float:
    """How many times as far away as poses and matches say recorded depth says that tissue is; 1 where they agree, or tell nothing.

    Args:
        frames: Posed views.
        matches: Features that they share.
        options: What a match must satisfy, and how many of a pair must.
    """
    logs = []
    for (i, j), uv_i, uv_j in matches:
        depth = frames[i].depth
        if depth is None:
            continue
        points, kept, _ = _intersect(frames[i].camera, frames[j].camera, uv_i, uv_j, options)
        u, v = np.floor(uv_i[kept]).astype(int).T
        known = depth[v, u] > 0
        if known.sum() >= options.min_points:
            logs.append(np.median(np.log(depth[v, u][known] / frames[i].camera.project(points)[1][known])))
    if not logs:
        return 1.0
    scale = float(np.median(logs))
    if len(logs) < _LEAST_PAIRS and abs(scale) < np.log(_UNIT):
        return 1.0
    sure = abs(scale) > np.log(1 + _OFF) + _SURE * np.median(np.abs(np.array(logs) - scale))
    return float(np.exp(scale)) if sure else 1.0


def scene_points(
    frames: Sequence[Frame], views: int = POINT_VIEWS, options: MatchingConfig = MatchingConfig(), progress: StageProgress = StageProgress()
) -> ScenePoints:
    """Points of a whole recording, triangulated from so many of its views: more of the scene than those one trains on show."""
    shown = spread([frame for frame in frames if frame.mask is None or frame.mask.any()], views)
    return triangulate(shown, None, options, progress) if len(shown) > 1 else ScenePoints.none()


def points_in_view(
    camera: Camera, points: np.ndarray, options: MatchingConfig = MatchingConfig(), where: np.ndarray | None = None, threads: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [M, 2] and depths [M] (m) of those of the points [N, 3] (m, world) that lie in a view, or in some of its pixels [H, W].

    A point whose depth disagrees with that of its neighbours in the image is a wrong match or hidden, and left out.
    """
    uv, z = camera.project(points)
    seen = camera.contains(uv, z)
    first = np.unique(uv[seen] @ [1, 1j], return_index=True)[1]  # as complex numbers they are sorted several times as fast
    uv, z = uv[seen][first], z[seen][first]
    if where is None:
        agrees = _like_those_around(uv, z, options)
    else:
        columns, rows = np.floor(uv).astype(int).T
        agrees = _like_those_around(uv, z, options, where[rows, columns], threads)
    return uv[agrees], z[agrees]


def _like_those_around(
    uv: np.ndarray, z: np.ndarray, options: MatchingConfig, which: np.ndarray | None = None, threads: int = 1
) -> np.ndarray:
    """Which of the points at pixels [N, 2], or of some [N], have a depth [N] like that of the eight around them; none of too few."""
    alike = np.zeros(len(uv), bool)
    chosen = np.arange(len(uv)) if which is None else np.flatnonzero(which)
    if len(uv) > 8 and len(chosen):
        around = z[cKDTree(uv).query(uv[chosen], k=9, workers=threads)[1][:, 1:]]
        alike[chosen] = np.abs(np.median(around, axis=1) / z[chosen] - 1) < options.outlier_depth
    return alike


def _intersect(
    first: Camera, second: Camera, uv_1: np.ndarray, uv_2: np.ndarray, options: MatchingConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [M, 3] where the rays of two views meet, the indices [M] of the matches that gave one, and the angles [M] between the rays."""
    homogeneous = cv2.triangulatePoints(first.K @ first.viewmat[:3], second.K @ second.viewmat[:3], uv_1.T, uv_2.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (homogeneous[:3] / homogeneous[3]).T
    good = np.isfinite(points).all(1)
    points = np.where(good[:, None], points, 0.0)
    directions = []
    for camera, uv in ((first, uv_1), (second, uv_2)):
        projected, z = camera.project(points)
        good &= (z > 0) & (np.linalg.norm(projected - uv, axis=1) < options.reprojection_error)
        ray = points - camera.position
        directions.append(ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12))
    parallax = np.arccos(np.clip((directions[0] * directions[1]).sum(1), -1, 1))
    good &= parallax > np.radians(options.min_parallax)
    return points[good], np.nonzero(good)[0], np.minimum(parallax[good], np.pi / 4)  # beyond it, depth is as well known as position
