"""Options of the synthetic patient and of the endoscope that films it."""

import math
from dataclasses import dataclass
from typing import Annotated

from endo_sim_ros.core.config import ConfigError, Range, StageConfig

PULL_RADIUS = 0.02  # metres, standard deviation of what moves: about what a grasper takes along
BREATH_RADIUS = 0.06  # the diaphragm moves whole organs
HEART_RADIUS = 0.03  # the heart moves what lies on it
_STEEPEST = 0.92  # gradient of a displacement; with 1 tissue could fold


@dataclass(frozen=True)
class PhantomConfig(StageConfig):
    """The synthetic patient and the endoscope that films it."""

    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Patient: anatomy, colours, vessels and camera path all follow from it."""
    frames: Annotated[int, Range(1, 100_000)] = 250
    """Length of the sequence."""
    fps: Annotated[float, Range(0.1, 1000.0, "Hz")] = 25.0
    """Frame rate."""
    width: Annotated[int, Range(8, 4096, "px")] = 640
    """Image width."""
    height: Annotated[int, Range(8, 4096, "px")] = 512
    """Image height."""
    fov_deg: Annotated[float, Range(20.0, 90.0, "deg")] = 60.0
    """Horizontal field of view."""
    travel: Annotated[float, Range(0.0, 0.06, "m")] = 0.03
    """How far the tip of the endoscope moves sideways, end to end; it dives in and out by half as much."""
    flight: Annotated[float, Range(0.0, 1.0, "m")] = 0.0
    """How far the endoscope also flies to the right over the tissue, which goes on as far: another organ every 28 cm. 0 = it
    stays in front of one organ."""
    rounds: Annotated[float, Range(0.05, 10.0)] = 1.0
    """How often it goes round its path; after whole rounds it is back where it began."""
    lever: Annotated[float, Range(0.05, 0.5, "m")] = 0.14
    """Distance from the trocar, about which the endoscope pivots, to its tip."""
    stereo: bool = True
    """Also render the right image."""
    baseline: Annotated[float, Range(0.0005, 0.05, "m")] = 0.0054
    """Distance between the lenses of the stereo endoscope."""
    exposure: Annotated[float, Range(0.1, 10.0)] = 1.0
    """Brightness of the light source."""
    auto_exposure: bool = False
    """Let the camera hold its mean brightness, as endoscopes do, instead of keeping the exposure fixed."""
    noise: Annotated[float, Range(0.0, 20.0, "grey levels")] = 1.2
    """Standard deviation of the sensor noise in 8-bit grey levels."""
    border: Annotated[float, Range(0.0, 0.3)] = 0.0
    """Black frame with round corners, as a fraction of the image height; masked out, without depth."""

    deformed: Annotated[float, Range(0.0, 0.03, "m")] = 0.0
    """How far tissue in the middle of the flight is pulled towards the endoscope and aside, in all frames; 2 cm off it follows by 0.6
    of it, 4 cm off by 0.14."""
    breathing: Annotated[float, Range(0.0, 0.03, "m")] = 0.0
    """How far breath moves the organs there and back."""
    breathing_period: Annotated[float, Range(0.1, 60.0, "s")] = 4.0
    """Time from breath to breath."""
    breathing_irregularity: Annotated[float, Range(0.0, 0.9)] = 0.0
    """Part of `breathing_period` by which breaths are longer or shorter at random, at most: 0.25 of 4 s gives breaths of 3 to 5 s."""
    heartbeat: Annotated[float, Range(0.0, 0.01, "m")] = 0.0
    """How far the heart moves what lies on it."""
    heartbeat_period: Annotated[float, Range(0.1, 10.0, "s")] = 0.9
    """Time from beat to beat."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # The largest gradient of a Gaussian bump is its height over its radius, times exp(−1/2).
        steepest = math.exp(-0.5) * (self.deformed / PULL_RADIUS + self.breathing / BREATH_RADIUS + self.heartbeat / HEART_RADIUS)
        if steepest > _STEEPEST:
            raise ConfigError(
                f"deformed {self.deformed:g} m, breathing {self.breathing:g} m and heartbeat {self.heartbeat:g} m together fold the "
                "tissue; give less of them"
            )

    @property
    def sections(self) -> int:
        """Organs side by side, so that the surface reaches 10 cm beyond the flight on both sides, where the views end."""
        return max(math.ceil((self.flight + 0.16) / 0.28), 1)
