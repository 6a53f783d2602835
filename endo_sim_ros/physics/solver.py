"""The material point solver: owns the grid and the state of the moving nodes, and takes steps."""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import warp as wp

from endo_sim_ros.core.device import cpu_threads, init_warp, on_torch_stream, pick_device, run_in_threads
from endo_sim_ros.physics.backends import cluster_kernels as cluster
from endo_sim_ros.physics.backends.cpu_kernels import LANES, SCRATCH, STRESSES, make_step_kernel
from endo_sim_ros.physics.backends.warp_kernels import (
    REDUCING,
    Grid,
    Loads,
    Nodes,
    RigidTools,
    State,
    Substep,
    Transfer,
    collect,
    end_step,
    make_advance_kernel,
    scatter,
    update_grid,
)
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.physics.cutting import CutTable, first_nodes
from endo_sim_ros.physics.materials import energy_density, lame_parameters
from endo_sim_ros.physics.regions import TissueProperties
from endo_sim_ros.physics.substeps import plan_substeps

# Springs that hold nodes, over the stiffness (λ + 2μ) V/h² of a cell's tissue, so that all springs in a cell together are as stiff
# however many nodes share it. Stiffer ones lock tissue that is few cells thick; softer ones let tissue lag behind its jaw.
PIN_STIFFNESS = 100.0
HOLD_STIFFNESS = 400.0
MARGIN_CELLS = 2.0  # between the nodes and the edge of the grid; a spline reaches 1.5
MIN_CELL, MAX_CELL = 1e-6, 1e3  # m; beyond these float32 no longer holds masses and stiffnesses
MAX_GRID_NODES = 64_000_000  # 28 bytes each
BLOCK = 64  # threads of a GPU's block: a few thousand nodes then reach many multiprocessors
STENCIL = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(27, 3)  # grid nodes around a node, k fastest


# Held while a graph is captured on a GPU: what another thread launches there meanwhile would become part of it.
capturing = threading.Lock()


@dataclass(frozen=True)
class Launch:
    """A kernel with what it is launched with."""

    kernel: wp.Kernel
    dim: int | tuple[int, ...]
    inputs: list
    block: int = BLOCK  # threads of a GPU's block


class MpmSolver:
    """MLS-MPM over control nodes on one device, for one or many environments.

    The state lives in a local frame (world axes, origin at the grid's corner) as displacement from rest, so that a
    scene metres from the world's origin is as accurate as one at it and an undisturbed rest state is an exact fixed
    point. A step whose end is bad (see `end_step`) is undone in its environment. On a CPU, and on a GPU with rest
    kinematics, the same inputs give the same bits.

    Args:
        nodes: The nodes at rest, the same in all environments.
        config: Material, substeps, grid and device.
        properties: Stiffness and density of each node; default: those of the config everywhere.
        environments: Number of independent copies B.
        tools: Number of rigid tools T in each.
        stiffness: Factor on the moduli of each environment [B], or of each of its nodes [B, M]; default 1. The largest
            one is also the largest that `set_stiffness` takes later.
        vectorised: Use the CPU's own kernel where there is one; False runs the kernels of the GPU on it, to compare.

    Raises:
        StabilityError: If the substeps are too long for the material.
        ValueError: If the grid would be absurdly large, or nodes, properties and stiffness do not fit together.
    """

    def __init__(
        self,
        nodes: ControlNodes,
        config: PhysicsConfig,
        properties: TissueProperties | None = None,
        *,
        environments: int = 1,
        tools: int = 1,
        stiffness: np.ndarray | None = None,
        vectorised: bool = True,
    ):
        init_warp()
        self.device = pick_device(config.device)
        self.config = config
        if environments < 1 or tools < 0:
            raise ValueError(f"there must be at least one environment and no fewer than zero tools, not {environments} and {tools}")
        self.environments, self.tool_count, self.node_count = environments, tools, len(nodes)
        if properties is None:
            properties = TissueProperties.uniform(len(nodes), config.young_modulus, config.poisson_ratio, config.density)
        if len(properties) != len(nodes):
            raise ValueError(f"there are properties of {len(properties)} nodes, but the tissue has {len(nodes)}")
        scale = np.ones(environments) if stiffness is None else np.asarray(stiffness, np.float64)
        good = scale.shape in ((environments,), (environments, len(nodes))) and np.isfinite(scale).all() and (scale > 0).all()
        if not good:
            raise ValueError(f"stiffness must be {environments} positive factors, got {np.round(scale, 4).tolist()}")
        self.largest_stiffness = float(scale.max())
        self.reducing = 1 if self.device == "cpu" else REDUCING  # threads that add up for one environment
        self.cell_size = h = config.grid_ratio * nodes.spacing
        if not MIN_CELL <= h <= MAX_CELL:
            raise ValueError(
                f"the grid cells would be {h:.3g} m wide, which is no tissue; is the model in metres, and is it the viewpoint's own?"
            )
        bad = np.flatnonzero(~((nodes.volumes > 0) & np.isfinite(nodes.volumes)))
        if len(bad):
            raise ValueError(f"the volume of node {bad[0]} is {nodes.volumes[bad[0]]:g} m³; every node must have some")
        self.substepping = plan_substeps(config, h, properties, self.largest_stiffness)
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
        if not environments * cells.prod() <= MAX_GRID_NODES:  # as floats: a product of integers could wrap around
            raise ValueError(
                f"the simulation grid would have {cells[0]:.0f}×{cells[1]:.0f}×{cells[2]:.0f} nodes of {h:.3g} m"
                + f" in each of {environments} environments" * (environments > 1)
                + "; remove outlying Gaussians, lower node_count or raise grid_ratio"
            )
        self.grid_shape = tuple(int(n) for n in cells)
        local = (rest - self.origin).astype(np.float32)
        self.rest_cells = local.astype(np.float64) / h  # [M, 3] rest positions, in cells of the grid
        self._grid = Grid()
        self._grid.h, self._grid.inverse_h = h, 1 / h
        self._grid.nx, self._grid.ny, self._grid.nz = self.grid_shape
        self._grid.count = int(cells.prod())

        lame = [lame_parameters(*each) for each in zip(properties.young_modulus, properties.poisson_ratio)]
        self.mu, self.lam = np.array(lame).T  # [M] Pa each
        hold = HOLD_STIFFNESS * (self.lam + 2 * self.mu) * nodes.volumes / h**2
        self._hold = torch.from_numpy(hold).to(self.device)  # [M] N/m, for a factor of one
        self._pinned = torch.from_numpy(nodes.pinned).to(self.device)
        self.nodes = Nodes()
        self.nodes.X = self._array(local, wp.vec3)
        self.nodes.mass = self._array(nodes.volumes * properties.density, float)
        self.nodes.volume = self._array(nodes.volumes, float)
        self.nodes.mu, self.nodes.lam = self._array(self.mu, float), self._array(self.lam, float)
        count = environments * len(nodes)
        self.nodes.stiffness, self.pin_springs, self._scale = (self._zeros(count, float) for _ in range(3))  # [B · M]; N/m, N/m, 1
        self.loads = Loads()
        self.loads.force, self.loads.target, self.loads.target_v = (self._zeros(count, wp.vec3) for _ in range(3))
        self.loads.spring = self._zeros(count, float)
        self.loads.holder = wp.full(count, -1, dtype=int, device=self.device)
        self.set_stiffness(slice(None), np.broadcast_to(scale.reshape(environments, -1), (environments, len(nodes))))
        self.rigid = RigidTools()
        self.rigid.count, self.rigid.friction = tools, config.friction
        self.rigid.tip, self.rigid.tip_v, self.rigid.end, self.rigid.end_v = (self._zeros(environments * tools, wp.vec3) for _ in range(4))
        self.rigid.radius = self._zeros(environments * tools, float)
        self._given, (self.rigid.impulse, self.rigid.moment) = self._together(count * tools, wp.vec3, wp.vec3)
        (self._saved, self.state), (self._backed_up, self._backup) = self._new_state(), self._new_state()
        self.bad_nodes = self._zeros(environments, int)  # in the last step; where there were any it was undone
        self._speed_sq = self._zeros(environments, float)
        self._substep = Substep()
        self._substep.dt = self.substepping.dt
        self._substep.decay = math.exp(-config.damping * self.substepping.dt)
        self._substep.gravity = wp.vec3(*config.gravity)
        self._substep.ratio = config.relaxation
        self._substep.forget = -math.expm1(-self.substepping.dt / config.relaxation_time)
        self._before: list[Launch] = []
        self._after: list[Launch] = []
        self._last: list[Launch | list[Launch]] = []
        self._vectorised = vectorised and self.device == "cpu" and config.material in STRESSES
        self._advance: Callable[[], None] | None = None
        self.set_cut(None)
        self.reset()

    def _array(self, values: np.ndarray, dtype) -> wp.array:
        values = np.ascontiguousarray(values, np.int32 if dtype in (int, wp.vec3i) else np.float32)
        return wp.array(values, dtype=dtype, device=self.device)

    def _zeros(self, count: int, dtype) -> wp.array:
        return wp.zeros(count, dtype, device=self.device)

    def _together(self, count: int, *dtypes) -> tuple[wp.array, list[wp.array]]:
        """Arrays of zeros that lie one after the other, and all of them as one array of float, to be copied or cleared at once."""
        sizes = [count * wp.types.type_size(dtype) for dtype in dtypes]
        everything = torch.zeros(sum(sizes), device=self.device)
        parts = [part.view(count, *dtype._shape_) for part, dtype in zip(everything.split(sizes), dtypes)]
        arrays = [wp.from_torch(part, dtype, requires_grad=False) for part, dtype in zip(parts, dtypes)]
        return wp.from_torch(everything, requires_grad=False), arrays

    def _new_state(self) -> tuple[wp.array, State]:
        """What a bad step brings back, as one array, and the state."""
        state, count = State(), self.environments * self.node_count
        saved, (state.u, state.F, state.Q) = self._together(count, wp.vec3, wp.mat33, wp.mat33)
        state.v, state.C = self._zeros(count, wp.vec3), self._zeros(count, wp.mat33)
        return saved, state

    def reset(self, environments: torch.Tensor | slice = slice(None)) -> None:
        """Back to rest, no force, nothing held but the pinned nodes, in these environments."""
        shape = (self.environments, self.node_count)

        def of(array: wp.array) -> torch.Tensor:
            values = wp.to_torch(array)
            return values.view(*shape, *values.shape[1:])

        for array in (self.loads.force, self.loads.target, self.loads.target_v, self.state.u, self.state.v, self.state.C, self.state.Q):
            of(array)[environments] = 0
        of(self.state.F)[environments] = torch.eye(3, device=self.device)
        of(self.loads.holder)[environments] = -1
        of(self.loads.spring)[environments] = of(self.pin_springs)[environments]

    def set_stiffness(self, environments: torch.Tensor | slice, stiffness: np.ndarray) -> None:
        """Other factors on the moduli [K, M] in these K environments; what pins or pushes their nodes is as much stiffer.

        Raises:
            ValueError: If one is not above zero, or larger than any factor that the substeps were planned for.
        """
        stiffness = np.asarray(stiffness, np.float64)
        if stiffness.ndim != 2 or stiffness.shape[1] != self.node_count:
            raise ValueError(f"stiffness has shape {stiffness.shape}, expected [K, {self.node_count}], a factor for each node")
        if not ((stiffness > 0) & (stiffness <= self.largest_stiffness)).all():
            raise ValueError(f"stiffness factors must lie above 0 and not above {self.largest_stiffness:g}, the largest planned for")
        factors = torch.from_numpy(stiffness.copy()).to(self.device)
        hold = factors * self._hold
        pins = PIN_STIFFNESS / HOLD_STIFFNESS * hold * self._pinned
        for array, values in ((self._scale, factors), (self.nodes.stiffness, hold), (self.pin_springs, pins)):
            wp.to_torch(array).view(self.environments, -1)[environments] = values.float()
        springs = wp.to_torch(self.loads.spring).view(self.environments, -1)
        springs[environments] = torch.where(self._pinned, pins.float(), springs[environments])

    def set_cut(self, cut: CutTable | None) -> None:
        """Let nodes beside a cut transfer to grid nodes of their own side; None makes the tissue whole again.

        Raises:
            ValueError: With current kinematics, whose nodes change their grid nodes in every substep.
        """
        if cut is not None and self.config.kinematics == "current":
            raise ValueError("tissue with current kinematics cannot be cut; set kinematics to rest")
        self._first = first_nodes(self.rest_cells, self.grid_shape)  # [M, 3]
        self._row, self._table = np.full(self.node_count, -1), np.zeros((0, 27), int)
        if cut is not None:
            self._first[cut.affected], self._row[cut.affected] = cut.base, np.arange(len(cut.affected))
            self._table = cut.table
        self._grid.count = math.prod(self.grid_shape) + (cut.extra if cut is not None else 0)
        self.nodes.first, self.nodes.row = self._array(self._first, wp.vec3i), self._array(self._row, int)
        self.nodes.table = self._array(self._table.ravel() if len(self._table) else np.zeros(1), int)
        self._advance = None
        if self.device == "cpu":  # now, where nobody waits, rather than when the tissue is first touched
            self._advance = self._prepare()

    def load_kernels(self) -> None:
        """Load now what a step of cut tissue may need on a GPU: its grid nodes can become too many for one launch."""
        if self.device != "cpu":
            for kernel in (make_advance_kernel(self.config.material, self.config.kinematics), collect):
                wp.load_module(kernel.module, self.device, block_dim=BLOCK)

    def surround(self, before: list[Launch], after: list[Launch]) -> None:
        """Make these launches part of every step, on a GPU of the one graph that it is."""
        self._before, self._after = before, after
        self._advance = self._prepare() if self.device == "cpu" else None

    def end_with(self, last: list[Launch | list[Launch]]) -> None:
        """Make these launches the end of every step, in place of earlier ones; those in a list may run at the same time."""
        self._last = last
        self._advance = self._prepare() if self.device == "cpu" else None

    def launch(self, launch: Launch) -> None:
        """Launch now."""
        with on_torch_stream(self.device):
            wp.launch(launch.kernel, launch.dim, launch.inputs, device=self.device, block_dim=launch.block)

    def prepare(self) -> None:
        """Make ready now what the next step would otherwise begin with: on a GPU its recording, and at first its kernels."""
        if self._advance is None:
            self._advance = self._prepare()

    def step(self) -> None:
        """Take one step in every environment."""
        self.prepare()
        with on_torch_stream(self.device):
            self._advance()

    @property
    def speed(self) -> float:
        """Speed of the fastest node at the end of the last step, m/s."""
        with on_torch_stream(self.device):
            return math.sqrt(max(float(self._speed_sq.numpy().max()), 0.0))

    def _prepare(self) -> Callable[[], None]:
        """The whole step as one call; loads and tools are read from their device arrays every time."""
        if self.device == "cpu":
            # No graph: a capture on the CPU takes in, and does not run, what other threads of the process launch meanwhile.
            actions = self._actions()
            return lambda: [action() for action in actions]
        actions = self._actions()
        with capturing, wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for action in actions:
                action()
        wp.synchronize_device(self.device)  # its arrays were filled on another stream than torch's, on which it runs
        self._captured = actions  # a graph does not keep the memory that it works in
        return partial(wp.capture_launch, capture.graph)

    def _actions(self) -> list[Callable[[], None]]:
        """What one step does, in order; memory and modules are ready when it returns."""
        threads = self.reducing
        check = [threads, self.node_count, self.config.travel, self._backup, self.state, self.bad_nodes, self._speed_sq]
        actions = [self._action(launch) for launch in self._before]
        actions += [partial(wp.copy, self._backed_up, self._saved), self._given.zero_]
        actions += self._vectorised_step() if self._vectorised else self._clustered_step() or self._launched_substeps()
        actions.append(self._action(Launch(end_step, (self.environments, threads), check, threads)))
        return actions + [self._action(launch) for launch in (*self._after, *self._last)]

    def _action(self, launch: Launch | list[Launch]) -> Callable[[], None]:
        """The launch as a call; a list of them is shared out among threads on the CPU, and in order on a GPU."""
        if isinstance(launch, list):
            actions = [self._action(each) for each in launch]
            return partial(run_in_threads, actions) if self.device == "cpu" else lambda: [action() for action in actions]
        arguments = (launch.kernel, launch.dim, launch.inputs)
        if self.device == "cpu":
            wp.load_module(launch.kernel.module, device="cpu")
            return wp.launch(*arguments, device="cpu", record_cmd=True).launch
        wp.load_module(launch.kernel.module, device=self.device, block_dim=launch.block)
        return partial(wp.launch, *arguments, device=self.device, block_dim=launch.block)

    def _vectorised_step(self) -> list[Callable[[], None]]:
        """CPU: one launch for all substeps; environments are shared out among threads, each with its scratch memory."""
        kernel = make_step_kernel(self.config.material, self.config.kinematics)
        slots = min(cpu_threads(), self.environments)
        padded = -(-self.node_count // LANES) * LANES
        order = np.full(padded, -1)
        order[: self.node_count] = np.lexsort(self._first.T[::-1])
        scratch = [self._array(order, int)]
        scratch += [self._zeros(slots * 4 * (self._grid.count + 4), float) for _ in range(2)]
        scratch += [self._zeros(slots * SCRATCH * padded, float), self._zeros(slots * padded, int)]
        scratch += [self._zeros(slots * 4 * padded, float), wp.full(slots * padded, -1, dtype=int, device="cpu")]
        inputs = [self.nodes, self.state, self.loads, self.rigid, self._grid, self._substep, self.substepping.count]
        ends = [self.environments * slot // slots for slot in range(slots + 1)]
        launches = [
            self._action(Launch(kernel, end - begin, [begin, slot, *inputs, self._scale, *scratch]))
            for slot, (begin, end) in enumerate(zip(ends, ends[1:]))
        ]
        return [lambda: run_in_threads(launches)]

    def _clustered_step(self) -> list[Callable[[], None]]:
        """One launch for all substeps, on a GPU with clusters of multiprocessors; none for more nodes than they hold."""
        # What it compiles for, which is less than the GPU where another one in the machine is older.
        arch = wp.get_device(self.device).get_cuda_compile_arch()
        if arch is None or arch < 90 or self.config.kinematics == "current":
            return []
        division = cluster.divide(self.rest_cells, self._corners())
        if division is None:
            return []
        device, memory = wp.get_device(self.device), 16 * cluster.SHARED
        if device.max_shared_memory_per_block < memory + cluster.OTHERS:
            return []
        kernel = cluster.make_step_kernel(self.config.material, division.lanes)
        if wp.get_cuda_max_cluster_dim(kernel, device, block_dim=cluster.BLOCK, dynamic_smem_bytes=memory) < cluster.CLUSTER:
            return []
        tables = [wp.array(values, dtype=int, device=device) for values in division[3:]]
        inputs = [self.nodes, self.state, self.loads, self.rigid, self._grid, self._substep, self.substepping.count, self._scale]
        inputs += [division.slots, division.inbox, *tables]
        return [self._action(Launch(kernel, self.environments * cluster.THREADS, inputs, cluster.BLOCK))]

    def _launched_substeps(self) -> list[Callable[[], None]]:
        """Two launches for each substep with rest kinematics, three with current kinematics."""
        current = self.config.kinematics == "current"
        advance = make_advance_kernel(self.config.material, self.config.kinematics)
        every, grid_count = (self.environments, self.node_count), self.environments * self._grid.count
        transfer = Transfer()
        transfer.given, transfer.pull = self._zeros(4 * math.prod(every), wp.vec4), self._zeros(math.prod(every), wp.vec4)
        transfer.giver = wp.full(math.prod(every), -1, dtype=int, device=self.device)
        grid_v, decay = self._zeros(grid_count, wp.vec4), self._substep.decay
        if current:
            grid_mv = self._zeros(grid_count, wp.vec4)
            collecting = [
                self._action(Launch(scatter, every, [self.nodes, self.state, transfer, self._grid, grid_mv])),
                self._action(Launch(update_grid, grid_count, [decay, grid_mv, grid_v])),
            ]
            actions = [grid_mv.zero_]
        else:
            lanes, entries = 1 if self.device == "cpu" else 32, self._entries()
            inputs = [*entries, lanes, self.node_count, self._grid, decay, transfer, grid_v]
            collecting = [self._action(Launch(collect, (self.environments, len(entries[-1]), lanes), inputs))]
            actions = []
        constants = [self.nodes, self.state, self.loads, self.rigid, transfer, self._grid, self._substep, self._scale]
        for substep in range(self.substepping.count + 1):
            halves = [int(substep > 0), int(substep < self.substepping.count)]
            time = (substep + 1) * self.substepping.dt
            actions.append(self._action(Launch(advance, every, [*constants, time, *halves, grid_v])))
            if substep < self.substepping.count:
                actions += collecting
        return actions

    def _corners(self) -> np.ndarray:
        """Numbers of each node's grid nodes [M, 27], for rest kinematics."""
        corners = np.ravel_multi_index(tuple(np.moveaxis(self._first[:, None] + STENCIL, -1, 0)), self.grid_shape)
        corners[self._row >= 0] = self._table[self._row[self._row >= 0]]
        return corners

    def _entries(self) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """For each grid node the nodes that give to it, as `collect` reads them."""
        f = self.rest_cells - self._first  # [M, 3]
        splines = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], -1)  # [M, 3, 3]
        weights = splines[:, 0, STENCIL[:, 0]] * splines[:, 1, STENCIL[:, 1]] * splines[:, 2, STENCIL[:, 2]]  # [M, 27]
        offsets = np.concatenate([STENCIL - f[:, None], weights[..., None]], -1).reshape(-1, 4)
        numbers = self._corners().ravel()
        order = np.argsort(numbers, kind="stable")
        places, counts = np.unique(numbers, return_counts=True)
        starts = np.concatenate([[0], np.cumsum(counts)])
        return self._array(starts, int), self._array(order // 27, int), self._array(offsets[order], wp.vec4), self._array(places, int)

    def displacements(self, environment: int = 0) -> np.ndarray:
        """Displacements [M, 3], m, world axes. Those of pinned nodes are how far their springs give way."""
        return self._of(self.state.u, environment)

    def deformation_gradients(self, environment: int = 0) -> np.ndarray:
        """F of all nodes [M, 3, 3]."""
        return self._of(self.state.F, environment)

    def _of(self, array: wp.array, environment: int) -> np.ndarray:
        with on_torch_stream(self.device):
            return array.numpy()[environment * self.node_count : (environment + 1) * self.node_count].copy()

    def momentum(self, environment: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Linear momentum [3], kg·m/s, and angular momentum about the world's origin [3], kg·m²/s, of all nodes.

        The angular momentum has the part that APIC carries in C: Σ m h²/4 ε : C, with rest kinematics ε : C Fᵀ."""
        mass = self.nodes.mass.numpy().astype(np.float64)[:, None]
        v, C, F = (self._of(array, environment).astype(np.float64) for array in (self.state.v, self.state.C, self.state.F))
        x = self.nodes.X.numpy().astype(np.float64) + self.displacements(environment) + self.origin
        if self.config.kinematics == "rest":
            C = C @ F.transpose(0, 2, 1)
        spin = np.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], 1)
        return (mass * v).sum(0), (mass * (np.cross(x, v) + self.cell_size**2 / 4 * spin)).sum(0)

    def energy(self, environment: int = 0) -> tuple[float, float]:
        """Kinetic energy (with the affine motion that APIC carries) and elastic energy, J."""
        mass, volume = self.nodes.mass.numpy().astype(np.float64), self.nodes.volume.numpy().astype(np.float64)
        v, C = (self._of(array, environment).astype(np.float64) for array in (self.state.v, self.state.C))
        kinetic = 0.5 * (mass * ((v**2).sum(1) + self.cell_size**2 / 4 * (C**2).sum((1, 2)))).sum()
        F = torch.from_numpy(self.deformation_gradients(environment)).double()
        mu, lam = (torch.from_numpy(self._of(self._scale, environment) * values) for values in (self.mu, self.lam))
        return float(kinetic), float((volume * energy_density(self.config.material, F, mu, lam).numpy()).sum())
