"""What users write themselves and name by where it is."""

import contextlib
import functools
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def told_where(name: str) -> Iterator[None]:
    """Let errors that what `load_named` loads by this name raises tell the line of its file; others stay as they are.

    Raises:
        RuntimeError: In place of such an error.
    """
    try:
        yield
    except Exception as error:
        place = name.rpartition(":")[0]
        file = place if place.endswith(".py") else getattr(sys.modules.get(place), "__file__", None)
        trace = traceback.extract_tb(error.__traceback__) if file else []
        lines = [frame.lineno for frame in trace if Path(frame.filename).resolve() == Path(file or "").resolve()]
        if not lines:
            raise
        raise RuntimeError(f"{name} failed at {file}, line {lines[-1]}: {type(error).__name__}: {error}") from error


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
    return getattr(module, attribute)
