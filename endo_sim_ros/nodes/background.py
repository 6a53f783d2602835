"""Work beside the callbacks of a ROS node."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


class Background:
    """Builds what is wanted in a thread of its own, one thing at a time; only the newest wish counts.

    A wish is known by its key: anything that compares equal only for equal wishes.
    """

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1)
        self._key: Any = None
        self._future: Future | None = None

    @property
    def wish(self) -> Any:
        """Key of the newest wish that building has begun for, or None."""
        return self._key

    @property
    def busy(self) -> bool:
        """Whether something is being built, or was built and not taken yet."""
        return self._future is not None

    def want(self, key: Any, build: Callable[[], Any]) -> None:
        """Begin to build, unless that was the last wish already; call again and again while busy.

        Keep what `take` gives, though the wish has changed meanwhile: what was built last is not built again.
        """
        if self._future is None and key != self._key:
            self._key, self._future = key, self._executor.submit(build)

    def take(self) -> tuple[Any, Any] | None:
        """Key and result once when a wish has been fulfilled, else None. Raises what the building raised."""
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        return self._key, future.result()

    def stop(self) -> None:
        """Begin nothing more."""
        self._executor.shutdown(wait=False, cancel_futures=True)
