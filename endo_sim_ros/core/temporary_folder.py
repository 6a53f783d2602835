"""A folder for files of one process that does not outlast it for long, even if it is killed."""

import contextlib
import fcntl
import os
import shutil
import tempfile
import weakref
from pathlib import Path

# Locks of other machines may not be seen where they share a folder.
_PREFIX = f"endo_sim_files_{os.uname().nodename}_"


def temporary_folder() -> tempfile.TemporaryDirectory:
    """A folder in TMPDIR, locked as long as the process lives; those of dead processes are removed first."""
    _remove_left()
    while True:
        folder = tempfile.TemporaryDirectory(prefix=_PREFIX)
        with contextlib.suppress(OSError):  # a file system without locks, where nobody gets one to remove it either
            lock = os.open(folder.name, os.O_RDONLY)
            weakref.finalize(folder, os.close, lock)
            fcntl.flock(lock, fcntl.LOCK_EX)
        if Path(folder.name).is_dir():
            return folder
        folder.cleanup()  # another process found it before it was locked, and removed it


def _remove_left() -> None:
    """Remove such folders of this user which nobody locks; others are left alone."""
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # it is locked, another user's, or just gone
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                if os.fstat(lock).st_uid == os.geteuid():
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(lock)
