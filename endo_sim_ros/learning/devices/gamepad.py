"""A gamepad, as Linux has it: /dev/input/js0 and so on (linux/joystick.h), read without any library."""

import struct
from pathlib import Path

import numpy as np

from endo_sim_ros.learning.by_person import Wish, Word
from endo_sim_ros.learning.devices.device_file import DeviceFile, first_device, is_multi_axis_controller
from endo_sim_ros.learning.person_config import GamepadConfig

_EVENT = struct.Struct("=IhBB")  # time, value, kind, number
_BUTTON, _AXIS = 0x01, 0x02  # kinds; 0x80 is added to those that tell how things are when the file is opened
_LARGEST = 32767  # of an axis


class Gamepad(DeviceFile[GamepadConfig]):
    """The sticks move the tip, and the buttons are the jaw, the arm and the words.

    Args:
        path: Its file.
        config: Which axes and buttons are what.

    Raises:
        ValueError: If it cannot be opened.
    """

    kind, at_once = "gamepad", 64 * _EVENT.size

    def __init__(self, path: Path, config: GamepadConfig):
        super().__init__(path, config)
        self._sticks: dict[int, float] = {}  # -1 … 1
        self._words: dict[int, Word] = {
            config.button_again: "again", config.button_drop: "drop", config.button_next: "next", config.button_finish: "finish"
        }  # fmt: skip

    def _hear(self, data: bytes, wish: Wish) -> None:
        for _, value, kind, number in _EVENT.iter_unpack(data[: len(data) // _EVENT.size * _EVENT.size]):
            if kind & _AXIS:
                self._sticks[number] = value / _LARGEST
            elif kind == _BUTTON and value:
                wish.jaw ^= number == self._config.button_jaw
                wish.arm |= number == self._config.button_arm
                if number in self._words:
                    wish.word = self._words[number]

    def _axes(self) -> np.ndarray:
        config = self._config
        sticks = config.stick_right, config.stick_down, config.stick_near, config.stick_turn
        return np.array([self._sticks.get(stick, 0.0) for stick in sticks]) * [1, -1, 1, -1]


def find_gamepad(config: GamepadConfig) -> Gamepad | None:
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
    return first_device(config.file, present, lambda path: Gamepad(path, config))
