"""What a person can act with in demonstrations, beside the page: each is a `Device` of :mod:`endo_sim_ros.learning.by_person`."""

from typing import Protocol

from endo_sim_ros.learning.by_person import Device
from endo_sim_ros.learning.devices.gamepad import find_gamepad
from endo_sim_ros.learning.devices.mouse_3d import find_mouse_3d
from endo_sim_ros.learning.devices.openxr import find_hands
from endo_sim_ros.learning.person_config import PersonConfig


class FoundDevice(Device, Protocol):
    """One whose name is its text, and that can be closed."""

    def close(self) -> None:
        """Hear it no more."""
        ...


def find_devices(config: PersonConfig) -> list[FoundDevice]:
    """The gamepad, the 3D mouse and the hands that are there and wanted.

    Raises:
        ValueError: If one that is asked for cannot be used.
    """
    found = (find_gamepad(config.gamepad), find_mouse_3d(config.mouse_3d), *find_hands(config.openxr))
    return [device for device in found if device is not None]
