"""Every layout that a recording may have, and how it is told from the others.

A new dataset is one file with a `read_…` function and one entry in READERS. `Command` in cli/convert.py has each of its options, too.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences import endonerf, folder, scared, stereomis
from endo_sim_ros.sequences.endonerf import read_endonerf
from endo_sim_ros.sequences.folder import read_folder
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
    path = Path(path)
    if not path.exists():
        raise SequenceError(f"{path}: no such file or folder")
    if kind == "auto":
        kind = next((name for name, reader in READERS.items() if reader.recognises(path)), "")
        if not kind:
            marks = "; ".join(f"{name}: {reader.mark}" for name, reader in READERS.items())
            raise SequenceError(f"{path}: no known layout recognised. Layouts and what each is recognised by: {marks}")
    if kind not in READERS:
        raise SequenceError(f"{path}: unknown kind {kind!r}; choose auto, {', '.join(READERS)}")
    try:
        return READERS[kind].read(path, **options)
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        option = str(error).rsplit("argument", 1)[1].strip()
        raise SequenceError(f"{path}: the {kind} layout has no option {option}") from None
