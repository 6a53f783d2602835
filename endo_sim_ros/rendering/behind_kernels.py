"""Kernel of `behind`: what is behind the skin, drawn at fewer pixels, comes into pictures."""

import warp as wp

from endo_sim_ros.core.surroundings_kernels import beside

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def put_behind(
    first: int,
    span: int,  # pixels of a row that an item takes: one on a GPU
    height: int,  # of the pictures
    width: int,
    covered: float,  # opacity of tissue that shows nothing of it
    background: wp.array[wp.vec3],  # [1]
    coarse_colors: wp.array3d[wp.vec3],  # [E, h, w] of what is behind, on the background
    coarse_depths: wp.array3d[float],
    coarse_alphas: wp.array3d[float],
    colors: wp.array[wp.vec3],  # [E H W]
    depths: wp.array[float],
    alphas: wp.array[float],
):
    pixel = (first + wp.tid()) * span
    down, across = coarse_alphas.shape[1], coarse_alphas.shape[2]
    picture, row, column = pixel // (height * width), pixel // width % height, pixel % width
    top, bottom, v = beside(row, float(down) / float(height), down)
    begin, end = column, column + span
    if span > 1:  # mostly little of a row has something behind it
        low, high, wide = int(across), int(-1), float(width) / float(across)
        for place in range(across):
            if wp.max(coarse_alphas[picture, top, place], coarse_alphas[picture, bottom, place]) > 0.0:
                low, high = wp.min(low, place), place
        begin = wp.max(begin, int((float(low) - 0.5) * wide - 0.5))
        end = wp.min(end, int((float(high) + 1.5) * wide + 0.5) + 1)
    row_start = pixel - column
    for x in range(begin, end):
        pixel = row_start + x
        alpha = alphas[pixel]
        if alpha < covered:
            left, right, u = beside(x, float(across) / float(width), across)
            weights = wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)
            opacities = wp.vec4(
                coarse_alphas[picture, top, left],
                coarse_alphas[picture, top, right],
                coarse_alphas[picture, bottom, left],
                coarse_alphas[picture, bottom, right],
            )
            if wp.max(opacities) > 0.0:
                share = (1.0 - alpha / covered) * weights  # all of it where there is no tissue
                colors[pixel] += (
                    share[0] * (coarse_colors[picture, top, left] - background[0])
                    + share[1] * (coarse_colors[picture, top, right] - background[0])
                    + share[2] * (coarse_colors[picture, bottom, left] - background[0])
                    + share[3] * (coarse_colors[picture, bottom, right] - background[0])
                )
                depths[pixel] += (
                    share[0] * coarse_depths[picture, top, left]
                    + share[1] * coarse_depths[picture, top, right]
                    + share[2] * coarse_depths[picture, bottom, left]
                    + share[3] * coarse_depths[picture, bottom, right]
                )
                alphas[pixel] = alpha + wp.dot(share, opacities)
