"""A policy for the task palpation that presses where it expects to learn most of where the inclusion is."""

from collections.abc import Generator, Sequence

import numpy as np

from endo_sim_ros.identification.acquire import Search
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.forward import ForwardModel
from endo_sim_ros.learning.tasks.palpation import Palpation
from endo_sim_ros.learning.tasks.task import FORCE, LENGTH, Script

Moves = Generator[np.ndarray, dict[str, float], None]


class InformedPalpation(Script):
    """Presses where most is expected to be learnt, and reports as soon as the place is known.

    It has the model of the tissue, as a reconstruction gives it, and knows where its patch is: both are read from the task. What it has
    not is where the inclusion is, or how stiff.

    Args:
        task: The episodes.
        device: Compute device.
        config: What is known of the inclusion.

    Attributes:
        presses: Of each episode, so far [B].
    """

    spacing = 0.01  # m, between places that may be pressed
    deep, above = 0.003, 0.012  # m, of the tip over the skin, at last and between presses
    known = 0.66  # of the task's tolerance: the deviation of the place with which it is reported
    most = 13  # presses, as many as the script makes
    tip_noise = 1e-4  # m; a tip is where it is told to be

    def __init__(self, task: Palpation, device: str = "auto", config: IdentificationConfig = IdentificationConfig()):
        self._task, self._model, self._config = task, ForwardModel(task.nodes, task.physics(device), device), config
        self._runs: list[Moves | None] = [None] * task.count
        self.presses = np.zeros(task.count, int)

    def reset(self, episodes: Sequence[int]) -> None:
        """Begin the search of these episodes anew, once the task has begun them."""
        for b in episodes:
            self._runs[b] = None
            self.presses[b] = 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4] for state observations [B, n]."""
        names, told = Palpation.observation_names, []
        for b, row in enumerate(observations.astype(np.float64)):
            run = self._runs[b]
            if run is None:
                self._runs[b] = run = self._search(b)
                next(run)
            told.append(run.send(dict(zip(names, row))))
        return np.stack(told)

    def _paths(self, b: int) -> np.ndarray:
        """Ways of the tip [K, T, 3], m, task frame, of the presses that may be made: down, for two steps deep, and up."""
        task = self._task
        skin = (task.rest[task.skin] - task.origin[b]) @ task.axes[b].T
        reach = task.patch + self.spacing / 2
        grid = np.arange(-reach, reach + 1e-9, self.spacing) + (reach % self.spacing)
        goals = np.array([(x, y) for y in grid for x in grid if np.hypot(x, y) <= reach])
        places = np.unique(((goals[:, None] - skin[:, :2]) ** 2).sum(2).argmin(1))
        down = np.arange(self.above, self.deep - 1e-9, -task.step_length)
        heights = np.concatenate([down, [self.deep], down[::-1]])
        return skin[places][:, None] + heights[:, None] * np.array([0, 0, 1.0])

    def _search(self, b: int) -> Moves:
        task, paths = self._task, self._paths(b)
        steps, turn = paths.shape[1], task.axes[b]
        still = np.tile(np.eye(3), (steps, 1, 1)), np.ones(steps, bool), np.zeros(steps, bool), np.full((steps, 3), np.nan)
        duration = task.physics().step_duration
        presses = [Experiment(duration, task.origin[b] + path @ turn, *still, tip_noise=self.tip_noise) for path in paths]
        search, left = Search(presses, self._model, self._config), np.ones(len(paths), bool)
        o = yield np.zeros(4)

        def to(goal: np.ndarray, near: float = 1e-5) -> Moves:
            nonlocal o
            for _ in range(task.horizon):
                way = goal - LENGTH * np.array([o["tip_x"], o["tip_y"], o["tip_z"]])
                if np.abs(way).max() < near:
                    return
                o = yield np.array([*np.clip(way / task.step_length, -1, 1), -1.0])

        while left.any() and self.presses[b] < self.most:
            number = int(np.where(left, search.expected(), -np.inf).argmax())
            left[number] = False
            yield from to(paths[number, 0])
            forces = [self._force(o, turn)]
            for goal in paths[number, 1:]:
                way = goal - LENGTH * np.array([o["tip_x"], o["tip_y"], o["tip_z"]])
                o = yield np.array([*np.clip(way / task.step_length, -1, 1), -1.0])
                forces.append(self._force(o, turn))
            search.feel(number, np.array(forces))
            self.presses[b] += 1
            if search.deviation < self.known * task.tolerance and search.probable[-1] < 0.5:
                break
        x, y, _ = turn @ (search.centre - task.origin[b])
        yield from to(np.array([x, y, LENGTH * o["tip_z"]]))
        while True:
            o = yield np.array([0, 0, 0, 1.0])

    @staticmethod
    def _force(o: dict[str, float], turn: np.ndarray) -> np.ndarray:
        return FORCE * np.array([o["force_x"], o["force_y"], o["force_z"]]) @ turn
