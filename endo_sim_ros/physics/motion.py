"""Breath and heart: how they move what holds the tissue."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.motion import MOTIONS, beat_share, breath_share
from endo_sim_ros.core.tissue_motion import PeriodicMotion
from endo_sim_ros.physics.backends.structs import Loads
from endo_sim_ros.physics.config import MotionConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.physics.stencils import Stencils


class MotionState(NamedTuple):
    """Of breath and heart at one time, [2] each."""

    phases: np.ndarray  # part of the period that is over, 0 to 1
    rates: np.ndarray  # periods per second
    displacements: np.ndarray  # of held tissue along the direction of the motion, m; of what was found, where it goes farthest
    velocities: np.ndarray  # of it, mean over the last step, m/s


@dataclass(frozen=True)
class _Found:
    """A motion that was found, as it is played."""

    which: int  # 0 breath, 1 heart
    part: PeriodicMotion
    amplitude: float  # that was found, m
    direction: np.ndarray  # [3], world, 1/m: over how far a place goes whose share is 1

    def path(self, phase: float) -> np.ndarray:
        """Where a place whose share is 1 is [3], m, at a phase."""
        return self.part.path(np.array([phase * self.part.period]))[0]

    def along(self, phase: float) -> float:
        """How far tissue is, from its mean and along the direction, that goes a metre there and back."""
        return float(self.path(phase) @ self.direction)


class HeldMotion:
    """Moves the ends of the springs that hold pinned control nodes; the rest is the physics.

    At the end of each step they are where the waveforms of `core/motion.py`, or those that were found, have them at its time, and move
    there evenly, so that their position is continuous and their velocity that of the position. Where a step was undone, they catch up
    in the next. Phases go on from step to step, whatever the periods.

    Each follows P paths by its shares, see `backends/motion_kernels.py`: one that all go alike, which strains nothing by itself, and
    one more for each motion that was found. Shares and slopes of that are as the grid has them: tissue that begins displaced by them
    comes to rest where it would have, had it begun at rest.

    Args:
        config: What moves.
        duration: Of a step, s.
        nodes: The control nodes [M].
        stencils: Theirs, of whole tissue.
        cell_size: Of the grid, m.
        loads: Of all copies [B · M].
        copies: B.

    Raises:
        ValueError: If the config has a file, and the control nodes have no motion that was found.
    """

    def __init__(
        self, config: MotionConfig, duration: float, nodes: ControlNodes, stencils: Stencils, cell_size: float, loads: Loads, copies: int
    ):
        self.config, self._duration = config, duration
        motion = nodes.motion if config.file else None
        if config.file and motion is None:
            raise ValueError(f"motion.file {config.file}: these control nodes have no motion; make them with build_control_nodes and that")
        self._found: list[_Found] = []
        follows = np.zeros((len(nodes), 1, 4), np.float32)
        follows[:, 0, 0] = 1
        if motion is not None:
            self._found = [_Found(MOTIONS.index(p.name), p, a, p.direction / p.reach) for p, a in zip(motion.parts, motion.amplitudes)]
            own = stencils.transferred(motion.follows(nodes.rest.astype(np.float64)), nodes.volumes.astype(np.float64), cell_size)
            follows = np.concatenate([follows, own.astype(np.float32)], 1)
        device, paths = str(loads.target.device), (copies, follows.shape[1])
        self._pinned = torch.from_numpy(np.flatnonzero(nodes.pinned)).to(device)
        self._target, self._velocity = (wp.to_torch(each).view(copies, len(nodes), 3) for each in (loads.target, loads.target_v))
        self.follows = wp.array(follows, dtype=wp.vec4, device=device)  # shares of paths, and their slopes, 1/m [M, P]
        self.held = wp.zeros(paths, wp.vec3, device=device)  # where the paths are, from rest [B, P], m
        self.goal = wp.zeros(paths, wp.vec3, device=device)  # the same at the end of the step
        self._follows, self._held, self._goal = wp.to_torch(self.follows), wp.to_torch(self.held), wp.to_torch(self.goal)
        self._shares = self._follows[self._pinned, :, :1]
        self._phases = np.tile(np.array(config.phases), (copies, 1))  # [B, 2]
        self._ways = self._old_ways = self._ways_of(config)
        self._changed = np.inf  # s since they became others
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

    def shifts(self, environments: Tensor | slice = slice(None)) -> Tensor:
        """How far breath and heart have moved where control nodes rest, in these K copies [K, M, 3], m."""
        return _followed(self._follows[:, :, :1], self._held[environments])

    def gradients(self, environments: Tensor | slice = slice(None)) -> Tensor:
        """The deformation gradients of `shifts` [K, M, 3, 3]."""
        paths, slopes = self._held[environments], self._follows[:, :, 1:]
        strain = torch.eye(3, device=paths.device).expand(len(paths), len(slopes), 3, 3)
        for i in range(1, paths.shape[1]):  # the first has no slope
            strain = strain + paths[:, None, i, :, None] * slopes[:, i, None]
        return strain

    def change(self, config: MotionConfig) -> None:
        """Move otherwise from now on: with other periods at once, each from its phase, and with other amplitudes within `fade`.

        Raises:
            ValueError: If the file is another; nothing changes then.
        """
        if config.file != self.config.file:
            raise ValueError(f"motion.file is {self.config.file!r} of this tissue; build it anew for {config.file!r}")
        ways = self._ways_of(config)
        if not np.array_equal(ways, self._ways) or config.fade != self.config.fade:
            self._old_ways, self._ways, self._changed = self._ways_now(), ways, 0.0
        self.config = config

    def copy(self, other: "HeldMotion") -> None:
        """Go on from where another motion of the same control nodes is, towards what this one's config has."""
        config = self.config
        self.config, self._phases, self._used = other.config, other._phases.copy(), other._used
        self._ways, self._old_ways, self._changed = other._ways, other._old_ways, other._changed
        self._shown, self._before = other._shown, other._before
        self._held.copy_(other._held)
        self.change(config)

    def reset(self, environments: Tensor | slice = slice(None), phases: np.ndarray | None = None) -> None:
        """Begin anew in these K copies, with phases [K, 2] or those of the config; `shifts` then tells where tissue begins."""
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
            self._held[environments] = self._paths().to(self._held)[environments]
            if everywhere:
                self._shown = self._before = self._displacements_along()
        self._goal[environments] = self._held[environments]

    def begin_step(self) -> None:
        """Let held control nodes move to where they will be at the end of the step that comes next."""
        self._used = self._used or self.moving
        if not self._used:
            return
        self._changed += self._duration
        going = (self._ways.any(1) | self._ways_now().any(1)) / np.array(self.config.periods)
        self._phases = (self._phases + self._duration * going) % 1.0
        self._before, self._shown = self._shown, self._displacements_along()
        self._goal.copy_(self._paths())
        self._target[:, self._pinned] = _followed(self._shares, self._held)
        self._velocity[:, self._pinned] = _followed(self._shares, (self._goal - self._held) / self._duration)

    def _ways_of(self, config: MotionConfig) -> np.ndarray:
        """How far breath and heart move held tissue [2, 4], m: along x, y and z, or as the last number what goes as it was found to."""
        ways = np.concatenate([config.ways, np.zeros((2, 1))], 1)
        for found in self._found:
            ways[found.which] = 0, 0, 0, getattr(config, found.part.name)
        return ways

    def _ways_now(self) -> np.ndarray:
        """The same while amplitudes fade."""
        if self._changed >= self.config.fade:
            return self._ways
        share = self._changed / self.config.fade
        return self._old_ways + share**2 * (3 - 2 * share) * (self._ways - self._old_ways)

    def _paths(self) -> Tensor:
        """Where the paths are in all copies, for their phases [B, P, 3], m."""
        # One by one: the same bits for any number of copies.
        ways = self._ways_now()
        breath, heart = ways[:, :3]
        paths = [[breath_share(phases[0], 1.0) * breath + beat_share(phases[1], 1.0) * heart] for phases in self._phases.tolist()]
        for own, phases in zip(paths, self._phases.tolist()):
            own += [ways[found.which, 3] / found.amplitude * found.path(phases[found.which]) for found in self._found]
        return torch.from_numpy(np.array(paths, np.float32))

    def _displacements_along(self) -> np.ndarray:
        """Displacements of the first copy by breath and heart [2], m, each along its direction."""
        breath, beat = self._phases[0].tolist()
        ways = self._ways_now()
        along = np.linalg.norm(ways[:, :3], axis=1) * [breath_share(breath, 1.0), beat_share(beat, 1.0)]
        for found in self._found:
            along[found.which] += ways[found.which, 3] * found.along(self._phases[0, found.which])
        return along


def _followed(shares: Tensor, paths: Tensor) -> Tensor:
    """How far paths [K, P, 3] take control nodes with shares of them [M, P, 1]: [K, M, 3]."""
    shifts = shares[:, 0] * paths[:, None, 0]
    for i in range(1, paths.shape[1]):
        shifts = shifts + shares[:, i] * paths[:, None, i]
    return shifts
