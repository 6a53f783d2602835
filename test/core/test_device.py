"""Threads of torch and of our own, garbage collection, and where kernels are kept."""

import functools
import gc
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
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


@pytest.mark.thorough
def test_where_no_cache_can_be_written_kernels_are_kept_elsewhere_and_that_is_told(tmp_path):
    """As where the home is that of another user; whoever is root may write everywhere, so that a file is in the place of a folder here."""
    (tmp_path / "home").touch()
    program = (
        "import atexit, os, pathlib; atexit.register(lambda: print(pathlib.Path(os.environ['WARP_CACHE_PATH']).exists()))\n"
        "from endo_sim_ros.core.device import init_warp; init_warp(); init_warp()\n"
        "import warp; print(pathlib.Path(warp.config.kernel_cache_dir).is_relative_to(os.environ['WARP_CACHE_PATH']))"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("XDG_CACHE_HOME", "WARP_CACHE_PATH")}
    environment |= {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"], "there, and removed in the end"
    told = f"{tmp_path}/home/.cache/warp: no files can be written there; kernels are compiled anew each time until XDG_CACHE_HOME is a "
    assert done.stderr.count("no files") == 1 and told in done.stderr


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


@pytest.mark.slow
@pytest.mark.parametrize(("start", "given", "threads"), [("-m", None, "1"), ("-m", "3", "3"), ("-c", None, "None")])
def test_numpy_has_one_thread_in_our_own_programs_unless_told_otherwise(tmp_path, start, given, threads):
    """What calls the library keeps its own."""
    code = "import os, endo_sim_ros; print(os.environ.get('OPENBLAS_NUM_THREADS'))"
    (tmp_path / "program").mkdir()
    (tmp_path / "program/__init__.py").write_text(code)  # which Python imports before it runs the module, as it does with us
    (tmp_path / "program/__main__.py").touch()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])}
    environment.pop("OPENBLAS_NUM_THREADS", None)
    if given:
        environment["OPENBLAS_NUM_THREADS"] = given
    command = [sys.executable, start, code if start == "-c" else "program"]
    assert subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip() == threads
