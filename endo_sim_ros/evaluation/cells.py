"""Cells of an evaluation: which trainings there are, under which names, and their records in the folder of results."""

import contextlib
import dataclasses
import json
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from endo_sim_ros.core import drawing
from endo_sim_ros.core.config import ConfigError, unused_options
from endo_sim_ros.core.folders import written_whole
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation import gsplat_trainers
from endo_sim_ros.evaluation.config import EvaluationConfig
from endo_sim_ros.evaluation.lpips import Backbone, Lpips, WeightsError
from endo_sim_ros.evaluation.sources import PHANTOM, find_named, parse_values, source_names, split_source
from endo_sim_ros.evaluation.splits import check_split
from endo_sim_ros.evaluation.workers import Finished
from endo_sim_ros.reconstruction import ReconstructionConfig
from endo_sim_ros.reconstruction.presets import ABLATIONS, preset
from endo_sim_ros.reconstruction.priors.network import find_network

log = logging.getLogger(__name__)


class Cell(NamedTuple):
    """One training and its measurement."""

    sequence: str
    split: str
    method: str
    seed: int
    options: dict[str, Any]  # of the reconstruction, all of them
    source: str
    train_depth: bool
    mono: bool
    lpips: tuple[Backbone, ...]  # networks whose weights are there
    curve: int
    most_held_out: int  # views that are measured

    @property
    def stem(self) -> str:
        """Name of the cell's files, without an ending."""
        return drawing.slug(f"{self.sequence}-{self.split}-{self.method}-{self.seed}")


def list_cells(sequences: Sequence[str], config: EvaluationConfig) -> tuple[list[Cell], dict[str, str]]:
    """Return all cells of an evaluation, and why figures are missing, by their names.

    Args:
        sequences: Sequences as named on the command line.
        config: What to compare.

    Raises:
        SequenceError, ConfigError: If a sequence, a split or an option is not there.
    """
    names = _names(sequences, config.out)
    for split in config.splits:
        check_split(split)
    networks, missing = _networks(config)
    methods = _methods(config)
    given = {
        "train_depth": config.train_depth,
        "mono": config.mono,
        "lpips": networks,
        "curve": config.curve,
        "most_held_out": config.held_out,
    }
    cells = [
        Cell(name, split, method, seed, options | {"seed": options["seed"] + seed}, source, **given)
        for name, source in names.items()
        for split in config.splits
        for method, options in methods.items()
        for seed in range(config.seeds)
    ]
    return cells, missing


def finished_record(out: Path, cell: Cell) -> dict[str, Any] | None:
    """The record of a cell that was finished with the same options."""
    try:
        record = json.loads((out / "cells" / f"{cell.stem}.json").read_text())
        return record if record["error"] is None and record["cell"] == json.loads(json.dumps(cell._asdict())) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def save_record(out: Path, cell: Cell, outcome: Finished) -> dict[str, Any]:
    """Write what a cell gave, and return its record."""
    result = outcome.result or {}
    pictures = {}
    for name, data in result.pop("pictures", {}).items():
        pictures[name] = f"pictures/{cell.stem}-{name}.jpg"
        (out / pictures[name]).write_bytes(data)
    record = {"cell": cell._asdict(), "error": outcome.error, "pictures": pictures, **result}
    file = out / "cells" / f"{cell.stem}.json"
    with written_whole(file) as partial:
        partial.write_text(json.dumps(record, indent=1) + "\n")
    return json.loads(file.read_text())


def _names(sequences: Sequence[str], out: Path) -> dict[str, str]:
    """Each sequence, told in full, by a short name that no other one has in the folder of results."""
    if not sequences:
        raise SequenceError(f"give one sequence or more: a bag, a folder, or {PHANTOM}0")
    names: dict[str, str] = {}
    owners = {drawing.slug(record["cell"]["sequence"]): record["cell"]["source"] for record in _records(out)}
    for text in sequences:
        place = split_source(text)[0]
        if not place.startswith(PHANTOM) and not Path(place).exists():
            raise SequenceError(f"{place}: no such file or folder; give a bag, a recording, or {PHANTOM}0")
        find_named(text)
        source, possible = source_names(text)
        if source in names.values():
            raise SequenceError(f"{text}: the same sequence twice")
        known = [name for name in possible if owners.get(drawing.slug(name)) == source]
        free = [name for name in possible if drawing.slug(name) not in owners]
        name = [*known, *free, possible[-1]][0]
        names[name] = owners[drawing.slug(name)] = source
    return names


def _records(out: Path) -> Iterator[dict[str, Any]]:
    """Records in the folder of results whose sequences have names as this version gives them."""
    for file in sorted((out / "cells").glob("*.json")):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            record = json.loads(file.read_text())
            source, names = source_names(record["cell"]["source"])
            if source == record["cell"]["source"] and record["cell"]["sequence"] in names:
                yield record


def _methods(config: EvaluationConfig) -> dict[str, dict[str, Any]]:
    """All options of each method, by its name."""
    if any(item.partition("=")[0] == "preset" for item in config.set):
        raise ConfigError("--set preset: methods are named with --presets")
    common = {"device": "auto"} | parse_values(config.set, "--set", ReconstructionConfig)
    if common.get("depth_model"):
        find_network(common["depth_model"])
    methods = {}
    for name in config.presets:
        if name in gsplat_trainers.STRATEGIES:
            gsplat_trainers.check_installed(name)
        # gsplat's trainers start as `3dgs` does.
        methods[name] = preset("3dgs" if name in gsplat_trainers.STRATEGIES else name, **common)
    if config.ablation:
        for name in config.presets:
            for part, overrides in ABLATIONS[name].items() if name in ABLATIONS else ():
                methods[f"{name} {part}"] = preset(name, **{**common, **overrides})
    for text in unused_options(*methods.values()):
        log.warning(text)
    return {name: dataclasses.asdict(options) for name, options in methods.items()}


def _networks(config: EvaluationConfig) -> tuple[tuple[Backbone, ...], dict[str, str]]:
    """The networks of LPIPS that can be used, and why the others cannot; a folder of weights that has none of them is refused."""
    usable: list[Backbone] = []
    missing: dict[str, str] = {}
    for name in config.lpips:
        try:
            Lpips(name, config.weights)
            usable.append(name)
        except WeightsError as error:
            missing[f"lpips_{name}"] = str(error)
    if missing and not usable and config.weights is not None:
        raise ConfigError(f"--weights: {next(iter(missing.values()))}")
    for text in missing.values():
        log.warning("%s", text)
    return tuple(usable), missing
