"""Recordings as a LeRobot dataset, layout v3.0: tables in parquet, images as video or PNG, metadata in json and parquet.

Written here and not by the lerobot library, which wants older torch, numpy and OpenCV than this package runs with; tests
read the result with it where it is installed. Each recording is an episode with files of its own. Columns beside those that
every LeRobot dataset has: `observation.images.endoscope.left`, and `observation.state`, `observation.environment_state` and
`action` as described in `episodes`. What else was recorded is in `observation.images.endoscope.right`, `observation.segmentation`,
`observation.joints` and `observation.camera_pose`. The cameras have the names of the Open-H datasets of da Vinci robots.
"""

import json
import shutil
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rich.progress import track

from endo_sim_ros.core import drawing
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.episodes import (
    POSE_NAMES,
    Episode,
    Sampling,
    action_names,
    environment_names,
    joint_names,
    read_episode,
    state_names,
)
from endo_sim_ros.sequences.bag import WORLD_FRAME

VERSION = "v3.0"
IMAGE = "observation.images.endoscope.left"
IMAGE_RIGHT = "observation.images.endoscope.right"
SEGMENTATION = "observation.segmentation"
JOINTS, CAMERA_POSE = "observation.joints", "observation.camera_pose"
_PICTURES = {IMAGE: "left", IMAGE_RIGHT: "right", SEGMENTATION: "segmentation"}  # of an `Episode`
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_CHUNK_SIZE = 1000  # files in a folder
# Every second frame is a key frame, so that any is found fast; without frames out of order times begin at zero.
_CODEC_OPTIONS = {"g": "2", "bf": "0", "crf": "18"}
_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_GROUP = 256  # rows that are written together with their png images
_SAMPLE = 150  # pixels along the longer side of an image that count in its statistics
_INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")

ImageFormat = Literal["video", "png"]


def export_lerobot(
    bags: Iterable[str | Path],
    out: str | Path,
    task: str,
    fps: int | None = None,
    arms: tuple[str, ...] = (),
    sampling: Sampling = "auto",
    images: ImageFormat = "video",
    world_frame: str = WORLD_FRAME,
    frames: tuple[str, ...] = (),
) -> tuple[int, int]:
    """Write recordings as one dataset and return the numbers of its episodes and frames.

    Args:
        bags: Recordings; each is an episode. All must have the arms, rate and image size of the first.
        out: Folder of the new dataset.
        task: What was done, in words.
        fps, arms, sampling, world_frame, frames: See `read_episode`.
        images: ``video`` (H.264, small) or ``png`` (exact).

    Raises:
        SequenceError: If the folder exists or a recording cannot be used; nothing is left behind then.
        ValueError: If one of the frames is not a name and a pose.
        RuntimeError: If pyarrow is not installed.
    """
    out, bags = Path(out), [Path(bag) for bag in bags]
    parquet = _pyarrow()
    if not bags:
        raise SequenceError("no recording to export; give one or more, then the folder of the dataset")
    if out.exists():
        raise SequenceError(f"{out} exists already; choose another name or remove it first")
    episodes = []
    for bag in bags:  # all of them before anything is written
        episodes.append(read_episode(bag, fps, arms, sampling, world_frame, frames))
        _check_alike(episodes[0], episodes[-1])
    if images == "video" and any(side % 2 for side in episodes[0].left.size):
        height, width = episodes[0].left.size
        raise SequenceError(f"{bags[0]}: {width}×{height} images make no video, which needs even sides; export them as png")
    try:
        _Dataset(out, parquet, task, images).write(episodes)
    except BaseException:  # half a dataset would only be in the way of the next try
        shutil.rmtree(out, ignore_errors=True)
        raise
    return len(episodes), sum(map(len, episodes))


def _pyarrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise RuntimeError("a LeRobot dataset needs pyarrow, which is not installed; pip install 'endo_sim_ros[lerobot]'") from error
    return pyarrow


def _check_alike(first: Episode, other: Episode) -> None:
    traits = {
        "arms": lambda episode: episode.arms,
        "fps": lambda episode: episode.fps,
        "image size": lambda episode: episode.left.size,
        "beside the rest": lambda episode: ", ".join(episode.content) or "nothing",
    }
    for what, trait in traits.items():
        mine, others = trait(first), trait(other)
        if mine != others:
            raise SequenceError(f"{other.bag} has {what} {others}, {first.bag} {mine}; the episodes of one dataset must agree")


class _Dataset:
    """Writes the files of a dataset."""

    def __init__(self, root: Path, pyarrow: Any, task: str, images: ImageFormat):
        self._root, self._pa, self._task = root, pyarrow, task
        self._images: ImageFormat = images

    def write(self, episodes: list[Episode]) -> None:
        features = _features(episodes[0], self._images)
        rows, histograms, all_columns, begin = [], [], [], 0
        for number, episode in enumerate(episodes):
            columns = _columns(episode, number, begin)
            own = self._write_files(episode, number, columns, features)
            rows.append(self._episode_row(episode, number, begin) | _flat(_statistics(columns, own, len(episode))))
            all_columns.append(columns)
            histograms.append(own)
            begin += len(episode)
        merged = {key: np.concatenate([columns[key] for columns in all_columns]) for key in all_columns[0]}
        statistics = _statistics(merged, {key: np.sum([each[key] for each in histograms], axis=0) for key in histograms[0]}, begin)
        self._write_json("meta/stats.json", statistics)
        self._write_json("meta/info.json", _info(episodes[0].fps, len(episodes), begin, features, self._images))
        self._write_table(_EPISODES, {key: self._pa.array([row[key] for row in rows]) for key in rows[0]})
        self._write_tasks()

    def _write_files(self, episode: Episode, number: int, columns: dict[str, np.ndarray], features: dict) -> dict[str, np.ndarray]:
        """Write table and pictures of an episode and return the histograms [C, 256] of its pictures by their keys."""
        histograms, cells = {}, {}
        table = self._pa.table({key: self._column(columns[key], features[key]) for key in columns})
        place = dict(zip(("chunk_index", "file_index"), divmod(number, _CHUNK_SIZE)))
        for key in filter(features.__contains__, _PICTURES):
            histograms[key] = np.zeros((features[key]["shape"][2], 256), np.int64)
            pictures = episode.images(getattr(episode, _PICTURES[key]))
            pictures = track(pictures, description=f"writing {episode.bag.name}", total=len(episode)) if key == IMAGE else pictures
            pictures = _counted(pictures, histograms[key])
            if features[key]["dtype"] == "image":
                cells[key] = pictures
            else:
                path = self._path(_VIDEO.format(video_key=key, **place))
                drawing.write_video(path, pictures, episode.fps, _CODEC_OPTIONS)
        kind = self._pa.struct({"bytes": self._pa.binary(), "path": self._pa.string()})
        schema = table.schema
        for key in cells:
            schema = schema.append(self._pa.field(key, kind))
        with self._pa.parquet.ParquetWriter(self._path(_DATA.format(**place)), schema) as file:
            for begin in range(0, len(episode), _GROUP):  # the images of a long episode do not fit into memory
                part = table.slice(begin, _GROUP)
                for key, pictures in cells.items():
                    own = [{"bytes": _png(picture), "path": None} for picture in islice(pictures, len(part))]
                    part = part.append_column(key, self._pa.array(own, kind))
                file.write_table(part)
        return histograms

    def _column(self, values: np.ndarray, feature: dict) -> Any:
        """Column of scalars [T], or of vectors [T, D]."""
        flat = self._pa.array(np.ascontiguousarray(values).reshape(-1))
        return flat if values.ndim == 1 else self._pa.FixedSizeListArray.from_arrays(flat, feature["shape"][0])

    def _episode_row(self, episode: Episode, number: int, begin: int) -> dict[str, Any]:
        chunk, file = divmod(number, _CHUNK_SIZE)
        row = {
            "episode_index": number,
            "tasks": [self._task],
            "length": len(episode),
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": begin,
            "dataset_to_index": begin + len(episode),
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for key in [key for key, name in _PICTURES.items() if getattr(episode, name) and _kind(key, self._images) == "video"]:
            video = {"chunk_index": chunk, "file_index": file, "from_timestamp": 0.0, "to_timestamp": len(episode) / episode.fps}
            row |= {f"videos/{key}/{name}": value for name, value in video.items()}
        return row

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
        columns = {"task_index": self._pa.array([0], self._pa.int64()), index: self._pa.array([self._task])}
        self._write_table("meta/tasks.parquet", columns, {"pandas": json.dumps(pandas)})

    def _write_table(self, name: str, columns: dict[str, Any], metadata: dict[str, str] | None = None) -> None:
        self._pa.parquet.write_table(self._pa.table(columns).replace_schema_metadata(metadata), self._path(name))

    def _write_json(self, name: str, values: dict) -> None:
        plain = lambda value: value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
        self._path(name).write_text(json.dumps(values, indent=4, ensure_ascii=False, default=plain), "utf8")

    def _path(self, name: str) -> Path:
        path = self._root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def _columns(episode: Episode, number: int, begin: int) -> dict[str, np.ndarray]:
    """The table of an episode without its images: scalars [T] and vectors [T, D]."""
    frames = np.arange(len(episode))
    more = {JOINTS: episode.joints, CAMERA_POSE: episode.camera_pose}
    return {
        "observation.state": episode.state,
        "observation.environment_state": episode.environment_state,
        **{key: values for key, values in more.items() if values is not None},
        "action": episode.action,
        "timestamp": (frames / episode.fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full_like(frames, number),
        "index": begin + frames,
        "task_index": np.zeros_like(frames),
    }


def _kind(key: str, images: ImageFormat) -> str:
    """How pictures are kept: labels exactly, whatever the images are."""
    return "image" if images == "png" or key == SEGMENTATION else "video"


def _features(episode: Episode, images: ImageFormat) -> dict[str, dict]:
    """What the columns are."""
    height, width = episode.left.size
    pictures: dict[str, dict] = {}
    for key, name in _PICTURES.items():
        if getattr(episode, name):
            channels = 1 if key == SEGMENTATION else 3
            kind = _kind(key, images)
            pictures[key] = {"dtype": kind, "shape": [height, width, channels], "names": ["height", "width", "channels"]}
            if kind == "video":
                pictures[key]["info"] = {
                    "video.height": height,
                    "video.width": width,
                    "video.codec": "h264",
                    "video.pix_fmt": "yuv420p",
                    "video.is_depth_map": False,
                    "video.fps": episode.fps,
                    "video.channels": channels,
                    "has_audio": False,
                }
    vectors = {
        "observation.state": state_names(episode.arms),
        "observation.environment_state": environment_names(episode.arms),
        "action": action_names(episode.arms),
    }
    vectors |= {JOINTS: joint_names(episode.arms)} if episode.joints is not None else {}
    vectors |= {CAMERA_POSE: list(POSE_NAMES)} if episode.camera_pose is not None else {}
    features = pictures
    features |= {key: {"dtype": "float32", "shape": [len(names)], "names": names} for key, names in vectors.items()}
    kinds = {name: "float32" if name == "timestamp" else "int64" for name in _INDICES}
    return features | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in kinds.items()}


def _info(fps: int, episodes: int, frames: int, features: dict, images: ImageFormat) -> dict[str, Any]:
    return {
        "codebase_version": VERSION,
        "robot_type": "endo_sim",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": _CHUNK_SIZE,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": _DATA,
        "video_path": _VIDEO if images == "video" else None,
        "features": features,
    }


# ---------------------------------------------------------------------------------------------------------------- images


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image)[1].tobytes()


def _counted(images: Iterable[np.ndarray], histogram: np.ndarray) -> Iterator[np.ndarray]:
    """Pass pictures on and add a sample of their pixels to a histogram [C, 256]."""
    for image in images:
        every = max(max(image.shape) // _SAMPLE, 1)
        sample = image[::every, ::every].reshape(-1, len(histogram))
        for channel in range(len(histogram)):
            histogram[channel] += np.bincount(sample[:, channel], minlength=256)
        yield image


# ------------------------------------------------------------------------------------------------------------ statistics


def _statistics(columns: dict[str, np.ndarray], histograms: dict[str, np.ndarray], frames: int) -> dict[str, dict[str, np.ndarray]]:
    """Minimum, maximum, mean, standard deviation, count and quantiles of every column; of images per channel, 0 to 1."""
    count = np.array([frames])
    statistics = {key: _image_statistics(histogram) | {"count": count} for key, histogram in histograms.items()}
    for key, column in columns.items():
        values = column.reshape(len(column), -1).astype(np.float64)
        found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0), "count": count}
        statistics[key] = found | {name: np.quantile(values, q, axis=0) for name, q in _QUANTILES.items()}
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
