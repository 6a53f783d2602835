"""The surface: a height field of a wall, an organ, a ligament and a lobe, the nearest of which is seen."""

import math

import numpy as np

from endo_sim_ros.sequences.phantom.height_field import CELL, HALF_WIDTH, blur, noise, smoothstep, vertices


class Anatomy:
    """The surface, nearest of its parts: `heights` z [SIDE, SIDE], metres, and what of each part is seen where.

    `shares` [parts, SIDE, SIDE] sums to one at every vertex; `fan_angle` (-1..1 over the ligament's width) and
    `fan_radius` (metres from where it is held) [SIDE, SIDE] are coordinates on the ligament.
    """

    WALL, ORGAN, LIGAMENT, LOBE = range(4)

    def __init__(self, rng: np.random.Generator):
        x, y = vertices()
        # Bend the plane in which the outlines are drawn, so that none of them is a textbook curve.
        bend_x, bend_y = 0.006 * noise(rng, 0.07, 2), 0.006 * noise(rng, 0.07, 2)
        bent_x, bent_y = x + bend_x, y + bend_y

        # where the ligament holds the organ
        self.apex = np.array([rng.uniform(-0.030, -0.005), rng.uniform(-0.020, -0.008)], np.float32)
        wall = self._wall(rng, x, y)
        organ = self._organ(rng, bent_x, bent_y)
        lobe = self._lobe(rng, bent_x, bent_y)
        ligament, self.fan_angle, self.fan_radius = self._ligament(rng, bent_x, bent_y, organ, wall)

        heights = np.stack([wall, organ, ligament, lobe])
        nearest = heights.min(0)
        # The parts meet in a narrow fillet; its weights also blend their textures.
        weights = nearest - heights
        weights /= np.float32(0.0005)
        np.exp(weights, out=weights)
        total = weights.sum(0)
        weights /= total
        self.shares = weights
        fillet = nearest - np.float32(0.0005) * np.log(total)
        self.heights = blur(fillet, 0.0004)  # no edge of tissue is sharper than this

    def _wall(self, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """A cavity that closes in on the camera away from the axis, with hanging folds."""
        turn = rng.normal(0.0, 0.25)
        across = x * math.cos(turn) + y * math.sin(turn) + 0.012 * noise(rng, 0.06, 2)
        wave = np.cos(across * (2.0 * math.pi / rng.uniform(0.028, 0.038)) + rng.uniform(0, 2.0 * math.pi))
        folds = (0.5 + 0.5 * wave) ** 1.5
        strength = smoothstep(noise(rng, 0.09), -0.8, 1.0)
        cavity = 0.9 * (x * x + y * y) * (1.0 + 0.3 * rng.standard_normal() * x / HALF_WIDTH)
        return 0.144 - 0.008 * folds * strength - 0.0030 * noise(rng, 0.045, 3, (0.7, 1.4)) - cavity

    def _organ(self, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """A rounded body, hung from its apex, that turns away steeply at its outline."""
        angle = rng.uniform(0.35, 0.75)  # its long axis runs down and to the right
        long, short = rng.uniform(0.066, 0.078), rng.uniform(0.036, 0.043)
        centre = self.apex + np.array([math.cos(angle), math.sin(angle)], np.float32) * long * 0.62 + np.array([0.0, 0.012], np.float32)
        a = (x - centre[0]) * math.cos(angle) + (y - centre[1]) * math.sin(angle)
        b = -(x - centre[0]) * math.sin(angle) + (y - centre[1]) * math.cos(angle)
        radius = ((np.abs(a) / long) ** 2.3 + (np.abs(b) / (short * np.clip(1.0 + 0.28 * a / long, 0.5, 1.5))) ** 2.3) ** (1 / 2.3)
        dome = np.maximum(1.0 - radius * radius, 0.0) ** 0.62
        height = rng.uniform(0.022, 0.027)
        relief = 0.0008 * noise(rng, 0.022, 2) + 0.00018 * noise(rng, 0.006, 2)
        beyond = np.maximum(radius - 1.0, 0.0) * 0.12  # falls behind the wall outside its outline
        return 0.143 - height * dome + beyond - relief * smoothstep(dome, 0.0, 0.4)

    def _lobe(self, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The next organ, its rounded rim entering from below, close to the camera."""
        rim = rng.uniform(0.030, 0.040) + rng.normal(0, 0.06) * x + 0.10 * np.abs(x) * rng.uniform(0, 1)
        inside = y - rim - 0.004 * noise(rng, 0.05, 2)
        rise = 1.0 - np.exp(-np.maximum(inside, 0.0) / 0.011)
        furrows = 0.0012 * noise(rng, 0.02, 3, (0.7, 1.6)) + 0.0003 * noise(rng, 0.004, 2)
        return 0.138 - rng.uniform(0.024, 0.030) * rise - furrows * rise - np.minimum(inside, 0.0) * 2.0

    def _ligament(
        self, rng: np.random.Generator, x: np.ndarray, y: np.ndarray, organ: np.ndarray, wall: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A taut translucent fan from the apex of the organ up to the wall; with the maps of its angle and radius."""
        heading = rng.uniform(-1.75, -1.15)  # image y points down: upwards
        spread = rng.uniform(0.24, 0.34)
        dx, dy = x - self.apex[0], y - self.apex[1] - np.float32(0.012)
        radius = np.hypot(dx, dy)
        angle = (np.arctan2(dy, dx) - heading + math.pi) % (2 * math.pi) - math.pi
        column, row = ((self.apex + HALF_WIDTH) / CELL).astype(int)
        start = organ[row + int(0.010 / CELL), column]
        along = smoothstep(radius, 0.0, 0.075)
        slack = 0.0060 * smoothstep(angle / spread, -1.0, 0.6) - 0.0015  # one side lies on the wall, one is free
        sheet = start + along * (blur(wall, 0.008) - slack - start) + 0.0015 * (1.0 - along)
        edge = np.maximum(np.abs(angle) - spread, 0.0) * radius
        behind = np.maximum(0.020 - radius, 0.0)  # grows out of the organ instead of ending on it
        return sheet + np.where(angle > 0.0, np.float32(4.0), np.float32(0.7)) * edge + 0.35 * behind, angle / spread, radius
