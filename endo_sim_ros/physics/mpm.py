"""The material point solver: owns the grid and the state of the moving nodes, and takes steps."""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import warp as wp

from endo_sim_ros.device import init_warp, pick_device
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.physics.materials import energy_density, lame_parameters, sound_speed
from endo_sim_ros.physics.mpm_kernels import Grid, Nodes, check_nodes, make_advance_kernel, update_grid

CFL_LIMIT = 0.7  # c Δt / h; measured: 0.7 runs, 0.9 blows up
CFL_CHOSEN = 0.5  # leaves room for tissue that stiffens where it is compressed
PIN_STIFFNESS = 50.0  # of a pinned node's spring, over that of a cube of tissue of its volume
MARGIN_CELLS = 2.0  # between the nodes and the edge of the grid; a spline reaches 1.5
MIN_CELL, MAX_CELL = 1e-6, 1e3  # m; beyond these float32 no longer holds masses and stiffnesses
MAX_GRID_NODES = 64_000_000  # 28 bytes each


# Held while a graph is captured on a GPU: what another thread launches there meanwhile would become part of it.
capturing = threading.Lock()


class StabilityError(ValueError):
    """A material that the chosen substep cannot follow; the message names the numbers and the substep that could."""


@dataclass(frozen=True)
class Substepping:
    """How one step is divided."""

    count: int
    dt: float  # s
    cfl: float  # c Δt / h


def plan_substeps(config: PhysicsConfig, cell_size: float) -> Substepping:
    """Divide a step so that the Courant number c Δt/h is stable: as few substeps as are safe, or those configured.

    Args:
        config: Material and substeps asked for; with ``adapt_substeps`` these give the duration of the step only.
        cell_size: Grid cell size h, metres.

    Raises:
        StabilityError: If the substeps are too long and ``adapt_substeps`` is off.
    """
    speed = sound_speed(config.young_modulus, config.poisson_ratio, config.density)
    count = config.substeps
    if config.adapt_substeps:
        count = math.ceil(config.step_duration * speed / (CFL_CHOSEN * cell_size))
    dt = config.step_duration / count
    cfl = speed * dt / cell_size
    if cfl > CFL_LIMIT:
        fitting = math.ceil(count * cfl / CFL_LIMIT)
        raise StabilityError(
            f"young_modulus {config.young_modulus:g} Pa, poisson_ratio {config.poisson_ratio:g} and density"
            f" {config.density:g} kg/m³ on a grid of {cell_size:.3g} m give a Courant number of {cfl:.2f} with {count}"
            f" substeps of {dt:g} s (limit {CFL_LIMIT}); use {fitting} substeps of {config.step_duration / fitting:.3g} s,"
            " adapt_substeps, or a softer material"
        )
    return Substepping(count, dt, cfl)


class MpmSolver:
    """MLS-MPM over control nodes on one device.

    The state lives in a local frame (world axes, origin at the grid's corner) as displacement from rest, so that a
    scene metres from the world's origin is as accurate as one at it and an undisturbed rest state is an exact fixed
    point. On CPU the solver is serial and bit-for-bit repeatable.

    Args:
        nodes: The nodes at rest.
        config: Material, substeps, grid and device.

    Raises:
        StabilityError: If the substeps are too long for the material and may not be adapted.
        ValueError: If the grid would be absurdly large.
    """

    def __init__(self, nodes: ControlNodes, config: PhysicsConfig):
        init_warp()
        self.device = pick_device(config.device)
        self.config = config
        self.mu, self.lam = lame_parameters(config.young_modulus, config.poisson_ratio)
        self.cell_size = config.grid_ratio * nodes.spacing
        self.substepping = plan_substeps(config, self.cell_size)

        h = self.cell_size
        if not MIN_CELL <= h <= MAX_CELL:
            raise ValueError(
                f"the grid cells would be {h:.3g} m wide, which is no tissue; is the model in metres, and is it the"
                " viewpoint's own?"
            )
        far = float(np.abs(nodes.rest).max())
        if not far * np.finfo(np.float32).eps < 0.01 * h:  # else nodes of one cell fall together, and out of the grid
            raise ValueError(
                f"the tissue lies {far:.3g} m from the world's origin, too far to tell its nodes {nodes.spacing:.3g} m"
                " apart; check the poses of the cameras"
            )
        margin = MARGIN_CELLS * h + (config.travel if config.kinematics == "current" else 0.0)
        rest = nodes.rest.astype(np.float64)
        self.origin = rest.min(0) - margin  # [3] world, m
        cells = np.ceil((rest.max(0) + margin - self.origin) / h) + 1
        if not cells.prod() <= MAX_GRID_NODES:  # as floats: a product of integers could wrap around to a small one
            raise ValueError(
                f"the simulation grid would have {cells[0]:.0f}×{cells[1]:.0f}×{cells[2]:.0f} nodes of {h:.3g} m; remove"
                " outlying Gaussians, lower node_count or raise grid_ratio"
            )
        self.grid_shape = tuple(int(n) for n in cells)
        self._grid = Grid()
        self._grid.h, self._grid.inverse_h = h, 1 / h
        self._grid.nx, self._grid.ny, self._grid.nz = self.grid_shape

        def array(values, dtype):
            return wp.array(values, dtype=dtype, device=self.device)

        # A pinned node's springs are stiffer than the tissue beside it, so that it gives way a few per cent at most.
        self._hold_stiffness = PIN_STIFFNESS * (self.lam + 2 * self.mu) * np.cbrt(nodes.volumes)
        self._pin_stiffness = self._hold_stiffness * nodes.pinned
        count = len(nodes)
        self._nodes = Nodes()
        self._nodes.X = array((rest - self.origin).astype(np.float32), wp.vec3)
        self._nodes.mass = array((nodes.volumes * config.density).astype(np.float32), float)
        self._nodes.volume = array(nodes.volumes.astype(np.float32), float)
        self._nodes.spring = wp.zeros(count, float, device=self.device)
        self._nodes.target = wp.zeros(count, wp.vec3, device=self.device)
        self._nodes.target_v = wp.zeros(count, wp.vec3, device=self.device)
        self._nodes.force = wp.zeros(count, wp.vec3, device=self.device)
        self._nodes.u = wp.zeros(count, wp.vec3, device=self.device)
        self._nodes.v = wp.zeros(count, wp.vec3, device=self.device)
        self._nodes.C = wp.zeros(count, wp.mat33, device=self.device)
        self._nodes.F = wp.empty(count, wp.mat33, device=self.device)
        self._state = (self._nodes.u, self._nodes.v, self._nodes.C, self._nodes.F)
        self._backup = tuple(wp.empty_like(array) for array in self._state)
        self._grid_mv = wp.zeros(self.grid_shape, wp.vec4, device=self.device)
        self._grid_v = wp.zeros(self.grid_shape, wp.vec3, device=self.device)
        self._fault = wp.zeros(1, int, device=self.device)
        self._speed_sq = wp.zeros(1, float, device=self.device)
        self._flat_mv, self._flat_v = self._grid_mv.flatten(), self._grid_v.flatten()
        self._advance: Callable[[], None] | None = None
        self.reset()
        if self.device == "cpu":  # now, where nobody waits, rather than when the tissue is first touched
            self._advance = self._prepare()

    def reset(self) -> None:
        """Back to rest, no force, nothing held but the pinned nodes."""
        self.hold(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))
        for array in (self._nodes.force, self._nodes.u, self._nodes.v, self._nodes.C):
            array.zero_()
        self._nodes.F.fill_(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))

    def set_forces(self, forces: np.ndarray) -> None:
        """Forces on the nodes [M, 3], N, world; kept until set again."""
        self._nodes.force.assign(np.ascontiguousarray(forces, np.float32))

    def hold(self, nodes: np.ndarray, start: np.ndarray, end: np.ndarray) -> None:
        """Springs pull these nodes [K] along: displacements [K, 3] m at the start and at the end of the next step.

        Pinned nodes stay held; all others are free. Kept until called again.
        """
        spring = self._pin_stiffness.copy()
        spring[nodes] = self._hold_stiffness[nodes]
        targets = np.zeros((2, len(spring), 3))
        targets[:, nodes] = start, (end - start) / self.config.step_duration
        for array, values in zip((self._nodes.spring, self._nodes.target, self._nodes.target_v), (spring, *targets)):
            array.assign(np.ascontiguousarray(values, np.float32))

    def holding_forces(self, nodes: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Forces [K, 3] N that the springs exert on these nodes [K] at the end of the step, for the ``end`` given to `hold`."""
        return self._hold_stiffness[nodes, None] * (end - self._nodes.u.numpy()[nodes])

    @property
    def speed(self) -> float:
        """Speed of the fastest node at the end of the last step, m/s."""
        return math.sqrt(max(float(self._speed_sq.numpy()[0]), 0.0))

    def step(self) -> int:
        """Take one step; returns how many nodes ended it non-finite or out of bounds (0 = a good step)."""
        if self._advance is None:
            self._advance = self._prepare()
        self._advance()
        return int(self._fault.numpy()[0])

    def _prepare(self) -> Callable[[], None]:
        """The whole step as one call; forces are read from their device array every time."""
        advance = make_advance_kernel(self.config.material, self.config.kinematics)
        for kernel in (advance, update_grid, check_nodes):
            wp.load_module(kernel.module, device=self.device)
        if self.device == "cpu":
            # No graph: a capture on the CPU takes in, and does not run, what other threads of the process launch meanwhile.
            actions = self._actions(advance, lambda *arguments: wp.launch(*arguments, device="cpu", record_cmd=True).launch)
            return lambda: [action() for action in actions]
        with capturing, wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for action in self._actions(advance, lambda *arguments: partial(wp.launch, *arguments, device=self.device)):
                action()
        return partial(wp.capture_launch, capture.graph)

    def _actions(self, advance: wp.Kernel, launch: Callable[..., Callable[[], None]]) -> list[Callable[[], None]]:
        """What one step does, in order; ``launch`` turns kernel, size and inputs into an action."""
        dt, count = self.substepping.dt, self.substepping.count
        gravity = wp.vec3(*self.config.gravity)
        decay = math.exp(-self.config.damping * dt)
        constants = [self._nodes, self._grid, dt, gravity, self.mu, self.lam]
        actions = [partial(wp.copy, backup, array) for array, backup in zip(self._state, self._backup)]
        actions += [array.zero_ for array in (self._fault, self._speed_sq, self._grid_mv)]
        update = launch(update_grid, len(self._flat_mv), [decay, self._flat_mv, self._flat_v])
        for substep in range(count + 1):
            gather, scatter = int(substep > 0), int(substep < count)
            if gather:
                actions.append(update)
            inputs = [*constants, (substep + 1) * dt, gather, scatter, self._grid_v, self._grid_mv]
            actions.append(launch(advance, len(self._nodes.X), inputs))
        inputs = [self._nodes.u, self._nodes.v, self._nodes.F, self.config.travel, self._fault, self._speed_sq]
        return [*actions, launch(check_nodes, len(self._nodes.X), inputs)]

    def restore(self) -> None:
        """Return to the state before the last step, at rest there."""
        for array, backup in zip(self._state, self._backup):
            wp.copy(array, backup)
        self._nodes.v.zero_()
        self._nodes.C.zero_()

    def displacements(self) -> np.ndarray:
        """Displacements [M, 3], m, world axes. Those of pinned nodes are how far their springs give way."""
        return self._nodes.u.numpy().copy()

    def deformation_gradients(self) -> np.ndarray:
        """F of all nodes [M, 3, 3]."""
        return self._nodes.F.numpy().copy()

    def momentum(self) -> np.ndarray:
        """Total linear momentum of the nodes [3], kg·m/s."""
        return (self._nodes.mass.numpy().astype(np.float64)[:, None] * self._nodes.v.numpy()).sum(0)

    def energy(self) -> tuple[float, float]:
        """Kinetic energy (with the affine motion that APIC carries) and elastic energy, J."""
        mass, volume = self._nodes.mass.numpy().astype(np.float64), self._nodes.volume.numpy().astype(np.float64)
        v, C = self._nodes.v.numpy().astype(np.float64), self._nodes.C.numpy().astype(np.float64)
        kinetic = 0.5 * (mass * ((v**2).sum(1) + self.cell_size**2 / 4 * (C**2).sum((1, 2)))).sum()
        F = torch.from_numpy(self._nodes.F.numpy()).double()
        density = energy_density(self.config.material, F, self.mu, self.lam).numpy()
        return float(kinetic), float((volume * density).sum())
