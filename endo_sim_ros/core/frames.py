"""The unit that flows from every recording into the reconstruction: one rectified, posed view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from endo_sim_ros.core.cameras import Camera

LEFT_FRAME, RIGHT_FRAME, WORLD_FRAME = "endoscope_left", "endoscope_right", "world"  # names of coordinate frames


class SequenceError(ValueError):
    """A recording that cannot be read; the message names the file and the field and says what to do."""


@dataclass(frozen=True)
class Frame:
    """One view of a sequence.

    Args:
        stamp_ns: Time of exposure, nanoseconds; unique and increasing within a sequence.
        image: Rectified RGB image [H, W, 3], uint8.
        camera: Left camera with its camera-to-world pose, metres.
        right: Rectified right RGB image [H, W, 3], uint8, or None.
        baseline: Distance from the left to the right camera along +x, metres, or None without a right image.
        right_K: Intrinsics of the right camera [3, 3] after rectification, or None when equal to the left's.
        depth: Depth along the optical axis [H, W], float32, metres; 0 = no measurement; or None.
        mask: [H, W], uint8, 255 = tissue to be used, 0 = ignore; or None.
    """

    stamp_ns: int
    image: np.ndarray
    camera: Camera
    right: np.ndarray | None = None
    baseline: float | None = None
    right_K: np.ndarray | None = None
    depth: np.ndarray | None = None
    mask: np.ndarray | None = None

    def __post_init__(self):
        shape = (self.camera.height, self.camera.width)
        for name in ("image", "right", "depth", "mask"):
            array = getattr(self, name)
            if array is not None and array.shape[:2] != shape:
                raise SequenceError(
                    f"frame {self.stamp_ns}: {name} is {array.shape[1]}×{array.shape[0]}, but the camera says {shape[1]}×{shape[0]}"
                )

    @property
    def right_intrinsics(self) -> np.ndarray:
        """Those of the right camera [3, 3], pixels."""
        return self.camera.K if self.right_K is None else self.right_K

    @property
    def right_camera(self) -> Camera:
        """The right camera of a frame that has one."""
        assert self.baseline is not None
        return replace(self.camera.beside(self.baseline), K=self.right_intrinsics)

    @property
    def tissue(self) -> np.ndarray:
        """Where there is tissue to be used [H, W], float32, 1 or 0."""
        return np.ones(self.image.shape[:2], np.float32) if self.mask is None else (self.mask > 0).astype(np.float32)


def interpolated(stamps_ns: Sequence[int], values: np.ndarray, stamp_ns: int) -> np.ndarray:
    """Values [V, N] of frames, in any order, at a time between them [N], constant before the first and after the last."""
    ahead = np.array([float(stamp - stamp_ns) for stamp in stamps_ns])
    order = ahead.argsort(kind="stable")
    return np.array([np.interp(0.0, ahead[order], each[order]) for each in values.T])
