"""Demonstrations: a script or a person solves episodes of a task, and what is seen and done is written as a LeRobot dataset.

Columns beside those that every LeRobot dataset has:

=============================  ==================================================================================
observation.images.endoscope.  left, and right with two eyes: what the endoscope shows
observation.segmentation       what is in each pixel, on request
observation.state              of each arm alone, in the frame of the endoscope (x right, y down, z forward): pose of the
                               tip (m, xyzw), jaw (rad), and the force of the tissue on the tool (N)
observation.state.             joint_positions: yaw, pitch, insertion (m), roll, wrist_pitch, wrist_yaw, where there is an
                               instrument
observation.meta.tool.         psm1, and psm2: the name of the instrument
observation.camera_pose        of the left eye, which is the pictures': camera to world (m, xyzw)
observation.endoscope          yaw, pitch, insertion (m) and roll of its arm, where the actions move it
observation.environment_state  the state observation of the task, which knows the goal
action                         what the task takes, -1 to 1: how far each tip moves in its frame, the fourth number, and
                               in some tasks the fifth, which turns it
action.cartesian_absolute      the same as a command: pose of the tip in the world (m, xyzw), and jaw (rad); or, where the actions move
                               it, pose of the endoscope in the world
command.endoscope              and joints of its arm
next.reward, .done, .success   what the action led to
seed                           of the episode
=============================  ==================================================================================

With the observations of row k the action of row k was taken.
"""

import json
import logging
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from endo_sim_ros.core.folders import leaving_none_empty, make_writable, written_whole
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.instruments import JOINTS
from endo_sim_ros.learning.actions import ARM_NAMES, POSE_NAMES, arm_commands, by_arm, command_names, pose_numbers
from endo_sim_ros.learning.card import card
from endo_sim_ros.learning.config import DemonstrationConfig, Randomisation, SightConfig
from endo_sim_ros.learning.dataset import (
    CAMERA_POSE,
    COMMAND,
    IMAGE,
    IMAGE_RIGHT,
    JOINT_POSITIONS,
    OPTIONS,
    SEGMENTATION,
    DatasetWriter,
    ImageFormat,
    picture_feature,
    scalar_feature,
    vector_feature,
)
from endo_sim_ros.learning.policies import Policy, scripted_policy
from endo_sim_ros.learning.task_batch import Observed, TaskBatch, usable
from endo_sim_ros.learning.tasks import Task, find_task, same_task, task_digest
from endo_sim_ros.physics import MotionConfig

_logger = logging.getLogger(__name__)

_COLUMNS = {"image": IMAGE, "image_right": IMAGE_RIGHT, "segmentation": SEGMENTATION}
_SAVE_EVERY = 10.0  # seconds; a process that is killed loses at most the episodes of this time, or of
_SAVE_SHARE = 0.1  # so much of the time in which saving may take: it grows with the dataset
_FEWEST = 0.02  # share of episodes that the script must solve


@dataclass
class Episode:
    """What is known of an episode so far, a row each."""

    rng: np.random.Generator
    rows: dict[str, list[Any]] = field(default_factory=dict)
    pictures: dict[str, list[np.ndarray]] = field(default_factory=dict)
    solved: bool | None = None  # None = it goes on


class Demonstrations:
    """A dataset of episodes of a task, and what they take place in: begun, or taken up where it ends.

    As a context it saves at its end. Where that is an interrupt or a failing drive, it is told how many episodes are kept.

    Args:
        task: Its name.
        scenes: What is seen and touched, each once, as `load_scene` takes it. One in which the task cannot take place is left out,
            and it is said why. Of the others the episode of seed n is in scene n modulo their number.
        out: Folder of the dataset.
        count: Episodes at once.
        config, sight, randomisation, motion: Options.
        device: Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N.

    Attributes:
        batches: The environments of each scene.
        seed: That of the next episode.
        wanted: Number of episodes that the dataset shall have.

    Raises:
        SequenceError: If the folder has other data.
        ValueError: If there is no such task, or an option cannot be used, or the task can take place in no scene.
        RuntimeError: If pyarrow is not installed.
    """

    def __init__(
        self,
        task: str,
        scenes: Sequence[str | Path],
        out: Path,
        count: int,
        config: DemonstrationConfig,
        sight: SightConfig,
        randomisation: Randomisation,
        motion: MotionConfig,
        device: str,
    ):
        find_task(task)  # else no scene would be usable
        make = partial(TaskBatch, task, randomisation=randomisation, sight=sight, device=device, motion=motion)
        scenes, self.batches = usable(scenes, partial(make, count=count, observations="both"))
        first = self.batches[0]
        fps = round(1 / first.task.physics().step_duration)
        noise = config.noise if config.by == "script" else 0.0
        options = {"task": task, "scenes": list(map(str, scenes)), "seed": config.seed, "noise": noise, "by": config.by}
        options |= {"license": config.license, "task_digest": task_digest(task)}
        moved = asdict(motion)
        moved |= {"motion_file": file} if (file := moved.pop("file")) else {}
        self._options = options | {**asdict(sight), "shown_tool": sight.tool, **asdict(randomisation), **moved}
        _check_options(out, self._options)
        features = _features(first, fps, config.images)
        if other := [scene for scene, batch in zip(scenes, self.batches) if _features(batch, fps, config.images) != features]:
            raise SequenceError(f"{other[0]} has pictures of another size than {scenes[0]}, but a dataset has one size of each kind")
        self._writer = DatasetWriter(out, first.task.sentence, fps, features)
        seeds = self._writer.column("seed")
        self.seed = int(seeds[-1]) + 1 if len(seeds) else config.seed
        self._out, self._task, self._fps, self.wanted = out, task, fps, config.episodes
        self._saved, self._save_after = time.monotonic(), _SAVE_EVERY

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        try:
            self.save()
        except OSError as failed:
            error = failed
        kept = f"{self._writer.saved} of {self.wanted} episodes are kept, and the same command goes on from there"
        if isinstance(error, OSError):  # a full drive, above all
            raise OSError(f"{self._out}: {error.strerror or error}; {kept}") from error
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            _logger.warning("%s: %s", self._out, kept)

    @property
    def episodes(self) -> int:
        """Number of episodes in the dataset."""
        return self._writer.episodes

    def add(self, episodes: dict[int, Episode]) -> None:
        """Write episodes by their seeds."""
        self._note_options()
        rows = []
        for seed, episode in episodes.items():
            columns = {name: np.array(values) for name, values in episode.rows.items()}
            columns = {name: values if values.dtype.kind in "bU" else values.astype(np.float32) for name, values in columns.items()}
            rows.append((columns | {"seed": np.full(len(columns["action"]), seed)}, episode.pictures))
        self._writer.add(*rows)

    def _note_options(self) -> None:
        """Write what the episodes depend on, before the first: only with that are they continued."""
        if not (self._out / OPTIONS).exists():
            folder = (self._out / OPTIONS).parent
            with leaving_none_empty(folder):
                make_writable(folder)
                with written_whole(self._out / OPTIONS) as unfinished:
                    unfinished.write_text(json.dumps(self._options, indent=4), "utf8")

    def save(self) -> None:
        """Write what describes all episodes so far; without it the newest are not part of the dataset."""
        began = time.monotonic()
        if self._writer.episodes:
            self._writer.save()
            text = card(self._out.name, self._options, self._fps, self._writer)
            for name in ("README.md", "meta/README.md"):  # where readers look, and where Open-H does
                (self._out / name).write_text(text, "utf8")
        self._saved = time.monotonic()
        self._save_after = max(_SAVE_EVERY, (self._saved - began) / _SAVE_SHARE)

    def save_if_due(self) -> None:
        """Save, if the last time was long ago."""
        if time.monotonic() - self._saved > self._save_after:
            self.save()


def demonstrate(
    task: str,
    scenes: Sequence[str | Path],
    out: Path,
    config: DemonstrationConfig = DemonstrationConfig(),
    sight: SightConfig = SightConfig(),
    randomisation: Randomisation = Randomisation(),
    motion: MotionConfig = MotionConfig(),
    device: str = "auto",
) -> tuple[int, int]:
    """Let the script of a task solve episodes and write them; returns the number of all in the dataset, and how many were tried now.

    The arguments are those of `Demonstrations`, and so is what it raises. Episodes are played in rounds: some in each scene, at most as
    many as are wanted. Those of finished rounds stay in the dataset when the call is interrupted, and the next one continues it.

    Raises:
        SequenceError: If hardly an episode is solved, too.
        OSError: If episodes cannot be written, as on a full drive.
    """
    count = min(config.environments, -(-config.episodes // max(len(scenes), 1)))
    demonstrations = Demonstrations(task, scenes, out, count, config, sight, randomisation, motion, device)
    batches, seed, tried = demonstrations.batches, demonstrations.seed, 0
    policy = scripted_policy(task, count)
    with demonstrations, Progress() as bar:
        progress = bar.add_task(task, total=config.episodes, completed=demonstrations.episodes)
        while demonstrations.episodes < config.episodes:
            # Seed n is of scene n mod their number, however many episodes run at once.
            own = [np.arange(count) * len(batches) + seed + (i - seed) % len(batches) for i in range(len(batches))]
            played = []
            for number, (batch, seeds) in enumerate(zip(batches, own), 1):
                bar.update(progress, description=f"{task}, scene {number} of {len(batches)}")
                played.append(_play(batch, policy, config.noise, seeds))
            episodes = dict(zip(np.concatenate(own).tolist(), chain(*played)))
            solved = [number for number in sorted(episodes) if episodes[number].solved]
            kept = solved[: config.episodes - demonstrations.episodes]
            tried += len(episodes) if kept == solved else sorted(episodes).index(kept[-1]) + 1
            if kept:
                demonstrations.add({number: episodes[number] for number in kept})
            bar.update(progress, completed=demonstrations.episodes)
            seed += len(episodes)
            demonstrations.save_if_due()
            if tried * _FEWEST > 1 and demonstrations.episodes < tried * _FEWEST:
                raise SequenceError(f"{demonstrations.episodes} of {tried} episodes were solved; less noise or randomisation helps")
    return demonstrations.episodes, tried


def _check_options(out: Path, options: dict[str, Any]) -> None:
    if not out.exists() or not any(out.iterdir()):
        return
    try:
        before = json.loads((out / OPTIONS).read_text("utf8"))
    except (OSError, ValueError) as error:
        if (out / "meta").exists() or (out / "data").exists():
            told = f"{out} has no {OPTIONS} that can be read, which tells by what options to continue it"
            raise SequenceError(f"{told}; copy the dataset again, if it was cut off on its way, or choose another name") from error
        raise SequenceError(f"{out} exists already and has no demonstrations; choose another name or remove it first") from error
    before = {"by": "script", "license": DemonstrationConfig().license, **before}  # of a dataset from when there were no others
    if same_task(str(before.get("task")), options["task"]):  # however its file is named now
        before["task"] = options["task"]
        if before.get("task_digest", options["task_digest"]) != options["task_digest"]:
            told = f"{out} was begun with another {Path(options['task']).name}: the file was changed since, or is another of this name"
            raise SequenceError(f"{told}; choose another name for the dataset, or give the file as it was")
    other = [name for name, value in json.loads(json.dumps(options)).items() if before.get(name) != value and name != "task_digest"]
    if other:
        had = ", ".join(f"{name} {before.get(name)!r}" for name in other)
        raise SequenceError(f"{out} was begun with {had}; continue it with the same options, or choose another name")


def _play(batch: TaskBatch, policy: Policy, noise: float, seeds: np.ndarray) -> list[Episode]:
    """One episode in each environment, each with its seed [B]."""
    episodes, seen = begin(batch, seeds)
    policy.reset(range(batch.count))
    while any(episode.solved is None for episode in episodes):
        actions = np.clip(policy.act(seen["state"]), -1, 1)
        noisy = actions + noise * np.stack([episode.rng.standard_normal(actions.shape[1]) for episode in episodes])
        seen = take(batch, episodes, seen, actions, noisy)
    return episodes


def begin(batch: TaskBatch, seeds: Sequence[int] | np.ndarray) -> tuple[list[Episode], dict[str, np.ndarray]]:
    """Begin an episode in each environment, each with its seed [B]; returns them, and what is observed first."""
    batch.reset(range(batch.count), [np.random.default_rng(seed) for seed in seeds])
    return [Episode(np.random.default_rng([seed, 0xDA])) for seed in seeds], _observed(batch.observe())


def take(
    batch: TaskBatch, episodes: Sequence[Episode], seen: dict[str, np.ndarray], actions: np.ndarray, noisy: np.ndarray
) -> dict[str, np.ndarray]:
    """Take a step in all episodes, and add its row to those that go on; returns what is observed after it.

    Args:
        batch: The environments.
        episodes: What is known of each so far [B].
        seen: What was observed before the step.
        actions: What is written [B, n].
        noisy: What is done [B, n].
    """
    rows = {
        "observation.state": batch.arm_state(),
        "observation.environment_state": seen["state"],
        "action": actions,
        COMMAND: arm_commands(batch.task, actions, None if batch.pictures is None else batch.pictures.moved),
    }
    if batch.pictures is not None:
        rows[CAMERA_POSE] = pose_numbers(batch.pictures.poses)
    if batch.tools is not None:
        rows[JOINT_POSITIONS] = batch.tools.joints.reshape(batch.count, -1).copy()
        rows |= dict(zip(_tools(batch.task), batch.tools.names().T))
    joints, asked = batch.task.endoscope_joints(), batch.task.endoscope_joints(actions)
    if joints is not None and asked is not None:
        rows |= {"observation.endoscope": joints, "command.endoscope": asked}
    after, outcome = batch.step(np.clip(noisy, -1, 1))
    rows |= {"next.reward": outcome.reward, "next.done": outcome.terminated | outcome.truncated, "next.success": outcome.success}
    for b, episode in enumerate(episodes):
        if episode.solved is None:
            for name, values in rows.items():
                episode.rows.setdefault(name, []).append(values[b])
            for name in seen.keys() & _COLUMNS.keys():
                episode.pictures.setdefault(_COLUMNS[name], []).append(seen[name][b].squeeze())
            if rows["next.done"][b]:
                episode.solved = bool(outcome.success[b])
    return _observed(after)


def _tools(task: Task) -> list[str]:
    """Columns with the names of the tools, as Open-H has them."""
    return [f"observation.meta.tool.{arm.lower()}" for arm in task.arms]


def _observed(seen: Observed) -> dict[str, np.ndarray]:
    assert isinstance(seen, dict)  # state and images
    return seen


def _features(batch: TaskBatch, fps: int, images: ImageFormat) -> dict[str, dict[str, Any]]:
    """What the columns are."""
    assert batch.pictures is not None  # images are observed
    task, action = batch.task, ["x", "y", "z", "fourth", *(["twist"] if batch.task.twist else [])]
    vectors = {
        "observation.state": by_arm(task, ARM_NAMES),
        "observation.environment_state": task.observation_names,
        "action": action if len(task.arms) == 1 else by_arm(task, action),
        COMMAND: command_names(task),
        CAMERA_POSE: list(POSE_NAMES),
    }
    if batch.tools is not None:
        vectors[JOINT_POSITIONS] = by_arm(task, JOINTS)
    if task.endoscope_joints() is not None:
        vectors |= dict.fromkeys(("observation.endoscope", "command.endoscope"), [f"ECM.{name}" for name in JOINTS[:4]])
    tools = dict.fromkeys(_tools(task) if batch.tools is not None else (), "string")
    kinds = tools | {"next.reward": "float32", "next.done": "bool", "next.success": "bool", "seed": "int64"}
    camera, sight = batch.pictures.camera, batch.sight
    shown = [IMAGE, *([IMAGE_RIGHT] * (sight.eyes == 2)), *([SEGMENTATION] * sight.segmentation)]
    features = {key: picture_feature(key, (camera.height, camera.width), fps, images) for key in shown}
    features |= {key: vector_feature(names) for key, names in vectors.items()}
    return features | {key: scalar_feature(kind) for key, kind in kinds.items()}
