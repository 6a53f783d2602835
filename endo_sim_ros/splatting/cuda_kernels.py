"""Kernels that composite with one thread per pixel and one block of threads per tile: for GPUs, and plain on a CPU.

The threads of a block read the tile's splats together, 256 at a time, into shared memory, and find out which of its
eight 8×4 blocks of pixels each one meets. A warp has one of these blocks, and looks at the splats that meet it. On a CPU,
where a block has one thread, each reads what it needs, and the functions that concern other threads do nothing.

A tile's splats are `splat_list[ranges[2 t] : ranges[2 t + 1]]`, front to back. If the lists of all tiles find no room,
every tile gets the list of all splats by depth instead: slow, but the same picture.
"""

import warp as wp

from endo_sim_ros.splatting.common_kernels import (
    ABSOLUTE,
    ALPHA_MAX,
    ALPHA_MIN,
    ASPECT_X,
    EXTENT_X,
    EXTENT_Y,
    MEDIAN,
    OPACITY,
    PIXEL_SLACK,
    RED,
    SHEAR_X,
    SHEAR_Y,
    TILE,
    TILE_SIZE,
    TRANSMITTANCE_MIN,
    A,
    B,
    C,
    X,
    Y,
    Z,
)

wp.set_module_options({"enable_backward": False})

BLOCK = TILE**2  # threads of a block, pixels of a tile, and splats that are read at a time
BATCH = wp.constant(BLOCK)

vec12 = wp.types.vector(length=12, dtype=wp.float32)


# ---------------------------------------------------------------- lists


@wp.kernel
def gather_counts(order: wp.array[int], counts: wp.array[int], sorted_counts: wp.array[wp.int64]):
    i = wp.tid()
    sorted_counts[i] = wp.int64(counts[order[i]])


@wp.kernel
def clear_lists(tile_count: int, ranges: wp.array[int], tiles: wp.array[int]):
    """Empty lists, and intersections that sort behind those of all tiles; launched over the room for them."""
    i = wp.tid()
    tiles[i] = tile_count
    if i < tile_count:
        ranges[2 * i] = 0
        ranges[2 * i + 1] = 0


@wp.kernel
def find_ranges(
    tiles: wp.array[int],  # sorted
    values: wp.array[int],  # splats in the same order
    order: wp.array[int],  # all splats by depth
    ends: wp.array[wp.int64],
    tile_mask: wp.array[wp.uint8],
    splat_list: wp.array[int],  # out, as long as there is room for intersections
    ranges: wp.array[int],  # out, zero before
    seen: wp.array[wp.int64],  # out, numbers of intersections and of splats
):
    """Launched over the room for intersections, which is no less than the number of splats and of tiles."""
    i = wp.tid()
    splat_count = ends.shape[0]
    count = ends[splat_count - 1]
    if i == 0:
        seen[0] = count
        seen[1] = wp.int64(splat_count)
    if count > wp.int64(splat_list.shape[0]):
        if i < splat_count:
            splat_list[i] = order[i]
        if i < tile_mask.shape[0] and tile_mask[i] != wp.uint8(0):
            ranges[2 * i + 1] = splat_count
    elif wp.int64(i) < count:
        tile = tiles[i]
        splat_list[i] = values[i]
        if tile < tile_mask.shape[0]:
            if i == 0 or tiles[i - 1] != tile:
                ranges[2 * tile] = i
            if wp.int64(i + 1) == count or tiles[i + 1] != tile:
                ranges[2 * tile + 1] = i + 1


# ---------------------------------------------------------------- threads together


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, condition);
#else
    return condition;
#endif
""")
def warp_any(condition: int) -> int:
    """Whether the condition holds in any thread of the warp, which must be here together."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __syncthreads_or(condition);
#else
    return condition;
#endif
""")
def block_any(condition: int) -> int:
    """Whether the condition holds in any thread of the block, which waits here for all its threads."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 1;
#else
    return 0;
#endif
""")
def is_gpu() -> int:
    """Whether a block has more threads than this one."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float4 rows[3 * 256 + 64];
    const int i = threadIdx.x;
    reinterpret_cast<int*>(rows + 3 * 256)[i] = met;
    if (met) {
        const float4* splat_row = reinterpret_cast<const float4*>(splats.data) + 4 * (size_t)splat;
        const float4 a = __ldg(splat_row), b = __ldg(splat_row + 1), c = __ldg(splat_row + 2), d = __ldg(splat_row + 3);
        rows[3 * i] = make_float4(a.x, a.y, a.z, d.z);
        rows[3 * i + 1] = make_float4(d.x, b.y, b.z, __int_as_float(splat));
        rows[3 * i + 2] = make_float4(b.w, c.x, c.y, 0.0f);
    }
    __syncthreads();
    return (int)__cvta_generic_to_shared(rows);
#else
    return 0;
#endif
""")
def stage(splats: wp.array2d[float], splat: int, met: int) -> int:
    """Put this thread's splat and the blocks of pixels that it meets into shared memory, and wait for the other threads.

    Returns the place of the first; the blocks lie behind the splats.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    int blocks;
    asm volatile("ld.shared.s32 %0, [%1];" : "=r"(blocks) : "r"(batch + 256 * 48 + 4 * (32 * word + (int)(threadIdx.x & 31))));
    return __ballot_sync(0xffffffffu, blocks >> (threadIdx.x / 32) & 1);
#else
    return 0u;
#endif
""")
def staged_for_warp(batch: int, word: int) -> wp.uint32:
    """Which of 32 splats in shared memory this warp's pixels meet, as bits."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_bit(bits: wp.uint32) -> int:
    """Number of the lowest bit that is set; there must be one."""
    ...


@wp.func_native("""
    wp::vec_t<12, wp::float32> row;
#if defined(__CUDA_ARCH__)
    const int place = batch + 48 * i;
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];" : "=f"(row[0]), "=f"(row[1]), "=f"(row[2]), "=f"(row[3]) : "r"(place));
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];" : "=f"(row[4]), "=f"(row[5]), "=f"(row[6]), "=f"(row[7]) : "r"(place + 16));
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];" : "=f"(row[8]), "=f"(row[9]), "=f"(row[10]), "=f"(row[11]) : "r"(place + 32));
#else
    const float* splat = splats.data + 16 * (size_t)splat_list.data[first + i];
    const int columns[11] = {0, 1, 2, 14, 12, 5, 6, 0, 7, 8, 9};
    for (int k = 0; k < 11; ++k)
        row[k] = splat[columns[k]];
    __builtin_memcpy(&row[7], splat_list.data + first + i, 4);
#endif
    return row;
""")
def staged_splat(batch: int, i: int, splats: wp.array2d[float], splat_list: wp.array[int], first: int) -> vec12:
    """X, Y, A, SHEAR_X, ASPECT_X, OPACITY, Z, its number as bits, RED, GREEN and BLUE of splat i in shared memory."""
    ...


@wp.func_native("""
    // Rounded alike wherever it is compiled into: both passes must draw the same splats.
#if defined(__CUDA_ARCH__)
    const float run = __fmaf_rn(shear, dy, dx), rise = __fmul_rn(aspect, dy);
    return __expf(__fmul_rn(__fmul_rn(-0.5f, a), __fmaf_rn(run, run, __fmul_rn(rise, rise))));
#else
    const float run = dx + shear * dy, rise = aspect * dy;
    return expf(-0.5f * a * (run * run + rise * rise));
#endif
""")
def exponential(dx: float, dy: float, a: float, shear: float, aspect: float) -> float:
    """exp(−σ) at an offset from the mean (pixels), to a few units in the last place.

    σ as a sum of squares: far from the mean of a needle the terms of the other form cancel.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __fdividef(x, y);
#else
    return x / y;
#endif
""")
def fast_divide(x: float, y: float) -> float:
    """x / y to two units in the last place."""
    ...


@wp.func_native("""
    float* record = records.data + 12 * (size_t)splat;
#if defined(__CUDA_ARCH__)
    // At each step a thread keeps half of its sums and gives the other half to a partner, until it has a single one.
    const int lane = threadIdx.x & 31;
    const auto halve = [&](float a, float b, int step) {
        const bool upper = lane & step;
        return (upper ? b : a) + __shfl_xor_sync(0xffffffffu, upper ? a : b, step);
    };
    const auto add = [&](float a, int step) { return a + __shfl_xor_sync(0xffffffffu, a, step); };
    const float a0 = halve(values[0], values[8], 16), a1 = halve(values[1], values[9], 16);
    const float a2 = halve(values[2], values[10], 16), a3 = halve(values[3], values[11], 16);
    const float a4 = add(values[4], 16), a5 = add(values[5], 16), a6 = add(values[6], 16), a7 = add(values[7], 16);
    const float b0 = halve(a0, a4, 8), b1 = halve(a1, a5, 8), b2 = halve(a2, a6, 8), b3 = halve(a3, a7, 8);
    const float c0 = halve(b0, b2, 4), c1 = halve(b1, b3, 4);
    const float sum = add(halve(c0, c1, 2), 1);
    if ((lane & 1) == 0 && lane / 2 < count)
        atomicAdd(record + lane / 2, sum);
#else
    for (int k = 0; k < count; ++k)
        record[k] += values[k];
#endif
""")
def add_record(values: vec12, records: wp.array2d[float], splat: int, count: int):
    """Add the first values of all threads of the warp, which must be here together, to the record of a splat."""
    ...


# ---------------------------------------------------------------- pixels


@wp.func
def blocks_met(splats: wp.array2d[float], splat: int, x0: float, y0: float) -> int:
    """Which 8×4 blocks of the tile with its corner at a place (pixels) an ellipse meets, as bits, row by row.

    As `tile_columns` does for rows of tiles.
    """
    x, y = splats[splat, X] - x0, splats[splat, Y] - y0
    extent_y = splats[splat, EXTENT_Y]
    square = extent_y * extent_y
    shear, aspect = splats[splat, SHEAR_X], splats[splat, ASPECT_X]
    widest = -splats[splat, SHEAR_Y] * splats[splat, EXTENT_X]
    met = int(0)
    for row in range(4):
        low = wp.max(float(4 * row) + 0.5 - y - PIXEL_SLACK, -extent_y)
        high = wp.min(float(4 * row) + 3.5 - y + PIXEL_SLACK, extent_y)
        if low <= high:
            dy_right = wp.clamp(widest, low, high)
            dy_left = wp.clamp(-widest, low, high)
            right = x - shear * dy_right + aspect * wp.sqrt(wp.max(square - dy_right * dy_right, 0.0)) + PIXEL_SLACK
            left = x - shear * dy_left - aspect * wp.sqrt(wp.max(square - dy_left * dy_left, 0.0)) - PIXEL_SLACK
            for column in range(2):
                if left <= float(8 * column) + 7.5 and right >= float(8 * column) + 0.5:
                    met = met | (1 << (2 * row + column))
    return met


@wp.func
def read_batch(
    first: int,
    end: int,
    lane: int,
    camera: int,
    x0: float,
    y0: float,
    splats: wp.array2d[float],
    counts: wp.array[int],
    gaussian_count: int,
    splat_list: wp.array[int],
) -> int:
    """Bring the next 256 splats of a list to the threads of a block. Returns the place of the first."""
    batch = int(0)
    if is_gpu() != 0:
        splat, met = int(0), int(0)
        if first + lane < end:
            splat = splat_list[first + lane]
            # The list of all splats also has those of other cameras, and those that are in no image.
            if counts[splat] > 0 and splat // gaussian_count == camera:
                met = blocks_met(splats, splat, x0, y0)
        batch = stage(splats, splat, met)
    return batch


@wp.func
def splats_to_draw(
    batch: int,
    word: int,
    first: int,
    end: int,
    camera: int,
    counts: wp.array[int],
    gaussian_count: int,
    splat_list: wp.array[int],
) -> wp.uint32:
    """Which of 32 splats of the batch this thread and those of its warp have to look at, as bits."""
    bits = wp.uint32(0)
    if is_gpu() != 0:
        bits = staged_for_warp(batch, word)
    else:
        for i in range(32):
            slot = first + 32 * word + i
            if slot < end:
                splat = splat_list[slot]
                if counts[splat] > 0 and splat // gaussian_count == camera:
                    bits = bits | (wp.uint32(1) << wp.uint32(i))
    return bits


@wp.func
def pixel_in_tile(lane: int) -> wp.vec2i:
    """Position of a thread's pixel in its tile. A warp covers 8×4 pixels, so that its threads agree more often."""
    warp = lane // 32
    return wp.vec2i((warp % 2) * 8 + lane % 8, (warp // 2) * 4 + (lane % 32) // 8)


@wp.func
def reference_depth(
    start: int,
    end: int,
    camera: int,
    splats: wp.array2d[float],
    counts: wp.array[int],
    gaussian_count: int,
    splat_list: wp.array[int],
) -> float:
    """Depth of the first splat of a list, if it is of this camera."""
    if start < end:
        splat = splat_list[start]
        if counts[splat] > 0 and splat // gaussian_count == camera:
            return splats[splat, Z]
    return 0.0


@wp.kernel(launch_bounds=(BLOCK, 5))
def render_pixels(
    splats: wp.array2d[float],
    counts: wp.array[int],
    gaussian_count: int,
    splat_list: wp.array[int],
    ranges: wp.array[int],
    background: wp.array[wp.vec3],  # [1]
    width: int,
    height: int,
    colors: wp.array[wp.vec3],  # out [C·H·W], as all below
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    wants_owners: int,
    owners_of_median: wp.array[int],  # splat at the median depth or -1, filled when wants_owners
):
    """Composite one pixel. Launched over tiles × 256 threads."""
    thread = wp.tid()
    tile = thread // BATCH
    lane = thread - tile * BATCH
    tiles_x = (width + TILE_SIZE - 1) // TILE_SIZE
    tiles_y = (height + TILE_SIZE - 1) // TILE_SIZE
    camera = tile // (tiles_x * tiles_y)
    column0, row0 = (tile % tiles_x) * TILE_SIZE, (tile // tiles_x % tiles_y) * TILE_SIZE
    in_tile = pixel_in_tile(lane)
    column, row = column0 + in_tile[0], row0 + in_tile[1]
    px, py = float(column) + 0.5, float(row) + 0.5
    start, end = ranges[2 * tile], ranges[2 * tile + 1]
    reference = reference_depth(start, end, camera, splats, counts, gaussian_count, splat_list)

    live = int(0)
    if column < width and row < height:
        live = 1
    color = wp.vec3()
    depth, distortion = float(0.0), float(0.0)
    transmittance = float(1.0)
    owner = int(-1)
    for first in range(start, end, BATCH):
        if block_any(live) == 0:
            break
        batch = read_batch(first, end, lane, camera, float(column0), float(row0), splats, counts, gaussian_count, splat_list)
        for word in range((wp.min(end - first, BATCH) + 31) // 32):
            if warp_any(live) == 0:
                break
            bits = splats_to_draw(batch, word, first, end, camera, counts, gaussian_count, splat_list)
            while bits != wp.uint32(0):
                s = staged_splat(batch, 32 * word + lowest_bit(bits), splats, splat_list, first)
                bits = bits & (bits - wp.uint32(1))
                alpha = wp.min(ALPHA_MAX, s[5] * exponential(s[0] - px, s[1] - py, s[2], s[3], s[4]))
                if live != 0 and alpha >= ALPHA_MIN:
                    following = transmittance * (1.0 - alpha)
                    if following < TRANSMITTANCE_MIN:
                        live = 0
                    else:
                        weight = alpha * transmittance
                        z = s[6] - reference
                        color += weight * wp.vec3(s[8], s[9], s[10])
                        distortion += 2.0 * weight * (z * (1.0 - transmittance) - depth)
                        depth += weight * z
                        if transmittance > MEDIAN and following <= MEDIAN:
                            owner = wp.cast(s[7], wp.int32)
                        transmittance = following

    if column < width and row < height:
        pixel = (camera * height + row) * width + column
        colors[pixel] = color + transmittance * background[0]
        depths[pixel] = depth + reference * (1.0 - transmittance)
        alphas[pixel] = 1.0 - transmittance
        distortions[pixel] = distortion
        if wants_owners != 0:
            owners_of_median[pixel] = owner


@wp.kernel(launch_bounds=(BLOCK, 4))
def render_pixels_backward(
    splats: wp.array2d[float],
    counts: wp.array[int],
    gaussian_count: int,
    splat_list: wp.array[int],
    ranges: wp.array[int],
    background: wp.array[wp.vec3],  # [1]
    width: int,
    height: int,
    colors: wp.array[wp.vec3],
    depths: wp.array[float],
    alphas: wp.array[float],
    distortions: wp.array[float],
    v_colors: wp.array[wp.vec3],
    v_depths: wp.array[float],
    v_alphas: wp.array[float],
    v_distortions: wp.array[float],
    wants_absolute: int,
    records: wp.array2d[float],  # out, zeroed before: each warp adds its share
):
    """Gradients of one pixel. All threads of a warp walk the same splats, also those whose pixel is finished."""
    thread = wp.tid()
    tile = thread // BATCH
    lane = thread - tile * BATCH
    tiles_x = (width + TILE_SIZE - 1) // TILE_SIZE
    tiles_y = (height + TILE_SIZE - 1) // TILE_SIZE
    camera = tile // (tiles_x * tiles_y)
    column0, row0 = (tile % tiles_x) * TILE_SIZE, (tile // tiles_x % tiles_y) * TILE_SIZE
    in_tile = pixel_in_tile(lane)
    column, row = column0 + in_tile[0], row0 + in_tile[1]
    px, py = float(column) + 0.5, float(row) + 0.5
    start, end = ranges[2 * tile], ranges[2 * tile + 1]
    reference = reference_depth(start, end, camera, splats, counts, gaussian_count, splat_list)

    live = int(0)
    v_color = wp.vec3()
    v_depth, v_alpha, v_distortion = float(0.0), float(0.0), float(0.0)
    total_weight, total_depth, remaining = float(0.0), float(0.0), float(0.0)
    if column < width and row < height:
        live = 1
        pixel = (camera * height + row) * width + column
        v_color = v_colors[pixel]
        v_depth = v_depths[pixel]
        v_distortion = v_distortions[pixel]
        total_weight = alphas[pixel]
        total_depth = depths[pixel] - reference * total_weight
        # The background is seen through the transmittance 1 − alpha, and depths count from the reference.
        v_alpha = v_alphas[pixel] - wp.dot(v_color, background[0]) + v_depth * reference
        foreground = colors[pixel] - (1.0 - total_weight) * background[0]
        remaining = wp.dot(v_color, foreground) + v_depth * total_depth + v_alpha * total_weight
        remaining += 2.0 * v_distortion * distortions[pixel]
    value_count = int(10)
    if wants_absolute != 0:
        value_count = 12

    transmittance, depth = float(1.0), float(0.0)
    for first in range(start, end, BATCH):
        if block_any(live) == 0:
            break
        batch = read_batch(first, end, lane, camera, float(column0), float(row0), splats, counts, gaussian_count, splat_list)
        for word in range((wp.min(end - first, BATCH) + 31) // 32):
            if warp_any(live) == 0:
                break
            bits = splats_to_draw(batch, word, first, end, camera, counts, gaussian_count, splat_list)
            while bits != wp.uint32(0):
                s = staged_splat(batch, 32 * word + lowest_bit(bits), splats, splat_list, first)
                bits = bits & (bits - wp.uint32(1))
                dx, dy = s[0] - px, s[1] - py
                falloff = exponential(dx, dy, s[2], s[3], s[4])
                alpha = wp.min(ALPHA_MAX, s[5] * falloff)
                following = transmittance * (1.0 - alpha)
                draws = int(0)
                if live != 0 and alpha >= ALPHA_MIN:
                    if following < TRANSMITTANCE_MIN:
                        live = 0
                    else:
                        draws = 1
                if warp_any(draws) != 0:
                    v = vec12()
                    if draws != 0:
                        weight = alpha * transmittance
                        z = s[6] - reference
                        spread = 2.0 - transmittance - following - total_weight  # W_i + W_{i+1} − W
                        v_weight = wp.dot(v_color, wp.vec3(s[8], s[9], s[10])) + v_depth * z + v_alpha
                        v_weight += 2.0 * v_distortion * (z * spread + total_depth - 2.0 * depth - weight * z)
                        depth += weight * z
                        remaining -= weight * v_weight
                        v_splat_alpha = transmittance * v_weight - fast_divide(remaining, 1.0 - alpha)
                        transmittance = following
                        v[Z] = weight * (v_depth + 2.0 * v_distortion * spread)
                        v[RED] = weight * v_color[0]
                        v[RED + 1] = weight * v_color[1]
                        v[RED + 2] = weight * v_color[2]
                        if s[5] * falloff <= ALPHA_MAX:
                            run, rise = dx + s[3] * dy, s[4] * dy
                            v_sigma = -alpha * v_splat_alpha
                            v[OPACITY] = falloff * v_splat_alpha
                            # A dx + B dy and B dx + C dy.
                            v[X] = v_sigma * s[2] * run
                            v[Y] = v_sigma * s[2] * (s[3] * run + s[4] * rise)
                            v[A] = 0.5 * v_sigma * dx * dx
                            v[B] = v_sigma * dx * dy
                            v[C] = 0.5 * v_sigma * dy * dy
                            v[ABSOLUTE] = wp.abs(v[X])
                            v[ABSOLUTE + 1] = wp.abs(v[Y])
                    add_record(v, records, wp.cast(s[7], wp.int32), value_count)
