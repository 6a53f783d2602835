"""Runs the kernels made for CPUs, in as many threads as there are cores."""

import functools
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import cpu_threads, run_in_threads, shares
from endo_sim_ros.splatting import common_kernels as kernels
from endo_sim_ros.splatting import cpu_kernels as simd_kernels
from endo_sim_ros.splatting.backend import Gradients, Scene, Settings, empty_images, kernel_arguments

MODULES = (kernels, simd_kernels)


class State(NamedTuple):
    """Which splat meets which tile; the header of the kernels defines the terms."""

    splats: Tensor  # [C·N, 16]
    counts: Tensor  # [C·N] intersections of each splat
    firsts: Tensor  # [C·N] first intersection of each splat
    owners: Tensor  # [I] splat of each intersection
    slots: Tensor  # [I] intersections by tile, then depth
    starts: Tensor  # [tiles + 1] first slot of each tile


def forward(scene: Scene, tile_mask: Tensor, settings: Settings) -> tuple[list[Tensor], Tensor, Tensor, State]:
    """Images, radii, owners of median depths, and what `backward` needs."""
    s, splat_count = settings, scene.splat_count
    integers = functools.partial(scene.means.new_empty, dtype=torch.int32)
    images, owners = empty_images(scene, settings)
    splats, counts = scene.means.new_empty(splat_count, kernels.SPLAT_SIZE), integers(splat_count)
    radii, depth_keys, order = integers((len(scene.viewmats), scene.gaussian_count)), integers(2 * splat_count), integers(2 * splat_count)
    arguments = [*scene.gaussian_arguments(), scene.opacities, scene.sh, scene.viewmats, scene.Ks, s.width, s.height, s.near, s.eps2d]
    _launch(kernels.project, splat_count, [*arguments, scene.apart, tile_mask, splats, radii, depth_keys, order, counts])
    state = _intersect(splats, depth_keys, order, counts, tile_mask, scene.gaussian_count, settings)
    arguments = [*_image_arguments(state, scene, settings, images), int(settings.median), owners]
    _launch_tiles(simd_kernels.render_tiles, len(tile_mask), arguments)
    return images, radii, owners, state


def backward(
    scene: Scene, state: State, settings: Settings, images: list[Tensor], v_images: list[Tensor], wants_pose: bool, wants_absolute: bool
) -> Gradients:
    """The gradients of the scene, from those of the images."""
    gradients = Gradients.empty(scene, wants_pose, wants_absolute)
    records = scene.means.new_empty(len(state.owners), kernels.RECORD_SIZE)
    arguments = [*_image_arguments(state, scene, settings, images), *v_images, int(wants_absolute), records]
    _launch_tiles(simd_kernels.render_tiles_backward, len(state.starts) - 1, arguments)
    arguments = [*scene.gaussian_arguments(), scene.sh, scene.viewmats, scene.Ks, settings.width, settings.height, settings.eps2d]
    arguments += [state.counts, 0, state.firsts, records, int(wants_pose), int(wants_absolute), *gradients]
    _launch(kernels.project_backward, len(scene.means), arguments)
    return gradients


def _intersect(splats, depth_keys, order, counts, tile_mask, gaussian_count, settings) -> State:
    """List the splats of every tile in depth order."""
    splat_count, tile_count = len(counts), len(tile_mask)
    _sort_pairs(depth_keys, order, splat_count, 31)
    ends = counts[order[:splat_count]].cumsum(0)
    count = int(ends[-1]) if splat_count else 0

    firsts, tiles, slots = torch.empty_like(counts), *counts.new_empty(2, 2 * count)
    owners, starts = counts.new_empty(count), counts.new_empty(tile_count + 1)
    arguments = [order, ends, counts, gaussian_count, splats, tile_mask, settings.tiles_x, settings.tiles_y, count, 0]
    _launch(kernels.emit_intersections, splat_count if count else 0, [*arguments, tiles, slots, firsts, owners])
    if count:
        _sort_pairs(tiles, slots, count, (tile_count + 1).bit_length())
    _launch(simd_kernels.find_tile_starts, count + 1, [tiles, count, starts])
    return State(splats, counts, firsts, owners, slots, starts)


def _sort_pairs(keys: Tensor, values: Tensor, count: int, bits: int) -> None:
    """Stable sort of the first count keys, from 0 to 2^bits − 1, and their values; both have room for 2·count."""
    wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, 0, bits)


def _image_arguments(state: State, scene: Scene, settings: Settings, images: list[Tensor]) -> list:
    """With these both kernels that composite begin."""
    lists = [state.splats, state.owners, state.slots, state.starts]
    return [*lists, scene.background, settings.width, settings.height, *images]


def _launch(kernel, count: int, arguments: list) -> None:
    """Launch a kernel whose first argument is an offset over count items, in shares."""
    if count == 0:
        return
    arguments = kernel_arguments(kernel, arguments, 1)

    def share(first, size):
        wp.launch(kernel, dim=size, inputs=[first, *arguments], device="cpu")

    run_in_threads([functools.partial(share, *pair) for pair in shares(count, 1024)])


def _launch_tiles(kernel, tile_count: int, arguments: list) -> None:
    """Launch a kernel that draws tiles from a counter, its first argument, in all threads."""
    inputs = kernel_arguments(kernel, [torch.zeros(1, dtype=torch.int32, device="cpu"), *arguments])
    command = wp.launch(kernel, dim=tile_count, inputs=inputs, device="cpu", record_cmd=True)
    run_in_threads([command.launch] * min(cpu_threads(), tile_count))
