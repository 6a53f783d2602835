"""What all rooms with kernels share: where kernels run, and how they are loaded and launched.

Beside its kernels a room has a `typing.Protocol` of what a backend does, and a function ``backend_for(device)`` that returns the
backend of a device. What Warp does not promise to keep (`kernel.adj`, `dtype._shape_`, `Launch.fwd_args`, `array_t._ref`) was seen with
version 1.19.
"""

import contextlib
import contextvars
import functools
import threading
import types
import weakref
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import current_warp_stream, gpu_index, init_warp, run_in_threads, shares

_plain = contextvars.ContextVar("plain", default=False)
_loading = threading.Lock()


@contextlib.contextmanager
def compare_plain() -> Iterator[None]:
    """Within it every ``backend_for`` gives a CPU the backend of GPUs, whose kernels run there without vectors, to compare with.

    It holds for the thread that entered it.
    """
    token = _plain.set(True)
    try:
        yield
    finally:
        _plain.reset(token)


def vectorised(device: torch.device | str) -> bool:
    """Return whether a device has the backend made for CPUs: every CPU has, except within `compare_plain`."""
    return torch.device(device).type == "cpu" and not _plain.get()


@functools.cache
def load_kernels(modules: tuple[types.ModuleType, ...], device: str) -> None:
    """Compile and load modules of kernels for a device, once, before several threads ask for them.

    Args:
        modules: Python modules that define kernels.
        device: Name of the device, e.g. ``cpu`` or ``cuda:0``.
    """
    init_warp()
    with _loading:  # two threads may ask for the same ones at first
        for module in modules:
            wp.load_module(module, device)


def kernel_arguments(kernel: Any, arguments: Sequence) -> list:
    """Return arguments of a kernel with tensors as arrays of the kernel's types, which share the tensors' memory.

    Args:
        kernel: A Warp kernel.
        arguments: Its arguments: contiguous tensors, numbers, or None for an array that the kernel does not read. Where a tensor has
            more dimensions than the kernel's array, the first ones become one.

    Raises:
        ValueError: If there are more or fewer arguments than the kernel takes.
    """
    init_warp()  # as arrays need it, whether or not kernels have been loaded
    kinds = [argument.type for argument in kernel.adj.args]
    return [_array(kind, x) if isinstance(x, Tensor) else x for kind, x in zip(kinds, arguments, strict=True)]


def _array(kind: Any, tensor: Tensor) -> Any:
    tensor = tensor.detach()
    dims = kind.ndim + len(getattr(kind.dtype, "_shape_", ()))
    if tensor.ndim > dims:
        tensor = tensor.view(-1, *tensor.shape[tensor.ndim - dims + 1 :])
    return wp.from_torch(tensor, dtype=kind.dtype, requires_grad=False, return_ctype=True)


def launch(kernel: Any, count: int | tuple[int, ...], arguments: Sequence, device: torch.device | str) -> None:
    """Launch a kernel over count items on a device, in order with torch's own work there.

    Packing the arguments takes longer than many kernels run. So launches are recorded, and a launch of the same kind as an
    earlier one of this thread only gets the addresses of its tensors.

    Args:
        kernel: A Warp kernel.
        count: Number of its threads, or numbers along each axis.
        arguments: As for `kernel_arguments`; what is no tensor must be hashable. A struct is known by its identity: one that
            is kept spares its packing.
        device: That of all tensors.
    """
    if not (count if isinstance(count, int) else all(count)):
        return
    kind, tensors = [kernel, count, device], []
    for argument in arguments:  # in line, as it runs some hundred times for a picture
        if isinstance(argument, Tensor):
            tensors.append(argument)
            kind += argument.shape, argument.dtype, argument.stride()
        elif argument is None or isinstance(argument, _VALUES):
            kind.append(argument)
        else:  # a struct, which is not kept alive by it, nor are its arrays
            kind.append(weakref.ref(argument))
    found = _recorded.launches.get(key := tuple(kind))
    if found is None:
        while len(_recorded.launches) >= _COMMANDS:
            del _recorded.launches[next(iter(_recorded.launches))]
        found = _recorded.launches[key] = _record(kernel, count, arguments, device)
    command, places, index = found
    for place, tensor in zip(places, tensors, strict=True):
        place.data = tensor.data_ptr()
    command.launch(None if index is None else current_warp_stream(index))


class _Recorded(threading.local):
    """Launches of one thread, with their array arguments: two threads never fill in the addresses of one launch."""

    def __init__(self) -> None:
        self.launches: dict[tuple, tuple[Any, list, int | None]] = {}


_recorded = _Recorded()
_VALUES = (int, float, tuple, np.generic)  # arguments that are known by what they are, not by which they are
_COMMANDS = 512  # recorded launches that a thread keeps


def _record(kernel: Any, count: int | tuple[int, ...], arguments: Sequence, device: torch.device | str) -> tuple[Any, list, int | None]:
    """Return a launch, not made yet, its array arguments, whose addresses are to be filled in, and the number of its GPU."""
    command: Any = wp.launch(kernel, count, kernel_arguments(kernel, arguments), device=str(device), record_cmd=True)
    places = [command.params[1 + i] for i, x in enumerate(arguments) if isinstance(x, Tensor)]
    command.fwd_args = None  # Warp's hold on structs and tensors, whose memory would never be free again
    for place in places:
        place._ref = None
    return command, places, gpu_index(device)


def launch_in_shares(kernel: Any, count: int, arguments: Sequence, least: int = 1024) -> None:
    """Launch a kernel over count items on the CPU, in as many threads as there are cores.

    Args:
        kernel: A Warp kernel. Its first argument is the number of the first item of a share; a thread adds `wp.tid()`.
        count: Number of items.
        arguments: The other arguments, as for `launch`.
        least: Fewer items are left to one thread.
    """
    if count:
        run_in_threads([functools.partial(launch, kernel, size, [first, *arguments], "cpu") for first, size in shares(count, least)])
