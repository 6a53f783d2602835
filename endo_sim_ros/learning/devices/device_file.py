"""What devices that are a file of Linux have in common: to be found, opened, read, and gone one day."""

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from endo_sim_ros.learning.config import AXES, PersonConfig

_logger = logging.getLogger(__name__)

T = TypeVar("T")


class DeviceFile:
    """A file of the kernel from which events can be read.

    Args:
        kind: What it is of, in words and as an option.
        path: Where it is.

    Raises:
        ValueError: If it cannot be opened.
    """

    def __init__(self, kind: str, path: Path):
        self.kind, self.path = kind, path
        try:
            self._file: int | None = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ValueError(f"{kind}: {path} cannot be opened ({error.strerror}); allow it, name another, or none") from error

    @property
    def gone(self) -> bool:
        """Whether there is nothing more to come."""
        return self._file is None

    def chunks(self, size: int) -> Iterator[bytes]:
        """All that came since the last call, at most `size` bytes at a time; one that is gone is told."""
        while self._file is not None:
            try:
                data = os.read(self._file, size)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if data:
                yield data
            else:
                self.close()
                _logger.warning("%s: %s is gone; the mouse and the keys go on", self.kind, self.path)

    def close(self) -> None:
        """Read no more of it."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def first_device(named: str, present: Iterable[Path], make: Callable[[Path], T]) -> T | None:
    """The device of a file that is named, or else of the first that is present and can be opened; None where the name is none.

    Raises:
        ValueError: If the one that is named cannot be opened.
    """
    if named:
        return None if named == "none" else make(Path(named))
    for path in present:
        try:
            return make(path)
        except ValueError as error:
            _logger.warning("%s", error)
    return None


def pushed(axes: np.ndarray, config: PersonConfig) -> tuple[np.ndarray, float]:
    """Way [3] and turn of a `Wish` by axes [4] in the order of `AXES`, each -1 … 1: 0 within the dead zone, and `speed` at their ends."""
    beyond = np.sign(axes) * np.clip((np.abs(axes) - config.dead_zone) / (1 - config.dead_zone), 0, 1)
    way = beyond * config.speed * [-1.0 if name in config.reverse else 1.0 for name in AXES]
    return way[:3], float(way[3])


def is_multi_axis_controller(device: Path) -> bool:
    """Whether a HID device, by its folder in /sys, says that it is one: usage 8 of generic desktop controls (HID Usage Tables 1.5)."""
    try:
        return bytes.fromhex("05 01 09 08 A1 01") in (device / "report_descriptor").read_bytes()
    except OSError:
        return False
