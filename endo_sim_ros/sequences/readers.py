"""Every layout that a recording may have, and how it is told from the others.

A new dataset is one file with a `read_…` function and one entry in READERS. `Command` in cli/convert.py has each of its options, too.
"""

import functools
import numbers
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences import endonerf, folder, scared, stereomis
from endo_sim_ros.sequences.colmap import find_models, read_colmap
from endo_sim_ros.sequences.endonerf import read_endonerf
from endo_sim_ros.sequences.folder import read_folder
from endo_sim_ros.sequences.images import numbered_files
from endo_sim_ros.sequences.scared import read_scared
from endo_sim_ros.sequences.stereomis import read_stereomis
from endo_sim_ros.sequences.video import read_video
from endo_sim_ros.sequences.video_files import VIDEO_SUFFIXES


@dataclass(frozen=True)
class Reader:
    """A layout of recordings.

    Args:
        read: Returns the frames of a path, with keyword options.
        recognises: Whether a path has this layout.
        mark: What it is recognised by, for people.
    """

    read: Callable[..., Iterable[Frame]]
    recognises: Callable[[Path], bool]
    mark: str


def _is_scared(path: Path) -> bool:
    names = (scared.CALIBRATION_FILE, "data/frame_data.tar.gz", "data/frame_data", "left_depth_map.tiff")
    return any((path / name).exists() for name in names) or any(path.glob("keyframe_*/"))


def _is_video(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in VIDEO_SUFFIXES
    return path.is_dir() and any(p.suffix.lower() in VIDEO_SUFFIXES for p in path.iterdir())


# The first that recognises a path reads it, so the most telling marks come first: a StereoMIS folder holds a video, too.
READERS: dict[str, Reader] = {
    "stereomis": Reader(
        read_stereomis, lambda path: (path / stereomis.CALIBRATION_FILE).is_file(), f"the file {stereomis.CALIBRATION_FILE}"
    ),
    "scared": Reader(read_scared, _is_scared, f"the file {scared.CALIBRATION_FILE} or data/frame_data[.tar.gz]"),
    "endonerf": Reader(read_endonerf, lambda path: (path / endonerf.POSES_FILE).is_file(), f"the file {endonerf.POSES_FILE}"),
    "colmap": Reader(
        read_colmap,
        lambda path: (path / "images").is_dir() and bool(find_models(path)),
        "the folder images/ and COLMAP's model in sparse/0/ (cameras, images and points3D)",
    ),
    "folder": Reader(read_folder, lambda path: (path / "left").is_dir(), f"the folder left/ with images, and {folder.CALIBRATION_FILE}"),
    "video": Reader(read_video, _is_video, f"a video ({', '.join(VIDEO_SUFFIXES)}), or a folder with one"),
}


def open_sequence(path: Path | str, kind: str = "auto", **options) -> Iterable[Frame]:
    """Open a recording of any known layout.

    Args:
        path: Its file or folder.
        kind: A name in READERS, or `auto` to recognise the layout.
        options: Passed on to the layout's reader.

    Returns:
        Frames, read lazily; `len()` of it is the number expected.

    Raises:
        SequenceError: If nothing is there, no layout matches, or the reader finds a fault.
    """
    return find_reader(path, kind, options)()


def find_kind(path: Path) -> str:
    """The name in READERS of the layout that a path has; empty if it has none."""
    return next((name for name, reader in READERS.items() if reader.recognises(path)), "")


def find_reader(path: Path | str, kind: str, options: Mapping[str, Any]) -> Callable[[], Iterable[Frame]]:
    """What opens a recording; nothing of it is read yet. Arguments and errors are those of `open_sequence`."""
    path = Path(path)
    if not path.exists():
        raise SequenceError(f"{path}: no such file or folder")
    if kind == "auto":
        kind = find_kind(path)
        if not kind:
            _refuse_bare_images(path)
            if is_bag(path):
                raise SequenceError(f"{path}: is a bag already; give it to `endo-sim reconstruct`, `evaluate` or `demo --bag`")
            marks = "; ".join(f"{name}: {reader.mark}" for name, reader in READERS.items())
            raise SequenceError(f"{path}: no known layout recognised. Layouts and what each is recognised by: {marks}")
    if kind not in READERS:
        raise SequenceError(f"{path}: unknown kind {kind!r}; choose auto, {', '.join(READERS)}")
    read = READERS[kind].read
    hints = {name: hint for name, hint in typing.get_type_hints(read).items() if name not in ("path", "return")}
    for name, value in options.items():
        if name not in hints:
            raise SequenceError(f"{path}: the {kind} layout has no option {name!r}; it has {', '.join(hints)}")
        check_option(path, name, value, hints[name])
    return functools.partial(read, path, **options)


def is_bag(path: Path) -> bool:
    """Whether a path looks like a rosbag2 folder or an .mcap file."""
    return path.suffix == ".mcap" or (path / "metadata.yaml").is_file() or path.is_dir() and any(path.glob("*.mcap"))


def _refuse_bare_images(path: Path) -> None:
    """Raise SequenceError if a folder, or one in it, holds images of an eye and nothing that tells a layout."""
    if not path.is_dir():
        return
    for place in [path, *sorted(each for each in path.iterdir() if each.name not in ("right", "masks", "depth"))]:
        images = numbered_files(place)
        if images and path.name in ("left", "right"):
            raise SequenceError(f"{path}: holds {counted(len(images), 'image')} of an eye; pass the folder that it is in")
        if images:
            left, calibration = path / "left", path / folder.CALIBRATION_FILE
            raise SequenceError(
                f"{place}: holds {counted(len(images), 'image')}, but none is in {left}: move them there, and give fx, fy, cx, cy [pixels] "
                f"in {calibration} where they are known; what is not, and poses without {folder.POSE_FILES[0]}, is estimated. "
                "docs/datasets.md has other layouts"
            )


_WORDS: dict[Any, str] = {
    bool: "true or false",
    numbers.Integral: "a whole number",
    numbers.Real: "a number",
    str: "a word",
    Path: "a path",
    Sequence: "a list of numbers",
}
_NUMBERS: dict[Any, Any] = {int: numbers.Integral, float: numbers.Real}  # those of numpy, too


def check_option(source: Path | str, name: str, value: Any, hint: Any) -> None:
    """Raise SequenceError if the value of an option has not the type that its annotation says."""
    allowed = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    kinds = tuple(_NUMBERS.get(kind, typing.get_origin(kind) or kind) for kind in allowed)
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        words = ", ".join(str(_WORDS.get(kind, kind)) for kind in kinds if kind is not types.NoneType)
        raise SequenceError(f"{source}: {name} must be {words}, got {value!r}")
