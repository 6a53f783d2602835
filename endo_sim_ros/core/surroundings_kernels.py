"""Kernels of `surroundings`: what is around holes of pictures, by cells, and how it comes into them."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def sum_cells(
    first: int,
    height: int,  # of a picture, pixels
    width: int,
    side: int,  # of a cell, pixels
    step: int,  # from one of its pixels that count to the next
    colors: wp.array[wp.vec3],  # [E H W]
    alphas: wp.array[float],
    sums: wp.array3d[wp.vec4],  # out [E, h, w]: of colours, and of opacities
):
    cell = first + wp.tid()
    down, across = sums.shape[1], sums.shape[2]
    picture, top, left = cell // (down * across), cell // across % down * side, cell % across * side
    total = wp.vec4(0.0)
    for row in range(top, wp.min(top + side, height), step):
        for column in range(left, wp.min(left + side, width), step):
            pixel = (picture * height + row) * width + column
            color, alpha = colors[pixel], alphas[pixel]
            total += wp.vec4(wp.min(color[0], alpha), wp.min(color[1], alpha), wp.min(color[2], alpha), alpha)
    sums[picture, cell // across % down, cell % across] = total


@wp.kernel
def fill_holes(
    first: int,
    span: int,  # pixels of a row that an item takes: one on a GPU
    height: int,
    width: int,
    side: int,
    covered: float,  # opacity from which on nothing shows of what fills
    filling: wp.array3d[wp.vec3],  # [E, h, w]
    alphas: wp.array[float],  # [E H W]
    colors: wp.array[wp.vec3],  # in, out
):
    item = first + wp.tid()
    down, across = filling.shape[1], filling.shape[2]
    for pixel in range(item * span, (item + 1) * span):
        alpha = alphas[pixel]
        if alpha < covered:
            picture, row, column = pixel // (height * width), pixel // width % height, pixel % width
            x = wp.clamp((float(column) + 0.5) / float(side) - 0.5, 0.0, float(across - 1))
            y = wp.clamp((float(row) + 0.5) / float(side) - 0.5, 0.0, float(down - 1))
            left, top = int(x), int(y)
            right, bottom = wp.min(left + 1, across - 1), wp.min(top + 1, down - 1)
            upper = wp.lerp(filling[picture, top, left], filling[picture, top, right], x - float(left))
            lower = wp.lerp(filling[picture, bottom, left], filling[picture, bottom, right], x - float(left))
            colors[pixel] += (1.0 - alpha / covered) * wp.lerp(upper, lower, y - float(top))
