"""Kernel of `drawing`, for B pictures at once: the light of the tissue, in all and in cells of the picture."""

import warp as wp

from endo_sim_ros.core.block_sums import OPTIONS, block_sum
from endo_sim_ros.instruments.drawing_kernels import CELLS, Frame

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, **OPTIONS})

LANES = 256  # threads of a block, as Warp launches them on a GPU unless told otherwise


PLACES = wp.constant(4)  # of a cell, each way, that are read


@wp.kernel
def sum_light(
    first: int,
    lanes: int,  # threads that share a picture: a block on a GPU, 1 on a CPU
    frame: Frame,
    colors: wp.array[wp.vec3],  # [P]
    depths: wp.array[float],  # [P] Σ w z, m
    alphas: wp.array[float],  # [P]
):
    """Squares, as the pictures are gamma-compressed; added up in float64, so that the order of the sum does not show."""
    i = first + wp.tid()
    picture, lane = i // lanes, i % lanes
    red, green, blue = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    fine, all_cells = CELLS * PLACES, CELLS * CELLS
    for cell in range(lane, all_cells, lanes):
        light = wp.vec3(0.0, 0.0, 0.0)
        depth = float(0.0)
        count = float(0.0)
        for k in range(PLACES * PLACES):
            row = ((cell // CELLS * PLACES + k // PLACES) * 2 + 1) * frame.height // (2 * fine)
            column = ((cell % CELLS * PLACES + k % PLACES) * 2 + 1) * frame.width // (2 * fine)
            pixel = (picture * frame.height + row) * frame.width + column
            alpha = alphas[pixel]
            if alpha > 0.5:
                light += wp.cw_mul(colors[pixel], colors[pixel])
                depth += depths[pixel] / alpha
                count += 1.0
        frame.cells[picture * all_cells + cell] = wp.vec4(light[0], light[1], light[2], depth) / wp.max(count, 1.0)
        red, green, blue = red + wp.float64(light[0]), green + wp.float64(light[1]), blue + wp.float64(light[2])
    red, green, blue = block_sum(red), block_sum(green), block_sum(blue)
    if lane == 0:  # as bright as it gets without being more than 1 in any colour; white where there is none
        whole = wp.vec3d(red, green, blue) + wp.vec3d(wp.float64(1.0e-6))
        frame.around[picture] = wp.vec3(whole / wp.max(whole))
