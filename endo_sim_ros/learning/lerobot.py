"""Recordings as a LeRobot dataset: each is an episode.

Columns beside those that every LeRobot dataset has: `observation.images.endoscope.left`, and `observation.state`,
`observation.environment_state` and `action` as described in `episodes`. What else was recorded is in
`observation.images.endoscope.right`, `observation.segmentation`, `observation.state.joint_positions` and `observation.camera_pose`;
where edges were told to cut, `action` ends with that. Of a task
`next.reward`, `next.done` and `next.success` say what a step led to, `seed` and `goal` (m, world, at rest) what the episode is
about, as in demonstrations. Cameras and joints have the names of Open-H.
"""

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rich.progress import track

from endo_sim_ros.core.folders import leaving_none_empty, make_writable
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.actions import POSE_NAMES
from endo_sim_ros.learning.dataset import (
    CAMERA_POSE,
    IMAGE,
    IMAGE_RIGHT,
    JOINT_POSITIONS,
    SEGMENTATION,
    DatasetWriter,
    ImageFormat,
    check_sides,
    import_pyarrow,
    picture_feature,
    scalar_feature,
    vector_feature,
)
from endo_sim_ros.learning.episodes import (
    Episode,
    Sampling,
    action_names,
    cut_names,
    environment_names,
    joint_names,
    picture_size,
    read_episode,
    state_names,
)
from endo_sim_ros.sequences.bag import WORLD_FRAME

GOAL = "goal"
_OUTCOME = {"next.reward": "float32", "next.done": "bool", "next.success": "bool", "seed": "int64"}
_PICTURES = {IMAGE: "left", IMAGE_RIGHT: "right", SEGMENTATION: "segmentation"}  # of an `Episode`


def export_lerobot(
    bags: Iterable[str | Path],
    out: str | Path,
    task: str,
    fps: int | None = None,
    arms: tuple[str, ...] = (),
    sampling: Sampling = "auto",
    images: ImageFormat = "video",
    world_frame: str = WORLD_FRAME,
    frames: tuple[str, ...] = (),
) -> tuple[int, int]:
    """Write recordings as one dataset and return the numbers of its episodes and frames.

    Args:
        bags: Recordings; each is an episode. All must have the arms, rate and image size of the first.
        out: Folder of the new dataset.
        task: What was done, in words.
        fps, arms, sampling, world_frame, frames: See `read_episode`.
        images: ``video`` (H.264, small) or ``png`` (exact).

    Raises:
        SequenceError: If the folder exists or a recording cannot be used; nothing is left behind then.
        ValueError: If one of the frames is not a name and a pose, or the folder takes no files.
        RuntimeError: If pyarrow is not installed.
    """
    out, bags = Path(out), [Path(bag) for bag in bags]
    import_pyarrow()
    if not bags:
        raise SequenceError("no recording to export; give one or more, then the folder of the dataset")
    if out.exists():
        raise SequenceError(f"{out} exists already; choose another name or remove it first")
    with leaving_none_empty(out):
        make_writable(out)  # before any work
    for bag in bags if images == "video" else ():  # before minutes of reading
        if (size := picture_size(bag)) is not None:
            check_sides(*size)
    episodes = []
    for bag in bags:  # all of them before anything is written
        episodes.append(read_episode(bag, fps, arms, sampling, world_frame, frames))
        _check_alike(episodes[0], episodes[-1])
    try:
        writer = DatasetWriter(out, task, episodes[0].fps, _features(episodes[0], images))
        for episode in episodes:
            shown = {key: episode.images(getattr(episode, name)) for key, name in _PICTURES.items() if getattr(episode, name)}
            shown[IMAGE] = track(shown[IMAGE], description=f"writing {episode.bag.name}", total=len(episode))
            writer.add((_columns(episode), shown))
        writer.save()
    except BaseException:  # half a dataset would only be in the way of the next try
        shutil.rmtree(out, ignore_errors=True)
        raise
    return len(episodes), sum(map(len, episodes))


def _check_alike(first: Episode, other: Episode) -> None:
    traits = {
        "arms": lambda episode: episode.arms,
        "fps": lambda episode: episode.fps,
        "image size": lambda episode: episode.left.size,
        "beside the rest": lambda episode: ", ".join(episode.content) or "nothing",
    }
    for what, trait in traits.items():
        mine, others = trait(first), trait(other)
        if mine != others:
            raise SequenceError(f"{other.bag} has {what} {others}, {first.bag} {mine}; the episodes of one dataset must agree")


def _columns(episode: Episode) -> dict[str, np.ndarray]:
    """The numbers of an episode: vectors [T, D], and single ones [T]."""
    more = {JOINT_POSITIONS: episode.joints, CAMERA_POSE: episode.camera_pose}
    if episode.outcome is not None:
        single, goal = np.split(episode.outcome, [len(_OUTCOME)], 1)
        more |= {key: column.astype(kind) for (key, kind), column in zip(_OUTCOME.items(), single.T)} | {GOAL: goal.astype(np.float32)}
    return {
        "observation.state": episode.state,
        "observation.environment_state": episode.environment_state,
        **{key: values for key, values in more.items() if values is not None},
        "action": episode.action if episode.cut is None else np.hstack([episode.action, episode.cut]),
    }


def _features(episode: Episode, images: ImageFormat) -> dict[str, dict]:
    """What the columns are."""
    vectors = {
        "observation.state": state_names(episode.arms),
        "observation.environment_state": environment_names(episode.arms),
        "action": action_names(episode.arms) + (cut_names(episode.arms) if episode.cut is not None else []),
    }
    vectors |= {JOINT_POSITIONS: joint_names(episode.arms)} if episode.joints is not None else {}
    vectors |= {CAMERA_POSE: list(POSE_NAMES)} if episode.camera_pose is not None else {}
    vectors |= {GOAL: ["x", "y", "z"]} if episode.outcome is not None else {}
    single = _OUTCOME if episode.outcome is not None else {}
    pictures = {
        key: picture_feature(key, episode.left.size, episode.fps, images) for key, name in _PICTURES.items() if getattr(episode, name)
    }
    numbers = {key: vector_feature(names) for key, names in vectors.items()}
    return pictures | numbers | {key: scalar_feature(kind) for key, kind in single.items()}
