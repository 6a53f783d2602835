"""What concerns the process of a ROS node, whoever started it."""

import ctypes
import os
import signal
import threading
import time

PARENT = "ENDO_SIM_PARENT"  # environment variable: number of the process that the node must not outlive

_KEPT = 64 << 20  # bytes of freed memory that a process keeps
_WHOLE = 32 << 20  # bytes from which memory is returned as soon as it is freed; the most that glibc allows
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt, see malloc.h


def keep_memory() -> None:
    """Keep freed memory for what is allocated next, up to 64 MB, where the C library is glibc.

    By default it returns a megabyte that an image took to the system and asks for it anew for the next image, which then fetches each
    page of 4 kB when it is first written. An image is copied several times on its way, at 0.5 to 1 ms a copy instead of 0.05.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, _KEPT)
        mallopt(_MMAP_THRESHOLD, _WHOLE)


def end_with_parent() -> None:
    """End this process when the one named by the environment variable `PARENT` is gone, even if it was killed."""
    parent = int(os.environ.get(PARENT, "0"))

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGTERM)

    if parent:
        threading.Thread(target=watch, daemon=True).start()
