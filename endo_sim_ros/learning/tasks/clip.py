"""Clip: put a clip on the marked one of several vessels; the task, and a script that solves it."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.instruments import Capsule, Material, Part, PlacementConfig, build_instrument, link_poses, load_arm, working_point
from endo_sim_ros.instruments.shapes import lofted
from endo_sim_ros.learning.tasks.task import LENGTH, Script, Task, dot, norm, turned_about
from endo_sim_ros.learning.vessels import ANCHORS, RINGS, Ground, Vessels, gaps, ring_name, run_over, vessel_parts
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

VESSEL, OTHERS, CLIP = "vessel", "other_vessels", "clip"
_LEGS, _HINGE = ("clip_left", "clip_right"), "clip_hinge"
_VESSELS = 3
_SECOND, _CROSSING = 0.5, 0.4  # chance that there is a third, and that one crosses the marked one
_BEND, _SLANT = 12.0, 0.35  # curvature, 1/m, and angle between two that run beside each other, rad, at most
_ENDS, _APART = (0.02, 0.03), (0.008, 0.018)  # m from the middle of a vessel to where it enters tissue, and from one to another
_TRIES, _AT_ONCE = 16, 6  # courses that are drawn for each other vessel, of which the first that will do is taken, and looked at together
_HEADINGS = 64  # that are drawn for the marked vessel: so many that one of them is level on a slope, too
_LEVEL = 0.12  # slope towards the endoscope that the marked vessel has in its middle at most: jaws turn about the line of sight
_ROOM = 0.002  # m between jaws on their way to the mark and any other vessel
_BACK = np.linspace(0.0, 0.021, 4)  # m from the mark: where jaws on that way are tried
_WALL = 0.0006  # m: half as thick is what a clip leaves of a vessel
_PINCHED = 0.0025  # m from the clip over which the vessel is narrowed
_SPARE = 0.0015  # m of legs beyond a vessel that lies flat between them
_LEG_APART, _LEG_INSIDE = 0.0009, 0.0008  # m from the middle of a clip to its legs when closed, and of open ones from the jaws
_MARK = np.zeros((1, 2))  # m, in the frame of the task
_MIDDLE = len(RINGS) // 2  # the first ring past the mark
_AROUND = 0.012  # m from the mark, along the vessel, in which it may lie between the jaws


class Clip(Task):
    """Bring the jaws of a clip applier around the marked vessel, and close them, so that a clip stays on it.

    There are two or three vessels. The one with the blue ring is to be clipped there. When the jaws have been closed for `latch` steps
    the clip has locked, and cannot be taken off: the episode is lost unless the vessel lies between its legs as a whole, within `along`
    of the mark, and square to them within `square`. It is lost as well when a jaw touches another vessel, or presses into the marked one
    by half its radius. It is solved when the clip is on and the jaws, open again, are `leave` away. The goal that is observed is where the
    jaws are to close, and then where they are to go. The fourth action closes the jaws where above zero; the fifth turns them.
    """

    name = "clip"
    sentence = "Put a clip on the vessel with the blue ring, at the ring, and touch no other vessel."
    observation_names = (
        *(f"tip_{axis}" for axis in "xyz"), *(f"goal_from_tip_{axis}" for axis in "xyz"), "distance",
        *(f"jaws_{axis}" for axis in "xyz"), "misaligned", "radius", "others_away", "fits", "jaw", "clipped", "away",
        *(f"force_{axis}" for axis in "xyz"), "force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 120, 2.0
    closing, working_fourth = True, 1.0
    fourth_does = "above 0 the jaws are closed; after 5 consecutive steps the clip has locked"
    twist, most_twist = 0.08, 1.9  # 2 rad/s; a vessel may run in any direction, which is a quarter turn to either side
    low, high = (-0.035, -0.035, -0.005), (0.035, 0.035, 0.045)
    margin, around, smooth = 0.02, 0.02, 0.6
    site_count = _VESSELS * len(ANCHORS)
    tool, tool_share = "LARGE_CLIP_APPLIER", 1.0
    open_jaw, closed_jaw = 0.785, 0.15  # rad: as far as they open; a clip keeps them from closing
    radius = 0.006  # m, of the ball behind the points of the jaws that touches the tissue
    tilt = np.radians(35.0)  # of the jaws from the line of sight
    legs = 0.003, 0.0165  # m from the hinge of the jaws: from where to where the legs of a clip reach
    widths = 0.003, 0.006  # m, of vessels
    free = 0.004, 0.0055  # m of room between the skin and a vessel that bridges it
    along, square = 0.0025, np.radians(20.0)  # polymer clips fail more often where they are not at 90° to the vessel
    latch, leave = 5, 0.025  # steps, m
    beyond = 1.2  # of `leave`: where the jaws are to go from the clip
    nearly = 0.003  # m from where the jaws are to close: within about this being exact is rewarded

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue, a ball that pushes it, and jaws that hold none of it."""
        return PhysicsConfig(
            node_count=800, layers=2, thickness=0.015, young_modulus=4e3, contact_radius=Clip.radius, force_radius=0.001, device=device
        )

    @staticmethod
    def script(count: int) -> "ClipScript":
        """The one below."""
        return ClipScript()

    @classmethod
    def jaw_axes(cls, endoscope: np.ndarray) -> np.ndarray:
        """They come from the side of the trocar, and point more towards the tissue than the shaft does, so that they reach around."""
        below = np.radians(PlacementConfig().below)
        side = np.array([np.cos(below), np.sin(below), 0.0])  # where the shaft comes from, in the picture
        z = np.array([0.0, 0.0, np.cos(cls.tilt)]) - np.sin(cls.tilt) * side
        x = np.cross([0.0, 0.0, 1.0], side)
        return endoscope[:3, :3] @ np.stack([x, np.cross(z, x), z], 1)

    @classmethod
    @functools.cache
    def thing(cls) -> tuple[list[Part], list[Capsule]]:
        """The vessels, and the clip: two legs that a hinge joins, one with the lock at its end."""
        found = [vessel_parts(v, OTHERS if v else VESSEL, not v) for v in range(_VESSELS)]
        parts, capsules = [part for own, _ in found for part in own], [capsule for _, own in found for capsule in own]
        start, end = cls.legs
        for leg, lock in zip(_LEGS, (1.9e-3, 1.0e-3)):  # thickness of its end
            sizes = [
                (start, 0.9e-3),
                (start + 4e-4, 1.1e-3),
                (end - 1.8e-3, 1.1e-3),
                (end - 1.4e-3, lock),
                (end - 3e-4, lock),
                (end, 0.7 * lock),
            ]
            parts.append(_bar(leg, sizes, 2.4e-3))
            capsules.append(Capsule(leg, np.array([0, 0, start]), np.array([0, 0, end]), 0.9e-3))
        parts.append(_bar(_HINGE, [(start - 0.7e-3, 1.6e-3), (start - 0.3e-3, 2.4e-3), (start + 0.9e-3, 2.4e-3)], 2.2e-3))
        return parts, capsules

    @classmethod
    @functools.cache
    def _jaws(cls, angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Ends [J, 2, 3] and radii [J] of the capsules of jaws that are open by an angle, m, from their points, in their axes."""
        arm = load_arm("PSM", cls.tool)
        joints, (_, capsules) = np.zeros(len(arm.joints)), build_instrument(arm)
        frames, hinge = link_poses(arm, joints, angle), np.linalg.inv(arm.tip_pose(joints))
        own = [capsule for capsule in capsules if capsule.link.startswith("jaw")]
        turned = [hinge @ frames[capsule.link] for capsule in own]
        ends = [[pose[:3, :3] @ end + pose[:3, 3] for end in (capsule.start, capsule.end)] for pose, capsule in zip(turned, own)]
        return np.array(ends) - working_point(arm, capsules, 1.0), np.array([capsule.radius for capsule in own])

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        self.vessels = Vessels(count, _VESSELS)
        self._grounds: dict[int, tuple[np.ndarray, Ground]] = {}
        arm = load_arm("PSM", self.tool)
        self._length = float(working_point(arm, build_instrument(arm)[1], 1.0)[2])  # of the jaws, m
        self._hand = self.jaw_axes(self.endoscope)  # axes of the jaws, world, where the tip has those of the world
        self._ahead = self.radius * self.endoscope[:3, 2]  # from the tip to the points of the jaws, world
        self._open, self._closed = (self._ahead + self._jaws(angle)[0] @ self._hand.T for angle in (self.open_jaw, self.closed_jaw))
        self._radii = self._jaws(self.open_jaw)[1]
        self._left = float(np.sign(self._jaws(self.open_jaw)[0][0, 1, 1]))  # on which side of the middle the left jaw is
        self._sites_at = np.zeros((count, self.site_count, 3))  # at rest, m, task frame
        self._frame = np.tile(np.eye(3), (count, 1, 1))  # axes of the jaws in columns, task frame
        self._hinge, self._way = np.zeros((count, 3)), np.zeros((count, 3))  # of the jaws, and from there to where it is to be, m
        self._sense = np.ones(count)  # whether the hinge of the jaws is to point along the vessel or against it
        self._misaligned, self._fits = np.zeros(count), np.zeros(count, bool)
        self._caught, self._clipped, self._lost = np.zeros(count, bool), np.zeros(count, bool), np.zeros(count, bool)
        self._at = np.zeros(count)  # where the jaws closed along the vessel, from the mark, m
        self._off, self._held = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))  # hinge of a clip from there, and its axes
        self._away = np.zeros(count)  # of the jaws from where they left the clip, m

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        skin, ground = self._skin_around(b)
        course, radius = self._draw_marked(ground, rng)
        drawn, taken = [(course, radius)], [self._way_of_jaws(b, course, radius)]
        for number in range(1, _VESSELS):
            wall, thick = drawn[-1]
            if len(drawn) == number:  # what the last one takes
                taken.append((wall[:-2:2], wall[2::2], np.full(_MIDDLE - 1, thick)))
            if number == 1 or rng.random() < _SECOND:
                drawn += self._draw_other(course, ground, taken, rng)
        self._lay(b, np.array([course for course, _ in drawn]), [radius for _, radius in drawn], skin)
        self.twisted[b] = rng.uniform(-0.5, 0.5)
        self.tip[b, 2] = self.high[2]
        self._caught[b] = self._clipped[b] = self._lost[b] = False

    def _skin_around(self, b: int) -> tuple[np.ndarray, Ground]:
        """Nodes of the skin that move [K, 3] in the frame of episode b, m, and how high it is; those of each place are made once."""
        place = int(self.sites[b, 0])
        if place not in self._grounds:
            all_skin, skin = (dot(self.axes[b], (self.rest[own] - self.origin[b])[:, None]) for own in (self.nodes.is_skin, self.skin))
            self._grounds[place] = skin, Ground(all_skin)
        return self._grounds[place]

    def _lay(self, b: int, courses: np.ndarray, radii: Sequence[float], skin: np.ndarray) -> None:
        """Let vessels run along courses [N, R, 3], and move with the nodes of the skin below."""
        anchors = courses[:, ANCHORS, None]
        below = ((anchors[..., 0] - skin[:, 0]) ** 2 + (anchors[..., 1] - skin[:, 1]) ** 2).argmin(2)
        own = slice(below.size)
        self.sites[b, own], self._sites_at[b, own] = self.skin[below.ravel()], skin[below.ravel()]
        self.vessels.lay(b, courses, radii, skin[below])

    def _draw_marked(self, ground: Ground, rng: np.random.Generator) -> tuple[np.ndarray, float]:
        """Axis [R, 3] and radius of a vessel that bridges the skin: the first that is level at the mark, or the most level."""
        wide, free, *ends = (_within(span, share) for span, share in zip((self.widths, self.free, _ENDS, _ENDS), rng.random(4)))
        radius = 0.5 * wide
        heading, bend = (
            _within(span, share) for span, share in zip(((-np.pi / 2, np.pi / 2), (-_BEND, _BEND)), rng.random((2, _HEADINGS)))
        )
        rest = np.array([free + radius]), np.array([2 * radius]), np.array([ends])  # of all
        middles = run_over(ground, _MARK, heading, bend, *rest, RINGS[_MIDDLE - 1 : _MIDDLE + 1])
        x, y, z = (middles[:, 1] - middles[:, 0]).T
        best = np.maximum(np.abs(z) / np.sqrt(x * x + y * y), _LEVEL).argmin()
        return run_over(ground, _MARK, heading[best : best + 1], bend[best : best + 1], *rest)[0], radius

    def _way_of_jaws(self, b: int, course: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Starts and ends [n, 3] and radii [n] of capsules around jaws: open on their way to the mark, and closed there, with `_ROOM`."""
        hand = dot(self.axes[b][:, None], self._hand.T)
        way = course[_MIDDLE] - course[_MIDDLE - 1]
        angle = _angle(hand[:, 0], way)
        turn = angle - np.pi * np.round(angle / np.pi)  # the less of the two that will do
        self._sense[b] = 1.0 if abs(turn - angle) < 1 else -1.0
        to_task = dot(turned_about(np.array([0.0, 0.0, 1.0]), np.array(turn))[:, None], self.axes[b].T)
        from_points = (self._open - self._ahead, self._closed - self._ahead)  # [J, 2, 3]
        opened, closed = (dot(to_task, ends[..., None, :]) for ends in from_points)
        along = dot(to_task, self._hand[:, 2])
        points = 0.5 * (course[_MIDDLE] + course[_MIDDLE - 1]) + (self._length - self._depth(radius)) * along
        placed = np.concatenate([*(opened - _BACK[:, None, None, None] * along), closed]) + points
        return placed[:, 0], placed[:, 1], np.tile(self._radii, len(_BACK) + 1) + _ROOM

    def _draw_other(
        self, marked: np.ndarray, ground: Ground, taken: list[tuple[np.ndarray, np.ndarray, np.ndarray]], rng: np.random.Generator
    ) -> list[tuple[np.ndarray, float]]:  # fmt: skip
        """Axis [R, 3] and radius of a vessel beside the marked one, or below it, out of what is taken, capsules; none where there was no
        room for those that were tried."""
        way = marked[_MIDDLE] - marked[_MIDDLE - 1]
        heading, (crosses, other, *shares) = np.arctan2(way[1], way[0]), rng.random((9, _TRIES))  # at once, as each call takes as long
        spans = self.widths, _ENDS, _ENDS, self.free, (-_SLANT, _SLANT), _APART, (-_BEND, _BEND)
        wide, before, after, free, slant, apart, bend = (_within(span, share) for span, share in zip(spans, shares))
        square, radius = crosses < _CROSSING, 0.5 * wide  # those lie on the skin, half in it
        turned, away = np.where(square, np.pi / 2, 0.0), np.where(other < 0.5, -apart, apart)
        aside = heading + np.pi / 2 - turned
        place, ends = np.array([away * np.cos(aside), away * np.sin(aside)]).T, np.array([before, after]).T
        drawn = place, heading + turned + slant, bend, np.where(square, 0.0, free + radius), 2 * radius, ends
        starts, stops, radii = map(np.concatenate, zip(*taken))
        for some in (slice(first, first + _AT_ONCE) for first in range(0, _TRIES, _AT_ONCE)):
            courses = run_over(ground, *(values[some] for values in drawn))
            good = gaps(courses[:, ::2], radius[some], starts, stops, radii) >= 0  # coarse, in a third of the time
            if good.any():
                found = int(good.argmax())
                return [(courses[found], float(radius[some][found]))]
        return []

    def _depth(self, radius: np.ndarray | float) -> np.ndarray:
        """How far from the hinge of the jaws the axis of a vessel of a radius is to be, m, so that it lies between legs when it is flat."""
        start, end = self.legs
        half = np.pi / 2 * np.asarray(radius)
        return end - half - np.minimum(_SPARE, 0.5 * (end - start) - half)

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        self.vessels.follow((here - self._sites_at).reshape(self.count, _VESSELS, len(ANCHORS), 3))
        closed = self.fourth > 0
        to_task = dot(self.axes[:, :, None], self.rotations.transpose(0, 2, 1)[:, None])  # from the tip, [B, 3, 3]
        self._frame = dot(to_task[:, :, None], self._hand.T)
        along = self._frame[:, :, 2]
        points = self.tip + dot(to_task, self._ahead)
        self._hinge = points - self._length * along
        jaws = np.where(closed[:, None, None, None], self._closed, self._open)  # [B, J, 2, 3]
        jaws = self.tip[:, None, None] + dot(to_task[:, None, None], jaws[..., None, :])
        away = self.vessels.gaps(jaws[:, :, 0], jaws[:, :, 1], self._radii)
        radius, marked = self.vessels.radius[:, 0], self.vessels.rings[:, 0]
        way = marked[:, _MIDDLE] - marked[:, _MIDDLE - 1]
        self._misaligned = _angle(self._frame[:, :, 0], self._sense[:, None] * way)
        middle = 0.5 * (marked[:, _MIDDLE] + marked[:, _MIDDLE - 1])
        self._way = middle - self._hinge - self._depth(radius)[:, None] * along
        at, place = self._judge_place()
        # What closed jaws do to the vessel is up to where it was when they began to close.
        begins, ends = self.raised == 1, (self.raised == self.latch) & ~self._clipped
        self._caught = np.where(begins, self._fits, self._caught & closed)
        on = ends & self._caught & self._fits
        self._at = np.where(begins & ~self._clipped, at, self._at)
        self._held[on], self._off[on] = self._frame[on], (self._hinge - place)[on]
        self._clipped |= on
        pierced = ~closed & ~self._clipped & (away[:, 0] < -0.5 * radius)
        others = away[:, 1:].min(1)
        self._lost |= (ends & ~on) | pierced | (others < 0)
        out = self._place_at(self._at) + self._off - self._hinge
        self._away = norm(out)
        self._way = np.where(self._clipped[:, None], out - self.beyond * self.leave * self._held[:, :, 2], self._way)
        lengths = np.column_stack([self.tip, self._way, norm(self._way)]) / LENGTH
        state = [self._fits.astype(float), np.where(closed, 1.0, -1.0), self._clipped.astype(float), self._clipped * self._away / LENGTH]
        return [*lengths.T, *along.T, self._misaligned, radius / LENGTH, np.minimum(others / LENGTH, 1.0), *state]

    def _judge_place(self) -> tuple[np.ndarray, np.ndarray]:
        """How far from the mark the marked vessel passes the plane of the jaws [B], m, and the place that closing jaws bring to there
        [B, 3], m, task frame; note whether it fits."""
        near, each = slice(*np.searchsorted(RINGS, (-_AROUND, _AROUND))), np.arange(self.count)
        ring = self.vessels.rings[:, 0, near]
        across, opening, depth = (dot(ring - self._hinge[:, None], self._frame[:, None, :, k]) for k in range(3))
        passes = across[:, :-1] * across[:, 1:] <= 0
        first = np.where(passes, np.abs(RINGS[near][:-1] + RINGS[near][1:]), np.inf).argmin(1)
        before, after = across[each, first], across[each, first + 1]
        share = np.clip(before / np.where(before == after, 1.0, before - after), 0.0, 1.0)
        mix = lambda values: values[each, first] + share * (values[each, first + 1] - values[each, first])
        way = ring[each, first + 1] - ring[each, first]
        place = ring[each, first] + share[:, None] * way
        at, off, depth = mix(np.broadcast_to(RINGS[near], across.shape)), mix(opening), mix(depth)
        half, (start, end) = np.pi / 2 * self.vessels.radius[:, 0], self.legs
        between = (np.abs(off) <= depth * np.tan(0.5 * self.open_jaw)) & (depth - half >= start) & (depth + half <= end)
        square = np.abs(dot(way, self._frame[:, :, 0])) >= np.cos(self.square) * norm(way)
        self._fits = passes.any(1) & between & square & (np.abs(at) <= self.along)
        return at, place - off[:, None] * self._frame[:, :, 1]

    def _place_at(self, at: np.ndarray) -> np.ndarray:
        """Places on the axis of the marked vessel [B, 3] that are so far along it from the mark [B], m."""
        after, each = np.clip(np.searchsorted(RINGS, at), 1, len(RINGS) - 1), np.arange(self.count)
        share = (at - RINGS[after - 1]) / (RINGS[after] - RINGS[after - 1])
        start, end = (self.vessels.rings[each, 0, ring] for ring in (after - 1, after))
        return start + share[:, None] * (end - start)

    def _value(self) -> np.ndarray:
        # Before the clip −1 for each 2 cm from where it belongs, up to 1 for being nearly there, and −½ for each radian that the jaws are
        # to turn. To close is worth 1 there, and 1 more until the clip locks; elsewhere it costs ½. So open jaws gain nothing where they
        # stay. After it 4, and 2 for leaving it. −1 for losing.
        off, closed = norm(self._way), self.fourth > 0
        closing = np.where(self._caught, 1 + np.minimum(self.raised / self.latch, 1.0), -0.5) * closed
        before = closing + np.exp(-off / self.nearly) - off / LENGTH - 0.5 * np.abs(self._misaligned)
        return np.where(self._clipped, 4 + 2 * np.minimum(self._away / self.leave, 1.0), before) - self._lost

    def _judge_goal(self) -> np.ndarray:
        return self._clipped & ~self._lost & (self.fourth <= 0) & (self._away >= self.leave)

    def _ended(self) -> np.ndarray:
        return self._lost

    def dyed_spots(self, b: int) -> tuple[DyedSpot, ...]:
        """None: the ring on the vessel is seen."""
        return ()

    def thing_poses(self) -> dict[str, np.ndarray]:
        """Where the rings of the vessels and the parts of the clip are [B, 4, 4], m, world."""
        to_world = np.tile(np.eye(4), (self.count, 1, 1))
        to_world[:, :3, :3], to_world[:, :3, 3] = self.axes.transpose(0, 2, 1), self.origin
        closed = self.fourth > 0
        narrowed = np.ones(self.vessels.rings.shape[:3])
        pinched = (self._clipped | self._caught)[:, None] * np.exp(-(((RINGS - self._at[:, None]) / _PINCHED) ** 2))
        narrowed[:, 0] -= pinched * (1 - _WALL / self.vessels.radius[:, :1])
        rings = to_world[:, None, None] @ self.vessels.poses(narrowed)
        poses = {ring_name(v, ring): rings[:, v, ring] for v in range(_VESSELS) for ring in range(len(RINGS))}
        frame = np.where(self._clipped[:, None, None], self._held, self._frame)
        hinge = np.where(self._clipped[:, None], self._place_at(self._at) + self._off, self._hinge)
        angle = np.where(closed | self._clipped, 0.0, 0.5 * self.open_jaw)[:, None]
        for leg, side in ((_HINGE, 0.0), (_LEGS[0], self._left), (_LEGS[1], -self._left)):
            own = np.tile(np.eye(4), (self.count, 1, 1))
            c, s = np.cos(side * angle), np.sin(side * angle)
            y, z = c * frame[:, :, 1] - s * frame[:, :, 2], c * frame[:, :, 2] + s * frame[:, :, 1]
            apart = np.where(angle == 0, _LEG_APART, -_LEG_INSIDE)  # open legs lie within the jaws
            own[:, :3, 0], own[:, :3, 1], own[:, :3, 2], own[:, :3, 3] = np.cross(y, z), y, z, hinge + side * apart * y
            poses[leg] = to_world @ own
        return poses | dict.fromkeys((VESSEL, OTHERS, CLIP), to_world)  # which are names alone


class ClipScript(Script):
    """Turns the jaws across the vessel well before it, comes along them, closes, and goes back as it came."""

    held_back, most_back, lever = 4.0, 0.025, 0.012  # m before the mark for each m beside it, at most; m beside it for each radian
    near, exact = 0.0005, 0.001  # m beside the way that are none; m from where the jaws shall be at which they close

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 5] for state observations [B, n]."""
        o = dict(zip(Clip.observation_names, self.states(observations).T))
        way, along = (np.stack([o[f"{name}_{axis}"] for axis in "xyz"], 1) for name in ("goal_from_tip", "jaws"))
        way = way * LENGTH
        ahead = dot(way, along)[:, None]
        beside = way - ahead * along
        off = norm(beside) + self.lever * np.abs(o["misaligned"])
        back = np.clip(self.held_back * (off - self.near), 0.0, self.most_back)[:, None]
        clipped = o["clipped"] > 0
        fits, closed, coming = o["fits"] > 0, o["jaw"] > 0, self.closing(norm(way), self.exact)
        jaw = np.select([clipped | closed & ~fits, closed, fits], [-1.0, 1.0, coming], np.minimum(coming, 0.0))
        close = jaw > 0
        wish = np.where((clipped | close)[:, None], way, beside + (ahead - back) * along)
        wish = wish / np.maximum(np.abs(wish).max(1, keepdims=True), Clip.step_length)
        turn = np.where(close | clipped, 0.0, np.clip(o["misaligned"] / Clip.twist, -1, 1))
        return np.concatenate([wish, jaw[:, None], turn[:, None]], 1)


def _within(span: tuple[float, float], share: Any) -> Any:
    """Numbers that are shares 0 to 1 of the way between two."""
    return span[0] + (span[1] - span[0]) * share


def _angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """By how much directions [..., 3] are to be turned about z to be others [..., 3], -π … π rad."""
    turn = np.arctan2(second[..., 1], second[..., 0]) - np.arctan2(first[..., 1], first[..., 0])
    return turn - 2 * np.pi * np.round(turn / (2 * np.pi))


def _bar(bone: str, sizes: list[tuple[float, float]], width: float) -> Part:
    """A bar along z that moves with a bone, by its thickness along y at places, m, and its width along x."""
    x, y = np.array([(-0.5, -0.3), (-0.3, -0.5), (0.3, -0.5), (0.5, -0.3), (0.5, 0.3), (0.3, 0.5), (-0.3, 0.5), (-0.5, 0.3)]).T
    vertices, faces = lofted(np.array([np.stack([width * x, thick * y, np.full(len(x), z)], 1) for z, thick in sizes]))
    return Part(CLIP, Material.CLIP, vertices.astype(np.float32), faces, (bone,) * len(vertices))
