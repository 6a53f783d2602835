"""What all benchmarks share: medians, rows of results, the table that people read and the file that machines read."""

import json
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import warp as wp
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from endo_sim_ros.core.device import cpu_threads, return_freed_memory


@dataclass(frozen=True)
class Row:
    """One result. ``ratio`` is this value over the peer's, measured in the same run: below 1 is less than the peer."""

    name: str
    value: float
    unit: str
    ratio: float | None = None
    peer: str | None = None


Stage = tuple[str, Callable[[], list[Row]]]
"""A part of a benchmark: its name, and what measures it."""


def median_seconds(action: Callable[[], object], repeats: int, device: torch.device | str = "cpu", warm_up: int = 2) -> float:
    """Median duration of an action in seconds; on a GPU until its work is done."""
    on_gpu = torch.device(device).type == "cuda"
    durations = []
    for index in range(warm_up + repeats):
        if on_gpu:
            torch.cuda.synchronize(device)
        start = time.perf_counter()
        action()
        if on_gpu:
            torch.cuda.synchronize(device)
        if index >= warm_up:
            durations.append(time.perf_counter() - start)
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


def run_stages(stages: Sequence[Stage]) -> list[Row]:
    """The rows of all stages of a benchmark."""
    rows = []
    with Progress(transient=True) as bar:
        task = bar.add_task("", total=len(stages))
        for name, stage in stages:
            bar.update(task, description=name)
            rows += stage()
            bar.advance(task)
    return rows


def write_rows(rows: Iterable[Row], json_file: Path) -> None:
    """Write rows as a JSON list of name, value, unit, ratio and peer."""
    json_file.parent.mkdir(parents=True, exist_ok=True)
    json_file.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


def report(title: str, rows: Sequence[Row], json_file: Path | None = None) -> None:
    """Print rows as a table and, if asked for, write them to a file."""
    table = Table(title=title, title_justify="left")
    for heading in ("", "value", "unit", "ratio", "to"):
        table.add_column(heading, justify="right" if heading in ("value", "ratio") else "left")
    for row in rows:
        ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
        table.add_row(row.name, f"{row.value:.4g}", row.unit, ratio, row.peer or "")
    Console().print(table)
    if json_file is not None:
        write_rows(rows, json_file)


def short(count: int) -> str:
    """A count in thousands or millions where that is exact: 30k, 1M."""
    return f"{count // 1_000_000}M" if count % 1_000_000 == 0 else f"{count // 1000}k" if count % 1000 == 0 else str(count)


def milliseconds(actions: list[Callable[[], object]], device: str, seconds: float) -> list[float]:
    """Median durations of actions, each run for some seconds in all, in turns: a busy machine then slows all alike."""
    turns, repeats = 3, []
    for action in actions:
        duration = median_seconds(action, 1, device, warm_up=0)
        if duration < 0.3 or device != "cpu":  # the first call may have compiled; a slow one need not be repeated to know
            duration = median_seconds(action, 1, device, warm_up=0)
        repeats.append(min(max(round(seconds / turns / duration), 1), 30))
    medians = [[median_seconds(*each, device, warm_up=0) for each in zip(actions, repeats)] for _ in range(turns)]
    return [1000 * statistics.median(durations) for durations in zip(*medians)]


def peak_megabytes(action: Callable[[], object], device: str) -> float | None:
    """Memory that an action needs above what was in use before, 10⁶ bytes; None where it cannot be told.

    On a GPU what torch and Warp allocated; on a CPU the growth of the process's resident memory (Linux only).
    """
    if device != "cpu":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        warp_before = wp.get_mempool_used_mem_current(device)
        action()
        torch.cuda.synchronize(device)
        # Warp's high-water mark cannot be reset; its share is the buffers of the sort, the same in every call.
        warp = max(wp.get_mempool_used_mem_high(device) - warp_before, 0)
        return (torch.cuda.max_memory_allocated(device) - before + warp) / 1e6
    try:
        return_freed_memory()  # else the allocator would serve the action from what it keeps
        Path("/proc/self/clear_refs").write_text("5")  # sets the peak to what is resident now
        before = status_kilobytes("VmRSS")
        action()
        return (status_kilobytes("VmHWM") - before) * 1024 / 1e6
    except (OSError, AttributeError):
        return None


def status_kilobytes(field: str, process: int | str = "self") -> int:
    """A number of kilobytes that Linux tells of a process."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(field + ":")).split()[1])
