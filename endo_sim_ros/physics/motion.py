"""Breath and heart: how they move what holds the tissue."""

from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.motion import beat_share, breath_share
from endo_sim_ros.physics.backends.structs import Loads
from endo_sim_ros.physics.config import MotionConfig


class MotionState(NamedTuple):
    """Of breath and heart at one time, [2] each."""

    phases: np.ndarray  # part of the period that is over, 0 to 1
    rates: np.ndarray  # periods per second
    displacements: np.ndarray  # of held tissue along the direction of the motion, m
    velocities: np.ndarray  # of it, mean over the last step, m/s


class HeldMotion:
    """Moves the ends of the springs that hold pinned control nodes; the rest is the physics.

    At the end of each step they are where the waveforms of `core/motion.py` have them at its time, and move there evenly, so that their
    position is continuous and their velocity that of the position. Where a step was undone, they catch up in the next. Phases go on from
    step to step, whatever the periods. All control nodes that are held move alike, which strains nothing by itself.

    Args:
        config: What moves.
        duration: Of a step, s.
        pinned: Which control nodes are held [M], bool, on the device.
        loads: Of all copies [B · M].
        copies: B.
    """

    def __init__(self, config: MotionConfig, duration: float, pinned: Tensor, loads: Loads, copies: int):
        self.config, self._duration = config, duration
        self._pinned = pinned.nonzero()[:, 0]
        device = str(pinned.device)
        self._target, self._velocity = (wp.to_torch(each).view(copies, len(pinned), 3) for each in (loads.target, loads.target_v))
        self.held = wp.zeros(copies, wp.vec3, device=device)  # how far held nodes are moved from rest [B], m
        self.goal = wp.zeros(copies, wp.vec3, device=device)  # the same at the end of the step
        self._held, self._goal = wp.to_torch(self.held), wp.to_torch(self.goal)
        self._phases = np.tile(np.array(config.phases), (copies, 1))  # [B, 2]
        self._ways, self._old_ways, self._changed = config.ways, config.ways, np.inf  # [2, 3] m, and s since they became others
        self._shown = self._before = np.zeros(2)  # displacements of the first copy now and a step before, m
        self._used = False  # since all was at rest

    @property
    def moving(self) -> bool:
        """Whether anything moves, or will in the next step."""
        return bool(self._ways.any() or self._ways_now().any() or self._before.any() or self._shown.any())

    @property
    def state(self) -> MotionState:
        """Of the first copy, at the end of the last step."""
        return MotionState(
            self._phases[0].copy(), 1 / np.array(self.config.periods), self._shown.copy(), (self._shown - self._before) / self._duration
        )

    def change(self, config: MotionConfig) -> None:
        """Move otherwise from now on: with other periods at once, each from its phase, and with other amplitudes within `fade`."""
        if not np.array_equal(config.ways, self._ways) or config.fade != self.config.fade:
            self._old_ways, self._ways, self._changed = self._ways_now(), config.ways, 0.0
        self.config = config

    def copy(self, other: "HeldMotion") -> None:
        """Go on from where another motion of the same control nodes is, towards what this one's config has."""
        config = self.config
        self.config, self._phases, self._used = other.config, other._phases.copy(), other._used
        self._ways, self._old_ways, self._changed = other._ways, other._old_ways, other._changed
        self._shown, self._before = other._shown, other._before
        self._held.copy_(other._held)
        self.change(config)

    def reset(self, environments: Tensor | slice = slice(None), phases: np.ndarray | None = None) -> Tensor:
        """Begin anew in these K copies, with phases [K, 2] or those of the config, and return where held tissue begins [K, 3], m."""
        everywhere = isinstance(environments, slice) and environments == slice(None)
        if everywhere:
            self._changed, self._used = np.inf, False
        self._held[environments] = 0
        if everywhere:
            self._shown = self._before = np.zeros(2)
        moving = self._ways.any() or self._ways_now().any()
        if everywhere or moving:
            which = environments if isinstance(environments, slice) else environments.cpu().numpy()
            self._phases[which] = self.config.phases if phases is None else phases
        if moving:
            self._held[environments] = self._displacements().to(self._held)[environments]
            if everywhere:
                self._shown = self._before = self._displacements_along()
        self._goal[environments] = self._held[environments]
        return self._held[environments]

    def begin_step(self) -> None:
        """Let held control nodes move to where they will be at the end of the step that comes next."""
        self._used = self._used or self.moving
        if not self._used:
            return
        self._changed += self._duration
        going = (self._ways.any(1) | self._ways_now().any(1)) / np.array(self.config.periods)
        self._phases = (self._phases + self._duration * going) % 1.0
        self._before, self._shown = self._shown, self._displacements_along()
        self._goal.copy_(self._displacements())
        self._target[:, self._pinned] = self._held[:, None]
        self._velocity[:, self._pinned] = ((self._goal - self._held) / self._duration)[:, None]

    def _ways_now(self) -> np.ndarray:
        """How far breath and heart move held tissue while amplitudes fade [2, 3], m."""
        if self._changed >= self.config.fade:
            return self._ways
        share = self._changed / self.config.fade
        return self._old_ways + share**2 * (3 - 2 * share) * (self._ways - self._old_ways)

    def _displacements(self) -> Tensor:
        """Of held tissue in all copies, for their phases [B, 3], m."""
        # One by one: the same bits for any number of copies.
        breath, heart = self._ways_now()
        moved = [breath_share(phases[0], 1.0) * breath + beat_share(phases[1], 1.0) * heart for phases in self._phases.tolist()]
        return torch.from_numpy(np.array(moved, np.float32))

    def _displacements_along(self) -> np.ndarray:
        """Displacements of the first copy by breath and heart [2], m, each along its direction."""
        breath, beat = self._phases[0].tolist()
        return np.linalg.norm(self._ways_now(), axis=1) * [breath_share(breath, 1.0), beat_share(beat, 1.0)]
