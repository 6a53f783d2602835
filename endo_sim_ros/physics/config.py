"""Parameters of the tissue simulation."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np

from endo_sim_ros.core.config import ConfigError, Range, StageConfig, option_values

_LEAST_DIRECTION = 1e-6  # of its largest number: less than that is none
MOST_MOTION = 0.5  # of the travel; the rest is for tools


@dataclass(frozen=True)
class MotionConfig(StageConfig):
    """How breath and heart move the control nodes that are held: as they were found to in a recording, or all of them alike, with the
    waveforms of the synthetic patient."""

    file: str = ""
    """File of the motion that a reconstruction found, the motion.npz beside its model, which motion.yaml there names: each control node
    goes its own share of the way found, about its own place at rest. breathing and heartbeat then tell how far the tissue goes that
    goes farthest, but for a hundredth of it, and directions and waveforms are those found. What was not found moves as without a file.
    Empty: all held nodes move alike. Relative paths begin at the folder of the parameter file that has them, or, where the file is not
    there, at the working folder."""
    breathing: Annotated[float, Range(0.0, 0.03, "m")] = 0.0
    """How far breath moves held tissue there and back."""
    breathing_period: Annotated[float, Range(0.5, 60.0, "s")] = 4.0
    """Time from breath to breath."""
    breathing_phase: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Part of its period that the breath has gone at the start and after a reset; it is farthest at 0.5, or with a file where it was
    found to be: it begins as the recording did."""
    heartbeat: Annotated[float, Range(0.0, 0.01, "m")] = 0.0
    """How far the heart moves held tissue."""
    heartbeat_period: Annotated[float, Range(0.2, 10.0, "s")] = 0.9
    """Time from beat to beat."""
    heartbeat_phase: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Part of its period that the heart has gone at the start and after a reset; it is farthest at 0.25, or with a file where it was
    found to be."""
    direction_x: Annotated[float, Range(-1.0, 1.0)] = 1.0
    """Direction of the motion in the world, of any length above a millionth: x. By default tissue slides, and comes half as far nearer to
    a camera that looks along z."""
    direction_y: Annotated[float, Range(-1.0, 1.0)] = 0.0
    """The same: y."""
    direction_z: Annotated[float, Range(-1.0, 1.0)] = -0.5
    """The same: z."""
    heartbeat_direction_x: Annotated[float, Range(-1.0, 1.0)] = 0.0
    """Direction of the heart's own motion in the world: x. Where none of its three is above a millionth, it is that of the breath."""
    heartbeat_direction_y: Annotated[float, Range(-1.0, 1.0)] = 0.0
    """The same: y."""
    heartbeat_direction_z: Annotated[float, Range(-1.0, 1.0)] = 0.0
    """The same: z."""
    fade: Annotated[float, Range(0.0, 60.0, "s")] = 1.0
    """Time in which a new amplitude or direction takes over from the old one, so that tissue does not jump; a new period acts at once, as
    the phase goes on from where it is."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.abs(self.direction).max() < _LEAST_DIRECTION:
            raise ConfigError(f"the direction of motion is {self.direction}; give one that points somewhere, as 1, 0, 0")

    @property
    def idle(self) -> str:
        """What to tell where a motion is described that moves nothing; empty otherwise."""
        usual = option_values(type(self)())
        changed = [name for name, value in option_values(self).items() if value != usual[name]]
        if not changed or self.breathing or self.heartbeat:
            return ""
        return f"motion.{changed[0]} has no effect while motion.breathing and motion.heartbeat are 0; give one of them, too"

    @property
    def direction(self) -> tuple[float, float, float]:
        """Direction of the motion, world, of any length."""
        return self.direction_x, self.direction_y, self.direction_z

    @property
    def heartbeat_direction(self) -> tuple[float, float, float]:
        """Direction of the heart's motion, world, of any length."""
        own = self.heartbeat_direction_x, self.heartbeat_direction_y, self.heartbeat_direction_z
        return own if np.abs(own).max() >= _LEAST_DIRECTION else self.direction

    @property
    def ways(self) -> np.ndarray:
        """How far breath and heart move held tissue [2, 3], m, world."""
        directions = np.array([self.direction, self.heartbeat_direction])
        return np.array([[self.breathing], [self.heartbeat]]) * (directions / np.linalg.norm(directions, axis=1, keepdims=True))

    @property
    def periods(self) -> tuple[float, float]:
        """Of breath and heart, s."""
        return self.breathing_period, self.heartbeat_period

    @property
    def phases(self) -> tuple[float, float]:
        """Of breath and heart at the start, in periods."""
        return self.breathing_phase, self.heartbeat_phase


@dataclass(frozen=True)
class PhysicsConfig(StageConfig):
    """How the tissue is built from the Gaussians, what it is made of and how it is stepped."""

    node_count: Annotated[int, Range(8, 200_000)] = 4000
    """Number of control nodes: the skin gets node_count / (layers + 1) of them, each layer as many."""
    thickness: Annotated[float, Range(1e-4, 1.0, "m")] = 0.02
    """Depth of the tissue behind the reconstructed skin; the layers divide it evenly."""
    layers: Annotated[int, Range(0, 32)] = 3
    """Number of layers extruded behind the skin; 0 simulates the skin alone, as the paper prints it."""
    carve: bool = True
    """Leave out tissue where a training camera sees through it, as behind the edge of one organ in front of another."""
    pin_back: bool = True
    """Hold the deepest layer in place. Tools that are pressed through the tissue meet it."""
    pin_rim: bool = True
    """Hold the control nodes at the border of the skin, as seen from the viewpoint, and the layers behind them. Tools meet
    nothing there: it is where the recording ends."""
    min_opacity: Annotated[float, Range(0.0, 1.0)] = 0.1
    """Gaussians fainter than this do not become control nodes."""
    material: Literal["fixed_corotated", "neo_hookean", "fung"] = "fixed_corotated"
    """Constitutive law. fung is neo_hookean whose shear modulus grows exponentially with the strain, as that of organs does."""
    young_modulus: Annotated[float, Range(1.0, 1e9, "Pa")] = 10e3
    """Stiffness of the tissue."""
    poisson_ratio: Annotated[float, Range(0.0, 0.49)] = 0.3
    """Compressibility. Wet tissue is nearer 0.49, but there the sound speed multiplies the substeps by four and
    the coarse grid locks; at 0.3 the paper's 80 substeps are stable."""
    stiffening: Annotated[float, Range(0.01, 100.0)] = 5.0
    """How fast fung stiffens: a in exp(a W), which multiplies the shear modulus. W is 0 at rest, about 2 ε:ε at a small strain ε, and 0.14
    in tissue that is pressed to four fifths and gives way to the sides. Organs have 0.5 to 10."""
    stiffening_limit: Annotated[float, Range(1.0, 1000.0)] = 5.0
    """Largest of these factors: from there on fung is a neo_hookean that much stiffer. Waves then meet a shear modulus s (1 + 2 ln s) times
    that at rest, 21 times for 5, and the substeps are planned for it; 1 = no stiffening."""
    relaxation: Annotated[float, Range(0.0, 20.0)] = 0.0
    """Visco-elasticity: a Maxwell branch this many times as stiff as the material beside it. Fast motion meets all of it, held
    tissue relaxes; liver has about 1, 0 = none."""
    relaxation_time: Annotated[float, Range(1e-3, 1e3, "s")] = 0.3
    """Time in which the Maxwell branch forgets."""
    density: Annotated[float, Range(1.0, 1e5, "kg/m³")] = 1000.0
    """Mass density of the tissue."""
    regions: tuple[str, ...] = ()
    """Regions that are made of something else, later ones over earlier ones: "box x0 y0 z0 x1 y1 z1", "sphere x y z radius" (m, world)
    or "mask IMAGE CAMERAS N" (what camera N of a cameras.json sees in the white of an image), then young_modulus=, poisson_ratio=
    or density=, e.g. "sphere 0 0 0.12 0.01 young_modulus=40000". [""] is none, as [] is, which `ros2 param set` does not know."""
    step_duration: Annotated[float, Range(1e-5, 10.0, "s")] = 0.04
    """What physics advances in one step, from one published state to the next."""
    substeps: Annotated[int, Range(0, 100_000)] = 0
    """Number of integration substeps in a step; 0 = as few as the material and the grid safely allow. The paper takes 80.
    A number that is too small for the material is refused with one that works."""
    damping: Annotated[float, Range(0.0, 1000.0, "1/s")] = 50.0
    """Rate c at which velocities decay, exp(-c t)."""
    gravity_x: Annotated[float, Range(-100.0, 100.0, "m/s²")] = 0.0
    """Gravity along world x. Zero by default: the reconstruction already hangs under gravity."""
    gravity_y: Annotated[float, Range(-100.0, 100.0, "m/s²")] = 0.0
    """Gravity along world y."""
    gravity_z: Annotated[float, Range(-100.0, 100.0, "m/s²")] = 0.0
    """Gravity along world z."""
    kinematics: Literal["rest", "current"] = "rest"
    """Where the transfer weights are taken: at the rest positions (total Lagrangian: never fractures numerically) or
    at the current positions (updated Lagrangian, as PhysGaussian and the paper have it)."""
    grid_ratio: Annotated[float, Range(1.0, 4.0)] = 1.5
    """Grid cell size over the spacing of control nodes. Near 1 a cell holds one control node and has motions that none resists (with
    current kinematics it fractures); above 2 dents are blurred."""
    courant_number: Annotated[float, Range(0.05, 0.7)] = 0.5
    """Largest c Δt/h (sound speed, substep, grid cell) that ``substeps: 0`` chooses. Above 0.7 no substep is stable; the rest is
    room for tissue that stiffens where it is compressed."""
    pin_stiffness: Annotated[float, Range(1.0, 1e5)] = 100.0
    """Stiffness of the springs that pin control nodes, over the stiffness (λ + 2μ) V/h² of their tissue in a grid cell: all springs
    of a cell together are then as stiff however many control nodes share it. Stiffer ones lock tissue that is few cells thick."""
    grasp_stiffness: Annotated[float, Range(1.0, 1e5)] = 400.0
    """The same of the springs by which jaws hold and capsules push; softer ones let tissue lag behind its jaw."""
    contact_stiffness: Annotated[float, Range(1.0, 1e6)] = 10000.0
    """The same where a link thinner than a cell of the grid pushes a control node at its axis; at its surface it is grasp_stiffness, as
    tissue that stiffer springs press resists by more than theory says. Less than that has no effect. A thin
    instrument passed between the control nodes of tissue of 10 kPa
    at 1 to 8 N with 400, at none of 12 N with 10 000."""
    push_out_speed: Annotated[float, Range(1e-3, 10.0, "m/s")] = 0.5
    """A capsule that suddenly is deep within tissue pushes it out no faster than this."""
    rollback_damping: Annotated[float, Range(0.0, 1.0)] = 0.9
    """Share of its deformation that is left to tissue when a step is undone right after another that was: from some states every
    step ends badly, and tissue has to give way towards rest."""
    travel: Annotated[float, Range(1e-3, 10.0, "m")] = 0.05
    """Farthest a control node may move from rest; a step that takes one farther is undone and counted as a fault."""
    force_radius: Annotated[float, Range(1e-4, 1.0, "m")] = 0.01
    """A tool pulls, and a closing jaw holds, the control nodes of the skin within this distance of its tip."""
    contact_radius: Annotated[float, Range(0.0, 0.1, "m")] = 0.0
    """Radius of the rigid capsule that each tool pushes the tissue away with, 0 = tools act by wrench and jaw only. Control nodes, not
    the skin between them, are what it touches, so a capsule thinner than 1.5 times their distance, or 0.3 of a grid cell, acts as
    one as thick as that. Tools whose links are known are their links instead."""
    contact_length: Annotated[float, Range(0.0, 1.0, "m")] = 0.0
    """Length of that capsule from the tip backwards, against the tool's z axis; 0 = a sphere."""
    friction: Annotated[float, Range(0.0, 10.0)] = 0.2
    """Coulomb friction between tool and tissue; wet instruments have 0.05 to 0.3."""
    grip_force: Annotated[float, Range(0.0, 1000.0, "N")] = 10.0
    """Force that presses the jaws of an instrument together: what pulls tissue with more than 2 friction grip_force lets it slip out.
    Instruments of the da Vinci have 2.3 to 39.9 N (Mucksavage et al. 2011). 0 = without limit, as for tools without links."""
    grasp_gap: Annotated[float, Range(0.0, 0.1, "m")] = 1e-3
    """Widest gap to the skin at which the closed jaws of an instrument take hold of it, as their teeth are up to 1 mm high; with
    control nodes at their default number the skin between these is known to about as much. Jaws that push tissue touch it anyway."""
    blade_length: Annotated[float, Range(1e-4, 0.1, "m")] = 0.01
    """Length of the edge that a cutting tool sweeps through the tissue, from its tip backwards, against its z axis. A cut opens
    once it is about one cell of the grid deep; more layers make that finer."""
    motion: MotionConfig = MotionConfig()
    """Breath and heart."""
    tear_strain: Annotated[float, Range(0.0, 5.0)] = 0.0
    """True strain, the logarithm of the stretch, beyond which the tissue tears as if it were cut there; 0 = never. Liver bears 0.38, the
    wall of the gall bladder 0.43 (Mancia et al. 2019). Each tear is 2.5 cells of the grid long."""
    skin_strain: Annotated[float, Range(0.0, 0.5)] = 0.0
    """Strain by which the skin is stretched at rest, in all directions along it: the edges of cuts and tears draw back from each other, and
    curl up, as deeper tissue holds them. The outer surface of a gut has about 0.1, skin 0.1 to 0.3 (Deroy et al. 2017); 0 = none."""
    dense: bool = False
    """Simulate every Gaussian as a material point (PhysGaussian's way) instead of sparse control nodes;
    layers are then ignored."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""

    renamed: ClassVar[dict[str, str]] = {
        "substep_dt": "step_duration, the duration of all substeps together",
        "adapt_substeps": "substeps, where 0 means as few as are safe",
    }

    needs: ClassVar[dict[str, tuple[str, ...]]] = {
        "stiffening": ("material", "fung"),
        "stiffening_limit": ("material", "fung"),
        "tear_strain": ("kinematics", "rest"),
        "skin_strain": ("kinematics", "rest"),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        moved, most = self.motion.breathing + self.motion.heartbeat, MOST_MOTION * self.travel
        if moved > most:
            raise ConfigError(
                f"breathing and heartbeat move tissue by up to {moved:g} m, but with travel {self.travel:g} m it takes {most:g} m, so that"
                " tools can move it as well; give less of them or more travel"
            )

        stretched = math.log(1 + self.skin_strain)
        if 0 < self.tear_strain <= stretched:
            raise ConfigError(
                f"skin_strain {self.skin_strain:g} stretches the skin at rest by a true strain of {stretched:.2f}, and tear_strain is"
                f" {self.tear_strain:g}: it would be torn already; give less of the first or more of the second"
            )

    @classmethod
    def baseline(cls, **overrides) -> "PhysicsConfig":
        """PhysGaussian's way through the same solver: every Gaussian a material point, skin only, current weights."""
        return cls(**{"dense": True, "layers": 0, "kinematics": "current", "grid_ratio": 1.0, **overrides})

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Gravity, world, m/s²."""
        return self.gravity_x, self.gravity_y, self.gravity_z
