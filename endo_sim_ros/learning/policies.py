"""Policies: scripted ones that solve the tasks, and a small network with its weights in a .npz file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, cast, get_args

import numpy as np

from endo_sim_ros.core.plugins import load_named, told_where
from endo_sim_ros.learning.actions import Actions, action_size, observed_names
from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.tasks import Script, find_task, same_task, task_digest, warn_of_other

_MOST_WEIGHTS = 10_000_000  # read from a file


class Policy(Protocol):
    """Acts in B episodes."""

    @property
    def actions(self) -> Actions:
        """What its actions mean, see `TaskBatch`."""
        ...

    @property
    def sight(self) -> SightConfig | None:
        """What the pictures show that it takes, with ``sensors`` as observations, see `TaskBatch`; None where it takes the state."""
        ...

    def reset(self, episodes: Sequence[int]) -> None:
        """These episodes begin anew."""

    def act(self, observations: Any) -> np.ndarray:
        """Actions [B, 4, 5 or 7] for observations; those of several arms one after the other."""
        ...


class StillPolicy(Script):
    """Does nothing: what a task scores by itself.

    Args:
        size: Of its actions.
    """

    def __init__(self, size: int = 4):
        self._size = size

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4 A] of zero for state observations [B, n]."""
        return np.zeros((len(self.states(observations)), self._size))


class NetworkPolicy:
    """A network with tanh between its layers; without hidden ones it is linear. Actions are clipped to ±1 by the task.

    Args:
        task: Name of the task that it was made for.
        layers: Weights [n_in + 1, n_out] of each layer, the last row being the bias; or [B, n_in + 1, n_out], one for each episode.
        actions: What its actions mean, see `TaskBatch`; with joints it also sees them.

    Raises:
        ValueError: If the layers do not fit together or do not fit the task.
    """

    sight = None

    def __init__(self, task: str, layers: Sequence[np.ndarray], actions: Actions = "cartesian"):
        self.task, self.layers = task, [np.asarray(layer, np.float64) for layer in layers]
        self.actions: Actions = actions
        self.digest = task_digest(task)  # of the task that it was made for
        sizes = self.sizes(task, [layer.shape[-1] for layer in self.layers[:-1]], actions)
        shapes = [layer.shape[-2:] for layer in self.layers]
        if shapes != sizes or not all(np.isfinite(layer).all() for layer in self.layers):
            raise ValueError(
                f"policy for {task}: layers of {shapes} do not fit, expected {sizes} of finite numbers for actions = {actions!r}"
                + self._which_fit(shapes)
            )

    def _which_fit(self, shapes: list[tuple[int, ...]]) -> str:
        """For which other actions layers of these shapes are, as the end of a sentence; empty for none."""
        hidden = [shape[-1] for shape in shapes[:-1]]
        fitting = [name for name in get_args(Actions) if name != self.actions and shapes == self.sizes(self.task, hidden, name)]
        return (
            f"; they fit actions = {' or '.join(map(repr, fitting))}; make a NetworkPolicy of the one it was trained for, and save it"
            if fitting
            else ""
        )

    @staticmethod
    def sizes(task: str, hidden: Sequence[int], actions: Actions = "cartesian") -> list[tuple[int, int]]:
        """Shapes of the layers for a task and what actions mean, with hidden layers of these sizes."""
        kind = find_task(task)
        widths = [len(observed_names(kind, actions)), *hidden, action_size(kind, actions) * len(kind.arms)]
        return [(before + 1, after) for before, after in zip(widths, widths[1:])]

    @classmethod
    def from_vectors(cls, task: str, hidden: Sequence[int], vectors: np.ndarray, actions: Actions = "cartesian") -> "NetworkPolicy":
        """From all weights in a row [P], or one row for each episode [B, P]."""
        sizes = cls.sizes(task, hidden, actions)
        ends = np.cumsum([rows * columns for rows, columns in sizes])
        parts = np.split(vectors, ends[:-1], axis=-1)
        return cls(task, [part.reshape(*vectors.shape[:-1], *size) for part, size in zip(parts, sizes)], actions)

    def reset(self, episodes: Sequence[int]) -> None:
        """Nothing to do: the network has no memory."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4 or 7], not clipped, for state observations [B, n].

        Raises:
            ValueError: If they are not as many as the policy was made for.
        """
        expected = self.layers[0].shape[-2] - 1
        if observations.shape[1:] != (expected,):
            raise ValueError(
                f"the policy for {self.task} with actions = {self.actions!r} takes observations [B, {expected}], got "
                f"{list(observations.shape)}; make the task with these actions"
            )
        values = observations.astype(np.float64)
        for number, layer in enumerate(self.layers):
            values = np.tanh(values) if number else values
            # One input after the other: the same bits for any number of episodes.
            total = layer[..., -1, :] + np.zeros((len(values), 1))
            for i in range(values.shape[1]):
                total = total + values[:, i : i + 1] * layer[..., i, :]
            values = total
        return values

    def save(self, path: str | Path) -> None:
        """Write a .npz file of plain arrays."""
        with Path(path).open("wb") as file:
            layers: dict[str, Any] = {f"layer{i}": layer for i, layer in enumerate(self.layers)}
            told = {name: np.array(getattr(self, name)) for name in ("task", "digest", "actions")}
            np.savez(file, **told, **layers)

    @classmethod
    def load(cls, path: str | Path, task: str = "") -> "NetworkPolicy":
        """Read what `save` wrote; nothing in the file is executed.

        Args:
            path: The file.
            task: How a task of your own is named now, if it is that of the policy.

        Raises:
            ValueError: If it is something else; the message names the file.
        """
        try:
            with Path(path).open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                layers = [file[f"layer{i}"] for i in range(sum(name.startswith("layer") for name in file.files))]
                trained, actions = str(file["task"]), str(file["actions"]) if "actions" in file.files else "cartesian"
                digest = str(file["digest"]) if "digest" in file.files else ""
        except OSError as error:
            raise ValueError(f"{path}: not a readable policy ({error})") from error
        except Exception as error:  # zipfile and numpy have a type each, and advise on what only programmers can do
            raise ValueError(f"{path} is no policy file; give the policy.npz that `endo-sim train` wrote") from error
        if actions not in get_args(Actions):
            known = ", ".join(get_args(Actions))
            raise ValueError(
                f"{path}: not a readable policy (its actions are {actions[:40]!r}, known are {known}; train one with one of these)"
            )
        if sum(layer.size for layer in layers) > _MOST_WEIGHTS or not layers or any(layer.ndim != 2 for layer in layers):
            raise ValueError(f"{path}: not a readable policy (it has no layers, or too large ones)")
        try:
            policy = cls(task if same_task(trained, task) else trained, layers, cast(Actions, actions))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: not a readable policy ({error})") from error
        policy.digest = digest
        return policy


def scripted_policy(task: str, count: int = 1) -> Policy:
    """The scripted policy that solves a task, for a number of episodes.

    Raises:
        ValueError: If there is no such task, or no script for it.
    """
    return find_task(task).script(count)


def make_policy(policy: str, task: str, count: int = 1, device: str = "auto") -> Policy:
    """``scripted``, ``still``, the policy in a .npz file, the folder of a checkpoint of lerobot, or your own ``path/to/file.py:Class``.

    Args:
        policy: Which. A class of your own is called with the number of episodes.
        task: Name of the task.
        count: Number of episodes.
        device: Of a checkpoint: auto (the GPU when there is one), cpu, cuda or cuda:N.

    Raises:
        ValueError: If there is no such task or script, or the file cannot be read or is for another task.
        RuntimeError: If lerobot is needed and not installed, or a class of your own raises.
    """
    kind = find_task(task)
    if policy == "scripted":
        return scripted_policy(task, count)
    if policy == "still":
        return StillPolicy(kind.action_size() * len(kind.arms))
    if Path(policy).is_dir():
        if (Path(policy) / "keypoints.npz").exists():
            from endo_sim_ros.learning.keypoint_policy import KeypointPolicy as Trained
        else:
            from endo_sim_ros.learning.lerobot_policy import LeRobotPolicy as Trained
        found = Trained(policy, device)
        if found.task and not same_task(found.task, task):
            raise ValueError(f"{policy} was trained on demonstrations of {found.task}, not of {task}; give a policy of this task")
        warn_of_other(policy, found.digest, task)
        return found
    if ":" in policy and not Path(policy).exists():
        try:
            made = load_named(policy)
            with told_where():
                found = made(count)
        except TypeError as error:
            raise ValueError(f"{policy} is called with the number of episodes alone: {error}") from error
        if getattr(found, "actions", None) not in get_args(Actions) or not isinstance(getattr(found, "sight", 0), SightConfig | None):
            known = ", ".join(get_args(Actions))
            raise ValueError(
                f"{policy} is no policy: its `actions` are one of {known}, and its `sight` is a SightConfig, or None for the state"
            )
        if missing := [name for name in ("reset", "act") if not callable(getattr(found, name, None))]:
            raise ValueError(f"{policy} is no policy: it has no {' and no '.join(missing)}; see endo_sim_ros.learning.policies.Policy")
        return found
    loaded = NetworkPolicy.load(policy, task)
    if loaded.task != task:
        raise ValueError(f"{policy} was trained for {loaded.task}, not for {task}")
    warn_of_other(policy, loaded.digest, task)
    return loaded
