"""How well stiffness is found where it is known: `endo-sim bench identification`.

Truth is simulated, with noise of forces (0.05 N) and tips (0.5 mm, and an offset that all share), by the estimator's own model, and by
models that it does not have: more control nodes, or more layers, with forces corrected by finer control nodes and without. Lungs that
were really pressed are in `benchmarks/lung_trials.py`.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, cast

import numpy as np

from benchmarks.lung_trials import lung_rows, press_files
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.evaluation.measurement import Row, Stage, machine, report, run_stages
from endo_sim_ros.identification import Experiment, Identification, IdentificationConfig, IdentificationError, find_inclusion, identify
from endo_sim_ros.identification.acquire import Search
from endo_sim_ros.identification.forward import ForwardModel
from endo_sim_ros.identification.palpate import InformedPalpation
from endo_sim_ros.identification.synthetic import measure, press, raster, skin_normal
from endo_sim_ros.identification.unknowns import Unknowns
from endo_sim_ros.learning.scenes import Scene, load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks.palpation import Palpation
from endo_sim_ros.learning.train import TESTED_FROM, play
from endo_sim_ros.physics import ControlNodes, PhysicsConfig
from endo_sim_ros.physics.regions import inside_sphere

SOFTEST, STIFFEST = 1e3, 16e3  # Pa, of the truth: from fat to tense organs
PRESSES = 3  # in a case of one modulus
PATCH, DEPTH, RATIO = 0.016, 0.005, 8.0  # m, m: where inclusions lie, as in the task palpation; how much stiffer they are
SOFT = 4.0  # how much softer than the rest a second one is
FIELDS = ("an inclusion", "two inclusions", "a gradient")
FOUND = 0.004  # m
MOST_PRESSES, SEARCH_NODES = 12, 1000  # of a search, which simulates each press that could be done


class Truth(NamedTuple):
    """How tissue is simulated that is to be identified, and by what model: numbers of control nodes and layers, also of what corrects
    forces, 0 = nothing does."""

    name: str
    nodes: int = 1000
    layers: int = 3
    by_nodes: int = 1000
    by_layers: int = 3
    finer_nodes: int = 0
    finer_layers: int = 0


TRUTHS = (
    Truth("of the same model"), Truth("of twice the nodes", 2000), Truth("of 5 layers instead of 3", 2000, 5),
    Truth("of 8 layers instead of 5", 3000, 8, 2000, 5), Truth("of twice the nodes, corrected", 2000, 3, 1000, 3, 2000, 5),
    Truth("of 8 layers instead of 3, corrected", 3000, 8, 1000, 3, 2000, 5),
)  # fmt: skip
FORCE_NOISES, TIP_NOISES = (0.02, 0.05, 0.1, 0.2), (0.0002, 0.001, 0.002)  # N and m, beside the usual 0.05 N and 0.5 mm


def physics(device: str, nodes: int = 1000, layers: int = 3) -> PhysicsConfig:
    """Soft tissue and a ball that presses, as in the task palpation."""
    return PhysicsConfig(
        node_count=nodes, layers=layers, thickness=0.02, young_modulus=4e3, contact_radius=0.008, friction=0.1, device=device
    )


def bench_identification(
    json_file: Path | None,
    device: str = "auto",
    cases: int = 4,
    inclusions: int = 1,
    radius: float = 0.008,
    searches: int = 1,
    palpations: int = 1,
    noises: int = 1,
    fields: int = 1,
    truth: str = "",
    nodes: int = 1000,
    layers: int = 3,
    folder: Path | None = None,
) -> None:
    """Print, and if asked for write, how well truth is found.

    Args:
        json_file: Where to write the rows.
        device: Compute device.
        cases: Of one modulus, with each truth.
        inclusions: To be found in maps.
        radius: Of these, m.
        searches: For inclusions, with presses where they tell most, and in a raster.
        palpations: Episodes of the task palpation, with presses where they tell most, and by its script.
        noises: Cases of one modulus with each noise of forces and tips.
        fields: Maps of tissue with an inclusion, with two, and that stiffens from one side to the other.
        truth: Cases are of truths alone whose names have this in them.
        nodes: Control nodes of inclusions and fields.
        layers: Of these, below the skin.
        folder: Of presses of lungs, as `endo-sim bench presses` takes it.

    Raises:
        ValueError: If a number is not positive, or the folder has no presses.
    """
    if min(cases, inclusions, searches, palpations, noises, fields) < 0 or not radius > 0:
        raise ValueError("cases, inclusions, searches, palpations, noises and fields must be 0 or more, and the radius above 0")
    truths = [each for each in TRUTHS if truth in each.name]
    if not truths:
        raise ValueError(f"there is no truth with {truth!r} in its name, but: {'; '.join(each.name for each in TRUTHS)}")
    if folder is not None:
        press_files(folder)  # what cannot be used is refused before the long work
    device, scene = pick_device(device), load_scene()
    config = physics(device, nodes, layers)
    stages: list[Stage] = [("speed", lambda: speed_rows(scene, device))]
    if cases:
        stages += [(f"truth {each.name}", partial(modulus_rows, scene, device, each, cases)) for each in truths]
    if inclusions:
        stages.append(("inclusions", lambda: inclusion_rows(scene, config, inclusions, radius)))
    if fields:
        stages += [(f"field with {kind}", partial(field_rows, scene, config, kind, fields, radius)) for kind in FIELDS]
    if searches:
        stages.append(("searches", lambda: search_rows(scene, device, searches, radius)))
    if palpations:
        stages.append(("palpations", lambda: palpation_rows(scene, device, palpations)))
    if noises:
        stages.append(("noises", lambda: noise_rows(scene, device, noises)))
    if folder is not None:
        stages.append(("lungs", lambda: lung_rows(folder)))
    report(f"Identification on {machine(device)}", run_stages(stages), json_file)


def speed_rows(scene: Scene, device: str, unknowns: Sequence[int] = (1, 20, 60), steps: int = 60) -> list[Row]:
    """Steps per second of P + 4 copies together, and what a Jacobian costs beside a gradient in reverse by kernels as fast as these: four
    forward passes of one copy (itself, its recomputation from checkpoints, and the adjoint, which takes as long as two)."""
    config = physics(device)
    nodes = scene.nodes(config)
    experiment, model = press(nodes, config, raster(nodes, 0.012)[0], steps=steps), ForwardModel(nodes, config, device)
    parameters = Unknowns(nodes, config, IdentificationConfig(), np.zeros((0, 3)))

    def seconds(count: int) -> float:
        copies = [parameters.copy(np.array([0.01 * c])) for c in range(count)]
        model.replay(experiment, copies)
        again = replace(experiment)  # of which no answers are kept
        begin = time.perf_counter()
        model.replay(again, copies)
        return time.perf_counter() - begin

    alone, rows = seconds(1), []
    for count in unknowns:
        together = seconds(count + 4)
        rows.append(Row(f"steps of {count + 4} copies", (count + 4) * steps / together, "steps/s"))
        rows.append(
            Row(f"Jacobian of {count} unknowns, one press", together, "s", together / (4 * alone), "a gradient in reverse, as fast")
        )
    return rows


def noise_rows(scene: Scene, device: str, cases: int) -> list[Row]:
    """The same with each noise, which the estimator knows."""
    noises = [(force, 0.0005) for force in FORCE_NOISES] + [(0.05, tip) for tip in TIP_NOISES]
    rows = []
    for force, tip in noises:
        truth = Truth(f"of the same model, {force:g} N, {1000 * tip:g} mm")
        rows += modulus_rows(scene, device, truth, cases, force_noise=force, tip_noise=tip)
    return rows


def modulus_rows(
    scene: Scene, device: str, truth: Truth, cases: int, first: int = 0, force_noise: float = 0.05, tip_noise: float = 0.0005
) -> list[Row]:
    """Of tissue with one modulus: error, share of intervals that hold the truth, and time."""
    config, made = physics(device, truth.by_nodes, truth.by_layers), physics(device, truth.nodes, truth.layers)
    nodes, true_nodes = scene.nodes(config), scene.nodes(made)
    finer = scene.nodes(physics(device, truth.finer_nodes, truth.finer_layers)) if truth.finer_nodes else None
    options = IdentificationConfig()
    places, errors, holds, seconds, widths, doubts, refused = raster(nodes, 0.012), [], [], [], [], 0, 0
    for case in range(first, first + cases):
        rng = np.random.default_rng([case, 1])
        modulus = float(np.exp(rng.uniform(np.log(SOFTEST), np.log(STIFFEST))))
        offset = options.tip_offset * rng.standard_normal(3)
        chosen = places[rng.permutation(len(places))[:PRESSES]]
        softness = replace(made, young_modulus=modulus)
        presses = [replace(press(nodes, config, place, steps=40), force_noise=force_noise, tip_noise=tip_noise) for place in chosen]
        experiments = [measure(each, true_nodes, softness, rng, offset=offset, device=device) for each in presses]
        begin = time.perf_counter()
        try:
            found = identify(experiments, nodes, config, options, device, finer=finer)
        except IdentificationError:  # nothing beyond the noise was measured
            refused += 1
            continue
        seconds.append(time.perf_counter() - begin)
        told = found["young_modulus"]
        errors.append(abs(told.estimate / modulus - 1))
        widths.append(np.log(told.high / told.low) / 2)
        holds.append(told.low <= modulus <= told.high)
        doubts += bool(found.findings)
    name = f"one modulus, truth {truth.name}"
    rows = [Row(f"{name}: cases refused", 100 * refused / cases, "%")] if refused else []
    if refused == cases:
        return rows
    return [
        Row(f"{name}: error, median", 100 * float(np.median(errors)), "%"),
        Row(f"{name}: within 10 %", 100 * float(np.mean(np.array(errors) <= 0.1)), "%"),
        Row(f"{name}: 90 % intervals that hold it", 100 * float(np.mean(holds)), "%"),
        Row(f"{name}: half width of intervals, median", 100 * float(np.median(widths)), "%"),
        Row(f"{name}: cases with findings", 100 * doubts / len(errors), "%"),
        Row(f"{name}: time of a case, median", float(np.median(seconds)), "s"),
        *rows,
    ]


class _Hidden(NamedTuple):
    """Tissue with an inclusion."""

    centre: np.ndarray
    normal: np.ndarray
    factors: np.ndarray
    offset: np.ndarray
    rng: np.random.Generator

    def error(self, found: Identification) -> float:
        """Distance of the inclusion that is found from where it is, m."""
        return float(np.linalg.norm(find_inclusion(found).centre - self.centre))

    def across(self, centre: np.ndarray) -> float:
        """Distance of a place [3], m, world, from it, across the press, m."""
        off = centre - self.centre
        return float(np.linalg.norm(off - (off @ self.normal) * self.normal))


def hide(nodes: ControlNodes, seed: int, radius: float) -> tuple[_Hidden, np.ndarray]:
    """Tissue with an inclusion as in the task palpation, and a raster of places over where it may be."""
    rng = np.random.default_rng([seed, 2])
    places = raster(nodes, 0.01)
    middle = places.mean(0)
    skin = nodes.rest[nodes.is_skin & ~nodes.pinned].astype(np.float64)
    near = skin[((skin - middle) ** 2).sum(1) <= PATCH**2]
    at = near[rng.integers(len(near))]
    normal = skin_normal(nodes, at)
    centre = at - DEPTH * normal
    inside = inside_sphere(nodes.rest, centre, radius)
    inside[((nodes.rest - centre) ** 2).sum(1).argmin()] = True
    offset = IdentificationConfig().tip_offset * rng.standard_normal(3)
    over = places[((places - middle) ** 2).sum(1) <= (PATCH + 0.006) ** 2]
    return _Hidden(centre, normal, np.where(inside, RATIO, 1.0), offset, rng), over


def short_press(nodes: ControlNodes, config: PhysicsConfig, place: np.ndarray, steps: int = 30) -> Experiment:
    """A press of a second or so."""
    return press(nodes, config, place, steps=steps, hold=4)


def inclusion_rows(scene: Scene, config: PhysicsConfig, count: int, radius: float) -> list[Row]:
    """Pressed in a raster over the place: how far from the truth the inclusion is found, as a ball, and in a field."""
    return [row for stiffness in ("inclusion", "field") for row in _inclusion_rows(scene, config, count, radius, stiffness)]


def _inclusion_rows(scene: Scene, config: PhysicsConfig, count: int, radius: float, stiffness: Literal["inclusion", "field"]) -> list[Row]:
    nodes, device = scene.nodes(config), config.device
    errors, across, seconds, ratios = [], [], [], []
    for seed in range(count):
        hidden, places = hide(nodes, seed, radius)
        experiments = [
            measure(short_press(nodes, config, each), nodes, config, hidden.rng, hidden.factors, hidden.offset, device=device)
            for each in places
        ]
        begin = time.perf_counter()
        found = identify(experiments, nodes, config, IdentificationConfig(stiffness=stiffness), device)
        seconds.append(time.perf_counter() - begin)
        errors.append(hidden.error(found))
        across.append(hidden.across(find_inclusion(found).centre))
        ratios.append(find_inclusion(found).ratio)
    name = f"inclusion of radius {1000 * radius:g} mm, {len(nodes)} nodes, as {stiffness}"
    return [
        Row(f"{name}: error, median", 1000 * float(np.median(errors)), "mm"),
        Row(f"{name}: error across the press, median", 1000 * float(np.median(across)), "mm"),
        Row(f"{name}: within 4 mm", 100 * float(np.mean(np.array(errors) <= FOUND)), "%"),
        Row(f"{name}: ratio of moduli, which is {RATIO:g}, median", float(np.median(ratios)), ""),
        Row(f"{name}: time of a map, median", float(np.median(seconds)), "s"),
    ]


def field_rows(scene: Scene, config: PhysicsConfig, kind: str, count: int, radius: float) -> list[Row]:
    """Pressed in a raster over the place: how many control nodes count as known, how many of these have intervals that hold the truth, and
    the same of what is stiffer or softer than the rest by a factor of two."""
    nodes, told = scene.nodes(config), []
    for seed in range(count):
        hidden, places = hide(nodes, seed, radius)
        factors = field_of(kind, nodes, hidden, places, radius)
        presses = [short_press(nodes, config, each) for each in places]
        experiments = [measure(each, nodes, config, hidden.rng, factors, hidden.offset, device=config.device) for each in presses]
        found = identify(experiments, nodes, config, IdentificationConfig(stiffness="field"), config.device)
        truth = config.young_modulus * factors
        told.append(np.stack([found.known, (found.low <= truth) & (truth <= found.high), np.abs(np.log(factors)) > np.log(2)], 1))
    known, held, different = np.concatenate(told).T
    name = f"field, {len(nodes)} nodes, truth with {kind}"
    rows = [Row(f"{name}: known", 100 * float(known.mean()), "%")]
    for title, members in (("all", np.ones(len(held), bool)), ("the known", known), ("those that differ", different)):
        if members.any():
            rows.append(Row(f"{name}: 90 % intervals that hold it, of {title}", 100 * float(held[members].mean()), "%"))
    return [*rows, Row(f"{name}: known of those that differ", 100 * float(known[different].mean()), "%")]


def field_of(kind: str, nodes: ControlNodes, hidden: _Hidden, places: np.ndarray, radius: float) -> np.ndarray:
    """Factors on the moduli [M]: of a hidden inclusion, of that one and another, soft one across the middle of the places, or e-fold
    between the middle of the places and their rim."""
    rest, middle = nodes.rest.astype(np.float64), places.mean(0)
    if kind == "an inclusion":
        return hidden.factors
    way = hidden.centre - middle
    if kind == "two inclusions":
        across = way - (way @ hidden.normal) * hidden.normal
        off = float(np.linalg.norm(across))
        mirrored = hidden.centre - max(2 * off, 2.5 * radius) / max(off, 1e-9) * across
        return np.where(inside_sphere(nodes.rest, mirrored, radius), 1 / SOFT, hidden.factors)
    across = np.cross(hidden.normal, hidden.rng.standard_normal(3))
    return np.exp((rest - middle) @ (across / np.linalg.norm(across)) / PATCH)


def search_rows(scene: Scene, device: str, count: int, radius: float) -> list[Row]:
    """Presses until an inclusion is found within 4 mm across them, and is after the next, too: where each is expected to tell most, and in
    a raster; both are told by the same search."""
    config = physics(device, SEARCH_NODES)
    nodes, needed = scene.nodes(config), {"a raster": [], "expected information": []}
    candidates = [short_press(nodes, config, each, steps=20) for each in hide(nodes, 0, radius)[1]]  # the places are the same for all
    untouched = Search(candidates, ForwardModel(nodes, config, device))
    for seed in range(count):
        for policy, told in needed.items():
            hidden, _ = hide(nodes, seed, radius)
            told.append(search(nodes, config, hidden, candidates, untouched.anew(), policy != "a raster", device))
    rows = []
    for policy, told in needed.items():
        compared = (np.mean(told) / np.mean(needed["a raster"]), "a raster") if policy != "a raster" else (None, None)
        rows.append(Row(f"presses until found within 4 mm across them, {policy}, mean of {count}", float(np.mean(told)), "", *compared))
    return rows


def search(
    nodes: ControlNodes, config: PhysicsConfig, hidden: _Hidden, candidates: list[Experiment], known: Search, informed: bool, device: str
) -> int:
    """Presses until the inclusion is found, `MOST_PRESSES` + 1 if it is not."""
    left, errors = list(range(len(candidates))), []
    for _ in range(min(MOST_PRESSES, len(candidates))):
        chosen = left.pop(int(known.expected()[left].argmax()) if informed else 0)
        measured = measure(candidates[chosen], nodes, config, hidden.rng, hidden.factors, hidden.offset, device=device)
        known.feel(chosen, measured.forces)
        errors.append(hidden.across(known.centre))
        if len(errors) > 1 and max(errors[-2:]) <= FOUND:
            return len(errors) - 1
    return MOST_PRESSES + 1


def palpation_rows(scene: Scene, device: str, count: int) -> list[Row]:
    """Episodes of the task palpation: how many are solved, and how soon, by presses that are expected to tell most, and by its script."""
    batch, rows = TaskBatch(Palpation.name, scene, count, device=device), []
    policies = {"its script": Palpation.script(count), "expected information": InformedPalpation(cast(Palpation, batch.task), device)}
    lengths = {}
    for name, policy in policies.items():
        _, success, lengths[name] = play(batch, policy, TESTED_FROM + np.arange(count))
        compared = (lengths[name].mean() / lengths["its script"].mean(), "its script") if name != "its script" else (None, None)
        rows.append(Row(f"palpation by {name}: solved", 100 * float(success.mean()), "%"))
        rows.append(Row(f"palpation by {name}: steps, mean of {count}", float(lengths[name].mean()), "", *compared))
    return rows
