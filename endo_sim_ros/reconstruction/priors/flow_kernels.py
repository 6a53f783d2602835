"""Dense optical flow, a thread for a pixel: inverse search of patches, and the mean of patches that overlap (Kroeger et al. 2016)."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def at(image: wp.array2d[float], row: int, column: int):
    """The value of a pixel, or of the nearest one in the picture."""
    return image[wp.clamp(row, 0, image.shape[0] - 1), wp.clamp(column, 0, image.shape[1] - 1)]


@wp.func
def between(image: wp.array2d[float], x: float, y: float):
    """The value between the centres of pixels; x and y are 0 at that of the first."""
    left = wp.floor(x)
    top = wp.floor(y)
    across = x - left
    down = y - top
    column = int(left)
    row = int(top)
    upper = at(image, row, column) * (1.0 - across) + at(image, row, column + 1) * across
    lower = at(image, row + 1, column) * (1.0 - across) + at(image, row + 1, column + 1) * across
    return upper * (1.0 - down) + lower * down


@wp.kernel
def search(
    image: wp.array2d[float],  # [H, W]
    other: wp.array2d[float],  # [H, W]
    start: wp.array2d[wp.vec2],  # [H, W] pixels
    radius: int,  # of the patch around a pixel
    noise: float,  # grey levels that an image varies by without showing anything
    iterations: int,
    found: wp.array2d[wp.vec2],  # out [H, W]
):
    """By how much the patch around a pixel lies elsewhere in the other image: least squares, whatever the mean brightness."""
    pixel = wp.tid()
    row = pixel // image.shape[1]
    column = pixel % image.shape[1]
    top = wp.max(row - radius, 0)
    bottom = wp.min(row + radius + 1, image.shape[0])
    left = wp.max(column - radius, 0)
    right = wp.min(column + radius + 1, image.shape[1])
    count = float((bottom - top) * (right - left))
    a = float(0.0)
    b = float(0.0)
    c = float(0.0)
    slope = wp.vec2()
    for y in range(top, bottom):
        for x in range(left, right):
            dx = 0.5 * (at(image, y, x + 1) - at(image, y, x - 1))
            dy = 0.5 * (at(image, y + 1, x) - at(image, y - 1, x))
            a += dx * dx
            b += dx * dy
            c += dy * dy
            slope += wp.vec2(dx, dy)
    damping = count * noise * noise
    a += damping - slope[0] * slope[0] / count
    b -= slope[0] * slope[1] / count
    c += damping - slope[1] * slope[1] / count
    scale = 1.0 / wp.max(a * c - b * b, 1.0e-9)
    begin = start[row, column]
    flow = begin
    for _ in range(iterations):
        right_side = wp.vec2()
        mean = float(0.0)
        for y in range(top, bottom):
            for x in range(left, right):
                difference = between(other, float(x) + flow[0], float(y) + flow[1]) - image[y, x]
                dx = 0.5 * (at(image, y, x + 1) - at(image, y, x - 1))
                dy = 0.5 * (at(image, y + 1, x) - at(image, y - 1, x))
                right_side += difference * wp.vec2(dx, dy)
                mean += difference
        right_side -= slope * (mean / count)
        flow -= scale * wp.vec2(c * right_side[0] - b * right_side[1], a * right_side[1] - b * right_side[0])
    if wp.length(flow - begin) > 2.0 * float(radius):  # it found something else
        flow = begin
    found[row, column] = flow


@wp.kernel
def blend(
    image: wp.array2d[float],  # [H, W]
    other: wp.array2d[float],  # [H, W]
    flows: wp.array2d[wp.vec2],  # [H, W]
    radius: int,  # of the patches
    stride: int,  # every so many pixels there is a patch
    found: wp.array2d[wp.vec2],  # out [H, W]
):
    """The mean of what patches around a pixel found, each weighed by how well it explains the pixel."""
    pixel = wp.tid()
    row = pixel // image.shape[1]
    column = pixel % image.shape[1]
    total = wp.vec2()
    weight = float(0.0)
    for down in range(-radius, radius + 1, stride):
        for across in range(-radius, radius + 1, stride):
            y = row + down
            x = column + across
            if y >= 0 and x >= 0 and y < image.shape[0] and x < image.shape[1]:
                flow = flows[y, x]
                off = wp.abs(between(other, float(column) + flow[0], float(row) + flow[1]) - image[row, column])
                share = 1.0 / wp.max(off, 1.0)
                total += share * flow
                weight += share
    found[row, column] = total / weight
