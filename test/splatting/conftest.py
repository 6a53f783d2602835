"""Fixtures of the tests of splatting."""

import contextlib

import pytest
import torch

from endo_sim_ros.core.kernels import compare_plain


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread():
    """The reference works on small tensors, for which threads that wait for each other on busy cores only cost time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=["vectors", "pixels"])
def compositor(request):
    """The backend of CPUs, and that of GPUs, which runs on the CPU too."""
    with compare_plain() if request.param == "pixels" else contextlib.nullcontext():
        yield
