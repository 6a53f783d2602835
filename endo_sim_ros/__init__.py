"""From an endoscope recording to tissue that a robot can touch: 3D Gaussian Splatting and MPM as ROS 2 nodes."""

import os

# Read by OpenCV when it is imported: a few kilobytes of PNG may claim, and would get, gigabytes.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))

__version__ = "0.1.0"
