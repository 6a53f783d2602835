"""A ball of other stiffness below the skin: what `stiffness: inclusion` takes for unknown."""

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.physics import ControlNodes

PLACE = 2  # numbers of where it is across the skin, before depth, radius and ratio
COUNT = PLACE + 3
_EDGE = 0.25  # of the distance between control nodes: how wide its edge is, as a node half in it is half as much stiffer
_DEPTH_SD = 0.7  # of the logarithm: from a quarter of the median to four times that
_RADIUS_SD = 0.5
_SHALLOW = 1 / 3  # of the thickness of the tissue: the median of the depth


def near_touches(places: np.ndarray, touched: np.ndarray, reach: float) -> np.ndarray:
    """Numbers of the places [N, 3] within reach of where tools were [K, 3], m, world; of all where there are none."""
    near = np.flatnonzero(KDTree(touched).query(places)[0] <= reach) if len(touched) else np.zeros(0, int)
    return near if len(near) else np.arange(len(places))


class Ball:
    """Where it may be, and the tissue that it makes.

    Its five numbers z have standard normal priors: two along the skin, and the logarithms of its depth below the skin, of its radius, and
    of the ratio of its modulus to that around it.

    Args:
        nodes: At rest.
        config: What is known of it.
        touched: Places where tools were [K, 3], m, world: it is near them.

    Raises:
        ConfigError: If no skin is free.
    """

    def __init__(self, nodes: ControlNodes, config: IdentificationConfig, touched: np.ndarray):
        skin = nodes.rest[nodes.is_skin & ~nodes.pinned].astype(np.float64)
        if not len(skin):
            raise ConfigError("stiffness: inclusion needs skin that is not held")
        near = skin[near_touches(skin, touched, config.field_reach)]
        self.rest = nodes.rest.astype(np.float64)
        self._middle = near.mean(0)
        normal = Surface(nodes).outwards(self._middle[None])[0]
        across = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, :2].T
        self.axes = np.stack([*across, normal])  # rows; the last one out of the tissue
        flat = (near - self._middle) @ self.axes.T
        self.across = np.maximum(flat[:, :2].std(0), config.field_length)  # sd, m
        self._basis = lambda uv: np.stack([np.ones(len(uv)), *uv.T, uv[:, 0] ** 2, uv[:, 0] * uv[:, 1], uv[:, 1] ** 2], 1)
        self._bend = np.linalg.lstsq(self._basis(flat[:, :2] / self.across), flat[:, 2], rcond=None)[0]
        deep = KDTree(skin).query(self.rest[~nodes.is_skin])[0] if not nodes.is_skin.all() else np.array([nodes.spacing])
        self.thickness = float(np.quantile(deep, 0.95))
        self._medians = np.log([_SHALLOW * self.thickness, config.inclusion_radius, config.inclusion_ratio])
        self._sds = np.array([_DEPTH_SD, _RADIUS_SD, config.field_spread])
        self._edge = _EDGE * np.cbrt(np.maximum(nodes.volumes.astype(np.float64), 1e-15))

    def told(self) -> tuple[tuple[str, str, float, float], ...]:
        """Name, unit, median of the logarithm, and its standard deviation, of depth, radius and ratio."""
        names = (("inclusion_depth", "m"), ("inclusion_radius", "m"), ("inclusion_ratio", ""))
        return tuple((*name, float(m), float(s)) for name, m, s in zip(names, self._medians, self._sds))

    def shape(self, z: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Centre [3], m, world, radius, m, and logarithm of the ratio."""
        depth, radius = np.exp(self._medians[:2] + self._sds[:2] * z[PLACE:4])
        return self.centre(z[:PLACE], depth), float(radius), float(self._medians[2] + self._sds[2] * z[4])

    def centre(self, place: np.ndarray, depth: float) -> np.ndarray:
        """The place [3], m, world, so deep (m) below the skin, which is taken for a paraboloid."""
        height = float(self._basis(np.asarray(place, float)[None])[0] @ self._bend)
        return self._middle + np.array([*(self.across * place), height - depth]) @ self.axes

    def numbers(self, centre: np.ndarray) -> np.ndarray:
        """The first three numbers [3] of a centre [3], m, world."""
        flat = self.axes @ (centre - self._middle)
        place = flat[:2] / self.across
        depth = max(float(self._basis(place[None])[0] @ self._bend - flat[2]), 1e-4)
        return np.array([*place, (np.log(depth) - self._medians[0]) / self._sds[0]])

    def aside(self, centre: np.ndarray, touched: np.ndarray) -> float:
        """How far a centre [3] is along the surface from the nearest place that was touched [K, 3], m, world, if all of them lie on one
        side of it; else 0."""
        ways = (touched - centre) @ self.axes[:2].T
        angles = np.sort(np.arctan2(ways[:, 1], ways[:, 0]))
        surrounded = np.diff(angles, append=angles[0] + 2 * np.pi).max() <= np.pi
        return 0.0 if surrounded else float(np.sqrt((ways**2).sum(1)).min())

    def absent(self) -> float:
        """The number of a ratio of one."""
        return float(-self._medians[2] / self._sds[2])

    def logs(self, z: np.ndarray) -> np.ndarray:
        """Logarithms of the factors on the moduli of all control nodes [M]."""
        centre, radius, ratio = self.shape(z)
        distance = np.sqrt(((self.rest - centre) ** 2).sum(1))
        return ratio / (1 + np.exp(np.clip((distance - radius) / self._edge, -50, 50)))
