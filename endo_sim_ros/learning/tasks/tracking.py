"""Tracking: hold the tip on tissue that breathes; the task, and a script that solves it."""

import numpy as np

from endo_sim_ros.learning.tasks.task import LENGTH, Script, Task, dot, norm
from endo_sim_ros.physics import ControlNodes, MotionConfig, PhysicsConfig


class Tracking(Task):
    """Touch a spot that moves with breath and heart, and stay on it.

    The tool is a ball. It is on the spot while its centre is within `tolerance` of where the ball just touches it, towards the endoscope.
    The episode is solved after `hold` steps on the spot, one after the other. The fourth action has no meaning.
    """

    name = "tracking"
    sentence = "Touch the blue spot and stay on it while the tissue breathes."
    observation_names = (
        *(f"tip_{axis}" for axis in "xyz"), *(f"goal_from_tip_{axis}" for axis in "xyz"), "distance",
        *(f"spot_moved_{axis}" for axis in "xyz"), "held",
        *(f"force_{axis}" for axis in "xyz"), "force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 150, 2.0
    fourth_does = "nothing"
    low, high = (-0.02, -0.02, -0.01), (0.02, 0.02, 0.025)
    open_jaw = 0.2  # rad: it feels with jaws that are as good as closed, but do not grasp
    radius, tolerance, hold = 0.006, 0.002, 50  # m, m, steps: half a breath

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue that breathes by 6 mm, and a ball that pushes."""
        motion = MotionConfig(breathing=0.006, heartbeat=0.001)
        return PhysicsConfig(
            node_count=800, layers=2, thickness=0.015, young_modulus=4e3, contact_radius=Tracking.radius, motion=motion, device=device
        )

    @staticmethod
    def script(count: int) -> "TrackingScript":
        """The one below."""
        return TrackingScript()

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        self._goal = np.zeros((count, 3))  # from the tip, m, task frame
        self._held = np.zeros(count, int)  # steps on the spot

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        self.tip[b, 2] = self.high[2]
        self._held[b] = 0

    def goal_lines(self) -> tuple[str, ...]:
        """How far the tip is from the spot, and how long it has been on it."""
        off = np.sqrt(dot(self._goal[0], self._goal[0]))
        return (
            f"{off * 1e3:.0f} mm from the spot, on it within {self.tolerance * 1e3:.0f} mm",
            f"on it for {self._held[0]} of {self.hold} steps",
        )

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        moved = here[:, 0]
        self._goal = moved + [0, 0, self.radius] - self.tip
        distance = norm(self._goal) / LENGTH
        return [*(self.tip / LENGTH).T, *(self._goal / LENGTH).T, distance, *(moved / LENGTH).T, self._held / self.hold]

    def _value(self) -> np.ndarray:
        # −1 for each 2 cm from the spot, and 2 for the time on it: coming near and staying both pay at once.
        return 2 * np.minimum(self._held / self.hold, 1.0) - norm(self._goal) / LENGTH

    def _judge_goal(self) -> np.ndarray:
        self._held = np.where(norm(self._goal) <= self.tolerance, self._held + 1, 0)
        return self._held >= self.hold


class TrackingScript(Script):
    """Comes down on the spot as in a funnel, so that it touches nothing beside it, and goes where the spot goes."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4] for state observations [B, n]."""
        first = Tracking.observation_names.index("goal_from_tip_x")
        way = self.states(observations)[:, first : first + 3] * LENGTH
        way[:, 2] += np.sqrt(way[:, 0] ** 2 + way[:, 1] ** 2)
        return np.concatenate([np.clip(way / Tracking.step_length, -1, 1), np.full((len(way), 1), -1.0)], 1)
