"""Retraction: the task, and a script that solves it."""

import numpy as np

from endo_sim_ros.instruments import GRIP
from endo_sim_ros.learning.tasks.task import LENGTH, Script, Task, norm
from endo_sim_ros.physics import ControlNodes, PhysicsConfig


class Retraction(Task):
    """Grasp tissue and lift it off what it covers.

    A spot of the skin hides what the surgeon wants to see. It is uncovered when it has been raised by `lift` towards the endoscope and
    stayed there for `hold` steps, without ever pulling harder than `force_limit`. The fourth action closes the jaw where above zero.
    """

    name = "retraction"
    sentence = "Grasp the tissue at the blue spot and lift it towards the endoscope."
    observation_names = (
        *(f"tip_{axis}" for axis in "xyz"), *(f"spot_from_tip_{axis}" for axis in "xyz"), "distance",
        *(f"spot_moved_{axis}" for axis in "xyz"), "jaw",
        *(f"force_{axis}" for axis in "xyz"), "force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 60, 3.0
    closing, working_fourth = True, 1.0
    open_jaw = 0.6  # rad: as links, wider jaws grasp more tissue than they lift within the limit of the force
    tool, tool_share = "PROGRASP_FORCEPS", GRIP  # what it grasps lies between its jaws, not at their points
    low, high = (-0.02, -0.02, -0.004), (0.02, 0.02, 0.025)
    lift, hold = 0.006, 3  # m, steps
    grasp_radius = 0.008  # m; the jaw holds control nodes within it

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue, and a jaw that holds control nodes within `grasp_radius`."""
        return PhysicsConfig(
            node_count=800, layers=2, thickness=0.015, young_modulus=4e3, force_radius=Retraction.grasp_radius, device=device
        )

    @staticmethod
    def script(count: int) -> "RetractionScript":
        """The one below."""
        return RetractionScript()

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        self._spot, self._moved = np.zeros((count, 3)), np.zeros((count, 3))  # from the tip, and from rest, m, task frame
        self._held = np.zeros(count, int)  # steps that the spot has been raised

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        self.tip[b, 2] = self.high[2]
        self._held[b] = 0

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        self._moved = here[:, 0]
        self._spot = here[:, 0] - self.tip
        jaw = np.where(self.fourth > 0, 1.0, -1.0)
        distance = norm(self._spot) / LENGTH
        return [*(self.tip / LENGTH).T, *(self._spot / LENGTH).T, distance, *(self._moved / self.lift).T, jaw]

    def goal_lines(self) -> tuple[str, ...]:
        """How far the spot has been lifted."""
        return (f"lifted by {self._moved[0, 2] * 1e3:.1f} mm of {self.lift * 1e3:.0f} mm",)

    def _value(self) -> np.ndarray:
        distance = norm(self._spot)
        grasped = (self.fourth > 0) & (distance <= self.grasp_radius)
        # 2 for the lift, 0.5 for the grasp, −1 for each 2 cm from the spot: coming near, grasping and lifting each pay at once.
        return np.minimum(self._moved[:, 2] / self.lift, 1.0) * 2 - distance / LENGTH + 0.5 * grasped

    def _judge_goal(self) -> np.ndarray:
        self._held = np.where(self._moved[:, 2] >= self.lift, self._held + 1, 0)
        return self._held >= self.hold


class RetractionScript(Script):
    """Goes to the spot, grasps, lifts a little farther than needed and holds."""

    grasp, beyond = 0.005, 1.15  # m from the spot at which the jaw closes; how far to lift, in parts of the goal

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4] for state observations [B, n]."""
        names = Retraction.observation_names
        o = dict(zip(names, self.states(observations).T))
        holding = (o["jaw"] > 0) & (o["distance"] < Retraction.grasp_radius / LENGTH)  # else it closed on nothing, and opens
        jaw = np.where(holding, 1.0, self.closing(o["distance"] * LENGTH, self.grasp))
        towards = np.stack([o[f"spot_from_tip_{axis}"] for axis in "xyz"], 1) * LENGTH / Retraction.step_length
        up = (self.beyond - o["spot_moved_z"]) * Retraction.lift / Retraction.step_length
        lift = np.stack([np.zeros_like(up), np.zeros_like(up), 0.5 * up], 1)
        moves = np.where(holding[:, None], lift, towards)  # also while it closes: it holds what it touches
        return np.concatenate([np.clip(moves, -1, 1), jaw[:, None]], 1)
