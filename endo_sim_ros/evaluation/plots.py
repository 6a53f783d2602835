"""Curves of an evaluation, where matplotlib is installed."""

import importlib.util
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from endo_sim_ros.evaluation.figures import slug

log = logging.getLogger(__name__)

_NAMES = {"views": "PSNR of each held-out view", "time": "PSNR over training time"}


def available() -> bool:
    return importlib.util.find_spec("matplotlib") is not None


def write(summaries: Sequence, out: Path) -> None:
    """Write every plot as `plots/*.png` below the folder of results."""
    if not available():
        log.info("no plots without matplotlib; `pip install matplotlib` and the same command again draws them")
        return
    (out / "plots").mkdir(exist_ok=True)
    for name, figure in all_plots(summaries).items():
        figure.savefig(out / "plots" / f"{slug(name)}.png", dpi=110)


def all_plots(summaries: Sequence) -> dict[str, Any]:
    """Figures of matplotlib by title, for each split of each sequence."""
    found = {}
    for key in dict.fromkeys((s.sequence, s.split) for s in summaries):
        ours = [s for s in summaries if (s.sequence, s.split) == key and s.cells]
        if not ours:
            continue
        found[f"{', '.join(key)}: {_NAMES['views']}"] = _lines(
            ours, lambda cell: cell["views"], "view", "psnr_gain", "held-out view", "PSNR, gain fitted [dB]"
        )
        if any(s.cells[0]["curve"] for s in ours):
            found[f"{', '.join(key)}: {_NAMES['time']}"] = _lines(
                ours, lambda cell: cell["curve"], "seconds", "psnr_gain", "training time [s]", "PSNR, gain fitted [dB]"
            )
    return found


def _lines(ours: Sequence, points: Callable, x: str, y: str, x_label: str, y_label: str) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    for s in ours:
        rows = points(s.cells[0])
        axes.plot([row[x] for row in rows], [row[y] for row in rows], marker="." if len(rows) < 60 else None, label=s.method)
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
