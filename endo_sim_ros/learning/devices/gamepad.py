"""A gamepad, as Linux has it: /dev/input/js0 and so on (linux/joystick.h), read without any library."""

import struct
from pathlib import Path

import numpy as np

from endo_sim_ros.learning.by_person import Wish, Word
from endo_sim_ros.learning.config import PersonConfig
from endo_sim_ros.learning.devices.device_file import DeviceFile, first_device, is_multi_axis_controller, pushed

_EVENT = struct.Struct("=IhBB")  # time, value, kind, number
_BUTTON, _AXIS = 0x01, 0x02  # kinds; 0x80 is added to those that tell how things are when the file is opened
_LARGEST = 32767  # of an axis
_AT_ONCE = 64  # events


class Gamepad:
    """The sticks move the tip, and the buttons are the jaw, the arm and the words.

    Args:
        path: Its file.
        config: Which axes and buttons are what.

    Raises:
        ValueError: If it cannot be opened.
    """

    def __init__(self, path: Path, config: PersonConfig):
        self._file, self._config = DeviceFile("gamepad", path), config
        self._axes: dict[int, float] = {}  # -1 … 1
        self._words: dict[int, Word] = {
            config.button_again: "again", config.button_drop: "drop", config.button_next: "next", config.button_finish: "finish"
        }  # fmt: skip

    def __str__(self) -> str:
        return f"gamepad {self._file.path}"

    def read(self) -> Wish:
        """Where the sticks are, and what was pressed since the last call."""
        wish, config = Wish(), self._config
        for data in self._file.chunks(_AT_ONCE * _EVENT.size):
            for _, value, kind, number in _EVENT.iter_unpack(data[: len(data) // _EVENT.size * _EVENT.size]):
                if kind & _AXIS:
                    self._axes[number] = value / _LARGEST
                elif kind == _BUTTON and value:
                    wish.jaw ^= number == config.button_jaw
                    wish.arm |= number == config.button_arm
                    if number in self._words:
                        wish.word = self._words[number]
        if self._file.gone:
            self._axes, wish.gone = {}, True
        across, down, near, turn = (
            self._axes.get(axis, 0.0) for axis in (config.stick_right, config.stick_down, config.stick_near, config.stick_turn)
        )
        wish.way, wish.turn = pushed(np.array([across, -down, near, -turn]), config)
        return wish

    def close(self) -> None:
        """No more of it; sticks are in their middle."""
        self._file.close()


def find_gamepad(config: PersonConfig) -> Gamepad | None:
    """The gamepad of the options, or the first that there is; None where there is none, or none is wanted.

    Raises:
        ValueError: If the one that is named cannot be opened.
    """
    # Linux takes 3D mice for joysticks, too.
    present = (
        path
        for path in sorted(Path("/dev/input").glob("js*"))
        if not is_multi_axis_controller(Path("/sys/class/input") / path.name / "device/device")
    )
    return first_device(config.gamepad, present, lambda path: Gamepad(path, config))
