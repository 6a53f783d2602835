"""Whether instruments run into each other."""

from collections.abc import Mapping, Sequence

import numpy as np

from endo_sim_ros.instruments.shapes import Capsule

Posed = tuple[Sequence[Capsule], Mapping[str, np.ndarray]]
"""Capsules of an instrument, and poses [..., 4, 4] of its links by name, world, m."""


def overlap(first: Posed, second: Posed, clear: float = 0.0) -> np.ndarray:
    """How deep two instruments are in each other where they are deepest [...], m; 0 where they do not touch.

    Args:
        first: One.
        second: The other.
        clear: How far apart they must be not to count as touching, m.
    """
    (a, b, thick), (p, q, thin) = _segments(*first), _segments(*second)
    a, b, p, q = a[..., :, None, :], b[..., :, None, :], p[..., None, :, :], q[..., None, :, :]
    gaps = np.linalg.norm(_shortest(a, b, p, q), axis=-1) - (thick[:, None] + thin) - clear
    return np.maximum(-gaps.min((-2, -1)), 0.0)


def _segments(capsules: Sequence[Capsule], links: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends [..., C, 3] and radii [C] of capsules in the world."""
    poses = np.stack([links[capsule.link] for capsule in capsules], -3)
    place = lambda ends: np.einsum("...cij,cj->...ci", poses[..., :3, :3], np.array(ends)) + poses[..., :3, 3]
    ends = [place([getattr(capsule, end) for capsule in capsules]) for end in ("start", "end")]
    return ends[0], ends[1], np.array([capsule.radius for capsule in capsules])


def _shortest(a: np.ndarray, b: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The shortest way from segments a b to segments p q [..., 3] (Ericson, Real-Time Collision Detection, 5.1.9)."""
    u, v, w = b - a, q - p, a - p
    uu, vv, uv, uw, vw = ((x * y).sum(-1) for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    tiny = 1e-18  # m²: a segment that short is a point
    apart = uu * vv - uv**2
    s = np.where(apart > tiny * uu, np.clip((uv * vw - vv * uw) / np.maximum(apart, tiny**2), 0, 1), 0.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0, 1)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0, 1)
    return w + s[..., None] * u - t[..., None] * v
