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
from endo_sim_ros.core.words import counted
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
    return next((record for record in _records(out, f"{cell.stem}.json") if _finished(record, cell)), None)


def earlier_records(out: Path, cells: list[Cell], config: EvaluationConfig) -> list[dict[str, Any]]:
    """Records of other cells that earlier commands finished in the folder of results, if this command would make them the same way.

    Args:
        out: The folder.
        cells: Those of this command.
        config: Its options.
    """
    ours, common = {cell.stem for cell in cells}, _common(config)
    found, others = [], 0
    for record in _records(out):
        with contextlib.suppress(ValueError, KeyError, TypeError):  # of a method or an option that is no more
            told = {name: record["cell"][name] for name in ("sequence", "split", "method", "seed", "source")}
            options = dataclasses.asdict(_method(told["method"], common))
            cell = cells[0]._replace(**told, options=options | {"seed": options["seed"] + told["seed"]})
            if cell.stem in ours:
                continue
            if _named_so(record) and _finished(record, cell):
                found.append(record)
                continue
        others += record["error"] is None
    if others:
        log.info("%s in %s made with other options, or by another version, not in the tables", counted(others, "cell"), out)
    return found


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
    owners = {drawing.slug(record["cell"]["sequence"]): record["cell"]["source"] for record in _records(out) if _named_so(record)}
    for text in sequences:
        place = split_source(text)[0]
        if not place.startswith(PHANTOM) and not Path(place).exists():
            raise SequenceError(f"{place}: no such file or folder; give a bag, a recording, or {PHANTOM}0")
        source, possible = source_names(text)
        find_named(source)
        if source in names.values():
            raise SequenceError(f"{text}: the same sequence twice")
        known = [name for name in possible if owners.get(drawing.slug(name)) == source]
        free = [name for name in possible if drawing.slug(name) not in owners]
        name = [*known, *free, possible[-1]][0]
        names[name] = owners[drawing.slug(name)] = source
    return names


def _records(out: Path, files: str = "*.json") -> Iterator[dict[str, Any]]:
    """Records in the folder of results; what cannot be read is left out."""
    for file in sorted((out / "cells").glob(files)):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            record = json.loads(file.read_text())
            if isinstance(record["cell"], dict) and "error" in record:
                yield record


def _finished(record: dict[str, Any], cell: Cell) -> bool:
    """Whether a record is that of a cell, finished with the same options."""
    return record["error"] is None and record["cell"] == json.loads(json.dumps(cell._asdict()))


def _named_so(record: dict[str, Any]) -> bool:
    """Whether the sequence of a record has a name that this version would give it."""
    with contextlib.suppress(ValueError, KeyError, TypeError):
        source, names = source_names(record["cell"]["source"])
        return source == record["cell"]["source"] and record["cell"]["sequence"] in names
    return False


def _methods(config: EvaluationConfig) -> dict[str, dict[str, Any]]:
    """All options of each method, by its name."""
    if any(item.partition("=")[0] == "preset" for item in config.set):
        raise ConfigError("--set preset: methods are named with --presets")
    common = _common(config)
    if common.get("depth_model"):
        find_network(common["depth_model"])
    for name in config.presets:
        if name in gsplat_trainers.STRATEGIES:
            gsplat_trainers.check_installed(name)
    names = list(config.presets)
    if config.ablation:
        names += [f"{name} {part}" for name in config.presets if name in ABLATIONS for part in ABLATIONS[name]]
    methods = {name: _method(name, common) for name in names}
    for text in unused_options(*methods.values()):
        log.warning(text)
    return {name: dataclasses.asdict(options) for name, options in methods.items()}


def _common(config: EvaluationConfig) -> dict[str, Any]:
    """Options of the reconstruction that all methods have."""
    return {"device": "auto"} | parse_values(config.set, "--set", ReconstructionConfig)


def _method(name: str, common: dict[str, Any]) -> ReconstructionConfig:
    """The options of a method by its name: a preset, a preset without a part, or a trainer of gsplat, which starts as `3dgs` does."""
    base, _, part = name.partition(" ")
    if base in gsplat_trainers.STRATEGIES:
        return preset("3dgs", **common)
    return preset(base, **{**common, **(ABLATIONS[base][part] if part and base in ABLATIONS else {})})


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
