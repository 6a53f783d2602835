"""When periodic work is due: at the pace of a clock, or at the pace of commands."""

from collections.abc import Callable, Hashable
from typing import Any

_SAME_RATE = 0.1  # part by which the interval of a stream may differ from the period for the rhythm to follow it
_GAIN = 0.2  # part of the distance by which it follows at a time
MOST_WAITING = 1000  # commands; beyond it the oldest is given up, so that nothing grows without bound


class Pacer:
    """Once a period on average, at the moment that serves best: work runs as soon as fresh input is there, up to half a
    period early or, while input streams in, late. What is missed by more than a period is skipped, never made up for.

    Towards a stream of about the same rate the rhythm shifts, by a period at most, until inputs come in the middle of
    that span, where jitter does no harm.
    """

    def __init__(self):
        self._due: float | None = None
        self._inputs: dict[Hashable, tuple[float, float]] = {}  # times of the last two of each source
        self._fresh: dict[Hashable, float] = {}  # since when input of a source waits
        self._shifted = 0.0  # periods
        self.skipped = 0

    def note_input(self, now: float, source: Hashable = None) -> None:
        """Input arrived that the next piece of work should use; that of all sources that stream is waited for."""
        self._inputs[source] = self._inputs.get(source, (float("-inf"), float("-inf")))[1], now
        self._fresh.setdefault(source, now)

    def is_due(self, now: float, period: float) -> bool:
        """Whether the work should run at this time, seconds of any clock; if so it is taken to run now."""
        if self._due is None or now < self._due - 3 * period:  # the first time, or the clock went back
            self._due, self._shifted = now, 0.0
            self._fresh.clear()
        streaming = {source for source, (before, _) in self._inputs.items() if now - before < 3 * period}
        newest = max(self._fresh.values(), default=now)  # what is much older belonged to the inputs before
        self._fresh = {source: since for source, since in self._fresh.items() if newest - since <= period / 2}
        complete = bool(self._fresh) and streaming <= self._fresh.keys()
        early = -0.5 if complete else 0.5 if streaming else 0.0
        if now < self._due + early * period - 1e-9:
            return False
        if self._fresh:
            self._follow(max(self._fresh, key=self._fresh.get), period)
        missed = max(int((now - self._due) / period), 0)
        self.skipped += missed
        self._due += (missed + 1) * period
        self._fresh.clear()
        return True

    def _follow(self, source: Hashable, period: float) -> None:
        """Shift the rhythm towards the source whose input came last."""
        before, last = self._inputs[source]
        if abs((last - before) / period - 1) < _SAME_RATE:
            phase = (self._fresh[source] - self._due) / period
            error = phase if phase > -1 else phase + 2  # what waited is nearer to this work, or to the one before
            shift = min(max(_GAIN * error, -1 - self._shifted), 1 - self._shifted)
            self._shifted += shift
            self._due += shift * period

    def restart(self) -> None:
        """Forget the rhythm: the time since the last piece of work was not meant to be filled."""
        self._due = None


class CommandQueue:
    """Commands made of parts that come on topics of their own, tied together by their stamp.

    Each topic keeps its order, but one may overtake another; a command is complete when all its parts are there. When a
    later one is complete an earlier incomplete one can never be, so it is given up.

    Args:
        needed: The parts of a command.
    """

    def __init__(self, needed: frozenset[Hashable]):
        self.needed = needed
        self.last_stamp = 0  # ns, of the last command taken
        self._waiting: dict[int, dict[Hashable, Any]] = {}

    def put(self, stamp_ns: int, part: Hashable, value: Any) -> None:
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

    def take(self, on_incomplete: Callable[[int, set], None]) -> tuple[int, dict[Hashable, Any]] | None:
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

    def missing(self) -> tuple[int, set] | None:
        """Stamp and missing parts of the earliest command that waits."""
        if not self._waiting:
            return None
        stamp = min(self._waiting)
        return stamp, set(self.needed - self._waiting[stamp].keys())

    def clear(self) -> None:
        """Forget what waits and what was; stamps may begin anew."""
        self._waiting.clear()
        self.last_stamp = 0
