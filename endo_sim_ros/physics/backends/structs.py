"""What kernels take: the grid, the control nodes, their state and loads, and rigid tools.

A launch covers all environments, which are independent copies of the same control nodes: node p of environment b is element
b M + p. All is float32 in the local frame: world axes, origin at the corner of the grid.
"""

from typing import TYPE_CHECKING, TypeVar

import warp as wp

if TYPE_CHECKING:
    T = TypeVar("T")

    def struct(cls: type[T]) -> type[T]:
        """`wp.struct`, which type checkers take for something else than a class."""
        ...
else:
    struct = wp.struct


@struct
class Grid:
    """A regular grid whose grid node (i, j, k) lies at h (i, j, k) in the local frame and is number (i ny + j) nz + k.
    Behind the regular grid nodes lie copies of those that a cut has split; `count` is the number of all."""

    h: float
    inverse_h: float
    nx: int
    ny: int
    nz: int
    count: int


@struct
class Nodes:
    """Control nodes: what all environments share [M]."""

    X: wp.array[wp.vec3]  # rest position, local, m
    mass: wp.array[float]  # kg
    volume: wp.array[float]  # at rest, m³
    mu: wp.array[float]  # Lamé's parameters, Pa
    lam: wp.array[float]
    stiffness: wp.array[float]  # N/m, of what grasps or pushes the control node, zero: nothing; of each environment its own, [B · M]
    first: wp.array[wp.vec3i]  # first grid node (i, j, k) of its stencil at rest
    row: wp.array[int]  # in the table, of control nodes beside a cut; -1 for all others; of each environment its own, [B · M]
    table: wp.array[int]  # [A · 27] numbers of the grid nodes of each of these, k fastest


@struct
class State:
    """What is stepped of control nodes, all [B · M]."""

    u: wp.array[wp.vec3]  # displacement, m
    v: wp.array[wp.vec3]  # velocity, m/s
    C: wp.array[wp.mat33]  # APIC matrix: velocity gradient, 1/s
    F: wp.array[wp.mat33]  # deformation gradient
    Q: wp.array[wp.mat33]  # stress that the Maxwell branch has forgotten, Pa


@struct
class Loads:
    """What acts on control nodes during the step, all [B · M]."""

    force: wp.array[wp.vec3]  # N
    released: wp.array[wp.vec3]  # the part of it that cuts have released, N
    spring: wp.array[float]  # N/m, of pinned and grasped control nodes; zero where free
    target: wp.array[wp.vec3]  # displacement u* at the start of the step that the spring pulls to, m
    target_v: wp.array[wp.vec3]  # its velocity during the step, m/s
    holder: wp.array[int]  # tool whose jaw the spring belongs to, or did when the control node was held last; -1 = none
    limit: wp.array[float]  # most that the spring pulls with, N; zero: without limit


@struct
class RigidTools:
    """Capsules of tools in the local frame, [B · C] with room for C in each environment; their ends move evenly through the step."""

    count: int  # tools T
    room: int  # C
    used: wp.array[int]  # [B] capsules that touch: the first ones, those of a tool together
    tool: wp.array[int]  # that a capsule is part of
    friction: float  # Coulomb's coefficient
    tip: wp.array[wp.vec3]  # one end at the start of the step, m
    tip_v: wp.array[wp.vec3]  # m/s
    end: wp.array[wp.vec3]  # the other
    end_v: wp.array[wp.vec3]
    push_out: float  # m/s; a tool that suddenly is deep within tissue pushes it out no faster than this
    radius: wp.array[float]  # m
    stiffening: wp.array[float]  # by how many times its stiffness more a node is pushed that is at the axis
    impulse: wp.array[wp.vec3]  # out [B · T · M]: what each gave to each node during the step, N·s
    moment: wp.array[wp.vec3]  # out [B · T · M]: its moment about the local origin, N·m·s


@struct
class Transfer:
    """From control nodes to the grid, all [B · M] but for the first, in fours that a GPU loads at once."""

    given: wp.array[wp.vec4]  # [B · M · 4] momentum at the node (kg·m/s) and mass with springs and contact (kg); its growth along x, y, z
    pull: wp.array[wp.vec4]  # the part of momentum and mass that a tool gave
    source_tool: wp.array[int]  # tool that gave it, -1 = none


@struct
class Skin:
    """N Gaussians at rest and the K control nodes that move each."""

    means: wp.array[wp.vec3]  # [N] m, world
    covars: wp.array[wp.mat33]  # [N] m²
    neighbours: wp.array2d[int]  # [N, K]
    weights: wp.array2d[float]  # [N, K]
    origin: wp.vec3  # of the maps
    low: float  # bounds of the singular values of each Gaussian's F
    high: float


@struct
class Substep:
    """What is the same in every substep."""

    dt: float  # s
    decay: float  # exp(-c Δt)
    gravity: wp.vec3  # m/s²
    ratio: float  # stiffness of the Maxwell branch over that of the elastic law, 0 = none
    forget: float  # 1 - exp(-Δt/τ) of it
    stiffening: float  # a of the exponential law
    largest_exponent: float  # of it
