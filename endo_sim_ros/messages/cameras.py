"""Camera calibrations, and the rectification that they ask for."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np

from endo_sim_ros.core.cameras import focal_length_possible, principal_point_inside
from endo_sim_ros.messages.headers import make_header
from endo_sim_ros.messages.topics import LEFT_INFO
from endo_sim_ros.messages.types import Message, MessageError, MessageTypes, ros_types

__all__ = ["CameraInfo", "decode_camera_info", "encode_camera_info"]

_DISTORTION_MODELS = ("", "plumb_bob", "rational_polynomial")


@dataclass(frozen=True)
class CameraInfo:
    """Intrinsics, distortion and rectification of one eye, in pixels and metres, as in a sensor_msgs/CameraInfo."""

    K: np.ndarray  # [3, 3] of the raw image
    D: np.ndarray  # distortion coefficients (plumb_bob / rational_polynomial), all zero when rectified
    R: np.ndarray  # [3, 3] rectifying rotation
    P: np.ndarray  # [3, 4] projection of the rectified image, P[0, 3] = −fx·B for a right eye
    width: int
    height: int

    @property
    def rectified(self) -> bool:
        """Whether images of this camera are rectified already."""
        return not self.D.any() and np.allclose(self.R, np.eye(3)) and np.allclose(self.K, self.P[:, :3])

    def same_as(self, other: "CameraInfo") -> bool:
        """Whether another calibration has the same values."""
        mine, others = (self.width, self.height), (other.width, other.height)
        return mine == others and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in ("K", "D", "R", "P"))

    @property
    def baseline(self) -> float:
        """Distance to the left eye along +x, metres. 0 for a left or single eye."""
        return float(-self.P[0, 3] / self.P[0, 0])

    def rectify(self, image: np.ndarray, nearest: bool = False) -> np.ndarray:
        """Rectified image [H, W, ...] of a raw one. Use ``nearest`` for masks and depth."""
        if self.rectified:
            return image
        return cv2.remap(image, *self._maps, cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR)

    @functools.cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        size = (self.width, self.height)
        return cv2.initUndistortRectifyMap(self.K, self.D, self.R, self.P[:, :3], size, cv2.CV_32FC1)

    @functools.cached_property
    def valid(self) -> np.ndarray:
        """Mask [H, W] uint8 of the rectified image: 255 where the raw image has a pixel, 0 in the border beyond it."""
        return self.rectify(np.full((self.height, self.width), 255, np.uint8), nearest=True)


def decode_camera_info(message: Message, topic: str = LEFT_INFO.name) -> CameraInfo:
    """Calibration of a CameraInfo. An R of zeros becomes the identity, a P without focal lengths becomes [K | 0].

    Raises:
        MessageError: If the camera is not calibrated, a value is impossible, or the distortion model is not supported.
    """
    K = np.asarray(message.k, np.float64).reshape(3, 3)
    D = np.asarray(message.d, np.float64)
    R = np.asarray(message.r, np.float64).reshape(3, 3)
    P = np.asarray(message.p, np.float64).reshape(3, 4)
    for name, value in (("K", K), ("D", D), ("R", R), ("P", P)):
        if not np.isfinite(value).all():
            raise MessageError(f"{topic}: {name} is not finite; calibrate the camera")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise MessageError(f"{topic}: K has focal lengths {K[0, 0]:g} and {K[1, 1]:g}; the camera is not calibrated")
    if message.width == 0 or message.height == 0:
        raise MessageError(f"{topic}: the image size is {message.width}×{message.height}")
    if message.distortion_model not in _DISTORTION_MODELS and D.any():
        raise MessageError(f"{topic}: distortion_model {message.distortion_model!r} is not supported; publish rectified images (D = 0)")
    if D.size not in (0, 4, 5, 8, 12, 14) or np.abs(D).max(initial=0) > 1e3:
        raise MessageError(f"{topic}: D = {D.tolist()} is not a set of OpenCV distortion coefficients; calibrate the camera")
    if not R.any():
        R = np.eye(3)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2:
        raise MessageError(f"{topic}: R is not a rotation; calibrate the camera, or set it to one for a single eye")
    if P[0, 0] <= 0 or P[1, 1] <= 0:
        P = np.hstack([K, np.zeros((3, 1))])
    for name, value in (("K", K), ("P", P)):
        if not focal_length_possible(value, message.width, message.height):
            raise MessageError(
                f"{topic}: {name} has focal lengths {value[0, 0]:g} and {value[1, 1]:g} pixels, which no endoscope has with images "
                f"of {message.width}×{message.height}; calibrate the camera"
            )
        if not principal_point_inside(value, message.width, message.height):
            raise MessageError(
                f"{topic}: {name} has the principal point ({value[0, 2]:g}, {value[1, 2]:g}), outside the images of "
                f"{message.width}×{message.height}; is the calibration of another size?"
            )
    if not np.allclose(P[2], [0, 0, 1, 0]):
        raise MessageError(f"{topic}: the last row of P is {P[2].tolist()}, not 0 0 1 0; calibrate the camera")
    return CameraInfo(K, D, R, P, message.width, message.height)


def encode_camera_info(
    K: np.ndarray, width: int, height: int, stamp_ns: int, frame_id: str, baseline: float = 0.0, types: MessageTypes = ros_types()
) -> Message:
    """CameraInfo of a rectified eye.

    Args:
        K: Intrinsics [3, 3], pixels.
        width, height: Size of the image, pixels.
        stamp_ns: Time, nanoseconds.
        frame_id: Optical frame of the eye.
        baseline: Distance of a right eye to the left one, metres: P[0, 3] = −fx·baseline.
        types: Message classes to build; those of ROS by default.
    """
    P = np.hstack([K, np.zeros((3, 1))])
    P[0, 3] = -K[0, 0] * baseline
    flat = lambda matrix: np.asarray(matrix, np.float64).reshape(-1)  # noqa: E731
    return types.CameraInfo(
        header=make_header(types, stamp_ns, frame_id),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=types.sequence(np.zeros(5)),
        k=flat(K),
        r=flat(np.eye(3)),
        p=flat(P),
        binning_x=0,
        binning_y=0,
        roi=types.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )
