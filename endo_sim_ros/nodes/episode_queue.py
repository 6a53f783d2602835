"""Stamped values that states ask for, episode by episode: stamps of one come again in the next."""

from collections import deque
from collections.abc import Sequence
from itertools import dropwhile, islice, pairwise, takewhile
from typing import Generic, TypeVar

from endo_sim_ros.nodes.pacing import MOST_WAITING

T = TypeVar("T")


class EpisodeQueue(Generic[T]):
    """Values in the order in which they came. A stamp that goes back begins an episode.

    States ask in their own order, and may lag episodes behind the values, or be ahead of them.
    """

    def __init__(self, most: int = MOST_WAITING) -> None:
        self._items: deque[tuple[int, T]] = deque(maxlen=most)

    def put(self, stamp: int, value: T, replace: bool = False) -> None:
        """Append a value with its stamp, ns; ``replace`` drops the one before if that has the same stamp."""
        if replace and self._items and self._items[-1][0] == stamp:
            self._items.pop()
        self._items.append((stamp, value))

    @property
    def newest(self) -> T | None:
        """The value that came last."""
        return self._items[-1][1] if self._items else None

    @property
    def newest_stamp(self) -> int | None:
        """Its stamp, ns."""
        return self._items[-1][0] if self._items else None

    def find(self, stamp: int, later: Sequence[int]) -> T | None:
        """Return the value of a state, None while it is not there; what is left of episodes before that of the state is dropped.

        Args:
            stamp: Of the state, ns.
            later: Stamps of the states after it.
        """
        while any(when == stamp for when, _ in self._items):
            first = self._first_episode()
            found = [value for when, value in first if when == stamp]
            if found:
                return found[0]
            if later and any(when == later[0] for when, _ in first):
                break  # that of the state alone is missing
            for _ in first:
                self._items.popleft()
        return None

    def passed(self, later: Sequence[int]) -> bool:
        """Whether values of states after one are there, so that its own will not come."""
        return any(when in later for when, _ in self._items)

    def count(self, stamp: int) -> int:
        """How many values with a stamp the first of its episodes has: each reset after a reset brings one more."""
        stamps = [when for when, _ in self._items]
        return len(list(takewhile(lambda when: when == stamp, dropwhile(lambda when: when != stamp, stamps))))

    def forget(self, stamp: int) -> None:
        """Drop the value of a state that was shown, or is not to be, and what came before it."""
        if any(when == stamp for when, _ in self._first_episode()):
            while self._items.popleft()[0] != stamp:
                pass

    def _first_episode(self) -> list[tuple[int, T]]:
        end = next((i for i, (before, after) in enumerate(pairwise(self._items), 1) if after[0] < before[0]), len(self._items))
        return list(islice(self._items, end))
