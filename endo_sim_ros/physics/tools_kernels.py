"""Kernels that turn what tools want into loads on nodes, and what nodes got into reactions.

One block of a GPU (one thread of a CPU) works for one environment b and its tools t, one after the other; its threads share
the nodes that tools may touch. Commands and sums are float64, which keeps a reaction equal to its wrench to the last digit that
matters and a scene metres from the world's origin as accurate as one at it.
"""

import warp as wp

from endo_sim_ros.core.block_sums import OPTIONS, block_sum
from endo_sim_ros.physics.backends.end_kernels import THREADS
from endo_sim_ros.physics.backends.structs import Loads, Nodes, RigidTools, State
from endo_sim_ros.physics.link_kernels import jaws_touch, lies_between, links_are_finite, measure_links, move_links, slide_in_jaws
from endo_sim_ros.physics.tool_state_kernels import Commands, Holds, ToolConstants, block_sum3, double, single

wp.set_module_options({"enable_backward": False, **OPTIONS})

SLIP = 0.9  # of the travel; tissue pulled farther slips out of the jaw
# What tissue bears of a wrench that is too much for it is found by trial:
FAR = 4.0  # times less is tried next where nothing is known to be borne; then the geometric mean of the least unborne and the most borne
RETREAT = 0.95  # of what was borne is still taken for that after a step that was undone
PROBE = 1.01  # times more is taken for unborne after each step that went well


@wp.func
def solve_on_range(J: wp.mat33d, needed: wp.vec3d, floor: wp.float64) -> wp.vec3d:
    """β with J β = needed for a symmetric J ≥ 0, nothing along axes about which nothing resists."""
    axes, values = wp.eig3(J)
    limit = wp.float64(1.0e-6) * wp.max(wp.max(wp.max(values[0], values[1]), values[2]), floor)
    beta = wp.vec3d()
    for i in range(3):
        if values[i] > limit:
            axis = wp.vec3d(axes[0, i], axes[1, i], axes[2, i])
            beta += (wp.dot(axis, needed) / values[i]) * axis
    return beta


@wp.kernel(launch_bounds=THREADS)
def take_hold(
    tools: int,
    threads: int,
    commands: Commands,
    holds: Holds,
    constants: ToolConstants,
    nodes: Nodes,
    state: State,
    rigid: RigidTools,
):
    """Wrenches and jaws that begin to act take hold of the nodes in reach, in their current positions; others let go."""
    b, thread = wp.tid()
    count = nodes.X.shape[0]
    touchable = constants.touchable.shape[0]
    zero, one = wp.float64(0.0), wp.float64(1.0)
    for t in range(tools):
        c = b * tools + t
        # Not finite is wanted as well: then the step fails, and is counted, instead of being another.
        wanted = not (wp.length_sq(commands.force[c]) == zero and wp.length_sq(commands.torque[c]) == zero)
        attach = wanted and holds.attached[c] == 0
        close = commands.closed[c] != 0 and commands.present[c] != 0
        grip = close and holds.gripping[c] == 0 and holds.shut[c] == 0
        if attach or grip:
            centre = wp.vec3d()
            total, gripped = wp.float64(0.0), wp.float64(0.0)
            opening = zero  # as wide as the jaws were before they closed
            if commands.jawed[c] != 0:
                opening = wp.length(commands.jaws[3 * c + 1] - commands.jaws[3 * c + 2])
                if holds.joined[c] != 0:
                    opening = wp.max(opening, holds.last_opening[c])
            for s in range(thread, touchable, threads):
                p = constants.touchable[s]
                u = double(state.u[b * count + p])
                x = constants.origin + double(nodes.X[p]) + u
                if attach:
                    distance = wp.length(x - commands.grasp_point[c]) / constants.radius
                    weight = wp.float64(0.0)
                    if distance <= one:  # smooth, and never quite zero, so that a node at the rim still counts
                        near = wp.max(one - distance * distance, wp.float64(1.0e-3))
                        weight = near * near
                    holds.weight[c * touchable + s] = wp.float32(weight)
                    weight = wp.float64(wp.float32(weight))
                    total += weight
                    centre += weight * x
                if grip:
                    arm = x - commands.tip[c]
                    inside = int(0)
                    if commands.jawed[c] != 0:
                        inside = lies_between(c, x, opening, commands, constants)
                    elif commands.linked[c] == 0 and wp.length(arm) <= constants.radius:  # a hook and scissors hold nothing
                        inside = 1
                    if inside != 0:
                        gripped += one
                        holds.local[c * touchable + s] = wp.transpose(commands.R[c]) * arm
                        holds.pulled[c * touchable + s] = u
                    holds.held[c * touchable + s] = inside
            total, gripped, centre = block_sum(total), block_sum(gripped), block_sum3(centre)
            if gripped > zero and commands.jawed[c] != 0:
                if not jaws_touch(b, c, thread, threads, commands, holds, constants, nodes, state, rigid):
                    gripped = zero
            if thread == 0:
                if attach and total > zero:
                    holds.attached[c] = 1
                    holds.borne[c] = zero
                    holds.unborne[c] = zero
                    holds.contact[c] = commands.grasp_point[c] - centre / total
                if grip and gripped > zero:
                    holds.gripping[c] = 1
                    holds.opening[c] = opening
                    holds.slipping[c] = commands.jawed[c]
        if thread == 0:
            if not wanted:
                holds.attached[c] = 0
            if not close:
                holds.gripping[c] = 0


@wp.func
def size_of(force: wp.vec3d, torque: wp.vec3d, constants: ToolConstants) -> wp.float64:
    """Size of a wrench, N: its force, and its torque as forces at the reach of the tool."""
    return wp.length(force) + wp.length(torque) / constants.radius


@wp.func
def bearable_share(c: int, commands: Commands, holds: Holds, constants: ToolConstants) -> wp.float64:
    """The share of the wrench of tool c that the tissue can bear within its travel, as far as is known; 1 until it was too much."""
    bad = holds.unborne[c]
    share = wp.float64(1.0)
    if bad > wp.float64(0.0):
        good = wp.max(holds.borne[c], bad / wp.float64(FAR * FAR))
        share = wp.min(share, wp.sqrt(good * bad) / size_of(commands.force[c], commands.torque[c], constants))
    return share


@wp.func
def learn_what_is_borne(c: int, undone: bool, holds: Holds, constants: ToolConstants):
    """Note whether the tissue bore what arrived of the wrench of tool c."""
    size = size_of(holds.applied_force[c], holds.applied_torque[c], constants)
    if undone:
        holds.unborne[c] = size
        holds.borne[c] = wp.float64(RETREAT) * holds.borne[c]  # it bore that for one step, and maybe not for two
    else:
        holds.unborne[c] = wp.float64(PROBE) * holds.unborne[c]  # moved elsewhere it may bear more
        holds.borne[c] = size


@wp.func
def apply_wrench(
    b: int, c: int, thread: int, threads: int, commands: Commands, holds: Holds, constants: ToolConstants,
    nodes: Nodes, state: State, loads: Loads,
):  # fmt: skip
    """Add the forces of the wrench of tool c; returns what arrives of it: force, N, and torque about the point held, N·m.

    They are the nodal forces f with Σ f = F and Σ r × f = τ that minimise Σ |f|²/w: f = w (F/Σw + β × s) with s
    the offset from the weighted centroid c, β = J⁻¹ (τ − c × F), J = Σ w (|s|² 1 − s sᵀ), w scaled to Σ w = 1. Nodes on one line or point
    resist no torque about it: the force is still exact and the torque is the nearest that the nodes can take.
    """
    count = nodes.X.shape[0]
    touchable = constants.touchable.shape[0]
    zero = wp.float64(0.0)
    total, centre = wp.float64(0.0), wp.vec3d()
    for s in range(thread, touchable, threads):
        w = wp.float64(holds.weight[c * touchable + s])
        if w > zero:
            p = constants.touchable[s]
            total += w
            centre += w * (double(nodes.X[p]) + double(state.u[b * count + p]))
    total, centre = block_sum(total), block_sum3(centre)
    centre = centre / total
    xx, yy, zz = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    xy, xz, yz = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for s in range(thread, touchable, threads):
        w = wp.float64(holds.weight[c * touchable + s]) / total
        if w > zero:
            p = constants.touchable[s]
            arm = double(nodes.X[p]) + double(state.u[b * count + p]) - centre
            xx += w * arm[0] * arm[0]
            yy += w * arm[1] * arm[1]
            zz += w * arm[2] * arm[2]
            xy += w * arm[0] * arm[1]
            xz += w * arm[0] * arm[2]
            yz += w * arm[1] * arm[2]
    xx, yy, zz = block_sum(xx), block_sum(yy), block_sum(zz)
    xy, xz, yz = block_sum(xy), block_sum(xz), block_sum(yz)
    J = wp.mat33d(yy + zz, -xy, -xz, -xy, xx + zz, -yz, -xz, -yz, xx + yy)
    share = bearable_share(c, commands, holds, constants)
    F = share * commands.force[c]
    lever = -holds.contact[c]  # of the centroid about the point held
    floor = wp.max(xx + yy + zz + wp.length_sq(lever), wp.float64(1.0e-30))
    beta = solve_on_range(J, share * commands.torque[c] - wp.cross(lever, F), floor)
    torque = wp.cross(lever, F) + J * beta
    for s in range(thread, touchable, threads):
        w = wp.float64(holds.weight[c * touchable + s]) / total
        if w > zero:
            p = constants.touchable[s]
            arm = double(nodes.X[p]) + double(state.u[b * count + p]) - centre
            loads.force[b * count + p] += single(w * (F + wp.cross(beta, arm)))
    return F, torque


@wp.func
def pull_by_jaw(
    b: int, t: int, c: int, thread: int, threads: int, commands: Commands, holds: Holds, constants: ToolConstants,
    nodes: Nodes, state: State, loads: Loads, bad_nodes: wp.array[int],
):  # fmt: skip
    """Let springs pull the nodes that the jaw of tool t holds to where it will be; it loses tissue that it pulls too far.

    A node that several jaws hold follows the last of them; when that opens, the one before has it. Jaws of links share what
    friction can bear among the nodes that they hold.
    """
    count = nodes.X.shape[0]
    touchable = constants.touchable.shape[0]
    zero, one = wp.float64(0.0), wp.float64(1.0)
    beyond, kept, share = wp.float64(0.0), one, zero
    if holds.slipping[c] != 0 and constants.most_pull > zero:
        kept = slide_in_jaws(b, t, c, thread, threads, commands, holds, constants, nodes, state, loads, bad_nodes)
        share = constants.most_pull / wp.max(kept, one)
    for s in range(thread, touchable, threads):
        if holds.held[c * touchable + s] != 0:
            p = constants.touchable[s]
            goal = commands.tip[c] + commands.R[c] * holds.local[c * touchable + s]
            if wp.length(goal - constants.origin - double(nodes.X[p])) > wp.float64(SLIP) * constants.travel:
                beyond += one
    beyond = block_sum(beyond)
    for s in range(thread, touchable, threads):
        if beyond == zero and holds.held[c * touchable + s] != 0:
            p = constants.touchable[s]
            e = b * count + p
            start = holds.pulled[c * touchable + s]
            # Where the last step was undone, or another jaw had the node: pull on from where the tissue is.
            if bad_nodes[b] > 0 or loads.holder[e] != t:
                start = double(state.u[e])
            goal = commands.tip[c] + commands.R[c] * holds.local[c * touchable + s] - constants.origin - double(nodes.X[p])
            loads.spring[e] = nodes.stiffness[e]
            loads.limit[e] = wp.float32(share)
            loads.target[e] = single(start)
            loads.target_v[e] = single((goal - start) / constants.duration)
            loads.holder[e] = t
            holds.pulled[c * touchable + s] = goal
    if thread == 0 and (beyond > zero or kept == zero):
        holds.gripping[c] = 0
        holds.slips[c] = holds.slips[c] + 1
        if holds.shut[c] == 0:  # else it takes hold of nothing anyway until it opens
            commands.closed[c] = 0


@wp.func
def is_finite(c: int, commands: Commands, constants: ToolConstants) -> bool:
    """Whether the command of a tool can be used."""
    finite = wp.isfinite(wp.length_sq(commands.force[c]) + wp.length_sq(commands.torque[c]))
    if commands.present[c] != 0:
        finite = finite and wp.isfinite(wp.length_sq(commands.tip[c]) + wp.ddot(commands.R[c], commands.R[c]))
        finite = finite and (commands.linked[c] == 0 or links_are_finite(c, commands, constants))
    return finite


@wp.func
def fail_if_unusable(b: int, c: int, commands: Commands, constants: ToolConstants, nodes: Nodes, loads: Loads):
    """Make a command that is not finite fail the step, which is then counted and undone."""
    if not is_finite(c, commands, constants) and constants.touchable.shape[0] > 0:
        loads.force[b * nodes.X.shape[0] + constants.touchable[0]] = wp.vec3(wp.nan, wp.nan, wp.nan)


@wp.func
def move_capsule(
    t: int, c: int, at: int, used: int, commands: Commands, holds: Holds, constants: ToolConstants, rigid: RigidTools
) -> int:  # fmt: skip
    """Let the capsule of tool t move from where it was to where it is to be at the end of the step; returns how many there are now.

    Args:
        t: The tool.
        c: Its number in all environments.
        at: First capsule of the environment.
        used: Capsules of the tools before it.
    """
    if commands.present[c] != 0:
        if holds.placed[c] == 0:
            holds.last_tip[c] = commands.tip[c]
            holds.last_R[c] = commands.R[c]
        tip, R, before, R_before = commands.tip[c], commands.R[c], holds.last_tip[c], holds.last_R[c]
        end = tip - constants.contact_length * wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
        end_before = before - constants.contact_length * wp.vec3d(R_before[0, 2], R_before[1, 2], R_before[2, 2])
        if commands.linked[c] == 0 and constants.contact_radius > 0.0:
            k = at + used
            rigid.tool[k] = t
            rigid.radius[k] = constants.contact_radius
            rigid.stiffening[k] = 0.0
            rigid.tip[k] = single(before - constants.origin)
            rigid.tip_v[k] = single((tip - before) / constants.duration)
            rigid.end[k] = single(end_before - constants.origin)
            rigid.end_v[k] = single((end - end_before) / constants.duration)
            used += 1
        holds.last_tip[c] = tip
        holds.last_R[c] = R
    holds.placed[c] = commands.present[c]
    return used


@wp.kernel(launch_bounds=THREADS)
def load_nodes(
    tools: int,
    threads: int,
    commands: Commands,
    holds: Holds,
    constants: ToolConstants,
    nodes: Nodes,
    state: State,
    loads: Loads,
    rigid: RigidTools,
    bad_nodes: wp.array[int],
):
    """Forces, springs and moving capsules of the next step."""
    b, thread = wp.tid()
    count = nodes.X.shape[0]
    touchable = constants.touchable.shape[0]
    for s in range(thread, touchable, threads):
        e = b * count + constants.touchable[s]
        loads.force[e] = loads.released[e]
        loads.spring[e] = 0.0  # its last holder stays known
        loads.limit[e] = 0.0
    used = int(0)
    for t in range(tools):
        c = b * tools + t
        if thread == 0:
            holds.shut[c] = wp.where(commands.closed[c] != 0 and (commands.jawed[c] != 0 or holds.shut[c] != 0), 1, 0)
        F, torque = wp.vec3d(), wp.vec3d()
        if holds.attached[c] != 0:
            F, torque = apply_wrench(b, c, thread, threads, commands, holds, constants, nodes, state, loads)
        if holds.gripping[c] != 0:
            pull_by_jaw(b, t, c, thread, threads, commands, holds, constants, nodes, state, loads, bad_nodes)
        if thread == 0:
            fail_if_unusable(b, c, commands, constants, nodes, loads)
            holds.applied_force[c] = F
            holds.applied_torque[c] = torque
            used = move_capsule(t, c, b * rigid.room, used, commands, holds, constants, rigid)
            used = move_links(t, c, b * rigid.room, used, commands, holds, constants, rigid)
    if thread == 0:
        rigid.used[b] = used


@wp.kernel(launch_bounds=THREADS)
def measure_reactions(
    tools: int,
    threads: int,
    commands: Commands,
    holds: Holds,
    constants: ToolConstants,
    nodes: Nodes,
    state: State,
    rigid: RigidTools,
    bad_nodes: wp.array[int],
    faults: wp.array[int],
):
    """What the tissue exerts back on each tool: minus its wrench, and minus the mean of what jaw and contact gave; of a tool that holds
    or pushes tissue in a step that was undone, what it was before."""
    b, thread = wp.tid()
    count = nodes.X.shape[0]
    for t in range(tools):
        c = b * tools + t
        force, moment = wp.vec3d(), wp.vec3d()
        if commands.present[c] != 0:  # others push and hold nothing
            for p in range(thread, count, threads):
                given = rigid.impulse[c * count + p]
                if wp.length_sq(given) > 0.0:
                    force += double(given) / constants.duration
                    moment += double(rigid.moment[c * count + p]) / constants.duration
            force, moment = block_sum3(force), block_sum3(moment)
        undone = bad_nodes[b] > 0  # and all that tools did in it
        # A tool that still holds or pushes tissue feels what it felt last: tissue at its limit does not vanish.
        touches = holds.attached[c] != 0 or holds.gripping[c] != 0 or wp.length_sq(force) > wp.float64(0.0)
        kept = undone and touches and is_finite(c, commands, constants)
        felt = wp.length_sq(force) > wp.float64(0.0) and not undone
        measure_links(b, c, thread, threads, felt, kept, commands, holds, constants, nodes, state, rigid)
        if thread == 0:
            if holds.attached[c] != 0 and is_finite(c, commands, constants):
                learn_what_is_borne(c, undone, holds, constants)
            torque = moment - wp.cross(commands.tip[c] - constants.origin, force)
            force += holds.applied_force[c]
            torque += holds.applied_torque[c]
            if undone:
                force, torque = wp.vec3d(), wp.vec3d()
            if not kept:
                holds.reaction_force[c] = -force
                holds.reaction_torque[c] = -torque
    if thread == 0 and bad_nodes[b] > 0:
        faults[b] = faults[b] + 1
