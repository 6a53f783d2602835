"""Matching costs of planes, a thread for a pixel, and their semi-global aggregation (Hirschmüller 2008), a warp of threads for a path."""

import warp as wp

from endo_sim_ros.reconstruction.priors.smoothing_kernels import mirrored

wp.set_module_options({"enable_backward": False})

WARP = 32  # threads of a GPU that go together


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int apart = 16; apart > 0; apart /= 2) value = fminf(value, __shfl_xor_sync(0xffffffffu, value, apart));
    __syncwarp();  // what the threads have written, all of them may read
#endif
    return value;
""")
def least_of_warp(value: float) -> float:
    """The least value of the threads of a warp; on a CPU, where a path has one thread, that of the thread."""
    ...


@wp.func
def within(pictures: wp.array3d[wp.vec2], index: int, row: int, column: int):
    """A pixel of a picture; zeros beyond it."""
    if row < 0 or column < 0 or row >= pictures.shape[1] or column >= pictures.shape[2]:
        return wp.vec2(0.0, 0.0)
    return pictures[index, row, column]


@wp.kernel
def warp_pictures(
    pictures: wp.array3d[wp.vec2],  # [J, H, W] grey level, and 1 for tissue
    homographies: wp.array[wp.mat33],  # [J] from pixels of the view to those of a picture; their centres are whole numbers
    rows: int,  # of the view
    columns: int,
    warped: wp.array3d[wp.vec2],  # out [J, rows, columns]
):
    """Pictures as they would look from a view."""
    thread = wp.tid()
    index = thread // (rows * columns)
    row = thread // columns % rows
    column = thread % columns
    found = homographies[index] * wp.vec3(float(column), float(row), 1.0)
    value = wp.vec2(0.0, 0.0)
    if found[2] != 0.0:
        x = wp.clamp(found[0] / found[2], -2.0, float(pictures.shape[2]) + 1.0)
        y = wp.clamp(found[1] / found[2], -2.0, float(pictures.shape[1]) + 1.0)
        left = int(wp.floor(x))
        top = int(wp.floor(y))
        right_share = x - float(left)
        low_share = y - float(top)
        above = within(pictures, index, top, left) * (1.0 - right_share) + within(pictures, index, top, left + 1) * right_share
        below = within(pictures, index, top + 1, left) * (1.0 - right_share) + within(pictures, index, top + 1, left + 1) * right_share
        value = above * (1.0 - low_share) + below * low_share
    warped[index, row, column] = value


@wp.kernel
def match_costs(
    own: wp.array2d[float],  # [H, W] grey level
    inside: wp.array2d[wp.uint8],  # [H, W] 1 where a window shows nothing but tissue
    mean: wp.array2d[float],  # [H, W] over windows
    variance: wp.array2d[float],  # [H, W]
    warped: wp.array3d[wp.vec2],  # [J, H, W] the others as they would look on a plane
    window: int,  # side of it, pixels
    noise: float,  # variance of it
    level: wp.array[int],  # [1] of the plane
    scratch: wp.array3d[float],  # [J, H, W]
    costs: wp.array3d[float],  # out [H, W, L]
):
    """1 − correlation with the better half of the others; 1 where there is nothing to compare with."""
    thread = wp.tid()
    row = thread // own.shape[1]
    column = thread % own.shape[1]
    before = window // 2
    for index in range(warped.shape[0]):
        sums = wp.vec4(0.0, 0.0, 0.0, 0.0)  # grey level, its square, its product with the view's, tissue
        if inside[row, column] > wp.uint8(0):
            for down in range(-before, window - before):
                for across in range(-before, window - before):
                    r = mirrored(row + down, own.shape[0])
                    c = mirrored(column + across, own.shape[1])
                    there = warped[index, r, c]
                    sums += wp.vec4(there[0], there[0] * there[0], there[0] * own[r, c], there[1])
            sums = sums / float(window * window)
        cost = float(1.0)
        if sums[3] > 0.95:
            spread = variance[row, column] * (wp.max(sums[1] - sums[0] * sums[0], 0.0) + noise)
            cost = wp.min(1.0 - (sums[2] - mean[row, column] * sums[0]) / wp.sqrt(spread), 1.0)
        scratch[index, row, column] = cost
    count = (warped.shape[0] + 1) // 2
    total = float(0.0)
    for _taken in range(count):
        best = int(0)
        for index in range(1, warped.shape[0]):
            if scratch[index, row, column] < scratch[best, row, column]:
                best = index
        total += scratch[best, row, column]
        scratch[best, row, column] = 3.0  # above any
    costs[row, column, level[0]] = total / float(count)


@wp.kernel
def aggregate(
    costs: wp.array3d[float],  # [H, W, L]
    down: int,  # step of the path in rows, −1 to 1
    across: int,  # and in columns
    small: float,  # penalty of a change by one level
    large: float,  # penalty of a larger one
    lanes: int,  # threads of a path: a warp, or one on a CPU
    scratch: wp.array3d[float],  # [H + W, 2, L]
    totals: wp.array3d[float],  # in, out [H, W, L]
):
    """Add to the totals, of each pixel, the least costs of a path that comes to it in one direction, from where it enters the picture."""
    thread = wp.tid()
    path = thread // lanes
    rows, columns, levels = costs.shape[0], costs.shape[1], costs.shape[2]
    row = int(0)
    column = int(0)
    if path < columns:  # those that enter through the first row, or the last
        if down == 0:
            return
        column = path
        if down < 0:
            row = rows - 1
    else:  # and through the first column, or the last
        row = path - columns
        if across == 0 or (down > 0 and row == 0) or (down < 0 and row == rows - 1):
            return
        if across < 0:
            column = columns - 1
    before = int(0)
    least = float(0.0)
    first = bool(True)
    while row >= 0 and row < rows and column >= 0 and column < columns:
        smallest = float(1.0e30)
        for level in range(thread % lanes, levels, lanes):
            cost = costs[row, column, level]
            if not first:
                best = wp.min(scratch[path, before, level], least + large)
                if level > 0:
                    best = wp.min(best, scratch[path, before, level - 1] + small)
                if level < levels - 1:
                    best = wp.min(best, scratch[path, before, level + 1] + small)
                cost += best - least
            scratch[path, 1 - before, level] = cost
            totals[row, column, level] += cost
            smallest = wp.min(smallest, cost)
        least = least_of_warp(smallest)
        before = 1 - before
        first = False
        row += down
        column += across
