"""Blood vessels that branch over the surface."""

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.sequences.phantom.height_field import CELL, HALF_WIDTH, SIDE


class Vessels:
    """Blood vessels, drawn as trees that do not cross: a branch ends where it meets tissue that another supplies.

    Args:
        rng: Where the randomness comes from.
        room: Width of the strip that a vessel keeps to itself, metres.
    """

    CALIBRES = (0.00022, 0.00055)  # radii between fine, middle and large vessels, metres
    SMALLEST = 0.00010  # radius at which branches end, metres

    def __init__(self, rng: np.random.Generator, room: float = 0.0016):
        self.canvas = np.zeros((len(self.CALIBRES) + 1, SIDE, SIDE), np.float32)  # blood of each calibre, finest first
        self._rng, self._room, self._count = rng, room, 0
        self._owners = np.zeros((int(2 * HALF_WIDTH / room) + 1,) * 2, np.int64)

    def grow(self, origin: ArrayLike, heading: float, radius: float, *, wander: float = 0.3, reach: float = 1.0) -> None:
        """Draw one tree. A vessel keeps its course but wanders, tapers, and forks by Murray's law r³ = r1³ + r2³.

        Args:
            origin: Root [2], metres.
            heading: Initial direction, radians.
            radius: Radius at the root, metres.
            wander: How far a vessel strays from its course, radians.
            reach: Length of vessels as a multiple of the usual.
        """
        rng = self._rng
        branches: list[tuple[np.ndarray, float, float, int]] = [(np.asarray(origin, np.float64), heading, radius, 0)]
        strokes: list[tuple[list[np.ndarray], float]] = []
        while branches:
            point, course, r, parent = branches.pop(0)  # the large ones first, so that they find room
            self._count += 1
            name, stray, since_fork = self._count, 0.0, 0.0
            fork_after = reach * rng.uniform(0.5, 1.4) * (0.004 + 12.0 * r)
            points = [point]
            while r > self.SMALLEST and since_fork < fork_after:
                stray = 0.80 * stray + wander * rng.standard_normal()
                course += 0.04 * wander * rng.standard_normal()
                step = max(0.0007, 0.9 * r)
                point = point + step * np.array([math.cos(course + stray), math.sin(course + stray)])
                if not self._claim(point, name, parent):
                    break
                points.append(point)
                since_fork += step
                r *= 1.0 - 1.8 * step  # tapers by a sixth per decimetre
                if len(points) == 4:
                    strokes.append((points, r))
                    points = [point]
                if rng.random() < 90.0 * step and r > 1.5 * self.SMALLEST:  # a twig that leaves the trunk as it is
                    side = rng.choice([-1.0, 1.0])
                    branches.append((point, course + side * rng.uniform(0.6, 1.3), r * rng.uniform(0.3, 0.55), name))
            else:
                if r > self.SMALLEST:
                    share, side = rng.uniform(0.35, 0.65), rng.choice([-1.0, 1.0])
                    for part, sign in ((share, side), (1.0 - share, -side)):  # the weaker branch turns the farther
                        turn = sign * (0.15 + 0.8 * (1.0 - part))
                        branches.append((point, course + turn, r * part ** (1 / 3), name))
            strokes.append((points, r))
        if len(strokes) > 5:  # a tree that found no room to grow is no vessel
            for points, r in strokes:
                self._stroke(points, r)

    def _claim(self, point: np.ndarray, name: int, parent: int) -> bool:
        """Take the place at a point unless it is outside or another vessel's, the parent's excepted."""
        if np.abs(point).max() > HALF_WIDTH:
            return False
        place = tuple(((point + HALF_WIDTH) / self._room).astype(int))
        owner = self._owners[place]
        if owner == 0:
            self._owners[place] = name
        return owner in (0, name, parent)

    def _stroke(self, points: list[np.ndarray], r: float) -> None:
        level = sum(r > calibre for calibre in self.CALIBRES)
        thickness = 2.0 * r / CELL
        # A line is at least one cell wide: thinner ones are drawn fainter instead.
        strength = min(thickness, 1.0) * (0.5 + 0.5 * min(r / 0.0007, 1.0))
        cells = np.round((np.array(points) + HALF_WIDTH) / CELL * 16).astype(np.int32)
        cv2.polylines(self.canvas[level], [cells], False, strength, max(round(thickness), 1), cv2.LINE_AA, 4)
