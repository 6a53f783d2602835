"""Builds what kernels take, in the memory of a device."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from endo_sim_ros.physics.backends.structs import Grid, Loads, Nodes, RigidTools, State
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.control_nodes import ControlNodes
from endo_sim_ros.physics.grid import GridPlan
from endo_sim_ros.physics.regions import TissueProperties
from endo_sim_ros.physics.stencils import Stencils


def copied(values: np.ndarray, dtype: type, device: str) -> wp.array:
    """Return a copy of values as an array of a Warp type on a device."""
    return wp.array(np.ascontiguousarray(values, np.int32 if dtype in (int, wp.vec3i) else np.float32), dtype=dtype, device=device)


def zeroed(kind: Any, count: int, device: str, **counts: int) -> Any:
    """Return a struct of Warp whose arrays are zeros, each of count elements, or of as many as counts says of its name."""
    made = kind()
    for name, field in kind.vars.items():
        if wp.types.is_array(field.type):
            setattr(made, name, wp.zeros(counts.get(name, count), field.type.dtype, device=device))
    return made


def adjoining(count: int, device: str, *dtypes: type) -> tuple[wp.array, list[wp.array]]:
    """Return arrays of count zeros that lie one after the other, and all of them as one array of float, to copy or clear at once."""
    sizes = [count * wp.types.type_size(dtype) for dtype in dtypes]
    everything = torch.zeros(sum(sizes), device=device)
    parts = [part.view(count, *dtype._shape_) for part, dtype in zip(everything.split(sizes), dtypes)]
    arrays = [wp.from_torch(part, dtype, requires_grad=False) for part, dtype in zip(parts, dtypes)]
    return wp.from_torch(everything, requires_grad=False), arrays


def new_grid(plan: GridPlan) -> Grid:
    """Return the grid of a plan, without copies of grid nodes."""
    grid = Grid()
    grid.h, grid.inverse_h = plan.cell_size, 1 / plan.cell_size
    grid.nx, grid.ny, grid.nz = plan.shape
    grid.count = plan.count
    return grid


def new_nodes(
    nodes: ControlNodes, plan: GridPlan, properties: TissueProperties, mu: np.ndarray, lam: np.ndarray, environments: int, device: str
) -> Nodes:
    """Return control nodes at rest, without stencils.

    Args:
        nodes: Where they are.
        plan: The grid that they are in.
        properties: What each is made of.
        mu, lam: Lamé's parameters of each [M], Pa.
        environments: B.
        device: Where to.
    """
    made = Nodes()
    made.X = copied(plan.local, wp.vec3, device)
    made.mass = copied(nodes.volumes * properties.density, float, device)
    made.volume = copied(nodes.volumes, float, device)
    made.mu, made.lam = copied(mu, float, device), copied(lam, float, device)
    made.stiffness = wp.zeros(environments * len(nodes), float, device=device)
    return made


def set_stencils(nodes: Nodes, grid: Grid, stencils: Sequence[Stencils], device: str) -> None:
    """Let control nodes transfer to the grid nodes of these stencils, of each environment its own [B]; they differ by cuts alone."""
    tables = [each.table for each in stencils]
    before = np.cumsum([0, *map(len, tables)])
    rows = [np.where(each.row < 0, -1, each.row + first) for each, first in zip(stencils, before)]
    nodes.first, nodes.row = copied(stencils[0].first, wp.vec3i, device), copied(np.concatenate(rows), int, device)
    nodes.table = copied(np.concatenate(tables).ravel() if before[-1] else np.zeros(1), int, device)
    grid.count = max(each.grid_count for each in stencils)


def new_state(count: int, device: str) -> tuple[wp.array, State]:
    """Return what a bad step brings back, as one array, and the state of count control nodes that it is part of."""
    state = State()
    saved, (state.u, state.F, state.Q) = adjoining(count, device, wp.vec3, wp.mat33, wp.mat33)
    state.v, state.C = wp.zeros(count, wp.vec3, device=device), wp.zeros(count, wp.mat33, device=device)
    return saved, state


def new_loads(count: int, device: str) -> Loads:
    """Return loads on count control nodes: none."""
    loads = zeroed(Loads, count, device)
    loads.holder.fill_(-1)
    return loads


def new_tools(count: int, room: int, environments: int, nodes: int, config: PhysicsConfig, device: str) -> tuple[wp.array, RigidTools]:
    """Return what rigid tools gave to control nodes, as one array to clear, and the tools, which touch nothing.

    Args:
        count: Number of tools T in each environment.
        room: Capsules C that all tools of an environment may have together.
        environments: B.
        nodes: Number of control nodes M in each.
        config: Friction and what else contact needs.
        device: Where to.
    """
    tools = zeroed(RigidTools, environments * room, device, used=environments)
    tools.count, tools.room, tools.friction, tools.push_out = count, room, config.friction, config.push_out_speed
    given, (tools.impulse, tools.moment) = adjoining(environments * count * nodes, device, wp.vec3, wp.vec3)
    return given, tools
