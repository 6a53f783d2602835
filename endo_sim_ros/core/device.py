"""Devices and threads: one name of a device for torch and Warp, Warp on torch's streams, and shares of work."""

import atexit
import contextlib
import ctypes
import functools
import gc
import logging
import math
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.folders import make_writable

if TYPE_CHECKING:
    import warp as wp


def pick_device(name: str = "auto") -> str:
    """Return the name of a device that both torch and Warp understand, e.g. ``cpu`` or ``cuda:0``.

    Args:
        name: ``auto`` (the GPU when there is one), ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        ValueError: If the name is unknown or names a GPU that is not there or, in a forked process, was in use before.
    """
    if name == "auto":
        name = "cuda:0" if torch.cuda.is_available() else "cpu"
    if name == "cpu":
        return name
    if name == "cuda" or name.startswith("cuda:") and name[5:].isdigit():
        index = int(name[5:] or 0) if name != "cuda" else 0
        if index >= torch.cuda.device_count():
            raise ValueError(f"device {name!r} asked for, but {torch.cuda.device_count()} CUDA devices are visible; use cpu or auto")
        if torch.cuda._is_in_bad_fork():
            raise ValueError("a process that was forked from one that uses the GPU cannot use it; start it by spawn, or use cpu")
        return f"cuda:{index}"
    raise ValueError(f"unknown device {name!r}; use auto, cpu, cuda or cuda:N")


@functools.cache
def init_warp() -> None:
    """Start Warp, once, without its banner and its remark that a machine has no GPU."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    _find_kernel_cache(wp.config.version)
    with contextlib.nullcontext() if torch.cuda.is_available() else _silent_stderr():
        wp.init()


def _find_kernel_cache(version: str) -> None:
    """Give Warp, and that of processes which this one starts, a temporary folder where its own takes no files, as in a home of others."""
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(os.environ.get("WARP_CACHE_PATH") or os.path.join(cache, "warp"))
    try:
        make_writable(folder / version)
    except ValueError:
        os.environ["WARP_CACHE_PATH"] = temporary = tempfile.mkdtemp(prefix="endo_sim_warp_")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        text = "%s: no files can be written there; kernels are compiled anew each time until XDG_CACHE_HOME is a folder that can be written"
        logging.getLogger(__name__).warning(text, folder)


@contextlib.contextmanager
def _silent_stderr():
    """Discard what native code writes to the error stream."""
    sys.stderr.flush()
    saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


def on_torch_stream(device: torch.device | str) -> contextlib.AbstractContextManager:
    """Return a context within which Warp works on torch's current stream of a CUDA device, in order with torch's own work."""
    index = gpu_index(device)
    if index is None:
        return contextlib.nullcontext()
    import warp as wp

    return wp.ScopedStream(current_warp_stream(index), sync_enter=False)


def gpu_index(device: torch.device | str) -> int | None:
    """Return the number of a GPU, None for a CPU."""
    device = torch.device(device)
    if device.type == "cpu":
        return None
    return torch.cuda.current_device() if device.index is None else device.index


def current_warp_stream(index: int) -> "wp.Stream":
    """Return Warp's object for torch's current stream of a GPU, by its number.

    Torch gives the bare handle, as every launch asks for it, and making a `torch.cuda.Stream` takes longer than all else here.
    """
    return _warp_stream(index, torch._C._cuda_getCurrentRawStream(index))


def warp_stream(stream: torch.cuda.Stream) -> "wp.Stream":
    """Return Warp's object for a stream of torch: one that is kept, because Warp forgets what it knows of a stream with the object."""
    return _warp_stream(stream.device.index, stream.cuda_stream)


@functools.cache
def _warp_stream(index: int, handle: int) -> "wp.Stream":
    import warp as wp

    return wp.Stream(wp.get_device(f"cuda:{index}"), cuda_stream=handle)


_launching = threading.Lock()


def one_at_a_time(device: torch.device | str) -> contextlib.AbstractContextManager:
    """Return a context in which no other thread works on a GPU, whichever it is; on a CPU, one that does nothing.

    Threads that launch kernels at once wait for each other many times as long as the kernels take.
    """
    return contextlib.nullcontext() if torch.device(device).type == "cpu" else _launching


def upload(device: torch.device | str, *arrays: np.ndarray) -> list[Tensor]:
    """Return numbers as float32 tensors on a device, copied all at once. The host does not wait for what a GPU does at the moment."""
    return split(upload_flat(device, *arrays), [array.shape for array in arrays])


def upload_flat(device: torch.device | str, *arrays: np.ndarray) -> Tensor:
    """Return the numbers of arrays one after another in one float32 tensor [N] on a device, as `upload` copies them.

    The copy starts from pinned memory, which torch does not use again before the copy is done.
    """
    on_host = torch.device(device).type == "cpu"
    flat = torch.empty(sum(array.size for array in arrays), dtype=torch.float32, pin_memory=not on_host)
    np.concatenate(arrays, None, flat.numpy(), casting="same_kind")
    return flat if on_host else flat.to(device, non_blocking=True)


def split(flat: Tensor, shapes: Sequence[tuple[int, ...]]) -> list[Tensor]:
    """Return the parts of what `upload_flat` returned that have these shapes, without a copy."""
    return [part.view(shape) for part, shape in zip(flat.split_with_sizes([math.prod(shape) for shape in shapes]), shapes)]


def download(*tensors: Tensor) -> list[np.ndarray]:
    """Return tensors of one device as arrays. The host waits once for a GPU, not once for each.

    The copies pass through pinned memory, which is soon there for others again, as pictures may be kept for long.
    """
    if tensors[0].device.type == "cpu":
        return [tensor.numpy() for tensor in tensors]
    pinned = [torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor, non_blocking=True) for tensor in tensors]
    torch.cuda.current_stream(tensors[0].device).synchronize()
    return [tensor.numpy().copy() for tensor in pinned]


def cpu_threads() -> int:
    """Return the number of threads for CPU kernels: the cores that this process may use, or ENDO_SIM_THREADS.

    Raises:
        ValueError: If ENDO_SIM_THREADS is no whole number.
    """
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get("ENDO_SIM_THREADS", "0")
    if not wanted.isdecimal():
        raise ValueError(f"ENDO_SIM_THREADS is {wanted!r}; it must be a number of threads, or 0 for as many as there are cores")
    return int(wanted) or available


def return_freed_memory() -> None:
    """Give back to the system the memory of arrays that are gone, which glibc keeps for new ones of the thread that made them."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # no such function, or no way to ask for one
        ctypes.CDLL(None).malloc_trim(0)


_holding = threading.Lock()
_holders, _collected_before = 0, True  # who holds garbage collection now, and whether it was on before the first of them


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Within it, in whatever thread, no garbage is collected: freeing arrays or graphs on a GPU would end a capture."""
    global _holders, _collected_before
    with _holding:
        if not _holders:
            _collected_before = gc.isenabled()
            gc.disable()
        _holders += 1
    try:
        yield
    finally:
        with _holding:
            _holders -= 1
            if not _holders and _collected_before:
                gc.enable()


_alone = threading.Lock()
_inside = threading.local()
_asking, _threads_before = 0, 1  # threads that work alone now, and how many torch had before the first of them


@contextlib.contextmanager
def single_threaded_torch() -> Iterator[None]:
    """Let torch work in the calling thread alone; also a decorator.

    On a CPU our kernels bring their own threads. Those of torch wait for each other in busy loops after each of many small operations:
    beside other work, training and pictures took four to fourteen times the CPU seconds with them.
    """
    global _asking, _threads_before
    if getattr(_inside, "yes", False):
        yield
        return
    threads = torch.get_num_threads()  # a thread that is not asked before takes later what others set
    with _alone:
        _threads_before = _threads_before if _asking else threads
        _asking += 1
    _inside.yes = True
    torch.set_num_threads(1)  # of this thread, and of those that begin now
    try:
        yield
    finally:
        _inside.yes = False
        with _alone:
            _asking -= 1
        torch.set_num_threads(_threads_before)


def shares(count: int, least: int) -> list[tuple[int, int]]:
    """Return the first item and the number of items, of count, that each CPU thread takes; fewer than ``least`` are left to one."""
    threads = cpu_threads() if count >= least else 1
    bounds = [count * i // threads for i in range(threads + 1)]
    return [(first, end - first) for first, end in zip(bounds, bounds[1:])]


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "endo_sim")


def _clean_up_after_fork() -> None:
    """A forked process has none of its parent's threads: neither ours nor torch's, for which it would wait for ever."""
    global _alone, _asking, _threads_before
    _pool.cache_clear()
    _alone, _asking, _threads_before = threading.Lock(), int(getattr(_inside, "yes", False)), 1
    torch.set_num_threads(1)


os.register_at_fork(after_in_child=_clean_up_after_fork)


def run_in_threads(jobs: Sequence[Callable[[], object]]) -> None:
    """Run callables at the same time, the last one in this thread; a kernel launch releases the interpreter lock.

    What no other thread has begun when this one is done, it does itself: where other programs keep the cores busy, a thread may take
    milliseconds to wake, a dozen times in a picture.
    """
    futures = [_pool(len(jobs) - 1).submit(job) for job in jobs[:-1]]
    jobs[-1]()
    for job, future in reversed(list(zip(jobs, futures))):  # others begin with the first
        if future.cancel():
            job()
        else:
            future.result()
