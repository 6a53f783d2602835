"""Semi-global aggregation of matching costs (Hirschmüller 2008), a thread for a path."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def aggregate(
    costs: wp.array3d[float],  # [H, W, L]
    down: int,  # step of the path in rows, −1 to 1
    across: int,  # and in columns
    small: float,  # penalty of a change by one level
    large: float,  # penalty of a larger one
    scratch: wp.array3d[float],  # [H + W, 2, L]
    totals: wp.array3d[float],  # in, out [H, W, L]
):
    """Add to the totals, of each pixel, the least costs of a path that comes to it in one direction, from where it enters the picture."""
    path = wp.tid()
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
        for level in range(levels):
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
        least = smallest
        before = 1 - before
        first = False
        row += down
        column += across
