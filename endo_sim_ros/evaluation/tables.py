"""The results of an evaluation as tables for people and files for machines."""

import csv
import statistics
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from endo_sim_ros.core import drawing
from endo_sim_ros.evaluation import plots
from endo_sim_ros.evaluation.held_out import FIGURES, Figure
from endo_sim_ros.evaluation.measurement import Row, write_rows
from endo_sim_ros.evaluation.paper import PRINTED, Printed
from endo_sim_ros.evaluation.splits import explain_split

COLUMNS = FIGURES | {
    "psnr_deformed": Figure("PSNR, deformed", "dB", 2),
    "psnr_deformed_truth": Figure("PSNR, deformed, against truth", "dB", 2),
    "psnr_undeformed": Figure("the same pixels at rest", "dB", 2),
    "seconds": Figure("training", "s", 1),
    "gaussians": Figure("Gaussians", "", 0),
    "megabytes": Figure("peak memory", "MB", 0),
}
_IN_TERMINAL = (
    "psnr", "psnr_gain", "ssim", "lpips_alex", "lpips_vgg", "seen_psnr_gain",
    "depth_rmse", "depth_share", "points_depth", "seconds", "gaussians",
)  # fmt: skip
BASELINE = "3dgs"  # what ratios are to
_STRIP_WIDTH = 320  # of each picture in a strip, pixels


class Summary(NamedTuple):
    """All seeds of one method on one split of one sequence."""

    sequence: str
    split: str
    method: str
    means: dict[str, float]
    spreads: dict[str, float]  # standard deviation, of two seeds or more
    cells: list[dict[str, Any]]  # those that did not fail
    errors: list[str]

    @property
    def seeds(self) -> str:
        """How many seeds succeeded, and of how many if one failed."""
        return str(len(self.cells)) if not self.errors else f"{len(self.cells)} of {len(self.cells) + len(self.errors)}"

    def text(self, name: str, missing: Iterable[str] = ()) -> str:
        """A figure as it stands in a table."""
        if name not in self.means:
            return "no weights" if name.removeprefix("seen_") in missing and self.cells else "–"
        digits = COLUMNS[name].digits
        spread = f" ± {self.spreads[name]:.{digits}f}" if name in self.spreads else ""
        return f"{self.means[name]:.{digits}f}{spread}"


def summarise(results: dict[str, Any]) -> list[Summary]:
    """Means and spreads over the seeds, in the order of the cells."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for record in results["cells"]:
        cell = record["cell"]
        groups.setdefault((cell["sequence"], cell["split"], cell["method"]), []).append(record)
    found = []
    for key, records in groups.items():
        done = [record for record in records if record["error"] is None]
        values = {name: [r["figures"][name] for r in done if r["figures"].get(name) is not None] for name in COLUMNS}
        means = {name: statistics.fmean(each) for name, each in values.items() if each}
        spreads = {name: statistics.stdev(each) for name, each in values.items() if len(each) > 1}
        found.append(Summary(*key, means, spreads, done, [r["error"] for r in records if r["error"] is not None]))
    return found


def printed_rows(split: str, methods: Iterable[str]) -> list[Printed]:
    """What the paper prints for a split: its method and the five that it compares with, and of its ablation what is in the run."""
    return [row for row in PRINTED if row.split == split and (" " not in row.method or row.method in methods)]


def printed_text(row: Printed, name: str) -> str:
    """A figure of the paper as it stands in a table."""
    marks = {"lpips_alex": "†", "lpips_vgg": "†", "depth_rmse": "‡"}
    value = row.figures.get(name)
    return "–" if value is None else f"{value:.{min(COLUMNS[name].digits, 3)}f}{marks.get(name, '')}"


def shown_columns(summaries: list[Summary], missing: Iterable[str]) -> list[str]:
    """The columns that have something in them, and PSNR in any case."""
    return [n for n in COLUMNS if n == "psnr" or any(n in s.means for s in summaries) or n.removeprefix("seen_") in missing]


def notes(results: dict[str, Any]) -> list[str]:
    """What a reader must know to read the table."""
    done = [record for record in results["cells"] if record["error"] is None]
    sequences: dict[str, dict] = {}
    for record in done:
        sequences.setdefault(record["cell"]["sequence"], record)
    lines = [f"Measured on {', '.join(dict.fromkeys(record['machine'] for record in done)) or results['machine']}."]
    depths = {
        "recorded": "the recorded depth",
        "stereo matching": "stereo matching of the held-out view with its right image, which is no ground truth",
        "none": "none",
    }
    for name, record in sequences.items():
        width, height = record["size"]
        pixels = "over the pixels of the mask (tissue); the others are black" if record["masked"] else "over all pixels, unmasked"
        given = f"; training views came with {' and '.join(record['given'])}" if record["given"] else ""
        lines.append(f"{name}: {width}×{height}, {pixels}; reference depth: {depths[record['depth_source']]}{given}.")
        if (off := record.get("reference_at_points")) is not None:
            lines.append(f"{name}: at the scene points that judge depth, that reference is itself off by {1e3 * off:.2f} mm.")
    models = any(record["seen_by"] == "model" for record in done)
    lines += [
        "PSNR, gain fitted: after one factor per colour channel and view, as exposure would. Means over the held-out views.",
        "Methods with an exposure take that of a held-out view from its brightness as rendered and from when it was taken.",
        "PSNR, deformed: over the pixels that change while a jaw moves the tissue; the reference is the model's own picture at rest, "
        "deformed with its surface.",
        "Against truth: over the pixels that change when a synthetic patient is pulled by 12 mm and filmed anew; of a patient at rest.",
        "Seen: pixels with a depth whose surface a training view shows, too, visibility checked with the reference depth"
        + ("; without one, with the model's own." if models else "."),
        "Depth RMSE: over the pixels where both have depth. Has depth: the share of those with reference depth.",
        "Median scaled: depth times the factor that makes its median right. Depth stays in floating point throughout.",
        "Training: all that happens between the views and the model. Memory: what the training needed at most, more than before.",
    ]
    methods = dict.fromkeys(r["cell"]["method"] for r in done if r["cell"]["options"].get("initialization") == "points")
    start = f"; {', '.join(methods)} start from them" if methods else ""
    lines.append(
        "Every training got scene points that all views show with their known poses, the held-out ones too, as the papers' structure "
        f"from motion does{start}. Finding them is not in the training time."
    )
    if any("points_depth" in record["figures"] for record in done):
        lines.append("Depth at scene points: median difference from a tenth of them, kept from all methods, where no depth is recorded.")
    lines += [f"{text}." for text in results["missing"].values()]
    if any(printed_rows(record["cell"]["split"], ()) for record in done):
        lines += [
            "The paper's rows are as printed there, of its own data and hardware (minutes on an RTX 3090); differences between methods "
            "compare, not the numbers.",
            "† Backbone not stated; the same number stands under both. ‡ Unit, scaling and reference not stated.",
        ]
    return lines


def write(results: dict[str, Any], out: Path, json_file: Path | None) -> None:
    """Print the table and why cells failed; write table.md, table.csv, views.csv, strips, plots and, if asked for, rows for machines."""
    summaries = summarise(results)
    (out / "table.md").write_text(markdown(results, summaries))
    _write_csv(results, summaries, out)
    _write_strips(summaries, out)
    plots.write(summaries, out)
    if json_file is not None:
        write_rows(machine_rows(summaries), json_file)
    Console(width=None if sys.stdout.isatty() else 150).print(_terminal_table(summaries, results["missing"]))
    for sentence in failures(results):
        print(sentence)


def failures(results: dict[str, Any]) -> list[str]:
    """Why cells failed: a sentence for each reason in a sequence, which names what the cells with that reason alone share."""
    parts = lambda cell: (cell["split"], cell["method"], f"seed {cell['seed']}")
    all_parts = [set(each) for each in zip(*(parts(record["cell"]) for record in results["cells"]))]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for record in results["cells"]:
        if record["error"] is not None:
            reason = next(iter(record["error"].splitlines()), "without a reason")
            groups.setdefault((record["cell"]["sequence"], reason), []).append(record["cell"])
    sentences = []
    for (sequence, reason), cells in groups.items():
        several = len(cells) > 1
        theirs = [set(each) for each in zip(*map(parts, cells))]
        shared = [min(names) for names, every in zip(theirs, all_parts) if len(names) == 1 and (names != every or not several)]
        sentences.append(f"{', '.join([sequence, *shared])}{f': {len(cells)} cells' * several} failed: {reason}")
    return sentences


def markdown(results: dict[str, Any], summaries: list[Summary]) -> str:
    """One table per split, ours and the paper's, and notes."""
    missing, methods = results["missing"], {s.method for s in summaries}
    columns = shown_columns(summaries, missing)
    lines = ["# Evaluation", "", f"{results['date']}, {results['machine']}."]
    for split in dict.fromkeys(s.split for s in summaries):
        titles = [COLUMNS[name].title for name in columns]
        lines += ["", f"## {split}", "", explain_split(split), "", "| sequence | method | " + " | ".join(titles) + " | seeds |"]
        lines.append("|---|---|" + "---:|" * (len(columns) + 1))
        for summary in (s for s in summaries if s.split == split):
            cells = [summary.sequence, summary.method]
            if summary.cells:
                cells += [summary.text(name, missing) for name in columns] + [summary.seeds]
            else:
                cells += [f"failed: {_one_line(summary.errors[0])}"] + [""] * (len(columns) - 1) + [summary.seeds]
            lines.append("| " + " | ".join(cells) + " |")
        for row in printed_rows(split, methods):
            cells = [f"the paper's, {row.dataset}", row.method, *(printed_text(row, name) for name in columns), ""]
            lines.append("| " + " | ".join(cells) + " |")
    failed = [(s, error) for s in summaries for error in s.errors if s.cells]
    lines += [""] + [f"- {s.sequence}, {s.split}, {s.method}: a seed failed: {_one_line(error)}" for s, error in failed]
    return "\n".join([*lines, *(f"- {note}" for note in notes(results))]) + "\n"


def _one_line(text: str) -> str:
    return " ".join(text.split()).replace("|", "/")


def machine_rows(summaries: list[Summary]) -> list[Row]:
    """Every mean as a row; the ratio is to the baseline on the same split of the same sequence."""
    baseline = {(s.sequence, s.split): s.means for s in summaries if s.method == BASELINE}
    rows = []
    for s in summaries:
        peers = baseline.get((s.sequence, s.split), {}) if s.method != BASELINE else {}
        for name, value in s.means.items():
            ratio = value / peers[name] if peers.get(name) else None
            label = f"{s.sequence}, {s.split}, {s.method}: {COLUMNS[name].heading}"
            rows.append(Row(label, value, COLUMNS[name].unit, ratio, BASELINE if ratio is not None else None))
    return rows


def _write_csv(results: dict[str, Any], summaries: list[Summary], out: Path) -> None:
    with (out / "table.csv").open("w", newline="") as file:
        columns = [name for base in COLUMNS for name in (base, f"{base}_sd")]
        writer = csv.DictWriter(file, ["source", "sequence", "split", "method", "seeds", "error", *columns], restval="")
        writer.writeheader()
        for s in summaries:
            row = {"source": "measured", "sequence": s.sequence, "split": s.split, "method": s.method, "seeds": len(s.cells)}
            row |= {"error": "; ".join(s.errors)} | s.means | {f"{name}_sd": value for name, value in s.spreads.items()}
            writer.writerow(row)
        for split in dict.fromkeys(s.split for s in summaries):
            for row in printed_rows(split, {s.method for s in summaries}):
                labels = {"source": "printed in the paper", "sequence": row.dataset, "split": split, "method": row.method}
                writer.writerow(labels | row.figures)
    with (out / "views.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["sequence", "split", "method", "seed", "view", *FIGURES], restval="")
        writer.writeheader()
        for record in results["cells"]:
            for row in record.get("views", ()):
                writer.writerow({name: record["cell"][name] for name in ("sequence", "split", "method", "seed")} | row)


def _terminal_table(summaries: list[Summary], missing: Iterable[str]) -> Table:
    table = Table()
    columns = [name for name in shown_columns(summaries, missing) if name in _IN_TERMINAL]
    for heading in ("sequence", "split", "method"):
        table.add_column(heading, overflow="fold")  # their ends tell names apart
    for name in columns:
        table.add_column(COLUMNS[name].title, justify="right")
    for s in summaries:
        texts = [s.text(name, missing) for name in columns] if s.cells else ["failed"]
        table.add_row(s.sequence, s.split, s.method, *texts)
    return table


# ----------------------------------------------------------------------------------------------------------- pictures


Pictures = dict[tuple[str, str], str]  # (method, or nothing for what was recorded; kind) → path below the folder of results


def comparisons(summaries: list[Summary]) -> dict[tuple[str, str], dict[str, Pictures]]:
    """Pictures of the first seeds, by sequence and split and then by view."""
    found: dict[tuple[str, str], dict[str, Pictures]] = {}
    for s in summaries:
        for name, path in s.cells[0]["pictures"].items() if s.cells else ():
            view, kind = name.split("-", 1)
            pictures = found.setdefault((s.sequence, s.split), {}).setdefault(view, {})
            pictures["" if kind.startswith("reference") else s.method, kind] = path
    return found


def _write_strips(summaries: list[Summary], out: Path) -> None:
    """A picture for each split: the held-out view, and what each method makes of it; below, depth."""
    (out / "strips").mkdir(exist_ok=True)
    for (sequence, split), views in comparisons(summaries).items():
        methods = [s.method for s in summaries if (s.sequence, s.split) == (sequence, split) and s.cells]
        cells = []
        for view, paths in views.items():
            for kind, reference in (("rendered", "reference"), ("depth", "reference_depth")):
                keys = [("", reference), *((method, kind) for method in methods)]
                images = [small_picture(out / paths[key], _STRIP_WIDTH) if key in paths else None for key in keys]
                blank = np.zeros_like(next(image for image in images if image is not None))
                depth = "no depth to compare with" if images[0] is None else "its depth"
                labels = [f"view {int(view)}" if kind == "rendered" else depth, *methods]
                cells += [(label, blank if image is None else image) for label, image in zip(labels, images)]
        drawing.write_png(out / "strips" / f"{drawing.slug(f'{sequence}-{split}')}.png", drawing.sheet(cells, len(methods) + 1))


def small_picture(path: Path, width: int) -> np.ndarray:
    """A picture of the folder of results, RGB [H, W, 3] uint8, at most so many pixels wide.

    Raises:
        ValueError: If it cannot be read.
    """
    image = cv2.imread(str(path))
    if image is None:
        raise ValueError(f"{path}: the picture is missing or damaged; remove its record from cells/ and evaluate again")
    scale = min(width / image.shape[1], 1.0)
    return cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
