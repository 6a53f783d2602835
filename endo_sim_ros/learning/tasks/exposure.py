"""Exposure: pull a fold aside until what lies behind it is seen; the task, and a script that solves it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay

from endo_sim_ros.core.cameras import look_at
from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.instruments import GRIP, PlacementConfig
from endo_sim_ros.learning.tasks.task import LENGTH, Script, Task, dot, norm
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

_TURNS = np.radians(np.arange(0.0, 360.0, 15.0))  # about the line of sight of the scene
_TILTS = np.radians([45.0, 52.0, 60.0])  # away from it
_AHEAD = 0.008, 0.025  # m from a place to the fold before it
_FACES = 120  # triangles of the skin that may hide a place, at most
_ASIDE = 0.5  # least part of the instrument's direction that is across the picture, so that it hides neither fold nor place
_HEIGHTS = np.append(0.0003, np.arange(0.5, 6.1, 0.5) * 1e-3)  # m above a place, for which it is asked whether they are seen


@dataclass
class _View:
    """A place behind a fold, as an endoscope sees it."""

    pose: np.ndarray  # of the endoscope [4, 4], camera to world, m
    axes: np.ndarray  # [3, 3] rows: x, y, z of the task frame in the world
    origin: np.ndarray  # [3] m, world
    eye: np.ndarray  # [3] m, task frame
    sites: np.ndarray  # [K] nodes: the place, the fold, the grip, and others around the line of sight
    corners: np.ndarray  # [F, 3] numbers of sites: faces of the skin between these, but for those at the place


class Exposure(Task):
    """Grasp a fold that hides a place, and pull it aside until the place is seen.

    The endoscope looks along the tissue, such that the instrument comes from one side. A place is
    hidden where the surface between neighbouring nodes of the skin crosses the line of sight. The episode is solved when the place
    has been seen for `hold` steps, without ever pulling harder than `force_limit`. The fourth action closes the jaw where above zero.
    """

    name = "exposure"
    sentence = "Grasp the fold beside the blue spot and pull it aside until the spot behind it is seen."
    observation_names = (
        *(f"tip_{axis}" for axis in "xyz"), *(f"grip_from_tip_{axis}" for axis in "xyz"), "distance",
        *(f"fold_moved_{axis}" for axis in "xyz"), "hidden", "jaw",
        *(f"force_{axis}" for axis in "xyz"), "force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 100, 4.0
    closing, working_fourth = True, 1.0
    roams = True
    open_jaw = 0.6
    tool, tool_share = "PROGRASP_FORCEPS", GRIP
    low, high = (-0.015, -0.02, -0.02), (0.025, 0.025, 0.03)
    hold = 5  # steps
    least, most = 0.001, 0.0035  # m up in the picture from a place to where it would be seen at first
    grasp_radius = 0.008  # m; the jaw holds control nodes within it
    aside = 0.006  # m from the fold to where it is gripped, on the side of the tool, which would be before the place else
    site_count = 60  # place, fold, grip, and nodes near the line of sight
    smooth, margin = 1.0, 0.01

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue, and a jaw that holds control nodes within `grasp_radius`."""
        return PhysicsConfig(
            node_count=800, layers=2, thickness=0.015, young_modulus=4e3, force_radius=Exposure.grasp_radius, device=device
        )

    @staticmethod
    def script(count: int) -> "ExposureScript":
        """The one below."""
        return ExposureScript()

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        skin = np.flatnonzero(nodes.is_skin)
        local = (self.rest[skin] - self.endoscope[:3, 3]) @ self.endoscope[:3, :3]
        self._faces = skin[Delaunay(local[:, :2] / local[:, 2:]).simplices]  # [F, 3] nodes
        self._clear = np.zeros(len(self.rest))  # m from tissue that is held
        self._clear[self.skin] = self._clearances()
        views = self._search()
        self._views = [self._view(*view) for view in views]
        if self._views:
            places = np.array([view.sites for view in self._views])
            eyes, corners = np.array([view.eye for view in self._views]), np.array([view.corners for view in self._views])
            here = np.array([dot(view.axes, (self.rest[sites] - view.origin)[:, None]) for view, sites in zip(self._views, places)])
            hidden = hidden_by(eyes, here, corners)
            self._views = [view for view, height in zip(self._views, hidden) if self.least <= height <= self.most]
        if not self._views:
            raise ValueError(f"{self.name}: no place in the scene is hidden behind a fold; take one with more relief")
        self._poses, self._eyes = np.tile(self.endoscope, (count, 1, 1)), np.zeros((count, 3))
        self._corners = np.zeros((count, _FACES, 3), int)
        self._hidden, self._grip = np.zeros(count), np.zeros((count, 3))  # m; from the tip, m, task frame
        self._fold, self._seen = np.zeros((count, 3)), np.zeros(count, int)

    def _search(self) -> list[tuple[int, int, int, np.ndarray]]:
        """Place, fold, grip (nodes), and pose of the endoscope, for all that can be exposed."""
        found, R = [], self.endoscope[:3, :3]
        below = np.radians(PlacementConfig().below)
        shaft = R @ np.array([np.cos(below), np.sin(below), 0.0])  # where `place_arm` has the instrument come from
        ways = self.rest[self.skin] - self.rest[self.places][:, None]  # [K, S, 3] from each place to the skin
        for turn in _TURNS:
            lateral = R @ np.array([-np.sin(turn), np.cos(turn), 0.0])
            across = float(shaft @ np.cross(R[:, 2], lateral))
            if abs(across) < _ASIDE:
                continue
            for tilt in _TILTS:
                towards = np.cos(tilt) * -R[:, 2] + np.sin(tilt) * lateral
                axes = look_at(towards, np.zeros(3), -R[:, 2])[:3, :3] * [1, -1, -1]
                x = axes[:, 0]
                side, height, ahead = np.moveaxis(ways @ axes, -1, 0)  # [K, S]
                near = (np.abs(side) < 0.004) & (ahead > _AHEAD[0]) & (ahead < _AHEAD[1])
                height = np.where(near, height, -np.inf)
                highest = height.max(1)
                for number in np.flatnonzero((self.least < highest) & (highest < 0.006)):
                    place, way, at = self.places[number], ways[number], np.argmax(height[number])
                    grip = np.argmin(((way - way[at] - np.copysign(self.aside, shaft @ x) * x) ** 2).sum(1))
                    if min(self._clear[self.skin[at]], self._clear[self.skin[grip]]) < 0.008:
                        continue
                    eye = self.rest[place] + float(np.linalg.norm(self.endoscope[:3, 3] - self.rest[place])) * towards
                    found.append((int(place), int(self.skin[at]), int(self.skin[grip]), look_at(eye, self.rest[place], -R[:, 2])))
        return found

    def _view(self, place: int, fold: int, grip: int, pose: np.ndarray) -> _View:
        """What there is to know of a fold, seen from a pose."""
        axes, named = np.stack([pose[:3, 0], -pose[:3, 1], -pose[:3, 2]]), [place, fold, grip]
        line = self.rest[place] - self.rest
        along = np.clip(-(line @ axes[2]), 0.0, _AHEAD[1] + self.grasp_radius)
        off = np.linalg.norm(line + along[:, None] * axes[2], axis=1)
        off[~self.nodes.is_skin] = np.inf
        off[named] = np.inf
        sites = np.concatenate([named, np.argsort(off, kind="stable")[: self.site_count - len(named)]])
        number = np.zeros(len(self.rest), int)
        number[sites] = np.arange(len(sites))  # 0: the place itself, or none
        faces = number[self._faces]
        faces = faces[(faces > 0).all(1)][:_FACES]
        corners = np.zeros((_FACES, 3), int)
        corners[: len(faces)] = faces
        origin = self.rest[fold]
        return _View(pose, axes, origin, dot(axes, pose[:3, 3] - origin), sites, corners)

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        view = self._views[int(rng.integers(len(self._views)))]
        self._poses[b], self.axes[b], self.origin[b], self._eyes[b] = view.pose, view.axes, view.origin, view.eye
        self.sites[b], self._corners[b] = view.sites, view.corners
        self.tip[b] = [rng.uniform(-0.01, 0.01), rng.uniform(0.012, 0.02), rng.uniform(0.0, 0.02)]
        self._seen[b] = 0

    def endoscopes(self, actions: np.ndarray | None = None) -> np.ndarray:
        """Poses of the endoscopes [B, 4, 4], camera to world, m, whatever the actions are."""
        return self._poses

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        self._hidden = hidden_by(self._eyes, here, self._corners)
        self._fold, self._grip = here[:, 1], here[:, 2] - self.tip
        jaw, distance = np.where(self.fourth > 0, 1.0, -1.0), norm(self._grip) / LENGTH
        moved = (self._fold / LENGTH).T
        return [*(self.tip / LENGTH).T, *(self._grip / LENGTH).T, distance, *moved, self._hidden / _HEIGHTS[-1], jaw]

    def _value(self) -> np.ndarray:
        distance = norm(self._grip)
        grasped = (self.fourth > 0) & (distance <= self.grasp_radius)
        return 2 * (1 - self._hidden / _HEIGHTS[-1]) - distance / LENGTH + 0.5 * grasped

    def _judge_goal(self) -> np.ndarray:
        self._seen = np.where(self._hidden == 0, self._seen + 1, 0)
        return self._seen >= self.hold

    def dyed_spots(self, b: int) -> tuple[DyedSpot, ...]:
        """The place behind the fold, and one on it that tells where it is."""
        return tuple(DyedSpot(self.rest[node].copy(), self.dyed_radius) for node in self.sites[b, :2])


class ExposureScript(Script):
    """Goes to the grip, closes there, and pulls the fold towards the endoscope and down, slower once the place is seen."""

    grasp = 0.005  # m from the grip at which the jaw closes
    pace = 0.5, 0.2  # parts of a step while the place is hidden and once it is seen; a policy that copies a stop fades out before it
    pull = np.array([0.0, -0.4, 0.92])  # pulled down alone the fold takes the place with it

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4] for state observations [B, n]."""
        o = dict(zip(Exposure.observation_names, self.states(observations).T))
        holding = (o["jaw"] > 0) & (o["distance"] < Exposure.grasp_radius / LENGTH)
        jaw = np.where(holding, 1.0, self.closing(o["distance"] * LENGTH, self.grasp))
        way = np.stack([o[f"grip_from_tip_{axis}"] for axis in "xyz"], 1) * LENGTH / Exposure.step_length
        pull = np.where(o["hidden"] > 0, *self.pace)[:, None] * self.pull
        return np.concatenate([np.clip(np.where(jaw[:, None] > 0, pull, way), -1, 1), jaw[:, None]], 1)


def hidden_by(eyes: np.ndarray, here: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """How far up in the picture each place is from being seen [B], m, 0 where it is.

    Args:
        eyes: Where they are seen from [B, 3], m, task frame.
        here: Sites [B, K, 3], m, task frame; the first is the place.
        corners: Numbers of the sites that are the corners of faces [B, F, 3]; (0, 0, 0) is none.
    """
    a, b, c = (np.take_along_axis(here, corners[:, :, i, None], 1) for i in range(3))  # [B, F, 3]
    e1, e2, s = b - a, c - a, eyes[:, None] - a
    q = np.cross(s, e1)
    blocked = np.zeros((len(here), len(_HEIGHTS)), bool)
    for number, height in enumerate(_HEIGHTS):  # Möller and Trumbore's intersection of a ray and triangles
        ray = (here[:, 0] + [0, height, 0] - eyes)[:, None]
        h = np.cross(np.broadcast_to(ray, e2.shape), e2)
        det = dot(e1, h)
        flat = np.abs(det) < 1e-18  # also where there is no face
        scale = 1 / np.where(flat, 1.0, det)
        u, v, t = dot(s, h) * scale, dot(ray, q) * scale, dot(e2, q) * scale
        blocked[:, number] = (~flat & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any(1)
    after = len(_HEIGHTS) - np.argmax(blocked[:, ::-1], 1)  # the first above all that are hidden
    return np.where(blocked.any(1), np.append(_HEIGHTS, _HEIGHTS[-1] + 5e-4)[after], 0.0)
