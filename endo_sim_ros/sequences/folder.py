"""A plain folder of images, the layout to bring other data in.

my_recording/
  left/000001.png …       the number in the name is the frame number; without right/ pictures may hold both eyes
  right/000001.png …      optional; rectified, same K, unless the calibration is one of ROS or OpenCV
  calibration.yaml        fx fy cx cy [pixels], baseline_m [with right/], optional fps, distortion (left only);
                          or the options fx fy cx cy, distortion or baseline_m; or, of one eye, nothing: it is estimated with the poses;
                          or any files that ROS or OpenCV wrote: images, masks, depth and poses are those of the raw cameras then
  poses_left.txt          frame tx ty tz qx qy qz qw, camera-to-world, metres; without it poses are estimated
  masks/000001.png …      optional; 255 = tissue, 0 = ignore
  depth/000001.png …      optional; 16 bit, millimetres (see depth_scale), 0 = none
  points.txt              optional, with poses; x y z [m, world] r g b [0-255], of structure from motion, for methods that start from it
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.estimated_poses import with_estimated_poses
from endo_sim_ros.sequences.eyes import find_halves, with_raw_eyes_checked
from endo_sim_ros.sequences.images import UNMEASURED, check_size, image_size, numbered_files, read_depth, read_image, tell_coarse_depth
from endo_sim_ros.sequences.lenses import calibrated_size, read_lenses
from endo_sim_ros.sequences.masks import UNMASKED, Borders, MaskFiles, find_borders
from endo_sim_ros.sequences.misread_poses import refuse_misread
from endo_sim_ros.sequences.opencv_calibrations import CALIBRATION_FILE, find_calibration
from endo_sim_ros.sequences.point_files import read_points
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.recording import (
    DEFAULT_FPS,
    Recording,
    check_folder,
    keep_posed,
    select,
    spread,
    stamp_ns,
    tell_beyond,
    tell_lacking,
)
from endo_sim_ros.sequences.rectification import AHEAD
from endo_sim_ros.sequences.stereo_images import StereoFiles

POSE_FILES = ("poses_left.txt", "poses.txt")


def read_folder(
    path: Path | str,
    *,
    start: int | None = None,
    stop: int | None = None,
    step: int = 1,
    depth_scale: float = 1e-3,
    mask_polarity: str = "tissue",
    mask_border: bool = True,
    fps: float | None = None,
    poses: str | None = None,
    scale: float | None = None,
    fx: float | None = None,
    fy: float | None = None,
    cx: float | None = None,
    cy: float | None = None,
    distortion: Sequence[float] = (),
    baseline_m: float | None = None,
    frames_rectified: bool | None = None,
    eyes: str = "auto",
) -> Recording:
    """Read a folder of images.

    Args:
        path: The folder that holds left/ and a calibration.
        start, stop: First frame number, and the one to stop before.
        step: Take every step-th image.
        depth_scale: Metres per unit of integer depth images; float images are metres.
        mask_polarity: What white means in the masks: `tool`, `tissue`, or `auto` to find out.
        mask_border: Ignore the black border that rectification or a round vignette leaves, and writing or a logo that is burnt in.
        fps: Frames per second that frame numbers count in; None takes the calibration's, or 25.
        poses: `sfm`, `vggt` or `vggt:FOLDER` estimates the poses, see `pose_estimator`; None takes those of the recording if there are any,
            else structure from motion.
        scale: Metres per unit of recorded poses and of points.txt (default 1), or of poses that are estimated where there is no right/: the
            median depth of the tissue over all frames (default: from depth/, and a guess without that).
        fx, fy, cx, cy, baseline_m: Instead of a file, as of `read_video`. Of one eye with neither, and no poses, both are estimated.
        distortion: With fx, coefficients k1 [k2 [p1 p2 [k3]]].
        frames_rectified: With a calibration of ROS or OpenCV, whether the images are rectified; None finds out from the rows of stereo
            pairs, and takes images of one eye for raw ones.
        eyes: Where pictures in left/ without right/ hold both eyes, see `EYES`; `one`: they hold one; `auto` finds out.

    Returns:
        Undistorted frames, of both eyes where there is right/ or left/ holds both; those without a pose are skipped.

    Raises:
        SequenceError: If a file is missing or wrong, or images tell that poses were written by another convention.
    """
    root = check_folder(path, fps=fps, depth_scale=depth_scale, scale=scale, baseline_m=baseline_m)
    left, right = numbered_files(root / "left"), numbered_files(root / "right")
    if not left:
        raise SequenceError(f"{root / 'left'}: holds no images named like 000001.png")
    if right and eyes != "auto":
        raise SequenceError(f"{root}: has right/, so that eyes={eyes} has no effect; leave it out, or take right/ away")
    pose_file = next((root / name for name in POSE_FILES if (root / name).is_file()), None) if poses is None else None
    given = fx, fy, cx, cy, baseline_m
    told = len(distortion) > 0 or any(value is not None for value in given)
    files = [] if told else find_calibration(root)
    if not (files or told) and (right or pose_file):
        files = [root / CALIBRATION_FILE]  # which is missing

    numbers, recorded = select(left, root / "left", start, stop, step), None
    if pose_file:
        recorded = read_poses(pose_file, scale or 1.0)
        tell_beyond(recorded, max(left), pose_file)
        numbers = keep_posed(numbers, recorded, pose_file)
    missing = [n for n in numbers if right and n not in right]
    if missing:
        raise SequenceError(f"{root / 'right'}: the right image of {left[missing[0]].name} is missing")
    tell_lacking([*right], left, root / "left", "their right images are left out")

    whole = image_size(read_image(left[numbers[0]]))
    look = lambda: [check_size(read_image(left[n]), whole, left[n]) for n in spread(numbers, 5)]
    halves = None if right else find_halves(eyes, whole, look, root / "left", calibrated_size(files))
    pairs = StereoFiles(root, {n: left[n] for n in numbers}, right, halves=halves) if right or halves else None
    size = halves.size if halves else whole
    rectification, raw, known, told_fps = read_lenses(root, files, given, distortion, size, pairs, frames_rectified)
    rate = fps or told_fps or DEFAULT_FPS
    stamp_ns(numbers[-1], rate)  # one that cannot be said is refused before the long work
    depths, mask_files = (_beside(root / name, left, numbers, so) for name, so in (("depth", UNMEASURED), ("masks", UNMASKED)))
    masks = MaskFiles(mask_files, root / "masks", mask_polarity, halves)

    def image_of(number: int) -> np.ndarray:
        picture = check_size(read_image(left[number]), whole, left[number])
        return halves.cut(picture)[0] if halves else picture

    def read(numbers: Sequence[int]) -> Iterable[tuple[int, np.ndarray, np.ndarray | None]]:
        return pairs.read(numbers) if pairs else ((n, image_of(n), None) for n in numbers)

    sampled = lambda: find_borders(root, read(spread(numbers, 10)), None if recorded is None else [recorded[n] for n in numbers])
    borders = sampled() if mask_border else Borders()

    def seen(number: int, image: np.ndarray) -> Frame:
        mask, tissue = borders.lit(image), masks.of(number, size)
        if tissue is not None:
            mask = cv2.bitwise_and(mask, tissue)
        pose = np.eye(4) if recorded is None else recorded[number]
        return Frame(
            stamp_ns=stamp_ns(number, rate),
            image=rectification.left(image),
            camera=Camera(rectification.K, *size, rectification.pose(pose)),
            mask=rectification.mask(mask),
        )

    tell_coarse_depth(depths, depth_scale)
    rays = raw.rays() if raw and depths else AHEAD  # of one eye depth stays as it is

    def frame_of(number: int, image: np.ndarray, other: np.ndarray | None) -> Frame:
        frame, depth = seen(number, borders.left(image)), None
        if number in depths:
            z = check_size(read_depth(depths[number], depth_scale), size, depths[number])
            depth = rectification.depth(rays * z[..., None])
        turned = rectification.right(borders.right(other)) if other is not None and rectification.baseline else None
        return replace(frame, right=turned, baseline=rectification.baseline, depth=depth)

    def frames() -> Iterator[Frame]:
        views = with_raw_eyes_checked(pairs.read(numbers), raw) if pairs and raw else read(numbers)
        yield from itertools.starmap(frame_of, views)

    if pose_file:
        refuse_misread(lambda number: seen(number, image_of(number)), numbers, pose_file)
    # Its points are of the poses recorded.
    source = f"{root / 'left'} and {root / 'right'}" if right else root / "left"
    recording = Recording(frames, len(numbers), lambda: read_points(root, scale or 1.0), source=source)
    if recorded is not None:
        return recording
    names = [left[n].name for n in numbers]
    return with_estimated_poses(recording, root, poses, " or ".join(POSE_FILES), names, scale=scale, calibrated=known)


def _beside(folder: Path, left: Mapping[int, Path], numbers: Sequence[int], so: str) -> dict[int, Path]:
    """Images of depth or masks by frame number; `so` is what comes of a frame without one."""
    files = numbered_files(folder)
    if files and not files.keys() & left.keys():
        raise SequenceError(
            f"{folder}: holds numbers from {min(files)} to {max(files)}, but no image in left/, from {min(left)} to {max(left)},"
            " has one of them; number them alike, or take the folder away"
        )
    tell_lacking(numbers, files, folder, so)
    return files
