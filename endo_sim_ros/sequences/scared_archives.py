"""What SCARED has of each frame: JSON documents and maps of points, in archives that are read as streams, or in folders."""

import contextlib
import gzip
import io
import json
import logging
import re
import tarfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.images import clean_depth
from endo_sim_ros.sequences.pose_files import rigid

logger = logging.getLogger(__name__)

# Beyond these an archive is damaged or hostile, and is refused before its memory is asked for.
_MOST_JSON_BYTES = 1 << 20  # of one frame; a camera takes two thousand
_MOST_POINTS_BYTES = 1 << 28  # of one frame; 2048×1280×3 float32 is 31 MB

_BLOCK = 1 << 20  # bytes that are unpacked at once: with tarfile's own ten thousand it takes a quarter longer


def _member_number(member: tarfile.TarInfo, suffix: str) -> int | None:
    """The frame number of an archive's regular file, None for folders, links and other files."""
    match = re.fullmatch(r"\D*(\d+)" + re.escape(suffix), Path(member.name).name)
    return int(match[1]) if match and member.isreg() else None


def _content(tar: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    file = tar.extractfile(member)
    assert file is not None  # _member_number took a regular file
    return file.read()


def _read_to_end(stream: gzip.GzipFile) -> None:
    """Raise what is wrong with the end of an archive: where one is cut off or damaged at a header, tarfile takes it for ended there."""
    while stream.read(_BLOCK):
        pass


@contextlib.contextmanager
def _readable(archive: Path) -> Iterator[None]:
    """Turn what a damaged archive raises into a SequenceError that names it."""
    try:
        yield
    except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
        raise SequenceError(f"{archive}: not a readable .tar.gz archive ({error}); copy it again") from None


def numbered(folder: Path, suffix: str) -> dict[int, Path]:
    """The files of a folder with a suffix such as `.json`, by the number in their name; none where there is no such folder."""
    matches = ((re.fullmatch(r"\D*(\d+)" + re.escape(suffix), path.name), path) for path in sorted(folder.glob(f"*{suffix}")))
    files: dict[int, Path] = {}
    for number, path in ((int(match[1]), path) for match, path in matches if match):
        if number in files:
            raise SequenceError(f"{folder}: {files[number].name} and {path.name} have the same number; move one away")
        files[number] = path
    return files


def read_frame_data(source: Path) -> dict[int, Any]:
    """The JSON documents of frame_data.tar.gz, or of the folder that it was extracted to, by frame number.

    Raises:
        SequenceError: If one cannot be read, or there are none.
    """
    documents = {}
    for number, name, data in _json_files(source):
        try:
            documents[number] = json.loads(data)
        except ValueError as error:
            raise SequenceError(f"{source}: {name} is not valid JSON ({error})") from None
    if not documents:
        raise SequenceError(f"{source}: holds no frame_data000000.json; extract the archive again, or take the folder away")
    return documents


def _json_files(source: Path) -> Iterator[tuple[int, str, bytes]]:
    """Frame number, name and content of each JSON file of an archive or a folder."""

    def check(name: str, size: int) -> None:
        if size > _MOST_JSON_BYTES:
            raise SequenceError(f"{source}: {name} has {size} bytes, far more than a camera needs")

    if source.is_dir():
        for number, path in numbered(source, ".json").items():
            check(path.name, path.stat().st_size)
            yield number, path.name, path.read_bytes()
        return
    with _readable(source), gzip.open(source) as stream, tarfile.open(fileobj=stream, mode="r|", bufsize=_BLOCK) as tar:
        for member in tar:
            number = _member_number(member, ".json")
            if number is not None:
                check(member.name, member.size)
                yield number, member.name, _content(tar, member)
        _read_to_end(stream)


def published_pose(document: Any, archive: Path, number: int) -> np.ndarray:
    """The published camera-pose [4, 4] of a frame, with its translation in metres.

    Raises:
        SequenceError: If there is none, or it is not rigid.
    """
    matrix = document.get("camera-pose") if isinstance(document, dict) else None
    source = f"{archive}: camera-pose of frame {number}"
    if matrix is None:
        raise SequenceError(f"{source} is missing")
    pose = rigid(matrix, source)
    pose[:3, 3] *= 1e-3
    return pose


class ScenePoints:
    """Reads scene_points.tar.gz forwards, in step with the video; tens of gigabytes unpacked, so one map at a time.

    The archive is expected in order of frame numbers. When a frame is not where it should be, the archive is indexed
    once, which decompresses all of it.
    """

    def __init__(self, archive: Path):
        self._archive = archive
        self._index: dict[int, tarfile.TarInfo] | None = None
        with _readable(self._archive):
            self._stream = gzip.open(archive)  # closed by `close`
            self._tar = tarfile.open(fileobj=self._stream, mode="r|", bufsize=_BLOCK)
        self._next: tuple[int, tarfile.TarInfo | None] = (-1, None)

    def close(self) -> None:
        """Close the archive."""
        self._tar.close()
        self._stream.close()

    def of(self, number: int, size: tuple[int, int]) -> np.ndarray | None:
        """Points [H, W, 3] in the left camera of a frame, metres, or None when it has none."""
        with _readable(self._archive):
            member = self._find(number)
            if member is None:
                return None
            if member.size > _MOST_POINTS_BYTES:
                raise SequenceError(f"{self._archive}: {member.name} has {member.size} bytes, more than an image can have")
            data = _content(self._tar, member)
        return read_point_map(io.BytesIO(data), f"{self._archive}: {member.name}", size)

    def _find(self, number: int) -> tarfile.TarInfo | None:
        if self._index is None:
            while self._next[0] < number:
                member = self._tar.next()
                if member is None:
                    _read_to_end(self._stream)
                    break
                found = _member_number(member, ".tiff")
                if found is not None:
                    self._next = (found, member)
            if self._next[0] == number:
                return self._next[1]
            logger.warning("%s: frame %d is not in its place; indexing the archive, which is slow", self._archive, number)
            self._tar.close()
            self._stream.seek(0)
            self._tar = tarfile.open(fileobj=self._stream, mode="r:")
            numbered = ((_member_number(member, ".tiff"), member) for member in self._tar)
            self._index = {number: member for number, member in numbered if number is not None}
            _read_to_end(self._stream)
        return self._index.get(number)


def keyframe_points(root: Path, size: tuple[int, int]) -> np.ndarray | None:
    """Points [H, W, 3] in the keyframe's left camera, metres, or None without a depth map."""
    path = root / "left_depth_map.tiff"
    if not path.is_file():
        logger.warning("%s: file is missing; the keyframe has no depth", path)
        return None
    return read_point_map(path, str(path), size)


def read_point_map(file: Path | io.BytesIO, source: str, size: tuple[int, int]) -> np.ndarray:
    """A map of points of the left eye [H, W, 3], metres, from a TIFF in millimetres with one eye or both stacked.

    Args:
        file: The TIFF.
        source: What to call it in messages.
        size: Width and height of an eye, pixels.

    Raises:
        SequenceError: If it is no such TIFF.
    """
    width, height = size
    points = _read_tiff(file, source, "points", ((height, width, 3), (2 * height, width, 3)))
    return points[:height].astype(np.float32) * 1e-3


def read_disparity(file: Path, size: tuple[int, int]) -> np.ndarray:
    """A disparity image [H, W], pixels, 0 = none, of rectified images of a size (width, height).

    Raises:
        SequenceError: If it is no such TIFF.
    """
    return clean_depth(_read_tiff(file, str(file), "disparity", (size[::-1],)))


def _read_tiff(file: Path | io.BytesIO, source: str, what: str, shapes: Sequence[tuple[int, ...]]) -> np.ndarray:
    try:
        with tifffile.TiffFile(file) as tiff:
            page = tiff.pages[0]
            if page.shape not in shapes:
                allowed = " or ".join(str(list(shape)) for shape in shapes)
                raise SequenceError(f"{source}: expected {what} of shape {allowed}, got {list(page.shape)}")
            return page.asarray()
    except SequenceError:
        raise
    except Exception as error:  # tifffile raises whatever its decoders do
        raise SequenceError(f"{source}: not a readable TIFF of {what} ({error}); copy it again") from None
