"""Palpation: the task, and a script that solves it."""

from collections.abc import Callable, Generator, Sequence

import numpy as np

from endo_sim_ros.learning.tasks.task import FORCE, LENGTH, Script, Task, dot, norm
from endo_sim_ros.physics import ControlNodes, PhysicsConfig
from endo_sim_ros.physics.regions import inside_sphere

Moves = Generator[np.ndarray, dict[str, float], None]
"""Yields actions [4], and is sent the state observation, by its names, after each."""


class Palpation(Task):
    """Find a stiff inclusion by pressing.

    Somewhere below a patch of skin, within `patch` of its centre, lies a ball of tissue `ratio` times as stiff. The tool is a
    ball that pushes and feels. With the fourth action above zero for `sure` steps together, or when time is out, the episode ends and the
    place under the tip is the report; it is right within `tolerance` across the line of sight. What was felt is part of the
    observations: the greatest force so far, and where that was, so that a policy needs no memory of its own.
    """

    name = "palpation"
    sentence = "Press on the tissue around the blue spot and report where it is stiffest."
    observation_names = (
        *(f"tip_{axis}" for axis in "xyz"), "height", "most_from_tip_x", "most_from_tip_y", "most",
        *(f"force_{axis}" for axis in "xyz"), "force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 200, 4.0
    fourth_does = "above 0 for 10 consecutive steps it reports the place under the tip"
    step_length = 0.003
    low, high = (-0.025, -0.025, -0.02), (0.025, 0.025, 0.03)
    same_tissue = False
    open_jaw = 0.2  # rad: it feels with jaws that are as good as closed, but do not grasp
    largest_stiffness = ratio = 8.0  # a power of two: as a factor or as a modulus, it gives the same bits
    patch, radius, depth, tolerance = 0.016, 0.008, 0.005, 0.007  # m
    margin, around, smooth = 0.02, 0.024, 0.5
    sure = 10  # steps
    touch = 0.05  # N; less is not felt

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue, and a ball that pushes."""
        return PhysicsConfig(
            node_count=1000, layers=3, thickness=0.02, young_modulus=4e3, contact_radius=0.008, friction=0.1, device=device
        )

    @staticmethod
    def script(count: int) -> "PalpationScript":
        """The one below."""
        return PalpationScript(count)

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        self.centre = np.zeros((count, 3))  # of the inclusion, m, task frame
        self.place = np.zeros((count, 3))  # the same in the world
        self._over = np.zeros((count, len(self.skin), 3))  # the skin at rest, m, task frame
        self._most, self._where = np.zeros(count), np.zeros((count, 2))  # greatest force so far, N, and the tip's place then, m, task frame

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        over = dot(self.axes[b], (self.rest[self.skin] - self.origin[b])[:, None])  # [S, 3]
        self._over[b] = over
        near = over[(over[:, 0] ** 2 + over[:, 1] ** 2) <= self.patch**2]
        self.centre[b] = near[rng.integers(len(near))] - [0, 0, self.depth]
        self.place[b] = self.origin[b] + dot(self.axes[b].T, self.centre[b])
        self.tip[b] = 0, 0, self.high[2]
        self._most[b], self._where[b] = 0, 0

    def goal_lines(self) -> tuple[str, ...]:
        """Whether the place under the tip is being reported."""
        raised = int(self.raised[0])
        return (f"reporting: {raised} of {self.sure} steps" if raised else "not reporting",)

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        force = norm(self.force)
        more = force > self._most
        self._most = np.where(more, force, self._most)
        self._where = np.where(more[:, None], self.tip[:, :2], self._where)
        felt = [*((self._where - self.tip[:, :2]) / LENGTH).T, self._most / FORCE]
        across = (self._over[..., 0] - self.tip[:, None, 0]) ** 2 + (self._over[..., 1] - self.tip[:, None, 1]) ** 2
        skin = self._over[np.arange(self.count), across.argmin(1), 2]
        return [*(self.tip / LENGTH).T, (self.tip[:, 2] - skin) / LENGTH, *felt]

    def _off(self, places: np.ndarray) -> np.ndarray:
        """How far places [B, 2] are from the inclusion, across the line of sight [B], m."""
        x, y = (places - self.centre[:, :2]).T
        return np.sqrt(x**2 + y**2)

    def _ended(self) -> np.ndarray:
        return (self.raised >= self.sure) | (self.steps >= self.horizon)

    def _value(self) -> np.ndarray:
        found = np.where(self._most > self.touch, np.maximum(1 - self._off(self._where) / self.patch, -1.0), 0.0)
        # Up to 3 for feeling the most over the inclusion, so that the search pays before the report, which is worth up to 1.
        return 3 * found + np.where(self._ended(), 1 - self._off(self.tip[:, :2]) / self.patch, 0.0)

    def _judge_goal(self) -> np.ndarray:
        return self._ended() & (self._off(self.tip[:, :2]) <= self.tolerance)

    def stiffness(self, b: int) -> np.ndarray:
        """Factor on the moduli of each node [M] in episode b: `ratio` inside the inclusion."""
        return np.where(inside_sphere(self.nodes.rest, self.place[b], self.radius), self.ratio, 1.0)

    def regions(self) -> tuple[str, ...]:
        """The inclusion of the first episode as physics_node's parameter `regions`."""
        x, y, z = self.place[0].tolist()
        return (f"sphere {x!r} {y!r} {z!r} {self.radius!r} young_modulus={self.ratio * self.physics().young_modulus!r}",)


class PalpationScript(Script):
    """Presses equally deep at points of a grid, feels the stiffness at each, and reports where it is greatest."""

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
        rows = [dict(zip(names, row)) for row in self.states(observations)]
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
