"""A 3D mouse, as those of 3Dconnexion are, by the reports that Linux passes on: /dev/hidraw0 and so on, read without any library.

Report 1 has three numbers of 16 bits, where the cap is pushed: to the right, towards the user, down. How it is turned about these axes
are three more, in the same report or in one of its own with number 2. Report 3 has a bit for each button.
"""

from pathlib import Path

import numpy as np

from endo_sim_ros.learning.by_person import Wish
from endo_sim_ros.learning.config import PersonConfig
from endo_sim_ros.learning.devices.device_file import DeviceFile, first_device, is_multi_axis_controller, pushed

_FIRST = {1: 0, 2: 3}  # axis of a report that tells of axes
_BUTTONS = 3  # the number of that report
_LARGEST = 350  # of an axis
_LONGEST = 64  # bytes of a report


class Mouse3D:
    """The cap moves the tip as it is pushed, and turns it as it is twisted; its buttons are the jaw and the arm.

    Args:
        path: Its file.
        config: How fast, and which axes go the other way.

    Raises:
        ValueError: If it cannot be opened.
    """

    def __init__(self, path: Path, config: PersonConfig):
        self._file, self._config = DeviceFile("mouse_3d", path), config
        self._axes, self._held = np.zeros(6), 0  # as reports have them; buttons, a bit each

    def __str__(self) -> str:
        return f"3D mouse {self._file.path}"

    def read(self) -> Wish:
        """Where the cap is, and what was pressed since the last call: the first button, the second, or one while the other is held."""
        wish = Wish()
        for report in self._file.chunks(_LONGEST):
            number, data = report[0], report[1:]
            if number in _FIRST:
                values = np.frombuffer(data[: len(data) // 2 * 2], "<i2")[: 6 - _FIRST[number]]
                self._axes[_FIRST[number] :][: len(values)] = values / _LARGEST
            elif number == _BUTTONS:
                held = int.from_bytes(data, "little")
                pressed, self._held = held & ~self._held, held
                if pressed & 3 and held & 3 == 3:
                    wish.word = "again"
                elif pressed & 3:
                    wish.jaw ^= bool(pressed & 1)
                    wish.arm |= bool(pressed & 2)
        if self._file.gone:
            self._axes[:], wish.gone = 0, True
        right, near, down, _, _, clockwise = self._axes
        wish.way, wish.turn = pushed(np.array([right, -down, near, -clockwise]), self._config)
        return wish

    def close(self) -> None:
        """No more of it; the cap is in its middle."""
        self._file.close()


def find_mouse_3d(config: PersonConfig) -> Mouse3D | None:
    """The 3D mouse of the options, or the first that there is; None where there is none, or none is wanted.

    Raises:
        ValueError: If the one that is named cannot be opened.
    """
    present = (Path("/dev") / hid.name for hid in sorted(Path("/sys/class/hidraw").glob("*")) if is_multi_axis_controller(hid / "device"))
    return first_device(config.mouse_3d, present, lambda path: Mouse3D(path, config))
