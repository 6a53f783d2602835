"""Kernels that compare the depth of every pixel of a view with all other views, a thread for a pixel.

Views follow each other in flat arrays. Cameras are focal lengths and principal point (fx, fy, cx, cy), pixels.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def seen_at(
    pixel: int,
    depth: float,
    width: int,
    camera: wp.vec4,
    motion: wp.mat44,
    other: wp.vec4,
    size: wp.vec2i,
):
    """Depth in another view (m) of a pixel of known depth (m), and which of that view's pixels [width, height] it is; −1 = none."""
    column = float(pixel % width) + 0.5
    row = float(pixel // width) + 0.5
    point = wp.vec4((column - camera[2]) / camera[0] * depth, (row - camera[3]) / camera[1] * depth, depth, 1.0)
    there = motion * point
    z = there[2]
    found = int(-1)
    if z > 0.0:
        u = there[0] / z * other[0] + other[2]
        v = there[1] / z * other[1] + other[3]
        if u >= 0.0 and v >= 0.0 and u < float(size[0]) and v < float(size[1]):
            found = int(v) * size[0] + int(u)
    return z, found


@wp.kernel
def uncontradicted(
    first: int,
    own: int,  # index of the view
    width: int,
    start: int,  # of the view's pixels
    cameras: wp.array[wp.vec4],  # [V]
    motions: wp.array[wp.mat44],  # [V] from the view to each of them
    sizes: wp.array[wp.vec2i],  # [V] width, height
    starts: wp.array[int],  # [V]
    depths: wp.array[float],  # [P] m, of all pixels of all views, 0 = none
    factors: wp.array[float],  # [V] least share of the depth that another view sees there
    kept: wp.array[wp.uint8],  # in, out [H·W]
):
    """Drop the pixels of a view whose points lie nearer than the surface that another view sees there, times its factor."""
    pixel = first + wp.tid()
    if kept[pixel] == wp.uint8(0):
        return
    depth = depths[start + pixel]
    for j in range(cameras.shape[0]):
        if j != own:
            z, found = seen_at(pixel, depth, width, cameras[own], motions[j], cameras[j], sizes[j])
            if found >= 0:
                surface = depths[starts[j] + found]
                if surface > 0.0 and z < surface * factors[j]:
                    kept[pixel] = wp.uint8(0)
                    return


@wp.kernel
def mean_colors(
    first: int,
    own: int,
    width: int,
    start: int,
    cameras: wp.array[wp.vec4],
    motions: wp.array[wp.mat44],
    sizes: wp.array[wp.vec2i],
    starts: wp.array[int],
    depths: wp.array[float],
    images: wp.array2d[wp.uint8],  # [P, 3] RGB of all pixels of all views
    tolerance: float,  # relative difference of depth from which on another view sees something else
    chosen: wp.array[int],  # [N] pixels of the view
    colors: wp.array[wp.vec3],  # out [N] RGB in [0, 1]
):
    """Give pixels of a view the mean colour of all views that see their points."""
    i = first + wp.tid()
    pixel = chosen[i]
    at = start + pixel
    total = wp.vec3(float(images[at, 0]), float(images[at, 1]), float(images[at, 2]))
    count = float(1.0)
    for j in range(cameras.shape[0]):
        if j != own:
            z, found = seen_at(pixel, depths[at], width, cameras[own], motions[j], cameras[j], sizes[j])
            if found >= 0:
                there = starts[j] + found
                surface = depths[there]
                if surface > 0.0 and wp.abs(z - surface) < tolerance * surface:
                    total += wp.vec3(float(images[there, 0]), float(images[there, 1]), float(images[there, 2]))
                    count += 1.0
    colors[i] = total / (255.0 * count)
