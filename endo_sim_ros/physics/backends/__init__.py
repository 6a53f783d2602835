"""Kernels of the tissue, one backend for each kind of device."""

from endo_sim_ros.core.device import init_warp
from endo_sim_ros.core.kernels import vectorised
from endo_sim_ros.physics.backends.base import Backend
from endo_sim_ros.physics.backends.cpu import CpuBackend
from endo_sim_ros.physics.backends.cuda import CudaBackend


def backend_for(device: str) -> Backend:
    """Return the backend of a device, as `pick_device` names it.

    A CPU steps with the vectorised kernels (`cpu_kernels`), and within `compare_plain` with the plain ones (`plain_kernels`).
    A GPU takes a step in one launch of `cluster_kernels` where it has clusters and one of them holds the tissue; otherwise, and
    with current kinematics, it launches the plain kernels for every substep.
    """
    init_warp()
    return CpuBackend() if vectorised(device) else CudaBackend(device)
