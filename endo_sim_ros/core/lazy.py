"""Packages that import a module when one of its names is first used."""

import importlib
import sys
from collections.abc import Callable
from typing import Any


def lazy_names(package: str, **modules: tuple[str, ...]) -> Callable[[str], Any]:
    """The ``__getattr__`` (PEP 562) of a package whose names are imported on first use.

    A configuration must be importable without the kernels that lie beside it: ``import endo_sim_ros.physics.config``
    runs ``endo_sim_ros/physics/__init__.py``, which must then import neither torch nor Warp.

    Args:
        package: Name of the package, ``__name__``.
        modules: The names that the package offers, by the module of the package that defines them. Type checkers read
            the same names from imports under ``TYPE_CHECKING``.
    """
    homes = {name: module for module, names in modules.items() for name in names}

    def __getattr__(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{package}.{homes[name]}"), name)
        setattr(sys.modules[package], name, value)  # found there from now on
        return value

    return __getattr__
