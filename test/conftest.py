"""Every test process has a graph of its own, on this machine only, and quiet kernels."""

import os

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

import torch  # noqa: E402

torch.set_num_threads(1)
