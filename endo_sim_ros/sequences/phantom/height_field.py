"""The grid of vertices on which the surface is built, and smooth noise over it."""

import math
from collections.abc import Sequence

import cv2
import numpy as np

CELLS = 2048  # of one section of the surface, a side: a power of two
HALF_WIDTH = 0.16  # metres from the centre of a section to its border, where the surface is mirrored or the next section begins
CELL = 2 * HALF_WIDTH / CELLS
SIDE = CELLS + 1  # vertices
SEAM = 256  # cells over which two sections pass into each other, 4 cm: a multiple of the coarsest cells of the renderer


def noise(rng: np.random.Generator, scale: float, octaves: int = 1, stretch: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    """Smooth noise [SIDE, SIDE] of about zero mean and unit deviation.

    Args:
        rng: Where the randomness comes from.
        scale: Size of the largest features, metres.
        octaves: How often finer noise, half in size and strength, is added.
        stretch: Factors on the size along x and y.
    """
    finest = scale * min(stretch) * 0.5 ** (octaves - 1)
    factor = max(int(finest / (8 * CELL)), 1)
    side = math.ceil(SIDE / factor)  # drawn small, with eight samples per finest feature, and enlarged
    total, power = np.zeros((side, side), np.float32), 0.0
    for octave in range(octaves):
        amplitude = 0.5**octave
        across, down = (side * scale * s * amplitude / (2 * HALF_WIDTH) for s in stretch)  # samples per feature
        columns, rows = math.ceil(side / across) + 3, math.ceil(side / down) + 3
        grid = rng.standard_normal((rows, columns)).astype(np.float32)
        wide = cv2.resize(grid, (math.ceil(columns * across), math.ceil(rows * down)), interpolation=cv2.INTER_CUBIC)
        left, top = int(rng.uniform(1.0, 2.0) * across), int(rng.uniform(1.0, 2.0) * down)  # any phase, off the border
        total += amplitude * wide[top : top + side, left : left + side]
        power += amplitude**2
    total /= np.float32(0.65 * math.sqrt(power))
    if factor == 1:
        return total
    # Linear interpolation and two running means make a cubic B-spline: glints would betray any kink in the slope.
    total = cv2.resize(total, (SIDE, SIDE), interpolation=cv2.INTER_LINEAR)
    box = (factor | 1, factor | 1)
    return cv2.blur(cv2.blur(total, box, borderType=cv2.BORDER_REFLECT_101), box, borderType=cv2.BORDER_REFLECT_101)


def smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Rise from 0 at low to 1 at high, level at both ends."""
    t = x - low  # new arrays are fetched page by page, which takes longer than what is done with them
    t /= high - low
    np.clip(t, 0.0, 1.0, out=t)
    slowed = 2.0 * t
    np.subtract(3.0, slowed, out=slowed)
    t *= t
    t *= slowed
    return t


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur with a standard deviation in metres; wide ones work on a reduced image."""
    pixels = sigma / CELL
    if pixels < 8:
        return cv2.GaussianBlur(image, (0, 0), pixels, borderType=cv2.BORDER_REFLECT_101)
    factor = 2 ** int(math.log2(pixels / 3))
    small = cv2.resize(image, (SIDE // factor, SIDE // factor), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), pixels / factor, borderType=cv2.BORDER_REFLECT_101)
    return cv2.resize(small, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)


def vertices() -> tuple[np.ndarray, np.ndarray]:
    """World x and y of every vertex, each [SIDE, SIDE], metres."""
    axis = np.linspace(-HALF_WIDTH, HALF_WIDTH, SIDE, dtype=np.float32)
    return np.meshgrid(axis, axis)


def joined(sections: Sequence[np.ndarray], seams: Sequence[np.ndarray]) -> np.ndarray:
    """Fields [SIDE, SIDE, ...] side by side along x, as one [SIDE, columns, ...].

    Args:
        sections: From left to right.
        seams: Between them, the share [SIDE, SEAM + 1] of the section on the right, from 0 to 1.
    """
    whole = sections[0]
    for section, seam in zip(sections[1:], seams, strict=True):
        share = seam.reshape(seam.shape + (1,) * (section.ndim - 2))
        left, right = whole[:, -SEAM - 1 :], section[:, : SEAM + 1]
        whole = np.concatenate([whole[:, : -SEAM - 1], left + share * (right - left), section[:, SEAM + 1 :]], 1)
    return whole
