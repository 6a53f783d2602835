"""A dataset in layout v2.1 of LeRobot, which Open-H asks for: the files of v3.0 under other names, and metadata as lines of JSON."""

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from endo_sim_ros.core.folders import leaving_none_empty, make_writable, naming
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.card import card_of_v21
from endo_sim_ros.learning.dataset import import_pyarrow, read_episodes, read_info, read_table, unreadable, video_columns, video_name

_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"


def to_v21(dataset: Path, out: Path) -> tuple[int, int]:
    """Copy a dataset that `DatasetWriter` wrote into layout v2.1; returns the numbers of its episodes and frames.

    Args:
        dataset: Folder of the dataset, whose episodes have files of their own.
        out: Folder of the new one.

    Raises:
        SequenceError: If the dataset cannot be read, or has several tasks, or several episodes in one file, or the folder exists or is in
            the dataset; nothing is left behind then.
        ValueError: If the folder takes no files.
        RuntimeError: If pyarrow is not installed.
    """
    pa = import_pyarrow()
    if dataset.resolve() in (out.resolve(), *out.resolve().parents):
        raise SequenceError(f"{out} is in the dataset itself; give the copy a folder of its own")
    if out.exists():
        raise SequenceError(f"{out} exists already; choose another name or remove it first")
    with leaving_none_empty(out):
        make_writable(out)  # before any work
    info = read_info(dataset)
    episodes = read_episodes(dataset, info)
    try:
        tasks = sorted({task for row in episodes for task in row["tasks"]})
        if len(tasks) != 1:
            raise SequenceError(f"{dataset} has {len(episodes)} episodes of {len(tasks)} tasks; give one with episodes of one task")
        _copy_files(dataset, out, info, episodes)
        _write_meta(dataset, out, info, episodes, tasks[0])
    except BaseException as error:  # half a dataset would only be in the way of the next try
        shutil.rmtree(out, ignore_errors=True)
        wrong = FileNotFoundError, NotADirectoryError, KeyError, TypeError, AttributeError, json.JSONDecodeError, pa.ArrowException
        if isinstance(error, wrong):
            raise unreadable(dataset, error) from error
        raise
    return len(episodes), sum(row["length"] for row in episodes)


def _copy_files(dataset: Path, out: Path, info: dict[str, Any], episodes: Iterable[dict[str, Any]]) -> None:
    """Tables and videos, each of one episode."""
    parquet = import_pyarrow().parquet
    features = {key: _kind(feature) for key, feature in info["features"].items() if feature["dtype"] != "video"}
    kinds = json.dumps({"info": {"features": features}})
    videos = video_columns(info["features"])
    for row in episodes:
        number = row["episode_index"]
        new = {"episode_chunk": number // info["chunks_size"], "episode_index": number}
        table = read_table(dataset, info, row)
        path = _made(out / _DATA.format(**new))
        with naming(path):
            parquet.write_table(table.replace_schema_metadata({"huggingface": kinds}), path)
        for key in videos:
            shutil.copyfile(dataset / video_name(info, row, key), _made(out / _VIDEO.format(video_key=key, **new)))


def _made(path: Path) -> Path:
    """A path, in a folder that is there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _kind(feature: dict[str, Any]) -> dict[str, Any]:
    """What the library datasets is to take a column of a table for: readers of v2.1 do not tell it."""
    if feature["dtype"] == "image":
        return {"_type": "Image"}
    value = {"dtype": feature["dtype"], "_type": "Value"}
    single = feature["shape"] == [1] and feature["names"] is None
    return value if single else {"feature": value, "length": feature["shape"][0], "_type": "Sequence"}


def _write_meta(dataset: Path, out: Path, info: dict[str, Any], episodes: list[dict[str, Any]], task: str) -> None:
    """What describes all: info.json, and a line for each episode, its statistics and each task."""
    videos = len(video_columns(info["features"]))
    kept = {name: value for name, value in info.items() if not name.endswith("_size_in_mb")}
    own = {
        "codebase_version": "v2.1",
        "total_videos": videos * len(episodes),
        "total_chunks": -(-len(episodes) // info["chunks_size"]),
        "data_path": _DATA,
        "video_path": _VIDEO if videos else None,
    }
    _made(out / "meta/info.json").write_text(json.dumps(kept | own, indent=4, ensure_ascii=False), "utf8")
    _write_lines(out / "meta/tasks.jsonl", [{"task_index": 0, "task": task}])
    _write_lines(out / "meta/episodes.jsonl", [{name: row[name] for name in ("episode_index", "tasks", "length")} for row in episodes])
    statistics = []
    for row in episodes:
        found: dict[str, dict[str, Any]] = {}
        for name, value in row.items():
            if name.startswith("stats/"):
                _, key, what = name.split("/")
                found.setdefault(key, {})[what] = value
        statistics.append({"episode_index": row["episode_index"], "stats": found})
    _write_lines(out / "meta/episodes_stats.jsonl", statistics)
    for name in ("README.md", "meta/README.md"):
        if (dataset / name).exists():
            (out / name).write_text(card_of_v21((dataset / name).read_text("utf8"), out.name), "utf8")


def _write_lines(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows), "utf8")
