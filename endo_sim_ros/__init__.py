"""From an endoscope recording to tissue that a robot can touch: 3D Gaussian Splatting and MPM as ROS 2 nodes."""

import os
import signal
import sys

# Read by OpenCV when it is imported: a few kilobytes of PNG may claim, and would get, gigabytes.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))

# Whether one of our own programs starts (`-m` is what Python calls a module that it is about to run), or the server that its processes
# are forked from.
_starts = os.path.basename(sys.argv[0]) in ("-m", "endo-sim") or "multiprocessing.forkserver" in "".join(sys.orig_argv[-1:])
if _starts:
    # Read by numpy when it is imported. Our matrices are many and small: beside a busy core, threads that wait for each other by spinning
    # take a search for breath three times as long, and alone they save a seventh of it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # while it starts, Ctrl-C just ends it


def hear_interrupts() -> None:
    """Called by a program that is ready to be interrupted: from now on Ctrl-C raises KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


__version__ = "0.1.0"
