"""Options of the drawing."""

from dataclasses import dataclass
from typing import Annotated

from endo_sim_ros.core.config import Range, StageConfig


@dataclass(frozen=True)
class DrawingConfig(StageConfig):
    """How instruments are lit and meet the tissue."""

    lamp_x: Annotated[float, Range(-0.05, 0.05, "m")] = 0.003
    """Where the lamp is beside the lens, to the right in the picture."""
    lamp_y: Annotated[float, Range(-0.05, 0.05, "m")] = -0.002
    """The same downwards."""
    lamp_size: Annotated[float, Range(0, 0.05, "m")] = 0.0015
    """Radius of the lamp, the end of a bundle of fibres: the larger, the softer are shadows."""
    shadows: bool = True
    """Whether instruments keep light from the tissue and from each other."""
    ambient: Annotated[float, Range(0, 1)] = 0.2
    """Share of the light that comes from all around: wet tissue reflects and scatters much of the lamp's."""
    mirror: Annotated[float, Range(0, 2)] = 1.0
    """How bright the tissue that metal mirrors is, as part of what it would be."""
    white: Annotated[float, Range(0.1, 10)] = 1.0
    """Brightest shine, as a part of what saturates the camera. Without a limit a glint would darken the whole picture through the
    exposure."""
    softness: Annotated[float, Range(1e-5, 0.01, "m")] = 4e-4
    """Depth over which an instrument comes out of the tissue; splats have no sharper surface."""
    blur: Annotated[float, Range(1, 3, "pixels")] = 1.5
    """Side of the square from which a pixel takes light: 1 is sharper than any lens, and than pictures whose colours were interpolated."""
