"""All that we use of the private interface of rosbags: the file behind its writer, and the chunk that it fills.

rosbags can close a bag, which writes the index, but not hand over what it has so far. We do that, so that a recording
outlives its recorder, and cut off half a record where the disk is full. Seen with rosbags 0.11.9; a release that changes
`Writer.storage` or its attributes `path`, `bio`, `chunk` and `close_chunk` fails here, in the tests of unfinished bags.
"""

from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Writer


def _storage(writer: Writer) -> Any:
    return writer.storage


def file_path(writer: Writer) -> Path:
    """The .mcap file that an open writer writes."""
    return _storage(writer).path


def chunk_is_empty(writer: Writer) -> bool:
    """Whether every message that was written is in the file, or on its way there."""
    return not _storage(writer).chunk.bio.tell()


def flush(writer: Writer) -> int:
    """End the chunk, hand the file over to the operating system, and return its length in bytes: whole records.

    Raises:
        OSError: If the disk is full.
    """
    storage = _storage(writer)
    if not chunk_is_empty(writer):
        storage.close_chunk()
    storage.bio.flush()
    return storage.bio.tell()
