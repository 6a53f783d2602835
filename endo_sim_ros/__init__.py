"""From an endoscope recording to tissue that a robot can touch: 3D Gaussian Splatting and MPM as ROS 2 nodes."""

__version__ = "0.1.0"
