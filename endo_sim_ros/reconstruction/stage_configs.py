"""Options of the stages that prepare a scene, in the order of the pipeline; `ReconstructionConfig` nests them."""

from dataclasses import dataclass
from typing import Annotated

from endo_sim_ros.core.config import Range, StageConfig


@dataclass(frozen=True)
class UsableViewsConfig(StageConfig):
    """Which views show enough tissue to be trained on."""

    white: Annotated[int, Range(1, 255, "grey levels")] = 250
    """A pixel of which all channels are at least this is overexposed; encoders leave white a few levels short of 255."""
    overexposed_share: Annotated[float, Range(0, 1)] = 0.5
    """Share of a view's tissue that is overexposed, above which the view is left out."""
    black: Annotated[int, Range(0, 254, "grey levels")] = 8
    """A pixel of which no channel is above this is black: the noise of a dark sensor stays below."""
    black_share: Annotated[float, Range(0, 1)] = 0.95
    """Share of a view's tissue that is black, above which the view is left out; much of a good one may lie in the dark."""


@dataclass(frozen=True)
class MatchingConfig(StageConfig):
    """Features that views share, and scene points triangulated from them."""


@dataclass(frozen=True)
class PosesConfig(StageConfig):
    """Which poses contradict what the views share."""


@dataclass(frozen=True)
class DepthPriorConfig(StageConfig):
    """Depth by stereo matching, a network or interpolation between scene points."""


@dataclass(frozen=True)
class MultiViewConfig(StageConfig):
    """Refinement of the depth prior by other images of the same tissue."""


@dataclass(frozen=True)
class DynamicMaskConfig(StageConfig):
    """What moved between the views."""


@dataclass(frozen=True)
class InitialModelConfig(StageConfig):
    """The Gaussians that training starts from."""


@dataclass(frozen=True)
class PhotometryConfig(StageConfig):
    """The light at the camera and each view's exposure, before training."""


@dataclass(frozen=True)
class ExtrapolationConfig(StageConfig):
    """Gaussians where no view has seen the tissue."""
