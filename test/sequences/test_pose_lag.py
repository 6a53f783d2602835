"""The lag of poses, on a real recording whose poses come from its own images."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix, invert_pose
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.pose_lag import LagFinder
from endo_sim_ros.sequences.rectification import Rectification
from endo_sim_ros.sequences.video_files import Video

GALLBLADDER = Path(__file__).parents[3] / "shared/data/gallbladder"


@pytest.mark.slow
@pytest.mark.skipif(not GALLBLADDER.is_dir(), reason="the gallbladder video is not at ../shared/data")
@pytest.mark.parametrize("lag", [4, pytest.param(-5, marks=pytest.mark.thorough)])
def test_lag_of_a_real_recording_whose_poses_are_shifted(lag):
    poses = read_poses(GALLBLADDER / "poses.txt")  # of every sixth frame
    points = np.loadtxt(GALLBLADDER / "points.txt", usecols=range(3))
    scale = 0.1 / np.median((points @ invert_pose(poses[0])[2, :3]) + invert_pose(poses[0])[2, 3])
    for pose in poses.values():
        pose[:3, 3] *= scale
    video = Video(GALLBLADDER / "endo.mp4")
    rectification = Rectification.mono(intrinsic_matrix(907.4, 907.4, 640, 360), [-0.083], (1280, 720))
    camera = Camera(rectification.K, 1280, 720).resized(320, 180)
    finder = LagFinder({number - lag: pose for number, pose in poses.items()}, camera, range(video.frame_count), pairs=16)
    images = {
        n: cv2.resize(rectification.left(image), (320, 180), interpolation=cv2.INTER_AREA) for n, image in video.frames(finder.frames)
    }
    found, basis = finder.find(images, lambda number: None)
    assert found is not None and abs(found - lag) <= 1, basis  # the tissue and a grasper move, too
