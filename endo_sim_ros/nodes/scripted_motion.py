"""How a tool takes hold of tissue, pulls, swings and lets go, by what it feels."""

import numpy as np

from endo_sim_ros.instruments.aiming import AHEAD
from endo_sim_ros.messages import ScriptedToolState
from endo_sim_ros.nodes.aimed_tool import CLOSED, OPEN
from endo_sim_ros.nodes.configs import ScriptedToolConfig

_APPROACH, _SETTLE = 2.0, 0.2  # s: the way to the tissue where nothing resists, and how long the jaw waits there before and after it closes
_LEAVE = 1.0  # s: the way back
_FIRST, _LONGEST = 0.0005, 0.02  # m: how far it pulls at once, and at most, where the force stays small
_SHARE = 0.25  # of the way to the lens that it pulls at most: tissue near a lens is small, and would tear or fill the picture
_NEAR = 0.5  # share of the force; nearer to it the pull grows ever more slowly, as what it feels is that of a while ago
_LATE = 0.1  # s: after a longer pause it goes on from where it is, or it would leap


class ScriptedMotion:
    """What a tool does from its way to the tissue to its way back. Until it lets go it gives way to more than the force.

    Args:
        pose: Pose of the tip where it takes hold [4, 4], m, world.
        towards_camera: Vector [3] from there to the camera, m, world.
        across: The picture's x axis [3], world.
    """

    def __init__(self, pose: np.ndarray, towards_camera: np.ndarray, across: np.ndarray) -> None:
        distance = float(np.linalg.norm(towards_camera))
        self._pose, self._towards_camera, self._across = pose, towards_camera / distance, across
        self._longest = min(_LONGEST, _SHARE * distance)  # m
        self._elapsed = 0.0  # s
        self._back, self._length = AHEAD, 0.0  # m: how far it is in front of where it takes hold, and how far it pulls

    def command(self, config: ScriptedToolConfig, since: float, felt: np.ndarray) -> tuple[np.ndarray, float | None, ScriptedToolState]:
        """What is due now.

        Args:
            config: Options of the scripted tool.
            since: Time since the last command, s.
            felt: Force of the tissue on the tool [3], N, world.

        Returns:
            Pose of the tip [4, 4], m, world; angle of the jaw, rad, None while it stays as it is; and what the tool does.
        """
        since = min(since, _LATE)
        self._elapsed += since
        at_tissue = _APPROACH + 2 * _SETTLE  # from then on it pulls
        swings, lets_go = at_tissue + config.pull, at_tissue + config.pull + config.swing
        angle = 2 * np.pi * (min(self._elapsed, lets_go) - swings) / max(config.swing, 1e-9)
        direction, pose = self._direction(max(angle, 0.0)), self._pose.copy()
        state = ScriptedToolState.PULLING
        if self._elapsed < _APPROACH + _SETTLE:
            self._back -= since * AHEAD / _APPROACH * _haste(config.force - float(np.linalg.norm(felt)), config.force)
        elif at_tissue <= self._elapsed < lets_go:
            state = ScriptedToolState.PULLING if self._elapsed < swings else ScriptedToolState.SWINGING
            resistance = float(-felt @ direction)
            across = float(felt @ felt) - resistance**2  # squared, of what pulling does not change
            left = np.sqrt(max(config.force**2 - across, 0.0)) - resistance
            # By an even share, as a millimetre is much in stiff tissue and little in soft; where nothing resists, to the end in time.
            share = np.log1p(self._longest / _FIRST) / max(config.pull, 0.1)
            self._length += since * share * (self._length + _FIRST) * _haste(left, _NEAR * config.force)
        elif self._elapsed >= lets_go:
            state = ScriptedToolState.RELEASED if self._elapsed < lets_go + config.release else ScriptedToolState.DONE
            if self._elapsed >= lets_go + _SETTLE:
                self._back += since * AHEAD / _LEAVE
        self._back, self._length = min(max(self._back, 0.0), AHEAD), min(max(self._length, 0.0), self._longest)
        pose[:3, 3] += self._length * direction - self._back * pose[:3, 2]
        if self._elapsed < _APPROACH + _SETTLE:  # by then the pose is known
            return pose, None, state
        return pose, CLOSED if self._elapsed < lets_go else OPEN, state

    def _direction(self, angle: float) -> np.ndarray:
        """Unit vector [3], world: aslant towards the camera, circling from the picture's top."""
        up = np.cross(self._towards_camera, self._across)
        direction = self._towards_camera + np.cos(angle) * up + np.sin(angle) * self._across
        return direction / np.linalg.norm(direction)


def _haste(left: float, near: float) -> float:
    """Share of its speed with which a tool goes on that may feel so much more, N, and slows down nearer to that, N; below zero back."""
    return float(np.clip(left / max(near, 1e-9), -1, 1))
