"""Smoothing within edges (bilateral filter, Tomasi and Manduchi 1998), a thread for a pixel."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def mirrored(index: int, count: int):
    """The index within 0 ... count − 1 of an item beyond the ends, mirrored at the last ones."""
    period = wp.max(2 * (count - 1), 1)
    found = wp.abs(index) % period
    return wp.min(found, period - found) % count


@wp.kernel
def bilateral(
    values: wp.array2d[float],  # [H, W]
    edge: float,  # standard deviation of values that belong together
    spread: float,  # standard deviation in the picture, strides
    radius: int,  # of the window, strides
    stride: int,  # a pixel is filtered with every stride-th one around it
    smoothed: wp.array2d[float],  # out [H, W]
):
    """The mean of the values around a pixel, each weighed by its distance and by how much it differs."""
    pixel = wp.tid()
    row = pixel // values.shape[1]
    column = pixel % values.shape[1]
    rows = (values.shape[0] - 1 - row % stride) // stride + 1
    columns = (values.shape[1] - 1 - column % stride) // stride + 1
    own = values[row, column]
    total = float(0.0)
    weight = float(0.0)
    for down in range(-radius, radius + 1):
        for across in range(-radius, radius + 1):
            distance = down * down + across * across
            if distance <= radius * radius:
                other_row = row % stride + stride * mirrored(row // stride + down, rows)
                other_column = column % stride + stride * mirrored(column // stride + across, columns)
                value = values[other_row, other_column]
                difference = (value - own) / edge
                share = wp.exp(-0.5 * (float(distance) / (spread * spread) + difference * difference))
                total += share * value
                weight += share
    smoothed[row, column] = total / weight
