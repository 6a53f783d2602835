"""Policies: scripted ones that solve the tasks, and a small network with its weights in a .npz file."""

from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, Protocol, cast, get_args

import numpy as np

from endo_sim_ros.learning.actions import ACTION_SIZES, Actions, observed_names
from endo_sim_ros.learning.tasks import LENGTH, Palpation, Retraction, find_task

_MOST_WEIGHTS = 10_000_000  # read from a file

Moves = Generator[np.ndarray, dict[str, float], None]
"""Yields actions [4], and is sent the state observation, by its names, after each."""


class Policy(Protocol):
    """Acts in B episodes.

    Attributes:
        actions: What its actions mean, see `TaskBatch`.
    """

    actions: Actions

    def reset(self, episodes: Sequence[int]) -> None:
        """These episodes begin anew."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4 or 7] for state observations [B, n]."""
        ...


class RetractionScript:
    """Goes to the spot, grasps, lifts a little farther than needed and holds."""

    actions: Actions = "cartesian"
    grasp, beyond = 0.005, 1.15  # m from the spot at which the jaw closes; how far to lift, in parts of the goal

    def reset(self, episodes: Sequence[int]) -> None:
        """Nothing to do: the script has no memory."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4] for state observations [B, n]."""
        names = Retraction.observation_names
        o = {name: observations[:, i].astype(np.float64) for i, name in enumerate(names)}
        holding = (o["jaw"] > 0) & (o["distance"] < 4 * self.grasp / LENGTH)
        close = holding | (o["distance"] < self.grasp / LENGTH)
        towards = np.stack([o[f"spot_from_tip_{axis}"] for axis in "xyz"], 1) * LENGTH / Retraction.step_length
        up = (self.beyond - o["spot_moved_z"]) * Retraction.lift / Retraction.step_length
        lift = np.stack([np.zeros_like(up), np.zeros_like(up), 0.5 * up], 1)
        moves = np.where(close[:, None], lift, towards)
        return np.concatenate([np.clip(moves, -1, 1), np.where(close, 1.0, -1.0)[:, None]], 1)


class PalpationScript:
    """Presses equally deep at points of a grid, feels the stiffness at each, and reports where it is greatest."""

    actions: Actions = "cartesian"
    spacing, above = 0.01, 0.012  # m: of the grid; of the tip over the skin between presses
    deep, further = 0.003, 0.002  # m: of the tip over the skin at last; by how much that is deeper than before

    def __init__(self, count: int = 1):
        self._runs = [self._search() for _ in range(count)]
        self.reset(range(count))

    def reset(self, episodes: Sequence[int]) -> None:
        """Begin the search of these episodes anew."""
        for b in episodes:
            self._runs[b] = self._search()
            next(self._runs[b])

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4] for state observations [B, n]."""
        names = Palpation.observation_names
        rows = [dict(zip(names, row)) for row in observations.astype(np.float64)]
        return np.stack([run.send(row) for run, row in zip(self._runs, rows)])

    def _search(self) -> Moves:
        step, felt = Palpation.step_length, {}
        o = yield np.zeros(4)

        def to(goal: Callable[[dict[str, float]], np.ndarray], near: float = 5e-4) -> Moves:
            """Move until the remaining way [3], m, is short."""
            nonlocal o
            for _ in range(40):
                way = goal(o)
                if np.abs(way).max() < near:
                    return
                o = yield np.array([*np.clip(way / step, -1, 1), -1.0])

        def over(x: float, y: float, height: float) -> Callable[[dict[str, float]], np.ndarray]:
            return lambda o: np.array([x - LENGTH * o["tip_x"], y - LENGTH * o["tip_y"], height - LENGTH * o["height"]])

        def press(x: float, y: float) -> Moves:
            yield from to(over(x, y, self.above), 1.5e-3)
            yield from to(over(x, y, self.deep + self.further))
            shallow = o["force"]
            yield from to(over(x, y, self.deep))
            felt[x, y] = o["force"] - shallow
            yield from to(lambda o: np.array([0, 0, self.above - LENGTH * o["height"]]), 1.5e-3)

        def best() -> np.ndarray:
            """Middle of the stiffest places [2], m."""
            places, forces = np.array(list(felt)), np.array(list(felt.values()))
            near = ((places - places[forces.argmax()]) ** 2).sum(1) < (1.1 * self.spacing) ** 2
            weights = near * np.maximum(forces - np.median(forces), 0) ** 2
            return (weights[:, None] * places).sum(0) / max(weights.sum(), 1e-12)

        for j in (-1, 0, 1):
            for i in (-j or -1, 0, j or 1):  # to and fro
                yield from press(i * self.spacing, j * self.spacing)
        x, y = best()
        for i, j in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            yield from press(x + i * self.spacing / 2, y + j * self.spacing / 2)
        x, y = best()
        yield from to(lambda o: np.array([x - LENGTH * o["tip_x"], y - LENGTH * o["tip_y"], 0]))
        while True:
            o = yield np.array([0, 0, 0, 1.0])


class NetworkPolicy:
    """A network with tanh between its layers; without hidden ones it is linear. Actions are clipped to ±1 by the task.

    Args:
        task: Name of the task that it was made for.
        layers: Weights [n_in + 1, n_out] of each layer, the last row being the bias; or [B, n_in + 1, n_out], one for each episode.
        actions: What its actions mean, see `TaskBatch`; with joints it also sees them.

    Raises:
        ValueError: If the layers do not fit together or do not fit the task.
    """

    def __init__(self, task: str, layers: Sequence[np.ndarray], actions: Actions = "cartesian"):
        self.task, self.layers = task, [np.asarray(layer, np.float64) for layer in layers]
        self.actions: Actions = actions
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
        widths = [len(observed_names(find_task(task).observation_names, actions)), *hidden, ACTION_SIZES[actions]]
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
            np.savez(file, task=np.array(self.task), actions=np.array(self.actions), **layers)

    @classmethod
    def load(cls, path: str | Path) -> "NetworkPolicy":
        """Read what `save` wrote; nothing in the file is executed.

        Raises:
            ValueError: If it is something else; the message names the file.
        """
        try:
            with Path(path).open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                layers = [file[f"layer{i}"] for i in range(sum(name.startswith("layer") for name in file.files))]
                task, actions = str(file["task"]), str(file["actions"]) if "actions" in file.files else "cartesian"
        except OSError as error:
            raise ValueError(f"{path}: not a readable policy ({error})") from error
        except Exception as error:  # zipfile and numpy have a type each, and advise on what only programmers can do
            raise ValueError(f"{path} is no policy file; give the policy.npz that `endo-sim train` wrote") from error
        if actions not in ACTION_SIZES:
            known = ", ".join(ACTION_SIZES)
            raise ValueError(
                f"{path}: not a readable policy (its actions are {actions[:40]!r}, known are {known}; train one with one of these)"
            )
        if sum(layer.size for layer in layers) > _MOST_WEIGHTS or not layers or any(layer.ndim != 2 for layer in layers):
            raise ValueError(f"{path}: not a readable policy (it has no layers, or too large ones)")
        try:
            return cls(task, layers, cast(Actions, actions))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: not a readable policy ({error})") from error


SCRIPTS: dict[str, Callable[[int], Policy]] = {
    Retraction.name: lambda count: RetractionScript(),
    Palpation.name: PalpationScript,
}
"""Makers of scripted policies for a number of episodes, by the names of the tasks that have one."""


def scripted_policy(task: str, count: int = 1) -> Policy:
    """The scripted policy that solves a task, for a number of episodes.

    Raises:
        ValueError: If there is no such task, or no script for it.
    """
    find_task(task)
    if task not in SCRIPTS:
        raise ValueError(f"there is no scripted policy for {task}; name the .npz file of a trained one")
    return SCRIPTS[task](count)


def make_policy(policy: str, task: str) -> Policy:
    """``scripted``, or the policy in a .npz file.

    Raises:
        ValueError: If there is no such task or script, or the file cannot be read or is for another task.
    """
    if policy == "scripted":
        return scripted_policy(task)
    loaded = NetworkPolicy.load(policy)
    if loaded.task != task:
        raise ValueError(f"{policy} was trained for {loaded.task}, not for {task}")
    return loaded
