"""What devices that are a file of Linux have in common: to be found, opened, read, and gone one day."""

import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import numpy as np

from endo_sim_ros.learning.by_person import Wish
from endo_sim_ros.learning.person_config import AXES, PushedConfig

_logger = logging.getLogger(__name__)

T = TypeVar("T")
Config = TypeVar("Config", bound=PushedConfig)


class DeviceFile(ABC, Generic[Config]):
    """A file of the kernel with the events of a device that is pushed, and returns to its middle.

    Args:
        path: Where it is.
        config: How fast, and which axes go the other way.

    Raises:
        ValueError: If it cannot be opened.
    """

    kind: ClassVar[str]
    """In words."""
    at_once: ClassVar[int]
    """Bytes that are read at a time."""

    def __init__(self, path: Path, config: Config):
        self._path, self._config = path, config
        try:
            self._file: int | None = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ValueError(f"{self} cannot be opened ({error.strerror}); allow it, name another, or none") from error

    def __str__(self) -> str:
        return f"{self.kind} {self._path}"

    def read(self) -> Wish:
        """Where it is pushed, and what was pressed since the last call; one that is gone is in its middle."""
        wish = Wish()
        for data in self._chunks():
            self._hear(data, wish)
        wish.gone = self._file is None
        axes = np.zeros(len(AXES)) if wish.gone else self._axes()
        beyond = np.sign(axes) * np.clip((np.abs(axes) - self._config.dead_zone) / (1 - self._config.dead_zone), 0, 1)
        way = beyond * self._config.speed * [-1.0 if name in self._config.reverse else 1.0 for name in AXES]
        wish.way, wish.turn = way[:3], float(way[3])
        return wish

    def close(self) -> None:
        """Read no more of it."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    @abstractmethod
    def _hear(self, data: bytes, wish: Wish) -> None:
        """Take up what came at once, and what it asks for beside the way."""

    @abstractmethod
    def _axes(self) -> np.ndarray:
        """Where it is pushed [4] in the order of `AXES`, each -1 … 1."""

    def _chunks(self) -> Iterator[bytes]:
        """All that came since the last call; one that is gone is told."""
        while self._file is not None:
            try:
                data = os.read(self._file, self.at_once)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if data:
                yield data
            else:
                self.close()
                _logger.warning("%s is gone; the mouse and the keys go on", self)


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


def is_multi_axis_controller(device: Path) -> bool:
    """Whether a HID device, by its folder in /sys, says that it is one: usage 8 of generic desktop controls (HID Usage Tables 1.5)."""
    try:
        return bytes.fromhex("05 01 09 08 A1 01") in (device / "report_descriptor").read_bytes()
    except OSError:
        return False
