"""Curves of an evaluation, where matplotlib is installed."""

import importlib.util
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from endo_sim_ros.core.drawing import slug

log = logging.getLogger(__name__)

_IN_THE_PLOT = 6  # methods that a legend has room for beside the lines


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def write(summaries: Sequence, out: Path) -> None:
    """Write every plot as `plots/*.png` below the folder of results."""
    if not available():
        log.info("no plots without matplotlib; `pip install matplotlib` and the same command again draws them")
        return
    (out / "plots").mkdir(exist_ok=True)
    for key, figure in all_plots(summaries).items():
        figure.savefig(out / "plots" / f"{slug('-'.join(key))}.png", dpi=110)


def all_plots(summaries: Sequence) -> dict[tuple[str, str, str], Any]:
    """Figures of matplotlib by sequence, split and `views` or `time`."""
    found = {}
    for key in dict.fromkeys((s.sequence, s.split) for s in summaries if s.cells):
        ours = [s for s in summaries if (s.sequence, s.split) == key and s.cells]
        found[(*key, "views")] = _lines(ours, "views", "view", "held-out view")
        if any(s.cells[0]["curve"] for s in ours):
            found[(*key, "time")] = _lines(ours, "curve", "seconds", "training time [s]")
    return found


def _lines(ours: Sequence, rows: str, x: str, x_label: str) -> Any:
    """Gain-fitted PSNR of each method's first seed over x."""
    from matplotlib.figure import Figure

    ours = [s for s in ours if s.cells[0][rows]]
    beside = len(ours) > _IN_THE_PLOT
    figure = Figure(figsize=(9 if beside else 6, max(3.2, 0.18 * len(ours) * beside)), layout="constrained")
    axes = figure.subplots()
    for s in ours:
        points = [row for row in s.cells[0][rows] if "psnr_gain" in row]
        axes.plot([p[x] for p in points], [p["psnr_gain"] for p in points], marker="." if len(points) < 60 else None, label=s.method)
    axes.set(xlabel=x_label, ylabel="PSNR, gain fitted [dB]")
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc="outside right upper") if beside else axes.legend(fontsize=8)
    return figure
