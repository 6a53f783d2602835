"""Progress bars of commands that read or write recordings."""

from collections.abc import Iterable, Iterator, Sized
from typing import Generic, TypeVar

from rich.progress import track

Item = TypeVar("Item")


class SizedIterator(Generic[Item]):
    """An iterator whose length is known, for progress bars.

    Args:
        items: The items.
        count: How many they are.
    """

    def __init__(self, items: Iterable[Item], count: int):
        self._items, self._count = items, count

    def __iter__(self) -> Iterator[Item]:
        return iter(self._items)

    def __len__(self) -> int:
        return self._count


def tracked(items: Iterable[Item], text: str) -> Iterable[Item]:
    """The same items, with a progress bar under a text; it shows how many are left where that is known."""
    return track(items, description=text, total=len(items) if isinstance(items, Sized) else None)
