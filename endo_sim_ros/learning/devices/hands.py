"""Hands that the tip follows while they hold on, whatever tells where they are: controllers of OpenXR, masters that speak CRTK."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from endo_sim_ros.learning.by_person import Wish, Word
from endo_sim_ros.learning.person_config import HandConfig

_STILL = 0.02  # of a largest step, 0.1 mm of the hand by default: less is the noise of what measures it, and moves nothing


@dataclass
class Grip:
    """A hand as it is measured."""

    place: np.ndarray  # [3], m
    rotation: Rotation
    held: bool  # the tip follows
    closed: bool
    pressed: frozenset[Word] = frozenset()


class Hands(Protocol):
    """What tells of hands, by their numbers: 0 = the right one, 1 = the left one."""

    def grip(self, hand: int) -> Grip | None:
        """How a hand is now; None where that is not known."""
        ...

    def gone(self, hand: int) -> bool:
        """Whether it is heard no more."""
        ...

    def name(self, hand: int) -> str:
        """What to call it."""
        ...

    def close(self) -> None:
        """Hear none any more."""
        ...


class Hand:
    """A hand that acts while it holds on: the tip moves as it does, and goes after it where it is faster.

    Args:
        hands: What tells of it.
        number: 0 = the right one, 1 = the left one.
        config: How far it goes for a step.
        axes: From the frame in which it is measured to that of the person: x right, y up, z towards the person.
        arm: The arm of the task with which it acts; None = the one at work.
    """

    def __init__(self, hands: Hands, number: int, config: HandConfig, axes: Rotation, arm: int | None):
        self._hands, self._number, self._axes, self._arm = hands, number, axes, arm
        self._steps = np.array([1 / config.step] * 3 + [1 / np.deg2rad(config.turn)])
        self._before: Grip | None = None
        self._closes = False  # it has closed since it holds on, and has not been opened
        self._left = np.zeros(4)  # of what it moved and turned and the tip has not yet, in largest steps

    def __str__(self) -> str:
        return self._hands.name(self._number)

    def read(self) -> Wish:
        """What it did since the last call: of a long way the first step."""
        grip, before = self._hands.grip(self._number), self._before
        self._before, wish = grip, Wish(hand=self._arm, gone=self._hands.gone(self._number))
        if grip is None or not grip.held:
            self._left[:], self._closes = 0, False
        elif before is not None:
            if before.held:
                way = self._axes.apply(grip.place - before.place)
                turn = self._axes.apply((grip.rotation * before.rotation.inv()).as_rotvec())
                self._left += self._steps * [*way, turn[2]]
                self._closes = grip.closed and (self._closes or not before.closed)
                # A jaw is as it was until the hand closes or opens; of two with one arm, only one that lets go opens it.
                wish.closed = True if self._closes else False if before.closed and not grip.closed else None
            step = np.where(np.abs(self._left) > _STILL, np.clip(self._left, -1, 1), 0)
            self._left -= step
            wish.way, wish.turn = step[:3], float(step[3])
        if grip is not None and before is not None:
            wish.word = next(iter(grip.pressed - before.pressed), None)
        return wish

    def close(self) -> None:
        """No more of it."""
        self._hands.close()
