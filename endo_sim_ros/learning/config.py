"""Parameters of environments and of training."""

import re
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from endo_sim_ros.core.config import ConfigError, Range, StageConfig

# Kinds of randomisation: where the joints of an arm are, and what only pictures show.
_OF_ARM, _OF_PICTURES = (
    ("tool", "trocar_angle", "trocar_position"),
    ("light", "texture", "camera_position", "camera_angle", "metal", "lamp"),
)


@dataclass(frozen=True)
class Randomisation(StageConfig):
    """How much each episode differs from the scene; all zero: not at all."""

    stiffness: Annotated[float, Range(0, 2)] = 0.0
    """Moduli are multiplied by a factor between exp(-x) and exp(x)."""
    light: Annotated[float, Range(0, 0.9)] = 0.0
    """Brightness is multiplied by a factor between 1 - x and 1 + x, and falls off to as much as 1 - x towards the corners."""
    texture: Annotated[float, Range(0, 0.9)] = 0.0
    """Contrast of the tissue's colours is multiplied by a factor between 1 - x and 1 + x."""
    camera_position: Annotated[float, Range(0, 0.05, "m")] = 0.0
    """The endoscope is moved by up to this along each axis, m."""
    camera_angle: Annotated[float, Range(0, 45, "deg")] = 0.0
    """The endoscope is turned by up to this about each axis, degrees."""
    tool: Annotated[float, Range(0, 1)] = 0.0
    """Share of episodes that have any of the six tools that are known, whatever the task's is; one with jaws where the task closes them."""
    trocar_angle: Annotated[float, Range(0, 30, "deg")] = 0.0
    """The remote centre, where the instrument enters, is turned by up to this about each axis through the tissue in the middle of the
    picture, degrees."""
    trocar_position: Annotated[float, Range(0, 0.05, "m")] = 0.0
    """The remote centre is moved by up to this along each axis of the world, m."""
    metal: Annotated[float, Range(0, 0.9)] = 0.0
    """What the surfaces of the tool give back of the light, and their roughness, are each multiplied by a factor between 1 - x and
    1 + x."""
    lamp: Annotated[float, Range(0, 0.02, "m")] = 0.0
    """The lamp beside the lens is moved by up to this along each axis of the camera, m."""


@dataclass(frozen=True)
class SightConfig(StageConfig):
    """What the endoscope shows."""

    image_width: Annotated[int, Range(16, 8192, "pixels")] = 64
    """Width of the pictures; the height follows from the scene's camera."""
    instrument: bool = True
    """Draw the tool, with its shadow; without it pictures show the tissue alone."""
    tool: str = ""
    """Name or file of the tool, as `endo_sim_ros.instruments.load_arm` takes it; empty = that of the task."""
    eyes: Literal[1, 2] = 1
    """2: the picture of the right eye, too."""
    baseline: Annotated[float, Range(0.0005, 0.05, "m")] = 0.00414
    """Distance between the eyes; 4.14 mm is that of the endoscope of a da Vinci Xi, from the calibration of SCARED (datasets 1 to 3)."""
    dye: bool = True
    """Mark the target of the task with a spot of dye on the tissue."""
    segmentation: bool = False
    """What is in each pixel, too."""


def without_instrument(sight: SightConfig, vary: Randomisation) -> list[str]:
    """A sentence for each option of an instrument that nothing shows and whose tip alone acts."""
    given = {"tool": sight.tool, **{f"vary.{name}": getattr(vary, name) for name in (*_OF_ARM, "metal", "lamp")}}
    said = "has no effect while instrument is false; leave one of the two out"
    return [] if sight.instrument else [f"{name} {said}" for name, value in given.items() if value]


def without_pictures(vary: Randomisation, joints: bool) -> list[str]:
    """A sentence for each kind of randomisation that states alone do not tell of; of an arm, unless its joints act or touch."""
    names = _OF_PICTURES if joints else (*_OF_PICTURES, *_OF_ARM)
    said = "has no effect on states, which this policy takes; leave it out, or train on pictures with endo-sim imitate"
    return [f"vary.{name} {said}" for name in names if getattr(vary, name)]


@dataclass(frozen=True)
class TrainingConfig(StageConfig):
    """The cross-entropy method: policies are drawn from a Gaussian, which moves to the best of them, again and again."""

    generations: Annotated[int, Range(1, 100_000)] = 30
    """How often the Gaussian moves."""
    population: Annotated[int, Range(4, 100_000)] = 128
    """Policies drawn each time; all run at once."""
    episodes: Annotated[int, Range(1, 1000)] = 1
    """Episodes by which each is judged, the same for all of a generation."""
    elite: Annotated[float, Range(0.01, 0.9)] = 0.08
    """Part of the population that the Gaussian moves to."""
    hidden: Annotated[int, Range(0, 1000)] = 0
    """Size of the network's hidden layer; 0 = a linear policy."""
    spread: Annotated[float, Range(1e-3, 100)] = 3.0
    """Standard deviation of the weights at the beginning."""
    test_episodes: Annotated[int, Range(1, 100_000)] = 64
    """Other episodes on which the mean of the Gaussian is tested after each generation."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Another seed draws other policies and episodes."""


@dataclass(frozen=True)
class PPOConfig(StageConfig):
    """Proximal policy optimisation by stable-baselines3: two hidden layers, tanh."""

    steps: Annotated[int, Range(1, 1_000_000_000)] = 300_000
    """Steps of all environments together."""
    environments: Annotated[int, Range(1, 100_000)] = 32
    """Episodes at once."""
    rollout: Annotated[int, Range(2, 10_000)] = 100
    """Steps of each environment between two updates."""
    minibatches: Annotated[int, Range(1, 10_000)] = 8
    """Parts in which the steps of a rollout are learned from."""
    hidden: Annotated[int, Range(1, 1000)] = 64
    """Size of each hidden layer."""
    learning_rate: Annotated[float, Range(1e-7, 1)] = 7e-4
    """Of Adam."""
    gamma: Annotated[float, Range(0, 1)] = 0.99
    """Discount per step."""
    gae_lambda: Annotated[float, Range(0, 1)] = 0.97
    """Of the generalised advantage estimate."""
    spread: Annotated[float, Range(1e-3, 10)] = 0.6
    """Standard deviation of the actions at the beginning."""
    demonstrations: Annotated[int, Range(0, 1_000_000)] = 0
    """Episodes of the task's script, with this spread, from which the policy learns before it learns by reward; 0 = none. Chance hardly
    finds what takes two arms in turn."""
    tests: Annotated[int, Range(1, 10_000)] = 10
    """Points of the learning curve after its first."""
    test_episodes: Annotated[int, Range(1, 100_000)] = 64
    """Other episodes on which the mean action is tested."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Another seed draws other weights, actions and episodes."""


@dataclass(frozen=True)
class ImitationConfig(StageConfig):
    """How a policy is trained on demonstrations."""

    policy: Literal["keypoints", "act", "diffusion"] = "keypoints"
    """keypoints: a small network of this package, trained within minutes; act: action chunking with transformers, diffusion: a diffusion
    policy, both by lerobot."""
    steps: Annotated[int, Range(0, 10_000_000)] = 0
    """Steps of the training; 0 = 3000 for keypoints, 10 000 for lerobot."""
    batch_size: Annotated[int, Range(1, 100_000)] = 128
    """Rows of the dataset that a step learns from."""
    learning_rate: Annotated[float, Range(0, 1)] = 0.0
    """Of the optimiser, for the image network too; 0 = 2e-3 for keypoints, 1e-4 for lerobot."""
    chunk: Annotated[int, Range(1, 1000)] = 16
    """Actions that are predicted at once; of a diffusion policy a multiple of 8."""
    executed: Annotated[int, Range(1, 1000)] = 8
    """How many of these are executed before the policy looks again."""
    backbone_weights: str = ""
    """Weights that the image network starts from, such as ResNet18_Weights.IMAGENET1K_V1, which torchvision downloads; empty = random."""
    workers: Annotated[int, Range(0, 256)] = 4
    """Processes that read the dataset."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Another seed draws other weights and another order."""

    needs: ClassVar[dict[str, tuple[str, ...]]] = dict.fromkeys(
        ("chunk", "executed", "backbone_weights", "workers"), ("policy", "act", "diffusion")
    )


COMPARED_IN = ("phantom:3", "phantom:4", "phantom:5")
"""Synthetic patients that policies are compared in; demonstrate and train use phantom:0 by default."""


@dataclass(frozen=True)
class BenchmarkConfig(StageConfig):
    """Episodes that no training sees."""

    task: str = "retraction"
    """Name of the task, such as retraction or palpation; an unknown one is answered with the list."""
    episodes: Annotated[int, Range(1, 1_000_000)] = 100
    """Episodes of each scene."""
    robustness: bool = False
    """Repeat all under other light, texture, endoscope, instrument, stiffness and breath than usual, one after the other."""
    image_width: Annotated[int, Range(16, 4096, "pixels")] = 256
    """Width of the video that shows the first episodes."""
    patience: Annotated[float, Range(0.01, 86_400, "s")] = 10.0
    """How long a ROS node has for each of its answers, s; to appear it has half a minute, or as long if that is more."""


@dataclass(frozen=True)
class DemonstrationConfig(StageConfig):
    """Demonstrations of a task."""

    by: Literal["script", "person"] = "script"
    """Who solves the episodes: the scripted policy of the task, or a person who sees a page in the browser and acts by mouse, keys, a
    gamepad, a 3D mouse, the controllers of OpenXR or masters that speak CRTK."""
    episodes: Annotated[int, Range(1, 1_000_000)] = 50
    """Solved episodes of the dataset."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Seed of the first episode; each following one has the next seed."""
    environments: Annotated[int, Range(1, 10_000)] = 16
    """Episodes of a script at once in each scene, at most as many as are wanted; the dataset does not depend on it on a CPU."""
    noise: Annotated[float, Range(0, 2)] = 0.1
    """Standard deviation of what is added to each action of a script before it acts, in its units of -1 to 1. What is written is the
    action without it, so that the data show how an expert recovers (DART, Laskey et al. 2017)."""
    images: Literal["video", "png"] = "video"
    """video: small (H.264); png: exact."""
    license: str = "cc-by-4.0"
    """Licence that the README of the dataset tells, by its identifier on the Hugging Face Hub, such as cc0-1.0 or apache-2.0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not re.fullmatch(r"[A-Za-z0-9][\w.+-]*", self.license, re.ASCII):
            raise ConfigError(f"DemonstrationConfig.license: {self.license!r} is no identifier of a licence; give one as cc-by-4.0")

    needs: ClassVar[dict[str, tuple[str, ...]]] = {"environments": ("by", "script"), "noise": ("by", "script")}
