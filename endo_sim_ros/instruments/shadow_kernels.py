"""Functions for kernels: how much of a lamp, and of the light from all around, capsules keep from a point; native/shadow.h has them."""

import warp as wp

MOST = wp.constant(64)  # capsules: a tile keeps those that matter to it in one word


@wp.func_native("""
    const endo_sim::Capsules capsules{(const endo_sim::Ends*)ends.data + first, radii.data, owners.data, count};
    const float place[3]{at[0], at[1], at[2]};
    return endo_sim::near_capsules(place, slack, {{lamp[0], lamp[1], lamp[2]}, size}, capsules);
""")
def near(
    at: wp.vec3,  # m, camera
    slack: float,  # m: points at most so far from there
    lamp: wp.vec3,
    size: float,
    first: int,  # capsule of this picture
    count: int,
    ends: wp.array2d[wp.vec3],  # [B C, 2], camera
    radii: wp.array[float],  # [C]
    owners: wp.array[int],  # [C] number of the instrument
) -> wp.uint64:
    """The capsules that may keep light from points about one, a bit for each; on a GPU a block's threads must be here with the same one."""
    ...


@wp.func_native("""
    const endo_sim::Capsules capsules{(const endo_sim::Ends*)ends.data + first, radii.data, owners.data, count};
    const float place[3]{at[0], at[1], at[2]}, up[3]{normal[0], normal[1], normal[2]};
    const auto left = endo_sim::light_left(mask, place, up, blur, {{lamp[0], lamp[1], lamp[2]}, size}, capsules, but);
    return {left.seen, left.open};
""")
def light_left(
    mask: wp.uint64,
    at: wp.vec3,
    normal: wp.vec3,
    blur: float,
    lamp: wp.vec3,
    size: float,
    first: int,
    count: int,
    ends: wp.array2d[wp.vec3],
    radii: wp.array[float],
    owners: wp.array[int],
    but: int,  # an instrument that does not count, or -1
) -> wp.vec2:
    """Share of the lamp that a point sees, and of the light from all around that it gets."""
    ...
