"""Kernels of `surroundings`: what is around holes of pictures, by cells, and how it comes into them."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def beside(pixel: int, cells: float, count: int):
    """Between which two of ``count`` cells in a row the centre of a pixel, ``cells`` wide, lies, and the weight of the second."""
    place = wp.clamp((float(pixel) + 0.5) * cells - 0.5, 0.0, float(count - 1))
    first = int(place)
    return first, wp.min(first + 1, count - 1), place - float(first)


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
            left, right, u = beside(column, 1.0 / float(side), across)
            top, bottom, v = beside(row, 1.0 / float(side), down)
            upper = wp.lerp(filling[picture, top, left], filling[picture, top, right], u)
            lower = wp.lerp(filling[picture, bottom, left], filling[picture, bottom, right], u)
            colors[pixel] += (1.0 - alpha / covered) * wp.lerp(upper, lower, v)
