"""What all benchmarks share: medians, rows of results, the table that people read and the file that machines read."""

import json
import platform
import statistics
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from endo_sim_ros.device import cpu_threads


@dataclass(frozen=True)
class Row:
    """One result. ``ratio`` is this value over the peer's, measured in the same run: below 1 is less than the peer."""

    name: str
    value: float
    unit: str
    ratio: float | None = None
    peer: str | None = None


def median_seconds(action: Callable[[], object], repeats: int, device: torch.device | str = "cpu", warm_up: int = 2) -> float:
    """Median duration of an action in seconds; on a GPU until its work is done."""
    from time import perf_counter

    on_gpu = torch.device(device).type == "cuda"
    durations = []
    for index in range(warm_up + repeats):
        if on_gpu:
            torch.cuda.synchronize(device)
        start = perf_counter()
        action()
        if on_gpu:
            torch.cuda.synchronize(device)
        if index >= warm_up:
            durations.append(perf_counter() - start)
    return statistics.median(durations)


def machine(device: torch.device | str = "cpu") -> str:
    """What the benchmark ran on, in words."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{_processor()}, {cpu_threads()} threads"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def report(title: str, rows: Iterable[Row], json_file: Path | None = None) -> None:
    """Print rows as a table and, if asked for, write them as a JSON list of name, value, unit, ratio and peer."""
    rows = list(rows)
    table = Table(title=title, title_justify="left")
    for heading, justify in (("", "left"), ("value", "right"), ("unit", "left"), ("ratio", "right"), ("to", "left")):
        table.add_column(heading, justify=justify)
    for row in rows:
        ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
        table.add_row(row.name, f"{row.value:.4g}", row.unit, ratio, row.peer or "")
    Console().print(table)
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
