"""A 3D mouse, as those of 3Dconnexion are, by the reports that Linux passes on: /dev/hidraw0 and so on, read without any library.

Report 1 has three numbers of 16 bits, where the cap is pushed: to the right, towards the user, down. How it is turned about these axes
are three more, in the same report or in one of its own with number 2. Report 3 has a bit for each button.
"""

from pathlib import Path

import numpy as np

from endo_sim_ros.learning.by_person import Wish
from endo_sim_ros.learning.devices.device_file import DeviceFile, first_device, is_multi_axis_controller
from endo_sim_ros.learning.person_config import PushedConfig

_FIRST = {1: 0, 2: 3}  # axis of a report that tells of axes
_BUTTONS = 3  # the number of that report
_LARGEST = 350  # of an axis


class Mouse3D(DeviceFile[PushedConfig]):
    """The cap moves the tip as it is pushed, and turns it as it is twisted.

    Its first button is the jaw, its second the next arm, and one while the other is held means again.

    Args:
        path: Its file.
        config: How fast, and which axes go the other way.

    Raises:
        ValueError: If it cannot be opened.
    """

    kind, at_once = "3D mouse", 64  # a report at a time

    def __init__(self, path: Path, config: PushedConfig):
        super().__init__(path, config)
        self._cap, self._held = np.zeros(6), 0  # as reports have it; buttons, a bit each

    def _hear(self, data: bytes, wish: Wish) -> None:
        number, values = data[0], data[1:]
        if number in _FIRST:
            axes = np.frombuffer(values[: len(values) // 2 * 2], "<i2")[: 6 - _FIRST[number]]
            self._cap[_FIRST[number] :][: len(axes)] = axes / _LARGEST
        elif number == _BUTTONS:
            held = int.from_bytes(values, "little")
            pressed, self._held = held & ~self._held, held
            if pressed & 3 and held & 3 == 3:
                wish.word = "again"
            elif pressed & 3:
                wish.jaw ^= bool(pressed & 1)
                wish.arm |= bool(pressed & 2)

    def _axes(self) -> np.ndarray:
        right, near, down, _, _, clockwise = self._cap
        return np.array([right, -down, near, -clockwise])


def find_mouse_3d(config: PushedConfig) -> Mouse3D | None:
    """The 3D mouse of the options, or the first that there is; None where there is none, or none is wanted.

    Raises:
        ValueError: If the one that is named cannot be opened.
    """
    present = (Path("/dev") / hid.name for hid in sorted(Path("/sys/class/hidraw").glob("*")) if is_multi_axis_controller(hid / "device"))
    return first_device(config.file, present, lambda path: Mouse3D(path, config))
