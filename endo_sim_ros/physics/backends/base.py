"""What a backend does: where the solver's step and skinning run.

A `Launch` is data: a kernel with its arguments, which a room's other files make without knowing the device. `Work` is one, or
several that may run at the same time. `Backend.action` makes an `Action` of it, a call with nothing left to load, and
`Backend.record` one of many: a step.
"""

import functools
import threading
import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import warp as wp
from torch import Tensor

from endo_sim_ros.physics.backends.structs import Grid, Loads, Nodes, RigidTools, Skin, State, Substep
from endo_sim_ros.physics.stencils import Stencils

BLOCK = 64  # threads of a GPU's block: a few thousand control nodes then reach many multiprocessors

Action = Callable[[], object]

viewed: Callable[..., Any] = functools.partial(wp.from_torch, requires_grad=False)
"""A tensor as an array of Warp in the same memory, which keeps the tensor."""

capturing = threading.Lock()
"""Held while a graph is captured on a GPU: what another thread launches there meanwhile would become part of it."""


@dataclass(frozen=True)
class Launch:
    """A kernel with what it is launched with."""

    kernel: Any  # a kernel of Warp
    dim: int | tuple[int, ...]
    inputs: list
    block: int = BLOCK  # threads of a GPU's block


Work = Launch | list[Launch]
"""A launch, or several that may run at the same time."""


@dataclass(frozen=True)
class StepData:
    """What the substeps of a step work on, all on the backend's device."""

    environments: int  # B
    node_count: int  # control nodes M
    material: str
    kinematics: str
    substeps: int  # in a step
    nodes: Nodes
    state: State
    loads: Loads
    tools: RigidTools
    grid: Grid
    substep: Substep
    scale: wp.array  # of the moduli of each control node [B · M]
    stencils: Sequence[Stencils]  # of each environment; the weights are the same in all
    own_cuts: bool  # whether they may differ


class Backend(Protocol):
    """How physics runs on a kind of device."""

    device: str
    threads: int
    """Threads that add up for one environment; they are one block of a GPU."""
    prepares_early: bool
    """Whether a step is made ready when the solver is, rather than when it is first taken."""

    skin_modules: tuple[types.ModuleType, ...]
    """Modules of the kernels of `skin`, to be loaded before."""

    def substeps(self, step: StepData) -> list[Action]:
        """Return what does all substeps, in order; memory and kernels are ready when it returns."""
        ...

    def action(self, work: Work) -> Action:
        """Return work as a call, its kernels loaded."""
        ...

    def record(self, actions: Sequence[Action]) -> Action:
        """Return one call that does all of these in order: on a GPU a captured graph. Arrays are read anew every time."""
        ...

    def launch(self, launch: Launch) -> None:
        """Launch now, in order with torch's own work."""

    def load_for_cuts(self, material: str, kinematics: str) -> None:
        """Load what a step needs once cuts have made more grid nodes than it was made ready for."""

    def over_items(self, kernel: Any, count: int, arguments: Sequence) -> None:
        """Launch a kernel now over count items, whose first argument, not among these, is the number of the first one.

        Args:
            kernel: The kernel; a thread adds `wp.tid()` to its first argument.
            count: Number of items.
            arguments: The others, tensors among them.
        """

    def skin(self, rest: Skin, maps: Tensor, means: Tensor, covars: Tensor) -> None:
        """Move Gaussians now by the maps of their control nodes, see `node_map_kernels`.

        Args:
            rest: Gaussians at rest.
            maps: [M, 4, 4].
            means: Out [N, 3], m, world.
            covars: Out [N, 3, 3], m².
        """

    def skin_work(self, rest: Skin, maps: Tensor, means: Tensor, covars: Tensor) -> list[Work]:
        """Return the work that moves Gaussians in B environments by maps [B, M, 4, 4]; means and covars are [B, N, …]."""
        ...
