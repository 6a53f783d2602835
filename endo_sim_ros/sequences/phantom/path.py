"""The endoscope: its camera, and the path on which it pivots about its trocar."""

import math

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.sequences.phantom.config import PhantomConfig


def phantom_poses(config: PhantomConfig) -> np.ndarray:
    """Camera-to-world poses [frames, 4, 4] of an endoscope that pivots about its trocar; it starts and ends at rest."""
    rng = np.random.default_rng([config.seed, 0x9A7])
    s = np.linspace(0.0, 1.0, config.frames)
    phase = config.rounds * 2.0 * math.pi * (s - np.sin(2.0 * math.pi * s) / (2.0 * math.pi))  # slow in, slow out
    swing = config.travel / (2.0 * config.lever)  # radians
    start = rng.uniform(0.0, 2.0 * math.pi)
    yaw = swing * np.cos(phase + start)
    pitch = 0.65 * swing * np.sin(2.0 * phase + rng.uniform(0.0, 2.0 * math.pi))
    depth = config.lever + 0.25 * config.travel * np.sin(phase + rng.uniform(0.0, 2.0 * math.pi))
    roll = 0.06 * np.sin(phase + rng.uniform(0.0, 2.0 * math.pi))
    poses = np.tile(np.eye(4), (config.frames, 1, 1))
    along = config.flight * (phase / (config.rounds * 2.0 * math.pi) - 0.5)
    for pose, a, b, c, d, x in zip(poses, yaw, pitch, roll, depth, along):
        turn = cv2.Rodrigues(np.array([0.0, a, 0.0]))[0] @ cv2.Rodrigues(np.array([b, 0.0, 0.0]))[0]
        pose[:3, :3] = turn @ cv2.Rodrigues(np.array([0.0, 0.0, c]))[0]
        pose[:3, 3] = turn[:, 2] * d - [0.0, 0.0, config.lever]
        pose[0, 3] += x
    return poses


def phantom_camera(config: PhantomConfig, pose: np.ndarray | None = None) -> Camera:
    """The left camera of the phantom's endoscope, at a pose [4, 4] or at the origin."""
    focal = 0.5 * config.width / math.tan(math.radians(config.fov_deg) / 2)
    K = intrinsic_matrix(focal, focal, config.width / 2, config.height / 2)
    return Camera(K, config.width, config.height, np.eye(4) if pose is None else pose)
