"""EndoNeRF: a fixed stereo endoscope over tissue that is pulled and cut, prepared in the LLFF layout.

pulling_soft_tissues/
  images/%06d.png
  poses_bounds.npy     17 floats per frame: 3×5 [down right back | position | height width focal], near, far
  depth/               8 or 16 bit, optional
  masks/               white = tool, optional
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix, rigid_pose
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.images import UNMEASURED, check_size, image_size, numbered_files, read_depth, read_image, tell_coarse_depth
from endo_sim_ros.sequences.masks import UNMASKED, MaskFiles
from endo_sim_ros.sequences.pose_files import rigid
from endo_sim_ros.sequences.recording import DEFAULT_FPS, Recording, check_folder, keep_posed, select, stamp_ns, tell_lacking

POSES_FILE = "poses_bounds.npy"


def read_endonerf(
    path: Path | str,
    *,
    start: int | None = None,
    stop: int | None = None,
    step: int = 1,
    depth_scale: float = 1e-3,
    pose_scale: float | None = None,
    mask_polarity: str = "tool",
    fps: float | None = None,
) -> Recording:
    """Read an EndoNeRF scene.

    Args:
        path: The scene's folder.
        start, stop: First frame number, and the one to stop before.
        step: Take every step-th frame.
        depth_scale: Metres per unit of the depth images; millimetres by default.
        pose_scale: Metres per unit of the camera positions; None = as the depth images.
        mask_polarity: What white means in the masks: `tool`, `tissue`, or `auto` to find out.
        fps: Frames per second; None = 25.

    Returns:
        Frames of one eye; the images are rectified as published.

    Raises:
        SequenceError: If a file is missing or wrong.
    """
    root = check_folder(path, fps=fps, depth_scale=depth_scale, pose_scale=pose_scale)
    images = numbered_files(root / "images")
    if not images:
        raise SequenceError(f"{root / 'images'}: holds no images named like 000000.png")
    table = _read_table(root / POSES_FILE)
    if len(table) != len(images):
        raise SequenceError(
            f"{root / POSES_FILE}: has {counted(len(table), 'pose')}, but {root / 'images'} has {counted(len(images), 'image')}; "
            "each image needs one row"
        )
    rows = dict(zip(sorted(images), table, strict=True))
    numbers = select(images, root, start, stop, step)
    keep_posed(numbers, rows, root / POSES_FILE)
    depths, mask_files = numbered_files(root / "depth"), numbered_files(root / "masks")
    for name, files, so in (("depth", depths, UNMEASURED), ("masks", mask_files, UNMASKED)):
        tell_lacking(numbers, files, root / name, so)
    masks = MaskFiles(mask_files, root / "masks", mask_polarity)
    tell_coarse_depth(depths, depth_scale)
    pose_scale = depth_scale if pose_scale is None else pose_scale

    def frames() -> Iterator[Frame]:
        for number in numbers:
            image = read_image(images[number])
            size, depth = image_size(image), None
            if number in depths:
                depth = check_size(read_depth(depths[number], depth_scale), size, depths[number])
            source = f"{root / POSES_FILE}: row of frame {number}"
            yield Frame(
                stamp_ns=stamp_ns(number, fps or DEFAULT_FPS),
                image=image,
                camera=_camera(rows[number], size, pose_scale, source),
                depth=depth,
                mask=masks.of(number, size),
            )

    return Recording(frames, len(numbers))


def _read_table(path: Path) -> np.ndarray:
    """The rows [N, 17] of a poses_bounds file."""
    if not path.is_file():
        raise SequenceError(f"{path}: file is missing; it holds the camera of every image")
    try:
        table = np.load(path, allow_pickle=False, mmap_mode="r")  # a false header must not take memory
    except (ValueError, OSError, EOFError) as error:
        raise SequenceError(f"{path}: not a readable NumPy array ({error})") from None
    if table.ndim != 2 or table.shape[1] != 17:
        raise SequenceError(f"{path}: expected numbers of shape [frames, 17], got shape {list(table.shape)}")
    return table.astype(np.float64)


def _camera(row: np.ndarray, size: tuple[int, int], pose_scale: float, source: str) -> Camera:
    """The camera of one LLFF row; the principal point is the image centre, as LLFF has none."""
    block = row[:15].reshape(3, 5)
    height, width, focal = block[:, 4]
    if min(height, width, focal) <= 0:
        raise SequenceError(f"{source}: height, width and focal must be positive, got {block[:, 4].tolist()}")
    down, right, back, position, _ = block.T
    matrix = rigid_pose(np.stack([right, down, -back], 1), position * pose_scale)  # optical frame: x right, y down, z forward
    K = intrinsic_matrix(focal * size[0] / width, focal * size[1] / height, size[0] / 2, size[1] / 2)
    try:
        return Camera(K, *size, rigid(matrix, source))
    except SequenceError as error:
        raise SequenceError(f"{error}; poses=sfm estimates poses of the same images in a folder named left") from None
