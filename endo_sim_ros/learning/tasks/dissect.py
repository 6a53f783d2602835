"""Dissect: one arm holds tissue taut, the other cuts along a dyed line; the task, and a script that solves it."""

import numpy as np

from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.instruments import GRIP
from endo_sim_ros.learning.tasks.task import FORCE, LENGTH, Script, Task, dot, norm
from endo_sim_ros.physics import ControlNodes, PhysicsConfig
from endo_sim_ros.physics.cutting.geometry import separated

_STATIONS = 11  # along the line, at which it is told whether it is parted
_NEAR = 6  # nodes of the skin that tell how high it is
_EACH = 3  # of which the nearest on each side of a station tell where it is now
_BRIDGE = np.linspace(-0.0012, 0.0012, 5)[:, None, None]  # m along the line; what holds on less is too little for the tissue's nodes
_ALONG = 0.7  # least cosine between the edges of tools, which lie along z of the world, and the line of sight


class Dissect(Task):
    """Grasp the tissue at a spot beside a line, pull it aside, and cut along the line until its edges have parted.

    PSM2 takes the spot, on the left of the line. PSM1 has half-open scissors that glide through the tissue: an edge of `blade` from its
    tip towards the endoscope, which cuts where the fourth action of PSM1 is above zero. A station on the line is parted where no tissue
    leads from one side to the other within `tolerance`, down to `depth`. The episode is solved when the line is parted over its whole
    length, and its edges are on average `opened` farther apart than at rest. More than `most_astray` of cuts elsewhere lose it, and so
    do more than `most_loose` stations that are parted while PSM2 pulls less than `taut`. The fourth action of PSM2 closes its jaw where
    above zero.
    """

    name = "dissect"
    sentence = "Hold the tissue at the blue spot, pull it aside, and cut along the blue line."
    arms = ("PSM1", "PSM2")
    observation_names = (
        *(f"{arm}.tip_{axis}" for arm in ("PSM1", "PSM2") for axis in "xyz"),
        *(f"PSM1.next_from_tip_{axis}" for axis in "xyz"), *(f"PSM2.spot_from_tip_{axis}" for axis in "xyz"),
        "PSM1.distance", "PSM2.distance", "PSM1.cuts", "PSM2.jaw", "line_x", "line_y", "parted", "opening", "astray", "pull",
        *(f"{arm}.force_{axis}" for arm in ("PSM1", "PSM2") for axis in "xyz"), "PSM1.force", "PSM2.force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 120, 3.0
    working_fourth = 1.0
    fourth_does = "of PSM2 above 0 the jaw is closed, of PSM1 above 0 the edge cuts"
    closing, cutting = (False, True), True
    open_jaw = 0.35  # rad; of forceps that are to grasp a fold, and of scissors that glide
    tool, tool_share = "PROGRASP_FORCEPS", GRIP
    low, high = (-0.032, -0.022, -0.02), (0.032, 0.022, 0.022)
    site_count = 2 * _EACH * _STATIONS + 1  # the nodes on the left and then those on the right of each station, and the spot
    margin, around, smooth = 0.018, 0.016, 0.4
    slant = 0.6  # rad; most between the line and y
    long = 0.016, 0.022  # m
    spot_away = 0.011  # m from the line
    blade = 0.012  # m
    tolerance = 0.003  # m aside from the line
    beyond, deepest = 0.004, 0.008  # m past its ends, and below the skin, within which cuts are not astray
    depth = 0.003  # m
    opened = 0.0015  # m
    most_astray = 2e-5  # m²
    taut, most_loose = 0.1, 2  # N, and stations: an edge pushes loose tissue away instead of parting it; half of what the script waits for
    grasp_radius = 0.006  # m; the jaw holds control nodes within it
    dot_radius = 0.0013  # m, of the spots that are the line in pictures

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue, a jaw that holds control nodes within `grasp_radius`, an edge that cuts."""
        return PhysicsConfig(
            node_count=2000, layers=3, thickness=0.012, young_modulus=4e3, force_radius=Dissect.grasp_radius, blade_length=Dissect.blade,
            device=device,
        )  # fmt: skip

    @classmethod
    def tool_of(cls, arm: str) -> str:
        """Scissors, and forceps."""
        return "CURVED_SCISSORS" if arm == "PSM1" else cls.tool

    @staticmethod
    def script(count: int) -> "DissectScript":
        """The one below."""
        return DissectScript()

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        if self.endoscope[2, 2] < _ALONG:
            raise ValueError(f"{self.name}: edges cut along z of the world, but the endoscope looks elsewhere; turn the scene")
        self.line = np.zeros((count, _STATIONS, 3))  # stations at rest, m, task frame
        self.along = np.zeros((count, 3))  # direction of the line, task frame
        self.across = np.zeros((count, 3))  # to its right
        self.parted = np.zeros((count, _STATIONS), bool)
        self.astray = np.zeros(count)  # m²
        self.loose = np.zeros(count, int)  # stations that were parted without tension
        self._heard = np.zeros(count, int)  # triangles
        self._rest = np.zeros((count, self.site_count, 3))  # sites at rest, m, task frame
        self._weights = np.zeros((count, _STATIONS, 2 * _EACH))  # of nodes in where a station is
        self._opening, self._pull = np.zeros(count), np.zeros(count)  # m, N
        self._next, self._spot = np.zeros((count, 3)), np.zeros((count, 3))  # from the tips, m, task frame

    def _choose(self, b: int, rng: np.random.Generator) -> None:
        place = int(rng.choice(self.places))
        all_skin = self.rest[self.skin]
        around = all_skin - self.rest[place]
        self._look(
            b, all_skin[_nearest(dot(around, around)[None], 3)[0]].mean(0)
        )  # between nodes, as a cut through one leaves it to one side
        skin = dot(self.axes[b], (all_skin - self.origin[b])[:, None])  # [S, 3]
        angle, half = rng.uniform(-self.slant, self.slant), 0.5 * rng.uniform(*self.long)
        self.along[b], self.across[b] = [np.sin(angle), np.cos(angle), 0], [np.cos(angle), -np.sin(angle), 0]
        self.line[b] = np.linspace(-half, half, _STATIONS)[:, None] * self.along[b]
        off = _squares(skin, self.line[b])  # [_STATIONS, S]
        self.line[b, :, 2] = _heights(skin, off)
        aside = dot(skin, self.across[b])
        sides = [own[_nearest(off[:, own], _EACH)] for own in map(np.flatnonzero, (aside < 0, aside > 0))]
        spot = _squares(skin, -self.spot_away * self.across[b, None]).argmin()
        chosen = np.append(np.concatenate(sides), spot)
        self.sites[b], self._rest[b] = self.skin[chosen], skin[chosen]
        # The weights nearest to each other that put a station where it is, whatever linear way the nodes move.
        places = np.concatenate([skin[each] for each in sides], 1)[..., :2] - self.line[b, :, None, :2]  # [_STATIONS, 2 _EACH, 2]
        wanted = np.concatenate([np.ones((*places.shape[:2], 1)), places / LENGTH], 2)
        self._weights[b] = np.linalg.pinv(wanted.transpose(0, 2, 1))[..., 0]

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        self.tip[b, :, 0] = np.abs(self.tip[b, :, 0]) * [1, -1]  # each on its side
        self.tip[b, :, 2] = rng.uniform(0.012, self.high[2], 2)
        self.parted[b], self.astray[b], self.loose[b], self._heard[b] = False, 0.0, 0, 0

    def cuts(self, fourth: np.ndarray) -> np.ndarray:
        """The edge of PSM1 does above zero."""
        return (fourth > 0) & np.array([True, False])

    def hear_cuts(self, b: int, triangles: np.ndarray) -> None:
        """Find which stations are parted, and how much was cut elsewhere."""
        if len(triangles) == self._heard[b]:
            return
        self._heard[b] = len(triangles)
        cut = dot(self.axes[b], (triangles.astype(np.float64) - self.origin[b])[..., None, :])  # [T, 3, 3]
        before, aside, self.parted[b] = self.parted[b].copy(), self.tolerance * self.across[b], True
        for down in (0.3 * self.depth, self.depth):
            at = (self.line[b] - [0, 0, down] + _BRIDGE * self.along[b]).reshape(-1, 3)
            self.parted[b] &= separated(at - aside, at + aside, cut).reshape(len(_BRIDGE), -1).any(0)
        self.loose[b] += (self._pull[b] < self.taut) * (self.parted[b] & ~before).sum()
        middle, ends = cut.mean(1), dot(self.line[b], self.along[b])
        along, below = dot(middle, self.along[b]), _heights(self.line[b], _squares(self.line[b], middle)) - middle[:, 2]
        near = (np.abs(dot(middle, self.across[b])) <= self.tolerance) & (below <= self.deepest)
        near &= (along >= ends[0] - self.beyond) & (along <= ends[-1] + self.beyond)
        areas = 0.5 * norm(np.cross(cut[:, 1] - cut[:, 0], cut[:, 2] - cut[:, 0]))
        self.astray[b] = areas[~near].sum()

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        sides = (here - self._rest)[:, :-1].reshape(self.count, 2, _STATIONS, _EACH, 3)
        each = np.concatenate([sides[:, 0], sides[:, 1]], 2) * self._weights[..., None]
        moved = sum(each[:, :, i] for i in range(2 * _EACH))
        waiting = np.where(self.parted.all(1), _STATIONS - 1, self.parted.argmin(1))  # the first that is whole
        episodes = np.arange(self.count)
        self._next = (self.line + moved)[episodes, waiting] - self.tip[:, 0]
        self._spot = here[:, -1] - self.tip[:, 1]
        wider = dot(sides[:, 1] - sides[:, 0], self.across[:, None, None]).reshape(self.count, -1)
        self._opening = np.asarray(sum(wider.T) / wider.shape[1])
        self._pull = dot(self.force[:, 1], self.across)
        lengths = np.concatenate([self._by_arm(self.tip), self._next, self._spot, norm(self._next)[:, None], norm(self._spot)[:, None]], 1)
        states = np.where(self.fourth > 0, 1.0, -1.0)
        told = [*self.along[:, :2].T, self.parted.mean(1), self._opening / self.opened, self.astray / self.most_astray, self._pull / FORCE]
        return [*(lengths / LENGTH).T, *states.T, *told]

    def goal_lines(self) -> tuple[str, ...]:
        """Whether it is pulled hard enough to be cut, and how far that is."""
        return (
            f"PSM2 pulls aside with {self._pull[0]:.2f} N, taut from {self.taut:g} N",
            f"parted by {self.parted[0].mean():.0%}, open by {self._opening[0] * 1e3:.1f} mm of {self.opened * 1e3:.1f} mm",
        )

    def _value(self) -> np.ndarray:
        far = norm(self._next) + norm(self._spot)
        grasped = (self.fourth[:, 1] > 0) & (norm(self._spot) <= self.grasp_radius)
        open_by = np.clip(self._opening / self.opened, 0.0, 1.0)
        return 0.5 * grasped + 3 * self.parted.mean(1) + open_by - self.astray / self.most_astray - far / LENGTH

    def _judge_goal(self) -> np.ndarray:
        return self.parted.all(1) & (self._opening >= self.opened) & ~self._ended()

    def _ended(self) -> np.ndarray:
        return (self.astray > self.most_astray) | (self.loose > self.most_loose)

    def dyed_spots(self, b: int) -> tuple[DyedSpot, ...]:
        """Where the tissue is to be held, and the line."""
        line = self.origin[b] + dot(self.axes[b].T, self.line[b][:, None])
        return (DyedSpot(self.rest[self.sites[b, -1]].copy(), self.dyed_radius), *(DyedSpot(place, self.dot_radius) for place in line))


class DissectScript(Script):
    """Grasps the spot and pulls away from the line; once the tissue is taut, enters it before the line and glides along.

    A tip that lost its way leaves the tissue, and enters again before what is still whole.
    """

    grasp = 0.004  # m from the spot at which the jaw closes
    wanted, taut, wide = 0.3, 0.2, 1.2  # N; the pull, what of it is enough to begin, and the pull that opens what is cut
    gain = 0.0012  # m a step for each N that is missing
    down, over = 0.005, 0.006  # m from the skin: where the tip cuts, and where it moves aside
    ahead, behind = 0.003, 0.0015  # m along the line from what is whole next: where the tip aims, and where it enters
    pace = 0.0012  # m in a step while it cuts
    past = 0.002  # m along the line by which it may have missed something
    near = 0.0012  # m

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 8] for state observations [B, n]."""
        o = dict(zip(Dissect.observation_names, self.states(observations).T))
        vector = lambda name: LENGTH * np.stack([o[f"{name}_{axis}"] for axis in "xyz"], 1)
        along = np.stack([o["line_x"], o["line_y"], np.zeros(len(observations))], 1)
        across = np.stack([o["line_y"], -o["line_x"], np.zeros(len(observations))], 1)

        holding = (o["PSM2.jaw"] > 0) & (o["PSM2.distance"] < Dissect.grasp_radius / LENGTH)
        jaw = np.where(holding, 1.0, self.closing(LENGTH * o["PSM2.distance"], self.grasp))
        more = self.gain * np.where(holding, np.where(o["parted"] < 1, self.wanted, self.wide) - FORCE * o["pull"], 0.0)
        pull = np.where(jaw[:, None] > 0, -more[:, None] * across, vector("PSM2.spot_from_tip"))

        way = vector("PSM1.next_from_tip")
        entry, aim, depth = way - self.behind * along, way + self.ahead * along, way[:, 2]
        whole, over = o["parted"] < 1, np.hypot(*entry[:, :2].T) < self.near
        goes_on = whole & (o["PSM1.cuts"] > 0) & (np.abs(dot(way, across)) < 0.5 * Dissect.tolerance) & (dot(way, along) > -self.past)
        enters = whole & over & holding & (FORCE * o["pull"] > self.taut)
        cuts = np.where(goes_on, 1.0, np.where(enters, self.closing(self.down - depth, self.near), -1.0))
        level = np.where(goes_on | enters, depth - self.down, depth + self.over)
        glide = np.where(goes_on[:, None], aim * (self.pace / norm(aim))[:, None], entry)
        glide = np.where((goes_on | over | (depth < self.near - self.over))[:, None] & whole[:, None], glide, 0.0)  # else it leaves first
        move = np.concatenate([glide[:, :2], level[:, None]], 1)
        moves = np.clip(np.stack([move, pull], 1) / Dissect.step_length, -1, 1)
        fourth = np.stack([cuts, jaw], 1)
        return np.concatenate([moves, fourth[..., None]], 2).reshape(len(o["parted"]), -1)


def _squares(points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Squared distances [P, S] between places [P, 2 or more] and points [S, 2 or more] in x and y."""
    x, y = (places[:, k, None] - points[:, k] for k in range(2))
    return x * x + y * y


def _heights(points: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Heights z [P] of a surface through points [S, 3] at places at squared distances [P, S] from them, near points counting more."""
    nearest = _nearest(squares, _NEAR)
    weights = 1 / (np.take_along_axis(squares, nearest, 1) + 1e-8)
    return (weights * points[nearest, 2]).sum(1) / weights.sum(1)


def _nearest(squares: np.ndarray, count: int) -> np.ndarray:
    """Numbers [P, count] of the smallest of squared distances [P, S], in their order."""
    some = np.argpartition(squares, count, axis=1)[:, :count]
    return np.take_along_axis(some, np.take_along_axis(squares, some, 1).argsort(1, kind="stable"), 1)
