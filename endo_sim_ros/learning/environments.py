"""The tasks as Gymnasium environments; importing this module registers each, such as ``endo_sim_ros/Retraction-v0``.

``gymnasium.make`` gives one environment, ``gymnasium.make_vec(id, num_envs, vectorization_mode="vector_entry_point")`` many in
one batched simulation. Environment i of those, with seed s + i, is the single one with that seed. Both take the arguments of
:class:`TaskEnvironment`.
"""

import math
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from endo_sim_ros.learning.actions import ARM_NAMES, Actions, Contact
from endo_sim_ros.learning.config import Randomisation, SightConfig, without_instrument
from endo_sim_ros.learning.pictures import IMAGE, IMAGE_RIGHT, SEGMENTATION
from endo_sim_ros.learning.scenes import Scene, load_scene
from endo_sim_ros.learning.task_batch import ARM_STATE, Observations, Observed, TaskBatch
from endo_sim_ros.learning.tasks import BOUND, TASKS, Outcome
from endo_sim_ros.physics import MotionConfig

_LARGEST = 1e3  # m, rad and N that an arm measures: far beyond any scene, and any force that ends an episode

try:
    import gymnasium
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("the environments need gymnasium, which is not installed; pip install 'endo_sim_ros[learning]'") from error

FPS = 25
"""Steps and images of an episode per second."""


def _make(
    task: str,
    count: int,
    scene: Scene | Path | str | None = None,
    observations: Observations = "state",
    randomisation: Randomisation | dict[str, float] | None = None,
    device: str = "auto",
    render_mode: str | None = None,
    actions: Actions = "cartesian",
    contact: Contact = "point",
    motion: MotionConfig | dict[str, float] | None = None,
    **sight: Any,
) -> tuple[TaskBatch, gymnasium.Space]:
    """The simulation, and the space of the observations of one environment; the arguments are those of `TaskEnvironment`."""
    for name, given, choice in (("observations", observations, Observations), ("actions", actions, Actions), ("contact", contact, Contact)):
        if given not in get_args(choice):
            raise ValueError(f"{name} must be {_either(choice)}, got {given!r}")
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be rgb_array or None, got {render_mode!r}")
    shown = SightConfig(**sight)
    if shown.eyes == 2 and observations == "state":
        raise ValueError("eyes is 2, but observations is state, which has no images; ask for image or both")
    if shown.segmentation and observations == "state":
        raise ValueError("segmentation is True, but observations is state, which has no images; ask for image or both")
    randomisation = Randomisation.from_mapping(randomisation) if isinstance(randomisation, dict) else randomisation or Randomisation()
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    for text in without_instrument(shown, randomisation) if actions == "cartesian" and contact == "point" else ():
        raise ValueError(text)
    if not isinstance(motion, MotionConfig | dict | None):
        raise ValueError(f"motion must be a MotionConfig or its values in a dict, such as {{'breathing': 0.004}}, got {motion!r}")
    motion = MotionConfig.from_mapping(motion) if isinstance(motion, dict) else motion or MotionConfig()
    batch = TaskBatch(task, scene, count, observations, randomisation, shown, device, render_mode is not None, actions, contact, motion)
    spaces: dict[str, gymnasium.Space] = {}
    if observations in ("state", "both"):
        spaces["state"] = gymnasium.spaces.Box(-BOUND, BOUND, (len(batch.observation_names),), np.float32)
    if observations == "sensors":
        spaces[ARM_STATE] = gymnasium.spaces.Box(-_LARGEST, _LARGEST, (len(ARM_NAMES) * len(batch.task.arms),), np.float32)
    if batch.pictures is not None:
        camera = batch.pictures.camera
        names = ((IMAGE, 3), (IMAGE_RIGHT, 3))[: shown.eyes] if observations != "state" else ()
        for name, channels in (*names, *(((SEGMENTATION, 1),) if shown.segmentation else ())):
            spaces[name] = gymnasium.spaces.Box(0, 255, (camera.height, camera.width, channels), np.uint8)
    return batch, gymnasium.spaces.Dict(spaces) if len(spaces) > 1 else next(iter(spaces.values()))


def _either(choice: Any) -> str:
    *others, last = get_args(choice)
    return f"{', '.join(others)} or {last}"


def _action_space(batch: TaskBatch) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-1.0, 1.0, (batch.action_size,), np.float32)


def _info(batch: TaskBatch, outcome: Outcome | None = None) -> dict[str, np.ndarray]:
    success = np.zeros(batch.count, bool) if outcome is None else outcome.success
    force, faults = np.sqrt((batch.task.force**2).sum(-1)), batch.tissue.tools.faults.cpu().numpy().copy()
    found = {"success": success, "force": force, "faults": faults}
    if batch.count == 1 and len(batch.task.arms) == 2 and batch.tools is not None:  # of many it would take as long as a GPU's step
        found["overlap"] = batch.tools.overlap()
    return found | {name: values.copy() for name, values in batch.varied.items()}


class TaskEnvironment(gymnasium.Env):
    """One episode at a time.

    Args:
        task: Name of the task, one of :data:`endo_sim_ros.learning.tasks.TASKS`.
        scene: A PLY model with its cameras.json, or the folder of a model.ply, or a :class:`Scene`; default: a piece of the
            synthetic patient.
        observations: ``state``, ``image`` (the endoscope's), ``both``, or ``sensors``: image and ``arm`` [11], what a robot has, see
            `endo_sim_ros.learning.actions.arm_state`. One alone is an array. More are a dict: ``state`` [n], ``arm`` [11 A],
            ``image`` and ``image_right`` [H, W, 3], ``segmentation`` [H, W, 1].
        randomisation: How episodes differ from the scene, as :class:`Randomisation` or its values in a dict.
        image_width: Pixels, 16 or more; the height follows from the scene's camera.
        device: Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N.
        render_mode: ``rgb_array`` for images by :meth:`render`.
        instrument: Whether images show the tool, with its shadow. States and rewards do not depend on it.
        tool: Name or file of the tool that is shown, as `endo_sim_ros.instruments.load_arm` takes it; default: that of the task.
        eyes: 2 adds the image of the right eye, ``image_right``.
        baseline: Distance between the eyes, m; default: that of the endoscope of a da Vinci Xi.
        dye: Whether images show a spot of dye on the tissue where the task is.
        segmentation: Add ``segmentation``, what is in each pixel: 0 nothing, 1 tissue, and from 2 on the links of the instrument,
            `endo_sim_ros.instruments.LINKS`.
        actions: ``cartesian``, ``joints`` or ``joint_positions``, see :class:`TaskBatch`.
        contact: What touches the tissue: ``point`` or ``links``, see :class:`TaskBatch`.
        motion: How the tissue breathes, as :class:`MotionConfig` or its values in a dict, such as ``{"breathing": 0.004}``. Each episode
            begins in phases of its own.

    Raises:
        ValueError: If an argument cannot be used, or the model is too small.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}

    def __init__(
        self,
        task: str,
        scene: Scene | Path | str | None = None,
        observations: Observations = "state",
        randomisation: Randomisation | dict[str, float] | None = None,
        image_width: int = 64,
        device: str = "auto",
        render_mode: str | None = None,
        instrument: bool = True,
        tool: str = "",
        eyes: Literal[1, 2] = 1,
        baseline: float = SightConfig.baseline,
        dye: bool = True,
        segmentation: bool = False,
        actions: Actions = "cartesian",
        contact: Contact = "point",
        motion: MotionConfig | dict[str, float] | None = None,
    ):
        self.batch, self.observation_space = _make(
            task, 1, scene, observations, randomisation, device, render_mode, actions, contact, image_width=image_width,
            instrument=instrument, tool=tool, eyes=eyes, baseline=baseline, dye=dye, segmentation=segmentation, motion=motion,
        )  # fmt: skip
        self.action_space, self.render_mode = _action_space(self.batch), render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observed, dict[str, Any]]:
        """Begin an episode; return its first observation and its info. A seed makes it repeatable."""
        super().reset(seed=seed)
        self.batch.reset([0], [self.np_random])
        return _first(self.batch.observe()), _first(_info(self.batch))

    def step(self, action: np.ndarray) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info after an action [4, 5 or 7] in -1 … 1."""
        observations, outcome = self.batch.step(np.asarray(action)[None])
        ended = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        return _first(observations), float(outcome.reward[0]), *ended, _first(_info(self.batch, outcome))

    def render(self) -> np.ndarray | None:
        """The endoscope's image [H, W, 3], uint8; None without a render mode."""
        return self.batch.images()[0] if self.render_mode else None


class VectorTaskEnvironment(gymnasium.vector.VectorEnv):
    """Many episodes at once in one batched simulation, on one device; an ended one begins anew at the next step.

    Args:
        task: As for :class:`TaskEnvironment`, like all others.
        num_envs: How many.
        render_mode, options: Its other arguments, by their names.
    """

    metadata = {
        "render_modes": ["rgb_array"], "render_fps": FPS, "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }  # fmt: skip

    def __init__(self, task: str, num_envs: int = 1, render_mode: str | None = None, **options: Any):
        self.batch, self.single_observation_space = _make(task, num_envs, render_mode=render_mode, **options)
        self.num_envs, self.single_action_space, self.render_mode = num_envs, _action_space(self.batch), render_mode
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, np.ndarray]]:
        """Begin episodes; return the observations [B, …] and infos of all.

        Args:
            seed: One seed s, with which environment i has s + i, or a list with one for each; None goes on with the generators.
            options: `reset_mask` [B] bool: which episodes begin anew; default: all.

        Raises:
            ValueError: If there are more or fewer seeds or places in the mask than environments.
        """
        seeds, chosen = seeds_and_mask(self.num_envs, seed, options)
        for i, each in enumerate(seeds):
            if each is not None and chosen[i]:
                self._generators[i] = np.random.default_rng(each)
        return self.renew(np.flatnonzero(chosen)), _info(self.batch)

    def step(self, actions: np.ndarray) -> tuple[Observed, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Return observations, rewards, terminated, truncated [B, …] and infos after actions [B, 4, 5 or 7]; ended episodes begin anew."""
        renew = np.flatnonzero(self._ended)
        observations, outcome = self.batch.step(actions, renew.tolist(), [self._generators[i] for i in renew])
        self._ended = outcome.terminated | outcome.truncated
        return observations, outcome.reward, outcome.terminated, outcome.truncated, _info(self.batch, outcome)

    def renew(self, episodes: np.ndarray) -> Observed:
        """Begin these anew at once instead of at the next step, and observe all: for learners that count on it."""
        self.batch.reset(episodes.tolist(), [self._generators[i] for i in episodes])
        self._ended[episodes] = False
        return self.batch.observe()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The endoscope's images [H, W, 3], uint8, one for each environment; None without a render mode."""
        return tuple(self.batch.images()) if self.render_mode else None


def seeds_and_mask(count: int, seed: int | list[int | None] | None, options: dict[str, Any] | None) -> tuple[list[int | None], np.ndarray]:
    """The seeds [B] and the mask [B] that `VectorTaskEnvironment.reset` takes; raises what that does."""
    seeds: list[int | None] = [None] * count
    if seed is not None:
        seeds = [int(seed) + i for i in range(count)] if isinstance(seed, (int, np.integer)) else list(seed)
    mask = np.array((options or {}).get("reset_mask", np.ones(count)), bool)
    for what, shape in (("seeds", (len(seeds),)), ("places in reset_mask", mask.shape)):
        if shape != (count,):
            raise ValueError(f"{count} environments need as many {what}, got {math.prod(shape)}")
    return seeds, mask


def _first(values: Any) -> Any:
    """Of the first environment, out of batched arrays."""
    if isinstance(values, dict):
        return {name: _first(value) for name, value in values.items()}
    return values[0] if values.ndim > 1 or values.dtype == object else values[0].item()


for _name in TASKS:
    gymnasium.register(
        f"endo_sim_ros/{_name.capitalize()}-v0",
        entry_point=f"{__name__}:TaskEnvironment",
        vector_entry_point=f"{__name__}:VectorTaskEnvironment",
        kwargs={"task": _name},
    )
