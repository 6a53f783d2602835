"""Whether kernels that draw splats on a CPU compute with subnormal numbers, for which it takes a hundred times as long."""

import ctypes
import platform
from collections.abc import Callable

import pytest

from endo_sim_ros.splatting import cpu

_UNDERFLOW = 0x10  # FE_UNDERFLOW in the fenv.h of x86

tells_underflow = pytest.mark.skipif(
    platform.machine() != "x86_64" or platform.system() != "Linux", reason="reads the floating-point flags of x86 through glibc"
)


def kernels_with_subnormals(action: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of the kernels that do so while an action draws splats. This thread runs them all, as flags are those of a thread."""
    libm, found, launch = ctypes.CDLL("libm.so.6"), set(), cpu.launch

    def flagged(kernel, *arguments) -> None:
        libm.feclearexcept(_UNDERFLOW)  # NumPy clears flags, too
        launch(kernel, *arguments)
        if libm.fetestexcept(_UNDERFLOW):
            found.add(kernel.key)

    monkeypatch.setenv("ENDO_SIM_THREADS", "1")
    monkeypatch.setattr(cpu, "launch", flagged)
    action()
    return found
