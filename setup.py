"""Installs by `pip install .` and by `colcon build`; `ros2 run endo_sim_ros <node>` works after both."""

import os
import re
from pathlib import Path

from setuptools import find_packages, setup

NAME = "endo_sim_ros"
HERE = Path(__file__).parent
VERSION = re.search(r"<version>(.+)</version>", (HERE / "package.xml").read_text()).group(1)

# A sourced ROS 2 brings its own rclpy and messages; a second copy from PyPI would shadow them.
# Private parts of rclpy: endo_sim_ros/nodes/rclpy_private.py.
ROS = [] if os.environ.get("AMENT_PREFIX_PATH") else ["ros-jazzy-rclpy[fastrtps]>=7.1.4,<7.2", "ros-jazzy-common-interfaces>=5.3,<6"]

setup(
    name=NAME,
    version=VERSION,
    description="Endoscope recordings become tissue that a robot can touch: Gaussian splatting and MPM as ROS 2 nodes",
    long_description=(HERE / "README.md").read_text(),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    install_requires=[
        *ROS,
        "av>=12",
        "mcap>=1.2.2",
        "numpy>=1.26",
        "opencv-python-headless>=4.9",
        "pycolmap>=4.2",  # its global mapper can hold the eyes of stereo pairs
        "pyyaml>=6",
        "rich>=13.4",
        "rosbags>=0.11.6,<0.12",  # private parts: endo_sim_ros/sequences/bag_private.py
        "scipy>=1.11",
        "tifffile>=2023.7.10",
        "torch>=2.11",
        "typing_extensions>=4.13",
        "tyro>=0.9.20",
        "warp-lang>=1.19,<1.20",  # private parts: see CONTRIBUTING.md
    ],
    extras_require={
        "depth": ["onnxruntime", "transformers"],  # reconstruction with depth:=network
        "learning": ["gymnasium>=1.1"],  # endo_sim_ros.learning.environments
        "lerobot": ["pyarrow>=15"],  # `endo-sim export`
        "openxr": ["pyopenxr>=1.1.6501"],  # controllers in the hands of a person, `endo-sim demonstrate --by person`
        "ray": ["gymnasium>=1.1", "ray>=2.9"],  # environments on several GPUs or machines, `learning.joined`
        "rl": ["gymnasium>=1.1", "stable-baselines3>=2.4"],  # `endo-sim train --algorithm ppo`
        "urdf": ["trimesh>=4"],  # instruments of your own, `instruments.urdf_reader`
        "viewer": ["viser>=1.1"],  # `endo-sim view`, viewer_node
        "report": ["matplotlib"],  # `endo-sim report`, `endo-sim plot`, plots of `endo-sim evaluate`
        "test": [
            *("gaussforge", "gymnasium", "hypothesis", "matplotlib", "mcap-ros2-support", "plyfile", "pyarrow", "pytest"),
            *("pdoc", "pyright", "pytest-xdist", "ruff", "torchmetrics", "trimesh>=4", "viser>=1.1"),
        ],
    },
    entry_points={"console_scripts": ["endo-sim = endo_sim_ros.cli:main"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml", "msg_conventions.md"]),
        (f"share/{NAME}/config", sorted(map(str, Path("config").glob("*.*")))),
        (f"share/{NAME}/config/sros2", sorted(map(str, Path("config/sros2").glob("*.xml")))),
        (f"share/{NAME}/launch", sorted(map(str, Path("launch").glob("*.py")))),
        # `ros2 run` looks for executables here; console scripts would land in bin/ under pip.
        (f"lib/{NAME}", sorted(map(str, Path("scripts").glob("*_node")))),
    ],
    package_data={
        NAME: ["*/native/*.h"],
        f"{NAME}.evaluation": ["page.html"],
        f"{NAME}.instruments": ["parameters/*.json"],
        f"{NAME}.nodes": ["fastdds.xml", "fastdds_shared_memory.xml"],
    },
    zip_safe=False,
)
