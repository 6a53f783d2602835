"""Calibrations that ROS and OpenCV write, of one camera or of a stereo pair.

ROS (camera_calibration): ost.yaml, or left.yaml and right.yaml; camera_matrix and distortion_coefficients are of the raw image,
rectification_matrix and projection_matrix lead to the rectified one.
OpenCV (cv2.FileStorage, YAML or XML, or plain YAML with the same names): camera_matrix and distortion_coefficients of one camera;
K1 D1 K2 D2 R T, as stereoCalibrate gives them, of a pair, in one file or in several.
"""

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from endo_sim_ros.core.cameras import intrinsic_matrix
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.calibration_files import check_baseline, check_calibrated_size, read_calibration, read_text, refuse_impossible
from endo_sim_ros.sequences.rectification import HALF_PIXEL, StereoCalibration

logger = logging.getLogger(__name__)

CALIBRATION_FILE = "calibration.yaml"

_SUFFIXES = (".yaml", ".yml", ".xml")
_MARK = re.compile(r"opencv-matrix|camera_?matrix|^[KM]1 *:", re.IGNORECASE | re.MULTILINE)  # in the text of such a calibration
_OF_CAMERA = {  # names in the file of one camera, and what they are called here, where the number of the camera follows
    "camera_matrix": "K",
    "cameraMatrix": "K",
    "K": "K",
    "distortion_coefficients": "D",
    "distCoeffs": "D",
    "D": "D",
    "rectification_matrix": "R",
    "projection_matrix": "P",
}
_OF_PAIR = {"R": "R", "T": "T"} | {
    f"{name}{eye}": f"{here}{eye}"
    for name, here in (("K", "K"), ("M", "K"), ("cameraMatrix", "K"), ("D", "D"), ("distCoeffs", "D"), ("R", "R"), ("P", "P"))
    for eye in "12"
}
_COUNTS = {"K": (9,), "D": (0, 4, 5, 8, 12, 14), "R": (9,), "P": (12,), "T": (3,)}  # numbers in each
_SHAPES = {"K": (3, 3), "R": (3, 3), "P": (3, 4)}
_MOST_NUMBERS = 15  # of a matrix that are looked at, one more than any has
_MOST_BYTES = 1_000_000  # of a file; some hold all corners of the chessboards
_MODELS = ("", "plumb_bob", "rational_polynomial")  # of distortion, as ROS names them


@dataclass(frozen=True)
class Cameras:
    """What files of ROS or OpenCV tell, in their conventions.

    Args:
        source: The files, for messages.
        values: Matrices by name: K1 [3, 3] and D1 [N] of the raw image of the left or only camera, R1 [3, 3] and P1 [3, 4] that
            rectify it, K2, D2, R2 and P2 of the right one, R [3, 3] and T [3] from the left to the right camera.
        size: Image width and height, pixels; None where they are not told.
    """

    source: str
    values: Mapping[str, np.ndarray]
    size: tuple[int, int] | None

    def single(self, rectified: bool) -> dict[str, Any]:
        """The left or only camera as `read_calibration` gives it: of raw images, or of rectified ones.

        Raises:
            SequenceError: If the files do not tell how raw images are distorted.
        """
        if not rectified and "D1" not in self.values:
            raise SequenceError(f"{self.source}: distortion_coefficients, or D1 of a pair, is missing; write zeros if the lens has none")
        K = self.values.get("P1", self.values["K1"])[:, :3] if rectified else self.values["K1"]
        K = K + HALF_PIXEL
        fields = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        fields["distortion"] = [] if rectified else self.values["D1"].tolist()
        return fields | (dict(zip(("width", "height"), self.size, strict=True)) if self.size else {})

    def raw_pair(self, size: tuple[int, int]) -> StereoCalibration:
        """Both cameras, of images of a size (width, height) where the files tell none.

        Raises:
            SequenceError: If something is missing, or no endoscope is so.
        """
        values = dict(self.values)
        if "R" not in values and {"R1", "P1", "R2", "P2"} <= values.keys():  # x2 = R2ᵀ (R1 x1 − (B, 0, 0))
            values["R"], values["T"] = values["R2"].T @ values["R1"], -self._baseline() * values["R2"][0]
        missing = next((name for name in ("K1", "D1", "K2", "D2", "R", "T") if name not in values), None)
        if missing:
            raise SequenceError(
                f"{self.source}: {missing} is missing; a stereo pair needs K1, D1, K2, D2, R and T of OpenCV, or left.yaml and right.yaml "
                "of ROS"
            )
        eyes = values["K1"], values["D1"], values["K2"], values["D2"]
        calibration = StereoCalibration(self.source, self.size or size, *eyes, values["R"], values["T"])
        baseline = float(np.linalg.norm(calibration.T))
        check_baseline(f"{self.source}: T", baseline)
        logger.info("%s: the eyes are %.2f mm apart", self.source, 1e3 * baseline)
        return calibration

    def rectified_pair(self, calibration: StereoCalibration) -> dict[str, Any]:
        """Both cameras of rectified images as `read_calibration` gives them, with the baseline of the raw pair.

        Raises:
            SequenceError: If the files do not tell them.
        """
        K = [self.values[name][:, :3] for name in ("P1", "P2") if name in self.values]
        if len(K) < 2 or not np.allclose(*K, atol=0.01):
            raise SequenceError(
                f"{self.source}: the images are rectified, but P1 and P2, or projection_matrix of both eyes, which tell how, are "
                f"{'missing' if len(K) < 2 else 'not alike'}; give the raw images, state frames_rectified=false if these are, or write "
                f"{CALIBRATION_FILE} of the rectified ones"
            )
        return self.single(rectified=True) | {"baseline_m": float(np.linalg.norm(calibration.T))}

    def _baseline(self) -> float:
        """Distance of the eyes by their projections, in the unit of the file."""
        P = self.values["P2"]
        if not P[0, 3] < 0 < P[0, 0]:
            exchanged = self.values["P1"][0, 3] < 0
            cause = ", that of the left one does: exchange the files" if exchanged else "; P[0, 3] is minus fx times it"
            raise SequenceError(f"{self.source}: projection_matrix of the right eye tells no baseline{cause}")
        return float(-P[0, 3] / P[0, 0])


def find_calibration(folder: Path) -> list[Path]:
    """calibration.yaml in a folder, or the files of ROS and OpenCV that are there in its place; empty where there are none."""
    ours = folder / CALIBRATION_FILE
    if ours.is_file():
        return [ours]
    present = sorted(folder.iterdir()) if folder.is_dir() else []
    files = (file for file in present if file.suffix.lower() in _SUFFIXES and not file.name.startswith("."))
    small = (file for file in files if file.is_file() and file.stat().st_size <= _MOST_BYTES)
    return [file for file in small if _MARK.search(file.read_text(encoding="utf-8", errors="replace"))]


def intrinsics(
    source: Path, calibration: dict[str, Any], values: tuple[float | None, ...], distortion: Sequence[float], size: tuple[int, int]
) -> tuple[np.ndarray | None, Sequence[float]]:
    """K [3, 3] and distortion from what `read_one` gives or from arguments; K is None when neither is given."""
    fx, fy, cx, cy, baseline = values
    if calibration:
        if fx is not None or baseline is not None:
            raise SequenceError(f"{source}: pass either a calibration file or fx and baseline_m, not both")
        check_calibrated_size(calibration, size, source)
        return intrinsic_matrix(*(calibration[name] for name in ("fx", "fy", "cx", "cy"))), calibration["distortion"]
    if fx is None:
        if any(value is not None for value in values) or len(distortion):
            raise SequenceError(f"{source}: fy, cx, cy, distortion and baseline_m need fx as well")
        return None, ()
    fy, cx, cy = fx if fy is None else fy, size[0] / 2 if cx is None else cx, size[1] / 2 if cy is None else cy
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise SequenceError(f"{source}: fx and fy must be positive, got fx={fx}, fy={fy}, cx={cx}, cy={cy}")
    K = intrinsic_matrix(fx, fy, cx, cy)
    refuse_impossible(K, size, source)
    return K, distortion


def read_cameras(files: Sequence[Path]) -> Cameras | None:
    """The cameras in files of ROS or OpenCV; None of a file in this package's own form, and of what has no camera in it.

    Raises:
        SequenceError: If a file cannot be read, or a matrix is wrong or told twice, or sizes differ.
    """
    texts = {file: read_text(file, _MOST_BYTES) for file in files}
    if not any(map(_MARK.search, texts.values())):
        return None
    values, origin, size = dict[str, np.ndarray](), dict[str, Path](), None
    for file, text in texts.items():
        fields = _fields(file, text)
        if "fx" in fields:
            return None
        single = any(_OF_CAMERA.get(name) == "K" for name in fields)
        model = "fisheye" if fields.get("fisheye_model") else fields.get("distortion_model", "")  # as OpenCV and ROS tell it
        if single and model not in _MODELS:
            raise SequenceError(f"{file}: distortion of the model {model} is not read; calibrate with plumb_bob or rational_polynomial")
        eye = "2" if "right" in file.stem.lower() and len(files) > 1 else "1"
        for name, value in fields.items():
            here = f"{_OF_CAMERA[name]}{eye}" if single and name in _OF_CAMERA else None if single else _OF_PAIR.get(name)
            if here is None:
                continue
            if here in values:
                raise SequenceError(f"{file}: {name} is in {origin[here].name} as well; name files of a pair left and right, or keep one")
            values[here], origin[here] = _matrix(value, here[0], f"{file}: {name}"), file
        told = _size(fields, file)
        if size and told and told != size:
            shown = " and ".join(f"{width}×{height}" for width, height in (size, told))
            raise SequenceError(f"{file}: the cameras would have images of {shown}; calibrate both with images of one size")
        size = size or told
    if "K1" not in values:
        return None
    source = str(files[0]) if len(files) == 1 else f"{files[0].parent}: {', '.join(file.name for file in files)}"
    return Cameras(source, values, size)


def read_one(source: Path, files: Sequence[Path], rectified: bool | None) -> dict[str, Any]:
    """One camera as `read_calibration` gives it, from files of ROS, OpenCV or this package's own form; empty where there are none.

    Args:
        source: The first file, or the recording where there is none, for messages.
        files: As of `find_calibration`.
        rectified: Whether its images are rectified; None: not by files of ROS and OpenCV.

    Raises:
        SequenceError: If a file is wrong, or `rectified` given without one of ROS or OpenCV.
    """
    cameras = read_cameras(files)
    if cameras is None:
        if rectified is not None:
            raise SequenceError(f"{source}: frames_rectified is for calibrations of ROS and OpenCV; leave it out")
        return read_calibration(files[0]) if files else {}
    logger.info("%s: its camera is taken, for %s images", cameras.source, "rectified" if rectified else "raw")
    return cameras.single(bool(rectified))


def _fields(path: Path, text: str) -> dict[str, Any]:
    """Numbers and words in a file by name; of a matrix its numbers, and of each no more than one has."""
    try:
        if "opencv-matrix" not in text:  # OpenCV reads but a part of YAML
            fields = yaml.safe_load(text)
        else:
            begun = text.lstrip().startswith(("%YAML", "<?xml"))
            storage = cv2.FileStorage(text if begun else f"%YAML:1.0\n---\n{text}", cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            fields = {name: _plain(storage.getNode(name)) for name in storage.root().keys()}  # noqa: SIM118 (no dict)
    except (cv2.error, SystemError, ValueError, RecursionError, yaml.YAMLError) as error:
        why = str(error.__cause__ or error).splitlines()[0]
        raise SequenceError(f"{path}: not a readable calibration of ROS or OpenCV ({why}); copy or write it again") from None
    return {name: _content(value) for name, value in fields.items()} if isinstance(fields, dict) else {}


def _plain(node: cv2.FileNode) -> Any:
    """What a node of OpenCV holds, as YAML has it; of a map only `data`."""
    if node.isMap():
        return {"data": _plain(node.getNode("data"))}
    if node.isSeq():
        return [_plain(node.at(i)) for i in range(min(int(node.size()), _MOST_NUMBERS))]
    return node.string() if node.isString() else node.real() if node.isReal() or node.isInt() else None


def _content(value: Any) -> float | str | list[float]:
    data = value.get("data") if isinstance(value, dict) else value
    if isinstance(data, list):  # a matrix, also as lists of rows, or a vector of C++
        rows = [each if isinstance(each, list) else [each] for each in data[:_MOST_NUMBERS]]
        return [_number(each) for row in rows for each in row[:_MOST_NUMBERS]]
    return data if isinstance(data, str) else _number(data)


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _matrix(value: float | str | list[float], kind: str, where: str) -> np.ndarray:
    if not isinstance(value, list) or len(value) not in _COUNTS[kind] or not np.isfinite(value).all():
        raise SequenceError(f"{where} must have {' or '.join(map(str, _COUNTS[kind]))} finite numbers; calibrate the camera")
    return np.reshape(value, _SHAPES.get(kind, -1))


def _size(fields: Mapping[str, Any], path: Path) -> tuple[int, int] | None:
    if not {"image_width", "image_height"} <= fields.keys():
        return None
    size = fields["image_width"], fields["image_height"]
    if not all(isinstance(side, float) and 1 <= side < 1e6 for side in size):
        raise SequenceError(f"{path}: image_width and image_height must be positive, in pixels, got {size[0]} and {size[1]}")
    return int(size[0]), int(size[1])
