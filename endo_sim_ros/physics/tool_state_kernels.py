"""What kernels know of tools: what they are told, what they hold, and what they all share. Commands and sums are float64."""

import warp as wp

from endo_sim_ros.core.block_sums import OPTIONS, block_sum

wp.set_module_options({"enable_backward": False, **OPTIONS})


@wp.struct
class Commands:
    """What tools are told to do, all [B · T] but for capsules and jaws, world."""

    force: wp.array[wp.vec3d]  # N
    torque: wp.array[wp.vec3d]  # about the point held, N·m
    grasp_point: wp.array[wp.vec3d]  # where the wrench takes hold, m
    tip: wp.array[wp.vec3d]  # of the tool at the end of the step, m
    R: wp.array[wp.mat33d]  # its axes
    present: wp.array[int]  # whether tip and R mean anything
    closed: wp.array[int]  # whether the jaw is to be closed
    linked: wp.array[int]  # whether its links are the capsules below, rather than the one of all tools
    links: wp.array[int]  # how many links these are of
    jawed: wp.array[int]  # whether these hold what lies between two jaws, else nothing; a bare tip holds what is near it
    start: wp.array[wp.vec3d]  # [B · T · K] of each capsule, one end at the end of the step, m
    end: wp.array[wp.vec3d]  # the other
    radius: wp.array[float]  # m, 0 = none
    link: wp.array[int]  # number of the link that it is of
    jaws: wp.array[wp.vec3d]  # [B · T · 3] their hinge, and the tips of the two, m
    jaw_radius: wp.array[float]  # [B · T] of jaws at their tips, m


@wp.struct
class Holds:
    """What tools hold, all [B · T] but for the links, and for the last four, [B · T · S] over the nodes that tools may touch."""

    attached: wp.array[int]  # whether the wrench acts on nodes
    contact: wp.array[wp.vec3d]  # the point held relative to their weighted centroid, kept, m
    gripping: wp.array[int]  # whether the jaw holds nodes
    shut: wp.array[int]  # whether two jaws were closed in the last step: what they did not hold then they hold no more until they open
    last_tip: wp.array[wp.vec3d]  # at the end of the last step
    last_R: wp.array[wp.mat33d]
    placed: wp.array[int]  # whether these two mean anything
    last_start: wp.array[wp.vec3d]  # [B · T · K] of the capsules of links
    last_end: wp.array[wp.vec3d]
    last_opening: wp.array[wp.float64]  # between the tips of the jaws, m
    joined: wp.array[int]  # whether these three mean anything
    link_force: wp.array[wp.vec3d]  # [B · T · K] out, N: the part of the reaction of jaw and contact that each link feels
    link_torque: wp.array[wp.vec3d]  # [B · T · K] about the tip, N·m
    opening: wp.array[wp.float64]  # of the jaws when they closed, m
    slipping: wp.array[int]  # whether jaws hold by friction, which has a limit
    applied_force: wp.array[wp.vec3d]  # what arrived of the wrench, N and N·m
    applied_torque: wp.array[wp.vec3d]
    borne: wp.array[wp.float64]  # size of the wrench that the tissue bore last, N
    unborne: wp.array[wp.float64]  # of one that was too much for it, 0 = none known
    reaction_force: wp.array[wp.vec3d]  # out, N
    reaction_torque: wp.array[wp.vec3d]  # out, N·m: of the wrench about the point held, of jaw and contact about the tip
    slips: wp.array[int]  # times that tissue slipped out of the jaw
    weight: wp.array[float]  # of each node in the wrench, zero = none
    held: wp.array[int]  # whether the jaw holds the node
    local: wp.array[wp.vec3d]  # where it was in the axes of the tip when the jaw closed, m
    pulled: wp.array[wp.vec3d]  # displacement that it was last pulled to, m


@wp.struct
class ToolConstants:
    """What all tools share."""

    touchable: wp.array[int]  # [S] nodes that tools may take hold of
    origin: wp.vec3d  # of the local frame, world, m
    radius: wp.float64  # of the wrench and the jaw, m
    travel: wp.float64  # m
    duration: wp.float64  # of the step, s
    contact_radius: float  # of the capsule that every tool is without links, m
    contact_length: wp.float64  # m
    capsules: int  # most of a tool, K
    thinnest: float  # radius as which thinner capsules of links act, m
    cell: float  # size of a cell of the grid, m
    stiffening: float  # of what pushes nodes away from capsules of links that are thinner than that, see `RigidTools`
    seen: int  # whether it is known from where the skin is seen
    eye: wp.vec3d  # from where, m
    margin: wp.float64  # how far from the middle of closed jaws nodes lie between them, m
    normal: wp.array[wp.vec3]  # [S] of the skin at rest, out of the tissue; where it is known from where that is seen
    apart: wp.float64  # distance between nodes of the skin, m
    grasp_gap: wp.float64  # between jaws and the skin that they take hold of, m
    most_pull: wp.float64  # of jaws, N; 0 = without limit


@wp.func
def block_sum3(v: wp.vec3d) -> wp.vec3d:
    return wp.vec3d(block_sum(v[0]), block_sum(v[1]), block_sum(v[2]))


@wp.func
def double(v: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def single(v: wp.vec3d) -> wp.vec3:
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))
