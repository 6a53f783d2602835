"""Kernel of `drawing`, for B pictures at once: the light of the tissue."""

import warp as wp

from endo_sim_ros.core.block_sums import OPTIONS, block_sum
from endo_sim_ros.instruments.drawing_kernels import Frame

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, **OPTIONS})

LANES = 256  # threads of a block, as Warp launches them on a GPU unless told otherwise


@wp.kernel
def sum_light(
    first: int,
    lanes: int,  # threads that share a picture: a block on a GPU, 1 on a CPU
    frame: Frame,
    stride: int,  # pixels from one that is read to the next
    colors: wp.array[wp.vec3],  # [P]
    alphas: wp.array[float],  # [P]
):
    """Squares, as the pictures are gamma-compressed; added up in float64, so that the order of the sum does not show."""
    i = first + wp.tid()
    picture, lane = i // lanes, i % lanes
    across, down = (frame.width + stride - 1) // stride, (frame.height + stride - 1) // stride
    red, green, blue = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for k in range(lane, across * down, lanes):
        pixel = (picture * frame.height + k // across * stride) * frame.width + k % across * stride
        if alphas[pixel] > 0.5:
            color = colors[pixel]
            red += wp.float64(color[0] * color[0])
            green += wp.float64(color[1] * color[1])
            blue += wp.float64(color[2] * color[2])
    red, green, blue = block_sum(red), block_sum(green), block_sum(blue)
    if lane == 0:  # as bright as it gets without being more than 1 in any colour; white where there is none
        light = wp.vec3d(red, green, blue) + wp.vec3d(wp.float64(1.0e-6))
        frame.around[picture] = wp.vec3(light / wp.max(light))
