"""Kernels of the tissue, one backend for each kind of device."""

from endo_sim_ros.core.device import init_warp
from endo_sim_ros.core.kernels import vectorised
from endo_sim_ros.physics.backends.base import Backend
from endo_sim_ros.physics.backends.cpu import CpuBackend
from endo_sim_ros.physics.backends.cuda import CudaBackend


def backend_for(device: str) -> Backend:
    """Return the backend of a device, as `pick_device` names it."""
    init_warp()
    return CpuBackend() if vectorised(device) else CudaBackend(device)
