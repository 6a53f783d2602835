"""Colours of the tissues."""

from typing import NamedTuple

import numpy as np


class Tissue(NamedTuple):
    """Look of one tissue: display colours (0-255) and the strengths of its marks."""

    base: tuple[int, int, int]
    second: tuple[int, int, int]  # what the mottling drifts towards: congestion, muscle, bile
    patch: tuple[int, int, int]  # lobules of fat, or pale spots
    patches: float
    vessels: float  # darkness of the branching vessels
    capillaries: float
    wetness: float


WALLS = (
    Tissue((212, 136, 126), (176, 84, 82), (238, 168, 134), 0.75, 0.85, 0.30, 0.9),  # peritoneum over fat
    Tissue((196, 116, 104), (158, 66, 62), (230, 152, 112), 0.60, 0.80, 0.30, 0.9),  # muscle shining through
    Tissue((210, 138, 128), (176, 90, 92), (226, 164, 142), 0.70, 0.85, 0.35, 0.9),
)
ORGANS = (
    Tissue((206, 126, 122), (186, 100, 98), (222, 154, 148), 0.50, 1.05, 0.50, 0.7),  # stomach
    Tissue((222, 152, 108), (196, 114, 92), (236, 186, 148), 0.45, 0.85, 0.30, 0.8),  # gallbladder
    Tissue((200, 112, 106), (164, 72, 72), (222, 150, 142), 0.40, 0.95, 0.60, 0.8),  # uterus
    Tissue((220, 148, 130), (196, 110, 100), (236, 186, 162), 0.55, 0.95, 0.45, 0.8),  # small bowel
)
LOBES = (
    Tissue((154, 94, 86), (126, 62, 58), (150, 112, 112), 0.70, 0.95, 0.9, 0.7),  # congested bowel
    Tissue((124, 50, 46), (94, 32, 34), (146, 74, 66), 0.30, 0.45, 0.7, 1.0),  # liver
    Tissue((136, 62, 54), (104, 42, 42), (150, 88, 76), 0.35, 0.50, 0.7, 1.0),
)
BLOOD = np.array([0.50, 1.50, 1.30], np.float32)  # absorption per unit of blood, red to blue, of a soft red vessel
DEEP_BLOOD = np.array([1.05, 1.20, 0.95], np.float32)  # of veins seen through tissue, which scatters blue back


def linear(display: tuple[int, int, int]) -> np.ndarray:
    """Albedo [3] that a display colour (0-255) stands for."""
    return (np.array(display, np.float32) / 255.0) ** np.float32(2.2)
