"""Folders for results, of which nothing is left where there are no results."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


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
