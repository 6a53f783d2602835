"""A known textured plane seen by known cameras, and files of it."""

import functools
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.cameras import matrix_to_quat

WIDTH, HEIGHT = 160, 128
PLANE_Z = 0.08  # m, in the world frame
K_LEFT = np.array([[150.0, 0, 78.0], [0, 152.0, 65.0], [0, 0, 1]])
K_RIGHT = np.array([[149.0, 0, 81.0], [0, 151.0, 62.0], [0, 0, 1]])
NO_DISTORTION = np.zeros(5)
BARREL = np.array([-0.2, 0.03, 0.001, -0.002, 0.0])
BASELINE = 0.005


def rotation(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    return cv2.Rodrigues(np.array([x, y, z], np.float64))[0]


def pose_of(position=(0, 0, 0), x=0.0, y=0.0, z=0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(x, y, z), position
    return pose


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """RGB of the plane at world points, smooth, so that video compression and interpolation change it little."""
    red = 120 + 60 * np.sin(2 * np.pi * x / 0.023) * np.cos(2 * np.pi * y / 0.031)
    green = 110 + 50 * np.sin(2 * np.pi * (x + 0.4 * y) / 0.017)
    blue = 80 + 40 * np.cos(2 * np.pi * (y - 0.3 * x) / 0.019)
    return np.stack([red, green, blue], -1)


@functools.cache
def rays_of(K_cv: tuple[float, ...], distortion: tuple[float, ...], width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Directions (x, y, 1) that the pixels of a camera look in, as x and y [H, W, 2]."""
    K, coefficients = np.reshape(K_cv, (3, 3)), np.array(distortion)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([u, v], -1).reshape(-1, 2)
    rays = cv2.undistortPoints(pixels[:, None], K, coefficients).reshape(-1, 2)
    for _ in range(20):  # OpenCV stops early
        seen = cv2.projectPoints(np.c_[rays, np.ones(len(rays))], np.zeros(3), np.zeros(3), K, coefficients)[0].reshape(-1, 2)
        rays += (pixels - seen) / K[[0, 1], [0, 1]]
    return rays.reshape(height, width, 2)


def see_plane(K_cv, distortion, pose) -> tuple[np.ndarray, np.ndarray]:
    """What a raw camera (OpenCV pixel convention) sees: RGB [H, W, 3] and points [H, W, 3] in its own frame."""
    rays = rays_of(tuple(np.ravel(K_cv)), tuple(distortion))
    rays = np.dstack([rays, np.ones((HEIGHT, WIDTH))])
    turned = rays @ pose[:3, :3].T
    depth = (PLANE_Z - pose[2, 3]) / turned[..., 2]
    points = turned * depth[..., None] + pose[:3, 3]
    return texture(points[..., 0], points[..., 1]).round().astype(np.uint8), rays * depth[..., None]


def right_pose(left: np.ndarray, R: np.ndarray, T: np.ndarray) -> np.ndarray:
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = R, T
    return left @ np.linalg.inv(change)


def plane_colours(frame) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H, W, 3] and depth [H, W] that the frame's own camera says the plane must have."""
    camera = frame.camera
    turned = camera.rays() @ camera.pose[:3, :3].T
    depth = (PLANE_Z - camera.pose[2, 3]) / turned[..., 2]
    points = turned * depth[..., None] + camera.pose[:3, 3]
    return texture(points[..., 0], points[..., 1]), depth


def assert_frame_agrees(frame, tolerance=4.0, margin=4):
    """The image shows what K and pose say; the right image shows it shifted by fx·baseline/depth on the same row."""
    expected, depth = plane_colours(frame)
    used = cv2.erode(frame.mask, np.ones((2 * margin + 1,) * 2)) > 0 if frame.mask is not None else np.ones(depth.shape, bool)
    used[:margin] = used[-margin:] = False
    assert used.mean() > 0.3
    error = np.abs(frame.image.astype(float) - expected).max(-1)[used]
    assert np.median(error) < tolerance / 2
    assert np.percentile(error, 95) < tolerance
    if frame.right is not None:
        disparity = frame.camera.K[0, 0] * frame.baseline / depth
        u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        moved = cv2.remap(frame.right, (u - disparity).astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        used &= u - disparity > margin
        error = np.abs(moved.astype(float) - expected).max(-1)[used]
        assert np.percentile(error, 95) < tolerance
    if frame.depth is not None:
        measured = (frame.depth > 0) & used
        assert measured.any()
        assert np.abs(frame.depth - depth)[measured].max() < 5.1e-4  # depth images are rounded to millimetres


def write_rgb(path: Path, image: np.ndarray):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_video(path: Path, images, fps=25.0):
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = None
    for image in images:
        writer = writer or cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), fps, image.shape[1::-1])
        assert writer.isOpened()
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()


def write_poses(path: Path, poses: dict[int, np.ndarray], heading="# frame tx ty tz qx qy qz qw"):
    lines = [heading]
    for number, pose in poses.items():
        w, x, y, z = matrix_to_quat(pose[:3, :3])
        lines.append(f"{number} " + " ".join(f"{value:.12g}" for value in (*pose[:3, 3], x, y, z, w)))
    path.write_text("\n".join(lines) + "\n")


def trajectory(count: int) -> dict[int, np.ndarray]:
    return {n: pose_of((0.001 * n, -0.0005 * n, 0.0004 * n), x=0.004 * n, y=-0.006 * n, z=0.003 * n) for n in range(count)}


R_EYES, T_EYES = rotation(0.01, -0.02, 0.005), np.array([-BASELINE, 0.0002, 0.0001])


def stereo_images(poses: dict[int, np.ndarray], distortion=BARREL):
    for pose in poses.values():
        left, _ = see_plane(K_LEFT, distortion, pose)
        right, _ = see_plane(K_RIGHT, distortion, right_pose(pose, R_EYES, T_EYES))
        yield left, right
