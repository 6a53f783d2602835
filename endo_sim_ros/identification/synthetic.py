"""Experiments on tissue whose stiffness is known: presses, and what would be measured of them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.forward import Copy, ForwardModel
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

_AROUND = 0.012  # m; skin within this distance has the plane that a press is across


def skin_normal(nodes: ControlNodes, place: np.ndarray) -> np.ndarray:
    """Outward normal [3] of the skin near a place, towards where it was seen from."""
    skin = nodes.rest[nodes.is_skin].astype(np.float64)
    near = skin[KDTree(skin).query(place, k=min(len(skin), 6))[1]]
    wide = skin[((skin - place) ** 2).sum(1) <= _AROUND**2]
    near = wide if len(wide) >= 6 else near
    normal = np.linalg.svd(near - near.mean(0))[2][2]
    eye = np.zeros(3) if nodes.seen_from is None else nodes.seen_from
    return normal if normal @ (eye - place) > 0 else -normal


def press(
    nodes: ControlNodes,
    physics: PhysicsConfig,
    place: np.ndarray,
    depth: float = 0.006,
    steps: int = 60,
    hold: int = 10,
    clearance: float = 0.002,
) -> Experiment:
    """A press across the skin, down to a depth, held there, and back. Nothing was measured yet.

    Args:
        nodes: At rest.
        physics: Its `contact_radius` is that of the ball that presses.
        place: On the skin [3], m, world.
        depth: How far the surface of the ball goes below the skin at rest, m.
        steps: Of all of it.
        hold: Of these, at depth.
        clearance: From where the ball comes, m.
    """
    normal = skin_normal(nodes, place)
    down = (steps - hold) // 2
    way = np.concatenate([np.linspace(clearance, -depth, down), np.full(hold, -depth), np.linspace(-depth, clearance, steps - hold - down)])
    tips = place + (way + physics.contact_radius)[:, None] * normal
    return Experiment(
        physics.step_duration, tips, np.tile(np.eye(3), (steps, 1, 1)), np.ones(steps, bool), np.zeros(steps, bool),
        np.full((steps, 3), np.nan),
    )  # fmt: skip


def measure(
    experiment: Experiment,
    nodes: ControlNodes,
    physics: PhysicsConfig,
    rng: np.random.Generator,
    factors: np.ndarray | None = None,
    offset: np.ndarray | None = None,
    noise: bool = True,
    device: str = "cpu",
) -> Experiment:
    """What would be measured in an experiment on this tissue: forces, and whatever else it asks for, with the noise it tells of.

    Args:
        experiment: What the tool is told to do: its true way is `offset` from that. Displacements and tracks that are there are replaced.
        nodes: At rest.
        physics: The truth.
        rng: Of the noise.
        factors: On the moduli of each node [M].
        offset: Of the true tips from those that are told [3], m.
        noise: Whether there is any.
        device: Compute device.
    """
    copy = Copy(np.ones(len(nodes)) if factors is None else factors, np.ones(len(nodes)), (), np.zeros(3) if offset is None else offset)
    told = ForwardModel(nodes, physics, device).replay(experiment, [copy])

    def noisy(values: np.ndarray, sd: float) -> np.ndarray:
        return values + noise * sd * rng.standard_normal(values.shape)

    tracks = [replace(each, pixels=noisy(seen[0], each.noise)) for each, seen in zip(experiment.tracks, told.pixels)]
    moved = None if told.displacements is None else noisy(told.displacements[0], experiment.displacement_noise)
    return replace(
        experiment, tips=noisy(experiment.tips, experiment.tip_noise), forces=noisy(told.forces[0], experiment.force_noise),
        displacements=moved, tracks=tracks,
    )  # fmt: skip


def raster(nodes: ControlNodes, spacing: float, inside: float = 0.01) -> np.ndarray:
    """Places on the skin [K, 3], m, world, about `spacing` apart and `inside` from its rim: rows from one side to the other, to and fro."""
    skin = nodes.rest[nodes.is_skin].astype(np.float64)
    held = skin[nodes.pinned[nodes.is_skin]]
    free = skin if not len(held) else skin[KDTree(held).query(skin)[0] >= inside]
    middle = free.mean(0)
    axes = np.linalg.svd(free - middle)[2]
    flat = (free - middle) @ axes[:2].T
    low, high = flat.min(0), flat.max(0)
    counts = np.maximum(np.round((high - low) / spacing).astype(int), 1) + 1
    tree, places = KDTree(flat), []
    for row, y in enumerate(np.linspace(low[1], high[1], counts[1])):
        for x in np.linspace(low[0], high[0], counts[0])[:: 1 if row % 2 == 0 else -1]:
            distance, index = tree.query([x, y])
            if distance <= spacing / 2:
                places.append(free[index])
    return _distinct(places)


def _distinct(places: Sequence[np.ndarray]) -> np.ndarray:
    found: list[np.ndarray] = []
    for place in places:
        if not any((place == other).all() for other in found):
            found.append(place)
    return np.array(found)
