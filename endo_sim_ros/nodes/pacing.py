"""When periodic work is due: at the pace of a clock, or at the pace of commands."""

import time
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

WINDOW = 1.0  # seconds over which speed is measured
MOST_WAITING = 1000  # commands; beyond it the oldest is given up, so that nothing grows without bound

# In periods:
_SET_BACK = 3  # work that ran a period early is next due in two; a clock that is further behind was set back
_STREAMING = 3  # a source with two inputs within this time streams, even if one came late or was lost
_STALL = 0.5  # asked more seldom, the caller was busy, and input may have come that it has not noted yet
_BELATED = 0.5  # input that is this much older than the newest belongs to the inputs before
_EARLIEST, _LATEST = -1.0, 0.5  # from the due time: when complete fresh input is used, and until when streaming input is waited for


class Pacer:
    """Once a period on average, at the moment that serves best: work runs as soon as fresh input is there, up to a period
    early or, while input streams in, half a period late. What is missed by more than a period is skipped, never made up for.

    Input that finds the work a whole period ahead waits for the next one, and both are used at once: had it run when that
    period was over, all those after it would have had to wait as well.
    """

    def __init__(self) -> None:
        self._due: float | None = None
        self._inputs: dict[Hashable, tuple[float, float]] = {}  # times of the last two of each source
        self._fresh: set[Hashable] = set()  # sources whose last input was not used yet
        self._ahead = False  # what is fresh waits for the next input
        self._asked = float("-inf")  # when it was last asked for
        self.skipped = 0

    def note_input(self, now: float, source: Hashable = None) -> None:
        """Note input of a source for the next piece of work, which waits for all sources that stream."""
        self._inputs[source] = self._inputs.get(source, (float("-inf"), float("-inf")))[1], now
        self._fresh.add(source)
        self._ahead = False

    def is_due(self, now: float, period: float) -> bool:
        """Whether the work should run at this time, seconds of any clock; if so it is taken to run now."""
        if self._due is None or now < self._due - _SET_BACK * period:  # the first time, or the clock went back
            self._due = now
            self._inputs.clear()
            self._fresh.clear()
        asked, self._asked = self._asked, now
        stalled = now - asked > _STALL * period
        streaming = {source for source, (before, _) in self._inputs.items() if (asked if stalled else now) - before < _STREAMING * period}
        newest = max((self._inputs[source][1] for source in self._fresh), default=now)
        belated = {source for source in self._fresh if newest - self._inputs[source][1] > _BELATED * period}
        self._fresh -= belated
        complete = bool(self._fresh) and streaming <= self._fresh
        if stalled and streaming and not complete:
            return False  # what came meanwhile is noted first
        offset = _EARLIEST if complete and not self._ahead else _LATEST if streaming else 0.0
        if now < self._due + offset * period - 1e-9:
            self._ahead = complete
            return False
        missed = max(int((now - self._due) / period), 0)
        self.skipped += missed
        self._due += (missed + 1) * period
        self._fresh.clear()
        self._ahead = False
        return True

    def restart(self) -> None:
        """Forget the rhythm: the time since the last piece of work was not meant to be filled."""
        self._due = None


class SpeedMeter:
    """How fast simulated time goes, over the last whole window.

    Attributes:
        real_time_factor: Simulated time over that of the clock.
        clock_speed: Time of the clock over that of the wall.
    """

    real_time_factor = clock_speed = 1.0

    def __init__(self) -> None:
        self._window: tuple[float, float, float] | None = None  # clock, simulated and wall time at its beginning

    def note(self, now: float, simulated: float) -> None:
        """Note the time of the clock and the simulated time, s."""
        wall = time.monotonic()
        if self._window is None or now < self._window[0] or simulated < self._window[1]:
            self._window = now, simulated, wall
        elapsed = now - self._window[0]
        if elapsed > WINDOW:
            self.real_time_factor = (simulated - self._window[1]) / elapsed
            self.clock_speed = elapsed / max(wall - self._window[2], 1e-3)
            self._window = now, simulated, wall

    def restart(self) -> None:
        """Forget the window: the time since it began was not meant to be simulated."""
        self._window, self.real_time_factor = None, 1.0


Part = TypeVar("Part", bound=Hashable)


class CommandQueue(Generic[Part]):
    """Commands made of parts that come on topics of their own, tied together by their stamp.

    Each topic keeps its order, but one may overtake another; a command is complete when all its parts are there. When a
    later one is complete an earlier incomplete one can never be, so it is given up.

    Args:
        needed: The parts of a command.
    """

    def __init__(self, needed: frozenset[Part]) -> None:
        self.needed = needed
        self.last_stamp = 0  # ns, of the last command taken
        self._waiting: dict[int, dict[Part, Any]] = {}

    def put(self, stamp_ns: int, part: Part, value: Any) -> None:
        """Add one part of the command with this stamp.

        Raises:
            ValueError: If that command cannot be taken any more, or too many wait.
        """
        if stamp_ns <= self.last_stamp:
            raise ValueError(
                f"a command of time {stamp_ns * 1e-9:.6f} s is not after the last step, {self.last_stamp * 1e-9:.6f} s;"
                " stamps must grow from one command to the next (~/reset begins anew)"
            )
        self._waiting.setdefault(stamp_ns, {})[part] = value
        if len(self._waiting) > MOST_WAITING:
            first = min(self._waiting)
            del self._waiting[first]
            raise ValueError(f"over {MOST_WAITING} commands wait; the oldest, of {first * 1e-9:.6f} s, is dropped")

    def take(self, on_incomplete: Callable[[int, set[Part]], None]) -> tuple[int, dict[Part, Any]] | None:
        """The earliest complete command, as its stamp in ns and its parts, or None.

        Args:
            on_incomplete: Told the stamp and the missing parts of each command that is given up.
        """
        complete = [stamp for stamp, parts in self._waiting.items() if parts.keys() >= self.needed]
        if not complete:
            return None
        stamp = min(complete)
        for earlier in sorted(other for other in self._waiting if other < stamp):
            on_incomplete(earlier, set(self.needed - self._waiting.pop(earlier).keys()))
        self.last_stamp = stamp
        return stamp, self._waiting.pop(stamp)

    def missing(self) -> tuple[int, set[Part]] | None:
        """Stamp (ns) and missing parts of the earliest command that waits, or None."""
        if not self._waiting:
            return None
        stamp = min(self._waiting)
        return stamp, set(self.needed - self._waiting[stamp].keys())

    def clear(self) -> None:
        """Forget what waits and what was; stamps may begin anew."""
        self._waiting.clear()
        self.last_stamp = 0
