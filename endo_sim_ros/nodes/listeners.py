"""Waits for those who listen to a node, at its beginning and at its end."""

import time
from collections.abc import Iterable

from rclpy.duration import Duration
from rclpy.publisher import Publisher

_SETTLED = 1.5  # seconds without a new subscriber after which all are there: processes announce themselves every 1, and answer each other


class Listeners:
    """Tells when all who want to hear some publishers have found them: discovery takes its time, and the topics of one listener are
    found one after another."""

    def __init__(self, publishers: Iterable[Publisher]):
        self._publishers = tuple(publishers)
        self._counts, self._since = (), 0.0

    @property
    def count(self) -> int:
        """Subscriptions there are."""
        return sum(publisher.get_subscription_count() for publisher in self._publishers)

    def settled(self) -> bool:
        """Whether there are some, and nobody new has come for a while; ask again and again."""
        counts = tuple(publisher.get_subscription_count() for publisher in self._publishers)
        if counts != self._counts:
            self._counts, self._since = counts, time.monotonic()
        return any(counts) and time.monotonic() - self._since > _SETTLED


def delivered(publisher: Publisher, within: float) -> bool:
    """Wait until everybody has received what was published, for so many seconds at most, and tell whether they have.

    A lost message is repeated when its subscriber asks, which it can only while the publisher exists.
    """
    return publisher.wait_for_all_acked(Duration(seconds=within))
