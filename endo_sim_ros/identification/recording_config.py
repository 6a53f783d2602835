"""Parameters of what is taken from a recording, or from a running graph."""

from dataclasses import dataclass
from typing import Annotated, Literal

from endo_sim_ros.core.config import ConfigError, Range, StageConfig


@dataclass(frozen=True)
class TouchConfig(StageConfig):
    """When a tool touches tissue, and how well it is measured."""

    clearance: Annotated[float, Range(0.0, 0.05, "m")] = 0.002
    """A tool that is farther than this from tissue at rest, beyond its own radius, does not touch it: about the error of a
    reconstructed surface."""
    settle: Annotated[float, Range(0.05, 60.0, "s")] = 0.4
    """Time without a touch after which tissue is at rest, or three times the `relaxation_time` of physics if it relaxes and that is longer.
    Each experiment begins so."""
    longest_gap: Annotated[float, Range(0.01, 10.0, "s")] = 0.2
    """Longest time without a pose through which the tool is taken to have moved straight."""
    jaw_closed: Annotated[float, Range(-3.2, 3.2, "rad")] = 0.1
    """A jaw at or below this angle holds the tissue at its tip. Tissue between the jaws of a robot keeps them wider open."""
    jaw_open: Annotated[float, Range(-3.2, 3.2, "rad")] = 0.2
    """A jaw at or above this angle lets go; between the two angles nothing changes."""
    force_noise: Annotated[float, Range(1e-4, 10.0, "N")] = 0.05
    """Standard deviation of a component of the force. Where a tool that touches nothing is seen to measure worse, that counts."""
    force_delay: Annotated[float, Range(-10.0, 10.0, "s")] = 0.0
    """How much later the clock of the forces is than that of the poses."""
    tip_noise: Annotated[float, Range(1e-6, 0.05, "m")] = 0.0005
    """Standard deviation of a coordinate of the tip in the world."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.jaw_closed >= self.jaw_open:
            raise ConfigError(f"jaw_closed, {self.jaw_closed:g} rad, must be less than jaw_open, {self.jaw_open:g} rad")


@dataclass(frozen=True)
class RecordingConfig(TouchConfig):
    """What is taken from a recording, and how well that was measured."""

    arms: tuple[str, ...] = ()
    """Names of the tool arms; default: all whose poses were recorded."""
    world_frame: str = "world"
    """Frame of the poses in the recording."""
    frames: tuple[str, ...] = ()
    """Other frames of poses and wrenches in the recording, as the nodes' parameter: 'PSM1_base x y z qx qy qz qw' each."""
    observed: Literal["auto", "control_nodes", "images", "none"] = "auto"
    """What tells how the tissue moves: control_nodes of a simulation, points followed in images, or auto: the first of these that was
    recorded."""
    points: Annotated[int, Range(4, 10_000)] = 60
    """Points that are followed in the images of an experiment, or control nodes that are looked at."""
    motion_reach: Annotated[float, Range(0.001, 0.5, "m")] = 0.03
    """These are within this distance of where the tool touches: tissue farther away hardly moves."""
    motion_rate: Annotated[float, Range(0.1, 100.0, "Hz")] = 5.0
    """Images, or states of control nodes, that are compared with the model. Points are followed in all images; more comparisons take
    long and tell little."""
    pixel_noise: Annotated[float, Range(0.01, 100.0, "pixels")] = 0.5
    """Standard deviation of a coordinate of a followed point."""
    displacement_noise: Annotated[float, Range(1e-6, 0.05, "m")] = 0.0005
    """Standard deviation of a coordinate of a recorded control node."""
    finer: Annotated[float, Range(1.0, 4.0)] = 1.0
    """How many times closer together the control nodes of tissue are whose forces correct those of the model; 1 = none. Those of the model
    make real tissue seem softer than it is, the more the fewer they are: give 1.5 or 2. Not so where a simulation of the same control
    nodes was recorded."""
    instrument_radius: Annotated[float, Range(0.0, 0.05, "m")] = 0.006
    """Half the width of what images show of the instrument, from its tip backwards against its z axis, where no mask was recorded. Points
    there are not followed. Shafts of the da Vinci have 4.2 mm."""
