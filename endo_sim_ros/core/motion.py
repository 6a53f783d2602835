"""How breath and heart move tissue over time: shares of the way there, which the synthetic patient and the physics both follow."""

import math

MOTIONS = "breathing", "heartbeat"
"""What moves tissue by itself, in the order of all arrays that have both."""
MOTION_FILE = "motion.npz"
"""Beside a model: how its tissue moves."""
MOTION_PARAMETERS = "motion.yaml"
"""Beside that: the parameters with which physics_node plays it."""


def breath_share(seconds: float, period: float) -> float:
    """Share, 0 to 1, of its way that a breath of this period (s) has gone after so many seconds: there and back as a cosine."""
    return 0.5 - 0.5 * math.cos(2 * math.pi * seconds / period)


def beat_share(seconds: float, period: float) -> float:
    """Share, 0 to 1, of its way that a heartbeat of this period (s) has gone after so many seconds: a knock, a bell curve with a standard
    deviation of 0.08 periods about a quarter of the period."""
    apart = (seconds / period + 0.25) % 1.0 - 0.5  # from the nearest beat, in periods
    return math.exp(-0.5 * (apart / 0.08) ** 2)
