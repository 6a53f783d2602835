"""Options of the rendering stage."""

from dataclasses import dataclass
from typing import Annotated, Literal

from endo_sim_ros.core.config import Range, StageConfig


@dataclass(frozen=True)
class InsideConfig(StageConfig):
    """What an open cut shows below the skin. A reconstruction knows the skin alone; the rest is made up."""

    shown: bool = True
    """Show flesh in open cuts; false leaves them dark. Without cuts it changes nothing."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Of the irregularities of the flesh: the same seed gives the same flesh."""
    fat_from: Annotated[float, Range(0, 0.1, "m")] = 0.001
    """Depth below the skin at which its own colour gives way to fat."""
    flesh_from: Annotated[float, Range(0, 0.1, "m")] = 0.003
    """Depth at which fat gives way to dark red flesh."""
    organ: Annotated[float, Range(0, 0.1, "m")] = 0.008
    """Width of the bell curve with which the colour of the skin is averaged to tell an organ: below yellow skin fat is four times as deep,
    below dark red skin there is none, and flesh has the organ's own colour. 0 = all alike."""
    blood: Annotated[float, Range(0, 0.01, "m")] = 0.0004
    """Depth to half of the blood that seeps along the edges of a cut; the line of blood on the skin is 1.4 times as wide. 0 = none."""
    grain: Annotated[float, Range(1e-4, 0.01, "m")] = 0.0006
    """Distance between the Gaussians of the faces of a cut. Finer ones cost time with the square of it, coarser ones blur the layers."""


@dataclass(frozen=True)
class BehindConfig(StageConfig):
    """What is behind the skin where tissue is lifted off what it hid. Nobody saw it; it is made up."""

    shown: bool = True
    """Show dim tissue there; false shows the background. Tissue at rest looks the same with both."""
    dark: Annotated[float, Range(0, 1)] = 0.3
    """How much darker it is than the skin nearby, once that has left it: organs keep the light off each other."""


@dataclass(frozen=True)
class RenderingConfig(StageConfig):
    """From a Gaussian model and the state of its control nodes to camera images."""

    image_width: Annotated[int, Range(0, 8192, "pixels")] = 0
    """Width of the rendered image; 0 = that of the camera. The height follows."""
    background: Annotated[float, Range(-1, 1)] = -1.0
    """Grey level where there is no tissue; below 0 it is black, or the colour of what is around in the picture, as the model says."""
    skinning: Literal["compact", "softmax"] = "compact"
    """Weights from nodes to Gaussians: compact (1 - (d/d5)²)² with F, or the paper's printed softmax(d) with R."""
    clamp_stretch: bool = True
    """Keep what stretches each Gaussian, the singular values of its F, between 0.2 and 4; false takes F as the paper prints it, and
    tissue that is torn or turned inside out shows needles and holes."""
    neighbours: Annotated[int, Range(1, 32)] = 4
    """Number of nodes that move one Gaussian."""
    bared_strain: Annotated[float, Range(0.01, 10)] = 0.2
    """Strain ‖Fᵀ F − 1‖ / 2 of a node beside it from which on a Gaussian that others hid in training has the colour that was seen in front
    of it in place of its own. Less strain gives a part that grows with its square. Breath of 8 mm strains by up to 0.08, the pull of
    12 mm against the truth of synthetic patients by 0.26, jaws by up to 2."""
    inside: InsideConfig = InsideConfig()
    """What open cuts show."""
    behind: BehindConfig = BehindConfig()
    """What is behind the skin where it is lifted."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
