"""The backend of CPUs: kernels of vectors of 16 pixels, in as many threads as there are cores."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import cpu_threads, run_in_threads
from endo_sim_ros.core.kernels import launch, launch_in_shares
from endo_sim_ros.core.native import LANE_COUNT
from endo_sim_ros.splatting import common_kernels as kernels, cpu_kernels
from endo_sim_ros.splatting.constants import RECORD_SIZE, SPLAT_SIZE
from endo_sim_ros.splatting.scene import Gradients, Scene, Settings, empty_images

modules = (kernels, cpu_kernels)
_LEAST = 1024  # fewer splats are left to one thread


class State(NamedTuple):
    """Which splat meets which tile; `common_kernels` defines the terms."""

    splats: Tensor  # [C·N, 16]
    counts: Tensor  # [C·N] intersections of each splat
    firsts: Tensor  # [C·N] first intersection of each splat
    owners: Tensor  # [I] splat of each intersection
    slots: Tensor  # [I] intersections by tile, then depth
    starts: Tensor  # [tiles + 1] first slot of each tile


def forward(scene: Scene, tile_mask: Tensor | None, settings: Settings) -> tuple[list[Tensor], Tensor, Tensor, State]:
    """Draw a scene, as `RasterBackend` says."""
    s, splat_count = settings, scene.splat_count
    integers = functools.partial(scene.means.new_empty, dtype=torch.int32)
    images, owners = empty_images(scene, settings)
    splats, counts = scene.means.new_empty(splat_count, SPLAT_SIZE), integers(splat_count)
    radii, depth_keys, order = integers((len(scene.viewmats), scene.gaussian_count)), integers(2 * splat_count), integers(2 * splat_count)
    arguments = [*scene.gaussian_arguments(), scene.opacities, scene.sh, scene.viewmats, scene.Ks, s.width, s.height, s.near, s.eps2d]
    arguments += [scene.per_camera, s.tiles_x, s.tiles_y, tile_mask, splats, radii, depth_keys, order, counts]
    _launch_items(kernels.project, len(scene.viewmats) * -(-scene.gaussian_count // LANE_COUNT), arguments)
    state = _intersect(scene, splats, depth_keys, order, counts, tile_mask, settings)
    arguments = [*_lists(state, scene), scene.viewmats, scene.Ks, s.glints, s.width, s.height, *images, int(s.median), owners]
    _launch_tiles(cpu_kernels.render_tiles, len(state.starts) - 1, arguments)
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
    scene: Scene, splats: Tensor, depth_keys: Tensor, order: Tensor, counts: Tensor, tile_mask: Tensor | None, settings: Settings
) -> State:
    """Return lists of the splats of every tile in depth order."""
    splat_count, tile_count = len(counts), settings.tile_count(scene)
    wp.utils.radix_sort_pairs(wp.from_torch(depth_keys), wp.from_torch(order), splat_count, 0, 31)
    ends = counts.index_select(0, order[:splat_count]).cumsum(0)
    count = int(ends[-1]) if splat_count else 0

    firsts, tiles, owners, slots, starts = torch.empty_like(counts), *counts.new_empty(3, count), counts.new_empty(tile_count + 1)
    arguments = [order, ends, counts, scene.gaussian_count, splats, settings.tiles_x, settings.tiles_y, tile_mask, tile_count, count]
    _launch_items(kernels.emit_intersections, -(-splat_count // LANE_COUNT) if count else 0, [*arguments, tiles, owners, firsts])
    launch(cpu_kernels.sort_by_tile, 1, [tiles, slots, starts], "cpu")
    return State(splats, counts, firsts, owners, slots, starts)


def _launch_items(kernel: Any, item_count: int, arguments: list) -> None:
    """Launch a kernel of `common_kernels` over items of as many splats as a vector holds."""
    launch_in_shares(kernel, item_count, [LANE_COUNT, *arguments], _LEAST // LANE_COUNT)


def _lists(state: State, scene: Scene) -> list:
    """Return the first arguments, after the counter, of both kernels that composite."""
    return [state.splats, scene.extras, state.owners, state.slots, state.starts, scene.background]


def _launch_tiles(kernel: Any, tile_count: int, arguments: list) -> None:
    """Launch a kernel that draws tiles from a counter, its first argument, in all threads."""
    arguments = [torch.zeros(1, dtype=torch.int32, device="cpu"), *arguments]
    run_in_threads([functools.partial(launch, kernel, tile_count, arguments, "cpu")] * min(cpu_threads(), tile_count))
