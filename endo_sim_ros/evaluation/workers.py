"""Jobs in processes of their own, so that one that crashes takes nothing else with it; over hosts with Ray."""

import importlib.util
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

import torch

from endo_sim_ros.core.device import cpu_threads

Job = Callable[[Any, str, Callable[[Any], None]], Any]  # (argument, device, report) → result


class Finished(NamedTuple):
    """The end of a job: its result, or why there is none."""

    index: int
    result: Any = None
    error: str | None = None


class News(NamedTuple):
    """What a running job reports."""

    index: int
    message: Any


def ray_is_installed() -> bool:
    """Whether Ray can be imported."""
    return importlib.util.find_spec("ray") is not None


def run_in_processes(job: Job, arguments: Sequence[Any], devices: Sequence[str]) -> Iterator[News | Finished]:
    """Run a job with each argument, as many at a time as there are devices, each in a process that stays for the next.

    Args:
        job: A function of a module, called as ``job(argument, device, report)``; what it passes to ``report`` becomes News.
        arguments: Picklable.
        devices: Where the processes compute; a device may be there several times.
    """
    waiting, workers = list(enumerate(arguments)), []
    try:
        workers = [_Worker(job, device, max(cpu_threads() // len(devices), 1)) for device in devices[: len(arguments)]]
        while waiting or any(worker.index is not None for worker in workers):
            for worker in workers:
                if worker.index is None and waiting:
                    worker.start(*waiting.pop(0))
            busy = {worker.connection: worker for worker in workers if worker.index is not None}
            ready = wait(list(busy))
            for connection, worker in busy.items():
                if connection in ready:
                    yield worker.receive()
    finally:
        for worker in workers:
            worker.stop()


class _Worker:
    """A process that does one job at a time, and is replaced when it dies."""

    def __init__(self, job: Job, device: str, threads: int):
        self._arguments = job, device, threads
        self.index: int | None = None  # of the job at hand
        self._process: BaseProcess | None = None

    def start(self, index: int, argument: Any) -> None:
        if self._process is None or not self._process.is_alive():
            context = multiprocessing.get_context("forkserver")  # CUDA does not survive a fork of this process
            context.set_forkserver_preload([__name__, self._arguments[0].__module__])  # so that each begins at once
            self.connection, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, *self._arguments), daemon=True)
            process.start()
            self._process = process  # not before: one that Ctrl-C keeps from beginning cannot be killed
            theirs.close()
        self.index = index
        self.connection.send((index, argument))

    def receive(self) -> News | Finished:
        index, process = self.index, self._process
        assert index is not None and process is not None  # only a worker that was started is heard
        try:
            told = self.connection.recv()
        except (EOFError, ConnectionResetError):
            process.join()
            reason, self._process, self.index = _reason(process.exitcode or 0), None, None
            return Finished(index, error=reason)
        if isinstance(told, Finished):
            self.index = None
        return told

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self.connection.close()


def _reason(exit_code: int) -> str:
    if exit_code < 0:
        name = signal.Signals(-exit_code).name
        return f"its process was ended by {name}" + (", as when memory runs out" if name == "SIGKILL" else "")
    return f"its process ended with exit code {exit_code}"


def _serve(connection: Connection, job: Job, device: str, threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    os.environ["ENDO_SIM_THREADS"] = str(threads)
    torch.set_num_threads(threads)
    if device != "cpu":
        torch.cuda.set_device(device)
    while True:
        try:
            index, argument = connection.recv()
        except EOFError:
            return
        connection.send(_attempt(index, job, argument, device, lambda message: connection.send(News(index, message))))


def _attempt(index: int, job: Job, argument: Any, device: str, report: Callable[[Any], None]) -> Finished:
    try:
        return Finished(index, job(argument, device, report))
    except Exception as error:  # whatever it is, the other jobs go on
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = next(iter(str(error).splitlines()), "") or type(error).__name__
        own = type(error).__module__.startswith("endo_sim_ros")  # one that was meant for the user says all in its text
        told = text if own else f"{type(error).__name__}: {text} ({os.path.basename(where.filename)}:{where.lineno})"
        return Finished(index, error=told)
    finally:
        if device != "cpu":
            torch.cuda.empty_cache()


def run_in_ray(job: Job, arguments: Sequence[Any], on_gpu: bool, at_once: int) -> Iterator[Finished]:
    """Run a job with each argument on the hosts of the Ray cluster that this process has joined.

    Args:
        job: As for `run_in_processes`; what it reports is not seen.
        arguments: Picklable, or tuples, in which Ray's object references are replaced by what they refer to.
        on_gpu: Whether a job needs a GPU.
        at_once: Jobs that share one GPU, or without GPUs one host.
    """
    import ray  # pyright: ignore[reportMissingImports]  (optional)

    share = {"num_gpus": 1 / at_once, "num_cpus": 1} if on_gpu else {"num_cpus": max((os.cpu_count() or 1) // at_once, 1)}
    threads = int(share["num_cpus"])

    @ray.remote(max_calls=1, max_retries=0, **share)  # a process each: a crash loses no other job
    def attempt(index: int, *argument: Any) -> Finished:
        os.environ["ENDO_SIM_THREADS"] = str(threads)
        torch.set_num_threads(threads)
        return _attempt(index, job, argument, "cuda:0" if on_gpu else "cpu", lambda message: None)

    running = {attempt.remote(index, *argument): index for index, argument in enumerate(arguments)}
    while running:
        (done,), _ = ray.wait(list(running), num_returns=1)
        index = running.pop(done)
        try:
            finished = ray.get(done)
        except Exception as error:  # its process died, or its host
            finished = Finished(index, error=next(iter(str(error).splitlines()), type(error).__name__))
        yield finished
