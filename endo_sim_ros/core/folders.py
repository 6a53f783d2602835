"""Folders and files for results, of which nothing is left where there are no results."""

import contextlib
import errno
import fcntl
import logging
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

_logger = logging.getLogger(__name__)
_FULL = (errno.ENOSPC, errno.EDQUOT)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name the path in an OSError of the block that names none, as where a file that is open grows until the disk is full."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


def told_if_full(error: Exception, where: object = None) -> str:
    """What to tell of a full disk, with the place that the error names, or this one; nothing of any other error."""
    if not isinstance(error, OSError) or error.errno not in _FULL:
        return ""
    place = error.filename2 or error.filename or where  # a copy has two, of which the second one is written
    room = f"{place}: there is no room on this disk" if place else "there is no room on a disk (`df -h` shows which)"
    return f"{room}; make room, or name a place on another disk"


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Where to write a file instead, so that it is there whole or not at all: it gets its name when the block ends well."""
    partial = path.with_name(path.name + ".part")
    try:
        with naming(path):
            yield partial
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def leaving_none_empty(*folders: Path) -> Iterator[None]:
    """Remove, at the end of the block and however it ends, the folders that were made in it and are empty; likewise their parents."""
    absent = {path for folder in folders for path in (folder, *folder.parents) if not path.exists()}
    try:
        yield
    finally:
        for path in sorted(absent, key=lambda path: len(path.parts), reverse=True):
            with contextlib.suppress(OSError):  # it is not empty, or was not made
                path.rmdir()


def make_writable(folder: Path) -> None:
    """Make a folder if need be; raises ValueError, which names it, where it takes no files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(f"{folder}: no files can be written there ({error.strerror}); name another folder") from None


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Make a folder if need be, and keep it from all others that claim it until the block ends: of two results in one neither is whole.

    Raises:
        ValueError: If another has claimed it, or it takes no files; one sentence that names it.
    """
    make_writable(folder)
    lock = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(f"{folder}: another command writes into it; wait until that has ended, or name another folder") from None
        yield
    finally:
        os.close(lock)


@contextlib.contextmanager
def told_if_not_kept(path: Path, why: str) -> Iterator[None]:
    """Say, where an interrupt ends the block and a file is not there, that nothing was kept, and why not."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        if not path.exists():
            _logger.warning("%s is not there, and nothing is kept: %s", path, why)
        raise
