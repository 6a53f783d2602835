"""A gamepad, as Linux has it: /dev/input/js0 and so on (linux/joystick.h), read without any library."""

import logging
import os
import struct
from pathlib import Path

import numpy as np

from endo_sim_ros.learning.by_person import Wish, Word
from endo_sim_ros.learning.config import PersonConfig

_EVENT = struct.Struct("=IhBB")  # time, value, kind, number
_BUTTON, _AXIS, _FIRST = 0x01, 0x02, 0x80  # kinds; the last is added to those that tell how things are when the file is opened
_LARGEST = 32767  # of an axis
_AT_ONCE = 64  # events
_JAW, _ARM = 0, 4  # buttons: of most gamepads A, and the left one of the shoulder
_WORDS: dict[int, Word] = {1: "again", 2: "drop", 3: "next", 7: "finish"}  # B, X, Y, start

_logger = logging.getLogger(__name__)


class Gamepad:
    """The sticks move the tip, and the buttons are the jaw, the arm and the words.

    Args:
        path: Its file.
        config: Which axes are what.

    Raises:
        ValueError: If it cannot be opened.
    """

    def __init__(self, path: Path, config: PersonConfig):
        self._path, self._config = path, config
        try:
            self._file: int | None = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ValueError(f"gamepad: {path} cannot be opened ({error.strerror}); name another, or none") from error
        self._axes: dict[int, float] = {}  # -1 … 1

    def read(self) -> Wish:
        """Where the sticks are, and what was pressed since the last call."""
        wish = Wish()
        for value, kind, number in self._events():
            if kind & _AXIS:
                self._axes[number] = value / _LARGEST
            elif kind == _BUTTON and value:
                wish.jaw ^= number == _JAW
                wish.arm |= number == _ARM
                if number in _WORDS:
                    wish.word = _WORDS[number]
        config = self._config
        wish.way = np.array([self._stick(config.stick_right), -self._stick(config.stick_down), self._stick(config.stick_near)])
        wish.turn = self._stick(config.stick_turn)
        return wish

    def _events(self) -> list[tuple[int, int, int]]:
        """Value, kind and number of what happened since the last call."""
        found = []
        while self._file is not None:
            try:
                data = os.read(self._file, _AT_ONCE * _EVENT.size)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self.close()
                _logger.warning("the gamepad %s is gone; the mouse and the keys go on", self._path)
            found += [event[1:] for event in _EVENT.iter_unpack(data[: len(data) // _EVENT.size * _EVENT.size])]
        return found

    def _stick(self, axis: int) -> float:
        """Where a stick is, -1 … 1, 0 within the dead zone."""
        value, dead = self._axes.get(axis, 0.0), self._config.dead_zone
        return float(np.sign(value) * max(abs(value) - dead, 0.0) / (1 - dead))

    def close(self) -> None:
        """No more of it; sticks are in their middle."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        self._axes = {}


def find_gamepad(config: PersonConfig) -> Gamepad | None:
    """The gamepad of the options, or the first that there is; None where there is none, or none is wanted.

    Raises:
        ValueError: If the one that is named cannot be opened.
    """
    if config.gamepad == "none":
        return None
    found = [Path(config.gamepad)] if config.gamepad else sorted(Path("/dev/input").glob("js*"))
    return Gamepad(found[0], config) if found else None
