"""Fixtures of the tests of splatting."""

import contextlib

import pytest
import torch

from endo_sim_ros.splatting import api


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread():
    """The reference works on small tensors, for which threads that wait for each other on busy cores only cost time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=["vectors", "pixels"])
def compositor(request):
    """Both ways to composite; the kernels made for GPUs run on the CPU too."""
    with api.scalar_kernels() if request.param == "pixels" else contextlib.nullcontext():
        yield
