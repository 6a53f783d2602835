"""Undistortion and stereo rectification.

Calibrations on the way in follow OpenCV (pixel (0, 0) has its centre at (0, 0)); the rectified K on the way out
follows `endo_sim_ros.core.cameras` (centre at (0.5, 0.5)).
"""

from __future__ import annotations

import dataclasses
import functools
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera, principal_point_inside
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.calibration_files import refuse_impossible, unit_of
from endo_sim_ros.sequences.images import clean_depth

logger = logging.getLogger(__name__)

Maps = Sequence[np.ndarray]  # raw column and row [H, W] of every rectified pixel, float32
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
AHEAD = np.array([0.0, 0.0, 1.0])  # times the depth of a pixel: all that is known of a point where the lens does not turn
_OUTSIDE = -2.0  # pixels, of no image: black when it is remapped


@dataclass(frozen=True)
class StereoCalibration:
    """Two cameras as a stereo calibration gives them, OpenCV conventions.

    Args:
        source: The calibration file, for messages.
        size: Image width and height, pixels.
        K_left, K_right: Intrinsic matrices [3, 3], pixels.
        D_left, D_right: Distortion coefficients [4, 5, 8, 12 or 14], in the order of OpenCV; empty for none.
        R, T: Rotation [3, 3] and translation [3] from the left to the right camera: x_right = R x_left + T. T may be given in
            metres or millimetres, which its length tells, and is in metres here.
    """

    source: str
    size: tuple[int, int]
    K_left: np.ndarray
    D_left: np.ndarray
    K_right: np.ndarray
    D_right: np.ndarray
    R: np.ndarray
    T: np.ndarray

    def __post_init__(self):
        shapes = {"K_left": (3, 3), "K_right": (3, 3), "R": (3, 3), "T": (3,), "D_left": None, "D_right": None}
        for name, shape in shapes.items():
            value = np.asarray(getattr(self, name), np.float64)
            value = value.ravel() if len(shape or (1,)) == 1 else value
            if not np.isfinite(value).all() or (shape and value.shape != shape):
                raise SequenceError(f"{self.source}: {name} must be finite with shape {shape}, got {value.tolist()}")
            object.__setattr__(self, name, value)
        for name in ("K_left", "K_right"):
            K = getattr(self, name)
            if K[0, 0] <= 0 or K[1, 1] <= 0:
                raise SequenceError(
                    f"{self.source}: {name} must have positive focal lengths, got fx {K[0, 0]:g} and fy {K[1, 1]:g}; correct it"
                )
            refuse_impossible(K, self.size, f"{self.source}: {name}")
        if np.abs(self.R @ self.R.T - np.eye(3)).max() > 0.01 or np.linalg.det(self.R) < 0:
            raise SequenceError(f"{self.source}: R is not a rotation; correct it")
        object.__setattr__(self, "T", unit_of(float(np.linalg.norm(self.T)), f"{self.source}: T") * self.T)
        if abs(self.T[0]) <= np.abs(self.T[1:]).max():
            raise SequenceError(f"{self.source}: the eyes are not side by side: T is {self.T.tolist()} m")
        if self.T[0] > 0:
            # Some tools write the pose of the right camera instead of the change of coordinates.
            logger.warning("%s: T points to the right eye, so R and T are read as its pose in the left frame", self.source)
            object.__setattr__(self, "T", -self.R.T @ self.T)
            object.__setattr__(self, "R", self.R.T.copy())

    def project_left(self, points: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] in the raw left image, OpenCV convention, of points [N, 3] in its camera's frame."""
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.K_left, self.D_left)[0][:, 0]

    def rays(self) -> np.ndarray:
        """Directions (x, y, 1) that the pixels of the raw left image look in [H, W, 3], in its camera's frame."""
        pixels = np.stack(np.meshgrid(*map(np.arange, self.size)), -1).reshape(-1, 1, 2).astype(np.float64)
        slopes = cv2.undistortPoints(pixels, self.K_left, self.D_left)
        return cv2.convertPointsToHomogeneous(slopes).reshape(*self.size[::-1], 3)

    def rectified_points(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where pixels [N, 2] of the raw left and right images lie after `Rectification.stereo`, this package's pixel convention."""
        R_left, R_right, P_left, P_right = _stereo_rectify(self)
        eyes = ((left, self.K_left, self.D_left, R_left, P_left), (right, self.K_right, self.D_right, R_right, P_right))
        moved = [cv2.undistortPoints(uv[:, None] - 0.5, K, D, R=R, P=P)[:, 0] + 0.5 for uv, K, D, R, P in eyes]
        return moved[0], moved[1]

    def resized(self, width: int, height: int) -> StereoCalibration:
        """The calibration for images of another size with the same field of view."""
        if (width, height) == self.size:
            return self
        sx, sy = width / self.size[0], height / self.size[1]
        if abs(sx / sy - 1) > 0.01:
            raise SequenceError(
                f"{self.source}: is for images of {self.size[0]}×{self.size[1]}, but the images are {width}×{height}; "
                "use the calibration that belongs to this recording"
            )
        logger.info("%s: intrinsics scaled from %d×%d to %d×%d", self.source, *self.size, width, height)
        scale = np.diag([sx, sy, 1.0])
        left, right = (scale @ (K + HALF_PIXEL) - HALF_PIXEL for K in (self.K_left, self.K_right))
        return dataclasses.replace(self, size=(width, height), K_left=left, K_right=right)


class Rectification:
    """Maps raw images, masks, depth and poses into the rectified left camera (and its twin on the right).

    Attributes:
        K: Intrinsics of both rectified cameras [3, 3], pixels, this package's pixel convention.
        baseline: Distance to the right camera along +x, metres; None for one eye.
        rotation: Rotation [3, 3] from the raw to the rectified left camera frame.
        valid: Mask [H, W], uint8: 255 where the raw left image has the pixel, 0 on the black border.
    """

    def __init__(
        self,
        size: tuple[int, int],
        K: np.ndarray,
        rotation: np.ndarray,
        left_maps: Maps | None,
        right_maps: Maps | None = None,
        baseline: float | None = None,
    ):
        self.size = size
        self.K = K
        self.rotation = rotation
        self.baseline = baseline
        self._left_maps = left_maps
        self._right_maps = right_maps
        if left_maps is None:
            self.valid = np.full(size[::-1], 255, np.uint8)
        else:
            u, v = left_maps
            self.valid = np.where(_inside(u, v, size), np.uint8(255), np.uint8(0))

    @classmethod
    def stereo(cls, calibration: StereoCalibration, alpha: float = 0) -> Rectification:
        """Rows aligned, one K and no disparity at infinity for both eyes.

        Args:
            calibration: Of both eyes.
            alpha: As OpenCV's: 0 zooms until nothing outside the raw images is seen; −1, its default, does not zoom.
        """
        c, size = calibration, calibration.size
        R_left, R_right, P_left, P_right = _stereo_rectify(c, alpha)
        baseline = -P_right[0, 3] / P_right[0, 0]
        if not np.isfinite(P_left).all() or not baseline > 0 or not principal_point_inside(P_left, *size):
            raise SequenceError(f"{c.source}: the two cameras cannot be rectified; check R, T and distortion")
        left = _maps(c.K_left, c.D_left, R_left, P_left, size, f"{c.source}, left eye")
        right = _maps(c.K_right, c.D_right, R_right, P_right, size, f"{c.source}, right eye")
        return cls(size, P_left[:, :3] + HALF_PIXEL, R_left, left, right, float(baseline))

    @classmethod
    def mono(
        cls, K: np.ndarray | None, distortion: Sequence[float] | np.ndarray, size: tuple[int, int], source: Path | str = "calibration"
    ) -> Rectification:
        """A rectification that undistorts one eye, without rotation and baseline. Its K is zoomed so that no border is black.

        Args:
            K: Intrinsics [3, 3] of the raw image, this package's pixel convention (as COLMAP's). None: unknown; images stay raw, and the
                result's K means nothing.
            distortion: Coefficients k1 [k2 [p1 p2 [k3]]] as OpenCV orders them; empty or zeros for none.
            size: Image width and height, pixels.
            source: Of these, for messages.

        Raises:
            SequenceError: If no lens distorts so.
        """
        coefficients = np.zeros(max(5, len(distortion)))
        coefficients[: len(distortion)] = distortion
        if K is None or not coefficients.any():
            return cls(size, np.eye(3) if K is None else np.array(K, np.float64), np.eye(3), None)
        K_cv = K - HALF_PIXEL
        try:
            K_new, _ = cv2.getOptimalNewCameraMatrix(K_cv, coefficients, size, 0)
        except cv2.error:  # of a number of coefficients that it does not know
            K_new = np.zeros((3, 3))
        zoom = max(K_new[0, 0] / K_cv[0, 0], K_new[1, 1] / K_cv[1, 1])  # one zoom for both axes: pixels stay as they are
        if not 0.1 < zoom < 10 or not principal_point_inside(K_new, *size):  # no lens needs as much
            shown = ", ".join(f"{value:g}" for value in distortion)
            raise SequenceError(f"{source}: distortion {shown} is that of no lens; give k1 [k2 [p1 p2 [k3]]] as OpenCV finds them")
        K_new[0, 0], K_new[1, 1] = zoom * K_cv[0, 0], zoom * K_cv[1, 1]
        maps = _maps(K_cv, coefficients, np.eye(3), K_new, size, str(source))
        return cls(size, K_new + HALF_PIXEL, np.eye(3), maps)

    def left(self, image: np.ndarray) -> np.ndarray:
        """Rectified left image [H, W, 3]."""
        return self._remap(image, self._left_maps, cv2.INTER_LINEAR)

    def right(self, image: np.ndarray) -> np.ndarray:
        """Rectified right image [H, W, 3]."""
        return self._remap(image, self._right_maps, cv2.INTER_LINEAR)

    def mask(self, mask: np.ndarray | None) -> np.ndarray:
        """Rectified mask [H, W] of a raw one (255 = tissue), with the black border ignored; None masks nothing else."""
        if mask is None:
            return self.valid
        return cv2.bitwise_and(self._remap(mask, self._left_maps, cv2.INTER_NEAREST), self.valid)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Rectified depth [H, W] of a raw map of points [H, W, 3], metres, in the raw left camera frame.

        Rectification turns the camera, so the depth of a point changes; it is not the raw depth moved about.
        Points that are not finite, or lie at or behind the camera, have no depth.
        """
        with np.errstate(invalid="ignore"):
            measured = np.isfinite(points).all(-1) & (points[..., 2] > 0)
            z = np.where(measured, points @ self.rotation[2], 0)
        return self._remap(clean_depth(z), self._left_maps, cv2.INTER_NEAREST)

    def project_left(self, points: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] in the rectified left image, OpenCV convention, of points [N, 3] in the raw left camera's frame."""
        turn = cv2.Rodrigues(self.rotation)[0]
        return cv2.projectPoints(points, turn, np.zeros(3), self.K - HALF_PIXEL, np.zeros(5))[0][:, 0]

    def pose(self, pose: np.ndarray) -> np.ndarray:
        """Camera-to-world pose [4, 4] of the rectified left camera from that of the raw one."""
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ self.rotation.T
        return turned

    def frame(
        self, stamp_ns: int, left: np.ndarray, right: np.ndarray | None, pose: np.ndarray, mask: np.ndarray, depth: np.ndarray | None = None
    ) -> Frame:
        """A frame of what is rectified, images [H, W, 3], mask and depth [H, W], at the pose [4, 4] of the raw left camera."""
        camera = Camera(self.K, *self.size, self.pose(pose))
        return Frame(stamp_ns, left, camera, right=right, baseline=self.baseline, depth=depth, mask=mask)

    def _remap(self, image: np.ndarray, maps: Maps | None, interpolation: int) -> np.ndarray:
        if image.shape[1::-1] != tuple(self.size):
            raise SequenceError(f"image is {image.shape[1]}×{image.shape[0]}, but its calibration is for {self.size[0]}×{self.size[1]}")
        return image if maps is None else cv2.remap(image, maps[0], maps[1], interpolation)


def _maps(K: np.ndarray, distortion: np.ndarray, rotation: np.ndarray, K_new: np.ndarray, size: tuple[int, int], source: str) -> Maps:
    """Where each rectified pixel is in the raw image [H, W], OpenCV's pixel convention; outside of it where a distortion does not hold.

    Polynomials hold as far out as the chessboards were. Farther out they may turn back, and the picture would be seen once more, mirrored.

    Args:
        K, distortion: Of the raw image.
        rotation, K_new: Into the rectified one; its principal point is inside it.
        size: Width and height of both.
        source: Of these, for messages.
    """
    u, v = cv2.initUndistortRectifyMap(K, distortion, rotation, K_new, size, cv2.CV_32FC1)
    inside = _inside(u, v, size)
    (u_down, u_across), (v_down, v_across) = np.gradient(u), np.gradient(v)
    labels = cv2.connectedComponents((u_across * v_down > u_down * v_across).astype(np.uint8), connectivity=4)[1]
    column, row = (min(max(int(at), 0), side - 1) for at, side in zip(K_new[:2, 2], size))
    folded = labels != labels[row, column]
    u[folded] = v[folded] = _OUTSIDE
    if (folded & inside).any():
        _tell_folded(source, f"{(folded & inside).mean():.1%}")
    return u, v


def _inside(u: np.ndarray, v: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return (u >= 0) & (u <= size[0] - 1) & (v >= 0) & (v <= size[1] - 1)


@functools.cache  # a recording is opened several times
def _tell_folded(source: str, share: str) -> None:
    text = "%s: its distortion turns back before the edges: %s of the frame is left out; if that is tissue, calibrate with the board there"
    logger.info(text, source, share)


def _stereo_rectify(c: StereoCalibration, alpha: float = 0) -> Sequence[np.ndarray]:
    """Rotations [3, 3] of both eyes and their new projections [3, 4], OpenCV's pixel convention."""
    return cv2.stereoRectify(
        c.K_left, c.D_left, c.K_right, c.D_right, c.size, c.R, c.T[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=alpha
    )[:4]
