"""Structural similarity and its gradient on a GPU, two separable passes each, a thread for a value of the images.

Images are flat, [H · W · channels]; sums over the 11×11 window take zeros from around the image.
"""

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

SIGMA = 1.5
gaussian = np.exp(-((np.arange(11) - 5) ** 2) / (2 * SIGMA**2))
gaussian /= gaussian.sum()  # the window of the field

WINDOW = wp.constant(11)
RADIUS = wp.constant(5)
WEIGHTS = wp.constant(wp.types.vector(11, float)(*gaussian.tolist()))
C1 = wp.constant(0.01**2)
C2 = wp.constant(0.03**2)

vec5 = wp.types.vector(5, float)


@wp.kernel
def moments_across(
    x: wp.array[float],
    y: wp.array[float],
    width: int,
    channels: int,
    moments: wp.array2d[float],  # out [5, n] sums along the row of x, y, x², y², xy
):
    i = wp.tid()
    column = i // channels % width
    total = vec5()
    for k in range(WINDOW):
        if column + k - RADIUS >= 0 and column + k - RADIUS < width:
            j = i + (k - RADIUS) * channels
            a = float(x[j])
            b = float(y[j])
            total += WEIGHTS[k] * vec5(a, b, a * a, b * b, a * b)
    for m in range(5):
        moments[m, i] = total[m]


@wp.kernel
def similarity_down(
    moments: wp.array2d[float],  # [5, n] of `moments_across`
    row_size: int,  # width · channels
    values: wp.array[float],  # out [n]
    slopes: wp.array2d[float],  # out [3, n] derivatives of the value by the window's mean of x, of x², and of xy
):
    i = wp.tid()
    count = moments.shape[1]
    total = vec5()
    for k in range(WINDOW):
        j = i + (k - RADIUS) * row_size
        if j >= 0 and j < count:
            total += WEIGHTS[k] * vec5(moments[0, j], moments[1, j], moments[2, j], moments[3, j], moments[4, j])
    mean_x, mean_y = total[0], total[1]
    var_x, var_y, cov = total[2] - mean_x * mean_x, total[3] - mean_y * mean_y, total[4] - mean_x * mean_y
    a, b = 2.0 * mean_x * mean_y + C1, 2.0 * cov + C2
    c, d = mean_x * mean_x + mean_y * mean_y + C1, var_x + var_y + C2
    value = a * b / (c * d)
    by_square, by_product = -value / d, 2.0 * a / (c * d)
    values[i] = value
    slopes[0, i] = 2.0 * (mean_y * b / (c * d) - mean_x * value / c) - 2.0 * mean_x * by_square - mean_y * by_product
    slopes[1, i] = by_square
    slopes[2, i] = by_product


@wp.kernel
def gradient_across(
    v_values: wp.array[float],
    slopes: wp.array2d[float],
    width: int,
    channels: int,
    sums: wp.array2d[float],  # out [3, n] of gradient · slope along the row
):
    i = wp.tid()
    column = i // channels % width
    total = wp.vec3()
    for k in range(WINDOW):
        if column + k - RADIUS >= 0 and column + k - RADIUS < width:
            j = i + (k - RADIUS) * channels
            total += WEIGHTS[k] * v_values[j] * wp.vec3(slopes[0, j], slopes[1, j], slopes[2, j])
    for m in range(3):
        sums[m, i] = total[m]


@wp.kernel
def gradient_down(
    sums: wp.array2d[float],  # [3, n] of `gradient_across`
    x: wp.array[float],
    y: wp.array[float],
    row_size: int,
    v_x: wp.array[float],  # out [n]
):
    i = wp.tid()
    count = sums.shape[1]
    total = wp.vec3()
    for k in range(WINDOW):
        j = i + (k - RADIUS) * row_size
        if j >= 0 and j < count:
            total += WEIGHTS[k] * wp.vec3(sums[0, j], sums[1, j], sums[2, j])
    v_x[i] = total[0] + 2.0 * x[i] * total[1] + y[i] * total[2]
