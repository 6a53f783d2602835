"""What concerns the process of a ROS node, whoever started it."""

import os
import signal
import threading
import time

PARENT = "ENDO_SIM_PARENT"  # environment variable: number of the process that the node must not outlive


def end_with_parent() -> None:
    """End this process when the one named by the environment variable `PARENT` is gone, even if it was killed."""
    parent = int(os.environ.get(PARENT, "0"))

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGTERM)

    if parent:
        threading.Thread(target=watch, daemon=True).start()
