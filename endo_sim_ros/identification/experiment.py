"""What was done to tissue, and what was measured of it."""

from dataclasses import dataclass, field

import numpy as np

from endo_sim_ros.core.cameras import Camera


@dataclass(frozen=True)
class Tracks:
    """Points of the skin that were followed in images.

    Args:
        rest: Where they are at rest [K, 3], m, world.
        steps: Step at the end of which each image was taken [F], of the steps of the experiment.
        pixels: Where they were seen [F, K, 2], pixels; NaN where a point was not seen.
        cameras: Of each image [F].
        noise: Standard deviation of a pixel coordinate.
        lasting: Standard deviation of an error that lasts, pixels, in the image in which points have moved farthest.
    """

    rest: np.ndarray
    steps: np.ndarray
    pixels: np.ndarray
    cameras: list[Camera]
    noise: float = 0.5
    lasting: float = 0.0


@dataclass(frozen=True)
class Experiment:
    """One tool that touches tissue for T steps of `step_duration`, beginning with tissue at rest.

    Args:
        step_duration: s.
        tips: Where the tip is at the end of each step [T, 3], m, world.
        rotations: Its axes [T, 3, 3], world.
        present: Whether the tool is known to be there [T], bool.
        closed: Whether its jaw is closed [T], bool.
        forces: What the tissue exerts on the tool at the end of each step [T, 3], N, world; NaN where it was not measured.
        force_noise: Standard deviation of a component of the force, N.
        tip_noise: Standard deviation of a coordinate of the tip, m.
        displacements: Of control nodes [T, L, 3], m, NaN where unknown, or None.
        nodes: Which control nodes these are [L].
        displacement_noise: Standard deviation of a coordinate of a displacement, m.
        tracks: Points that were followed in images, one entry a camera.
    """

    step_duration: float
    tips: np.ndarray
    rotations: np.ndarray
    present: np.ndarray
    closed: np.ndarray
    forces: np.ndarray
    force_noise: float = 0.05
    tip_noise: float = 0.0005
    displacements: np.ndarray | None = None
    nodes: np.ndarray | None = None
    displacement_noise: float = 0.0005
    tracks: list[Tracks] = field(default_factory=list)
