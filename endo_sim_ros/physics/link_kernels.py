"""Functions of kernels for tools whose links are known: capsules that touch, and jaws that hold what lies between them."""

import warp as wp

from endo_sim_ros.core.block_sums import OPTIONS, block_sum
from endo_sim_ros.physics.backends.structs import Loads, Nodes, RigidTools, State
from endo_sim_ros.physics.tool_state_kernels import Commands, Holds, ToolConstants, double, single

wp.set_module_options({"enable_backward": False, **OPTIONS})


# The skin between its nodes is the mean of the planes through these; the weight of one falls by e within so many distances between nodes,
WIDTH = 0.6  # with which it is right to 1 mm for 4000 of them on the synthetic patient
FARTHEST = 3.0  # of these distances, beyond which a node says nothing
MOST_POINTS = 16  # of a jaw whose height over the skin is asked, two for each such distance


@wp.func
def links_are_finite(c: int, commands: Commands, constants: ToolConstants) -> bool:
    """Whether the links of tool c, and its jaws if there are any, can be used."""
    total = wp.float64(0.0)
    for k in range(constants.capsules):
        i = c * constants.capsules + k
        if commands.radius[i] != 0.0:
            total += wp.length_sq(commands.start[i]) + wp.length_sq(commands.end[i]) + wp.float64(commands.radius[i])
    if commands.jawed[c] != 0:
        for i in range(3):
            total += wp.length_sq(commands.jaws[3 * c + i])
    return wp.isfinite(total)


@wp.func
def set_back(point: wp.vec3d, radius: float, constants: ToolConstants) -> wp.vec3d:
    """An end of a capsule as it acts: towards the eye by as much as the capsule acts thicker than it is, so that it meets the skin where
    it is seen to."""
    if constants.seen == 0 or radius >= constants.thinnest:
        return point
    return point + wp.float64(constants.thinnest - radius) * wp.normalize(constants.eye - point)


@wp.func
def move_links(
    t: int, c: int, at: int, used: int, commands: Commands, holds: Holds, constants: ToolConstants, rigid: RigidTools
) -> int:  # fmt: skip
    """Let the links of tool t move from where they were to where they are to be at the end of the step.

    Args:
        t: The tool.
        c: Its number in all environments.
        at: First capsule of the environment.
        used: Capsules of the tools before it.

    Returns:
        How many capsules there are now.
    """
    acts = commands.linked[c] != 0 and commands.present[c] != 0
    if acts:
        for k in range(constants.capsules):
            i = c * constants.capsules + k
            if holds.joined[c] == 0:
                holds.last_start[i] = commands.start[i]
                holds.last_end[i] = commands.end[i]
            start, end, start_before, end_before = commands.start[i], commands.end[i], holds.last_start[i], holds.last_end[i]
            if commands.radius[i] > 0.0:
                place = at + used
                rigid.tool[place] = t
                thin = commands.radius[i]
                rigid.radius[place] = wp.max(thin, constants.thinnest)
                rigid.stiffening[place] = wp.where(rigid.radius[place] < constants.cell, constants.stiffening, 0.0)
                start_acts, end_acts = set_back(start_before, thin, constants), set_back(end_before, thin, constants)
                rigid.tip[place] = single(start_acts - constants.origin)
                rigid.tip_v[place] = single((set_back(start, thin, constants) - start_acts) / constants.duration)
                rigid.end[place] = single(end_acts - constants.origin)
                rigid.end_v[place] = single((set_back(end, thin, constants) - end_acts) / constants.duration)
                used += 1
            holds.last_start[i] = start
            holds.last_end[i] = end
        holds.last_opening[c] = wp.length(commands.jaws[3 * c + 1] - commands.jaws[3 * c + 2])
    holds.joined[c] = wp.where(acts, 1, 0)
    return used


@wp.func
def nearest_link(c: int, x: wp.vec3d, commands: Commands, constants: ToolConstants) -> int:
    """Number of the link of tool c whose surface is nearest to a point, or which the point is deepest in; -1 = none touches."""
    link = int(-1)
    nearest = wp.float64(1.0e30)
    for k in range(constants.capsules):
        i = c * constants.capsules + k
        if commands.radius[i] > 0.0:
            start = set_back(commands.start[i], commands.radius[i], constants)
            along = set_back(commands.end[i], commands.radius[i], constants) - start
            arm = x - start
            share = wp.dot(arm, along) / wp.max(wp.length_sq(along), wp.float64(1.0e-12))
            share = wp.clamp(share, wp.float64(0.0), wp.float64(1.0))
            gap = wp.length(arm - share * along) - wp.float64(wp.max(commands.radius[i], constants.thinnest))
            if gap < nearest:
                nearest = gap
                link = commands.link[i]
    return link


@wp.func
def measure_links(
    b: int, c: int, thread: int, threads: int, felt: bool, kept: bool, commands: Commands, holds: Holds, constants: ToolConstants,
    nodes: Nodes, state: State, rigid: RigidTools,
):  # fmt: skip
    """What each link of tool c feels: minus the mean of what the tool gave to the nodes that the link is nearest to.

    Args:
        b: The environment.
        c: Number of the tool in all environments.
        thread: This one.
        threads: How many there are.
        felt: Whether it gave anything.
        kept: Whether what was felt before counts.
        commands, holds, constants, nodes, state, rigid: As the kernels have them.
    """
    count = nodes.X.shape[0]
    for link in range(commands.links[c]):
        force, moment = wp.vec3d(), wp.vec3d()
        if felt and commands.linked[c] != 0:
            for p in range(thread, count, threads):
                given = rigid.impulse[c * count + p]
                if wp.length_sq(given) > 0.0:
                    x = constants.origin + double(nodes.X[p]) + double(state.u[b * count + p])
                    if nearest_link(c, x, commands, constants) == link:
                        force += double(given) / constants.duration
                        moment += double(rigid.moment[c * count + p]) / constants.duration
            force = wp.vec3d(block_sum(force[0]), block_sum(force[1]), block_sum(force[2]))
            moment = wp.vec3d(block_sum(moment[0]), block_sum(moment[1]), block_sum(moment[2]))
        if thread == 0 and not kept:
            i = c * constants.capsules + link
            holds.link_force[i] = -force
            holds.link_torque[i] = wp.cross(commands.tip[c] - constants.origin, force) - moment


@wp.func
def lies_between(c: int, x: wp.vec3d, opening: wp.float64, commands: Commands, constants: ToolConstants) -> int:
    """Whether a point lies between the jaws of tool c where they are to be: 1 or 0.

    It does within half the opening, which grows from the hinge to the tips, and the margin from the line in the middle of the jaws,
    and not behind the hinge.
    """
    hinge = commands.jaws[3 * c]
    along = wp.float64(0.5) * (commands.jaws[3 * c + 1] + commands.jaws[3 * c + 2]) - hinge
    arm = x - hinge
    share = wp.dot(arm, along) / wp.max(wp.length_sq(along), wp.float64(1.0e-12))
    near = wp.min(share, wp.float64(1.0))
    if share >= wp.float64(0.0) and wp.length(arm - near * along) <= near * wp.float64(0.5) * opening + constants.margin:
        return 1
    return 0


@wp.func
def height_over_skin(
    b: int, y: wp.vec3d, at_rest: int, thread: int, threads: int, constants: ToolConstants, nodes: Nodes, state: State
) -> wp.float64:  # fmt: skip
    """How far a point (local, m) is in front of the skin of environment b as it is, or as it is at rest, m; below zero behind it.

    Nodes are farther apart than what touches is thick. The skin between them is where the planes through them are in the mean, near ones
    counting more (implicit moving least squares: Kolluri, "Provably Good Moving Least Squares", 2005). Endless where no node is within
    one distance between nodes along the skin, as beside its edge, where the planes go on: in the skin one is (up to 1.0 such distances).
    """
    count = nodes.X.shape[0]
    total, height, beside = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for s in range(thread, constants.touchable.shape[0], threads):
        p = constants.touchable[s]
        arm, normal = y - double(nodes.X[p]), wp.normalize(constants.normal[s])
        if at_rest == 0:
            arm -= double(state.u[b * count + p])
            normal = wp.normalize(wp.transpose(wp.inverse(state.F[b * count + p])) * normal)
        if wp.length(arm) < wp.float64(FARTHEST) * constants.apart:
            weight = wp.exp(-wp.length_sq(arm) / (wp.float64(WIDTH * WIDTH) * constants.apart * constants.apart))
            above = wp.dot(double(normal), arm)
            total += weight
            height += weight * above
            if wp.length(arm - above * double(normal)) <= constants.apart:
                beside += wp.float64(1.0)
    total, height, beside = block_sum(total), block_sum(height), block_sum(beside)
    return wp.where(beside > wp.float64(0.0), height / total, wp.float64(1.0e30))


@wp.func
def jaws_touch(
    b: int, c: int, thread: int, threads: int, commands: Commands, holds: Holds, constants: ToolConstants, nodes: Nodes, state: State,
    rigid: RigidTools,
) -> bool:  # fmt: skip
    """Whether the jaws of tool c, where they are to be, touch tissue or have it between them.

    They do if a capsule along one of them, or along their middle, pushes a node as `move_links` has it act, or comes as near to the skin as
    a grasp may. Tissue that the tool has pushed aside until now follows its jaws while they close: then the skin at rest counts as well. Of
    tissue that nobody has seen it is not known on which side its skin is.
    """
    count = nodes.X.shape[0]
    zero, one = wp.float64(0.0), wp.float64(1.0)
    hinge, radius = commands.jaws[3 * c], commands.jaw_radius[c]
    acting = wp.float64(wp.max(radius, constants.thinnest))
    pushed, touched, nearest = wp.float64(0.0), wp.float64(0.0), wp.float64(1.0e30)
    if holds.joined[c] != 0:
        for p in range(thread, count, threads):
            if wp.length_sq(rigid.impulse[c * count + p]) > 0.0:
                pushed += one
    pushed = block_sum(pushed)
    for line in range(3):
        to = wp.float64(0.5) * wp.float64(line)
        tip = (one - to) * commands.jaws[3 * c + 1] + to * commands.jaws[3 * c + 2]
        start = set_back(hinge, radius, constants)
        along = set_back(tip, radius, constants) - start
        for s in range(thread, constants.touchable.shape[0], threads):
            p = constants.touchable[s]
            arm = constants.origin + double(nodes.X[p]) + double(state.u[b * count + p]) - start
            share = wp.clamp(wp.dot(arm, along) / wp.max(wp.length_sq(along), wp.float64(1.0e-12)), zero, one)
            if wp.length(arm - share * along) <= acting:
                touched += one
        if constants.seen != 0:
            points = 1 + wp.clamp(int(wp.ceil(wp.float64(2.0) * wp.length(tip - hinge) / constants.apart)), 1, MOST_POINTS)
            for i in range(points):
                y = hinge + (wp.float64(i) / wp.float64(points - 1)) * (tip - hinge) - constants.origin
                nearest = wp.min(nearest, height_over_skin(b, y, 0, thread, threads, constants, nodes, state))
                if pushed > zero:
                    nearest = wp.min(nearest, height_over_skin(b, y, 1, thread, threads, constants, nodes, state))
    return block_sum(touched) > zero or nearest <= wp.float64(radius) + constants.grasp_gap


@wp.func
def slide_in_jaws(
    b: int, t: int, c: int, thread: int, threads: int, commands: Commands, holds: Holds, constants: ToolConstants,
    nodes: Nodes, state: State, loads: Loads, bad_nodes: wp.array[int],
) -> wp.float64:  # fmt: skip
    """Let nodes that the jaws of tool t pulled with all that friction bears slide, and let go of those that leave the jaws.

    A node has slid as far as its spring is longer than its share of the friction stretches it. Returns the number of nodes that are
    still held.
    """
    count = nodes.X.shape[0]
    touchable = constants.touchable.shape[0]
    zero = wp.float64(0.0)
    held = wp.float64(0.0)
    for s in range(thread, touchable, threads):
        if holds.held[c * touchable + s] != 0:
            held += wp.float64(1.0)
    held = block_sum(held)
    kept = wp.float64(0.0)
    for s in range(thread, touchable, threads):
        i = c * touchable + s
        if holds.held[i] != 0:
            p = constants.touchable[s]
            e = b * count + p
            # Not where the last step was undone, or another jaw had the node, or the jaws have just closed.
            if holds.placed[c] != 0 and bad_nodes[b] == 0 and loads.holder[e] == t:
                behind = double(state.u[e]) - holds.pulled[i]
                stretch = constants.most_pull / held / wp.float64(nodes.stiffness[e])
                if wp.length(behind) > stretch:
                    pulled = double(state.u[e]) - (stretch / wp.length(behind)) * behind
                    x = constants.origin + double(nodes.X[p]) + pulled
                    holds.pulled[i] = pulled
                    holds.local[i] = wp.transpose(holds.last_R[c]) * (x - holds.last_tip[c])
                    goal = commands.tip[c] + commands.R[c] * holds.local[i]
                    holds.held[i] = lies_between(c, goal, holds.opening[c], commands, constants)
            if holds.held[i] != 0:
                kept += wp.float64(1.0)
    return wp.where(held > zero, block_sum(kept), zero)
