"""CUDA graphs of work that draws pictures, captured once and replayed: hundreds of launches then take the host the time of one."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.device import no_garbage_collection, warp_stream
from endo_sim_ros.splatting import cuda

Result = TypeVar("Result", Tensor, list[Tensor])


class GraphCapture(Generic[Result]):
    """A function whose work on a GPU is captured as a graph at its second call and replayed from then on.

    The graph is captured anew when its pictures need longer lists than they have, or much shorter ones.

    Args:
        function: Takes tensors or None, and launches the same work at every call, without waiting for the GPU. Other tensors
            that it reads or writes must stay where they are: call `invalidate` when they have moved.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        self._function, self._pool = function, torch.cuda.graph_pool_handle()
        self._inputs: list[Tensor | None] | None = None
        # Kept until there is another graph: its memory serves that, too.
        self._captured: tuple[torch.cuda.CUDAGraph, Result, list[cuda.Capacity]] | None = None
        self._valid = False

    def invalidate(self) -> None:
        """Capture anew at the next call."""
        self._valid = False

    def prepare(self) -> None:
        """Capture now what was done once, so that the next call need not."""
        if self._inputs is not None and not (self._valid and self._captured):
            self._captured, self._valid = self._capture(self._inputs), True

    def __call__(self, *inputs: Tensor | None) -> Result:
        """Return what the function returns; the next call overwrites it.

        Args:
            inputs: As large as at the first call, and on the same GPU.
        """
        if self._inputs is None:  # whatever is loaded or made at first use must not be captured
            self._inputs = [None if x is None else x.clone() for x in inputs]
            return self._first(self._inputs)
        for mine, given in zip(self._inputs, inputs):
            if mine is not None and given is not None:
                mine.copy_(given)
        if not (self._valid and self._captured and all(capacity.fits() for capacity in self._captured[2])):
            self._captured, self._valid = self._capture(self._inputs), True
        graph, result, _ = self._captured
        graph.replay()
        return result

    def _first(self, inputs: list[Tensor | None]) -> Result:
        stream = _side_stream(_device_of(inputs))
        current = torch.cuda.current_stream(stream.device)
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            result = self._function(*inputs)
        current.wait_stream(stream)
        return result

    def _capture(self, inputs: list[Tensor | None]) -> tuple[torch.cuda.CUDAGraph, Result, list[cuda.Capacity]]:
        """Return a graph of the function's work, what it returns, and the capacity that its pictures have."""
        stream = _side_stream(_device_of(inputs))
        graph = torch.cuda.CUDAGraph()
        # Other threads may go on using the GPU. Warp has to know of the capture, for the memory that it takes.
        capture = torch.cuda.graph(graph, self._pool, stream, capture_error_mode="thread_local")
        with (
            no_garbage_collection(),
            cuda.noted_capacities() as capacities,
            capture,
            wp.ScopedCapture(stream=warp_stream(stream), external=True),
        ):
            result = self._function(*inputs)
        return graph, result, capacities


def _device_of(inputs: list[Tensor | None]) -> torch.device:
    return next(x.device for x in inputs if x is not None)


_streams = threading.local()


def _side_stream(device: torch.device) -> torch.cuda.Stream:
    """A stream of this thread: what another one launches is not to be captured."""
    if not hasattr(_streams, "by_device"):
        _streams.by_device = {}
    if device not in _streams.by_device:
        _streams.by_device[device] = torch.cuda.Stream(device)
    return _streams.by_device[device]
