"""The forward model: many copies of an experiment at once, each with other unknowns."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree

from endo_sim_ros.core.device import pick_device
from endo_sim_ros.identification.experiment import Experiment, Tracks
from endo_sim_ros.identification.surface import Surface
from endo_sim_ros.physics import ControlNodes, PhysicsConfig, TissueBatch
from endo_sim_ros.physics.batch import tissue_properties
from endo_sim_ros.physics.skinning import bind_weights
from endo_sim_ros.physics.substeps import plan_substeps

NEIGHBOURS = 4  # control nodes that move a point, as in `Skinning`
_ROOM = math.sqrt(2)  # substeps are planned for moduli in steps of this, so that they hardly ever change between iterations
_KEPT = 8  # batches that are kept, as a GPU captures each step anew
_REMEMBERED = 64 << 20  # bytes of answers of copies that are kept: an estimate comes back to where it was, a fit begins where another ended


@dataclass(frozen=True)
class Copy:
    """One copy of the tissue, and of the way of its tool.

    Args:
        factors: On the moduli of each control node [M].
        holds: On the springs of pinned control nodes [M].
        options: Of physics that differ, by name.
        shift: Of all tips [3], m, world.
        jog: Of the tips but for those at which a jaw closes [3], or of each step [T, 3], m, world: as a held place moves with the tip, it
            does not matter where all tips are together, but how far they go.
    """

    factors: np.ndarray
    holds: np.ndarray
    options: tuple[tuple[str, float], ...] = ()
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    jog: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class Replay:
    """What C copies of an experiment of T steps predict.

    Args:
        forces: On the tool at the end of each step [C, T, 3], N, world.
        displacements: Of the control nodes that were measured [C, T, L, 3], m.
        pixels: Of each set of tracks [C, F, K, 2].
        faults: Steps that the simulation had to undo in each copy [C].
        change: By how much forces of the first copy are other ones on finer control nodes [T, 3], N; 0 where there are none.
    """

    forces: np.ndarray
    displacements: np.ndarray | None
    pixels: list[np.ndarray]
    faults: np.ndarray
    change: np.ndarray


class _Answer(NamedTuple):
    """What one copy told of an experiment."""

    experiment: Experiment  # which is known by its identity
    forces: np.ndarray  # [T, 3]
    displacements: np.ndarray | None  # [T, L, 3]
    pixels: list[np.ndarray]  # each [F, K, 2]
    faults: int

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        moved = 0 if self.displacements is None else self.displacements.nbytes
        return self.forces.nbytes + moved + sum(each.nbytes for each in self.pixels)


class ForwardModel:
    """Replays experiments in copies of a tissue. What a copy did lately is not simulated again.

    Args:
        nodes: At rest.
        physics: What the tissue is as far as it is known; factors of copies multiply its moduli.
        device: Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N.
        finer: The same tissue of more control nodes, which corrects forces, if any.
    """

    def __init__(self, nodes: ControlNodes, physics: PhysicsConfig, device: str = "auto", finer: ControlNodes | None = None):
        self.nodes, self.physics = nodes, replace(physics, device=device)
        self._finer = None if finer is None else ForwardModel(finer, physics, device)
        if finer is not None:
            self._bound = bind_weights(finer.rest.astype(np.float64), nodes.rest.astype(np.float64), NEIGHBOURS, "compact")
        self._steps = 0
        self._most: dict[float, int] = {}  # substeps, by the duration of steps
        self._batches: dict[tuple, TissueBatch] = {}
        self._answers: dict[bytes, _Answer] = {}
        self._held = 0  # bytes of these

    @property
    def steps(self) -> int:
        """Steps that were simulated, of all copies together."""
        return self._steps + (self._finer.steps if self._finer is not None else 0)

    def replan(self) -> None:
        """Forget how many substeps were needed: they grow with the stiffness, and should be those of tissue as it is thought to be now."""
        self._most.clear()
        if self._finer is not None:
            self._finer.replan()

    def replay(self, experiment: Experiment, copies: Sequence[Copy], exact: int = 0) -> Replay:
        """Let the tool of an experiment do in each copy what it did. Until it first comes near the tissue nothing is simulated. Where it is
        there from the beginning, it comes from the air before that.

        Args:
            experiment: What the tool did.
            copies: C of the tissue.
            exact: Forces of so many copies, the first ones, are those on the finer control nodes, where there are any. Those of the others
                differ from the first as on the coarse ones, but for the scale by which forces on these are greater.
        """
        told = self._replay(experiment, copies)
        if self._finer is None or not exact:
            return told
        finer = self._finer._replay(experiment, [self._on_finer(each) for each in copies[:exact]], forces_only=True)
        coarse = told.forces
        scale = float((finer.forces[0] * coarse[0]).sum()) / max(float((coarse[0] ** 2).sum()), 1e-30)
        forces = np.concatenate([finer.forces, finer.forces[:1] + scale * (coarse[exact:] - coarse[:1])])
        return replace(told, forces=forces, change=finer.forces[0] - coarse[0])

    def _on_finer(self, copy: Copy) -> Copy:
        """The same on the finer control nodes."""
        index, weights = self._bound
        return replace(copy, factors=np.exp((np.log(copy.factors)[index] * weights).sum(1)), holds=copy.holds[index[:, 0]])

    def _replay(self, experiment: Experiment, copies: Sequence[Copy], forces_only: bool = False) -> Replay:
        reach = max(float(np.abs(copy.shift + copy.jog).max()) for copy in copies) * math.sqrt(3)
        begin = first_touch(experiment, self.nodes, self.physics, reach)
        lead = way_in(experiment, self.nodes, self.physics, begin, reach)
        substeps = self._substeps(experiment, copies)
        keys = [_key(experiment, copy, substeps, begin, lead) for copy in copies]
        answers = {key: self._answers[key] for key in keys if key in self._answers}
        groups: dict[tuple, dict[bytes, Copy]] = {}
        for key, copy in zip(keys, copies):
            groups.setdefault(copy.options, {})[key] = copy
        wanted = None if forces_only or experiment.displacements is None else np.asarray(experiment.nodes)
        points = [] if forces_only else [_Points(tracks, self.nodes) for tracks in experiment.tracks]
        for options, group in groups.items():
            new = {key: copy for key, copy in group.items() if key not in answers}
            if not new:
                continue
            if pick_device(self.physics.device) == "cpu":  # a GPU captures steps for each number of copies, and takes as long for few
                group = new
            members = list(group.values())
            batch = self._batch(experiment, members, options, substeps)
            told = self._run(batch, experiment, members, begin, lead, wanted, points)
            faults = batch.tools.faults.cpu().numpy()
            for c, key in enumerate(group):
                moved = None if told[1] is None else told[1][c]
                answers[key] = _Answer(experiment, told[0][c], moved, [each[c] for each in told[2]], int(faults[c]))
            self._steps += len(members) * (len(lead) + len(experiment.tips) - begin)
        self._remember(answers)
        told = [answers[key] for key in keys]
        forces, faults = np.stack([each.forces for each in told]), np.array([each.faults for each in told])
        moved = [each.displacements for each in told if each.displacements is not None]
        pixels = [np.stack(each) for each in zip(*(each.pixels for each in told))]
        return Replay(forces, np.stack(moved) if moved else None, pixels, faults, np.zeros(forces.shape[1:]))

    def _remember(self, answers: dict[bytes, _Answer]) -> None:
        """Keep answers, the oldest ones no longer than there is room."""
        self._held += sum(each.size for key, each in answers.items() if key not in self._answers)
        self._answers |= answers
        while self._held > _REMEMBERED:
            self._held -= self._answers.pop(next(iter(self._answers))).size

    def _config(self, experiment: Experiment, options: Sequence[tuple[str, float]]) -> PhysicsConfig:
        given: dict[str, Any] = dict(options)
        return replace(self.physics, step_duration=experiment.step_duration, **given)

    def _substeps(self, experiment: Experiment, copies: Sequence[Copy]) -> int:
        """As many as the most demanding copy so far needs: forces change with their number by some per cent, so that copies, and replays
        that are compared, differ by their unknowns alone."""
        if self.physics.substeps:
            return self.physics.substeps
        needed = self._most.get(experiment.step_duration, 0)
        for options in {copy.options for copy in copies}:
            config = self._config(experiment, options)
            most = _rounded(max(float(copy.factors.max()) for copy in copies if copy.options == options))
            cell = self.nodes.spacing * config.grid_ratio
            needed = max(needed, plan_substeps(config, cell, tissue_properties(self.nodes, config), most).count)
        self._most[experiment.step_duration] = needed
        return needed

    def _batch(self, experiment: Experiment, copies: list[Copy], options: Sequence[tuple[str, float]], substeps: int) -> TissueBatch:
        most = _rounded(max(float(copy.factors.max()) for copy in copies))
        key = (tuple(options), len(copies), most, substeps, experiment.step_duration)
        if key not in self._batches:
            while len(self._batches) >= _KEPT:
                del self._batches[next(iter(self._batches))]
            config = replace(self._config(experiment, options), substeps=substeps)
            self._batches[key] = TissueBatch(self.nodes, config, len(copies), stiffness=np.full(len(copies), most))
        batch = self._batches[key]
        batch.reset()
        factors, holds = np.stack([copy.factors for copy in copies]), np.stack([copy.holds for copy in copies])
        batch.solver.set_stiffness(slice(None), factors, holds)
        return batch

    def _run(
        self, batch: TissueBatch, experiment: Experiment, copies: list[Copy], begin: int, lead: np.ndarray,
        wanted: np.ndarray | None, points: list["_Points"],
    ) -> tuple[np.ndarray, np.ndarray | None, list[np.ndarray]]:  # fmt: skip
        """Forces [C, T, 3], displacements and pixels of one batch."""
        tools, device = batch.tools, batch.solver.device
        tips = torch.from_numpy(np.nan_to_num(experiment.tips)).to(device, torch.float64)
        turned = torch.from_numpy(np.nan_to_num(experiment.rotations)).to(device, torch.float64)
        present, closed = (torch.from_numpy(each.astype(np.int32)).to(device) for each in (experiment.present, experiment.closed))
        jogged = (closing_steps(experiment) != np.arange(len(tips)))[:, None]
        moved_by = torch.from_numpy(np.stack([copy.shift + jogged * copy.jog for copy in copies], 1)).to(device)  # [T, C, 3]
        nodes = None if wanted is None else torch.from_numpy(wanted).long().to(device)
        forces = torch.zeros((len(copies), len(tips), 3), dtype=torch.float64, device=device)
        moved = None if wanted is None else torch.zeros((len(copies), len(tips), len(wanted), 3), device=device)
        pixels = [np.repeat(each.pixels_at_rest[None], len(copies), 0) for each in points]
        for away in torch.from_numpy(lead).to(device):
            tools.tips[:, 0] = tips[begin] + moved_by[begin] + away
            tools.rotations[:, 0] = turned[begin]
            tools.present[:, 0], tools.closed[:, 0] = 1, 0
            batch.step()
        for step in range(begin, len(tips)):
            tools.tips[:, 0] = tips[step] + moved_by[step]
            tools.rotations[:, 0] = turned[step]
            tools.present[:, 0] = present[step]
            tools.closed[:, 0] = closed[step] * present[step]
            batch.step()
            forces[:, step] = tools.reaction_forces[:, 0]
            if moved is not None:
                moved[:, step] = batch.displacements[:, nodes]
            for each, into in zip(points, pixels):
                images = np.flatnonzero(each.steps == step)
                if len(images):
                    at = each.places(batch)
                    for image in images.tolist():
                        into[:, image] = each.project(at, image)
        return forces.cpu().numpy(), None if moved is None else moved.cpu().double().numpy(), pixels


def _key(experiment: Experiment, copy: Copy, substeps: int, begin: int, lead: np.ndarray) -> bytes:
    """What the answer of a copy depends on."""
    told = hashlib.blake2b(repr((id(experiment), copy.options, substeps, begin)).encode())
    for each in (copy.factors, copy.holds, copy.shift, copy.jog, lead):
        told.update(np.ascontiguousarray(each).tobytes() + b"|")
    return told.digest()


class _Points:
    """Tracked points, which follow their nearest control nodes as Gaussians do."""

    def __init__(self, tracks: Tracks, nodes: ControlNodes):
        self.steps, self.cameras = np.asarray(tracks.steps), tracks.cameras
        rest = nodes.rest.astype(np.float64)
        self.index, weights = bind_weights(np.asarray(tracks.rest, np.float64), rest, NEIGHBOURS, "compact")
        self.weights = weights.astype(np.float64)
        self.arms = np.asarray(tracks.rest, np.float64)[:, None] - rest[self.index]  # [K, N, 3]
        self.pixels_at_rest = np.stack([camera.project(np.asarray(tracks.rest, np.float64))[0] for camera in self.cameras])

    def places(self, batch: TissueBatch) -> np.ndarray:
        """Where they are in each copy [C, K, 3], m, world."""
        index = torch.from_numpy(self.index.astype(np.int64)).to(batch.solver.device)
        positions, F = batch.positions()[:, index].cpu().double().numpy(), batch.F[:, index].cpu().double().numpy()
        return ((positions + np.einsum("cknij,knj->ckni", F, self.arms)) * self.weights[..., None]).sum(2)

    def project(self, places: np.ndarray, image: int) -> np.ndarray:
        """Pixels [C, K, 2] of places [C, K, 3]."""
        return self.cameras[image].project(places.reshape(-1, 3))[0].reshape(*places.shape[:2], 2)


def finer_physics(physics: PhysicsConfig, times: float) -> PhysicsConfig:
    """Physics whose control nodes are that many times closer together, across the skin and below it."""
    layers = math.ceil(times * physics.layers)
    skin = times**2 * physics.node_count / (physics.layers + 1)
    return replace(physics, layers=layers, node_count=round(skin * (layers + 1)))


def closing_steps(experiment: Experiment) -> np.ndarray:
    """Step at which the jaw closed that is closed at each step [T], -1 where it is open."""
    closed = np.asarray(experiment.closed, bool) & np.asarray(experiment.present, bool)
    begins = closed & ~np.append(False, closed[:-1])
    return np.where(closed, np.maximum.accumulate(np.where(begins, np.arange(len(closed)), -1)), -1)


def first_touch(experiment: Experiment, nodes: ControlNodes, physics: PhysicsConfig, further: float = 0.0) -> int:
    """Return the first step at which the tool may touch the tissue, or T; `further` (m) is added to its reach."""
    touching = distances_to_skin(experiment, nodes) <= reach_of(physics, nodes) + further
    return int(touching.argmax()) if touching.any() else len(touching)


def way_in(experiment: Experiment, nodes: ControlNodes, physics: PhysicsConfig, begin: int, further: float = 0.0) -> np.ndarray:
    """Return how far from its tip at step `begin` the tool is in the steps before that [L, 3], m, world: none where it was seen in the air.

    A tool that pushes would shove away in no time the tissue that it is in, and forces of that are as rough as the grid. It comes along the
    normal of the skin, as fast as it ever goes. `further` (m) is added to its reach.
    """
    none = np.zeros((0, 3))
    if not physics.contact_radius or begin >= len(experiment.tips) or (begin and experiment.present[begin - 1]):
        return none
    way = reach_of(physics, nodes) + further - distances_to_skin(experiment, nodes)[begin]
    there = np.asarray(experiment.present, bool)
    moves = np.linalg.norm(np.diff(experiment.tips, axis=0), axis=1)[there[1:] & there[:-1]]
    fastest = float(moves.max(initial=0.0))
    if way <= 0 or not fastest:
        return none
    return np.linspace(way, 0, math.ceil(way / fastest), endpoint=False)[:, None] * Surface(nodes).outwards(experiment.tips[begin][None])


def reach_of(physics: PhysicsConfig, nodes: ControlNodes) -> float:
    """Distance from a control node within which a tip can touch it, m; more than enough, as thin capsules act as thicker ones."""
    return max(physics.contact_radius and max(physics.contact_radius, 1.5 * nodes.spacing) + physics.contact_length, physics.force_radius)


def distances_to_skin(experiment: Experiment, nodes: ControlNodes) -> np.ndarray:
    """Distance of the tip from the nearest skin node at rest at each step [T], m; infinite where the tool is not there."""
    skin = nodes.rest[nodes.is_skin].astype(np.float64)
    distances = np.full(len(experiment.tips), np.inf)
    there = np.asarray(experiment.present, bool)
    distances[there] = KDTree(skin).query(experiment.tips[there])[0]
    return distances


def _rounded(factor: float) -> float:
    return _ROOM ** math.ceil(math.log(factor * 1.0001, _ROOM))
