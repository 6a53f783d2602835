"""`endo-sim report`: an evaluation as one HTML page that needs nothing else."""

import base64
import io
import json
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from endo_sim_ros.core import drawing
from endo_sim_ros.evaluation import plots, tables
from endo_sim_ros.evaluation.splits import explain_split
from endo_sim_ros.evaluation.tables import COLUMNS, Pictures, Summary

_WIDTH = 480  # of pictures in the page, pixels
_QUALITY = 82
_MORE_IS_BETTER = ("psnr", "ssim")
_LESS_IS_BETTER = ("lpips", "depth")
_KINDS = ("rendered", "difference", "depth")
_RECORDED = {"rendered": "reference", "depth": "reference_depth"}  # what stands beside them


def write_page(run: Path) -> Path:
    """Write `report.html` into the folder of an evaluation, and return its path.

    Raises:
        ValueError: If the folder holds no results of an evaluation, or matplotlib is not installed.
    """
    file = run / "results.json"
    try:
        results = json.loads(file.read_text())
        summaries = tables.summarise(results)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file}: no results of an evaluation ({type(error).__name__}); give the --out of `endo-sim evaluate`") from error
    if not plots.available():
        raise ValueError("the report has plots, which need matplotlib: pip install matplotlib")
    images: dict[str, str] = {}
    body = [_table(summaries, split, results["missing"]) for split in dict.fromkeys(s.split for s in summaries)]
    body.append("<ul class=notes>" + "".join(f"<li>{escape(note)}</li>" for note in tables.notes(results)) + "</ul>")
    drawn, pictures = plots.all_plots(summaries), tables.comparisons(summaries)
    for sequence, split in dict.fromkeys((s.sequence, s.split) for s in summaries if s.cells):
        body.append(f"<h2>{escape(sequence)}, {escape(split)}</h2>")
        ours = [figure for key, figure in drawn.items() if key[:2] == (sequence, split)]
        body.append(f"<div class=plots>{''.join(map(_svg, ours))}</div>")
        body.append(_pictures(run, f"{sequence}/{split}", pictures.get((sequence, split), {}), images))
    page = resources.files("endo_sim_ros.evaluation").joinpath("page.html").read_text()
    parts = {
        "title": "Evaluation",
        "subtitle": escape(f"{results['date']}, {results['machine']}"),
        "body": "\n".join(body),
        "images": json.dumps(images),
    }
    for name, text in parts.items():
        page = page.replace(f"{{{{{name}}}}}", text)
    out = run / "report.html"
    out.write_text(page)
    return out


def _table(summaries: list[Summary], split: str, missing: dict[str, str]) -> str:
    """The table of one split; a click on a heading sorts it."""
    ours = [s for s in summaries if s.split == split]
    columns = tables.shown_columns(summaries, missing)
    best = {(s.sequence, name): _best(name, [o for o in ours if o.sequence == s.sequence]) for s in ours for name in columns}
    rows = []
    for s in ours:
        cells = [f"<td>{escape(s.sequence)}</td><td>{escape(s.method)}</td>"]
        for name in columns if s.cells else ():
            mark = " class=best" if s.means.get(name) is not None and s.means[name] == best[s.sequence, name] else ""
            cells.append(f"<td{mark}{_value(s.means.get(name))}>{escape(s.text(name, missing))}</td>")
        if not s.cells:
            cells.append(f"<td class=failed colspan={len(columns)}>failed: {escape(s.errors[0])}</td>")
        rows.append(f"<tr>{''.join(cells)}<td>{s.seeds}</td></tr>")
    for row in tables.printed_rows(split, {s.method for s in ours}):
        cells = "".join(f"<td{_value(row.figures.get(name))}>{tables.printed_text(row, name)}</td>" for name in columns)
        rows.append(f"<tr class=paper><td>the paper's, {row.dataset}</td><td>{escape(row.method)}</td>{cells}<td data-none=1></td></tr>")
    titles = ["sequence", "method", *(COLUMNS[name].title for name in columns), "seeds"]
    head = "".join(f"<th>{escape(title)}</th>" for title in titles)
    return (
        f"<h2>split {escape(split)}</h2><p>{escape(explain_split(split))}</p><div class=scroll><table><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _value(value: float | None) -> str:
    return " data-none=1" if value is None else f" data-value={value!r}"


def _best(name: str, ours: list[Summary]) -> float | None:
    """The best of a figure among the methods on one sequence, if one of them can be."""
    values = [s.means[name] for s in ours if name in s.means]
    base = name.removeprefix("seen_")
    if len(values) < 2 or not base.startswith(_MORE_IS_BETTER + _LESS_IS_BETTER):
        return None
    return max(values) if base.startswith(_MORE_IS_BETTER) else min(values)


def _svg(figure: Any) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg")
    return text.getvalue()[text.getvalue().index("<svg") :]


def _pictures(run: Path, key: str, views: dict[str, Pictures], images: dict[str, str]) -> str:
    """Two pictures of a view with a slider between them, and all of them in rows; adds the pictures to ``images``."""
    if not views:
        return ""
    for view, paths in views.items():
        images |= {f"{key}/{view}/{_label(name)}": _data(run / path) for name, path in paths.items()}
    names = dict.fromkeys(name for paths in views.values() for name in paths)
    methods = list(dict.fromkeys(method for method, _ in names if method))
    ordered = [name for name in names if not name[0]] + [(method, kind) for kind in _KINDS for method in methods]

    def choice(of: str, chosen: tuple[str, str]) -> str:
        options = "".join(f"<option{' selected' * (name == chosen)}>{escape(_label(name))}</option>" for name in ordered)
        return f"<select aria-label={of}>{options}</select>"

    rows = []
    for view, paths in views.items():
        for kind in _KINDS:
            row = [("", _RECORDED.get(kind, "")), *((method, kind) for method in methods)]
            shown = (_figure(key, view, name) if name in paths else "<figure></figure>" for name in row)
            rows.append(f"<div class=grid>{''.join(shown)}</div>")
    return f"""<div class=compare data-key="{escape(key)}">
<select aria-label=view>{"".join(f"<option value={view}>view {int(view)}</option>" for view in views)}</select>
{choice("left", ("", _RECORDED["rendered"]))} | {choice("right", (methods[-1], "rendered"))}
<div class=stage><img class=right alt=""><img class=left alt=""></div>
<input type=range min=0 max=100 value=50 aria-label="where the pictures meet"></div>
<details><summary>all pictures: rendered, difference × 3, depth</summary>{"".join(rows)}</details>"""


def _figure(key: str, view: str, name: tuple[str, str]) -> str:
    image = f'<img alt="" data-key="{escape(f"{key}/{view}/{_label(name)}")}">'
    return f"<figure>{image}<figcaption>view {int(view)}, {escape(_label(name))}</figcaption></figure>"


def _label(name: tuple[str, str]) -> str:
    return ", ".join(filter(None, name)).replace("_", " ")


def _data(path: Path) -> str:
    """A picture as an address that holds it."""
    data = drawing.jpeg(tables.small_picture(path, _WIDTH), _QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()
