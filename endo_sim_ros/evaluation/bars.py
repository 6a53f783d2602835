"""Results of benchmarks as one picture: `endo-sim plot`."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

from endo_sim_ros.evaluation.measurement import Row


def read_rows(path: Path) -> list[Row]:
    """What `endo-sim bench … --json` wrote.

    Raises:
        ValueError: If it is something else.
    """
    try:
        return [Row(**row) for row in json.loads(path.read_text())]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: not the rows that `endo-sim bench … --json` writes ({error})") from error


def plot_rows(files: Sequence[Path], out: Path, only: str = "", title: str = "") -> int:
    """Draw rows as bars, one panel for each unit, with a ring where the row's peer is.

    Args:
        files: Rows; those of several machines stand side by side, each named like its file.
        out: Picture to write, .png, .svg or .pdf.
        only: Regular expression; rows whose names it is not found in are left out.
        title: Over the picture.

    Returns:
        How many rows were drawn.

    Raises:
        ValueError: If a file cannot be read, or nothing is left to draw.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("plots need matplotlib, which is not installed; pip install 'endo_sim_ros[report]'") from error
    series = {path.stem: [row for row in read_rows(path) if row.value > 0 and re.search(only, row.name)] for path in files}
    units = {row.unit: list(dict.fromkeys(r.name for rows in series.values() for r in rows if r.unit == row.unit))
             for rows in series.values() for row in rows}  # fmt: skip
    if not units:
        raise ValueError(f"{', '.join(map(str, files))}: no row to draw" + (f" whose name has {only!r}" if only else ""))
    heights = [len(names) * (1 + 0.6 * (len(series) - 1)) + 2 for names in units.values()]
    figure = Figure(figsize=(8, 0.23 * sum(heights) + 0.3), layout="constrained")
    panels = figure.subplots(len(units), height_ratios=heights, squeeze=False)[:, 0]
    thickness = 0.8 / len(series)
    for axes, (unit, names) in zip(panels, units.items()):
        for number, (name, rows) in enumerate(series.items()):
            rows = [row for row in rows if row.unit == unit]
            places = [names.index(row.name) + (number + 0.5) * thickness - 0.4 for row in rows]
            first = {row.name: (row.value, place) for row, place in reversed([*zip(rows, places)])}  # one that has two peers is there twice
            values, heights = zip(*first.values()) if first else ((), ())
            bars = axes.barh(heights, values, thickness, color=f"C{number}", label=name)
            axes.bar_label(bars, [f"{v:,.0f}" if v >= 1000 else f"{v:.3g}" for v in values], padding=3, fontsize=7)
            peers = [(row.value / row.ratio, place) for row, place in zip(rows, places) if row.ratio]
            if peers:
                axes.plot(*zip(*peers), "o", mfc="none", color="0.3", markersize=4, label="peer in the same run" if number == 0 else None)
        axes.set(xscale="linear" if unit == "dB" else "log", yticks=range(len(names)), xlabel=unit)
        axes.set_yticklabels(names, fontsize=7)
        axes.invert_yaxis()
        axes.margins(x=0.12)
        axes.grid(axis="x", alpha=0.3)
    if len(series) > 1 or any(row.ratio for rows in series.values() for row in rows):
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=len(series) + 1, fontsize=7)
    figure.suptitle(title, fontsize=10, x=0.02, ha="left")
    figure.savefig(out, dpi=110)
    return sum(map(len, series.values()))
