"""A plain folder of rectified images, the layout to bring other data in.

my_recording/
  left/000001.png …       rectified images; the number in the name is the frame number
  right/000001.png …      optional; rectified, same K
  calibration.yaml        fx fy cx cy [pixels], baseline_m [with right/], optional fps, distortion (left only)
  poses_left.txt          frame tx ty tz qx qy qz qw, camera-to-world, metres; without it poses are estimated
  masks/000001.png …      optional; 255 = tissue, 0 = ignore
  depth/000001.png …      optional; 16 bit, millimetres (see depth_scale), 0 = none
  points.txt              optional, with poses; x y z [m, world] r g b [0-255], of structure from motion, for methods that start from it
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.calibration_files import check_calibrated_size, read_calibration
from endo_sim_ros.sequences.estimated_poses import with_estimated_poses
from endo_sim_ros.sequences.images import UNMEASURED, check_size, image_size, numbered_files, read_depth, read_image
from endo_sim_ros.sequences.masks import UNMASKED, MaskFiles, lit_now, lit_part
from endo_sim_ros.sequences.misread_poses import refuse_misread
from endo_sim_ros.sequences.point_files import read_points
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.recording import DEFAULT_FPS, Recording, check_folder, keep_posed, select, spread, stamp_ns, tell_lacking
from endo_sim_ros.sequences.rectification import Rectification

CALIBRATION_FILE = "calibration.yaml"
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
) -> Recording:
    """Read a folder of images.

    Args:
        path: The folder that holds left/ and calibration.yaml.
        start, stop: First frame number, and the one to stop before.
        step: Take every step-th image.
        depth_scale: Metres per unit of integer depth images; float images are metres.
        mask_polarity: What white means in the masks: `tool`, `tissue`, or `auto` to find out.
        mask_border: Ignore the black border that rectification or a round vignette leaves.
        fps: Frames per second that frame numbers count in; None takes the calibration's, or 25.
        poses: `sfm`, `vggt` or `vggt:FOLDER` estimates the poses, see `pose_estimator`; None takes those of the recording if there are any,
            else structure from motion.
        scale: Metres per unit of poses that are estimated where there is no right/; None guesses.

    Returns:
        Undistorted frames, of both eyes where there is right/; those without a pose are skipped.

    Raises:
        SequenceError: If a file is missing or wrong, or images tell that poses were written by another convention.
    """
    root = check_folder(path, fps=fps, depth_scale=depth_scale, scale=scale)
    left, right = numbered_files(root / "left"), numbered_files(root / "right")
    if not left:
        raise SequenceError(f"{root / 'left'}: holds no images named like 000001.png")
    calibration = read_calibration(root / CALIBRATION_FILE)
    K = intrinsic_matrix(*(calibration[name] for name in ("fx", "fy", "cx", "cy")))
    baseline = calibration.get("baseline_m")
    if right and baseline is None:
        raise SequenceError(f"{root / CALIBRATION_FILE}: baseline_m is missing, but there are right images")
    if right and any(calibration["distortion"]):
        raise SequenceError(f"{root / CALIBRATION_FILE}: stereo images must be rectified already; drop distortion or right/")
    rate: float = fps or calibration.get("fps", DEFAULT_FPS)

    numbers = select(left, root / "left", start, stop, step)
    recorded = None
    pose_file = next((root / name for name in POSE_FILES if (root / name).is_file()), None)
    if pose_file and poses is None:
        recorded = read_poses(pose_file)
        numbers = keep_posed(numbers, recorded, pose_file)
        if scale is not None:
            raise SequenceError(f"{pose_file}: its poses are in metres, and scale is for those that are estimated; leave scale out")
    stamp_ns(numbers[-1], rate)  # one that cannot be said is refused before the long work
    missing = [n for n in numbers if right and n not in right]
    if missing:
        raise SequenceError(f"{root / 'right'}: the right image of {left[missing[0]].name} is missing")
    tell_lacking([*right], left, root / "left", "their right images are left out")

    size = image_size(read_image(left[numbers[0]]))
    check_calibrated_size(calibration, size, root / CALIBRATION_FILE)
    rectification = Rectification.mono(K, calibration["distortion"], size, root / CALIBRATION_FILE)
    depths, mask_files = numbered_files(root / "depth"), numbered_files(root / "masks")
    for name, files, so in (("depth", depths, UNMEASURED), ("masks", mask_files, UNMASKED)):
        if files and not files.keys() & left.keys():
            raise SequenceError(
                f"{root / name}: holds numbers from {min(files)} to {max(files)}, but no image in left/, from {min(left)} to {max(left)},"
                " has one of them; number them alike, or take the folder away"
            )
        tell_lacking(numbers, files, root / name, so)
    masks = MaskFiles(mask_files, root / "masks", mask_polarity)

    def image_of(file: Path) -> np.ndarray:
        return check_size(read_image(file), size, file)

    lit = np.full(size[::-1], 255, np.uint8)
    if mask_border:
        lit = lit_part(root, (image_of(left[n]) for n in spread(numbers, 10)))

    def left_of(number: int) -> Frame:
        image = image_of(left[number])
        mask, tissue = lit_now(lit, image), masks.of(number, size)
        if tissue is not None:
            mask = cv2.bitwise_and(mask, tissue)
        pose = np.eye(4) if recorded is None else recorded[number]
        return Frame(
            stamp_ns=stamp_ns(number, rate),
            image=rectification.left(image),
            camera=Camera(rectification.K, *size, pose),
            mask=rectification.mask(mask),
        )

    def frame_of(number: int) -> Frame:
        frame, depth = left_of(number), None
        if number in depths:
            z = read_depth(depths[number], depth_scale)
            check_size(z, size, depths[number])
            depth = rectification.depth(np.dstack([np.zeros_like(z)] * 2 + [z]))
        return replace(frame, right=image_of(right[number]) if right else None, baseline=baseline if right else None, depth=depth)

    if pose_file and recorded is not None:
        refuse_misread(left_of, numbers, pose_file)
    # Its points are of the poses recorded.
    read, source = (lambda: map(frame_of, numbers)), f"{root / 'left'} and {root / 'right'}"
    recording = Recording(read, len(numbers), lambda: read_points(root), source=source)
    return recording if recorded is not None else with_estimated_poses(recording, root, poses, " or ".join(POSE_FILES), scale)
