"""Hand-over: one arm picks up a needle and gives it to the other; the task, and a script that solves it."""

import functools

import numpy as np

from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.instruments import Capsule, Material, Part
from endo_sim_ros.instruments.shapes import lofted
from endo_sim_ros.learning.tasks.task import LENGTH, Script, Task, dot, norm
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

NEEDLE = "needle"
_SECTIONS, _AROUND = 32, 8  # of the tube that the needle is


class Handover(Task):
    """Pick up a needle that lies on the skin with PSM1, and give it to PSM2.

    The needle is rigid. A jaw that closes on it holds it, and it moves and turns with the tip; of two that hold it the first
    one leads, and the other loses it where it is pulled away by more than `tolerance`. Without a jaw that holds it it falls onto the skin,
    which it does not deform. The episode is solved when PSM2 alone has held it for `hold` steps, `lift` above where it would lie,
    and PSM1 has given it. The fourth action of each arm closes its jaw where above zero.
    """

    name = "handover"
    sentence = "Pick up the needle with the right instrument and hand it over to the left one."
    arms = ("PSM1", "PSM2")
    observation_names = (
        *(f"{arm}.{what}_{axis}" for what in ("tip", "needle_from_tip") for arm in ("PSM1", "PSM2") for axis in "xyz"),
        *(f"{arm}.{what}" for what in ("distance", "jaw", "holds") for arm in ("PSM1", "PSM2")), "height", "given",
        *(f"{arm}.force_{axis}" for arm in ("PSM1", "PSM2") for axis in "xyz"), "PSM1.force", "PSM2.force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 150, 2.0
    low, high = (-0.03, -0.025, -0.01), (0.03, 0.025, 0.03)
    margin, around, smooth = 0.02, 0.02, 0.5
    closing, open_jaw = True, 0.6  # rad
    length, turn, radius = 0.04, 0.375, 5e-4  # of the needle: m along its arc, share of a circle, m
    tolerance = 0.002  # m from the needle at which a jaw takes it
    yaw = 1.0  # rad: by how much it lies turned at most
    lift, hold = 0.01, 5  # m, steps

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue, and jaws that take what they close on, as small as their points."""
        return PhysicsConfig(node_count=800, layers=2, thickness=0.015, young_modulus=4e3, force_radius=0.001, device=device)

    @staticmethod
    def script(count: int) -> "HandoverScript":
        """The one below."""
        return HandoverScript()

    @classmethod
    @functools.cache
    def thing(cls) -> tuple[list[Part], list[Capsule]]:
        """The needle: a tube along its arc, which ends in a point."""
        places, bend = cls._arc(_SECTIONS), np.linspace(0.5, -0.5, _SECTIONS) * 2 * np.pi * cls.turn
        thick = cls.radius * np.minimum(1, 0.15 + 6 * np.linspace(0, 1, _SECTIONS))  # the end on the right is its point
        around = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
        outward = np.stack([np.sin(bend), np.cos(bend), np.zeros(_SECTIONS)], 1)
        rings = [p + t * (np.cos(around)[:, None] * o + np.sin(around)[:, None] * [0, 0, 1]) for p, t, o in zip(places, thick, outward)]
        vertices, faces = lofted(np.array(rings))
        ends = cls._arc(9)
        capsules = [Capsule(NEEDLE, start, end, cls.radius) for start, end in zip(ends, ends[1:])]
        return [Part(NEEDLE, Material.STEEL, vertices.astype(np.float32), faces)], capsules

    @classmethod
    def _arc(cls, count: int) -> np.ndarray:
        """Places along the needle [n, 3], m, in its frame: z is normal to its plane, y points at its bend, and x is along its chord."""
        bend, circle = np.linspace(0.5, -0.5, count) * 2 * np.pi * cls.turn, cls.length / (2 * np.pi * cls.turn)
        arc = circle * np.stack([np.sin(bend), np.cos(bend), np.zeros(count)], 1)
        return arc - [0, circle * np.sin(np.pi * cls.turn) / (np.pi * cls.turn), 0]  # the middle of its mass is the origin

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        self._line = self._arc(2 * _SECTIONS + 1)
        self._marks = self._line[[_SECTIONS // 2, 3 * _SECTIONS // 2]]  # where PSM1 and PSM2 are to take it
        self._over = np.zeros((count, len(self.skin), 3))  # the skin at rest, m, task frame
        self.needle, self.turned = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))  # its pose, m, task frame
        self.holds = np.zeros((count, 2), bool)
        self._lead = np.zeros(count, int)  # the arm that it follows
        self._grip = np.zeros((count, 3, 4))  # its axes, and where it is from the tip of that arm, m, in the axes of that tip
        self._height = np.zeros(count)  # above where it would lie, m
        self._ways = np.zeros((count, 2, 3))  # from the tips to the marks, m, task frame
        self._given = np.zeros(count, bool)  # since it lay on the skin both arms have held it, PSM1 having lifted it
        self._held = np.zeros(count, int)  # steps that PSM2 alone has held it high enough

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        self._over[b] = over = dot(self.axes[b], (self.rest[self.skin] - self.origin[b])[:, None])
        near = over[norm(over) <= self.around]
        slope_x, slope_y, _ = np.linalg.lstsq(np.column_stack([near[:, :2], np.ones(len(near))]), near[:, 2], rcond=None)[0]
        yaw = rng.uniform(-self.yaw, self.yaw)
        normal, along = np.array([-slope_x, -slope_y, 1.0]), np.array([np.cos(yaw), np.sin(yaw), 0.0])
        normal /= norm(normal)
        along -= dot(along, normal) * normal
        along /= norm(along)
        self.turned[b], self.needle[b] = np.stack([along, np.cross(normal, along), normal], 1), 0.0
        self.needle[b, 2] -= self._clearance(np.array([b]))[0]
        self.tip[b, :, 0] = np.abs(self.tip[b, :, 0]) * [1, -1]  # each on its side
        self.tip[b, :, 2] = self.high[2]
        self.holds[b], self._given[b], self._held[b] = False, False, 0

    def _places(self, own: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Where places of the needle [n, 3] are in these episodes [e]: [e, n, 3], m, task frame."""
        return self.needle[own, None] + dot(self.turned[own, None], places[None, :, None])

    def _clearance(self, own: np.ndarray) -> np.ndarray:
        """How far the needle can fall in these episodes [e], m; the skin between its nodes is that of the three nearest."""
        line, skin = self._places(own, self._line[::4]), self._over[own]
        far = (line[:, :, None, 0] - skin[:, None, :, 0]) ** 2 + (line[:, :, None, 1] - skin[:, None, :, 1]) ** 2
        nearest = np.argsort(far, axis=2, kind="stable")[..., :3]
        weights = 1 / (np.take_along_axis(far, nearest, 2) + 1e-8)
        heights = np.take_along_axis(skin[:, None, :, 2], nearest, 2)
        return (line[..., 2] - dot(weights, heights) / dot(weights, np.ones(3))).min(1) - self.radius

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        everyone = np.arange(self.count)
        hands = dot(self.axes[:, None, :, None], self.rotations.swapaxes(2, 3)[:, :, None])  # axes of the tips [B, 2, 3, 3], task frame
        self.holds &= self.fourth > 0
        passed = np.flatnonzero(~self.holds[everyone, self._lead] & self.holds.any(1))
        self._lead[passed] = 1 - self._lead[passed]
        self._take(passed, hands)
        held, carried = self.holds[:, 0] | self.holds[:, 1], _product(hands[everyone, self._lead], self._grip)
        self.turned = np.where(held[:, None, None], carried[..., :3], self.turned)
        self.needle = np.where(held[:, None], self.tip[everyone, self._lead] + carried[..., 3], self.needle)
        off = norm(self._places(everyone, self._line)[:, None] - self.tip[:, :, None]).min(2)
        self.holds &= (off <= self.tolerance) | np.equal(self._lead[:, None], [0, 1])
        free = ~self.holds.any(1)
        self.holds |= (self.raised == 1) & (off <= self.tolerance)
        taken = np.flatnonzero(free & self.holds.any(1))
        self._lead[taken] = self.holds[taken].argmax(1)
        self._take(taken, hands)
        self._height = self._clearance(everyone)
        lies = ~self.holds.any(1)
        self.needle[:, 2] -= np.where(lies, self._height, 0.0)
        self._height = np.where(lies, 0.0, self._height)
        passing = self.holds.all(1) & (self._lead == 0) & (self._height >= self.lift)
        self._given = ~lies & (self._given | passing)
        self._ways = self._places(everyone, self._marks) - self.tip
        lengths = np.concatenate([self._by_arm(v) for v in (self.tip, self._ways, norm(self._ways))], 1)
        jaws = np.where(self.fourth > 0, 1.0, -1.0)
        return [*(lengths / LENGTH).T, *jaws.T, *self.holds.T.astype(float), self._height / LENGTH, self._given.astype(float)]

    def _take(self, own: np.ndarray, hands: np.ndarray) -> None:
        """Let the needle follow the arm that leads in these episodes [e] from where it is; hands are the axes of the tips [B, 2, 3, 3]."""
        lead = self._lead[own]
        pose = np.concatenate([self.turned[own], (self.needle[own] - self.tip[own, lead])[..., None]], 2)
        self._grip[own] = _product(hands[own, lead].swapaxes(1, 2), pose)

    def _value(self) -> np.ndarray:
        right, left = norm(self._ways).T
        taken = self._given | self.holds[:, 0]
        received = self._given & self.holds[:, 1]
        # −1 for each 2 cm of an arm from its mark; ½, 1, 1 and 1 for taking, lifting, receiving and leaving it. PSM2 is paid while it
        # holds, not for having held: else its jaw need not stay closed, and the needle falls when PSM1 lets go.
        lifted, leaves = np.minimum(self._height / self.lift, 1.0), 1.0 - self.holds[:, 0]
        return 0.5 * taken + lifted + received * (1 + leaves) - (np.where(taken, 0.0, right) + left) / LENGTH

    def _judge_goal(self) -> np.ndarray:
        done = self._given & self.holds[:, 1] & ~self.holds[:, 0] & (self._height >= self.lift)
        self._held = np.where(done, self._held + 1, 0)
        return self._held >= self.hold

    def goal_lines(self) -> tuple[str, ...]:
        """Who holds the needle, and how high."""
        holding = " and ".join(arm for arm, holds in zip(self.arms, self.holds[0]) if holds) or "nobody"
        return (f"{holding} holds the needle, {self._height[0] * 1e3:.0f} mm above the tissue of {self.lift * 1e3:.0f} mm",)

    def dyed_spots(self, b: int) -> tuple[DyedSpot, ...]:
        """None: the needle is seen."""
        return ()

    def thing_poses(self) -> dict[str, np.ndarray]:
        """Where the needle is [B, 4, 4], m, world."""
        poses = np.tile(np.eye(4), (self.count, 1, 1))
        poses[:, :3, :3] = self.axes.transpose(0, 2, 1) @ self.turned
        poses[:, :3, 3] = self.origin + self._to_world(self.needle)
        return {NEEDLE: poses}


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Products [B, 3, n] of matrices [B, 3, 3] and [B, 3, n], each sum in one order."""
    return dot(first[:, :, None], second.swapaxes(1, 2)[:, None])


class HandoverScript(Script):
    """PSM1 takes the needle and lifts it, PSM2 takes it in the air, and PSM1 lets go and leaves."""

    close, above = 0.001, 0.008  # m from a mark at which its jaw closes; m over it to wait
    higher = 1.3  # how far to lift, in parts of the goal

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 8] for state observations [B, n]."""
        o = self.states(observations)
        ways = np.moveaxis(o[:, 6:12].reshape(-1, 2, 3), 1, 0) * LENGTH  # of each arm [B, 3], m
        distance, jaw, holds = np.moveaxis(o[:, 12:18].reshape(-1, 3, 2), 1, 0)  # [B, 2]
        height = o[:, Handover.observation_names.index("height")] * LENGTH
        right, left = (holds > 0).T
        high = height >= Handover.lift
        up = np.outer(0.5 * (self.higher * Handover.lift - height), [0, 0, 1])
        funnel = lambda way: way + np.outer(np.hypot(way[:, 0], way[:, 1]), [0, 0, 1])  # touches nothing beside it
        coming = funnel(ways[1] + np.outer(~high, [-0.005, 0, self.above]))
        none, aside = np.zeros_like(up), np.full_like(up, 0.002) * [1, 0, 1]
        cases = [(right & left)[:, None], right[:, None], left[:, None]]
        moves = np.stack([np.select(cases, [none, up, aside], funnel(ways[0])), np.select(cases, [none, coming, up], coming)], 1)
        ready = (distance * LENGTH < self.close) & (jaw < 0)  # a jaw that closed on nothing opens before it closes again
        takes = np.stack([~left & (right | ready[:, 0]), left | right & high & ready[:, 1]], 1)
        moves = np.where((takes & (holds == 0))[..., None], 0.0, moves)
        coming = (jaw < 0) & np.stack([~left & ~right, right & high & ~left], 1)
        jaws = np.where(coming, self.closing(distance * LENGTH, self.close), np.where(takes, 1.0, -1.0))
        actions = np.concatenate([np.clip(moves / Handover.step_length, -1, 1), jaws[..., None]], 2)
        return actions.reshape(len(o), -1)
