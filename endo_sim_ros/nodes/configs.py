"""The options of all ROS nodes. This module imports no node and neither rclpy nor torch: `endo-sim config` needs it alone."""

import functools
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from endo_sim_ros.core.cameras import parse_frames
from endo_sim_ros.core.config import ConfigError, Range, StageConfig
from endo_sim_ros.core.frames import LEFT_FRAME, RIGHT_FRAME
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.recording_config import TouchConfig
from endo_sim_ros.instruments.config import DrawingConfig
from endo_sim_ros.nodes.pacing import MOST_WAITING
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.tissues import TISSUES, Tissue
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.presets import PRESETS, Preset
from endo_sim_ros.rendering.config import RenderingConfig
from endo_sim_ros.viewer.config import ViewerConfig

COMMAND_PARTS = ("pose", "wrench", "jaw", "cut")  # of a tool, in the order in which they act
ALL_TOPICS = "all"


@dataclass(frozen=True)
class WorldConfig(StageConfig):
    """Where poses are given."""

    world_frame: str = "world"
    """Frame of camera poses, tool poses, the model and the control nodes."""
    frames: tuple[str, ...] = ("",)  # ROS has no typed empty list
    """Other frames of camera and tool poses, such as the bases of robot arms: the name and the pose in the world of each,
    'PSM1_base x y z qx qy qz qw', metres."""

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            parse_frames(self.world_frame, self.frames)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    @property
    def frame_poses(self) -> dict[str, np.ndarray]:
        """Poses [4, 4] of all known frames in the world, by name."""
        return _frame_poses(self.world_frame, self.frames)


_frame_poses = functools.cache(parse_frames)


@dataclass(frozen=True)
class ReconstructionNodeConfig(WorldConfig):
    """Options of reconstruction_node beside those of the reconstruction."""

    preset: Preset = "default"
    """Method: ours, ours sized for a CPU, that of the paper as printed, FSGS or 3DGS as published, or these two with one colour for
    all directions of view (sh0). Options that are not given have the values of the preset."""
    mode: Literal["realtime", "lockstep"] = "realtime"
    """realtime: intermediate models are published while they train, stamped by the clock. lockstep: the final model only,
    stamped by the newest image (models read from files: from one nanosecond on): one bag gives the same bytes in every run."""
    sync_tolerance: Annotated[float, Range(0, 10, "s")] = 0.01
    """Largest difference between the stamps of an image and its pose, depth, mask and right image."""
    reliable: bool = True
    """Ask for reliable delivery; set to false for cameras that publish best effort."""
    start_after: Annotated[float, Range(0, 3600, "s")] = 1.5
    """Reconstruct when no image came for this long, or for three times the longest gap between images so far; 0 = only
    on a call of the service ~/reconstruct."""
    start_views: Annotated[int, Range(0, 100_000)] = 0
    """Reconstruct once when this many views arrived (for a live camera, whose stream does not end); 0 = off."""
    max_views: Annotated[int, Range(2, 100_000)] = 500
    """Views kept, in files of the folder TMPDIR (/tmp); above it every second one is dropped. The next node of the same user
    and machine removes what a killed one left there."""
    image_timeout: Annotated[float, Range(0.1, 3600, "s")] = 10.0
    """Warn when no view arrived for this long; also the longest wait for a slow recording to go on."""
    publish_period: Annotated[float, Range(0.1, 3600, "s")] = 5.0
    """Time between intermediate models during training."""
    output_dir: str = "~/.ros/endo_sim_ros"
    """Where each reconstruction's model.ply, cameras.json and checkpoint.pt are saved, in a folder named by the time; of moving tissue also
    motion.npz, which physics_node follows, and motion.yaml, its parameters for that."""
    model_file: str = ""
    """PLY model to publish at start, before any reconstruction, or when this is set; latest = the newest in output_dir.
    Cameras (cameras.json) and the motion of the tissue (motion.npz) that were saved beside it are published with it."""


@dataclass(frozen=True)
class PhysicsNodeConfig(WorldConfig):
    """Options of physics_node beside those of the physics."""

    tissue: Tissue = "default"
    """What the tissue is made of, with published numbers (docs/physics.md). Options that are not given have the values of the tissue."""
    found_motion: bool = True
    """Let tissue move by itself as reconstruction_node found it to, unless motion.file is given."""
    mode: Literal["realtime", "lockstep"] = "realtime"
    """realtime: steps follow the clock (the wall clock, or /clock with use_sim_time) and use the newest commands; steps that
    would be late are skipped. lockstep: each command takes one step; state, reaction and /clock have its stamp."""
    lockstep_inputs: tuple[str, ...] = ("pose", "wrench")
    """lockstep: the parts of a command (pose, wrench, jaw, cut). A step is taken when all parts, of all arms and with the same
    stamp, have arrived. Parts that are not listed act on arrival."""
    step_count: Annotated[int, Range(1, MOST_WAITING)] = 1
    """Steps that one call of ~/step takes."""
    arms: tuple[str, ...] = ("PSM1",)
    """Names of the arms; the topics of an arm are under its name. ECM is the arm of the camera, with arm_source commanded only."""
    arm_source: Literal["measured", "commanded"] = "measured"
    """measured: tool tips follow measured_cp, as robots and their simulators publish it. commanded: there is no robot; tips
    follow servo_cp at once and move_cp at move_speed, and this node publishes measured_cp and jaw/measured_js as an arm does."""
    instruments: tuple[str, ...] = ("LARGE_NEEDLE_DRIVER",)
    """Tool of each arm in the order of arms, or one for all: a name of the dVRK, such as PROGRASP_FORCEPS or PROGRASP_FORCEPS:420093,
    or the path of a tool file of the dVRK; after an @ the path of a URDF that has its shape. none = a tip without joints, which
    reaches every pose. One for all leaves the ECM its straight endoscope."""
    arm_models: tuple[str, ...] = ("PSM",)
    """Kind of each arm in the order of arms, or one for all: PSM, PSM_Si, or the path of a kinematic file of the dVRK. PSM for all
    makes the ECM an ECM."""
    tell_empty_jaws: bool = True
    """An error says that a jaw closed on no tissue; false where jaws also take what physics knows nothing of, such as a needle."""
    link_contact: bool = True
    """Let the links of instruments touch the tissue: shaft, wrist and jaws push, and closed jaws hold what lies between them, by friction.
    Off, and for arms without an instrument or a place: the tip alone acts, with contact_radius as a rod; the tip of an instrument is
    the hinge of its jaws, so that a closed jaw holds what is within force_radius of that."""
    move_speed: Annotated[float, Range(1e-4, 10, "m/s")] = 0.05
    """Speed of a tool tip that moves to the goal of move_cp."""
    turn_speed: Annotated[float, Range(1e-2, 100, "rad/s")] = 1.5
    """Speed at which a tool tip turns to the goal of move_cp, and at which a jaw turns to the goal of jaw/move_jp."""
    joint_speed: Annotated[float, Range(1e-2, 100, "rad/s")] = 2.0
    """Largest speed of a joint that turns, during moves; 2 is about that of the dVRK."""
    slide_speed: Annotated[float, Range(1e-4, 10, "m/s")] = 0.2
    """Largest speed of a joint that slides, during moves; 0.2 is about that of the dVRK."""
    force_limit: Annotated[float, Range(0, 1000, "N")] = 10.0
    """A growing reaction above this ends the move of an arm with joints where its last step began; 10 N is more than instruments exert in
    surgery. A warning tells of a force that grows by more in one step, as where an arm is put into the tissue. 0 = neither."""
    cartesian_frame: str = "world"
    """Frame of measured_cp, setpoint_cp and measured_cv of commanded tool arms: world, one of frames, or ECM_view, that of the camera now,
    x to the left and y up in the picture as on a dVRK. Poses without a frame are in it, too."""
    reaction_rate: Annotated[float, Range(0, 1000, "Hz")] = 0.0
    """Reactions per second on body/measured_cf, interpolated between steps, for haptic devices (500). In real time each is published one
    and a quarter steps after its stamp, the time for which it holds. In lockstep those since the step before come together. 0 = one
    with each step, at once."""
    command_timeout: Annotated[float, Range(0, 3600, "s")] = 0.5
    """A wrench that is not repeated for this long is dropped; 0 = held until changed."""
    jaw_closed: Annotated[float, Range(-3.2, 3.2, "rad")] = 0.1
    """A jaw at or below this angle grasps the tissue between its jaws, that of an arm without links the tissue at its tip."""
    jaw_open: Annotated[float, Range(-3.2, 3.2, "rad")] = 0.2
    """A jaw at or above this angle releases; between the two angles nothing changes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.jaw_closed >= self.jaw_open:
            raise ConfigError(f"jaw_closed, {self.jaw_closed:g} rad, must be less than jaw_open, {self.jaw_open:g} rad")
        known = ["world", "ECM_view", *self.frame_poses]
        if self.cartesian_frame not in known:
            names = ", ".join(dict.fromkeys(known))
            raise ConfigError(f"cartesian_frame: {self.cartesian_frame!r} is not known; it is one of {names}, or name it in frames")
        unknown = set(self.lockstep_inputs) - set(COMMAND_PARTS)
        if unknown or not self.lockstep_inputs:
            raise ConfigError(f"lockstep_inputs: {list(self.lockstep_inputs)} must be some of {', '.join(COMMAND_PARTS)}")


@dataclass(frozen=True)
class RenderingNodeConfig(WorldConfig):
    """Options of rendering_node beside those of the rendering."""

    mode: Literal["realtime", "lockstep"] = "realtime"
    """realtime: the newest state is rendered when it arrives, at most at the rate. lockstep: each state on control_nodes
    gives one image with its stamp."""
    lockstep_camera: bool = False
    """lockstep: wait for the camera pose with the stamp of the state; off, the newest pose is used."""
    rate: Annotated[float, Range(0.1, 240, "Hz")] = 25.0
    """Images published per second; of input that arrives faster the newest is used."""
    idle_rate: Annotated[float, Range(0.1, 240, "Hz")] = 5.0
    """Images published per second while nothing in the image changes."""
    camera_frame: str = LEFT_FRAME
    """Frame in the headers of rendered images."""
    right_frame: str = RIGHT_FRAME
    """The same of the right eye."""
    baseline: Annotated[float, Range(0, 0.05, "m")] = 0.0
    """Distance between the eyes where endoscope/right/camera_info does not say it; 0 = no right eye then."""
    instruments: bool = True
    """Draw the instruments of the arms where link_poses says they are."""
    arms: tuple[str, ...] = ("PSM1",)
    """Names of the arms whose instruments are drawn; one that nobody publishes is not."""
    thing: str = ""
    """Name of the task, or file.py:Class, whose thing is drawn with the instruments, such as the needle of handover or the vessels of
    clip, where thing_poses says that it is; empty = none."""
    jpeg_quality: Annotated[int, Range(1, 100)] = 90
    """Quality of compressed images; at 90 the eye sees no difference."""
    drawing: DrawingConfig = DrawingConfig()
    """How instruments are lit."""


@dataclass(frozen=True)
class BagPlayerConfig(StageConfig):
    """Options of the bag player."""

    bag: str = ""
    """Path of a rosbag2 folder or an .mcap file."""
    rate: Annotated[float, Range(0.01, 100)] = 1.0
    """Playback speed relative to the recording."""
    loop: bool = False
    """Start again at the end."""
    wait_for_subscribers: Annotated[float, Range(0, 3600, "s")] = 10.0
    """Longest wait for a subscriber before playing."""


@dataclass(frozen=True)
class RecorderConfig(StageConfig):
    """Options of the recorder."""

    bag: str = "recording"
    """Folder of the new bag; it must not exist."""
    arms: tuple[str, ...] = ("PSM1",)
    """Names of the tool arms."""
    topics: tuple[str, ...] = (ALL_TOPICS,)
    """Names of the topics to record, of those in msg_conventions.md. all records every one but what would be rendered for the recorder
    alone: depth, segmentation, the right eye, and one of the two forms of the images. Name these beside all."""
    images: Literal["compressed", "raw"] = "compressed"
    """Form of the rendered images where all topics are recorded; raw ones are exact and take fifteen times the room."""
    canonical: bool = True
    """Write zeros into the padding between the fields of a message, so that equal messages have equal bytes."""


@dataclass(frozen=True)
class ScriptedToolConfig(StageConfig):
    """Options of the scripted tool."""

    arm: str = "PSM1"
    """Name of the arm whose topics are published."""
    world_frame: str = "world"
    """Frame of the tool's pose."""
    force: Annotated[float, Range(0, 100, "N")] = 2.0
    """Force with which it pulls; less where 2 cm of pull, or a quarter of the way to the lens, do not reach it. It keeps to the force
    within a fifth, from its first touch until it lets go. It feels the force about a tenth of a second late, so that stiff or moving
    tissue may push by more for a moment."""
    u: Annotated[float, Range(0, 1)] = 0.5
    """Column of the pixel at which the tool grasps, or as near to it as its shaft gets without touching what the picture shows, as a
    fraction of the image width."""
    v: Annotated[float, Range(0, 1)] = 0.5
    """Row of that pixel, as a fraction of the image height."""
    listeners: Annotated[int, Range(0, 100)] = 1
    """Subscribers of the jaw to wait for before the first command."""
    rate: Annotated[float, Range(10, 1000, "Hz")] = 50.0
    """Commands per second."""
    pull: Annotated[float, Range(0, 600, "s")] = 2.0
    """Time in which it pulls farther and farther, obliquely towards the camera."""
    swing: Annotated[float, Range(0, 600, "s")] = 4.0
    """Time in which the pull circles around the direction to the camera."""
    release: Annotated[float, Range(0, 600, "s")] = 2.5
    """Time after the release until the tool is finished."""


@dataclass(frozen=True)
class PolicyConfig(StageConfig):
    """Options of the policy. physics_node must have the same mode, arm_source commanded, lockstep_inputs [pose, jaw], with
    cut where the task cuts, and the tissue of the task: `endo-sim scene` writes these parameters to a file."""

    mode: Literal["realtime", "lockstep"] = "lockstep"
    """lockstep: each action takes one step, as in the environments. realtime: time goes on by itself. The policy acts on the newest
    state, with its pictures; a step of the task is from one action to the next, and states that come while it thinks are left out."""

    task: str = "retraction"
    """Name of the task, or your own as file.py:Class; an unknown one is answered with the list."""
    policy: str = "scripted"
    """scripted; still, which does nothing; the .npz file of a trained policy; the folder of `endo-sim imitate`; or your own
    file.py:Class."""
    scene: str = ""
    """Folder of the model.ply and cameras.json that the graph runs on; empty = a piece of the synthetic patient."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Seed of the first episode; each following episode has the next seed."""
    tool: str = ""
    """Name or file of the tool that the scene was written with, which a policy that acts by joints moves; empty = that of the task."""
    dye: bool = True
    """Mark the target with a spot of dye on the tissue."""
    device: str = "auto"
    """Compute device of a policy of lerobot: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    episodes: Annotated[int, Range(1, 1_000_000)] = 1
    """Number of episodes; palpation has one, as the inclusion is part of the parameters of physics_node."""
    record: str = ""
    """File (.npz) for states, actions, rewards and success of all steps; empty = none."""
    arm: str = "PSM1"
    """Name of the arm that acts, in a task of one; those of two are PSM1 and PSM2."""
    world_frame: str = "world"
    """Frame of the tool's pose."""
    physics_node: str = "physics_node"
    """Name of the physics node, which is reset before each episode."""


@dataclass(frozen=True)
class ViewerNodeConfig(WorldConfig):
    """Options of viewer_node beside those of the page."""

    arm: str = "PSM1"
    """Name of the arm that the mouse moves while it grasps tissue; its topics are published only then."""
    arm_source: Literal["measured", "commanded"] = "measured"
    """The same as that of physics_node. measured: the mouse publishes measured_cp. commanded: it publishes servo_cp."""
    arms: tuple[str, ...] = ("PSM1",)
    """Names of the arms that are shown with their forces."""
    physics_node: str = "physics_node"
    """Name of the physics node, whose parameters and services the page uses."""


@dataclass(frozen=True)
class IdentificationNodeConfig(WorldConfig):
    """Options of identification_node beside those of the identification and of the physics, which must be those of physics_node."""

    tissue: Tissue = "default"
    """What the tissue is thought to be made of, with published numbers (docs/physics.md). Options that are not given have the values of
    the tissue."""
    arms: tuple[str, ...] = ("PSM1",)
    """Names of the tool arms whose touches count."""
    new_touches: Annotated[int, Range(1, 1000)] = 1
    """New experiments after which the estimate is refined by them; more may come while that goes on."""
    experiments: Annotated[int, Range(1, 1000)] = 12
    """The newest experiments that are kept, to begin anew when options change."""
    apply: bool = False
    """Give physics_node what was estimated, where that is known: set its parameters young_modulus and regions, and those of `unknowns`."""
    physics_node: str = "physics_node"
    """Name of the physics node that gets it."""


NODE_CONFIGS: dict[str, tuple[type[StageConfig], ...]] = {
    "reconstruction_node": (ReconstructionNodeConfig, ReconstructionConfig),
    "physics_node": (PhysicsNodeConfig, PhysicsConfig),
    "rendering_node": (RenderingNodeConfig, RenderingConfig),
    "bag_player": (BagPlayerConfig,),
    "recorder": (RecorderConfig,),
    "scripted_tool": (ScriptedToolConfig,),
    "policy": (PolicyConfig,),
    "identification_node": (IdentificationNodeConfig, TouchConfig, IdentificationConfig, PhysicsConfig),
    "viewer_node": (ViewerNodeConfig, ViewerConfig, RenderingConfig),
}
"""The configurations whose options are the parameters of each node, by the name of the ROS node."""

CHOSEN_BY: dict[type[StageConfig], tuple[str, Mapping[Any, dict[str, Any]]]] = {
    ReconstructionConfig: ("preset", PRESETS),
    PhysicsConfig: ("tissue", TISSUES),
}
"""Configurations of which another option of the node names a set of values: that option, and the sets by its values."""


def _names_topics(name: str) -> bool:
    """Whether a text can be part of the names of topics: words of letters, digits and _, which a / parts, none with a digit first."""
    return re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*", name) is not None


def namespace_arguments(namespace: str) -> list[str]:
    """Arguments of ROS that put a node into a namespace; none for the root.

    Raises:
        ConfigError: If it cannot be part of the names of topics.
    """
    name = namespace.strip("/")
    if name and not _names_topics(name):
        raise ConfigError(f"namespace: {namespace!r} cannot name topics; use letters, digits and _, and no digit first")
    return ["-r", f"__ns:=/{name}"] if name else []


def arm_names(names: Iterable[str]) -> tuple[str, ...]:
    """The names in the parameter `arms` without spaces.

    Raises:
        ConfigError: If there is none, one is there twice or in other capitals, or one cannot be part of the name of a topic.
    """
    names = tuple(name.strip() for name in names)
    if not names:
        raise ConfigError("arms: the list is empty; name at least one arm, such as [PSM1]")
    for name in names:
        if not _names_topics(name):
            raise ConfigError(f"arms: {name!r} cannot name topics; use letters, digits and _, and no digit first")
        if names.count(name) > 1:
            raise ConfigError(f"arms: {name} is there {names.count(name)} times; give each arm a name of its own")
        if alike := [other for other in names if other != name and other.lower() == name.lower()]:
            raise ConfigError(f"arms: {name} and {alike[0]} differ in capitals alone; give each arm a name of its own")
    return names
