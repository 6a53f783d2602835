"""Small copies of StereoMIS in the forms in which it is found, filmed of the synthetic patient with a tool in view."""

import functools
from pathlib import Path

import cv2
import numpy as np
from plane_scene import rays_of, right_pose, rotation, write_poses, write_rgb, write_video

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_poses, render_phantom

COUNT, WIDTH, HEIGHT = 40, 240, 192
SMALL = WIDTH // 2, HEIGHT // 2  # of what the authors' preprocessing writes
MARGIN = 12  # poses before the first frame and after the last
K_LEFT = np.array([[215.0, 0, 112.0], [0, 216.0, 99.0], [0, 0, 1]])
K_RIGHT = np.array([[214.0, 0, 130.0], [0, 215.0, 92.0], [0, 0, 1]])
BARREL = np.array([-0.25, 0.08, 0.001, -0.002, 0.0, 0.0, 0.0, 0.0])
R, T = rotation(0.012, -0.015, 0.01), np.array([-0.0054, 0.0002, 0.0001])
FPS = 25.0


@functools.cache
def true_poses() -> np.ndarray:
    """Camera-to-world poses [N, 4, 4] of the raw left camera; frame 0 has the one in row MARGIN."""
    count = COUNT + 2 * MARGIN
    return phantom_poses(PhantomConfig(frames=count, rounds=count / 70, travel=0.025))


def pose_of_frame(number: int) -> np.ndarray:
    return true_poses()[number + MARGIN]


@functools.cache
def _distortion_maps(eye: str) -> tuple[np.ndarray, np.ndarray]:
    """Where in a wider undistorted picture each pixel of an eye is."""
    rays = rays_of(tuple(np.ravel(K_LEFT if eye == "left" else K_RIGHT)), tuple(BARREL), WIDTH, HEIGHT)
    wide = _wide_camera().K
    return tuple((rays[..., i] * wide[i, i] + wide[i, 2] - 0.5).astype(np.float32) for i in range(2))  # pyright: ignore


def _wide_camera() -> Camera:
    return Camera(intrinsic_matrix(215, 215, 0.7 * WIDTH, 0.7 * HEIGHT), round(1.4 * WIDTH), round(1.4 * HEIGHT))


def _tool(number: int, shift: float = 0.0) -> np.ndarray:
    """A tool [H, W] that moves by some three pixels a frame in a raw image."""
    tip = 100 + 45 * np.sin(number / 8) - shift, 90 + 40 * np.cos(number / 11)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.line(mask, (round(WIDTH - shift), 150), tuple(int(round(c)) for c in tip), 255, 26)
    return mask


@functools.cache
def raw_frame(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left and right image as the endoscope sees them, and the left mask, 255 = tool."""
    images = []
    for eye, pose in (("left", pose_of_frame(number)), ("right", right_pose(pose_of_frame(number), R, T))):
        wide, _ = render_phantom(PhantomConfig(exposure=1.4), _wide_camera().at(pose))
        image = cv2.remap(wide, *_distortion_maps(eye), cv2.INTER_LINEAR)
        tool = _tool(number, 0 if eye == "left" else 6)
        image[tool > 0] = (105, 110, 115)
        images.append(image)
    return images[0], images[1], _tool(number)


@functools.cache
def preprocessing() -> tuple:
    """Maps of both eyes and the left eye's intrinsics (OpenCV) of the half-size images that the authors' preprocessing writes."""
    scale = np.diag([0.5, 0.5, 1])
    K = scale @ K_LEFT, scale @ K_RIGHT
    R1, R2, P1, P2, *_ = cv2.stereoRectify(K[0], BARREL, K[1], BARREL, SMALL, R, T[:, None], alpha=0)
    left = cv2.initUndistortRectifyMap(K[0], BARREL, R1, P1, SMALL, cv2.CV_32FC1)
    right = cv2.initUndistortRectifyMap(K[1], BARREL, R2, P2, SMALL, cv2.CV_32FC1)
    return left, right, P1[:3, :3]


def preprocessed(image: np.ndarray, eye: int, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """A raw image or mask of an eye as the authors' preprocessing leaves it: rectified, half the size."""
    small = cv2.resize(image, SMALL, interpolation=cv2.INTER_AREA if interpolation == cv2.INTER_LINEAR else cv2.INTER_NEAREST)
    return cv2.remap(small, *preprocessing()[eye], interpolation)


def write_calibration(path: Path, size=(WIDTH, HEIGHT), eyes=(K_LEFT, K_RIGHT), distortion=BARREL, R=R, T=T):
    lines = []
    for section, K in zip(("StereoLeft", "StereoRight"), eyes):
        lines += [f"[{section}]", f"res_x={size[0]}", f"res_y={size[1]}", f"fc_x={K[0, 0]}", f"fc_y={K[1, 1]}"]
        lines += [f"cc_x={K[0, 2]}", f"cc_y={K[1, 2]}"] + [f"kc_{i}={k}" for i, k in enumerate(distortion)]
    lines += [f"R_{i}={value:.12g}" for i, value in enumerate(R.ravel())]
    lines += [f"T_{i}={1000 * value:.12g}" for i, value in enumerate(T)]
    path.write_text("\n".join(lines))


def write_stereomis(
    root: Path,
    *,
    lag: int | None = 4,
    missing: tuple[int, ...] = (7, 8, 21),
    video: bool = True,
    frames: str | None = None,
    masks: str | None = "rectified",
    first_mask: int = 1,
    white: str = "tool",
    masked: range = range(COUNT),
) -> Path:
    """Write a sequence.

    Args:
        root: Its new folder.
        lag: Frame n has the pose in row n − lag of groundtruth.txt; None writes no such file.
        missing: Rows that it lacks.
        video: Write the stacked video.
        frames: Also `video_frames/`: `rectified` at half the size and numbered from 1, or `raw` and numbered from 0.
        masks: `rectified` at half the size, `raw` at full size, or none.
        first_mask: Number of the first frame's mask.
        white: What is white in the masks, `tool` or `tissue`.
        masked: Frames that have a mask.
    """
    root.mkdir(parents=True)
    write_calibration(root / "StereoCalibration.ini")
    raw = [raw_frame(number) for number in range(COUNT)]
    if video:
        write_video(root / "IFBS_ENDOSCOPE-part0001.mp4", (np.vstack(frame[:2]) for frame in raw), fps=FPS)
    for number, frame in enumerate(raw):
        for eye in range(2 if frames else 0):
            image = frame[eye] if frames == "raw" else preprocessed(frame[eye], eye)
            write_rgb(root / f"video_frames/{number + (frames == 'rectified'):06d}{'lr'[eye]}.png", image)
        if masks and number in masked:
            mask = frame[2] if masks == "raw" else preprocessed(frame[2], 0, cv2.INTER_NEAREST)
            write_rgb(root / f"masks/{number + first_mask:06d}l.png", mask if white == "tool" else 255 - mask)
    if lag is not None:
        rows = {row: pose_of_frame(row + lag) for row in range(COUNT) if row not in missing}
        write_poses(root / "groundtruth.txt", rows)
    (root / "train_split.csv").write_text("start,end\n4,10\n20,24\n")
    (root / "test_split.csv").write_text("start,end\n30,33\n")
    return root
