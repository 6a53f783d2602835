"""Sliders for options of the physics."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

_QUIET = 0.4  # s without a change after which the sliders act; each change builds new tissue
_HINT = "Acts a moment after the slider stands still; a new thickness brings the tissue back to rest."


class Slider(NamedTuple):
    """One of the physics' parameters on the page."""

    parameter: str
    label: str
    unit: float  # SI units in one of the label
    low: float
    high: float
    step: float


SLIDERS = (
    Slider("young_modulus", "stiffness, kPa", 1e3, 0.5, 100, 0.5),
    Slider("damping", "damping, 1/s", 1, 0, 300, 5),
    Slider("thickness", "thickness, mm", 1e-3, 2, 80, 1),
    Slider("force_radius", "hold radius, mm", 1e-3, 2, 40, 1),
)


class Sliders:
    """The sliders of a page.

    Args:
        gui: Where they are added.
        slid: Called with a slider and its value, in its unit, when a user moves it.
    """

    def __init__(self, gui: Any, slid: Callable[[Slider, float], None]):
        self.handles: dict[str, Any] = {}
        """What viser has of each, by parameter."""
        self._wanted: dict[str, float] = {}
        self._wanted_at = 0.0
        for slider in SLIDERS:
            made = gui.add_slider(slider.label, slider.low, slider.high, slider.step, slider.low, hint=_HINT)
            self.handles[slider.parameter] = made

            def moved(event: Any, slider: Slider = slider) -> None:
                if event.client is not None:  # not set by this program
                    slid(slider, event.target.value)

            made.on_update(moved)

    def show(self, values: dict[str, Any]) -> None:
        """Parameters as they are; what a user wants and is not set yet stays."""
        for slider in SLIDERS:
            if slider.parameter in values and slider.parameter not in self._wanted:
                shown = round(values[slider.parameter] / slider.unit / slider.step) * slider.step
                self.handles[slider.parameter].value = float(np.clip(shown, slider.low, slider.high))

    def slide(self, slider: Slider, value: float) -> None:
        """Take the value of a slider, in its unit."""
        self._wanted[slider.parameter] = value * slider.unit
        self._wanted_at = time.monotonic()

    def take(self, now: float) -> dict[str, float]:
        """Return parameters to set: those that users want, once the sliders stand still."""
        if not self._wanted or now - self._wanted_at <= _QUIET:
            return {}
        wanted, self._wanted = self._wanted, {}
        return wanted
