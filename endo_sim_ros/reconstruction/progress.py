"""Progress of long work, and how it is cancelled."""

import contextlib
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

from endo_sim_ros.core.device import cpu_threads, return_freed_memory, single_threaded_torch

OnProgress = Callable[[str, int, int], None]
"""``on_progress(stage, done, total)``; total is 0 where it is unknown. It may be called from several threads, and cancels the work by
raising `Cancelled`."""


class Cancelled(Exception):
    """Somebody does not want the work done any more. A progress callback raises it."""


class StageProgress:
    """Reports the progress of one stage and passes on its cancellation, to all of its threads.

    Args:
        stage: Name of the stage.
        on_progress: Called with the stage, how much of it is done, and how much there is; None calls nothing.
    """

    def __init__(self, stage: str = "", on_progress: OnProgress | None = None) -> None:
        self._stage, self._on_progress = stage, on_progress
        self._done, self._total, self._stopped = 0, 0, threading.Event()

    def __call__(self, done: int, total: int) -> None:
        """Report that so much is done.

        Raises:
            Cancelled: If the work is not wanted any more.
        """
        self._done, self._total = done, total
        self.check()

    def check(self) -> None:
        """Ask whether to go on, from any thread; call it at least once in half a second of work.

        Raises:
            Cancelled: If not.
        """
        if self._stopped.is_set():
            raise Cancelled
        if self._on_progress is not None:
            self._on_progress(self._stage, self._done, self._total)

    def map(self, function: Callable, items: Iterable) -> list:
        """Results of a function, which mostly waits for OpenCV or numpy, for each item, several at a time; reports the share done.

        After an error, a cancellation or Ctrl-C no further item begins, and `check` raises in those that run. One that does not check,
        as a single call of OpenCV can take seconds, is left to end by itself. Meanwhile torch has one thread in each of ours where these
        fill the cores.
        """
        items = list(items)
        with single_threaded_torch() if len(items) >= cpu_threads() else contextlib.nullcontext():  # else its threads multiply ours
            return self._map(function, items)

    def _map(self, function: Callable, items: list) -> list:
        self._stopped = stopped = threading.Event()
        pool, futures = ThreadPoolExecutor(cpu_threads(), "endo_sim"), []
        try:
            self(0, len(items))
            futures = [pool.submit(function, item) for item in items]
            left = set(futures)
            while left:
                done, left = wait(left, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in done:
                    future.result()
                self(len(items) - len(left), len(items))
        except BaseException:
            stopped.set()
            pool.shutdown(wait=False, cancel_futures=True)
            wait([future for future in futures if not future.cancelled()], timeout=0.5)
            raise
        pool.shutdown()
        if len(items) > cpu_threads():  # of few things little is freed, and to take it anew costs more than some stages
            return_freed_memory()  # of threads that have ended
        return [future.result() for future in futures]
