"""Threads of torch and of our own, and garbage collection."""

import functools
import gc
import threading

import torch

from endo_sim_ros.core import device
from endo_sim_ros.core.device import no_garbage_collection, run_in_threads, single_threaded_torch


def test_torch_gets_its_threads_back_when_the_last_one_is_done():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    entered, leave, seen = threading.Event(), threading.Event(), []

    def other():
        with single_threaded_torch():
            entered.set()
            leave.wait(120)
            seen.append(torch.get_num_threads())

    thread = threading.Thread(target=other)
    try:
        with single_threaded_torch():
            with single_threaded_torch():
                thread.start()
                entered.wait(120)
            seen.append(torch.get_num_threads())
        seen.append(torch.get_num_threads())  # the other one still works
        leave.set()
        thread.join()
        assert seen == [1, 3, 1] and torch.get_num_threads() == 3
        with single_threaded_torch():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_garbage_is_collected_again_when_the_last_one_is_done():
    assert gc.isenabled()
    first, second = no_garbage_collection(), no_garbage_collection()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert not gc.isenabled()
    second.__exit__(None, None, None)
    assert gc.isenabled()
    gc.disable()  # as a node starts
    try:
        with no_garbage_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_what_no_other_thread_has_begun_is_not_waited_for():
    release, ran = threading.Event(), []
    pool = device._pool(2)
    busy = [pool.submit(release.wait, 10) for _ in range(pool._max_workers)]  # as if other programs kept their cores busy
    try:
        run_in_threads([functools.partial(ran.append, job) for job in range(3)])
        assert ran == [2, 1, 0], "the thread that waits begins where others end"
    finally:
        release.set()
    assert all(future.result() for future in busy), "it waited until others had time"
