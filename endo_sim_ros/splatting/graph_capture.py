"""Work on a GPU that draws pictures, recorded once and then replayed: hundreds of launches take the host the time of one."""

import contextlib
import functools
import gc
from collections.abc import Callable, Iterator

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import warp_stream
from endo_sim_ros.splatting import cuda


class Recording:
    """A function whose work on a GPU is recorded at its second call.

    It is recorded anew when its pictures turn out to need more room, or much less.

    Args:
        function: Takes tensors or None, and launches the same work at every call, without waiting for the GPU. Other tensors
            that it reads or writes must stay where they are: `forget` tells when they moved.
    """

    def __init__(self, function: Callable[..., Tensor]):
        self._function, self._pool = function, torch.cuda.graph_pool_handle()
        self._inputs: list[Tensor | None] | None = None
        self._graph: torch.cuda.CUDAGraph | None = None  # kept until there is another: its memory serves that, too
        self._valid = False

    def forget(self) -> None:
        """Record anew at the next call."""
        self._valid = False

    def __call__(self, *inputs: Tensor | None) -> Tensor:
        """What the function returns, of inputs as large as at the first call and on a GPU; the next call overwrites it."""
        if self._inputs is None:  # whatever is loaded or made at first use must not be recorded
            self._inputs = [None if x is None else x.clone() for x in inputs]
            return self._first()
        for mine, given in zip(self._inputs, inputs):
            if mine is not None:
                mine.copy_(given)
        if not (self._valid and all(room.fits() for room in self._rooms)):
            self._record()
        self._graph.replay()
        return self._result

    def _first(self) -> Tensor:
        device = next(x.device for x in self._inputs if x is not None)
        self._stream, current = _side_stream(device), torch.cuda.current_stream(device)
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            result = self._function(*self._inputs)
        current.wait_stream(self._stream)
        return result

    def _record(self) -> None:
        graph = torch.cuda.CUDAGraph()
        # Other threads may go on using the GPU. Warp has to know, for the memory that it takes.
        recording = torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local")
        with (
            _no_garbage_collection(),
            cuda.noting_rooms() as rooms,
            recording,
            wp.ScopedCapture(stream=warp_stream(self._stream), external=True),
        ):
            result = self._function(*self._inputs)
        self._graph, self._result, self._rooms, self._valid = graph, result, rooms, True


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """What the collector finds may be tensors and recordings, and to free their memory on the GPU would end a recording."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@functools.cache
def _side_stream(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)
