"""Tension: two arms pull tissue taut between them; the task, and a script that solves it."""

import numpy as np

from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.instruments import GRIP
from endo_sim_ros.learning.tasks.task import FORCE, LENGTH, Script, Task, dot, norm
from endo_sim_ros.physics import ControlNodes, PhysicsConfig


class Tension(Task):
    """Grasp tissue at two spots and pull them apart, until it is taut to a wanted force, and keep it so.

    PSM1 takes the spot on the right of the picture, PSM2 that on the left. An arm pulls by as much as the tissue draws its tool towards
    the other. The tissue is taut while both hold it at their spots and pull within `tolerance`
    of the wanted force; the episode is solved after `hold` steps of
    that, one after the other. The fourth action of each arm closes its jaw where above zero.
    """

    name = "tension"
    sentence = "Grasp the tissue at both blue spots and keep it taut between the instruments."
    arms = ("PSM1", "PSM2")
    observation_names = (
        *(f"{arm}.{what}_{axis}" for what in ("tip", "spot_from_tip") for arm in ("PSM1", "PSM2") for axis in "xyz"),
        *(f"{arm}.{what}" for what in ("distance", "jaw", "missing") for arm in ("PSM1", "PSM2")), "wanted", "held",
        *(f"{arm}.force_{axis}" for arm in ("PSM1", "PSM2") for axis in "xyz"), "PSM1.force", "PSM2.force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 100, 3.0
    closing, working_fourth = True, 1.0
    open_jaw = 0.6  # rad, as for retraction
    tool, tool_share = "PROGRASP_FORCEPS", GRIP
    low, high = (-0.036, -0.02, -0.008), (0.036, 0.02, 0.025)
    site_count = 2
    apart = 0.02, 0.03  # m from one spot to the other
    slant = 0.5  # largest part of that which is not across the picture, from left to right
    wanted_force = 0.8, 1.2  # N; jaws that have just closed feel up to 0.7
    tolerance, hold = 0.15, 10  # part of the wanted force, steps
    grasp_radius = 0.007  # m; a jaw holds control nodes within it

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue, and jaws that hold control nodes within `grasp_radius`."""
        return PhysicsConfig(node_count=800, layers=2, thickness=0.015, young_modulus=4e3, force_radius=Tension.grasp_radius, device=device)

    @staticmethod
    def script(count: int) -> "TensionScript":
        """The one below."""
        return TensionScript()

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        places, (least, most) = self.rest[self.places], self.apart
        ways = places[:, None] - places  # [P, P, 3]
        far, across = norm(ways), dot(ways, self.endoscope[:3, 0])
        right, left = np.nonzero((far >= least) & (far <= most) & (across >= np.sqrt(1 - self.slant**2) * far))
        if not len(right):
            raise ValueError(f"{self.name}: no two places of the skin are {least:g} to {most:g} m apart; the model is too small")
        self.pairs = self.places[np.stack([right, left], 1)]  # nodes [n, 2]
        self.wanted = np.zeros(count)  # N
        self._spots = np.zeros((count, 2, 3))  # from the tips, m, task frame
        self._pull = np.zeros((count, 2))  # N
        self._held = np.zeros(count, int)  # steps that the tissue has been taut

    def _choose(self, b: int, rng: np.random.Generator) -> None:
        self.sites[b] = rng.choice(self.pairs)
        self._look(b, self.rest[self.sites[b]].mean(0))

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        self.wanted[b] = rng.uniform(*self.wanted_force)
        self.tip[b, :, 0] = np.abs(self.tip[b, :, 0]) * [1, -1]  # each on its side
        self.tip[b, :, 2] = self.high[2]
        self._held[b] = 0

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        self._spots = here - self.tip
        way = self.tip[:, 1] - self.tip[:, 0]
        way /= np.maximum(norm(way), 1e-6)[:, None]
        self._pull = np.stack([dot(self.force[:, 0], way), -dot(self.force[:, 1], way)], 1)
        lengths = np.concatenate([self._by_arm(v) for v in (self.tip, self._spots, norm(self._spots))], 1)
        jaws = np.where(self.fourth > 0, 1.0, -1.0)
        missing = self.wanted[:, None] - self._pull
        return [*(lengths / LENGTH).T, *jaws.T, *(missing / FORCE).T, self.wanted / FORCE, self._held / self.hold]

    def _value(self) -> np.ndarray:
        distance, off = norm(self._spots), np.abs(self._pull / self.wanted[:, None] - 1)
        grasped = (self.fourth > 0) & (distance <= self.grasp_radius)
        # Of each arm 1 for the force, 0.5 for the grasp, −1 for each 2 cm from the spot: each of the three pays at once. 1 for holding.
        each = grasped * (1.5 - np.minimum(off, 1.0)) - distance / LENGTH
        return each[:, 0] + each[:, 1] + np.minimum(self._held / self.hold, 1.0)

    def _judge_goal(self) -> np.ndarray:
        grasped = (self.fourth > 0) & (norm(self._spots) <= self.grasp_radius)
        taut = (grasped & (np.abs(self._pull / self.wanted[:, None] - 1) <= self.tolerance)).all(1)
        self._held = np.where(taut, self._held + 1, 0)
        return self._held >= self.hold

    def goal_lines(self) -> tuple[str, ...]:
        """The wanted force, what each arm pulls with, and for how long it has been taut."""
        pulls = ", ".join(f"{arm} {pull:.2f} N" for arm, pull in zip(self.arms, self._pull[0]))
        return f"pull with {self.wanted[0]:.2f} N each, ± {self.tolerance:.0%}: {pulls}", f"taut for {self._held[0]} of {self.hold} steps"

    def dyed_spots(self, b: int) -> tuple[DyedSpot, ...]:
        """The two places that are to be grasped."""
        return tuple(DyedSpot(self.rest[site].copy(), self.dyed_radius) for site in self.sites[b])


class FixedTension(Tension):
    """The same with one wanted force, for policies that see: pictures do not tell it."""

    name = "fixed tension"
    wanted_force = 1.0, 1.0


class TensionScript(Script):
    """Goes to the spots, grasps, and when both are held pulls away from the other arm by as much as force is missing."""

    grasp = 0.004  # m from a spot at which its jaw closes
    gain = 0.0012  # m a step for each N that is missing; links that touch hold more tissue than a point, and more would make them swing

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 8] for state observations [B, n]."""
        o = self.states(observations)
        tips, ways = np.moveaxis(o[:, :12].reshape(-1, 2, 2, 3), 1, 0)  # of both arms [B, 2, 3]
        distance, jaw, missing = np.moveaxis(o[:, 12:18].reshape(-1, 3, 2), 1, 0)  # [B, 2]
        holding = (jaw > 0) & (distance < Tension.grasp_radius / LENGTH)  # else it closed on nothing, and opens
        jaws = np.where(holding, 1.0, self.closing(distance * LENGTH, self.grasp))
        outward = tips - tips[:, ::-1]
        outward /= np.maximum(norm(outward), 1e-6)[..., None]
        more = self.gain * FORCE * np.where(holding.all(1, keepdims=True), missing, 0.0)
        moves = np.where(jaws[..., None] > 0, more[..., None] * outward, ways * LENGTH) / Tension.step_length
        actions = np.concatenate([np.clip(moves, -1, 1), jaws[..., None]], 2)
        return actions.reshape(len(o), -1)
