"""What users write themselves and name by where it is."""

import contextlib
import functools
import hashlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_files: dict[Path, str] = {}  # what was loaded, and how it was named


class OwnError(RuntimeError):
    """What a file of a user's own raised; the message tells its line."""


@contextlib.contextmanager
def told_where() -> Iterator[None]:
    """Let errors that come through what `load_named` has loaded tell the line of its file; others stay as they are.

    Raises:
        OwnError: In place of such an error.
    """
    try:
        yield
    except OwnError:
        raise
    except Exception as error:
        for frame in reversed(traceback.extract_tb(error.__traceback__) if _files else ()):
            if place := _files.get(Path(frame.filename).resolve()):
                raise OwnError(f"{place} failed at line {frame.lineno}: {type(error).__name__}: {error}") from error
        raise


@functools.cache
def digest_of(name: str) -> str:
    """SHA-256 of the file of what `load_named` loads by a name, as it was when this was first called."""
    load_named(name)
    place = name.rpartition(":")[0]
    file = place if place.endswith(".py") else sys.modules[place].__file__
    return hashlib.sha256(Path(file or "").read_bytes()).hexdigest()


@functools.cache
def load_named(name: str) -> Any:
    """The object that ``path/to/file.py:name`` or ``package.module:name`` names; a file is run once.

    Raises:
        ValueError: If there is none, or the file cannot be run.
    """
    place, _, attribute = name.rpartition(":")
    path = Path(place)
    try:
        if path.suffix == ".py":
            spec = importlib.util.spec_from_file_location(path.stem, path.resolve())
            assert spec is not None and spec.loader is not None  # of a .py file
            module = importlib.util.module_from_spec(spec)
            sys.modules.setdefault(path.stem, module)  # for dataclasses in it, and pickle
            spec.loader.exec_module(module)
        else:
            module = importlib.import_module(place)
    except Exception as error:
        raise ValueError(f"{place} cannot be loaded: {type(error).__name__}: {error}") from error
    if not hasattr(module, attribute):
        raise ValueError(f"{place} has no {attribute!r}; name what it defines, as in {path.name}:Name")
    if (file := getattr(module, "__file__", None)) and module.__name__.partition(".")[0] != __name__.partition(".")[0]:
        _files[Path(file).resolve()] = place
    return getattr(module, attribute)
