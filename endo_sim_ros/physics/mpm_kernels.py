"""Kernels of the material point method: MLS-MPM (Hu et al. 2018) with APIC transfers and quadratic B-splines.

For node p with weights w at grid nodes i (a distance d = X_i − X_p away), cell size h:

    P2G   (mv)_i += w [m (v + Δt g) + Δt (f − k (u − u*)) + (m C − Δt 4/h² V S) d],   m_i += w (m + Δt² k)
    grid  v_i = (mv)_i / m_i · exp(−c Δt)
    G2P   v = Σ w v_i,   C = 4/h² Σ w v_i dᵀ,   u += Δt v

With current kinematics X is the current position, S = τ and F ← (I + Δt C) F. With rest kinematics (total Lagrangian,
de Vaucorbeil et al. 2020) X is the rest position, S = P and F ← F + Δt C; the weights then never change, so stretched
tissue cannot lose contact with itself.

The state is a displacement u from rest in the solver's local frame, all float32. G2P of one substep and P2G of the
next share a kernel, so that one substep is two launches.

Pinned nodes are held by springs k to the displacement u* = 0, grasped ones to a u* that moves evenly through the step;
k is zero for all others. Δt² k is the springs' implicit part, lumped, which makes them stable at any stiffness. (Holding
grid nodes instead puts the wall up to half a cell off, and kinematic nodes without stress leave the tissue next to the
wall hanging on nothing.)
"""

import functools

import warp as wp

from endo_sim_ros.physics.materials import MATERIALS, kirchhoff_stress

wp.set_module_options({"enable_backward": False})


@wp.struct
class Grid:
    """A regular grid whose node (i, j, k) lies at h (i, j, k) in the local frame."""

    h: float
    inverse_h: float
    nx: int
    ny: int
    nz: int


@wp.struct
class Nodes:
    """All nodes, shape [M] each: constants, the force on each and the state."""

    X: wp.array[wp.vec3]  # rest position, local, m
    mass: wp.array[float]  # kg
    volume: wp.array[float]  # at rest, m³
    spring: wp.array[float]  # N/m, of pinned and grasped nodes; zero where free
    target: wp.array[wp.vec3]  # displacement u* at the start of the step that the spring pulls to, m
    target_v: wp.array[wp.vec3]  # its velocity during the step, m/s
    force: wp.array[wp.vec3]  # N
    u: wp.array[wp.vec3]  # displacement, m
    v: wp.array[wp.vec3]  # velocity, m/s
    C: wp.array[wp.mat33]  # APIC matrix: velocity gradient, 1/s
    F: wp.array[wp.mat33]  # deformation gradient


@wp.func
def spline(x: float) -> wp.vec3:
    """Quadratic B-spline weights of the three grid nodes around a point x cells (0.5 to 1.5) past the first."""
    a, b, c = 1.5 - x, x - 1.0, x - 0.5
    return wp.vec3(0.5 * a * a, 0.75 - b * b, 0.5 * c * c)


@wp.func
def first_cell(x: float, n: int) -> int:
    """First of the three grid nodes along one axis; clamped, so that a runaway node stays inside the grid.

    Before the conversion: what an integer cannot hold, and NaN, would become any integer, past a later clamp.
    """
    first = wp.floor(x - 0.5)
    if first > 0.0:  # not NaN
        return int(wp.min(first, float(n - 3)))
    return 0


@functools.cache
def make_advance_kernel(material: str, kinematics: str):
    """The kernel that takes grid velocities to nodes (G2P) and nodes to grid momenta (P2G); either half can be off."""
    stress_of = MATERIALS[material][0]
    current = kinematics == "current"

    @wp.kernel(enable_backward=False, module="unique")
    def advance(
        nodes: Nodes,
        grid: Grid,
        dt: float,
        gravity: wp.vec3,
        mu: float,
        lam: float,
        time: float,  # since the start of the step
        gather: int,
        scatter: int,
        grid_v: wp.array3d[wp.vec3],
        grid_mv: wp.array3d[wp.vec4],
    ):
        p = wp.tid()
        u = nodes.u[p]
        v = nodes.v[p]
        C = nodes.C[p]
        F = nodes.F[p]
        X = nodes.X[p]
        x = X * grid.inverse_h
        if wp.static(current):
            x = (X + u) * grid.inverse_h
        i0, j0, k0 = first_cell(x[0], grid.nx), first_cell(x[1], grid.ny), first_cell(x[2], grid.nz)
        f = wp.vec3(x[0] - float(i0), x[1] - float(j0), x[2] - float(k0))
        wx, wy, wz = spline(f[0]), spline(f[1]), spline(f[2])

        if gather != 0:
            v = wp.vec3()
            cx, cy, cz = wp.vec3(), wp.vec3(), wp.vec3()  # columns of Σ w v_i (i, j, k)
            for i in range(3):
                plane, plane_y, plane_z = wp.vec3(), wp.vec3(), wp.vec3()
                for j in range(3):
                    g1 = wz[1] * grid_v[i0 + i, j0 + j, k0 + 1]
                    g2 = wz[2] * grid_v[i0 + i, j0 + j, k0 + 2]
                    row = wz[0] * grid_v[i0 + i, j0 + j, k0] + g1 + g2
                    plane += wy[j] * row
                    plane_y += wy[j] * float(j) * row
                    plane_z += wy[j] * (g1 + 2.0 * g2)
                v += wx[i] * plane
                cx += wx[i] * float(i) * plane
                cy += wx[i] * plane_y
                cz += wx[i] * plane_z
            # Σ w v_i (X_i − X_p)ᵀ, with X_p at f cells.
            C = 4.0 * grid.inverse_h * wp.matrix_from_cols(cx - f[0] * v, cy - f[1] * v, cz - f[2] * v)
            u += dt * v
            if wp.static(current):
                F += dt * (C * F)
            else:
                F += dt * C
            nodes.u[p] = u
            nodes.v[p] = v
            nodes.C[p] = C
            nodes.F[p] = F
            if wp.static(current):
                x = (X + u) * grid.inverse_h
                i0, j0, k0 = first_cell(x[0], grid.nx), first_cell(x[1], grid.ny), first_cell(x[2], grid.nz)
                f = wp.vec3(x[0] - float(i0), x[1] - float(j0), x[2] - float(k0))
                wx, wy, wz = spline(f[0]), spline(f[1]), spline(f[2])

        if scatter != 0:
            mass = nodes.mass[p]
            S = stress_of(F, mu, lam)
            if wp.static(current):
                S = kirchhoff_stress(S, F)
            A = (mass * grid.h) * C - (dt * 4.0 * grid.inverse_h * nodes.volume[p]) * S  # per cell of distance
            spring = nodes.spring[p]
            stretch = u - nodes.target[p] - time * nodes.target_v[p]
            q = mass * (v + dt * gravity) + dt * (nodes.force[p] - spring * stretch) - A * f
            ax = wp.vec4(A[0, 0], A[1, 0], A[2, 0], 0.0)
            ay = wp.vec4(A[0, 1], A[1, 1], A[2, 1], 0.0)
            az = wp.vec4(A[0, 2], A[1, 2], A[2, 2], 0.0)
            corner = wp.vec4(q[0], q[1], q[2], mass + dt * dt * spring)
            for i in range(3):
                for j in range(3):
                    w = wx[i] * wy[j]
                    edge = corner + float(i) * ax + float(j) * ay
                    wp.atomic_add(grid_mv, i0 + i, j0 + j, k0, w * wz[0] * edge)
                    wp.atomic_add(grid_mv, i0 + i, j0 + j, k0 + 1, w * wz[1] * (edge + az))
                    wp.atomic_add(grid_mv, i0 + i, j0 + j, k0 + 2, w * wz[2] * (edge + 2.0 * az))

    return advance


@wp.kernel
def update_grid(decay: float, grid_mv: wp.array[wp.vec4], grid_v: wp.array[wp.vec3]):
    """Momenta to velocities with decay exp(−c Δt), then clear the momenta. The grid is flat here: [nx · ny · nz]."""
    i = wp.tid()
    q = grid_mv[i]
    v = wp.vec3()
    if q[3] > 0.0:
        v = (decay / q[3]) * wp.vec3(q[0], q[1], q[2])
    grid_v[i] = v
    grid_mv[i] = wp.vec4()


@wp.kernel
def check_nodes(
    u: wp.array[wp.vec3],
    v: wp.array[wp.vec3],
    F: wp.array[wp.mat33],
    travel: float,
    fault: wp.array[int],
    speed_sq: wp.array[float],
):
    """Count nodes that are not finite or out of bounds (the comparisons are false for NaN) and find the largest v²."""
    p = wp.tid()
    if not (wp.length_sq(u[p]) <= travel * travel and wp.ddot(F[p], F[p]) < 1.0e4):
        wp.atomic_add(fault, 0, 1)
    wp.atomic_max(speed_sq, 0, wp.length_sq(v[p]))
