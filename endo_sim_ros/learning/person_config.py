"""What a person who demonstrates sees, and acts with beside the mouse and the keys of the page."""

import re
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from endo_sim_ros.core.config import ConfigError, Range, StageConfig, options, unused_options

_TOPIC = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)

AXES = ("right", "up", "near", "turn")
"""Where sticks, 3D mice and hands move and turn: in the picture, towards the endoscope, and counter-clockwise."""


@dataclass(frozen=True)
class PushedConfig(StageConfig):
    """What is pushed, and returns to its middle: where it is, and how fast the tip goes by it."""

    file: str = ""
    """Its file, such as /dev/input/js0 of a gamepad or /dev/hidraw0 of a 3D mouse; empty = the first one that there is, none = none."""
    dead_zone: Annotated[float, Range(0, 0.9)] = 0.15
    """Part of the way that does nothing, as sticks and caps do not return to their middle."""
    speed: Annotated[float, Range(0.01, 1)] = 1.0
    """How fast the tip goes when it is pushed to its end, in parts of the fastest."""
    reverse: tuple[Literal["right", "up", "near", "turn"], ...] = ()
    """Axes on which it goes the other way."""


@dataclass(frozen=True)
class GamepadConfig(PushedConfig):
    """Sticks and buttons of a gamepad. Numbers by default are those that Linux has for Xbox."""

    stick_right: Annotated[int, Range(0, 63)] = 0
    """Axis that moves to the right."""
    stick_down: Annotated[int, Range(0, 63)] = 1
    """Axis that moves down in the picture."""
    stick_near: Annotated[int, Range(0, 63)] = 4
    """Axis that moves towards the endoscope when it is pulled."""
    stick_turn: Annotated[int, Range(0, 63)] = 3
    """Axis that turns clockwise, in tasks that turn something."""
    button_jaw: Annotated[int, Range(0, 255)] = 0
    """Button that closes and opens the jaw: A."""
    button_arm: Annotated[int, Range(0, 255)] = 4
    """Button for the next arm: the left one of the shoulder."""
    button_again: Annotated[int, Range(0, 255)] = 1
    """Button for again: B."""
    button_drop: Annotated[int, Range(0, 255)] = 2
    """Button for drop: X."""
    button_next: Annotated[int, Range(0, 255)] = 3
    """Button for next: Y."""
    button_finish: Annotated[int, Range(0, 255)] = 7
    """Button for finish: start. It is 9, options, on those of a PlayStation, where 7 is a trigger."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for kind, text in (("stick", "axis"), ("button", "button")):
            taken: dict[int, str] = {}
            for name in (each.name for each in fields(self) if each.name.startswith(f"{kind}_")):
                if (other := taken.setdefault(number := getattr(self, name), name)) != name:
                    raise ConfigError(f"{type(self).__name__}.{other} and {name} are both {text} {number}; give each its own")


@dataclass(frozen=True)
class HandConfig(StageConfig):
    """A hand that the tip follows."""

    step: Annotated[float, Range(0.0005, 0.1, "m")] = 0.006
    """How far the hand goes for a largest step, which is 2 mm of the tip in most tasks, m."""
    turn: Annotated[float, Range(0.1, 45, "deg")] = 5.0
    """How far it turns for a largest turn, degrees."""


@dataclass(frozen=True)
class OpenXRConfig(HandConfig):
    """Controllers of OpenXR."""

    use: Literal["auto", "on", "off"] = "auto"
    """Hear them: auto = where pyopenxr is installed and its runtime can be used; on = or end with a sentence that says why not."""
    heading: Annotated[float, Range(-180, 180, "deg")] = 0.0
    """How far to the left of the headset's direction, as it was at the beginning, the person looks at the page, degrees."""


Direction = Literal["right", "left", "up", "down", "near", "away"]
"""Where an axis points, as a person sees it: near is towards the person."""

DIRECTIONS: dict[str, tuple[int, int, int]] = {
    "right": (1, 0, 0), "left": (-1, 0, 0), "up": (0, 1, 0), "down": (0, -1, 0), "near": (0, 0, 1), "away": (0, 0, -1)
}  # fmt: skip
"""The same in the frame of the person: x right, y up, z towards the person."""


@dataclass(frozen=True)
class MastersConfig(HandConfig):
    """Masters that speak CRTK over ROS topics, as those of a dVRK console do."""

    names: tuple[str, ...] = ()
    """Their names, that of the right hand first, such as MTMR MTML; empty = none. One alone acts with the arm at work."""
    axes: tuple[Direction, Direction, Direction] = ("left", "up", "away")
    """Where x, y and z of the frame of measured_cp point, as the person sees them. The default is that of the dVRK, whose masters are
    measured from the middle of the surgeon's display."""
    clutch: str = "footpedals/clutch"
    """Topic of the pedal (Joy) that lets the hands go elsewhere while it is down."""
    operator: str = "console/operator_present"
    """Topic (Joy) that says whether somebody is there; until it says something, somebody is."""
    closed: Annotated[float, Range(-3.2, 3.2, "rad")] = 0.2
    """A gripper at or below this angle closes the jaw."""
    open: Annotated[float, Range(-3.2, 3.2, "rad")] = 0.4
    """A gripper at or above this angle opens it; between the two angles nothing changes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        plain = [name.removeprefix("/") for name in self.names]
        if len(plain) > len(set(plain[:2])):
            raise ConfigError(f"MastersConfig.names: {' '.join(self.names)} must be one or two different names, right hand first")
        for name in filter(None, (*self.names, self.clutch, self.operator)):
            if not _TOPIC.fullmatch(name):
                raise ConfigError(f"MastersConfig: {name!r} cannot be a ROS name; give letters, digits, _ and /, as in MTMR")
        if self.clutch and self.clutch.removeprefix("/") == self.operator.removeprefix("/"):
            raise ConfigError(f'MastersConfig: clutch and operator are both {self.clutch}; give each its own, or "" for none')
        x, y, z = (np.array(DIRECTIONS[name]) for name in self.axes)
        if (np.cross(x, y) != z).any():
            raise ConfigError(f"MastersConfig.axes: {' '.join(self.axes)} are no right-handed axes; the dVRK has left up away")
        if self.closed >= self.open:
            raise ConfigError(f"MastersConfig.closed, {self.closed:g} rad, must be less than open, {self.open:g} rad")


@dataclass(frozen=True)
class PersonConfig(StageConfig):
    """What a person sees, and acts with beside the mouse and the keys of the page."""

    host: str = "127.0.0.1"
    """Address that the page is served on; 0.0.0.0 lets other machines in, all of them, and none has to log in."""
    port: Annotated[int, Range(1, 65535)] = 8080
    """Port of the page; the next free one if it is taken."""
    width: Annotated[int, Range(16, 4096, "pixels")] = 480
    """Width of the picture in the page; two cores about keep up with this one. The dataset has pictures of its own width."""
    pace: Annotated[float, Range(0.02, 1)] = 1.0
    """How fast time goes in an episode; 1 is real time, 0.5 gives twice as long to act. The dataset has the rate of the task."""
    gamepad: GamepadConfig = field(default_factory=GamepadConfig)
    mouse_3d: PushedConfig = field(default_factory=PushedConfig)
    openxr: OpenXRConfig = field(default_factory=OpenXRConfig)
    masters: MastersConfig = field(default_factory=MastersConfig)

    renamed: ClassVar[dict[str, str]] = {
        "gamepad": "gamepad.file",
        "mouse_3d": "mouse_3d.file",
        "openxr": "openxr.use",
        **{f"hand_{name}": f"openxr.{name}" for name in ("step", "turn", "heading")},
        **{f"stick_{name}": f"gamepad.stick_{name}" for name in ("right", "down", "near", "turn")},
        **{f"button_{name}": f"gamepad.button_{name}" for name in ("jaw", "arm", "again", "drop", "next", "finish")},
        **{name: f"gamepad.{name} and mouse_3d.{name}" for name in ("dead_zone", "speed", "reverse")},
    }
    needs: ClassVar[dict[str, tuple[str, ...]]] = dict.fromkeys(
        ("openxr.step", "openxr.turn", "openxr.heading"), ("openxr.use", "auto", "on")
    )

    def without_effect(self) -> list[str]:
        """A sentence for each option that is not at its default, yet has no effect beside the others."""
        found = unused_options(self)
        devices: dict[str, Any] = {"gamepad": self.gamepad, "mouse_3d": self.mouse_3d}
        for name, config in devices.items():
            changed = [option.name for option in options(type(config)) if getattr(config, option.name) != option.default]
            if config.file == "none":
                found += [f"{name}.{option} has no effect while {name}.file is none; name one" for option in changed if option != "file"]
        if not self.masters.names and self.masters != MastersConfig():
            found.append("masters have options, but no names; give them, as in MTMR MTML")
        return found
