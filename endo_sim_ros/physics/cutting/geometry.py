"""Surfaces of cuts: triangles in the tissue at rest, and which straight lines they cross."""

import numpy as np

MIN_HEIGHT = 1e-6  # m; of a triangle worth keeping
ON_PLANE = 1e-9  # m; points this near to the plane of a triangle lie on its positive side
OVERLAP = 1e-6  # of a triangle, by which it reaches over its edges, so that two that share one leave no gap
UPWARD = np.array([0.531, 0.616, 0.582])  # tells the positive side of a plane, however its triangle is wound
BLOCK = 4_000_000  # bounding boxes compared at once


def sweep(start: np.ndarray, end: np.ndarray, whole: np.ndarray | None = None) -> np.ndarray:
    """Triangles [T, 3, 3] between a blade at the start and at the end of a step, as polylines [S, 3] each, in metres.

    A blade of two points gives T = 2. Triangles lower than a micrometre are left out, so a blade at rest or drawn along
    itself gives none.

    Args:
        start: Points of the blade [S, 3].
        end: The same later.
        whole: Which points cut all the way [S]; default: all. Between others there is no triangle.

    Raises:
        ValueError: If the shapes differ, or are not [S, 3] with S of at least 2.
    """
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    if start.shape != end.shape or start.ndim != 2 or start.shape[1] != 3 or len(start) < 2:
        raise ValueError(f"sweep: start has shape {start.shape} and end {end.shape}, expected both [S, 3] with S > 1")
    cutting = np.ones(len(start) - 1, bool) if whole is None else whole[:-1] & whole[1:]
    a, b, c, d = start[:-1][cutting], start[1:][cutting], end[1:][cutting], end[:-1][cutting]
    triangles = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1).reshape(-1, 3, 3)
    edges = triangles - np.roll(triangles, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(1)
    return triangles[np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > MIN_HEIGHT * longest]


def separated(a: np.ndarray, b: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Whether the segments from a [N, 3] to b [N, 3] cross any of the triangles [T, 3, 3]; bool [N].

    A point in the plane of a triangle counts as on one of its sides, the same for all triangles of that plane, so that a
    cut right through nodes parts them from one side only. Triangles reach a millionth over their edges.
    """
    a, b, triangles = np.asarray(a, np.float64), np.asarray(b, np.float64), np.asarray(triangles, np.float64)
    crossed = np.zeros(len(a), bool)
    if not len(triangles) or not len(a):
        return crossed
    pad = ON_PLANE + OVERLAP * np.ptp(triangles, axis=1)
    low, high = triangles.min(1) - pad, triangles.max(1) + pad  # [T, 3]
    first, last = np.minimum(a, b), np.maximum(a, b)
    near = np.flatnonzero(((first <= high.max(0)) & (last >= low.min(0))).all(1))
    if not len(near):
        return crossed
    first, last = first[near].T.copy(), last[near].T.copy()
    chunk = max(1, BLOCK // len(near))
    for begin in range(0, len(triangles), chunk):
        rows = slice(begin, begin + chunk)
        meets = np.ones((len(triangles[rows]), len(near)), bool)
        for axis in range(3):
            meets &= first[axis] <= high[rows, axis, None]
            meets &= last[axis] >= low[rows, axis, None]
        triangle, segment = np.nonzero(meets)
        segment = near[segment]
        hit = _crosses(a[segment], b[segment], triangles[begin + triangle])
        crossed[segment[hit]] = True
    return crossed


def _crosses(a: np.ndarray, b: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Whether each segment a–b [Q, 3] crosses its triangle [Q, 3, 3]."""
    origin, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    cross = np.cross(e1, e2)
    area = np.linalg.norm(cross, axis=1)
    normal = cross * (np.where(cross @ UPWARD < 0, -1, 1) / np.maximum(area, 1e-300))[:, None]
    height_a, height_b = ((a - origin) * normal).sum(1), ((b - origin) * normal).sum(1)
    apart = (height_a >= -ON_PLANE) != (height_b >= -ON_PLANE)
    t = np.clip(height_a / np.where(apart, height_a - height_b, 1), 0, 1)
    x = a + t[:, None] * (b - a) - origin
    # Barycentric coordinates of the crossing, from areas in the plane.
    square = np.where(area > 0, area**2, np.inf)
    u = (np.cross(x, e2) * cross).sum(1) / square
    v = (np.cross(e1, x) * cross).sum(1) / square
    return apart & (area > 0) & (u >= -OVERLAP) & (v >= -OVERLAP) & (u + v <= 1 + OVERLAP)
