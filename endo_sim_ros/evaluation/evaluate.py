"""`endo-sim evaluate`: sequences × splits × methods × seeds, each trained and measured on its own.

`cells` tells what there is to do, `preparation` what the cells of a sequence share, `training` what one cell does in its process;
this file runs the cells and gathers the results.
"""

import json
import logging
import pickle
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.temporary_folder import temporary_folder
from endo_sim_ros.core.words import counted
from endo_sim_ros.evaluation import tables
from endo_sim_ros.evaluation.cells import Cell, earlier_records, finished_record, list_cells, save_record
from endo_sim_ros.evaluation.config import EvaluationConfig
from endo_sim_ros.evaluation.measurement import machine
from endo_sim_ros.evaluation.preparation import prepare_sequence
from endo_sim_ros.evaluation.training import train_and_measure
from endo_sim_ros.evaluation.workers import Finished, News, ray_is_installed, run_in_processes, run_in_ray

log = logging.getLogger(__name__)


def evaluate(sequences: Sequence[str], config: EvaluationConfig) -> dict[str, Any]:
    """Train and measure every cell that is not finished yet in the folder of results, and write tables and pictures of all that is.

    Args:
        sequences: Each a bag, a recording of a known layout, or `phantom:SEED`; `,name=value` appends options of its reader.

    Returns:
        What `results.json` holds: these cells, and those that earlier commands finished there with the same options.

    Raises:
        SequenceError, ConfigError: If a sequence, a split or an option is not there. What fails later is in the table, with why.
    """
    cells, missing = list_cells(sequences, config)
    device = pick_device(config.device)  # one that is not there is refused before any work
    for folder in ("cells", "pictures"):
        (config.out / folder).mkdir(parents=True, exist_ok=True)
    finished = {cell.stem: finished_record(config.out, cell) for cell in cells}
    open_cells = [cell for cell in cells if finished[cell.stem] is None]
    if len(open_cells) < len(cells):
        log.info("finished in %s already: %d of %s", config.out, len(cells) - len(open_cells), counted(len(cells), "cell"))
    if open_cells:
        for cell, outcome in _run(open_cells, config):
            finished[cell.stem] = save_record(config.out, cell, outcome)
    records = [*earlier_records(config.out, cells, config), *(finished[cell.stem] for cell in cells)]
    order = list(dict.fromkeys(record["cell"]["sequence"] for record in records))
    results = {
        "machine": machine(device),
        "date": time.strftime("%Y-%m-%d"),
        "missing": missing,
        "cells": sorted(records, key=lambda record: order.index(record["cell"]["sequence"])),
    }
    (config.out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    tables.write(results, config.out, config.json)
    return results


def _devices(config: EvaluationConfig) -> list[str]:
    first = pick_device(config.device)
    if first == "cpu" or config.device not in ("auto", "cuda"):
        devices = [first]
    else:
        devices = [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    return devices * config.workers


def _run(cells: list[Cell], config: EvaluationConfig) -> Iterator[tuple[Cell, Finished]]:
    """Run cells, sequence by sequence, and yield each with its end as it comes."""
    devices = _devices(config)
    with_ray = config.pool == "ray" or config.pool == "auto" and ray_is_installed()
    bar = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with bar, temporary_folder() as folder:
        task, failed = bar.add_task("cells", total=len(cells)), 0
        for sequence in dict.fromkeys(cell.sequence for cell in cells):
            ours = [cell for cell in cells if cell.sequence == sequence]
            files = Path(tempfile.mkdtemp(dir=folder))
            try:
                prepared = prepare_sequence(ours, bar, files)
            except (ValueError, OSError, RuntimeError) as error:
                failed += len(ours)
                bar.update(task, advance=len(ours), description=f"cells, {failed} failed")  # why is told below the table
                yield from ((cell, Finished(index, error=str(error))) for index, cell in enumerate(ours))
                continue
            if with_ray:
                import ray  # pyright: ignore[reportMissingImports]  (optional)

                if not ray.is_initialized():
                    ray.init(log_to_driver=False, logging_level="ERROR")
                shared = ray.put(prepared.carried())
                arguments = [(cell, config.weights, shared) for cell in ours]
                events = run_in_ray(train_and_measure, arguments, devices[0] != "cpu", config.workers)
            else:
                file = files / "prepared"
                file.write_bytes(pickle.dumps(prepared))
                events = run_in_processes(train_and_measure, [(cell, config.weights, file) for cell in ours], devices)
            del prepared
            running: dict[int, TaskID] = {}
            for event in events:
                cell = ours[event.index]
                if isinstance(event, News):
                    done, total, text = event.message
                    if event.index not in running:
                        running[event.index] = bar.add_task("")
                    what = f"  {cell.sequence} {cell.split} {cell.method} seed {cell.seed}: {text}"
                    bar.update(running[event.index], completed=done, total=total, description=what)
                    continue
                if event.index in running:
                    bar.remove_task(running.pop(event.index))
                failed += event.error is not None
                bar.update(task, advance=1, description=f"cells, {failed} failed" if failed else "cells")
                yield cell, event
            shutil.rmtree(files)
