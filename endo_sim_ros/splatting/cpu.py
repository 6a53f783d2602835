"""The backend of CPUs: kernels of vectors of 16 pixels, in as many threads as there are cores."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import cpu_threads, run_in_threads
from endo_sim_ros.core.kernels import launch, launch_in_shares
from endo_sim_ros.splatting import common_kernels as kernels, cpu_kernels
from endo_sim_ros.splatting.constants import RECORD_SIZE, SPLAT_SIZE
from endo_sim_ros.splatting.scene import Gradients, Scene, Settings, empty_images

modules = (kernels, cpu_kernels)


class State(NamedTuple):
    """Which splat meets which tile; `common_kernels` defines the terms."""

    splats: Tensor  # [C·N, 16]
    counts: Tensor  # [C·N] intersections of each splat
    firsts: Tensor  # [C·N] first intersection of each splat
    owners: Tensor  # [I] splat of each intersection
    slots: Tensor  # [I] intersections by tile, then depth
    starts: Tensor  # [tiles + 1] first slot of each tile


def forward(scene: Scene, tile_mask: Tensor, settings: Settings) -> tuple[list[Tensor], Tensor, Tensor, State]:
    """Draw a scene, as `RasterBackend` says."""
    s, splat_count = settings, scene.splat_count
    integers = functools.partial(scene.means.new_empty, dtype=torch.int32)
    images, owners = empty_images(scene, settings)
    splats, counts = scene.means.new_empty(splat_count, SPLAT_SIZE), integers(splat_count)
    radii, depth_keys, order = integers((len(scene.viewmats), scene.gaussian_count)), integers(2 * splat_count), integers(2 * splat_count)
    arguments = [*scene.gaussian_arguments(), scene.opacities, scene.sh, scene.viewmats, scene.Ks, s.width, s.height, s.near, s.eps2d]
    launch_in_shares(kernels.project, splat_count, [*arguments, scene.per_camera, tile_mask, splats, radii, depth_keys, order, counts])
    state = _intersect(splats, depth_keys, order, counts, tile_mask, scene.gaussian_count, settings)
    arguments = [*_lists(state, scene), scene.viewmats, scene.Ks, s.glints, s.width, s.height, *images, int(s.median), owners]
    _launch_tiles(cpu_kernels.render_tiles, len(tile_mask), arguments)
    return images, radii, owners, state


def backward(
    scene: Scene, state: State, settings: Settings, images: Sequence[Tensor], v_images: Sequence[Tensor], gradients: Gradients
) -> None:
    """Fill the gradients of a scene, as `RasterBackend` says."""
    records = scene.means.new_empty(len(state.owners), RECORD_SIZE)
    arguments = [*_lists(state, scene), settings.width, settings.height, *images, *v_images, gradients.wants_absolute(settings), records]
    _launch_tiles(cpu_kernels.render_tiles_backward, len(state.starts) - 1, arguments)
    arguments = [*scene.gaussian_arguments(), scene.sh, scene.viewmats, scene.Ks, settings.width, settings.height, settings.eps2d]
    arguments += [state.counts, 0, state.firsts, records, *gradients.arguments(settings)]
    launch_in_shares(kernels.project_backward, len(scene.means), arguments)


def _intersect(
    splats: Tensor, depth_keys: Tensor, order: Tensor, counts: Tensor, tile_mask: Tensor, gaussian_count: int, settings: Settings
) -> State:
    """Return lists of the splats of every tile in depth order."""
    splat_count, tile_count = len(counts), len(tile_mask)
    _sort_pairs(depth_keys, order, splat_count, 31)
    ends = counts[order[:splat_count]].cumsum(0)
    count = int(ends[-1]) if splat_count else 0

    firsts, tiles, slots = torch.empty_like(counts), *counts.new_empty(2, 2 * count)
    owners, starts = counts.new_empty(count), counts.new_empty(tile_count + 1)
    arguments = [order, ends, counts, gaussian_count, splats, tile_mask, settings.tiles_x, settings.tiles_y, count, 0]
    launch_in_shares(kernels.emit_intersections, splat_count if count else 0, [*arguments, tiles, slots, firsts, owners])
    if count:
        _sort_pairs(tiles, slots, count, (tile_count + 1).bit_length())
    launch_in_shares(cpu_kernels.find_tile_starts, count + 1, [tiles, count, starts])
    return State(splats, counts, firsts, owners, slots, starts)


def _sort_pairs(keys: Tensor, values: Tensor, count: int, bits: int) -> None:
    """Stable sort of the first count keys, from 0 to 2^bits − 1, and their values; both have room for 2·count."""
    wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, 0, bits)


def _lists(state: State, scene: Scene) -> list:
    """Return the first arguments, after the counter, of both kernels that composite."""
    return [state.splats, scene.extras, state.owners, state.slots, state.starts, scene.background]


def _launch_tiles(kernel: Any, tile_count: int, arguments: list) -> None:
    """Launch a kernel that draws tiles from a counter, its first argument, in all threads."""
    arguments = [torch.zeros(1, dtype=torch.int32, device="cpu"), *arguments]
    run_in_threads([functools.partial(launch, kernel, tile_count, arguments, "cpu")] * min(cpu_threads(), tile_count))
