"""Parameters of tests, of which the first are enough for `make test`."""

from collections.abc import Iterable
from typing import Any

import pytest


def mostly_thorough(values: Iterable[Any], kept: int = 1) -> list[Any]:
    """The values of one parameter, or tuples of several; what is tested with others than the first few is left to `make test-thorough`."""
    later = lambda value: pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.thorough)
    return [later(value) if index >= kept else value for index, value in enumerate(values)]
