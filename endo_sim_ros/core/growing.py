"""Arrays that grow at their end."""

from typing import Any, Generic, TypeVar

import numpy as np
from torch import Tensor

Rows = TypeVar("Rows", np.ndarray, Tensor)


class Growing(Generic[Rows]):
    """An array to which rows are appended without a copy of the others each time.

    Args:
        rows: The first [N, ...]; not changed by what is appended.

    Attributes:
        rows: Those that there are now. What is written into them stays when more come.
    """

    def __init__(self, rows: Rows) -> None:
        self.rows: Rows = rows
        self._room: Any = rows

    def append(self, more: Rows) -> Rows:
        """Append rows [K, ...] and return all."""
        start, end = len(self.rows), len(self.rows) + len(more)
        room: Any = self._room
        if end > len(room):
            size = end + end // 8, *self.rows.shape[1:]
            room = self.rows.new_empty(size) if isinstance(self.rows, Tensor) else np.empty(size, self.rows.dtype)
            room[:start] = self.rows
            self._room = room
        room[start:end] = more
        self.rows = self._room[:end]
        return self.rows

    def shorten(self, count: int) -> Rows:
        """Forget all but the first rows, and return these."""
        self.rows = self._room[:count]
        return self.rows
