"""Tubes on tissue, vessels and ducts: how they run, how they move with the skin, how far capsules are from them, and what they look like.

A tube is a row of rings about its axis. Its ends lie in the tissue; between them it lies on the skin, or bridges it. Each ring moves as
the nodes of the skin around it do.
"""

from collections.abc import Sequence

import numpy as np

from endo_sim_ros.instruments import Capsule, Material, Part
from endo_sim_ros.instruments.shapes import lofted

_HALF = 1e-3 * np.array([1.5, 3.5, 5.5, 8.0, 11.0, 14.0, 17.0, 20.0, 23.0, 26.0, 29.0, 32.0])
RINGS = np.concatenate([-_HALF[::-1], _HALF])
"""Where the rings are along the axis [R], from the middle of the tube, m. Between the two next to the middle it may be dyed."""

ANCHORS = np.array([2, 6, 10, 13, 17, 21])
"""Rings below which the nodes of the skin lie that the tube moves with."""

_AROUND = 12  # corners of a ring
_EVERY = 2  # rings from the start of a capsule, which throws a shadow, to its end
_SHADOW = 2.2e-3  # m: radius with which a tube throws its shadow, the mean of those that there are
_SKIN, _SPREAD = 0.003, 0.008  # m: nodes of the skin around a place that tell its height, and how it moves
_FAR = np.outer(RINGS, [1, 0, 0]) + [0, 0, 1.0]  # m, towards the endoscope and so behind it: where tubes are that an episode does not have


class Vessels:
    """V tubes in each of B episodes. All is in the frames of the episodes, m.

    Args:
        episodes: B.
        count: V.
    """

    def __init__(self, episodes: int, count: int):
        self.rest = np.zeros((episodes, count, len(RINGS), 3))  # centres of the rings where the skin is at rest
        self.rings = self.rest.copy()  # and now
        self.radius = np.full((episodes, count), _SHADOW)
        self._weights = np.zeros((episodes, count, len(RINGS), len(ANCHORS)))

    def lay(self, b: int, courses: np.ndarray, radii: Sequence[float], anchors: np.ndarray) -> None:
        """Let the first N tubes of episode b run along courses [N, R, 3] with radii [N], and each move with nodes of the skin that are at
        anchors [N, n, 3] at rest; the episode has no others: these lie far away."""
        own, others = slice(len(courses)), slice(len(courses), None)
        self.rest[b, own], self.rest[b, others] = courses, _FAR
        self.rings[b] = self.rest[b]
        self.radius[b, own], self.radius[b, others] = radii, _SHADOW
        x, y, z = (courses[:, :, None, k] - anchors[:, None, :, k] for k in range(3))
        self._weights[b, own], self._weights[b, others] = _shares(x * x + y * y + z * z, _SPREAD), 0

    def follow(self, moved: np.ndarray) -> None:
        """Move with the anchors, which have moved by [B, V, n, 3] from rest."""
        self.rings = self.rest + sum(self._weights[..., k, None] * moved[:, :, k, None] for k in range(len(ANCHORS)))

    def gaps(self, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """How far capsules [B, J] are from each tube [B, V], as `gaps` has it."""
        return gaps(self.rings, self.radius, starts[:, None], ends[:, None], radii)

    def poses(self, narrowed: np.ndarray) -> np.ndarray:
        """Poses of the rings [B, V, R, 4, 4] with which `vessel_parts` are drawn.

        Args:
            narrowed: Factors on the radii of the rings [B, V, R].
        """
        along = np.gradient(self.rings, axis=2)
        x = np.cross([0.0, 0.0, 1.0], along)
        x /= np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-9)
        y = np.cross(along, x)
        y /= np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), 1e-9)
        poses = np.zeros((*self.rings.shape[:3], 4, 4))
        size = (narrowed * self.radius[..., None])[..., None]
        poses[..., :3, 0], poses[..., :3, 1], poses[..., :3, 3], poses[..., 3, 3] = size * x, size * y, self.rings, 1
        following = np.minimum(np.arange(len(RINGS)) + _EVERY, len(RINGS) - 1)
        poses[..., :3, 2] = self.rings[:, :, following] - self.rings
        return poses


def gaps(rings: np.ndarray, radius: np.ndarray, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """How far capsules are from tubes [...], m; less than zero where they overlap.

    Args:
        rings, radius: Of the tubes [..., R, 3] and [...].
        starts, ends, radii: Of the capsules [..., J, 3] and [J].
    """
    off = _between(starts[..., None, :], ends[..., None, :], rings[..., None, :-1, :], rings[..., None, 1:, :])  # [..., J, R - 1]
    return (off - radii[:, None]).min((-2, -1)) - radius


def ring_name(number: int, ring: int) -> str:
    """Name of the link that a ring of a tube is."""
    return f"ring_{number}_{ring}"


def vessel_parts(number: int, link: str, dyed: bool) -> tuple[list[Part], list[Capsule]]:
    """What a tube is drawn with: its wall, bent by its rings, whose poses `Vessels.poses` gives, and capsules that throw its shadow.

    Args:
        number: Of the tube.
        link: What it counts as.
        dyed: Whether its middle is dyed.
    """
    middle = len(RINGS) // 2
    pieces = [(0, middle - 1, False), (middle - 1, middle, True), (middle, len(RINGS) - 1, False)] if dyed else [(0, len(RINGS) - 1, False)]
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(_AROUND)], 1)
    parts = []
    for first, last, blue in pieces:
        count = last - first + 1
        _, faces = lofted(circle + np.arange(count)[:, None, None] * [0, 0, 1])
        names = [ring_name(number, ring) for ring in range(first, last + 1)]
        bones = (*(name for name in names for _ in range(_AROUND)), names[0], names[-1])
        vertices = np.concatenate([np.tile(circle, (count, 1)), np.zeros((2, 3))])
        normals = np.concatenate([np.tile(circle, (count, 1)), [[0, 0, -1], [0, 0, 1]]])
        parts.append(Part(link, Material.DYE if blue else Material.VESSEL, vertices.astype(np.float32), faces, bones, normals))
    ends = np.zeros(3), np.array([0.0, 0.0, 1.0])
    return parts, [Capsule(ring_name(number, ring), *ends, _SHADOW) for ring in range(0, len(RINGS), _EVERY)]


class Ground:
    """How high skin is, z being up.

    Args:
        skin: Its nodes [K, 3], m; what is above and below is told within `reach` of the origin.
    """

    reach, _spacing = 0.06, 0.003  # m

    def __init__(self, skin: np.ndarray):
        at = np.arange(-self.reach, self.reach + self._spacing, self._spacing)
        squares = (at[:, None, None] - skin[:, 0]) ** 2 + (at[:, None] - skin[:, 1]) ** 2
        self._heights = (_shares(squares, _SKIN) * skin[:, 2]).sum(2)

    def heights(self, places: np.ndarray) -> np.ndarray:
        """Heights [...] at places [..., 2], m."""
        across = np.minimum(np.maximum((places + self.reach) / self._spacing, 0), len(self._heights) - 1.001)
        before = across.astype(int)
        u, v = (across - before)[..., 0], (across - before)[..., 1]
        heights, corner, row = self._heights.ravel(), before[..., 0] * len(self._heights) + before[..., 1], len(self._heights)
        near, far = ((1 - v) * heights[at] + v * heights[at + 1] for at in (corner, corner + row))
        return (1 - u) * near + u * far


def run_over(
    ground: Ground, place: np.ndarray, heading: np.ndarray, bend: np.ndarray, height: np.ndarray, depth: np.ndarray, ends: np.ndarray,
    rings: np.ndarray = RINGS,
) -> np.ndarray:  # fmt: skip
    """Axes [n, R, 3] of tubes over skin, m, z being up; beside headings and curvatures 1 is enough of what all n share.

    Args:
        ground: The skin.
        place: Where their middles are [n, 2], m.
        heading: Directions there [n], rad from x to y.
        bend: Curvatures [n], 1/m.
        height: Of the axes above the skin in the middle [n], m.
        depth: Of the axes below it at the ends [n], m.
        ends: How far these are from the middle [n, 2], m.
        rings: Where along them [R], from the middle, m.
    """
    c, s, aside = np.cos(heading)[:, None], np.sin(heading)[:, None], 0.5 * bend[:, None] * rings**2
    axes = np.empty((len(heading), len(rings), 3))
    axes[..., 0], axes[..., 1] = place[:, :1] + c * rings - s * aside, place[:, 1:] + s * rings + c * aside
    way = np.minimum(np.abs(rings) / np.where(rings < 0, ends[:, :1], ends[:, 1:]), 1.2)
    axes[..., 2] = ground.heights(axes[..., :2]) + height[:, None] - (height + depth)[:, None] * (way * way * way)
    return axes


def _shares(squares: np.ndarray, spread: float) -> np.ndarray:
    """Weights [..., n] of places at squared distances [..., n], m², that add up to 1."""
    weights = np.exp(-(squares - squares.min(-1, keepdims=True)) / (2 * spread * spread))
    return weights / weights.sum(-1, keepdims=True)


def _between(a: np.ndarray, b: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distances [...] between segments from a to b and from p to q [..., 3] (Ericson, Real-Time Collision Detection, 5.1.9)."""
    # Each coordinate by itself: numbers that are worked on together lie together.
    starts, stops, others, last = ([np.ascontiguousarray(ends[..., k]) for k in range(3)] for ends in (a, b, p, q))
    less = lambda v, w: [one - other for one, other in zip(v, w)]
    dot = lambda v, w: v[0] * w[0] + v[1] * w[1] + v[2] * w[2]
    share = lambda value: np.minimum(np.maximum(value, 0.0), 1.0)
    d1, d2, r = less(stops, starts), less(last, others), less(starts, others)
    aa, ee, f, c, bb = dot(d1, d1), dot(d2, d2), dot(d2, r), dot(d1, r), dot(d1, d2)
    aa, ee = np.maximum(aa, 1e-14), np.maximum(ee, 1e-14)
    cross = aa * ee - bb * bb
    s = np.where(cross > 1e-6 * aa * ee, share((bb * f - c * ee) / np.maximum(cross, 1e-28)), 0.0)
    t = share((bb * s + f) / ee)
    s = share((bb * t - c) / aa)  # nearest to where t has come to
    way = [x + s * along - t * other for x, along, other in zip(r, d1, d2)]
    return np.sqrt(dot(way, way))
