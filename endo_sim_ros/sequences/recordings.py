"""What the dataset readers share: lazy recordings, videos, images, pose files, masks and time stamps."""

import functools
import logging
import math
import re
import reprlib
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import yaml

from endo_sim_ros.core.cameras import make_pose
from endo_sim_ros.core.frames import Frame, SequenceError

logger = logging.getLogger(__name__)

DEFAULT_FPS = 25.0
FIRST_STAMP_NS = 1_000_000_000  # a ROS stamp of 0 means "unset", so recordings begin at one second
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg")
POLARITIES = ("auto", "tool", "tissue")
_RIM = 0.02  # of the width, how far the edge of a round picture may be from where it is in other frames


class Recording:
    """A sequence of frames read lazily: every `iter()` reads the files again from the beginning.

    `len()` is the number of frames expected, for progress bars; a damaged video or a frame that structure from
    motion could not place makes the iteration shorter.
    """

    def __init__(self, frames: Callable[[], Iterator[Frame]], count: int):
        self._frames = frames
        self._count = count

    def __iter__(self) -> Iterator[Frame]:
        return self._frames()

    def __len__(self) -> int:
        return self._count


def stamp_ns(number: int, fps: float) -> int:
    """Time of exposure of a frame number, nanoseconds; frame 0 is at one second."""
    return round(number / fps * 1e9) + FIRST_STAMP_NS


def check_folder(path: Path | str) -> Path:
    path = Path(path)
    if not path.is_dir():
        raise SequenceError(f"{path}: no such folder; pass the folder of the recording")
    return path


def select(numbers: Iterable[int], source: Path, start: int | None, stop: int | None, step: int) -> list[int]:
    """Every step-th of the frame numbers in [start, stop), in increasing order."""
    if step < 1:
        raise SequenceError(f"{source}: step must be 1 or more, got {step}")
    inside = sorted(n for n in numbers if (start is None or n >= start) and (stop is None or n < stop))
    if not inside:
        raise SequenceError(f"{source}: no frame between start={start} and stop={stop}; widen the range")
    return inside[::step]


def keep_posed(numbers: list[int], poses: Container[int], pose_file: Path) -> list[int]:
    """The frame numbers that have a pose; the others are counted in the log."""
    posed = [n for n in numbers if n in poses]
    if not posed:
        raise SequenceError(f"{pose_file}: holds no pose for any of the {len(numbers)} chosen frames")
    if len(posed) < len(numbers):
        logger.info("%s: %d of %d frames have no pose and are skipped", pose_file, len(numbers) - len(posed), len(numbers))
    return posed


# ------------------------------------------------------------------------------------------------ images and video


def read_image(path: Path) -> np.ndarray:
    """An RGB image [H, W, 3], uint8."""
    return cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_gray(path: Path) -> np.ndarray:
    """A single-channel image [H, W], uint8."""
    return _decode(path, cv2.IMREAD_GRAYSCALE)


def read_depth(path: Path, depth_scale: float) -> np.ndarray:
    """A depth image [H, W], float32, metres, 0 = none; integers are multiplied by depth_scale, floats are metres."""
    raw = _decode(path, cv2.IMREAD_UNCHANGED)
    raw = raw[..., 0] if raw.ndim == 3 else raw
    depth = raw.astype(np.float32) * (depth_scale if np.issubdtype(raw.dtype, np.integer) else 1.0)
    return clean_depth(depth)


def check_size(image: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    """The image, if it has the recording's size (width, height)."""
    if image.shape[1::-1] != tuple(size):
        raise SequenceError(f"{path}: is {image.shape[1]}×{image.shape[0]}, but the recording is {size[0]}×{size[1]}")
    return image


def clean_depth(depth: np.ndarray) -> np.ndarray:
    """Depth as float32 with every value that is not finite and positive set to 0."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _decode(path: Path, flags: int) -> np.ndarray:
    if not path.is_file():
        raise SequenceError(f"{path}: file is missing")
    image = cv2.imread(str(path), flags)
    if image is None:
        raise SequenceError(f"{path}: not a readable image; the file is damaged, copy it again")
    return image


def numbered_files(folder: Path, suffixes: Sequence[str] = IMAGE_SUFFIXES, ending: str = "") -> dict[int, Path]:
    """Files by the last number in their name: `000012.png` and `frame-000012.mask.png` are both 12.

    Args:
        folder: Where to look; a folder that does not exist holds no files.
        suffixes: File name extensions to accept, lower case.
        ending: What the name before the extension must end with, such as `l` for left images.
    """
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        digits = re.findall(r"\d+", path.stem)
        if path.suffix.lower() not in suffixes or not path.stem.endswith(ending) or not digits:
            continue
        number = int(digits[-1])
        if number in files:
            raise SequenceError(f"{folder}: {files[number].name} and {path.name} have the same number; remove one")
        files[number] = path
    return files


def find_video(folder: Path) -> Path | None:
    """The only video of a folder, or None when there is none."""
    videos = sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    if len(videos) > 1:
        names = ", ".join(p.name for p in videos)
        raise SequenceError(f"{folder}: more than one video ({names}); keep one or pass the file itself")
    return videos[0] if videos else None


class Video:
    """A video file, decoded forwards only, because seeking is inexact in most containers."""

    def __init__(self, path: Path):
        self.path = path
        if not path.is_file():
            raise SequenceError(f"{path}: file is missing")
        capture = self._open()
        self.frame_count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        fps = capture.get(cv2.CAP_PROP_FPS)
        capture.release()
        self.fps = fps if math.isfinite(fps) and 0 < fps <= 1000 else DEFAULT_FPS
        if self.frame_count < 1 or self.width < 1 or self.height < 1:
            raise SequenceError(f"{path}: holds no video frames; the file is damaged, copy it again")

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise SequenceError(f"{self.path}: not a readable video; the file is damaged or its codec is unknown")
        return capture

    def frames(self, numbers: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        """RGB images [H, W, 3] of the given frame numbers, which must increase."""
        capture, position = self._open(), 0
        try:
            for done, number in enumerate(numbers):
                while position < number and capture.grab():
                    position += 1
                ok, image = capture.read() if position == number else (False, None)
                if not ok:
                    if not done:
                        raise SequenceError(f"{self.path}: frame {number} cannot be decoded; the video is damaged")
                    logger.warning(
                        "%s: the video ends before frame %d; %d frames are missing",
                        self.path, number, len(numbers) - done,
                    )  # fmt: skip
                    return
                position += 1
                yield number, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        finally:
            capture.release()


def split_stacked(image: np.ndarray, source: Path) -> tuple[np.ndarray, np.ndarray]:
    """Left and right image of a frame with the left eye stacked on top of the right."""
    height = image.shape[0]
    if height % 2:
        raise SequenceError(f"{source}: a stacked stereo video must have an even height, got {height}")
    return image[: height // 2], image[height // 2 :]


# ----------------------------------------------------------------------------------------- poses and calibrations


def read_poses(path: Path) -> dict[int, np.ndarray]:
    """Camera-to-world poses [4, 4] by frame number, from lines `frame tx ty tz qx qy qz qw`; # begins a comment."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SequenceError(f"{path}: file is missing") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path}: not a readable text file ({error})") from None
    poses: dict[int, np.ndarray] = {}
    for count, raw_line in enumerate(text.splitlines(), 1):
        line = raw_line.split("#")[0].replace(",", " ")
        if not line.strip():
            continue
        try:
            values = np.array([float(word) for word in line.split()])
        except ValueError:
            if not poses and count == 1:
                continue  # a heading
            raise SequenceError(f"{path}: line {count} is not made of numbers: {raw_line.strip()!r}") from None
        if len(values) != 8:
            raise SequenceError(f"{path}: line {count} has {len(values)} numbers, expected 8: frame tx ty tz qx qy qz qw")
        number, position, quat = int(values[0]) if np.isfinite(values[0]) else -1, values[1:4], values[[7, 4, 5, 6]]
        if not np.isfinite(values).all() or abs(np.linalg.norm(quat) - 1) > 0.05 or number != values[0] or number < 0:
            raise SequenceError(
                f"{path}: line {count} is not a pose; expected a whole frame number, a finite position and a unit "
                f"quaternion, got {raw_line.strip()!r}"
            )
        if number in poses:
            raise SequenceError(f"{path}: line {count} repeats frame {number}; keep one pose per frame")
        poses[number] = make_pose(position, quat)
    if not poses:
        raise SequenceError(f"{path}: holds no poses; expected lines `frame tx ty tz qx qy qz qw`")
    return poses


def rigid(matrix: np.ndarray, source: str) -> np.ndarray:
    """A rigid transform [4, 4] from one that is rigid up to rounding; its rotation is made exact."""
    try:
        matrix = np.asarray(matrix, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise SequenceError(f"{source}: expected a finite 4×4 matrix, got shape {matrix.shape}")
    u, singular, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(singular - 1).max() > 0.02 or np.linalg.det(u @ vt) < 0:
        raise SequenceError(f"{source}: its 3×3 block is not a rotation (singular values {singular.round(3).tolist()})")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ vt, matrix[:3, 3]
    return pose


_MOST_BYTES = 65_536  # of a calibration file


def read_calibration(path: Path) -> dict:
    """The calibration file of image folders and videos: YAML with fx, fy, cx, cy in pixels.

    Pixel (0, 0) has its centre at (0.5, 0.5), as everywhere in this package and in COLMAP; add 0.5 to cx and cy of an
    OpenCV calibration. Optional: width, height, baseline_m (metres), fps, distortion (OpenCV order k1 k2 p1 p2 k3).
    """
    if path.is_file() and path.stat().st_size > _MOST_BYTES:
        raise SequenceError(f"{path}: it has {path.stat().st_size} bytes, far more than a calibration needs")
    try:
        fields = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SequenceError(f"{path}: file is missing; it must give fx, fy, cx, cy in pixels") from None
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise SequenceError(f"{path}: not a readable YAML file ({str(error).splitlines()[0]})") from None
    if not isinstance(fields, dict):
        raise SequenceError(f"{path}: expected `name: value` lines with fx, fy, cx, cy in pixels")
    for name in ("fx", "fy", "cx", "cy", *(n for n in ("width", "height", "baseline_m", "fps") if n in fields)):
        value = fields.get(name)
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < 1e9:
            shown = reprlib.repr(value) if isinstance(value, int | float | str | None) else f"a {type(value).__name__}"  # lists may nest
            raise SequenceError(f"{path}: {name} must be a positive number, got {shown}")
    try:
        fields["distortion"] = [float(k) for k in fields.get("distortion") or ()]
    except (TypeError, ValueError, OverflowError):
        raise SequenceError(f"{path}: distortion must be a list of numbers") from None
    if not all(map(math.isfinite, fields["distortion"])):
        raise SequenceError(f"{path}: distortion must be finite, got {fields['distortion']}")
    return fields


def check_calibrated_size(calibration: dict, size: tuple[int, int], path: Path):
    """Refuses a calibration file that states another image size than (width, height)."""
    stated = calibration.get("width", size[0]), calibration.get("height", size[1])
    if stated != size:
        raise SequenceError(
            f"{path}: width and height are {stated[0]}×{stated[1]}, but the images are {size[0]}×{size[1]}; "
            "scale fx, fy, cx, cy or the images"
        )


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


# ------------------------------------------------------------------------------------------------------------ masks


def tool_is_white(masks: Iterable[np.ndarray], source: Path, polarity: str = "auto") -> bool:
    """Whether white in these masks means instrument rather than tissue.

    Instruments cover less of an image than tissue does, so the colour in the minority over all masks is taken for
    the instruments. The decision is logged, because it cannot be checked.

    Args:
        masks: A sample of the masks [H, W], uint8.
        source: Their folder, for messages.
        polarity: `auto`, or what white is known to be: `tool` or `tissue`.
    """
    if polarity not in POLARITIES:
        raise SequenceError(f"{source}: mask polarity must be one of {', '.join(POLARITIES)}, got {polarity!r}")
    if polarity != "auto":
        return polarity == "tool"
    white = float(np.mean([np.mean(mask > 127) for mask in masks]))
    tool = white <= 0.5
    unsure = 0.4 < white < 0.6
    logger.log(
        logging.WARNING if unsure else logging.INFO,
        "%s: white covers %.0f %% of the masks, so white is taken for %s%s",
        source, 100 * white, "tools" if tool else "tissue",
        "; this is close, state the polarity if it is wrong" if unsure else "",
    )  # fmt: skip
    return tool


def tissue_mask(mask: np.ndarray, *, white_is_tool: bool, size: tuple[int, int]) -> np.ndarray:
    """A mask [H, W] with 255 = tissue and 0 = ignore at the image's size (width, height)."""
    white = mask > 127
    tissue = np.where(white ^ white_is_tool, np.uint8(255), np.uint8(0))
    return tissue if tissue.shape[::-1] == size else cv2.resize(tissue, size, interpolation=cv2.INTER_NEAREST)


def lit_area(images: Iterable[np.ndarray], threshold: int = 16) -> np.ndarray:
    """Mask [H, W] (255 = seen, 0 = black) of what the optics show, from a sample of RGB images.

    Black means dark in all images but one in ten (a title, a flash) and connected to the image's edge: vignette or
    rectification border. Dark tissue in the middle of the image stays in.
    """
    values = [functools.reduce(cv2.max, cv2.split(image)) for image in images]  # ten times as fast as image.max(-1)
    if not values:
        raise ValueError("lit_area: no images")
    usual = len(values) - 1 - len(values) // 10
    dark = (np.partition(values, usual, 0)[usual] < threshold).astype(np.uint8)
    count, labels = cv2.connectedComponents(dark, connectivity=4)
    border = np.zeros(count, np.uint8)
    border[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = 1
    border[0] = 0  # what is not dark
    outside = cv2.dilate(border[labels], np.ones((5, 5), np.uint8))  # the fall-off beside the border is not tissue colour
    return np.where(outside > 0, np.uint8(0), np.uint8(255))


def lit_now(lit: np.ndarray, image: np.ndarray) -> np.ndarray:
    """A recording's lit area [H, W] without the rim that is black in this RGB image [H, W, 3].

    Round pictures wander on the sensor as the camera head turns on the endoscope, by a hundredth of the width or two.
    What is dark there, border or tissue, is left out; what is dark farther inside is tissue.
    """
    if lit.all():
        return lit
    side = 2 * max(round(_RIM * lit.shape[1]), 1) + 1
    rim = cv2.erode(lit, np.ones((side, side), np.uint8)) == 0
    return np.where(rim & (lit_area([image]) == 0), np.uint8(0), lit)


def spread(items: Sequence, count: int) -> list:
    """At most count items, evenly spread from the first to the last."""
    if len(items) <= count:
        return list(items)
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, count)]
