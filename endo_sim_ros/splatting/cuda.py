"""Runs the kernels made for GPUs. Nothing here waits for the GPU, and little is done in Python while it waits for us."""

import collections
import contextlib
import contextvars
import functools
import math
import threading
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import on_torch_stream
from endo_sim_ros.splatting import common_kernels as kernels
from endo_sim_ros.splatting import cuda_kernels as tiled_kernels
from endo_sim_ros.splatting.backend import Gradients, Scene, Settings, empty_images, kernel_arguments

MODULES = (kernels, tiled_kernels)
_FIRST_GUESS = 4.0  # intersections of a splat, on average
_MOST = 64.0  # of them that lists have room for
_ALWAYS = 2**24  # that lists have room for however few splats there are; pictures that need more are drawn without lists
_SPARE = 1.25  # room, relative to what is expected
_FORGETTING = 0.98  # of what was needed once, at every picture
_COMMANDS = 512  # recorded launches kept


class State(NamedTuple):
    """What the backward pass needs of the forward pass."""

    splats: Tensor  # [C·N, 16]
    counts: Tensor  # [C·N] tiles of each splat
    splat_list: Tensor  # splats by tile, then depth
    ranges: Tensor  # [tiles, 2] first and end of each tile in it


def forward(scene: Scene, tile_mask: Tensor, settings: Settings) -> tuple[list[Tensor], Tensor, Tensor, State]:
    """Images, radii, owners of median depths, and what `backward` needs."""
    device, splat_count, tile_count = scene.means.device, scene.splat_count, len(tile_mask)
    integers = functools.partial(torch.empty, dtype=torch.int32, device=device)
    images, owners = empty_images(scene, settings)
    radii = integers((len(scene.viewmats), scene.gaussian_count))
    splats, counts, ranges = scene.means.new_empty(splat_count, kernels.SPLAT_SIZE), integers(splat_count), integers((tile_count, 2))
    with _lock, on_torch_stream(device):  # the scratch memory serves one picture after the other, and Warp has one stream
        if splat_count:
            scratch = _scratch(device, _stream(device))
            if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
                scratch = scratch.anew()
            scratch.reserve_splats(splat_count)
            arguments = [*scene.gaussian_arguments(), *_cameras(scene, settings), settings.near, settings.eps2d, scene.apart, tile_mask]
            outputs = [splats, radii, scratch.depth_keys, scratch.order, counts]
            _launch(kernels.project, splat_count, [0, *arguments, *outputs])
            scratch.sort_by_depth()
            _launch(tiled_kernels.gather_counts, splat_count, [scratch.order, counts, scratch.sorted_counts])
            scratch.sum_counts()
            room = scratch.reserve_lists(tile_count)
            splat_list = integers(room)
            _launch(tiled_kernels.clear_lists, room, [tile_count, ranges, scratch.tiles])
            arguments = [scratch.order, scratch.ends, counts, scene.gaussian_count, splats, tile_mask, settings.tiles_x, settings.tiles_y]
            _launch(kernels.emit_intersections, splat_count, [0, *arguments, room, 1, scratch.tiles, scratch.values, None, None])
            scratch.sort_by_tile(tile_count)
            arguments = [scratch.tiles, scratch.values, scratch.order, scratch.ends, tile_mask]
            _launch(tiled_kernels.find_ranges, room, [*arguments, splat_list, ranges, scratch.seen])
        else:
            splat_list = integers(0)
            ranges.zero_()
        state = State(splats, counts, splat_list, ranges)
        arguments = [*_image_arguments(state, scene, settings, images), int(settings.median), owners]
        _launch(tiled_kernels.render_pixels, tile_count * tiled_kernels.BLOCK, arguments)
    return images, radii, owners, state


def backward(
    scene: Scene, state: State, settings: Settings, images: list[Tensor], v_images: list[Tensor], wants_pose: bool, wants_absolute: bool
) -> Gradients:
    """The gradients of the scene, from those of the images."""
    gradients = Gradients.empty(scene, wants_pose, wants_absolute)
    records = scene.means.new_zeros(scene.splat_count, kernels.RECORD_SIZE)
    with _lock, on_torch_stream(scene.means.device):
        arguments = [*_image_arguments(state, scene, settings, images), *v_images, int(wants_absolute), records]
        _launch(tiled_kernels.render_pixels_backward, len(state.ranges) * tiled_kernels.BLOCK, arguments)
        arguments = [0, *scene.gaussian_arguments(), *_cameras(scene, settings)[1:], settings.eps2d, state.counts, 1, None, records]
        _launch(kernels.project_backward, len(scene.means), [*arguments, int(wants_pose), int(wants_absolute), *gradients])
    return gradients


def _cameras(scene: Scene, settings: Settings) -> list:
    return [scene.opacities, scene.sh, scene.viewmats, scene.Ks, settings.width, settings.height]


def _image_arguments(state: State, scene: Scene, settings: Settings, images: list[Tensor]) -> list:
    """With these both kernels that composite begin."""
    lists = [state.splats, state.counts, scene.gaussian_count, state.splat_list, state.ranges]
    return [*lists, scene.background, settings.width, settings.height, *images]


# ---------------------------------------------------------------- memory


class _Expectation:
    """How many intersections a splat has on average, in pictures of one size.

    The host learns it later and without asking: the GPU writes it into the host's memory. A picture that needs more room
    than it got comes out right all the same (see the kernels), only slower, and the next one finds room. On a CPU there is
    nothing to wait for, and it is known at once.
    """

    def __init__(self, device: torch.device):
        self.seen = torch.zeros(2, dtype=torch.int64, pin_memory=device.type == "cuda")  # intersections and splats
        self.numbers = self.seen.numpy()
        self._mean = _FIRST_GUESS

    def room(self, splat_count: int) -> int:
        """Of how many intersections the next picture should have room, in steps of √2."""
        intersections, splats = self.numbers.tolist()
        if splats:
            self._mean = max(_FORGETTING * self._mean, intersections / splats)
        wanted = min(_SPARE * self._mean * splat_count, max(_MOST * splat_count, _ALWAYS))
        return math.ceil(2 ** (math.ceil(2 * math.log2(wanted)) / 2))


class Room(NamedTuple):
    """What recorded work has for the lists of a picture."""

    expectation: _Expectation
    splat_count: int
    tile_count: int
    size: int

    @classmethod
    def for_picture(cls, expectation: _Expectation, splat_count: int, tile_count: int) -> "Room":
        """Room as it should be now."""
        return cls(expectation, splat_count, tile_count, max(expectation.room(splat_count), splat_count, tile_count))

    def fits(self) -> bool:
        """Whether it is neither too small nor much too large by now."""
        wanted = Room.for_picture(*self[:3]).size
        return wanted <= self.size <= 2 * wanted


_noted: contextvars.ContextVar[list[Room] | None] = contextvars.ContextVar("noted", default=None)


@contextlib.contextmanager
def noting_rooms():
    """Within it, work is recorded: the list that it gives is of the room that the recorded pictures have."""
    rooms: list[Room] = []
    token = _noted.set(rooms)
    try:
        yield rooms
    finally:
        _noted.reset(token)


class _Scratch:
    """What is written and read within one picture, in one stream of a device."""

    def __init__(self, device: torch.device, expectations: dict[int, _Expectation] | None = None):
        self._device = device
        self._splat_count, self._room, self.room = 0, 0, 0
        self._expectations = collections.defaultdict(functools.partial(_Expectation, device)) if expectations is None else expectations

    def anew(self) -> "_Scratch":
        """Memory of its own for a picture that is recorded, which shall be there whenever it is replayed."""
        return _Scratch(self._device, self._expectations)

    def reserve_splats(self, splat_count: int) -> None:
        """Make the memory for what each splat has."""
        if splat_count != self._splat_count:
            self._splat_count = 0  # if there is no memory, the next picture must not find it either
            self.depth_keys, self.order = self._integers(2 * splat_count), self._integers(2 * splat_count)
            self.sorted_counts, self.ends = (self._integers(splat_count, torch.int64) for _ in range(2))
            self._by_depth = wp.from_torch(self.depth_keys), wp.from_torch(self.order)
            self._sums = wp.from_torch(self.sorted_counts), wp.from_torch(self.ends)
            self._splat_count = splat_count

    def reserve_lists(self, tile_count: int) -> int:
        """Make the memory for lists of intersections, which are counted by now, and return the room for them."""
        expectation = self._expectations[tile_count]
        self.seen = expectation.seen
        if self._device.type == "cpu":  # no need to wait
            expectation.numbers[:] = int(self.ends[-1]), self._splat_count
        room = Room.for_picture(expectation, self._splat_count, tile_count)
        self.room = room.size
        if (noted := _noted.get()) is not None:
            noted.append(room)
        if self.room > self._room:
            self._room = 0
            self.tiles, self.values = self._integers(2 * self.room), self._integers(2 * self.room)
            self._by_tile = wp.from_torch(self.tiles), wp.from_torch(self.values)
            self._room = self.room
        return self.room

    def sort_by_depth(self) -> None:
        wp.utils.radix_sort_pairs(*self._by_depth, self._splat_count, 0, 31)

    def sum_counts(self) -> None:
        wp.utils.array_scan(*self._sums)

    def sort_by_tile(self, tile_count: int) -> None:
        wp.utils.radix_sort_pairs(*self._by_tile, self.room, 0, tile_count.bit_length())

    def _integers(self, count: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return torch.empty(count, dtype=dtype, device=self._device)


@functools.cache
def _scratch(device: torch.device, stream: int) -> _Scratch:
    return _Scratch(device)


def _stream(device: torch.device) -> int:
    return torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0


# ---------------------------------------------------------------- launches

_lock = threading.Lock()


def _launch(kernel, count: int, arguments: list) -> None:
    """Launch a kernel in some threads.

    Packing the arguments takes longer than many a kernel runs. So launches are recorded, and a launch of the same kind as an
    earlier one only tells where its tensors lie.
    """
    if not count:
        return
    tensors = [x for x in arguments if isinstance(x, Tensor)]
    kind = (kernel, count, tensors[0].device, *[x.shape if isinstance(x, Tensor) else x for x in arguments])
    command, places = _commands.get(kind, (None, None))
    if command is None:
        device = str(tensors[0].device)
        command = wp.launch(kernel, dim=count, inputs=kernel_arguments(kernel, arguments), device=device, record_cmd=True)
        places = [command.params[1 + i] for i, x in enumerate(arguments) if isinstance(x, Tensor)]
        for place in places:
            place._ref = None  # Warp's hold on the tensor, whose memory would never be free again
        while len(_commands) >= _COMMANDS:
            del _commands[next(iter(_commands))]
        _commands[kind] = command, places
    for place, tensor in zip(places, tensors):
        place.data = tensor.data_ptr()
    command.launch()


_commands: dict[tuple, tuple[wp.Launch, list]] = {}
