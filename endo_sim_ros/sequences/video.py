"""A plain video of one eye, with or without a calibration and poses.

    endo.mp4, or a folder with
      endo.mp4
      calibration.yaml    optional: fx fy cx cy [pixels], distortion
      poses.txt           optional: frame tx ty tz qx qy qz qw, camera-to-world
      mask.png            optional, one for all frames; or masks/%06d.png; 255 = tissue
"""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.cameras import Camera
from endo_sim_ros.sequences.frames import Frame, SequenceError
from endo_sim_ros.sequences.recordings import (
    Recording,
    Video,
    find_video,
    intrinsic_matrix,
    lit_area,
    numbered_files,
    read_calibration,
    read_gray,
    read_poses,
    select,
    spread,
    stamp_ns,
    tissue_mask,
    tool_is_white,
)
from endo_sim_ros.sequences.rectification import Rectification
from endo_sim_ros.sequences.structure_from_motion import estimate_poses

logger = logging.getLogger(__name__)

STRUCTURE_FROM_MOTION = "sfm"


def read_video(
    path: Path | str,
    *,
    start: int | None = None,
    stop: int | None = None,
    step: int = 1,
    poses: Path | str | None = None,
    calibration: Path | str | None = None,
    fx: float | None = None,
    fy: float | None = None,
    cx: float | None = None,
    cy: float | None = None,
    distortion: Sequence[float] = (),
    scale: float | None = None,
    sfm_step: int = 6,
    mask: Path | str | None = None,
    mask_polarity: str = "tissue",
    mask_border: bool = True,
    fps: float | None = None,
    threads: int = -1,
) -> Recording:
    """Read a video.

    Args:
        path: The video, or a folder with one video.
        start, stop: First frame number, and the one to stop before.
        step: Take every step-th frame.
        poses: File of lines `frame tx ty tz qx qy qz qw` (camera-to-world, metres unless scale is given); frames that
            it leaves out are skipped. None takes `poses.txt` beside the video if there is one, and structure from
            motion otherwise; `sfm` insists on the latter.
        calibration: YAML file with fx, fy, cx, cy, optional distortion; None takes `calibration.yaml` beside the video.
        fx, fy, cx, cy: Intrinsics instead of a file, pixels, pixel (0, 0) centred at (0.5, 0.5) as in COLMAP.
            fy = fx and the image centre where left out.
        distortion: With fx, coefficients k1 [k2 [p1 p2 [k3]]]; the frames are undistorted.
        scale: Metres per unit of the poses, from a file (default 1) or from structure from motion (default: a guess).
        sfm_step: Structure from motion uses and returns every sfm_step-th of the frames only.
        mask: One mask image for all frames, or a folder of numbered ones; None takes `mask.png` or `masks` beside
            the video.
        mask_polarity: What white means in the masks: `tool`, `tissue`, or `auto` to find out.
        mask_border: Ignore the black border and round vignette around the image.
        fps: Frames per second; None takes the video's.
        threads: For structure from motion: -1 = all cores, 1 = repeatable to the last bit.

    Raises:
        SequenceError: If a file is missing or wrong, or poses are given without intrinsics.
    """
    path = Path(path)
    root = path if path.is_dir() else path.parent
    if path.is_dir():
        path = find_video(path)
        if path is None:
            raise SequenceError(f"{root}: holds no video; pass a video file or a folder with one")
    beside = root if root == Path(root) and find_sidecars(root, path) else None
    video = Video(path)
    return video, beside


def find_sidecars(root: Path, path: Path) -> bool:
    return True
