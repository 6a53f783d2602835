"""The backend of GPUs: a thread for each pixel. The host never waits for the GPU, and does little in Python that the GPU would wait for."""

import collections
import contextlib
import contextvars
import functools
import math
import threading
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import on_torch_stream
from endo_sim_ros.core.kernels import launch
from endo_sim_ros.splatting import common_kernels as kernels, cuda_kernels
from endo_sim_ros.splatting.constants import RECORD_SIZE, SPLAT_SIZE
from endo_sim_ros.splatting.scene import Gradients, Scene, Settings, empty_images

modules = (kernels, cuda_kernels)
_FIRST_GUESS = 4.0  # intersections of a splat, on average, before any picture has told
_MOST = 64.0  # intersections of a splat, on average, that lists have room for
_ALWAYS = 2**24  # intersections that lists have room for, however few splats there are; with more a picture is drawn without lists
_SPARE = 1.25  # capacity of lists, relative to the expected number of intersections
_FORGETTING = 0.98  # factor on the largest number of intersections so far, at every picture
_lock = threading.Lock()  # the scratch memory of a stream serves one picture after the other


class State(NamedTuple):
    """What the backward pass needs of the forward pass."""

    splats: Tensor  # [C·N, 16]
    counts: Tensor  # [C·N] tiles of each splat
    splat_list: Tensor  # splats by tile, then depth
    ranges: Tensor  # [tiles, 2] first and end of each tile in it


def forward(scene: Scene, tile_mask: Tensor | None, settings: Settings) -> tuple[list[Tensor], Tensor, Tensor, State]:
    """Draw a scene, as `RasterBackend` says."""
    device, splat_count, tile_count = scene.means.device, scene.splat_count, settings.tile_count(scene)
    integers = functools.partial(torch.empty, dtype=torch.int32, device=device)
    images, owners = empty_images(scene, settings)
    radii = integers((len(scene.viewmats), scene.gaussian_count))
    splats, counts, ranges = scene.means.new_empty(splat_count, SPLAT_SIZE), integers(splat_count), integers((tile_count, 2))
    with _lock, on_torch_stream(device):  # Warp has one stream
        if splat_count:
            scratch = scratch_for(device, stream_of(device))
            if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
                scratch = scratch.anew()
            scratch.reserve_splats(splat_count)
            tiles = [settings.tiles_x, settings.tiles_y, tile_mask]
            arguments = [*scene.gaussian_arguments(), *_cameras(scene, settings), settings.near, settings.eps2d, scene.per_camera, *tiles]
            outputs = [splats, radii, scratch.depth_keys, scratch.order, counts]
            launch(kernels.project, splat_count, [0, 1, *arguments, *outputs], device)
            wp.utils.radix_sort_pairs(*scratch.by_depth, splat_count, 0, 31)
            launch(cuda_kernels.gather_counts, splat_count, [scratch.order, counts, scratch.sorted_counts], device)
            wp.utils.array_scan(*scratch.sums)
            capacity = scratch.reserve_lists(tile_count)
            splat_list = integers(capacity)
            launch(cuda_kernels.clear_lists, capacity, [tile_count, ranges, scratch.tiles], device)
            arguments = [scratch.order, scratch.ends, counts, scene.gaussian_count, splats, *tiles, tile_count, capacity]
            launch(kernels.emit_intersections, splat_count, [0, 1, *arguments, scratch.tiles, scratch.values, None], device)
            wp.utils.radix_sort_pairs(*scratch.by_tile, capacity, 0, tile_count.bit_length())
            arguments = [scratch.tiles, scratch.values, scratch.order, scratch.ends, tile_mask]
            launch(cuda_kernels.find_ranges, capacity, [*arguments, splat_list, ranges, scratch.seen], device)
        else:
            splat_list = integers(0)
            ranges.zero_()
        state = State(splats, counts, splat_list, ranges)
        lenses, size = [scene.viewmats, scene.Ks, settings.glints], [settings.width, settings.height]
        arguments = [*_lists(state, scene), *lenses, *size, *images, int(settings.median), owners]
        launch(cuda_kernels.render_pixels, tile_count * cuda_kernels.BLOCK, arguments, device)
    return images, radii, owners, state


def backward(
    scene: Scene, state: State, settings: Settings, images: Sequence[Tensor], v_images: Sequence[Tensor], gradients: Gradients
) -> None:
    """Fill the gradients of a scene, as `RasterBackend` says."""
    device, records = scene.means.device, scene.means.new_zeros(scene.splat_count, RECORD_SIZE)
    wanted = gradients.wants_absolute(settings)
    with _lock, on_torch_stream(device):
        arguments = [*_lists(state, scene), settings.width, settings.height, *images, *v_images, wanted, records]
        launch(cuda_kernels.render_pixels_backward, len(state.ranges) * cuda_kernels.BLOCK, arguments, device)
        arguments = [0, *scene.gaussian_arguments(), *_cameras(scene, settings)[1:], settings.eps2d, state.counts, 1, None, records]
        launch(kernels.project_backward, len(scene.means), [*arguments, *gradients.arguments(settings)], device)


def _cameras(scene: Scene, settings: Settings) -> list:
    return [scene.opacities, scene.sh, scene.viewmats, scene.Ks, settings.width, settings.height]


def _lists(state: State, scene: Scene) -> list:
    """Return the first arguments of both kernels that composite."""
    return [state.splats, scene.extras, state.counts, scene.gaussian_count, state.splat_list, state.ranges, scene.background]


# ---------------------------------------------------------------- memory


class _Expectation:
    """How many intersections a splat has on average, in pictures of one size.

    The host does not ask for the number, which would stall it: the GPU writes it into the host's memory. A picture that
    needs longer lists than it got is drawn without them, slowly (see the kernels), and the next one gets longer lists. On a
    CPU there is nothing to wait for, and the number is known at once.
    """

    def __init__(self, device: torch.device) -> None:
        self.seen = torch.zeros(2, dtype=torch.int64, pin_memory=device.type == "cuda")  # intersections and splats
        self.numbers = self.seen.numpy()
        self._mean = _FIRST_GUESS

    def capacity(self, splat_count: int) -> int:
        """Return for how many intersections the next picture should have lists, in steps of √2."""
        intersections, splats = self.numbers.tolist()
        if splats:
            self._mean = max(_FORGETTING * self._mean, intersections / splats)
        wanted = min(_SPARE * self._mean * splat_count, max(_MOST * splat_count, _ALWAYS))
        return math.ceil(2 ** (math.ceil(2 * math.log2(wanted)) / 2))


class Capacity(NamedTuple):
    """How long the lists of a picture are, and for what."""

    expectation: _Expectation
    splat_count: int
    tile_count: int
    size: int

    @classmethod
    def for_picture(cls, expectation: _Expectation, splat_count: int, tile_count: int) -> "Capacity":
        """Return the capacity that a picture should have now."""
        return cls(expectation, splat_count, tile_count, max(expectation.capacity(splat_count), splat_count, tile_count))

    def fits(self) -> bool:
        """Return whether it is neither too small nor much too large by now."""
        wanted = Capacity.for_picture(*self[:3]).size
        return wanted <= self.size <= 2 * wanted


_noted: contextvars.ContextVar[list[Capacity] | None] = contextvars.ContextVar("noted", default=None)


@contextlib.contextmanager
def noted_capacities() -> Iterator[list[Capacity]]:
    """Within it, the list that it gives receives the capacity of each picture that is drawn, e.g. while a graph is captured."""
    capacities: list[Capacity] = []
    token = _noted.set(capacities)
    try:
        yield capacities
    finally:
        _noted.reset(token)


class _Scratch:
    """Memory that is written and read within one picture, in one stream of a device."""

    def __init__(self, device: torch.device, expectations: dict[int, _Expectation] | None = None) -> None:
        self._device = device
        self._splat_count, self._reserved, self.capacity = 0, 0, 0
        self._expectations = collections.defaultdict(functools.partial(_Expectation, device)) if expectations is None else expectations

    def anew(self) -> "_Scratch":
        """Return memory for a picture that is captured in a graph; it must be there whenever the graph is replayed."""
        return _Scratch(self._device, self._expectations)

    def reserve_splats(self, splat_count: int) -> None:
        """Make the memory for what each splat has."""
        if splat_count != self._splat_count:
            self._splat_count = 0  # if there is no memory, the next picture must not find it either
            self.depth_keys, self.order = self._integers(2 * splat_count), self._integers(2 * splat_count)
            self.sorted_counts, self.ends = (self._integers(splat_count, torch.int64) for _ in range(2))
            self.by_depth = wp.from_torch(self.depth_keys), wp.from_torch(self.order)
            self.sums = wp.from_torch(self.sorted_counts), wp.from_torch(self.ends)
            self._splat_count = splat_count

    def reserve_lists(self, tile_count: int) -> int:
        """Make the memory for lists of intersections, which are counted by now, and return their capacity."""
        expectation = self._expectations[tile_count]
        self.seen = expectation.seen
        if self._device.type == "cpu":  # no need to wait
            expectation.numbers[:] = int(self.ends[-1]), self._splat_count
        capacity = Capacity.for_picture(expectation, self._splat_count, tile_count)
        self.capacity = capacity.size
        if (noted := _noted.get()) is not None:
            noted.append(capacity)
        if self.capacity > self._reserved:
            self._reserved = 0
            self.tiles, self.values = self._integers(2 * self.capacity), self._integers(2 * self.capacity)
            self.by_tile = wp.from_torch(self.tiles), wp.from_torch(self.values)
            self._reserved = self.capacity
        return self.capacity

    def _integers(self, count: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return torch.empty(count, dtype=dtype, device=self._device)


@functools.cache
def scratch_for(device: torch.device, stream: int) -> _Scratch:
    """The memory that pictures on a stream share."""
    return _Scratch(device)


def stream_of(device: torch.device) -> int:
    """torch's current stream, 0 on a CPU."""
    return torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
