"""Packages that import a module when one of its names is first used."""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy_names(package: str, file: str) -> Callable[[str], Any]:
    """The ``__getattr__`` (PEP 562) of a package whose names are imported on first use.

    A configuration must be importable without the kernels that lie beside it: ``import endo_sim_ros.physics.config``
    runs ``endo_sim_ros/physics/__init__.py``, which must then import neither torch nor Warp.

    The names are those that the package's file imports under ``TYPE_CHECKING``, so that type checkers and editors know
    them, too. The file is parsed for them, as `lazy_loader.attach_stub` parses a stub.

    Args:
        package: Name of the package, ``__name__``.
        file: The package's own file, ``__file__``.
    """
    blocks = [node.body for node in ast.parse(Path(file).read_text("utf-8")).body if isinstance(node, ast.If)]
    imports = [node for body in blocks for node in body if isinstance(node, ast.ImportFrom) and node.module]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def __getattr__(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(homes[name]), name)
        setattr(sys.modules[package], name, value)  # found there from now on
        return value

    return __getattr__
