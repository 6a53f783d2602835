"""Image files: colour images, masks and depth images, and folders of numbered files."""

import logging
import re
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.frames import SequenceError

logger = logging.getLogger(__name__)

UNMEASURED = "these have no depth of their own"
"""What comes of a frame without an image of depth."""

_FEWEST_BITS = 12  # of images of 16: with fewer all would be black
_MOST_DIGITS = 15  # of a number of an image: more are none of a frame
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".jp2")
_UNREAD = (".avif", ".dcm", ".dng", ".exr", ".gif", ".heic", ".heif", ".jxl", ".raw", ".tga")  # images nevertheless
_JPEG = (".jpg", ".jpeg")


def read_image(path: Path) -> np.ndarray:
    """An RGB image [H, W, 3], uint8; of 16 bits the upper eight. It is as stored, however its EXIF data would turn it.

    Raises:
        SequenceError: If it is missing, damaged, has fewer bits than its file, or is of other numbers.
    """
    # Calibrations and masks are of what is stored.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype == np.uint16:
        if (most := int(image.max())) < 2**_FEWEST_BITS:
            raise SequenceError(
                f"{path}: has 16 bits, but no value above {most}, as of a camera of 10 or 12 bits; scale images to all 16, or to 8"
            )
        image = (image >> 8).astype(np.uint8)
    if image.dtype != np.uint8:
        raise SequenceError(f"{path}: is an image of {image.dtype} numbers; convert it to 8 or 16 bits, for instance as .png")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_mask_image(path: Path) -> np.ndarray:
    """The image of a mask [H, W], in the numbers of its file: the brightness of colours, black where it is transparent.

    Raises:
        SequenceError: If it is missing or damaged.
    """
    mask = _decode(path, cv2.IMREAD_UNCHANGED)
    if mask.ndim == 2:
        return np.nan_to_num(mask)
    gray = cv2.cvtColor(mask[..., :3], cv2.COLOR_BGR2GRAY)
    if gray.max() <= 127:  # only dark ones: a mask in red or blue
        gray = mask[..., :3].max(-1)
    return np.minimum(gray, mask[..., 3]) if mask.shape[2] == 4 else gray


def read_depth(path: Path, depth_scale: float) -> np.ndarray:
    """A depth image [H, W], float32, metres, 0 = none; integers are multiplied by depth_scale, floats are metres."""
    raw = _decode(path, cv2.IMREAD_UNCHANGED)
    if raw.ndim == 3:
        if (raw[..., :3] != raw[..., :1]).any():
            raise SequenceError(f"{path}: is a picture in colours; depth needs one channel, of 16 bits or floats in metres")
        raw = raw[..., 0]
    depth = raw.astype(np.float32) * (depth_scale if np.issubdtype(raw.dtype, np.integer) else 1.0)
    return clean_depth(depth)


def tell_coarse_depth(files: Mapping[int, Path], depth_scale: float) -> None:
    """Warn if the first of the depth images has 8 bits, as those that are made to be looked at."""
    path = next(iter(files.values()), None)
    if path is not None and _decode(path, cv2.IMREAD_UNCHANGED).dtype == np.uint8:
        logger.warning(
            "%s: has 8 bits, so that depth goes in steps of %g mm up to %g m; if it was made to be looked at, leave the folder out, "
            "else check depth_scale, or write 16 bits or floats in metres",
            path, 1e3 * depth_scale, 255 * depth_scale,
        )  # fmt: skip


def image_size(image: np.ndarray) -> tuple[int, int]:
    """Width and height of an image [H, W, ...], pixels."""
    return image.shape[1], image.shape[0]


def check_size(image: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    """The image, if it has the recording's size (width, height)."""
    if image_size(image) != tuple(size):
        raise SequenceError(f"{path}: is {image.shape[1]}×{image.shape[0]}, but the recording is {size[0]}×{size[1]}; give all one size")
    return image


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether images of two sizes (width, height) have one ratio of sides, but for rounding."""
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= 0.01


def clean_depth(depth: np.ndarray) -> np.ndarray:
    """Depth as float32 with every value that is not finite and positive set to 0."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _decode(path: Path, flags: int) -> np.ndarray:
    if not path.is_file():
        raise SequenceError(f"{path}: file is missing")
    try:
        image = cv2.imread(str(path), flags)
    except cv2.error:  # its size is beyond OPENCV_IO_MAX_IMAGE_PIXELS
        raise SequenceError(f"{path}: the image has over 64 megapixels, or is damaged; make it smaller or copy it again") from None
    if image is None or path.suffix.lower() in _JPEG and _is_cut_off(path.read_bytes()):  # of such a JPEG the rest would be grey
        raise SequenceError(f"{path}: not a readable image; the file is damaged, copy it again")
    return image


def _is_cut_off(jpeg: bytes) -> bool:
    """Whether the last scan in a JPEG has no end: neither marker is in what is coded, but a thumbnail has both."""
    return jpeg.startswith(b"\xff\xd8") and jpeg.rfind(b"\xff\xd9") < jpeg.rfind(b"\xff\xda")


def numbered_files(folder: Path, ending: str = "") -> dict[int, Path]:
    """Image files by the last number in their name: `000012.png` and `frame-000012.mask.png` are both 12.

    Args:
        folder: Where to look; a folder that does not exist holds no files.
        ending: What the name before the extension must end with, such as `l` for left images.

    Raises:
        SequenceError: If two have one number, or one is of a format that is not read.
    """
    files: dict[int, Path] = {}
    numberless = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        digits = re.findall(r"\d+", path.stem)
        if path.name.startswith(".") or not path.stem.endswith(ending):
            continue
        if not digits:
            if path.suffix.lower() in _SUFFIXES:
                numberless.append(path.name)
            continue
        if path.suffix.lower() in _UNREAD:
            raise SequenceError(
                f"{folder}: {path.name} is of a format that is not read; convert such images, for instance to .png, or move them away"
            )
        if path.suffix.lower() not in _SUFFIXES:
            continue
        if len(digits[-1]) > _MOST_DIGITS:
            raise SequenceError(f"{folder}: {path.name} has {len(digits[-1])} digits in a row; number frames with {_MOST_DIGITS} at most")
        number = int(digits[-1])
        if number in files:
            both = f"{files[number].name} and {path.name}"
            if {files[number].stem[-1], path.stem[-1]} == {"l", "r"}:
                raise SequenceError(f"{folder}: {both} are of two eyes, as in StereoMIS; put its StereoCalibration.ini beside this folder")
            raise SequenceError(f"{folder}: {both} have the same number, the last in the name; rename one, or move it away")
        files[number] = path
    if files and numberless:
        more = " and others" if len(numberless) > 3 else ""
        logger.warning("%s: images without a number in their names are left out: %s%s", folder, ", ".join(numberless[:3]), more)
    return files
