"""Writes a LeRobot dataset, layout v3.0: tables in parquet, images as video or PNG, metadata in json and parquet.

Written here and not by the lerobot library, which wants older torch, numpy and OpenCV than this package runs with; tests
read the result with it where it is installed. Each episode has files of its own, so that a dataset can be continued.
"""

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import chain, islice, takewhile
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rich.progress import track

from endo_sim_ros.core import drawing
from endo_sim_ros.core.device import cpu_threads
from endo_sim_ros.core.folders import naming, written_whole
from endo_sim_ros.core.frames import SequenceError

_logger = logging.getLogger(__name__)

VERSION = "v3.0"
IMAGE = "observation.images.endoscope.left"
IMAGE_RIGHT = "observation.images.endoscope.right"
SEGMENTATION = "observation.segmentation"
OPTIONS = "meta/demonstrations.json"  # what the episodes of demonstrations depend on
_SIGHT = {"shown_tool": "tool", "instrument": "instrument", "baseline": "baseline", "dye": "dye"}  # of these, what pictures show
STATE, ENVIRONMENT_STATE, ACTION = "observation.state", "observation.environment_state", "action"
# As Open-H recommends them: every joint of the arms, and the pose and the jaw that are asked for.
JOINT_POSITIONS, COMMAND = "observation.state.joint_positions", "action.cartesian_absolute"
CAMERA_POSE = "observation.camera_pose"
_RENAMED = {"command.pose": COMMAND, "observation.joints": JOINT_POSITIONS}  # columns that older versions wrote
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_ASIDE = "set_aside"  # folder of files that a dataset does not tell of
_TASKS, _STATS = "meta/tasks.parquet", "meta/stats.json"
_INFO, _HISTOGRAMS = "meta/info.json", "meta/image_histograms.npz"  # the latter to continue with
_COPY = "copy the dataset again, if it was cut off on its way"
_CHUNK_SIZE = 1000  # files in a folder
# Every second frame is a key frame, so that any is found fast; without frames out of order times begin at zero.
_CODEC_OPTIONS = {"g": "2", "bf": "0", "crf": "18"}
_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_GROUP = 256  # rows that are written together with their png images
_SAMPLE = 150  # pixels along the longer side of an image that count in its statistics
_INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")

ImageFormat = Literal["video", "png"]


def import_pyarrow() -> Any:
    """The library that writes tables.

    Raises:
        RuntimeError: If it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise RuntimeError("a LeRobot dataset needs pyarrow, which is not installed; pip install 'endo_sim_ros[lerobot]'") from error
    return pyarrow


def vector_feature(names: Sequence[str]) -> dict[str, Any]:
    """What a column of vectors with these names is."""
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def scalar_feature(dtype: str) -> dict[str, Any]:
    """What a column of numbers, or of texts (``string``), is."""
    return {"dtype": dtype, "shape": [1], "names": None}


def picture_feature(key: str, size: tuple[int, int], fps: int, images: ImageFormat) -> dict[str, Any]:
    """What a column of pictures of a size (height, width) is; labels are kept exactly, whatever the images are."""
    (height, width), channels = size, 1 if key == SEGMENTATION else 3
    kind = "image" if images == "png" or key == SEGMENTATION else "video"
    feature: dict[str, Any] = {"dtype": kind, "shape": [height, width, channels], "names": ["height", "width", "channels"]}
    if kind == "video":
        feature["info"] = {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": channels,
            "has_audio": False,
        }
    return feature


def check_sides(height: int, width: int) -> None:
    """Raise SequenceError if pictures of a size make no video."""
    if height % 2 or width % 2:
        raise SequenceError(f"{width}×{height} images make no video, which needs even sides; choose --images png, or another width")


class DatasetWriter:
    """Writes a dataset, episode by episode, and continues one that was begun with the same features.

    Args:
        root: Its folder.
        task: What is done, in words.
        fps: Rows per second.
        features: What its columns are, beside the indices that every dataset has.

    Raises:
        SequenceError: If there is another dataset in the folder, or it is damaged or cut off, or videos have odd sides.
        RuntimeError: If pyarrow is not installed.
    """

    def __init__(self, root: Path, task: str, fps: int, features: Mapping[str, dict[str, Any]]):
        self.task, self._root, self._fps, self._pa = task, root, fps, import_pyarrow()
        kinds = {name: "float32" if name == "timestamp" else "int64" for name in _INDICES}
        self.features = {**features, **{name: scalar_feature(kind) for name, kind in kinds.items()}}
        self._pictures = [key for key, feature in features.items() if feature["dtype"] in ("image", "video")]
        self._videos = video_columns(features)
        for key in self._videos:
            drawing.check_video()
            check_sides(*features[key]["shape"][:2])
        self.saved = 0  # episodes that the dataset tells of
        self._rows: list[dict[str, Any]] = []
        self._columns: list[dict[str, np.ndarray]] = []
        self._histograms: list[dict[str, np.ndarray]] = []
        if (root / _INFO).exists():
            self._continue()
        elif held := [name for name in ("data", "videos", _EPISODES) if (root / name).exists()]:
            what = f"{root} has {', '.join(held)}, but no {_INFO}, which is written first: a copy that was cut off"
            raise SequenceError(f"{what}; copy the dataset again, choose another name, or remove the folder")
        # What a process that was killed had not told of yet: readers look into all files.
        told = {self._root / name for number in range(self.saved) for name in self._files(number)}
        untold = {*root.glob("data/*/*"), *root.glob("videos/*/*/*")} - told
        for path in untold:
            aside = root / _ASIDE / path.relative_to(root)
            aside.parent.mkdir(parents=True, exist_ok=True)
            path.replace(aside)
        if untold:
            left = f"{len(untold)} files that {_INFO} does not tell of, as a run that was killed leaves them"
            _logger.warning("%s: %s, are in %s now; nothing here needs them", root, left, root / _ASIDE)

    @property
    def episodes(self) -> int:
        """Number of episodes so far."""
        return len(self._rows)

    @property
    def frames(self) -> int:
        """Number of rows so far."""
        return self._rows[-1]["dataset_to_index"] if self._rows else 0

    def column(self, name: str) -> np.ndarray:
        """A column of numbers of all episodes so far."""
        return np.concatenate([columns[name] for columns in self._columns]) if self._columns else np.zeros(0)

    def add(self, *episodes: tuple[dict[str, np.ndarray], Mapping[str, Iterable[np.ndarray]]]) -> None:
        """Write episodes, one on each core at a time.

        Args:
            episodes: Of each its columns, numbers [T] and vectors [T, D], and T pictures of each kind.
        """
        placed, first, begin = [], self.episodes, self.frames
        for number, (columns, pictures) in enumerate(episodes, first):
            frames = np.arange(len(next(iter(columns.values()))))
            own = columns | {
                "timestamp": (frames / self._fps).astype(np.float32),
                "frame_index": frames,
                "episode_index": np.full_like(frames, number),
                "index": begin + frames,
                "task_index": np.zeros_like(frames),
            }
            placed.append((number, own, pictures))
            begin += len(frames)
        if not (self._root / _INFO).exists():  # before all else: with it, files that it does not tell of are those of a killed process
            self._write_json(_INFO, self._info())
        try:
            for (number, own, _), histograms in zip(placed, self._write_all(placed)):
                count = len(own["index"])
                self._rows.append(self._row(number, self.frames, count) | _flat(_statistics(own, histograms, count)))
                self._columns.append(own)
                self._histograms.append(histograms)
        except BaseException:
            self._drop(len(self._histograms), first + len(placed))
            raise

    def save(self) -> None:
        """Write what describes all episodes so far; without it the newest are not part of the dataset."""
        if not self.episodes:
            return
        merged = {key: self.column(key) for key in self._columns[0]}
        histograms: dict[str, Any] = {key: np.stack([each[key] for each in self._histograms]) for key in self._histograms[0]}
        statistics = _statistics(merged, {key: each.sum(0) for key, each in histograms.items()}, self.frames)
        try:
            with written_whole(self._path(_HISTOGRAMS)) as partial, partial.open("wb") as file:
                np.savez_compressed(file, **histograms)
            self._write_table(_EPISODES, {key: self._pa.array([row[key] for row in self._rows]) for key in self._rows[0]})
            self._write_tasks()  # each time: a copy may have been cut off
            self._write_json(_STATS, statistics)
            self._write_json(_INFO, self._info())  # last: it tells how many there are
        except OSError:  # no room; what was saved before still is
            self._drop(self.saved, self.episodes)
            raise
        self.saved = self.episodes

    def _drop(self, first: int, end: int) -> None:
        """Leave nothing of these episodes, as readers look into all files, and others may need the room."""
        for known in (self._rows, self._columns, self._histograms):
            del known[first:]
        for name in chain.from_iterable(map(self._files, range(first, end))):
            (self._root / name).unlink(missing_ok=True)

    def _files(self, number: int) -> list[str]:
        """Names of the files that an episode may have."""
        place = _place(number)
        return [_DATA.format(**place), *(_VIDEO.format(video_key=key, **place) for key in self._pictures)]

    def _continue(self) -> None:
        """Take up a dataset where it ends."""
        info = read_info(self._root)
        if old := [f"{name} is {new} now" for name, new in _RENAMED.items() if name in info["features"]]:
            raise SequenceError(f"{self._root} was begun by an older version ({', '.join(old)}); choose another name")
        if [info["features"], info.get("fps")] != json.loads(json.dumps([self.features, self._fps])):
            raise SequenceError(f"{self._root} has other columns, images or rates; choose another name")
        self._rows = self._read_rows(info)
        if other := {task for row in self._rows for task in row.get("tasks", ())} - {self.task}:
            raise SequenceError(f"{self._root} is of the task {min(other)!r}, not {self.task!r}; choose another name")
        if not all({*_names(info, row)} <= {*self._files(number)} for number, row in enumerate(self._rows)):  # else they would be set aside
            raise SequenceError(f"{self._root} has its files in other places than this command writes them; choose another name")
        numbers = [key for key in self.features if key not in self._pictures]
        tables = [read_table(self._root, info, row, numbers) for row in self._rows]
        try:
            self._columns = [{key: _from_column(table.column(key), self.features[key]) for key in numbers} for table in tables]
            if self._rows:
                with np.load(self._root / _HISTOGRAMS) as file:
                    self._histograms = [{key: file[key][number] for key in self._pictures} for number in range(len(self._rows))]
        except (OSError, KeyError, ValueError, IndexError) as error:
            raise SequenceError(f"{self._root}: its columns or {_HISTOGRAMS} are not those that {_INFO} tells of; {_COPY}") from error
        self.saved = len(self._rows)

    def _read_rows(self, info: dict[str, Any]) -> list[dict[str, Any]]:
        """Rows of the table of episodes, with those that a save which was interrupted had added to it alone."""
        rows, count = read_episodes(self._root, info, untold=True), info["total_episodes"]
        there = lambda row: all((self._root / name).exists() for name in _names(info, row))
        rows = [*rows[:count], *takewhile(there, rows[count:])]
        if len(rows) > count:
            _logger.warning("%s: %s tells of %d episodes, but %d were written; it goes on from these", self._root, _INFO, count, len(rows))
        return rows

    def _write_all(self, episodes: Sequence[tuple[int, dict, Mapping]]) -> Iterator[dict[str, np.ndarray]]:
        """What `_write_files` returns for each; encoding several at a time does not hold the interpreter."""
        if len(episodes) == 1:  # it has all cores, and is interrupted at once
            yield self._write_files(*episodes[0])
            return
        with ThreadPoolExecutor(cpu_threads()) as pool:
            yield from pool.map(partial(self._write_files, codec_options=_CODEC_OPTIONS | {"threads": "1"}), *zip(*episodes))

    def _write_files(
        self,
        number: int,
        columns: dict[str, np.ndarray],
        pictures: Mapping[str, Iterable[np.ndarray]],
        codec_options: dict[str, str] = _CODEC_OPTIONS,
    ) -> dict[str, np.ndarray]:
        """Write table and pictures of an episode and return the histograms [C, 256] of its pictures by their keys."""
        histograms, cells, count = {}, {}, len(columns["index"])
        table = self._pa.table({key: self._column(columns[key], self.features[key]) for key in columns})
        for key in self._pictures:
            histograms[key] = np.zeros((self.features[key]["shape"][2], 256), np.int64)
            counted = _counted(pictures[key], histograms[key])
            if self.features[key]["dtype"] == "image":
                cells[key] = counted
            else:
                path = self._path(_VIDEO.format(video_key=key, **_place(number)))
                drawing.write_video(path, counted, self._fps, codec_options)
        kind = self._pa.struct({"bytes": self._pa.binary(), "path": self._pa.string()})
        schema = table.schema
        for key in cells:
            schema = schema.append(self._pa.field(key, kind))
        path = self._path(_DATA.format(**_place(number)))
        with naming(path), self._pa.parquet.ParquetWriter(path, schema) as file:
            for begin in range(0, count, _GROUP):  # the images of a long episode do not fit into memory
                part = table.slice(begin, _GROUP)
                for key, shown in cells.items():
                    own = [{"bytes": _png(picture), "path": None} for picture in islice(shown, len(part))]
                    part = part.append_column(key, self._pa.array(own, kind))
                file.write_table(part)
        return histograms

    def _column(self, values: np.ndarray, feature: dict) -> Any:
        """Column of scalars [T], or of vectors [T, D]."""
        flat = self._pa.array(np.ascontiguousarray(values).reshape(-1))
        return flat if values.ndim == 1 else self._pa.FixedSizeListArray.from_arrays(flat, feature["shape"][0])

    def _row(self, number: int, begin: int, count: int) -> dict[str, Any]:
        """What the table of episodes tells of one."""
        place = _place(number)
        row = {
            "episode_index": number,
            "tasks": [self.task],
            "length": count,
            **{f"data/{name}": value for name, value in place.items()},
            "dataset_from_index": begin,
            "dataset_to_index": begin + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for key in self._videos:
            video = place | {"from_timestamp": 0.0, "to_timestamp": count / self._fps}
            row |= {f"videos/{key}/{name}": value for name, value in video.items()}
        return row

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": "endo_sim",
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": 1,
            "chunks_size": _CHUNK_SIZE,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": _DATA,
            "video_path": _VIDEO if self._videos else None,
            "features": self.features,
        }

    def _write_tasks(self) -> None:
        """One task; pandas, which reads the table, is told that its text is the index."""
        index = "__index_level_0__"
        column = {"metadata": None}
        pandas = {
            "index_columns": [index],
            "column_indexes": [],
            "columns": [
                {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"} | column,
                {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object"} | column,
            ],
            "pandas_version": "2.0.0",
        }
        columns = {"task_index": self._pa.array([0], self._pa.int64()), index: self._pa.array([self.task])}
        self._write_table(_TASKS, columns, {"pandas": json.dumps(pandas)})

    def _write_table(self, name: str, columns: dict[str, Any], metadata: dict[str, str] | None = None) -> None:
        with written_whole(self._path(name)) as partial:
            self._pa.parquet.write_table(self._pa.table(columns).replace_schema_metadata(metadata), partial)

    def _write_json(self, name: str, values: dict) -> None:
        plain = lambda value: value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
        with written_whole(self._path(name)) as partial:
            partial.write_text(json.dumps(values, indent=4, ensure_ascii=False, default=plain), "utf8")

    def _path(self, name: str) -> Path:
        path = self._root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def learned_from(root: Path) -> dict[str, Any]:
    """What a policy keeps of the demonstrations that it learned from: their ``task`` with its ``digest``, see `task_digest`, and as
    ``sight`` options of `SightConfig`, as far as they are known."""
    try:
        options = dict(json.loads((root / OPTIONS).read_text("utf8")))
    except (OSError, ValueError, TypeError):
        options = {}
    sight = {name: options[key] for key, name in _SIGHT.items() if key in options}
    return {"task": options.get("task", ""), "digest": options.get("task_digest", ""), "sight": sight}


def read_info(root: Path) -> dict[str, Any]:
    """What meta/info.json tells of a dataset.

    Raises:
        SequenceError: If there is no dataset, or it has another layout than v3.0.
    """
    try:
        info = json.loads((root / _INFO).read_text("utf8"))
        version, _ = info["codebase_version"], info["features"]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise unreadable(root, error) from error
    if version != VERSION:
        raise SequenceError(f"{root} is a LeRobot dataset {version}; give one of {VERSION}, as `endo-sim demonstrate` writes it")
    return info


def read_episodes(root: Path, info: dict[str, Any], untold: bool = False) -> list[dict[str, Any]]:
    """Rows of the table of episodes, each of which has files of its own; those that an interrupted save had added only if ``untold``.

    Raises:
        SequenceError: If the table cannot be read, or is not that of info.json, or one file has several episodes.
    """
    try:
        count, frames = int(info["total_episodes"]), int(info["total_frames"])
        begun = count or untold and (root / _EPISODES).exists()  # there is none before the first save
        rows = import_pyarrow().parquet.read_table(root / _EPISODES).to_pylist() if begun else []
        kinds = ["data", *(f"videos/{key}" for key in video_columns(info["features"]))]
        files = [{(row[f"{kind}/chunk_index"], row[f"{kind}/file_index"]) for row in rows} for kind in kinds]
        numbers, lengths = [row["episode_index"] for row in rows[:count]], [row["length"] for row in rows[:count]]
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:  # those of pyarrow are among them
        raise unreadable(root, error) from error
    if any(len(each) < len(rows) for each in files):
        several = f"{root} has several episodes in one file, as lerobot's own tools write them"
        raise SequenceError(f"{several}; give a dataset as `endo-sim demonstrate` or `endo-sim export` wrote it, with a file for each")
    if numbers != list(range(count)) or sum(lengths) != frames:
        told = f"{len(numbers)} of {count} episodes and {sum(lengths)} of {frames} rows that {_INFO} tells of"
        raise SequenceError(f"{root}: {_EPISODES} has {told}; {_COPY}")
    return rows if untold else rows[:count]


def read_table(root: Path, info: dict[str, Any], row: dict[str, Any], columns: Sequence[str] | None = None) -> Any:
    """Table of an episode, these columns or all, which has as many rows as the table of episodes says, and so have its videos.

    Args:
        root: Folder of the dataset.
        info: What `read_info` returns.
        row: Of the episode, one of those that `read_episodes` returns.
        columns: Names.

    Raises:
        SequenceError: If a file cannot be read, or is not that of this episode.
    """
    name, number = data_name(info, row), row["episode_index"]
    try:
        file = import_pyarrow().parquet.ParquetFile(root / name)  # in a fraction of the time that read_table takes for so few rows
        table = file.read(columns and list({*columns, "episode_index"}), use_threads=False)
        held = set(table.column("episode_index").unique().to_pylist())
    except (OSError, KeyError, ValueError, TypeError) as error:  # those of pyarrow are among them
        raise SequenceError(f"{root}: {name} cannot be read; {_COPY}") from error
    if held != {number} or len(table) != row["length"]:
        of = "/".join(map(str, sorted(held, key=str)))
        raise SequenceError(f"{root}: {name} has {len(table)} rows of episode {of} for {row['length']} of episode {number}; {_COPY}")
    for key in video_columns(info["features"]):
        _check_video(root, video_name(info, row, key), len(table))
    return table


def check_dataset(root: Path, info: dict[str, Any], columns: Iterable[str]) -> None:
    """Find out whether lerobot can learn from these columns of a dataset: all that it reads is there and agrees; reads no picture.

    Raises:
        SequenceError: As `read_episodes` and `read_table` do, and if there is no episode, tasks or statistics are missing, or there are
            files that the dataset does not tell of.
    """
    rows, parquet, name = _some_episodes(root, info), import_pyarrow().parquet, _TASKS
    try:
        whole = {*range(info["total_tasks"])} == {*parquet.read_table(root / name).column("task_index").to_pylist()}
        if whole:
            name = _STATS
            whole = json.loads((root / name).read_text("utf8")).keys() >= {*columns}
    except (OSError, KeyError, ValueError, TypeError, AttributeError):  # those of pyarrow are among them
        whole = False
    if not whole:
        again = "continue it by the command that wrote it, which writes this file anew"
        raise SequenceError(f"{root}: {name} is missing, or not that of this dataset; {_COPY}, or {again}")
    told = {root / data_name(info, row) for row in rows}
    for row in rows:
        read_table(root, info, row, ["episode_index"])
    tabled = parquet.read_metadata(root / _EPISODES).num_rows
    if untold := sorted({*root.glob("data/*/*.parquet")} - told) or [root / _EPISODES] * (tabled > len(rows)):
        left = f"has more than the {len(rows)} episodes that {_INFO} tells of, as a run that was killed or goes on leaves it"
        name = untold[0].relative_to(root)
        raise SequenceError(f"{root} {left} ({name}), and lerobot reads all; let the command that wrote it come to its end, or {_COPY}")


def _some_episodes(root: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    """What `read_episodes` returns; raises SequenceError as that, and if there is none."""
    rows = read_episodes(root, info)
    if not rows:
        raise SequenceError(f"{root} has no episodes; give one with some")
    return rows


def data_name(info: dict[str, Any], row: dict[str, Any]) -> str:
    """Name of the table of an episode, a row of those that `read_episodes` returns, in its dataset."""
    return info.get("data_path", _DATA).format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])


def video_name(info: dict[str, Any], row: dict[str, Any], key: str) -> str:
    """Name of the video of an episode that is the column of this name."""
    place = {name: row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
    return (info.get("video_path") or _VIDEO).format(video_key=key, **place)


def _names(info: dict[str, Any], row: dict[str, Any]) -> list[str]:
    """Names of all files of an episode."""
    return [data_name(info, row), *(video_name(info, row, key) for key in video_columns(info["features"]))]


def video_columns(features: Mapping[str, dict[str, Any]]) -> list[str]:
    """The columns that are videos, of what all columns are."""
    return [key for key, feature in features.items() if feature["dtype"] == "video"]


def unreadable(root: Path, error: BaseException) -> SequenceError:
    """Says that a folder is no dataset, and why."""
    where = f"give the folder that `endo-sim demonstrate` or `endo-sim export` wrote ({' '.join(str(error).split())})"
    return SequenceError(f"{root} is no LeRobot dataset that can be read; {where}")


def no_demonstrations(root: Path) -> SequenceError:
    """Says that the columns of a dataset are not those of demonstrations, and what makes these."""
    ways = "give what `endo-sim demonstrate` wrote, or train on this one with lerobot itself: lerobot-train"
    return SequenceError(f"{root} has other columns than demonstrations, as what `endo-sim export` writes has; {ways}")


def _check_video(root: Path, name: str, count: int) -> None:
    """Find out whether a video of a dataset has as many images as its episode has rows."""
    try:
        images = drawing.count_images(root / name)
    except (OSError, ValueError) as error:
        raise SequenceError(f"{root}: {name} cannot be read; {_COPY}") from error
    if images != count:
        raise SequenceError(f"{root}: {name} has {images} images for {count} rows; {_COPY}")


def read_dataset(root: Path, vectors: Sequence[str], pictures: Sequence[str]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Columns of all episodes of a dataset that `DatasetWriter` wrote: vectors [T, D] float32, and those of the pictures that it has
    [T, H, W, C] uint8.

    Raises:
        SequenceError: If there is no such dataset, or a vector is missing, or it is damaged.
        RuntimeError: If pyarrow is not installed.
    """
    info = read_info(root)
    features = info["features"]
    if missing := [key for key in vectors if key not in features]:
        raise SequenceError(f"{root} has no column {', '.join(missing)}; give the folder that `endo-sim demonstrate` wrote")
    shown = [key for key in pictures if key in features]
    images = [key for key in shown if features[key]["dtype"] == "image"]
    rows, begin = _some_episodes(root, info), 0
    kinds = dict.fromkeys(vectors, np.float32) | dict.fromkeys(shown, np.uint8)
    read = {key: np.empty((info["total_frames"], *features[key]["shape"]), kind) for key, kind in kinds.items()}  # the only copy
    for row in track(rows, description=f"reading {root.name}", transient=True):
        table, reading = read_table(root, info, row, [*vectors, *images]), data_name(info, row)
        own = slice(begin, begin := begin + len(table))
        try:
            for key in vectors:
                read[key][own] = _from_column(table.column(key), features[key])
            for key in shown:
                if key in images:
                    cells = (np.frombuffer(cell["bytes"], np.uint8) for cell in table.column(key).to_pylist())
                    read[key][own] = [np.asarray(cv2.imdecode(cell, cv2.IMREAD_COLOR_RGB)) for cell in cells]
                else:
                    reading = video_name(info, row, key)
                    read[key][own] = drawing.read_video(root / reading)
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise SequenceError(f"{root}: {reading} cannot be read; {_COPY}") from error
    return {key: read[key] for key in vectors}, {key: read[key] for key in shown}


def _place(number: int) -> dict[str, int]:
    """Where the files of an episode are."""
    return dict(zip(("chunk_index", "file_index"), divmod(number, _CHUNK_SIZE)))


def _from_column(column: Any, feature: dict[str, Any]) -> np.ndarray:
    """Scalars [T], or vectors [T, D], of a column of a table."""
    values = column.combine_chunks()
    if feature["shape"] == [1] and feature["names"] is None:
        return values.to_numpy(zero_copy_only=False)
    return values.flatten().to_numpy(zero_copy_only=False).reshape(-1, feature["shape"][0])


# ---------------------------------------------------------------------------------------------------------------- images


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image)[1].tobytes()


def _counted(images: Iterable[np.ndarray], histogram: np.ndarray) -> Iterator[np.ndarray]:
    """Pass pictures on and add a sample of their pixels to a histogram [C, 256]."""
    for image in images:
        every = max(max(image.shape) // _SAMPLE, 1)
        sample = np.ascontiguousarray(image[::every, ::every])
        for channel in range(len(histogram)):
            histogram[channel] += cv2.calcHist([sample], [channel], None, [256], [0, 256]).ravel().astype(np.int64)
        yield image


# ------------------------------------------------------------------------------------------------------------ statistics


def _statistics(columns: dict[str, np.ndarray], histograms: dict[str, np.ndarray], frames: int) -> dict[str, dict[str, np.ndarray]]:
    """Minimum, maximum, mean, standard deviation, count and quantiles of every column of numbers; of images per channel, 0 to 1."""
    count = np.array([frames])
    statistics = {key: _image_statistics(histogram) | {"count": count} for key, histogram in histograms.items()}
    for key, column in columns.items():
        if column.dtype.kind in "OU":  # texts
            continue
        values = column.reshape(len(column), -1).astype(np.float64)
        found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0), "count": count}
        statistics[key] = found | dict(zip(_QUANTILES, np.quantile(values, list(_QUANTILES.values()), axis=0)))
    return statistics


def _image_statistics(histogram: np.ndarray) -> dict[str, np.ndarray]:
    levels, share = np.arange(256) / 255, histogram / histogram.sum(1, keepdims=True)
    below = np.cumsum(share, 1)
    mean = share @ levels
    found = {
        "min": [levels[np.flatnonzero(row)[0]] for row in histogram],
        "max": [levels[np.flatnonzero(row)[-1]] for row in histogram],
        "mean": mean,
        "std": np.sqrt(np.maximum(share @ levels**2 - mean**2, 0)),
    } | {name: [levels[np.searchsorted(row, q)] for row in below] for name, q in _QUANTILES.items()}
    return {name: np.reshape(values, (-1, 1, 1)) for name, values in found.items()}


def _flat(statistics: dict[str, dict[str, np.ndarray]]) -> dict[str, list]:
    """Columns of the table of episodes."""
    return {f"stats/{key}/{name}": value.tolist() for key, found in statistics.items() for name, value in found.items()}
